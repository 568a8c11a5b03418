"""Where a task was shown, and which way, as a motion along it sees that."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import AXES
from manip_learn.constraint.shown import Shown
from manip_learn.control.tasks.driven_motion import DrivenMotion, Origin, PathMotion, apart
from manip_learn.robot.rotations import rotation_vector

# [m] a hand this near to where a task was shown is on the mechanism: people take hold of a handle a finger's breadth
# further on, and a constraint file keeps a few postures only
GRIP = 0.02
HAND_LEVER = 0.2  # [m] between a hand and what it turns, so that an approach of 0.25 m/s turns by 1.25 rad/s at most


def shown_sense(shown: Shown | None, motion: DrivenMotion, *, of_most: bool = False) -> float:
    """1 where a task was shown to the positive side of a motion, -1 to the other; 0 if the recordings do not say.

    With `of_most`, the side of most recordings counts where they went to both.
    """
    if shown is None or not shown.is_way or not (shown.one_way or of_most) or shown.unit != motion.unit:
        return 0.0
    begin = np.eye(4)
    begin[:3, :3], begin[:3, 3] = shown.orientation, shown.begin
    along = float(motion.axis_at(begin) @ shown.coordinates.axes[0])
    return math.copysign(1.0, along) if along else 0.0


@final
@dataclass(frozen=True, eq=False)
class ShownPlaces:
    """Where a task was shown, as a motion along it sees that.

    Attributes:
        motion: The motion along what is free.
        postures: shape (n, nq or nv), in which it was shown; None where they do not say where the mechanism is.
        lever: Distance of the hand from the axis of a turn [m]; 1 where nothing turns.
        n_held: How many of the held coordinates of the motion belong to the constraint; others hold the orientation.
        hold: shape (3,), where all contacts began [m]; None if they began at different places.
        orientation: shape (3, 3), of the hand there; None where the mechanism leaves it free.
        points: shape (k, 3), along the way from there [m].
        shown: What was shown, if that is known.
        grasps: shape (n, 4, 4), of contacts that began at different places, and
        ahead: shape (n,), how far along the way each of them began [m or rad].
        anew: Whether the hand goes there even if it is on the mechanism already.
        sense: Of the way shown along the motion, 1 or -1.
    """

    motion: DrivenMotion
    postures: Float[np.ndarray, "n m"] | None
    lever: float
    n_held: int
    hold: Float[np.ndarray, " 3"] | None
    orientation: Float[np.ndarray, "3 3"] | None
    points: Float[np.ndarray, "k 3"]
    shown: Shown | None
    grasps: Float[np.ndarray, "n 4 4"]
    ahead: Float[np.ndarray, " n"]
    anew: bool
    sense: float

    @staticmethod
    def of(constraint: Constraint, motion: DrivenMotion, anew: bool) -> ShownPlaces | None:
        """Of a learnt constraint; None if it was not learnt, or if nothing says where its mechanism is.

        A hand that is fixed to the mechanism carries the mechanism's place with it: of a firm grip a place is known
        where all contacts began at one.
        """
        mechanism, robot, shown, postures = constraint.mechanism, constraint.robot, constraint.shown, None
        free = mechanism is not None and mechanism.grip == "loose" and mechanism.orientation == "free"
        if free and robot is not None and (kept := constraint.provenance.get("postures")):
            postures = np.array(kept, dtype=np.float64)
            postures = postures if postures.ndim == 2 and postures.shape[1] in (robot.nq, robot.nv) else None
        hold, points = None, np.zeros((0, 3))
        if shown is not None and (shown.hold is not None or postures is None or isinstance(motion, PathMotion)):
            hold, points = shown.begin, shown.points
        if hold is None and postures is None:
            return None
        grasps, ahead = np.zeros((0, 4, 4)), np.zeros(0)
        if hold is None and shown is not None and shown.is_way and shown.unit == motion.unit:
            grasps = shown.grasps
            ahead = np.array([shown.coordinates.of(np.array([grasps[0], grasp]))[1, 0] for grasp in grasps])
        lever = 1.0 if motion.unit == "m" or mechanism is None else max(mechanism.radius or 0.0, GRIP)
        turned = None if free or mechanism is None or shown is None else shown.orientation
        sense = shown_sense(shown, motion, of_most=True) or 1.0
        held = constraint.n_constraints
        return ShownPlaces(motion, postures, lever, held, hold, turned, points, shown, grasps, ahead, anew, sense)

    def apart(self, one: Origin, other: Origin) -> float:
        """Distance of two origins [m]; where the hand's orientation counts, an angle at the lever of a hand."""
        far = apart(one, other)
        if self.orientation is None or one.ndim == 1:
            return far
        turn = rotation_vector(one[:3, :3].T @ other[:3, :3])
        return max(far, HAND_LEVER * math.sqrt(turn @ turn))

    def nearest(self, here: Origin, distance: float) -> Origin:
        """The origin from which the way begins.

        That is where contacts began, of a way back its end; of a hand that is on the mechanism already its own, of one
        that begins anew only if it is where contacts began. Where contacts began at different places, it is the
        nearest of them from which the way stays within what was shown; where nobody says where they began, the nearest
        place that was shown.
        """
        motion = self.motion
        if self.hold is not None:
            there = motion.placed(here, self.hold, self.orientation)
            if self.sense * distance < 0.0:
                there = motion.goal(there, -distance)
            return here if self._is_on_the_way(here) else there
        if self.postures is None or self._is_on_the_way(here):
            return here
        if self.shown is not None and len(self.grasps):
            way = self.sense * distance
            ends = self.ahead - self.ahead.min() + abs(way)
            fits = np.flatnonzero(ends <= max(self.shown.span, ends.min()) + GRIP / self.lever)
            begins = [motion.placed(here, grasp[:3, 3]) for grasp in self.grasps[fits]]
            if way < 0.0:  # back from where one of them ended
                begins = [motion.goal(begin, -distance) for begin in begins]
            return min(begins, key=lambda begin: apart(here, begin))
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
        return place if place.ndim == 1 else motion.placed(here, place[:3, 3])

    def _is_on_the_way(self, here: Origin) -> bool:
        """Return True if the hand is where a way was shown, or between such places, and may begin there."""
        if self.shown is None:
            return False
        names = AXES[:3] if here.ndim == 2 else self.motion.constraint.features.row_names
        columns, place = [AXES.index(name) for name in names], here[:3, 3] if here.ndim == 2 else here
        if self.hold is not None:
            off = np.linalg.norm(self.points[:, columns] - place, axis=1)
            return not self.anew and bool(np.min(off, initial=np.inf) <= GRIP)
        if not len(self.grasps):
            return False
        hand, along = self.grasps[0].copy(), self.shown.coordinates
        hand[columns, 3] = place
        far = float(along.of(np.array([self.grasps[0], hand]))[1, 0])
        first, room = float(self.ahead.min()), GRIP / self.lever
        last = float(self.ahead.max()) if self.anew else first + self.shown.span
        if not first - room <= far <= last + room:
            return False
        # both taken back along the way: is the hand where contacts began, or between them?
        begun = [along.place(g[:3, 3], np.array([-s])) for g, s in zip(self.grasps, self.ahead, strict=True)]
        began, goal = np.array(begun), along.place(hand[:3, 3], np.array([-far]))
        weights = nnls(np.vstack([began.T, np.ones(len(began))]), np.append(goal, 1.0))[0]
        return float(np.linalg.norm(weights @ began / max(weights.sum(), GRIP) - goal)) <= GRIP
