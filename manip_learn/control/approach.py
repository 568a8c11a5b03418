"""Approach to a position limit: how fast a joint may be at a distance from it."""

from __future__ import annotations

import math
from typing import NamedTuple, final

# share of the acceleration limit that braking before a position limit uses; the rest keeps the task on its way
BRAKING_SHARE = 0.5
# [1/s] rate at which a joint approaches its position limit exponentially, at the end of its braking distance
APPROACH_RATE = 20.0
# share of the velocity limit at which a joint that starts outside its position limits returns
RETURN_SPEED = 0.25


@final
class Approach(NamedTuple):
    """How fast one joint may approach a position limit, see `limits.Limits`.

    Attributes:
        free: Distance from which every speed is allowed.
        rate: kappa.
        linear: d1, where the exponential approach begins.
        offset: d0.
        twice: 2 a.
        half: a dt / 2.
        fastest: Speed of return from outside.
    """

    free: float
    rate: float
    linear: float
    offset: float
    twice: float
    half: float
    fastest: float

    def speed(self, distance: float) -> float:
        """brake(d); negative outside, where the joint returns."""
        if distance <= self.linear:
            return max(self.rate * distance, -self.fastest)
        return math.sqrt(self.half * self.half + self.twice * (distance - self.offset)) - self.half


def approach_of(velocity: float, acceleration: float, dt: float) -> Approach:
    """The constants of a joint: value and slope of brake(d) are continuous at d1."""
    acceleration = BRAKING_SHARE * acceleration
    rate = min(APPROACH_RATE, 0.5 / dt)
    v = min(velocity, 1e6)
    fastest = RETURN_SPEED * v
    if not math.isfinite(acceleration):  # stops at once
        return Approach(v / rate, rate, math.inf, 0.0, 0.0, 0.0, fastest)
    twice, half = 2.0 * acceleration, 0.5 * acceleration * dt
    joined = acceleration / rate - half  # speed at d1
    linear = joined / rate
    offset = linear - joined * (joined + acceleration * dt) / twice
    free = v / rate if v <= joined else offset + v * (v + acceleration * dt) / twice
    return Approach(free, rate, linear, offset, twice, half, fastest)
