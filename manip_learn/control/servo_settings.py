"""What a servo loop makes of its settings: whose limits count, and a controller with them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.relative_frame_jacobian import RelativeFrameJacobian
from manip_learn.constraint.features.weighed_velocity import WeighedVelocity
from manip_learn.control.command import Controller
from manip_learn.control.compiled_controller import CompiledController, compiled_if_possible
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.law_sequence import LawSequence
from manip_learn.control.limits import Limits
from manip_learn.control.tasks import PointAttractor, Task
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


def law_of(controller: Controller) -> ResolvedRateController | None:
    """The law of a controller of the library, compiled or not, that in force; None for a controller of another kind."""
    law = controller.controller if isinstance(controller, CompiledController) else controller
    law = law.current if isinstance(law, LawSequence) else law
    return law if isinstance(law, ResolvedRateController) else None


def limits_of(controller: Controller, robot: Robot, acceleration: ArrayLike | None, jerk: ArrayLike | None) -> Limits:
    """The controller's limits, with other accelerations and jerks if they are given."""
    law = law_of(controller)
    own = None if law is None else law.limits
    if own is None:
        return Limits(robot, acceleration=acceleration, jerk=jerk)
    return own.with_rates(acceleration, jerk)


def with_limits(controller: Controller, limits: Limits, compiled: bool | None = False) -> Controller:
    """A controller of the loop's own, with its limits, compiled where that is asked for (`compiled_if_possible`)."""
    if isinstance(controller, CompiledController):
        return CompiledController(controller.controller.with_limits(limits))
    own = controller.with_limits(limits) if isinstance(controller, ResolvedRateController | LawSequence) else controller
    return compiled_if_possible(own, compiled)


def task_of(controller: Controller) -> Task | None:
    """The task of a controller of the library; None for a controller of another kind."""
    law = law_of(controller)
    return None if law is None else law.task


def keeps_limits(controller: Controller) -> bool:
    """Whether a controller's commands are within the limits that it was given."""
    return isinstance(controller, ResolvedRateController | CompiledController | LawSequence)


def forget(controller: Controller) -> None:
    """Make a controller forget what its tasks remember of the past."""
    if isinstance(controller, LawSequence):
        controller.reset()
    elif (task := task_of(controller)) is not None:
        task.reset()


def constraint_of(controller: Controller) -> Constraint | None:
    """The constraint of a controller of the library, with the rows that its task drives; None for another kind."""
    law = controller.way if isinstance(controller, LawSequence) else law_of(controller)
    return None if law is None else law.constraint


def frame_of(controller: Controller) -> str | None:
    """The frame that a controller's constraint holds; None where it has none."""
    constraint = constraint_of(controller)
    if constraint is None:
        return None
    features = constraint.features
    return (
        features.frame.name if isinstance(features, FrameJacobian | RelativeFrameJacobian | WeighedVelocity) else None
    )


def exchanged(
    controller: Controller, *, task: Task | None = None, constraint: Constraint | None = None
) -> ResolvedRateController:
    """The law of a controller with another task or another constraint.

    Raises:
        ConfigurationError: It is no controller of the library.
        ManipLearnError: Task and constraint do not fit each other.
    """
    law = law_of(controller)
    if law is None:
        raise ConfigurationError(f"only a ResolvedRateController takes another task, not {type(controller).__name__}")
    if constraint is not None and constraint.robot is not law.learnt.robot:
        raise ConfigurationError("the constraint belongs to another robot than that of the loop")
    return law.with_task(law.task if task is None else task, law.learnt if constraint is None else constraint)


def aimed_at(task: Task | None, target: ArrayLike) -> PointAttractor:
    """The same attractor with another target.

    Raises:
        ConfigurationError: The task is no attractor.
    """
    if type(task) is not PointAttractor:
        raise ConfigurationError(f"only a PointAttractor has a target that can be set, the task is {task!r}")
    return PointAttractor(target, task.gain, task.max_speed, driven=task.driven)


def is_number(value: Any) -> bool:
    """Whether a value is a real number; True, text, arrays and durations are none."""
    kinds = (int, float, np.integer, np.floating)
    return isinstance(value, kinds) and not isinstance(value, bool | np.timedelta64)
