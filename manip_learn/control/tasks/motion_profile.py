"""Distance over time: from rest to rest with bounded acceleration, or with the timing of a demonstrated path."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class MotionProfile:
    """Distance over time with bounded acceleration and jerk.

    The speed rises and falls as 3 x^2 - 2 x^3 over the ramp, so that the acceleration is continuous and at most 1.5
    speed / ramp. If the distance is too short to reach the speed, the ramps stay as long and the speed is lower.

    Attributes:
        distance: Whole distance [m or rad], negative for the opposite sense.
        speed: Speed of the middle part, positive [m/s or rad/s].
        ramp: Time from rest to the speed [s].
    """

    distance: float
    speed: float
    ramp: float

    @property
    def peak(self) -> float:
        """Largest speed of the motion [m/s or rad/s]."""
        return min(self.speed, abs(self.distance) / self.ramp)

    @property
    def duration(self) -> float:
        """Time from rest to rest [s]."""
        return abs(self.distance) / self.peak + self.ramp

    def at(self, t: float) -> tuple[float, float]:
        """Return the distance covered [m or rad] and the speed [m/s or rad/s] at a time.

        The speed is 0 before the start and after the end.

        Args:
            t: Time since the start [s].
        """
        peak, duration = math.copysign(self.peak, self.distance), self.duration
        t = min(max(t, 0.0), duration)
        near = min(t, duration - t)  # [s] from rest
        x = min(near / self.ramp, 1.0)
        covered = peak * (self.ramp * x**3 * (1.0 - 0.5 * x) + max(near - self.ramp, 0.0))
        return (covered if near == t else self.distance - covered), peak * x * x * (3.0 - 2.0 * x)


@final
@dataclass(frozen=True, eq=False)
class PathProfile(MotionProfile):
    """Distance along a path with the timing of its demonstration, from rest and to rest.

    The time of the recording begins and ends slowly; in between it runs like the clock, or more slowly if `speed` is
    less.

    Attributes:
        distance: Length of the path [m].
        speed: Largest speed along the path [m/s].
        ramp: Time from rest until the path is followed at its demonstrated speed [s].
        times: shape (k,), times of the recording, from 0 [s].
        ways: shape (k,), distances along the path at these times [m].
    """

    times: Float[np.ndarray, " k"]
    ways: Float[np.ndarray, " k"]

    @cached_property
    def _clock(self) -> MotionProfile:
        """Time of the recording [s] as a profile over time."""
        steepest = float(np.max(np.diff(self.ways) / np.diff(self.times)))  # [m/s] in the recording
        return MotionProfile(float(np.interp(self.distance, self.ways, self.times)), self.speed / steepest, self.ramp)

    @property
    def peak(self) -> float:
        """Largest speed along the path [m/s]."""
        return self.speed

    @property
    def duration(self) -> float:
        """Time from rest to rest [s]."""
        return self._clock.duration

    def at(self, t: float) -> tuple[float, float]:
        """Return the distance covered [m] and the speed [m/s] at a time.

        Args:
            t: Time since the start [s].
        """
        time, pace = self._clock.at(t)
        k = min(int(np.searchsorted(self.times, time, side="right")), len(self.times) - 1)
        slope = float((self.ways[k] - self.ways[k - 1]) / (self.times[k] - self.times[k - 1]))
        return float(self.ways[k - 1]) + slope * (time - float(self.times[k - 1])), slope * pace
