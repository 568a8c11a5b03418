"""Time between readings: the time for which a command counts, and the average that limits jerk."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.command import Vector
from manip_learn.control.limits import Limits
from manip_learn.errors import ConfigurationError


def is_number(value: Any) -> bool:
    """Return True if a value is a real number; True, text, arrays and durations are not.

    Args:
        value: Anything.
    """
    kinds = (int, float, np.integer, np.floating)
    return isinstance(value, kinds) and not isinstance(value, bool | np.timedelta64)


def time_of(t: Any) -> float:
    """Return a time stamp as a number, or NaN.

    Args:
        t: Anything. Booleans, text, arrays and durations are not times.

    Returns:
        The time [s].
    """
    # the spacing of larger floating-point numbers exceeds a period
    return float(t) if is_number(t) and abs(t) < 1e15 else math.nan


def in_milliseconds(time: float, seconds: float) -> bool:
    """Return True if a clock seems to count milliseconds.

    Args:
        time: Time that passed on the clock, in its own unit.
        seconds: Time that really passed [s].
    """
    return time > 0.0 and abs(math.log10(time / seconds) - 3.0) < 0.1


@final
class Timing(NamedTuple):
    """Timing of the readings of one arm so far.

    Attributes:
        dt: Agreed period [s].
        stale_after: Time without a new reading after which it is stale [s].
        time: Stamp of the newest reading [s]; -inf before the first.
        older: Stamp of a reading that was refused for being older than the newest [s]; NaN if there is none.
        since: Time between the last two readings [s]; 0 if the newest reading was not new.
        silent: Time since the newest reading, in agreed periods [s].
        late: Time by which the newest reading came after the end of the commanded motion [s]; negative if it came
            early, 0 if it came in time.
        held: Time for which the next command counts [s].
        waited: Time by which the clock of a task that waits for the arm is behind [s].
        usual: Period of the calls: the agreed one, or the period of a caller who is regular but slower [s].
        longest: Longest recent period, where calls are irregular; else `usual` [s].
        recent: The newest periods, oldest first [s].
        warning: Fault of the caller's period, in words; empty if there is none.
    """

    dt: float
    stale_after: float
    time: float = -math.inf
    older: float = math.nan
    since: float = 0.0
    silent: float = 0.0
    late: float = 0.0
    held: float = 0.0
    waited: float = 0.0
    usual: float = 0.0
    longest: float = 0.0
    recent: tuple[float, ...] = ()
    warning: str = ""

    @classmethod
    def begin(cls, dt: float, stale_after: float) -> Timing:
        """Return the timing before the first reading.

        Args:
            dt: Agreed period [s].
            stale_after: Time without a new reading after which it is stale [s].
        """
        return cls(dt, stale_after, held=dt, usual=dt, longest=dt)

    def restart(self) -> Timing:
        """Return the timing before the first reading of another motion; the period of the calls stays known."""
        return self.skip_reading(math.nan)._replace(time=-math.inf, silent=0.0, waited=0.0)

    @property
    def is_stale(self) -> bool:
        """True if the newest reading is too old, or came after too long a gap."""
        return self.since > self.stale_after or self.silent > self.stale_after

    @property
    def is_regular(self) -> bool:
        """True if calls come one usual period apart."""
        return self.longest == self.usual

    def detect_reset(self, time: float) -> Timing:
        """Return this timing with its clock set back, if two successive readings show that it was.

        Args:
            time: Stamp of a reading [s].
        """
        is_next = time < self.time and self.older < time <= self.older + self.stale_after
        return self._replace(time=-math.inf) if is_next else self

    def skip_reading(self, older: float) -> Timing:
        """Return the timing after a period without a usable reading.

        Args:
            older: Stamp of the reading if it is refused for its time, else NaN [s].
        """
        silent = self.silent + self.dt
        return self._replace(older=older, silent=silent, since=0.0, late=0.0, held=self.dt)

    def accept(self, time: float, stands: bool, commanded: float) -> Timing:
        """Return the timing after a usable reading.

        Args:
            time: Its stamp, not earlier than the newest [s].
            stands: True if the arm stood: a task that waits for the arm has then waited all the time.
            commanded: Time for which commands have moved the commanded posture since the newest reading [s].
        """
        since, dt = time - self.time, self.dt
        if since <= 0.0:
            return self.skip_reading(self.older)
        if math.isinf(since):  # the first, or the first of a clock that was set back
            return self._replace(time=time, older=math.nan, since=0.0, silent=0.0, late=0.0, held=dt)
        late = since - commanded
        late = late if abs(late) > 0.01 * dt else 0.0  # a smaller difference counts as in time
        waited = self.waited + (since if stands else late)
        calls = dt, self.usual, self.longest, self.recent, self.warning
        period, usual, longest, recent, words = self._calls(since) if since <= self.stale_after else calls
        stale = self.stale_after
        return Timing(dt, stale, time, math.nan, since, 0.0, late, period, waited, usual, longest, recent, words)

    def _calls(self, since: float) -> tuple[float, float, float, tuple[float, ...], str]:
        """Return `held`, `usual`, `longest`, `recent` and `warning` after a period `since` [s]."""
        # regular: largest over smallest period of regular calls, and over dt of a period that counts as dt;
        # window: number of periods that are compared; rounding: share of a period
        regular, window, rounding = 1.25, 100, 1e-6
        dt, warning, recent = self.dt, self.warning, (*self.recent[1 - window :], since)
        if self.longest == self.usual == dt and dt * (1.0 - rounding) <= since <= regular * dt:
            return dt, dt, dt, recent, warning
        shortest, longest, mean = min(recent), max(recent), sum(recent) / len(recent)
        is_regular = len(recent) >= 3 and longest <= regular * shortest
        usual = shortest if is_regular and shortest > regular * dt else dt
        if not warning and (is_regular or len(recent) == window) and not dt / regular <= mean <= regular * dt:
            every = f"every {1e3 * mean:.4g} ms in the mean ({1e3 * shortest:.4g} to {1e3 * longest:.4g})"
            warning = f"the servo loop was made for a period of {1e3 * dt:.4g} ms and is called {every}: set dt to that"
        period = usual if since >= usual * (1.0 - rounding) else since
        return period, usual, longest if longest > regular * usual else usual, recent, warning


@final
class VelocityAverage(NamedTuple):
    """Mean of the velocities of the last `time` seconds, which limits jerk.

    Velocities are joined by straight lines, so that with changes of at most a dt in every dt, for any dt, the mean
    over a time T changes by at most a dt, and its rate by at most 2 a dt / T: a jerk of 2 a / T.

    Attributes:
        time: T, a whole number of periods [s].
        ages: shape (k,), age of each knot, from `time` down to 0 [s].
        knots: shape (k, nv), velocities there [rad/s or m/s].
        mean: shape (nv,) [rad/s or m/s].
    """

    time: float
    ages: Float[np.ndarray, " k"]
    knots: Float[np.ndarray, "k nv"]
    mean: Vector

    @staticmethod
    def at_rest(limits: Limits, dt: float) -> VelocityAverage | None:
        """Return the average that keeps the jerk limits, from rest; None without such limits.

        Args:
            limits: Limits of the joints.
            dt: Period [s].

        Raises:
            ConfigurationError: A jerk limit without acceleration limits, or one that needs an average of over 5 s.
        """
        longest = 5.0  # [s] a longer average delays the arm by seconds: such limits are a mistake
        needed = 0.0 if limits.jerk is None else float(np.max(2.0 * limits.acceleration / limits.jerk))
        if not needed <= longest:
            fix = f"lower the acceleration limits, or raise the jerk limits, to {longest:g} s or less"
            raise ConfigurationError(f"the jerk limits need an average over {needed:g} s, 2 acceleration / jerk: {fix}")
        time, rest = dt * max(1, math.ceil(needed / dt - 1e-9)), np.zeros((2, limits.robot.nv))
        return VelocityAverage(time, np.array([time, 0.0]), rest, rest[0]) if time > dt else None

    def add(self, velocity: Vector, dt: float) -> VelocityAverage:
        """Return the average with another velocity.

        Args:
            velocity: shape (nv,) [rad/s or m/s].
            dt: Time in which the velocity is reached [s].
        """
        T = self.time
        ages, knots = np.append(self.ages + min(dt, T), 0.0), np.vstack((self.knots, velocity))
        k = int(np.count_nonzero(ages >= T)) - 1  # the newest knot that is at least as old as T
        share = (ages[k] - T) / (ages[k] - ages[k + 1])
        oldest = knots[k] + share * (knots[k + 1] - knots[k])
        ages, knots = np.append(T, ages[k + 1 :]), np.vstack((oldest, knots[k + 1 :]))
        mean = (ages[:-1] - ages[1:]).dot(knots[:-1] + knots[1:]) / (2.0 * T)
        return VelocityAverage(T, ages, knots, mean)
