"""What a servo loop makes of its settings: whose limits count, and a controller with them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.control.command import Controller
from manip_learn.control.compiled_controller import CompiledController, compiled_if_possible
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.limits import Limits
from manip_learn.control.tasks import Task
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot


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


def with_limits(controller: Controller, limits: Limits, compiled: bool | None = False) -> Controller:
    """A controller of the loop's own, with its limits, compiled where that is asked for (`compiled_if_possible`)."""
    if isinstance(controller, CompiledController):
        return CompiledController(controller.controller.with_limits(limits))
    own = controller.with_limits(limits) if isinstance(controller, ResolvedRateController) else controller
    return compiled_if_possible(own, compiled)


def task_of(controller: Controller) -> Task | None:
    """The task of a controller of the library; None for a controller of another kind."""
    law = controller.controller if isinstance(controller, CompiledController) else controller
    return law.task if isinstance(law, ResolvedRateController) else None


def is_number(value: Any) -> bool:
    """Whether a value is a real number; True, text, arrays and durations are none."""
    kinds = (int, float, np.integer, np.floating)
    return isinstance(value, kinds) and not isinstance(value, bool | np.timedelta64)
