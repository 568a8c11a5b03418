"""Where a task was shown, and which way, as a motion along it sees that."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.mechanism import GRIP
from manip_learn.constraint.shown import Shown
from manip_learn.control.tasks.driven_motion import DrivenMotion, Origin, apart
from manip_learn.robot.rotations import angles_between

LEAST_TURN = 1e-3  # share of a rotation in a row: a learnt row of the place leaks less, and holds no turn
HAND_LEVER = 0.2  # [m] between a hand and what it turns, so that an approach of 0.25 m/s turns by 1.25 rad/s at most


def shown_sense(shown: Shown | None, motion: DrivenMotion, *, of_most: bool = False) -> float:
    """1 where a task was shown to the positive side of a motion, -1 to the other; 0 if the recordings do not say.

    With `of_most`, the side of most recordings counts where they went to both.
    """
    if shown is None or not shown.is_way or not (shown.one_way or of_most) or shown.unit != motion.unit:
        return 0.0
    begin = shown.chart.grasp
    along = float(shown.chart.heading(begin) @ motion.course(begin).chart.heading(begin))
    return math.copysign(1.0, along) if along else 0.0


@final
@dataclass(frozen=True, eq=False)
class ShownPlaces:
    """Where a task was shown, as a motion along it sees that.

    Attributes:
        motion: The motion along what is free.
        shown: What was shown, by the place of the hand.
        begins: shape (n, 4, 4), poses at which contacts began; one, if loose grips began at one place.
        anew: Whether the hand goes to where contacts began even if it is on the mechanism already.
        is_turned: Whether the hand is turned as it was shown; False where the rows leave that free.
        room: How far from what was shown a hand may begin, along the way [m or rad].
        sense: Of the way shown along the motion, 1 or -1.
    """

    motion: DrivenMotion
    shown: Shown
    begins: Float[np.ndarray, "n 4 4"]
    anew: bool
    is_turned: bool
    room: float
    sense: float

    @staticmethod
    def of(constraint: Constraint, motion: DrivenMotion, anew: bool, is_path: bool) -> ShownPlaces | None:
        """Of a learnt constraint; None if nothing was shown.

        A firm grip is taken as in the contact at which the hand is, else as in the typical one; a path as it began.
        """
        mechanism, shown = constraint.mechanism, constraint.shown
        if shown is None:
            return None
        rows: Any = motion.constraint.features
        turning = motion.constraint.selection @ rows.weights_at(shown.chart.grasp[None])[0, :, 3:]
        is_firm = mechanism is not None and mechanism.orientation != "free"  # kept by habit is free, too
        is_turned = is_firm and bool(np.any(np.abs(turning) > LEAST_TURN))
        is_apart = (shown.hold is None or is_turned) and len(shown.grasps) > 0 and not is_path
        lever = 1.0 if motion.unit == "m" or mechanism is None else max(mechanism.radius or 0.0, GRIP)
        sense = shown_sense(shown, motion, of_most=True) or 1.0
        by_place = replace(shown, mechanism=replace(shown.mechanism, orientation="free"))
        begins = shown.grasps if is_apart else shown.chart.grasp[None]
        return ShownPlaces(motion, by_place, begins, anew, is_turned, GRIP / lever, sense)

    @cached_property
    def _ahead(self) -> Float[np.ndarray, "n k"]:
        """How far along what is free each beginning is from the first [m or rad]."""
        return np.vstack([self.shown.along(np.array([self.begins[0], begin]))[1] for begin in self.begins])

    @cached_property
    def _taken_back(self) -> Float[np.ndarray, "n 3"]:
        """Where each beginning would be if it were taken back along the way to the first [m]."""
        far = zip(self.begins, self._ahead, strict=True)
        return np.array([self.shown.place_before(begin, ahead) for begin, ahead in far])

    def apart(self, one: Origin, other: Origin) -> float:
        """Distance of two origins [m]; where the hand's orientation counts, an angle at the lever of a hand."""
        turned = float(angles_between(one[:3, :3], other[None, :3, :3])[0]) if self.is_turned else 0.0
        return max(apart(one, other), HAND_LEVER * turned)

    def nearest(self, here: Origin, distance: float) -> Origin:
        """The origin from which the way begins.

        That is where contacts began, of a way back its end; of a hand that is on the mechanism already its own, of one
        that begins anew only if it is where contacts began. Where contacts began at different places, it is the
        nearest of them from which the way stays within what was shown.
        """
        if self._is_on_the_way(here):
            return here
        begins, way = self.begins.copy(), self.sense * distance
        if len(begins) > 1 and self.shown.is_way and not self.is_turned:
            ends = self._ahead[:, 0] - self._ahead[:, 0].min() + abs(way)
            begins = begins[ends <= max(self.shown.span, ends.min()) + self.room]
        if not self.is_turned:
            begins[:, :3, :3] = here[:3, :3]
        elif min(self.apart(here, begin) for begin in begins) > GRIP:  # from elsewhere the typical one
            begins = self.shown.chart.grasp[None]
        if way < 0.0:  # back from where one of them ended
            begins = [self.motion.goal(begin, -distance) for begin in begins]
        return min(begins, key=lambda begin: self.apart(here, begin))

    def _is_on_the_way(self, here: Origin) -> bool:
        """Return True if the hand is where a way was shown, or between such places, and may begin there."""
        if self.anew and (self.is_turned or len(self.begins) == 1):
            return False
        hand = self.begins[0].copy()
        hand[:3, 3] = here[:3, 3]
        far, path = self.shown.along(np.array([self.begins[0], hand]))[1], self.shown.path * (not self.anew)
        low, high = self._ahead.min(0) + path.min(0), self._ahead.max(0) + path.max(0)
        # both taken back along the way: is the hand where contacts began, or between them?
        goal, begun = self.shown.place_before(hand, far), self._taken_back
        weights = nnls(np.vstack([begun.T, np.ones(len(begun))]), np.append(goal, 1.0))[0]
        off = np.linalg.norm(weights @ begun / max(weights.sum(), GRIP) - goal)
        return bool(np.all((low - self.room <= far) & (far <= high + self.room)) and off <= GRIP)
