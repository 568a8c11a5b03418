"""A motion to show: its samples, checked and in the robot's order of joints, and what guided it."""

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
from manip_learn.recordings.velocities import derive_velocities
from manip_learn.robot.robot import Robot


@final
@dataclass(frozen=True, eq=False)
class MotionSamples:
    """Samples of a motion; times count from the first one [s].

    Attributes:
        time: shape (T,).
        q: shape (T, n).
        first_time: Of the first sample, on the motion's own clock [s].
        velocity_time: shape (U,), of the velocities: those of all samples, or fewer where they had to be derived.
        velocity_q: shape (U, n), the postures that the velocities belong to.
        u: shape (U, nv) [rad/s or m/s]; empty if they are not known.
    """

    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T n"]
    first_time: float
    velocity_time: Float[np.ndarray, " U"]
    velocity_q: Float[np.ndarray, "U n"]
    u: Float[np.ndarray, "U nv"]


def motion_samples(robot: Robot, name: str, recording: Rollout | Trajectory) -> MotionSamples:
    """Check a motion, and derive its velocities if it has none.

    Raises:
        RecordingError: No samples, shapes that do not fit, time that does not increase, NaN, another robot, or other
            joints locked.
    """
    u = recording.u if recording.u is not None and np.all(np.isfinite(recording.u)) else None
    if isinstance(recording, Rollout):
        if recording.robot is not None:
            recording.robot.refuse_another(robot, f"rollout {name!r}")
        # one that was made by hand is not checked: its times and postures as those of a trajectory are
        recording = Trajectory(recording.time, recording.q, None, recording.joint_names, f"rollout {name!r}")
    names = recording.joint_names or robot.joint_names
    if set(names) != set(robot.joint_names) or len(names) != robot.nv:
        missing = [n for n in robot.joint_names if n not in names]
        extra = [n for n in names if n not in robot.joint_names]
        parts = {"missing": missing, "not its own": extra}
        what = "; ".join(f"{label} {', '.join(some[:6])}" for label, some in parts.items() if some) or "given twice"
        sentence = f"rollout {name!r} was not made with robot {robot.name!r}: joints {what}; load the robot that it was"
        raise RecordingError(f"{sentence} made with", code="joint-names")
    order = [names.index(n) for n in robot.joint_names]
    first, time = float(recording.time[0]), recording.time - recording.time[0]
    q = recording.q[:, order] if names != robot.joint_names and recording.q.shape[1] == robot.nv else recording.q
    if u is not None:
        if u.shape != (time.size, robot.nv):
            wanted = f"{(time.size, robot.nv)} is needed: one row per time"
            raise RecordingError(f"rollout {name!r}: u has shape {u.shape}, {wanted}", code="shape")
        return MotionSamples(time, q, first, time, q, u[:, order])
    derived = Trajectory(recording.time, q, None, robot.joint_names, name)
    derived = derive_velocities(derived, robot) if time.size >= 5 else derived  # [samples] that a derivative needs
    if derived.u is None:
        return MotionSamples(time, q, first, time[:0], q[:0], np.zeros((0, robot.nv)))
    return MotionSamples(time, q, first, derived.time - first, derived.q, derived.u)


@final
@dataclass(frozen=True, eq=False)
class Guidance:
    """What guided a motion.

    Attributes:
        constraints: By the numbers of the phases, of a skill done again by its ways; a motion without phases has the
            first. Empty if none is known.
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
        return bool(self.constraints) and self.constraints[0].provenance.get("kind") != "self-imposed"

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
    given = (constraint,) if isinstance(constraint, Constraint) else tuple(constraint or ())
    if isinstance(motion, Rollout):
        target = motion.target if target is None else target
        if constraint is None:
            given = _kept_constraints(robot, name, motion)
    for c in given:
        other = c.robot
        if c.nv != robot.nv or (other is not None and other.joint_names != robot.joint_names):
            whose = f"robot {other.name!r}" if other is not None else f"a system of {c.nv} velocities"
            raise ConstraintMismatchError(
                f"the constraint to show with {name!r} is of {whose}, the robot shown is {robot.name!r} with "
                f"{robot.nv}: give the constraint of that robot"
            )
    if target is None:
        return Guidance(given)
    try:
        place = np.array(target, dtype=np.float64)
    except (TypeError, ValueError):
        place = np.array(np.nan)
    if place.ndim not in (1, 2) or not np.all(np.isfinite(place)):
        raise TargetError(f"the target to show must be finite numbers, or a 4 x 4 pose, got {target!r:.80}")
    return Guidance(given, place)


def _kept_constraints(robot: Robot, name: str, rollout: Rollout) -> tuple[Constraint, ...]:
    """Return the constraints that a rollout keeps: one for each of its ways, or its only one."""
    kept = [way.get("constraint") for way in rollout.ways]
    kept = [rollout.constraint] if not kept or None in kept else kept
    try:
        given = (Constraint.from_dict(c, robot, source=f"the constraint of rollout {name!r}") for c in kept if c)
        return tuple(given)
    except ConstraintMismatchError as error:
        sentence = f"rollout {name!r} was not made with robot {robot.name!r}: {error}"
        raise RecordingError(sentence, code="other-robot") from error
