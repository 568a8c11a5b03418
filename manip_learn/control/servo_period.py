"""The periods at which a servo loop is really called: averages over time, and the way back after a trip."""

from __future__ import annotations

import logging
import math
from collections import deque
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.limits import Limits
from manip_learn.errors import ConfigurationError

_LOGGER = logging.getLogger("manip_learn")
# calls whose periods are compared, and how many of them are enough at the start
COMPARED, ENOUGH = 100, 3
# largest over smallest period of calls that count as regular, and over dt of a period that is not dt
REGULAR = 1.25
ROUNDING = 1e-6  # share of a period


@final
class Period:
    """For how long commands count: the period, or that of a caller who is regular but slower.

    Args:
        dt: The period that was agreed [s].

    Attributes:
        usual: Period for which commands count, where none comes earlier [s].
        longest: Longest time from one state to the next of late, where that is longer; else `usual` [s].
    """

    def __init__(self, dt: float):
        self.dt, self._said = dt, False
        self.usual, self.longest = dt, dt
        self._seen: deque[float] = deque(maxlen=COMPARED)

    def step(self, since: float) -> float:
        """The time for which the next command counts, at most that since the last one.

        Args:
            since: Time from the last state to this one [s].
        """
        self._seen.append(since)
        dt = self.dt
        if dt * (1.0 - ROUNDING) <= since <= REGULAR * dt and self.longest == self.usual == dt:
            return dt
        shortest, longest = min(self._seen), max(self._seen)
        regular = len(self._seen) >= ENOUGH and longest <= REGULAR * shortest
        if regular and not shortest <= dt * REGULAR:
            dt = shortest
        if not self._said and (regular or len(self._seen) == COMPARED):
            self._say(sum(self._seen) / len(self._seen))
        self.usual, self.longest = dt, longest if longest > REGULAR * dt else dt
        return dt if since >= dt * (1.0 - ROUNDING) else since

    def _say(self, mean: float) -> None:
        """Once, if the period is another than agreed."""
        if self.dt / REGULAR <= mean <= REGULAR * self.dt:
            return
        self._said = True
        _LOGGER.warning(
            "the servo loop was made for a period of %.4g ms and is called every %.4g ms in the mean (%.4g to %.4g): "
            "give it that as dt",
            *(1e3 * x for x in (self.dt, mean, min(self._seen), max(self._seen))),
        )


@final
class Return(NamedTuple):
    """The way of a commanded posture back to a measured one, within the velocity and acceleration limits.

    Attributes:
        limits: The limits.
        posture: Where a position servo is sent.
        speed: Share of the acceleration limits, times s, with which it moves [s].
    """

    limits: Limits
    posture: Float[np.ndarray, " n"]
    speed: float = 0.0

    def step(self, measured: Float[np.ndarray, " n"], dt: float) -> Return | None:
        """One period farther; None where the way ends.

        All joints move along the straight way, faster by at most an acceleration for dt, and as fast as lets them stop:
        at unit acceleration the steps x, x - 1, x - 2, ... > 0 [dt^2] are as long together as what is left.
        """
        limits = self.limits
        away = limits.robot.difference(self.posture, measured)
        acceleration = np.minimum(limits.acceleration, 1e6)
        far = float(np.max(np.abs(away) / acceleration))  # [s^2] at unit acceleration
        if far <= 0.5 * dt * dt:
            return None
        direction = away / far
        fastest = float(np.min(limits.velocity / np.maximum(np.abs(direction), 1e-12)))
        left = far / (dt * dt)
        n = math.floor(0.5 * (math.sqrt(1.0 + 8.0 * left) - 1.0))
        stopping = dt * (left + 0.5 * n * (n + 1)) / (n + 1)
        speed = min(self.speed + dt, stopping, fastest, far / dt)
        posture = limits.robot.integrate(self.posture, dt * speed * direction)
        return Return(limits, posture, speed)


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
