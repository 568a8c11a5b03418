"""Null-space policies by the names that people type and press."""

from __future__ import annotations

from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, NullSpacePolicy, ZeroPolicy
from manip_learn.control.tasks import FreeDirection, Task
from manip_learn.errors import ManipLearnError
from manip_learn.robot import Robot

POLICIES = ("manipulability", "zero", "attractor")


def null_policy(
    name: str, task: Task, constraint: Constraint, robot: Robot, gain: float | None, rest: ArrayLike | None
) -> NullSpacePolicy:
    """A null-space policy by its name on the command line, with its own gain if none is given.

    Raises:
        ManipLearnError: Unknown name.
    """
    given = () if gain is None else (gain,)
    if name == "manipulability":
        climbs = isinstance(task, FreeDirection)
        return task.ascent(*given) if climbs else ManipulabilityAscent(task.rows(constraint), *given)
    if name == "zero":
        return ZeroPolicy(constraint.nv)
    if name == "attractor":
        return JointAttractor(robot.neutral() if rest is None else rest, *given, robot=robot)
    raise ManipLearnError(f"unknown policy {name!r}: use one of {', '.join(POLICIES)}")
