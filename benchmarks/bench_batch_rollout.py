"""Rollouts from many starts, per step and arm, over the bare step (Jacobian, pseudo-inverse, null-space product)."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
import pytest
from control_states import bare_step
from timing import keep, rounds_of, summary

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian, MechanismRows
from manip_learn.control.compiled_controller import CompiledController
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import ManipulabilityAscent
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import Hold, PointAttractor
from manip_learn.robot import load_robot

pytestmark = [pytest.mark.bench, pytest.mark.timeout(600)]
CENTRE = np.array([0.1, -0.6, 0.2, 1.3, -0.2, 0.7, 0.4])  # elbow bent, far from limits and singularities
PROMISED = 0.10  # compiled, of the bare step
DOOR = 1.2  # time of a door's rollout over that of a drawer's, both compiled, two rows each
COMPILED = find_spec("numba") is not None


@pytest.mark.parametrize("starts", [1, 20, 200, 2000])
def test_growth_over_starts(starts: int) -> None:
    """Time per step and arm, for what `simulate` chooses from."""
    robot = load_robot("sawyer")
    features = FrameJacobian(robot, "right_hand")
    rows = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 2)))[0].T
    constraint = Constraint(rows, features)
    task, policy = PointAttractor([0.75, 0.2, 0.35]), ManipulabilityAscent(constraint, 0.1)
    controller = ResolvedRateController(constraint, task, policy)
    q = CENTRE + np.random.default_rng(0).uniform(-0.2, 0.2, (starts, robot.nv))
    steps = max(10, 4000 // starts)
    bare, postures = bare_step(constraint), q[:20]
    candidates: dict[str, Callable[[], object]] = {
        "bare step": lambda: [bare(x) for x in postures],
        "one by one": lambda: simulate(robot, controller, q[0], 1.0, 0.01),
    }
    work = {"bare step": len(postures), "one by one": 101, "compiled": starts * (steps + 1)}
    if COMPILED:
        compiled = CompiledController(controller)
        candidates["compiled"] = lambda: simulate(robot, compiled, q, steps * 0.01, 0.01)
    print(f"\n{starts} starts, {steps} steps")
    best = {}
    for name, seconds in rounds_of(candidates, 1, 9).items():
        timing = summary([s / work[name] for s in seconds])
        best[name] = timing.best
        print(f"  {name:12s} {timing.median * 1e6:7.2f} us per step and arm, best {timing.best * 1e6:.2f}")
    ratios = {f"{name}, {starts} starts": best[name] / best["bare step"] for name in best if name != "bare step"}
    print("  over the bare step: " + ", ".join(f"{name} {x:.3f}" for name, x in ratios.items()))
    assert ratios.get(f"compiled, {starts} starts", 0.0) <= PROMISED
    keep("rollouts", ratios)


@pytest.mark.skipif(not COMPILED, reason="the extra 'fast' is not installed")
def test_a_door_is_simulated_as_fast_as_a_drawer() -> None:
    """Rows whose weights change with the place cost what constant ones do, in the same kernels."""
    robot = load_robot("sawyer")
    axis, point = (0.1, 0.0, 1.0), (0.5, 0.3, 0.2)
    maps = {
        "drawer": FrameJacobian(robot, "right_hand", "y z"),
        "door": MechanismRows(robot, "right_hand", "radial axial", axis=axis, point=point, radius=0.4),
        "door, any radius": MechanismRows(robot, "right_hand", "radial axial", axis=axis, point=point),
        "screw": MechanismRows(robot, "right_hand", "radial helical", axis=axis, point=point, pitch=0.01),
        "line, firm": FrameJacobian(robot, "right_hand", "y z rx ry rz"),
        "hinge, firm": MechanismRows(
            robot, "right_hand", "turn-1 turn-2 slide-1 slide-2 slide", axis=axis, point=point
        ),
    }
    candidates: dict[str, Callable[[], object]] = {}
    for name, features in maps.items():
        constraint = Constraint(np.eye(features.n_rows), features)
        law = ResolvedRateController(constraint, Hold(), ManipulabilityAscent(constraint, 0.1))
        candidates[name] = lambda law=law: simulate(robot, law, CENTRE, 20.0, 0.002)
    medians = {name: summary(list(seconds)).median for name, seconds in rounds_of(candidates, 1, 15).items()}
    over = {name: "line, firm" if "firm" in name else "drawer" for name in maps}
    ratios = {name: medians[name] / medians[over[name]] for name in maps}
    print(
        "\n"
        + "\n".join(
            f"  {n:18s} {medians[n] * 1e6 / 10001:6.3f} us a step, {x:.2f} of {over[n]}" for n, x in ratios.items()
        )
    )
    assert max(ratios.values()) <= DOOR
