"""Readings of an arm: a posture that it can have, and that it can have moved to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.command import Posture
from manip_learn.control.contact import other_turns
from manip_learn.errors import ConfigurationError
from manip_learn.linalg import finite
from manip_learn.recordings.checks import far_outside
from manip_learn.robot.robot import Robot

JUMP = 0.05  # [rad or m] by which a reading may be off beyond twice what a joint can move meanwhile


@final
@dataclass(frozen=True, eq=False)
class Readings:
    """The readings of one arm.

    Attributes:
        robot: The robot.
        farthest: shape (nv,), positions that no joint is at, however its encoder counts [rad or m].
    """

    robot: Robot
    farthest: Float[np.ndarray, " nv"] | float

    def posture(self, reading: Any) -> Posture | None:
        """Return a reading as an array of its own, or None if it is not a posture.

        Args:
            reading: Anything.
        """
        try:
            q = np.asarray(reading)
            if q.dtype.kind not in "fiu" or q.ndim != 1:
                return None
            q = self.robot.checked_posture(q.astype(np.float64))
            # (cos, sin) of any length but 0
            within = bool(np.all(np.abs(q) < self.farthest))
            return (q if q.shape[0] == self.robot.nv else self.robot.configuration(q)) if within else None
        except (TypeError, ValueError, OverflowError, ConfigurationError):
            return None

    def refusal(self, reading: Any) -> str:
        """Return why a reading is not a posture, in words."""
        words, x = f"no posture: {reading!r:.200}", finite(reading, self.robot.nv)
        far = "" if x is None else far_outside(self.robot, x)
        return f"{words}; {far}" if far else words

    def jump(self, before: Posture | None, q: Posture, since: float) -> str:
        """Return how a joint has moved that none can move so fast, in words; empty if none has.

        Args:
            before: Posture that was read before; None for none.
            q: Posture.
            since: Time between them [s].
        """
        if before is None or (away := q - before).dot(away) < JUMP * JUMP:
            return ""
        step, robot = self.robot.difference(before, q), self.robot
        fastest = 2.0 * robot.velocity_limit * since + JUMP
        if np.all(np.abs(step) <= fastest):
            return ""
        j = int((np.abs(step) / fastest).argmax())
        name, moved = robot.joint_names[j], f"{step[j]:+.3g} {robot.joint_units[j]}"
        words = f"joint {name} was read {moved} from where it was {1e3 * since:.3g} ms before"
        if np.all(np.abs(np.diff([np.sort(robot.positions(x)) for x in (before, q)], axis=0)) <= np.sort(fastest)):
            return f"{words}: the joints come in another order"
        return words + other_turns(float(step[j]), robot.joint_units[j])
