"""A motion along one free direction of a constraint: what is common to straight ways and to mechanisms."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal, NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint

Unit = Literal["m", "rad"]


def way_in_words(way: float, unit: Unit) -> str:
    """The size of a way, e.g. `"0.3 m"` or `"60 degrees"`."""
    return f"{abs(way):.3g} m" if unit == "m" else f"{math.degrees(abs(way)):.3g} degrees"


@final
class Setpoint(NamedTuple):
    """Where a motion should be: how far from its start [m or rad], how fast, and how large its rate may be."""

    distance: float
    rate: float
    speed: float

    def approached(self, lag: float, gain: float) -> float:
        """The rate that makes up for a lag, within the speed [m/s or rad/s]."""
        return min(max(self.rate + gain * lag, -self.speed), self.speed)


class DrivenMotion(ABC):
    """A free direction, driven; the constrained rows are held at their values at the start.

    Attributes of every child:
        constraint: The constrained rows and the driven one.
        unit: `"m"` or `"rad"`, of distances along the motion.
        along_rows: Whether `error_jacobian` is known to be None at every posture.
    """

    constraint: Constraint
    unit: Unit
    along_rows: bool

    @abstractmethod
    def origin(self, q: ArrayLike) -> Float[np.ndarray, "..."]:
        """What has to be known of the start posture."""

    @abstractmethod
    def progress(self, origin: Float[np.ndarray, "..."], q: ArrayLike, near: float) -> float:
        """How far posture q is from the start [m or rad]; of angles a turn apart the one next to `near`."""

    @abstractmethod
    def rates(
        self, origin: Float[np.ndarray, "..."], q: ArrayLike, setpoint: Setpoint, gain: float
    ) -> Float[np.ndarray, " p"]:
        """Velocities wanted of the features of `constraint`."""

    @abstractmethod
    def deviation(self, origin: Float[np.ndarray, "..."], q: ArrayLike, distance: float) -> Float[np.ndarray, " k"]:
        """How far the constrained coordinates are from where they are held [m or rad], at that distance."""

    @abstractmethod
    def goal(self, origin: Float[np.ndarray, "..."], distance: float) -> Float[np.ndarray, "..."]:
        """Where the frame is after a distance: a pose (4, 4), or numbers for the features' rows (p,)."""

    def error_jacobian(
        self, origin: Float[np.ndarray, "..."], q: ArrayLike, distance: float
    ) -> Float[np.ndarray, "s nv"] | None:
        """E of `Task.error_jacobian`; None where that is A(q)."""
        return None

    def rates_and_jacobian(
        self, origin: Float[np.ndarray, "..."], q: ArrayLike, setpoint: Setpoint, gain: float
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "s nv"] | None]:
        """`rates` and `error_jacobian` together, cheaper than one by one where a child shares work."""
        return self.rates(origin, q, setpoint, gain), self.error_jacobian(origin, q, setpoint.distance)


def between(start: Float[np.ndarray, "..."], end: Float[np.ndarray, "..."], share: float) -> Float[np.ndarray, "..."]:
    """An origin on the straight way from one to another: of poses the place moves and the orientation stays."""
    out = start.copy()
    if start.ndim == 1:
        return out + share * (end - start)
    out[:3, 3] += share * (end[:3, 3] - start[:3, 3])
    return out


def apart(one: Float[np.ndarray, "..."], other: Float[np.ndarray, "..."]) -> float:
    """Distance of two origins, poses or coordinates [m]."""
    if one.ndim == 2:
        one, other = one[:3, 3], other[:3, 3]
    return float(np.linalg.norm(other - one))


def nearest_turn(angle: float, near: float) -> float:
    """The angle [rad] that is the same but for whole turns and next to another one."""
    return angle + 2.0 * math.pi * round((near - angle) / (2.0 * math.pi))


def _shown_postures(constraint: Constraint) -> Float[np.ndarray, "n m"] | None:
    """Postures in which a constraint was shown, as far as it keeps them; None if it keeps none of its robot."""
    robot, shown = constraint.robot, constraint.provenance.get("postures")
    if robot is None or not shown:
        return None
    postures = np.array(shown, dtype=np.float64)
    return postures if postures.ndim == 2 and postures.shape[1] in (robot.nq, robot.nv) else None


ONE_WAY = 0.5  # share of what lies to one side of where recordings begin, from which on that is the way shown


def shown_sense(constraint: Constraint, motion: DrivenMotion) -> float:
    """1 where a task was shown to the positive side of where its recordings began, -1 to the other; 0 if not known.

    Whether a person who opened a drawer shut it again does not matter; where the recordings went to both sides, the
    way is not known.
    """
    shown, of = _shown_postures(constraint), constraint.provenance.get("posture_trajectories")
    if shown is None or not of or len(of) != len(shown):
        return 0.0
    ways, numbers = [], np.array(of)
    for number in np.unique(numbers):
        first, *others = (shown[i] for i in np.flatnonzero(numbers == number))
        origin = motion.origin(first)
        ways += [motion.progress(origin, posture, 0.0) for posture in others]
    left, moved = float(np.sum(ways)), float(np.sum(np.abs(ways)))
    return math.copysign(1.0, left) if moved > 0.0 and abs(left) >= ONE_WAY * moved else 0.0


# [m] a hand this near to where a task was shown is on the mechanism: people take hold of a handle a finger's breadth
# further on, and a constraint file keeps a few postures only
GRIP = 0.02


@final
@dataclass(frozen=True, eq=False)
class ShownPlaces:
    """Postures in which a task was shown, as a motion along it sees them.

    Attributes:
        motion: The motion along what is free.
        postures: shape (n, nq or nv).
        lever: Distance of the hand from the axis of a turn [m]; 1 where nothing turns.
        n_held: How many of the held coordinates of the motion belong to the constraint; others hold the orientation.
    """

    motion: DrivenMotion
    postures: Float[np.ndarray, "n m"]
    lever: float
    n_held: int

    @staticmethod
    def of(constraint: Constraint, motion: DrivenMotion) -> ShownPlaces | None:
        """Of a learnt constraint; None if it was not learnt, or if its rows do not say where its mechanism is.

        A hand that is fixed to the mechanism carries the mechanism's place with it, so that only a loose grip has one.
        """
        mechanism, postures = constraint.mechanism, _shown_postures(constraint)
        if mechanism is None or mechanism.grip != "loose" or mechanism.orientation != "free" or postures is None:
            return None
        lever = 1.0 if motion.unit == "m" else max(mechanism.radius or 0.0, GRIP)
        return ShownPlaces(motion, postures, lever, constraint.n_constraints)

    @property
    def span(self) -> float:
        """How far apart along the motion the farthest two of the postures are [m or rad]."""
        along = [self.motion.progress(self.motion.origin(self.postures[0]), p, 0.0) for p in self.postures]
        return float(max(along) - min(along))

    def nearest(self, here: Float[np.ndarray, "..."], distance: float) -> Float[np.ndarray, "..."]:
        """The origin from which the way begins: that of the hand where it is on the mechanism, else the nearest one.

        Args:
            here: Origin of the motion where the hand is.
            distance: Of the way [m or rad].
        """
        motion = self.motion
        along = np.array([motion.progress(here, p, 0.0) for p in self.postures])
        across = np.array([motion.deviation(here, p, 0.0)[: self.n_held] for p in self.postures])
        origins = [motion.origin(p) for p in self.postures]
        low, high, room = float(along.min()), float(along.max()), GRIP / self.lever
        if low - room <= 0.0 <= high + room and np.all((across.min(0) <= GRIP) & (across.max(0) >= -GRIP)):
            return here
        # places from which the way ends within what was shown; if it is too long for that, those with the most room
        first, last = (low, max(high - distance, low)) if distance > 0.0 else (min(low - distance, high), high)
        places = [motion.goal(o, float(np.clip(s, first, last) - s)) for o, s in zip(origins, along, strict=True)]
        place = min(places, key=lambda place: apart(here, place))
        return between(here, place, 1.0)  # a loose grip keeps the hand's orientation as it is
