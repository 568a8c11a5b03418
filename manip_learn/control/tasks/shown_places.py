"""Where a task was shown, and which way, as a motion along it sees that."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from functools import cached_property
from typing import Any, final

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from manip_learn.constraint.mechanism import GRIP, Mechanism
from manip_learn.constraint.place import Chart
from manip_learn.constraint.shown import Shown
from manip_learn.control.tasks.driven_motion import DrivenMotion, Origin, screw
from manip_learn.robot.rotations import angles_between, rotation_vector


def shown_sense(shown: Shown | None, motion: DrivenMotion, *, of_most: bool = False) -> float:
    """Return 1 where a task was shown to the positive side of a motion, -1 to the other; 0 if that is not known.

    With `of_most`, the side of most recordings counts where they went to both.
    """
    if shown is None or not shown.is_way or not (shown.one_way or of_most) or shown.unit != motion.unit:
        return 0.0
    begin = shown.chart.grasp
    along = float(shown.chart.heading(begin) @ motion.chart_at(begin).heading(begin))
    return math.copysign(1.0, along) if along else 0.0


def straight(start: Origin, end: Origin) -> Chart:
    """Return the chart of a hand that goes straight from one pose (0) to another (1), and turns evenly meanwhile."""
    return screw(end[:3, 3] - start[:3, 3], spin=rotation_vector(end[:3, :3] @ start[:3, :3].T))(start)


@final
class ShownPlaces:
    """Where a task was shown, as a motion along it sees that.

    A firm grip is taken as in the contact at which the hand is, else as in the typical one; a path as it began.

    Args:
        mechanism: What holds the hand.
        shown: What was shown.
        motion: The motion along what is free.
        anew: Whether the hand does as was shown: it goes to where contacts began even if it is on the mechanism
            already, and along the path that was shown on a surface.

    Attributes:
        sense: Of the way shown along the motion, 1 or -1.
    """

    def __init__(self, mechanism: Mechanism | None, shown: Shown, motion: DrivenMotion, anew: bool):
        self._shown = replace(shown, mechanism=shown.mechanism.by_place())
        self._motion, self._anew = motion, anew
        self.sense = shown_sense(shown, motion, of_most=True) or 1.0
        rows: Any = motion.constraint.features
        turning = motion.constraint.selection @ rows.weights_at(shown.chart.grasp[None])[0, :, 3:]
        # the hand is turned as it was shown, where a firm grip holds that; one that is kept by habit is free
        is_firm = mechanism is not None and mechanism.orientation != "free"
        self._is_turned = is_firm and bool(np.any(np.abs(turning) > 1e-3))  # a learnt row of the place leaks less
        is_apart = (shown.hold is None or self._is_turned) and len(shown.grasps) > 0 and (shown.is_way or not anew)
        self._begins = shown.grasps if is_apart else shown.chart.grasp[None]
        lever = 1.0 if motion.unit == "m" or mechanism is None else max(mechanism.radius or 0.0, GRIP)
        self._room = GRIP / lever  # how far from what was shown a hand may begin, along the way [m or rad]

    def only(self, grasp: Origin) -> ShownPlaces:
        """Return these places for a hand that takes hold at one pose."""
        other = copy.copy(self)
        vars(other).pop("_ahead", None)
        other._begins, other._anew = grasp[None], True
        return other

    @cached_property
    def _ahead(self) -> Float[np.ndarray, "n k"]:
        """How far along what is free each beginning is from the first [m or rad]."""
        return np.vstack([self._shown.along(np.array([self._begins[0], begin]))[1] for begin in self._begins])

    def apart(self, one: Origin, other: Origin) -> float:
        """Return the distance of two origins [m]; where orientation counts, an angle at the lever of a hand."""
        turned = float(angles_between(one[:3, :3], other[None, :3, :3])[0]) if self._is_turned else 0.0
        # at 0.2 m between a hand and what it turns, an approach of 0.25 m/s turns by 1.25 rad/s at most
        return max(float(np.linalg.norm(other[:3, 3] - one[:3, 3])), 0.2 * turned)

    def nearest(self, here: Origin, distance: float) -> tuple[Origin, float]:
        """Return the origin from which the way begins, and how far that is [m].

        That is where contacts began, of a way back its end; of a hand that is on the mechanism already its own, of one
        that begins anew only if it is where contacts began. Where contacts began at different places, it is the
        nearest of them from which the way stays within what was shown.
        """
        if self._is_on_the_way(here):
            return here, 0.0
        begins, way = self._begins.copy(), self.sense * distance
        if len(begins) > 1 and self._shown.is_way and not self._is_turned:
            ends = self._ahead[:, 0] - self._ahead[:, 0].min() + abs(way)
            begins = begins[ends <= max(self._shown.span, ends.min()) + self._room]
        if not self._is_turned:
            begins[:, :3, :3] = here[:3, :3]
        elif len(begins) > 1 and min(self.apart(here, begin) for begin in begins) > GRIP:  # then the typical one
            begins = self._shown.chart.grasp[None]
        if way < 0.0:  # back from where one of them ended
            begins = [self._motion.chart_at(begin).pose((-distance,)) for begin in begins]
        origin = min(begins, key=lambda begin: self.apart(here, begin))
        return origin, self.apart(here, origin)

    def _is_on_the_way(self, here: Origin) -> bool:
        """Return True if the hand is where a way was shown, or between such places, and may begin there."""
        if self._anew and (self._is_turned or len(self._begins) == 1):
            return False
        hand = self._begins[0].copy()
        hand[:3, 3] = here[:3, 3]
        far, path = self._shown.along(np.array([self._begins[0], hand]))[1], self._shown.path * (not self._anew)
        low, high = self._ahead.min(0) + path.min(0), self._ahead.max(0) + path.max(0)
        # both taken back along the way: is the hand where contacts began, or between them?
        goal, back = self._shown.place_before(hand, far), zip(self._begins, self._ahead, strict=True)
        begun = np.array([self._shown.place_before(begin, ahead) for begin, ahead in back])
        weights = nnls(np.vstack([begun.T, np.ones(len(begun))]), np.append(goal, 1.0))[0]
        off = np.linalg.norm(weights @ begun / max(weights.sum(), GRIP) - goal)
        return bool(np.all((low - self._room <= far) & (far <= high + self._room)) and off <= GRIP)
