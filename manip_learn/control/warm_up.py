"""Compile ahead of time what a control loop needs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import final

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.control.command import Controller
from manip_learn.control.compiled_controller import CompiledController, compiled_if_possible
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import ManipulabilityAscent, WeightedPolicies
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.tasks import PointAttractor
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip


@final
@dataclass(frozen=True)
class WarmUp:
    """What was made ready, and how long that took.

    Attributes:
        seconds: [s]; what is on disk already is only read.
        step: Whether whole steps are compiled now.
        limits: Whether what keeps the limits behind a law in Python is compiled now.
    """

    seconds: float
    step: bool
    limits: bool


def warm_up(controller: Controller | ServoLoop, report: Callable[[str], object] | None = None) -> WarmUp:
    """Compile, once per machine, what the first `ServoLoop` of a controller would compile.

    Later processes read the machine code from disk. It depends on the kind of controller, not on its numbers: which
    robot, constraint, target and limits does not matter. Without numba (the extra `fast`) there is nothing to do.

    Args:
        controller: A controller, or a loop.
        report: Called with a sentence where code has to be compiled; by default a line of the logger `manip_learn`.

    Returns:
        What was made ready.
    """
    start = time.perf_counter()
    if isinstance(controller, ServoLoop):
        controller = controller.controller
    if find_spec("numba") is not None:
        controller = compiled_if_possible(controller, None, report)
    step = isinstance(controller, CompiledController)
    limits = isinstance(controller, ResolvedRateController) and controller.solver == "compiled"
    return WarmUp(time.perf_counter() - start, step, limits)


def controllers_to_warm_up(robot: Robot) -> tuple[ResolvedRateController, ResolvedRateController]:
    """One controller of each kind: of which whole steps are compiled, and of which only what keeps the limits is."""
    features = FrameJacobian(robot, default_tip(robot), "x y")
    constraint = Constraint(np.eye(2)[:1], features)
    target = features.coordinates(robot.neutral())
    climb = ManipulabilityAscent(constraint)
    sums = WeightedPolicies([climb], [1.0])  # which are not compiled
    return (
        ResolvedRateController(constraint, PointAttractor(target), climb),
        ResolvedRateController(constraint, PointAttractor(target), sums),
    )
