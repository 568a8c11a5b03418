"""Many postures at once, over a bare loop of Pinocchio's `computeFrameJacobian` (7 joints, all six rows).

Promises: Jacobians a third as fast as the loop, with checks and poses; mu and its gradient a tenth. Beside them
growth curves over postures. No table is asked for twice in a row, since the last one is kept.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import cycle

import numpy as np
import pinocchio as pin
import pytest
from timing import keep, rounds_of, summary

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.manipulability import manipulability_batch
from manip_learn.robot import Robot, load_robot

pytestmark = [pytest.mark.bench, pytest.mark.timeout(600)]
N = 8192
# at least so many times the rate of the bare loop
PROMISED = {"many": 0.3, "mu and gradient, many": 0.1}


@pytest.fixture(scope="module")
def robot() -> Robot:
    """The 7-joint arm."""
    return load_robot("sawyer")


@pytest.fixture(scope="module")
def q(robot: Robot) -> np.ndarray:
    """Postures of a chunk and more."""
    return np.random.default_rng(0).uniform(-1.5, 1.5, (N, robot.nv))


def report(title: str, seconds: dict[str, list[float]], n: dict[str, int]) -> dict[str, float]:
    """Print millions a second, and return the best of each: the neighbours' noise only ever adds time."""
    print(f"\n{title} (load {os.getloadavg()[0]:.1f})")
    best = {}
    for name, values in seconds.items():
        timing, count = summary(values), n[name]
        best[name] = count / timing.best
        print(
            f"  {name:32s} {count / timing.median / 1e6:8.3f} M/s median, {count / timing.best / 1e6:.3f} best, "
            f"quarters {count / timing.upper / 1e6:.3f} .. {count / timing.lower / 1e6:.3f}"
        )
    return best


def test_frame_jacobians(robot: Robot, q: np.ndarray) -> None:
    """All six rows of a 7-joint arm, and mu with its gradient for two of them, against Pinocchio in a loop."""
    features, xyz = FrameJacobian(robot, "right_hand", "pose"), FrameJacobian(robot, "right_hand")
    constraint = Constraint([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]], xyz)
    tables = cycle((q, q + 1e-3))
    candidates: dict[str, Callable[[], object]] = {
        "bare loop": bare_loop(robot, q[:512]),
        "many": lambda: features.batch(next(tables)),
        "mu and gradient, many": lambda: manipulability_batch(constraint, next(tables)),
    }
    counts = {name: 512 if name == "bare loop" else N for name in candidates}
    best = report("frame Jacobians, 6 x 7", rounds_of(candidates, 2, 40), counts)
    times = {name: best[name] / best["bare loop"] for name in candidates if name != "bare loop"}
    print("times the bare loop: " + ", ".join(f"{name} {x:.2f}" for name, x in times.items()))
    missed = {name: x for name, x in times.items() if x < PROMISED[name]}
    assert not missed, f"slower than promised: {missed}, promised {PROMISED}"
    keep("batch", {f"{name}, share of the bare loop": 1.0 / x for name, x in times.items()})


def bare_loop(robot: Robot, q: np.ndarray) -> Callable[[], object]:
    """Pinocchio alone: no checks, no rows chosen."""
    model, reference = robot.pinocchio_model, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    data, index = model.createData(), robot.frame("right_hand").index

    def run() -> None:
        for row in q:
            pin.computeFrameJacobian(model, data, row, index, reference)

    return run


def test_rows_derivatives_and_manipulability(robot: Robot, q: np.ndarray) -> None:
    """What else there is in bulk: three rows, the frame's own axes, dPhi/dq, mu and its gradient, poses."""
    xyz, own = FrameJacobian(robot, "right_hand"), FrameJacobian(robot, "right_hand", "pose", "local")
    pose = FrameJacobian(robot, "right_hand", "pose")
    constraint = Constraint([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]], xyz)
    tables = cycle((q, q + 1e-3))
    candidates: dict[str, Callable[[], object]] = {
        "xyz, many": lambda: xyz.batch(next(tables)),
        "frame's own axes, many": lambda: own.batch(next(tables)),
        "with derivative, many": lambda: pose.batch_with_derivative(next(tables)),
        "mu and gradient, many": lambda: manipulability_batch(constraint, next(tables)),
        "poses, many": lambda: robot.frame_kinematics(xyz.frame).poses(next(tables)),
    }
    report("7-joint arm", rounds_of(candidates, 1, 20), dict.fromkeys(candidates, N))


@pytest.mark.parametrize("n", [1, 16, 256, 4096, 65536])
def test_growth_over_postures(robot: Robot, n: int) -> None:
    """Time a posture falls until a few hundred postures share the calls, and stays flat after it."""
    features = FrameJacobian(robot, "right_hand", "pose")
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (n, robot.nv))
    tables = cycle((q, q + 1e-3))
    candidates = {"many": lambda: features.batch(next(tables))}
    report(f"{n} postures", rounds_of(candidates, max(1, 2048 // n), 10), dict.fromkeys(candidates, n))
