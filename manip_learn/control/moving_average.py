"""Moving average of commands, which turns bounds on acceleration into bounds on jerk."""

from __future__ import annotations

import math
from collections import deque
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.control.limits import Limits
from manip_learn.errors import ConfigurationError

LONGEST = 5.0  # [s] an average over more delays the arm by seconds: the limits are meant otherwise


@final
class MovingAverage:
    """Mean of the newest velocities.

    Velocities are joined by straight lines, so that with changes of at most a dt in every dt, however long that is, the
    mean over a time T changes by at most a dt, and its rate by at most 2 a dt / T: a jerk of 2 a / T.

    Args:
        limits: Limits, with jerk or without.
        dt: Period [s].

    Attributes:
        time: T, a whole number of periods [s].
        averages: Whether that is more than one.

    Raises:
        ConfigurationError: A jerk limit without acceleration limits, or so small that it needs `LONGEST` or more.
    """

    def __init__(self, limits: Limits, dt: float):
        needed = 0.0 if limits.jerk is None else float(np.max(2.0 * limits.acceleration / limits.jerk))
        if not needed <= LONGEST:
            raise ConfigurationError(
                f"the jerk limits need an average over {needed:g} s, 2 acceleration / jerk: "
                f"lower the acceleration limits, or raise the jerk limits, to {LONGEST:g} s or less"
            )
        length = max(1, math.ceil(needed / dt - 1e-9))
        self.time, self.averages = length * dt, length > 1
        self._rest = np.zeros(limits.robot.nv)
        # velocities at the start and the end of straight stretches, and how long these are, oldest first
        self._newest: deque[tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"], float]] = deque()
        self.forget()

    def forget(self) -> None:
        """Begin anew, from rest."""
        self._newest.clear()
        self._newest.append((self._rest, self._rest, self.time))

    def of(self, velocity: Float[np.ndarray, " nv"], dt: float) -> Float[np.ndarray, " nv"]:
        """The mean, with this velocity as the newest, reached in dt [s]; always an array of its own."""
        if not self.averages:
            return velocity.copy()
        newest, dt = self._newest, min(dt, self.time)
        left = dt
        while left > 0.0:
            first, last, length = newest.popleft()
            if length - left > 1e-9 * dt:
                newest.appendleft((first + (last - first) * (left / length), last, length - left))
            left -= length
        newest.append((newest[-1][1] if newest else self._rest, velocity.copy(), dt))
        return sum((length * (first + last) for first, last, length in newest), self._rest) / (2.0 * self.time)
