"""Promises: 2 million frame Jacobians a second and core in NumPy, 4.5 million compiled (7 joints, all six rows).

Beside them Pinocchio in a Python loop, and growth curves over postures and joints.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
import pytest
from timing import rounds_of, summary

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.robot import Robot, load_robot
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.planar_arm import planar_arm_urdf

pytestmark = [pytest.mark.bench, pytest.mark.timeout(600)]
N = 8192
COMPILED = find_spec("numba") is not None
NUMPY_PROMISE, COMPILED_PROMISE = 2.0e6, 4.5e6  # Jacobians a second


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
    """All six rows of a 7-joint arm, NumPy and compiled, against Pinocchio in a loop."""
    features = FrameJacobian(robot, "right_hand", "pose")
    loop = q[:256]
    candidates: dict[str, Callable[[], object]] = {
        "numpy": lambda: features.batch(q, compiled=False),
        "pinocchio in a loop": lambda: np.stack([features(row) for row in loop]),
    }
    if COMPILED:
        candidates["compiled"] = lambda: features.batch(q, compiled=True)
    counts = {"numpy": N, "compiled": N, "pinocchio in a loop": len(loop)}
    best = report("frame Jacobians, 6 x 7", rounds_of(candidates, 2, 40), counts)
    assert best["numpy"] >= NUMPY_PROMISE
    assert best.get("compiled", np.inf) >= COMPILED_PROMISE


def test_rows_derivatives_and_manipulability(robot: Robot, q: np.ndarray) -> None:
    """What else there is in bulk: three rows, the frame's own axes, dPhi/dq, mu and its gradient, poses."""
    xyz, own = FrameJacobian(robot, "right_hand"), FrameJacobian(robot, "right_hand", "pose", "local")
    pose = FrameJacobian(robot, "right_hand", "pose")
    constraint = Constraint([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]], xyz)
    candidates: dict[str, Callable[[], object]] = {
        "xyz, numpy": lambda: xyz.batch(q, compiled=False),
        "frame's own axes, numpy": lambda: own.batch(q, compiled=False),
        "with derivative, numpy": lambda: pose.batch_with_derivative(q, compiled=False),
        "mu and gradient, numpy": lambda: manipulability_batch(constraint, q),
        "poses, numpy": lambda: batch_kinematics(robot, xyz.frame).pose(q),
    }
    if COMPILED:
        candidates["with derivative, compiled"] = lambda: pose.batch_with_derivative(q, compiled=True)
    report("7-joint arm", rounds_of(candidates, 1, 20), dict.fromkeys(candidates, N))


@pytest.mark.parametrize("n", [1, 16, 256, 4096, 65536])
def test_growth_over_postures(robot: Robot, n: int) -> None:
    """Time a posture falls until a few hundred postures share the calls, and stays flat after it."""
    features = FrameJacobian(robot, "right_hand", "pose")
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (n, robot.nv))
    candidates = {"numpy": lambda: features.batch(q, compiled=False)}
    if COMPILED:
        candidates["compiled"] = lambda: features.batch(q, compiled=True)
    report(f"{n} postures", rounds_of(candidates, max(1, 2048 // n), 10), dict.fromkeys(candidates, n))


@pytest.mark.parametrize("joints", [3, 7, 14, 28])
def test_growth_over_joints(joints: int, tmp_path) -> None:
    """Time a Jacobian is linear in the joints."""
    path = tmp_path / "arm.urdf"
    path.write_text(planar_arm_urdf([0.3] * joints), encoding="utf-8")
    robot = load_robot(path)
    features = FrameJacobian(robot, robot.frame_names[-1], "pose")
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (2048, robot.nv))
    candidates = {"numpy": lambda: features.batch(q, compiled=False)}
    if COMPILED:
        candidates["compiled"] = lambda: features.batch(q, compiled=True)
    report(f"{joints} joints", rounds_of(candidates, 2, 10), dict.fromkeys(candidates, 2048))
