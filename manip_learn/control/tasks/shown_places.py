"""Start poses and sense of the demonstrations, relative to a motion along a free direction."""

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
    """Return the sign of the demonstrated motions along a motion: 1 or -1, or 0 if it is not known.

    Args:
        shown: The demonstrated motions; None for none.
        motion: The motion along a free direction.
        of_most: True to return the sign of most demonstrations if they went to both sides; False returns 0 then.
    """
    if shown is None or not shown.is_way or not (shown.one_way or of_most) or shown.unit != motion.unit:
        return 0.0
    begin = shown.chart.grasp
    along = float(shown.chart.heading(begin) @ motion.chart_at(begin).heading(begin))
    return math.copysign(1.0, along) if along else 0.0


def straight(start: Origin, end: Origin) -> Chart:
    """Return the chart of a straight motion between two poses, with an even rotation; its coordinate is 0 to 1.

    Args:
        start: Pose of the hand (4, 4) in the base frame.
        end: Pose of the hand (4, 4) in the base frame.
    """
    return screw(end[:3, 3] - start[:3, 3], spin=rotation_vector(end[:3, :3] @ start[:3, :3].T))(start)


@final
class DemonstratedStarts:
    """Start poses of the demonstrations for a motion along a free direction.

    With a firm grip, the hand starts at the start pose of the contact that is near the hand, or of the typical contact
    if none is near. On a demonstrated path it starts at the start of that path.

    Args:
        mechanism: Mechanism that constrains the hand; None if it is not known.
        shown: The demonstrated motions.
        motion: The motion along a free direction.
        repeats: True if the hand repeats the demonstration: it moves to a start pose of the contacts even if it is on
            the mechanism already, and follows the demonstrated path on a surface.

    Attributes:
        sense: Sense of the demonstrations along the motion, 1 or -1.
    """

    def __init__(self, mechanism: Mechanism | None, shown: Shown, motion: DrivenMotion, repeats: bool):
        self._shown = replace(shown, mechanism=shown.mechanism.by_place())
        self._motion, self._repeats = motion, repeats
        self.sense = shown_sense(shown, motion, of_most=True) or 1.0
        rows: Any = motion.constraint.features
        turning = motion.constraint.selection @ rows.weights_at(shown.chart.grasp[None])[0, :, 3:]
        # a firm grip fixes the demonstrated orientation; an orientation kept by habit is free
        is_firm = mechanism is not None and mechanism.orientation != "free"
        self._is_turned = is_firm and bool(np.any(np.abs(turning) > 1e-3))  # learnt rows of positions leak less
        is_apart = (shown.hold is None or self._is_turned) and len(shown.grasps) > 0 and (shown.is_way or not repeats)
        self._start_poses = shown.grasps if is_apart else shown.chart.grasp[None]
        lever = 1.0 if motion.unit == "m" or mechanism is None else max(mechanism.radius or 0.0, GRIP)
        self._room = GRIP / lever  # largest distance of the start from the demonstrated motion, along it [m or rad]

    def with_grasp(self, grasp: Origin) -> DemonstratedStarts:
        """Return a copy in which a single grasp pose replaces all start poses.

        Args:
            grasp: Pose of the hand (4, 4) in the base frame.
        """
        other = copy.copy(self)
        vars(other).pop("_ahead", None)
        other._start_poses, other._repeats = grasp[None], True
        return other

    @cached_property
    def _ahead(self) -> Float[np.ndarray, "n k"]:
        """Distance of each start pose from the first one along the free directions [m or rad]."""
        return np.vstack([self._shown.along(np.array([self._start_poses[0], begin]))[1] for begin in self._start_poses])

    def pose_distance(self, one: Origin, other: Origin) -> float:
        """Return the distance between two poses [m].

        If the grip fixes the orientation, an angle counts as a distance at a lever of 0.2 m; the larger of both
        distances is returned.

        Args:
            one: Pose of the hand (4, 4), in the same frame as the other one [m].
            other: Pose of the hand (4, 4), in the same frame as the other one [m].
        """
        turned = float(angles_between(one[:3, :3], other[None, :3, :3])[0]) if self._is_turned else 0.0
        # with a lever of 0.2 m, an approach at 0.25 m/s turns by 1.25 rad/s at most
        return max(float(np.linalg.norm(other[:3, 3] - one[:3, 3])), 0.2 * turned)

    def nearest(self, here: Origin, distance: float) -> tuple[Origin, float]:
        """Return the pose at which the motion begins, and the distance of the hand from it [m].

        If the hand is on the mechanism already, the pose is the hand's own; if the hand repeats the demonstration, it
        must also be near a start pose for that. Otherwise it is a start pose of the contacts (for a motion back: the
        end of the motion from there). If the contacts began at different poses, it is the nearest one from which the
        motion stays within the demonstrated range.

        Args:
            here: Pose of the hand (4, 4) in the base frame.
            distance: Signed distance of the motion [m or rad].
        """
        if self._is_on_motion(here):
            return here, 0.0
        begins, way = self._start_poses.copy(), self.sense * distance
        if len(begins) > 1 and self._shown.is_way and not self._is_turned:
            ends = self._ahead[:, 0] - self._ahead[:, 0].min() + abs(way)
            begins = begins[ends <= max(self._shown.span, ends.min()) + self._room]
        if not self._is_turned:
            begins[:, :3, :3] = here[:3, :3]
        elif len(begins) > 1 and min(self.pose_distance(here, begin) for begin in begins) > GRIP:
            begins = self._shown.chart.grasp[None]  # the typical one
        if way < 0.0:  # back from the end of one of them
            begins = [self._motion.chart_at(begin).pose((-distance,)) for begin in begins]
        origin = min(begins, key=lambda begin: self.pose_distance(here, begin))
        return origin, self.pose_distance(here, origin)

    def _is_on_motion(self, here: Origin) -> bool:
        """Return True if the hand is on a demonstrated motion, or between such motions, and may begin there."""
        if self._repeats and (self._is_turned or len(self._start_poses) == 1):
            return False
        hand = self._start_poses[0].copy()
        hand[:3, 3] = here[:3, 3]
        far, path = self._shown.along(np.array([self._start_poses[0], hand]))[1], self._shown.path * (not self._repeats)
        low, high = self._ahead.min(0) + path.min(0), self._ahead.max(0) + path.max(0)
        # moved back along the motion: is the hand at a start pose, or between start poses?
        goal, back = self._shown.place_before(hand, far), zip(self._start_poses, self._ahead, strict=True)
        start_places = np.array([self._shown.place_before(begin, ahead) for begin, ahead in back])
        weights = nnls(np.vstack([start_places.T, np.ones(len(start_places))]), np.append(goal, 1.0))[0]
        off = np.linalg.norm(weights @ start_places / max(weights.sum(), GRIP) - goal)
        return bool(np.all((low - self._room <= far) & (far <= high + self._room)) and off <= GRIP)
