"""Where a task was shown, and from where on its mechanism a way of some length can be done within that."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.tasks.driven_motion import DrivenMotion, apart, between

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
        mechanism, shown = constraint.mechanism, constraint.provenance.get("postures")
        if mechanism is None or mechanism.grip != "loose" or mechanism.orientation != "free" or not shown:
            return None
        robot, postures = constraint.robot, np.array(shown, dtype=np.float64)
        if robot is None or postures.ndim != 2 or postures.shape[1] not in (robot.nq, robot.nv):
            return None
        lever = 1.0 if motion.unit == "m" else max(mechanism.radius or 0.0, GRIP)
        return ShownPlaces(motion, postures, lever, constraint.n_constraints)

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
