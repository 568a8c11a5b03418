"""A way in time: from rest to rest with bounded acceleration, or as a path was shown."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float


@final
@dataclass(frozen=True)
class MotionProfile:
    """A distance in time with bounded acceleration and jerk.

    The speed rises and falls as 3 x^2 - 2 x^3 over the ramp, so that the acceleration is continuous and at most
    1.5 speed / ramp. Where the distance is too short to reach the speed, the ramps stay as long and the speed is less.

    Attributes:
        distance: [m or rad], negative for the other way.
        speed: Of the middle part, positive [m/s or rad/s].
        ramp: Time from rest to the speed [s].
    """

    distance: float
    speed: float
    ramp: float

    def over(self, distance: float) -> MotionProfile:
        """Over another distance [m or rad]."""
        return replace(self, distance=distance)

    def slowed(self, times: float) -> MotionProfile:
        """At a speed that is so many times smaller."""
        return replace(self, speed=self.peak / times)

    @property
    def peak(self) -> float:
        """Largest speed that is reached [m/s or rad/s]."""
        return min(self.speed, abs(self.distance) / self.ramp)

    @property
    def duration(self) -> float:
        """Time from rest to rest [s]."""
        return abs(self.distance) / self.peak + self.ramp

    def at(self, t: float) -> tuple[float, float]:
        """Distance covered and its rate, t [s] after the start; at rest before the start and after the end."""
        peak, ramp, duration = math.copysign(self.peak, self.distance), self.ramp, self.duration
        t = min(max(t, 0.0), duration)
        left = duration - t
        x = min(t, left) / ramp
        if x >= 1.0:
            return peak * (t - 0.5 * ramp), peak
        ramped, rate = peak * ramp * x**3 * (1.0 - 0.5 * x), peak * x * x * (3.0 - 2.0 * x)
        return (ramped if t < left else self.distance - ramped), rate


@final
@dataclass(frozen=True, eq=False)
class PathProfile:
    """The way along a path in the time in which it was shown, from rest and to rest.

    The time of the recording begins and ends slowly; between, it runs as the clock does.

    Attributes:
        clock: Time of the recording [s], in time.
        times: shape (k,), of the recording, from 0 [s].
        ways: shape (k,), along the path by then [m].
    """

    clock: MotionProfile
    times: Float[np.ndarray, " k"]
    ways: Float[np.ndarray, " k"]

    def over(self, distance: float) -> PathProfile:
        """Over the first part of the path [m]."""
        return replace(self, clock=self.clock.over(float(np.interp(abs(distance), self.ways, self.times))))

    def slowed(self, times: float) -> PathProfile:
        """At a pace that is so many times smaller."""
        return replace(self, clock=self.clock.slowed(times))

    @property
    def distance(self) -> float:
        """How much of the path is gone [m]."""
        return float(np.interp(self.clock.distance, self.times, self.ways))

    @property
    def speed(self) -> float:
        """Largest rate of the way [m/s]."""
        return self.clock.peak * float(np.max(np.diff(self.ways) / np.diff(self.times)))

    @property
    def duration(self) -> float:
        """Time from rest to rest [s]."""
        return self.clock.duration

    def at(self, t: float) -> tuple[float, float]:
        """Distance covered and its rate, t [s] after the start."""
        time, pace = self.clock.at(t)
        k = min(int(np.searchsorted(self.times, time, side="right")), len(self.times) - 1)
        slope = float((self.ways[k] - self.ways[k - 1]) / (self.times[k] - self.times[k - 1]))
        return float(self.ways[k - 1]) + slope * (time - float(self.times[k - 1])), slope * pace
