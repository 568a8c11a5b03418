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
        shown: What was shown.
        lever: Distance of the hand from the axis of a turn [m]; 1 where nothing turns.
        hold: shape (3,), where all contacts began [m]; None if they began at different places.
        orientation: shape (3, 3), of the hand there; None where the mechanism leaves it free.
        ahead: shape (n, k), how far along what is free each grasp that was shown is from the first [m or rad]; with
            `hold` there is no need to know, n = 0.
        begun: shape (n, 3), where each of these would be if it were taken back along the way to the first [m].
        anew: Whether the hand goes to where contacts began even if it is on the mechanism already.
        sense: Of the way shown along the motion, 1 or -1.
    """

    motion: DrivenMotion
    shown: Shown
    lever: float
    hold: Float[np.ndarray, " 3"] | None
    orientation: Float[np.ndarray, "3 3"] | None
    ahead: Float[np.ndarray, "n k"]
    begun: Float[np.ndarray, "n 3"]
    anew: bool
    sense: float

    @staticmethod
    def of(constraint: Constraint, motion: DrivenMotion, anew: bool) -> ShownPlaces | None:
        """Of a learnt constraint; None if nothing was shown.

        A hand that is fixed to the mechanism carries the mechanism's place with it: of a firm grip, and of a path, one
        place is taken for all where contacts began.
        """
        mechanism, shown = constraint.mechanism, constraint.shown
        if shown is None:
            return None
        free = mechanism is not None and mechanism.orientation == "free"  # kept by habit is free, too
        apart = shown.hold is None and free and len(shown.grasps) > 0 and not isinstance(motion, PathMotion)
        grasps, hold = (shown.grasps, None) if apart else (shown.grasps[:0], shown.begin)
        ahead = [shown.coordinates.of(np.array([shown.grasps[0], grasp]))[1] for grasp in grasps]
        begun = [shown.coordinates.place(grasp[:3, 3], -far) for grasp, far in zip(grasps, ahead, strict=True)]
        lever = 1.0 if motion.unit == "m" or mechanism is None else max(mechanism.radius or 0.0, GRIP)
        turned = None if free or mechanism is None else shown.orientation
        sense = shown_sense(shown, motion, of_most=True) or 1.0
        return ShownPlaces(motion, shown, lever, hold, turned, np.array(ahead), np.array(begun), anew, sense)

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
        nearest of them from which the way stays within what was shown.
        """
        if self._is_on_the_way(here):
            return here
        places, way = self.shown.grasps[:, :3, 3] if self.hold is None else self.hold[None], self.sense * distance
        if self.hold is None and self.shown.is_way:
            ends = self.ahead[:, 0] - self.ahead[:, 0].min() + abs(way)
            places = places[ends <= max(self.shown.span, ends.min()) + GRIP / self.lever]
        begins = [self.motion.placed(here, place, self.orientation) for place in places]
        if way < 0.0:  # back from where one of them ended
            begins = [self.motion.goal(begin, -distance) for begin in begins]
        return min(begins, key=lambda begin: apart(here, begin))

    def _is_on_the_way(self, here: Origin) -> bool:
        """Return True if the hand is where a way was shown, or between such places, and may begin there."""
        names = AXES[:3] if here.ndim == 2 else self.motion.constraint.features.row_names
        columns, place = [AXES.index(name) for name in names], here[:3, 3] if here.ndim == 2 else here
        if self.hold is not None:
            off = np.linalg.norm(self.shown.points[:, columns] - place, axis=1)
            return not self.anew and bool(np.min(off) <= GRIP)
        hand, along = self.shown.grasps[0].copy(), self.shown.coordinates
        hand[columns, 3] = place
        far, path = along.of(np.array([self.shown.grasps[0], hand]))[1], self.shown.path * (not self.anew)
        low, high, room = self.ahead.min(0) + path.min(0), self.ahead.max(0) + path.max(0), GRIP / self.lever
        # both taken back along the way: is the hand where contacts began, or between them?
        goal = along.place(hand[:3, 3], -far)
        weights = nnls(np.vstack([self.begun.T, np.ones(len(self.begun))]), np.append(goal, 1.0))[0]
        off = np.linalg.norm(weights @ self.begun / max(weights.sum(), GRIP) - goal)
        return bool(np.all((low - room <= far) & (far <= high + room)) and off <= GRIP)
