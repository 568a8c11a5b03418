"""Checks of an arm's readings: they are postures of the arm, and the arm can have moved there since the last one."""

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


@final
@dataclass(frozen=True, eq=False)
class Readings:
    """Checks of the readings of one arm.

    Attributes:
        robot: The robot.
        farthest: Upper bounds of the absolute joint positions, shape (nv,) or one number, see `farthest_positions`
            [rad or m].
    """

    robot: Robot
    farthest: Float[np.ndarray, " nv"] | float

    def posture(self, reading: Any) -> Posture | None:
        """Return a reading as a new array, or None if it is not a posture.

        A posture is a vector of nv or nq finite numbers that are smaller than `farthest` in absolute value.

        Args:
            reading: Value from a driver, of any type.

        Returns:
            Joint positions (nv,) as they were read, or a normalised configuration (nq,).
        """
        try:
            q = np.asarray(reading)
            if q.dtype.kind not in "fiu" or q.ndim != 1:
                return None
            q = self.robot.checked_posture(q.astype(np.float64))
            # a pair (cos, sin) may have any length but 0
            within = bool(np.all(np.abs(q) < self.farthest))
            return (q if q.shape[0] == self.robot.nv else self.robot.configuration(q)) if within else None
        except (TypeError, ValueError, OverflowError, ConfigurationError):
            return None

    def refusal(self, reading: Any) -> str:
        """Return a text that explains why a reading is not a posture.

        Args:
            reading: A reading for which `posture` returns None.
        """
        words, x = f"no posture: {reading!r:.200}", finite(reading, self.robot.nv)
        far = "" if x is None else far_outside(self.robot, x)
        return f"{words}; {far}" if far else words

    def jump(self, before: Posture | None, q: Posture, since: float) -> str:
        """Return a text on the joint that moved faster than it can between two readings; empty if none did.

        Args:
            before: Posture of the previous reading; None if there is none.
            q: Posture of the newest reading, (nq,) or (nv,) as `before` [rad or m].
            since: Time between the two readings [s].
        """
        jump = 0.05  # [rad or m] error of a reading that is accepted beyond twice the largest motion of the joint
        if before is None or (away := q - before).dot(away) < jump * jump:
            return ""
        step, robot = self.robot.difference(before, q), self.robot
        farthest = 2.0 * robot.velocity_limit * since + jump
        if np.all(np.abs(step) <= farthest):
            return ""
        j = int((np.abs(step) / farthest).argmax())
        name, moved = robot.joint_names[j], f"{step[j]:+.3g} {robot.joint_units[j]}"
        words = f"joint {name} reads {moved} from its position {1e3 * since:.3g} ms before"
        if np.all(np.abs(np.diff([np.sort(robot.positions(x)) for x in (before, q)], axis=0)) <= np.sort(farthest)):
            return f"{words}: the joints are in another order"
        return words + other_turns(float(step[j]), robot.joint_units[j])
