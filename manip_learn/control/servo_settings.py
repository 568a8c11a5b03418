"""What a servo loop makes of its settings: whose limits count, and the defaults."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.control.command import Controller
from manip_learn.control.compiled_controller import CompiledController
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.limits import Limits
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

# [rad] and [m] default largest distance between the commanded and the measured position of a joint
FOLLOWING_ERROR = 0.1
PRISMATIC_FOLLOWING_ERROR = 0.02


def robot_of(controller: Controller, robot: Robot | None) -> Robot:
    """The robot whose limits count: the one given, or the controller's.

    Raises:
        ConfigurationError: There is none.
    """
    own = robot or getattr(controller, "robot", None)
    if not isinstance(own, Robot):
        raise ConfigurationError("the controller has no robot whose limits count: ServoLoop(..., robot=robot)")
    return own


def limits_of(controller: Controller, robot: Robot, acceleration: ArrayLike | None, jerk: ArrayLike | None) -> Limits:
    """The controller's limits, with other accelerations and jerks if they are given."""
    law = controller.controller if isinstance(controller, CompiledController) else controller
    own = law.limits if isinstance(law, ResolvedRateController) else None
    if own is None:
        return Limits(robot, acceleration=acceleration, jerk=jerk)
    return own.with_rates(acceleration, jerk)


def with_limits(controller: Controller, limits: Limits) -> Controller:
    """A controller of the loop's own, with its limits."""
    if isinstance(controller, CompiledController):
        return CompiledController(controller.controller.with_limits(limits))
    return controller.with_limits(limits) if isinstance(controller, ResolvedRateController) else controller


def following_errors(robot: Robot, limit: ArrayLike | None) -> Float[np.ndarray, " nv"]:
    """Largest following error of each joint [rad or m].

    Raises:
        ConfigurationError: A limit that is not positive.
    """
    if limit is None:
        limit = np.full(robot.nv, FOLLOWING_ERROR)
        for block in robot.blocks:
            if block.kind == "prismatic":
                limit[block.v] = PRISMATIC_FOLLOWING_ERROR
    array = np.array(np.broadcast_to(np.asarray(limit, dtype=np.float64), (robot.nv,)))
    if not np.all(array > 0.0):
        raise ConfigurationError(f"following_error_limit must be positive, got {array.tolist()}")
    return array


def filter_length(limits: Limits, dt: float) -> int:
    """Periods over which commands are averaged: a change of 2 a within them makes a jerk of 2 a / length."""
    if limits.jerk is None:
        return 1
    return max(1, math.ceil(float(np.max(2.0 * limits.acceleration / limits.jerk)) / dt))
