"""What the page has of a task: its recordings, and the ways that they show, each as far as the slider says."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.shown import Shown, Unit
from manip_learn.constraint.skill import Skill
from manip_learn.control.limits import Limits
from manip_learn.control.tasks import FreeDirection, motion
from manip_learn.control.tasks.motion import APPROACH_SPEED
from manip_learn.robot.robot import Robot
from manip_learn.teach.scene import REACHES

STEP = 0.01  # [s] of a simulation, as the arm's period
_SHORTEST = {"m": 0.02, "rad": 0.05}  # [m or rad] a way that was shown and is worth doing again
ARRIVES = {"m": 2e-3, "rad": 4e-3}  # [m or rad] of a way that is done


@final
@dataclass
class TaughtRecording:
    """One recording.

    Attributes:
        path: The file.
        q: shape (T, nv), its postures.
        time: shape (T,) [s].
        phases: Start [s], end [s] and number of the constraint, -1 for free motion.
        odd: Why it does not agree with the others.
    """

    path: Path
    q: Float[np.ndarray, "T nv"]
    time: Float[np.ndarray, " T"]
    phases: list[list[float]] = field(default_factory=list)
    odd: str = ""

    def to_dict(self) -> dict[str, Any]:
        """For the page; times from its first sample on."""
        first, last = (float(self.time[0]), float(self.time[-1])) if len(self.time) else (0.0, 0.0)
        return {
            "name": self.path.stem,
            "seconds": round(last - first, 2),
            "samples": len(self.time),
            "odd": self.odd,
            "phases": [[start - first, end - first, k] for start, end, k in self.phases],
        }


def limits_of(robot: Robot, tip: str) -> Limits:
    """Return the limits of everything that the arm does by itself: as `repeat` has them by default."""
    return Limits(robot, tip_speed=APPROACH_SPEED, frames=tip)


def handle_near(place: Float[np.ndarray, " 3"], handles: Sequence[Float[np.ndarray, "n 3"]]) -> int | None:
    """Number of the handle along whose way a place is; None where none is near.

    Args:
        place: Where a contact began [m].
        handles: Places along the way of each, from where it is shut [m].
    """
    gaps = [float(np.min(np.linalg.norm(way - place, axis=1))) for way in handles]
    nearest = int(np.argmin(gaps)) if gaps else None
    return nearest if nearest is not None and gaps[nearest] < 2.0 * REACHES else None


def held_by_handles(skill: Skill, handles: Sequence[Float[np.ndarray, "n 3"]]) -> Skill:
    """A skill whose ways count from where their handles are shut, positive as they open.

    A person does not always shut what was opened before the next recording, so that recordings may go to both sides of
    where they began, and contacts are seen a little late.

    Args:
        skill: As learnt.
        handles: As for `handle_near`; two places at least.
    """

    def from_shut(shown: Shown | None) -> Shown | None:
        number = None if shown is None else handle_near(shown.begin, handles)
        if shown is None or number is None or not shown.is_way:
            return shown
        shut, ajar = handles[number][:2]
        if coordinate(shown, shut, ajar) < 0.0:
            shown = replace(shown, mechanism=shown.mechanism.reversed(), path=-shown.path)
        ahead = coordinate(shown, shut, shown.begin)
        path = shown.path + ahead
        far = float(np.max(path))  # of the typical contact: the others may have begun elsewhere
        counted = {"extent": far, "least": min(shown.least + ahead, far), "most": max(far, shown.span)}
        counted["span"] = counted["most"]
        return replace(shown, hold=shut, begin=shut, path=path, one_way=True, **counted)

    constraints: dict[int, Constraint] = {}
    for constraint in skill.constraints:
        shown = from_shut(constraint.shown)
        constraints[id(constraint)] = constraint if shown is None else constraint.showing(shown)
    steps = (
        replace(s, shown=from_shut(s.shown), constraint=None if s.constraint is None else constraints[id(s.constraint)])
        for s in skill.steps
    )
    return Skill(tuple(constraints.values()), tuple(steps), skill.notes)


def coordinate(shown: Shown, begin: Float[np.ndarray, " 3"], place: Float[np.ndarray, " 3"]) -> float:
    """How far a hand is along a way from where it began [m or rad], by its place."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = begin, place
    return float(replace(shown, mechanism=shown.mechanism.by_place()).along(poses)[1, 0])


@final
@dataclass
class TaughtWay:
    """One way of what was learnt, as it was shown, as far as the slider says.

    Attributes:
        constraint: What holds the hand.
        number: Which of the ways, in the order shown.
        value: How far the hand is to go [m or rad].
    """

    constraint: Constraint
    number: int
    value: float

    @staticmethod
    def all_of(skill: Skill) -> list[TaughtWay]:
        """The ways of a skill, those that are too short to be meant left out."""
        ways: list[TaughtWay] = []
        for step in skill.steps:
            constraint = step.as_shown if step.kind == "way" else None
            shown = None if constraint is None else constraint.shown
            if constraint is not None and shown is not None and shown.extent > _SHORTEST[shown.unit]:
                ways.append(TaughtWay(constraint, len(ways), abs(motion(constraint).wanted)))
        return ways

    @staticmethod
    def asked_for(file: str, robot: Robot, asked: Mapping[str, Any]) -> TaughtWay:
        """The way that `asked` describes, of a skill's file."""
        way = TaughtWay.all_of(Skill.load(file, robot))[asked["number"]]
        way.set(asked["value"])
        return way

    @property
    def shown(self) -> Shown:
        """What the recordings did along it."""
        return cast(Shown, self.constraint.shown)

    @property
    def unit(self) -> Unit:
        """Of the way."""
        return self.shown.unit if self.shown.is_way else "m"

    @property
    def high(self) -> float:
        """How far it was shown [m or rad]: the longest of the recordings, or the whole path on a surface."""
        return self.shown.most if self.shown.is_way else abs(motion(self.constraint).wanted)

    def to_dict(self) -> dict[str, Any]:
        """For the page's slider."""
        return {"unit": self.unit, "low": _SHORTEST[self.unit], "high": self.high, "value": self.value}

    def asked(self) -> dict[str, Any]:
        """As the worker takes it."""
        return {"number": self.number, "value": self.value}

    def set(self, value: float) -> None:
        """Ask for another way, at most as far as it was shown.

        Raises:
            ValueError: No finite number.
        """
        if not math.isfinite(value):
            raise ValueError("the way must be a finite number")
        self.value = min(max(value, _SHORTEST[self.unit]), self.high)

    def task(self, place: ArrayLike | None = None) -> FreeDirection:
        """Go where it was shown to take hold, or where the handle is now [m], and what is left of the way."""
        shown = self.shown
        begin = shown.begin if place is None else np.asarray(place, dtype=np.float64)
        task = motion(self.constraint.showing(replace(shown, hold=begin, begin=begin)), beyond_shown=True)
        left = self.value - (self.at(begin) if shown.is_way else 0.0)
        return task.with_distance(math.copysign(max(left, _SHORTEST[self.unit]), task.wanted))

    def rest(self, q: Float[np.ndarray, " nv"]) -> FreeDirection:
        """What is left of the way from a posture; a path on a surface is begun again."""
        if not self.shown.is_way:
            return self.task()
        left = self.value - self.at(self.place(q))
        along, turn = (left, None) if self.unit == "m" else (None, left)
        return motion(self.constraint, along, turn, beyond_shown=True)

    @property
    def limits(self) -> Limits:
        """Those of the arm that goes it."""
        features = cast(Any, self.constraint.features)
        return limits_of(features.robot, features.frame.name)

    def place(self, q: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " 3"]:
        """Where the hand is at a posture [m]."""
        features = cast(Any, self.constraint.features)  # what was shown is known of a frame's rows alone
        return features.robot.position(q, features.frame)

    def at(self, place: Float[np.ndarray, " 3"]) -> float:
        """How far along the way a place of the hand is [m or rad]."""
        shown = self.shown
        if not shown.is_way:
            points = shown.points
            far = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
            return float(far[np.argmin(np.linalg.norm(points - place, axis=1))])
        return coordinate(shown, shown.begin, place)

    def in_words(self, done: float) -> str:
        """How far it came [m or rad], of how far it was to go."""
        size, unit, digits = (100.0, "cm", 1) if self.unit == "m" else (float(np.degrees(1.0)), "degrees", 0)
        return f"{size * done:.{digits}f} of {size * self.value:.{digits}f} {unit}"
