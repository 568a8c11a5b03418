"""Promise: rollouts from many starts cost about 1 us per step and arm compiled."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
import pytest
from timing import rounds_of, summary

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.control.compiled_controller import CompiledController
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import ManipulabilityAscent
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import PointAttractor
from manip_learn.robot import load_robot

pytestmark = [pytest.mark.bench, pytest.mark.timeout(600)]
CENTRE = np.array([0.1, -0.6, 0.2, 1.3, -0.2, 0.7, 0.4])  # elbow bent, far from limits and singularities
NOISE = 1.25  # what a busy machine may add to a promise before this is called a failure
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
    candidates: dict[str, Callable[[], object]] = {
        "one by one": lambda: simulate(robot, controller, q[0], 1.0, 0.01),
    }
    work = {"one by one": 101, "compiled": starts * (steps + 1)}
    if COMPILED:
        compiled = CompiledController(controller)
        candidates["compiled"] = lambda: simulate(robot, compiled, q, steps * 0.01, 0.01)
    print(f"\n{starts} starts, {steps} steps")
    for name, seconds in rounds_of(candidates, 1, 9).items():
        timing = summary([s / work[name] for s in seconds])
        print(f"  {name:12s} {timing.median * 1e6:7.2f} us per step and arm, best {timing.best * 1e6:.2f}")
        if name == "compiled":
            assert timing.best * 1e6 < NOISE * 1.5  # with the words of the statuses, which are Python's
