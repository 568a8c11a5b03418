"""Moving average of commands, which turns bounds on acceleration into bounds on jerk."""

from __future__ import annotations

import math
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.control.limits import Limits
from manip_learn.errors import ConfigurationError

LONGEST = 5.0  # [s] an average over more delays the arm by seconds: the limits are meant otherwise


@final
class MovingAverage:
    """Mean of the newest velocities.

    With steps of at most a dt, the mean over T = length * dt changes by at most a dt a step, and that change changes by
    at most 2 a dt / length: a jerk of 2 a / T.

    Args:
        limits: Limits, with jerk or without.
        dt: Period [s].

    Attributes:
        length: Number of periods, 1 without a jerk limit.

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
        self.length = max(1, math.ceil(needed / dt - 1e-9))
        self._window = np.zeros((self.length, limits.robot.nv))
        self._row = 0

    def forget(self) -> None:
        """Begin anew, from rest."""
        self._window[:] = 0.0

    def of(self, velocity: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
        """The mean, with this velocity as the newest; always an array of its own."""
        if self.length == 1:
            return velocity.copy()
        self._window[self._row] = velocity
        self._row = (self._row + 1) % self.length
        return self._window.mean(axis=0)
