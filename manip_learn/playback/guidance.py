"""What guided a motion: the constraint, or those of its phases, and the target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.rollout import Rollout
from manip_learn.errors import ConstraintMismatchError, RecordingError, TargetError
from manip_learn.playback.phase_bands import PhaseBand
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Robot

IMPOSED = "self-imposed"


@final
@dataclass(frozen=True, eq=False)
class Guidance:
    """What guided a motion.

    Attributes:
        constraints: By the numbers of the phases; a motion without phases has the first. Empty if none is known.
        target: Where the task was to arrive, as `Task.goal` says it; None if that is not known.
    """

    constraints: tuple[Constraint, ...] = ()
    target: Float[np.ndarray, "..."] | None = None

    @property
    def constraint(self) -> Constraint | None:
        """The first one."""
        return self.constraints[0] if self.constraints else None

    def mechanism(self, k: int) -> Mapping[str, Any] | None:
        """That of constraint k, as it keeps it; None if it keeps none."""
        kept = self.constraints[k].provenance.get("mechanism") if k < len(self.constraints) else None
        return kept if isinstance(kept, Mapping) else None

    @property
    def holds(self) -> bool:
        """Whether the world holds the first constraint (b = 0), so that motion may be measured by it."""
        return bool(self.constraints) and self.constraints[0].provenance.get("kind") != IMPOSED

    def at(self, time: Float[np.ndarray, " T"], phases: Sequence[PhaseBand]) -> Int[np.ndarray, " T"]:
        """Number of the constraint by which each sample is measured: that of its phase, else the first; -1: none."""
        chosen = np.zeros(time.size, dtype=int)
        for band in phases:
            if band.constraint is not None:
                inside = (time >= band.start) & (time <= band.end)
                chosen[inside] = band.constraint if band.constraint < len(self.constraints) else -1
        return chosen


def guidance_of(
    robot: Robot,
    name: str,
    motion: Rollout | Trajectory,
    constraint: Constraint | Sequence[Constraint] | None,
    target: ArrayLike | None,
) -> Guidance:
    """The given constraint and target, else those that a rollout keeps.

    Args:
        robot: Whose joints move.
        name: Of the motion, for errors.
        motion: A rollout or a recording.
        constraint: One, or one for each number of the phases; None for the rollout's own.
        target: As `Task.goal` says it; None for the rollout's own.

    Raises:
        ConstraintMismatchError: A constraint of another robot.
        RecordingError: A rollout of another robot.
        TargetError: A target that is not finite numbers.
    """
    if isinstance(constraint, Constraint):
        constraint = (constraint,)
    if constraint is None and isinstance(motion, Rollout) and motion.constraint is not None:
        constraint = (_own_constraint(robot, name, motion.constraint),)
    if target is None and isinstance(motion, Rollout):
        target = motion.target
    for c in constraint or ():
        other = c.robot
        if c.nv != robot.nv or (other is not None and other.joint_names != robot.joint_names):
            whose = f"robot {other.name!r}" if other is not None else f"a system of {c.nv} velocities"
            raise ConstraintMismatchError(
                f"the constraint to show with {name!r} is of {whose}, the robot shown is {robot.name!r} with "
                f"{robot.nv}: give the constraint of that robot"
            )
    return Guidance(tuple(constraint or ()), None if target is None else _numbers(target))


def _numbers(target: ArrayLike) -> Float[np.ndarray, "..."]:
    try:
        array = np.array(target, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TargetError(f"the target to show must be numbers, got {target!r:.60}") from error
    if array.ndim not in (1, 2) or not np.all(np.isfinite(array)):
        raise TargetError(f"the target to show must be finite numbers, or a 4 x 4 pose, got {array.tolist()!r:.80}")
    return array


def _own_constraint(robot: Robot, name: str, content: Mapping[str, Any]) -> Constraint:
    """What guided a rollout; it belongs to the robot that the rollout was made with."""
    try:
        return Constraint.from_dict(content, robot, source=f"the constraint of rollout {name!r}")
    except ConstraintMismatchError as error:
        raise RecordingError(
            f"rollout {name!r} was not made with robot {robot.name!r}: {error}", code="other-robot"
        ) from error
