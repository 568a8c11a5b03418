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
from manip_learn.linalg import finite
from manip_learn.playback.phase_bands import PhaseBand
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.velocities import derive_velocities
from manip_learn.robot.robot import Robot


@final
@dataclass(frozen=True, eq=False)
class GuidedMotion:
    """A rollout or a recording, its samples and what guided it; times count from the first sample [s].

    Attributes:
        name: Name in the legend.
        recording: The rollout or the recording itself.
        time: shape (T,).
        q: shape (T, n).
        first_time: Of the first sample, on the motion's own clock [s].
        velocity_time: shape (U,), of the velocities: those of all samples, or fewer where they had to be derived.
        velocity_q: shape (U, n), the postures that the velocities belong to.
        u: shape (U, nv) [rad/s or m/s]; empty if they are not known.
        constraints: By the numbers of the phases, of a skill done again by its ways; a motion without phases has the
            first. Empty if none is known.
        target: Where the task was to arrive, as `Task.goal` says it; None if that is not known.
        phases: Bands of constraints within the motion, or a rollout's own.
    """

    name: str
    recording: Rollout | Trajectory
    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T n"]
    first_time: float
    velocity_time: Float[np.ndarray, " U"]
    velocity_q: Float[np.ndarray, "U n"]
    u: Float[np.ndarray, "U nv"]
    constraints: tuple[Constraint, ...] = ()
    target: Float[np.ndarray, "..."] | None = None
    phases: tuple[PhaseBand, ...] = ()

    @property
    def constraint(self) -> Constraint | None:
        """The first one."""
        return self.constraints[0] if self.constraints else None

    @property
    def ways(self) -> tuple[Mapping[str, Any], ...]:
        """What became of each way of a rollout; empty for a recording."""
        return self.recording.ways if isinstance(self.recording, Rollout) else ()

    def mechanism(self, k: int) -> Mapping[str, Any] | None:
        """Return the mechanism that constraint k keeps; None if it keeps none."""
        kept = self.constraints[k].provenance.get("mechanism") if k < len(self.constraints) else None
        return kept if isinstance(kept, Mapping) else None

    def chosen(self) -> Int[np.ndarray, " U"]:
        """Return the number of the constraint by which each velocity is measured: of its phase, else the first.

        -1 where it is not known, and everywhere if the demonstrator drives the rows (b is not 0).
        """
        is_imposed = self.constraint is None or self.constraint.provenance.get("kind") == "self-imposed"
        chosen = np.full(self.velocity_time.size, -1 if is_imposed else 0)
        for band in [] if is_imposed else self.phases:
            if band.constraint is not None:
                chosen[band.covers(self.velocity_time)] = band.constraint
        return np.where(chosen < len(self.constraints), chosen, -1)


def guided_motion(
    robot: Robot,
    name: str,
    recording: Rollout | Trajectory,
    constraint: Constraint | Sequence[Constraint] | None = None,
    target: ArrayLike | None = None,
) -> GuidedMotion:
    """Check a motion, derive its velocities if it has none, and find what guided it.

    Args:
        robot: Whose joints move.
        name: Name in the legend.
        recording: A rollout or a recording.
        constraint: One, or one for each number of the phases; None for the rollout's own.
        target: As `Task.goal` says it; None for the rollout's own.

    Raises:
        ConstraintMismatchError: A constraint of another robot.
        RecordingError: No samples, shapes that do not fit, time that does not increase, NaN, another robot, or other
            joints locked.
        TargetError: A target that is not finite numbers.
    """
    given = (constraint,) if isinstance(constraint, Constraint) else tuple(constraint or ())
    checked = recording
    if isinstance(recording, Rollout):
        target = recording.target if target is None else target
        if constraint is None:
            given = _kept_constraints(robot, name, recording)
        if recording.robot is not None:
            recording.robot.refuse_another(robot, f"rollout {name!r}")
        # one that was made by hand is not checked: its times and postures as those of a trajectory are
        u = recording.u if np.all(np.isfinite(recording.u)) else None
        checked = Trajectory(recording.time, recording.q, u, recording.joint_names, f"rollout {name!r}")
    for c in given:
        other = c.robot
        if c.nv != robot.nv or (other is not None and other.joint_names != robot.joint_names):
            whose = f"robot {other.name!r}" if other is not None else f"a system of {c.nv} velocities"
            raise ConstraintMismatchError(
                f"the constraint to show with {name!r} is of {whose}, the robot shown is {robot.name!r} with "
                f"{robot.nv}: give the constraint of that robot"
            )
    place = None if target is None else finite(target, *np.shape(np.array(target, dtype=object)))
    if target is not None and (place is None or place.ndim not in (1, 2)):
        raise TargetError(f"the target to show must be finite numbers, or a 4 x 4 pose, got {target!r:.80}")
    names, own = checked.joint_names or robot.joint_names, robot.joint_names
    if set(names) != set(own):
        parts = {"missing": [n for n in own if n not in names], "not its own": [n for n in names if n not in own]}
        what = "; ".join(f"{label} {', '.join(some[:6])}" for label, some in parts.items() if some)
        sentence = f"rollout {name!r} was not made with robot {robot.name!r}: joints {what}; load the robot that it was"
        raise RecordingError(f"{sentence} made with", code="joint-names")
    order, q = [names.index(n) for n in own], checked.q
    q = q[:, order] if q.shape[1] == robot.nv else q
    u = checked.u[:, order] if checked.u is not None and np.all(np.isfinite(checked.u)) else None
    moving = Trajectory(checked.time, q, u, own, name)
    if u is None and len(moving) >= 5:  # [samples] that a derivative needs
        moving = derive_velocities(moving, robot)
    first, known = float(checked.time[0]), 0 if moving.u is None else len(moving)
    velocities = np.zeros((0, robot.nv)) if moving.u is None else moving.u
    moved = moving.time[:known] - first, moving.q[:known], velocities
    return GuidedMotion(name, recording, checked.time - first, q, first, *moved, given, place)


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
