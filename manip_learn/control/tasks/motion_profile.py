"""How far a motion has come at a time: from rest to a speed, on at that speed, and back to rest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final


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
