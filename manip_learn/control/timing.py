"""Timing of readings and commands, and the average of velocities that limits jerk."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.command import Vector
from manip_learn.control.limits import Limits
from manip_learn.errors import ConfigurationError


def is_number(value: Any) -> bool:
    """Return True if a value is a single int or float of Python or NumPy, but no Boolean.

    Args:
        value: Value of any type.
    """
    kinds = (int, float, np.integer, np.floating)
    return isinstance(value, kinds) and not isinstance(value, bool | np.timedelta64)


def time_of(t: Any) -> float:
    """Return a time stamp as a float, or NaN if it is not a valid time.

    Args:
        t: Value of any type; an int or float below 1e15 in absolute value is a valid time.

    Returns:
        The time [s], or NaN.
    """
    # the spacing of larger floating-point numbers exceeds a period
    return float(t) if is_number(t) and abs(t) < 1e15 else math.nan


def in_milliseconds(time: float, seconds: float) -> bool:
    """Return True if a clock that should count seconds seems to count milliseconds.

    Args:
        time: Time that passed on the clock, in its own unit.
        seconds: Time that really passed [s].
    """
    return time > 0.0 and abs(math.log10(time / seconds) - 3.0) < 0.1


@final
class Timing(NamedTuple):
    """Timing of the readings of one arm so far.

    Attributes:
        dt: Period for which the loop was made [s].
        stale_after: Time without a new reading after which the newest one is stale [s].
        time: Time stamp of the newest reading [s]; -inf before the first.
        older: Time stamp of a reading that was refused because it is older than the newest [s]; NaN if there is none.
        since: Time between the last two readings [s]; 0 if the last call brought no newer reading.
        silent: Time since the newest reading [s], counted as one `dt` per call.
        late: Time by which the newest reading came after the end of the commanded motion [s]; negative if it came
            early, 0 if it came in time.
        held: Time for which the next command is applied [s].
        waited: Total time for which the clock of a task that waits for the arm has been stopped [s].
        usual: Period of the calls [s]: `dt`, or the actual period if the calls are regular but slower.
        longest: Longest recent period if calls are irregular; otherwise `usual` [s].
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
            dt: Period for which the loop was made [s].
            stale_after: Time without a new reading after which the newest one is stale [s].
        """
        return cls(dt, stale_after, held=dt, usual=dt, longest=dt)

    def restart(self) -> Timing:
        """Return the timing before the first reading of another motion; it keeps the measured period of the calls."""
        return self.skip_reading(math.nan)._replace(time=-math.inf, silent=0.0, waited=0.0)

    @property
    def is_stale(self) -> bool:
        """True if the newest reading is older than `stale_after`, or came after a gap longer than that."""
        return self.since > self.stale_after or self.silent > self.stale_after

    @property
    def is_regular(self) -> bool:
        """True if the calls come at regular times, one `usual` period apart."""
        return self.longest == self.usual

    def detect_reset(self, time: float) -> Timing:
        """Return a timing that accepts earlier times, if two successive readings show that the clock was set back.

        Args:
            time: Time stamp of a reading [s].

        Returns:
            Timing whose `time` is -inf after a reset; this timing otherwise.
        """
        is_next = time < self.time and self.older < time <= self.older + self.stale_after
        return self._replace(time=-math.inf) if is_next else self

    def skip_reading(self, older: float) -> Timing:
        """Return the timing after a period without a usable reading.

        Args:
            older: Time stamp of a reading that is refused for its time [s]; NaN if there was none.
        """
        silent = self.silent + self.dt
        return self._replace(older=older, silent=silent, since=0.0, late=0.0, held=self.dt)

    def accept(self, time: float, stands: bool, commanded: float) -> Timing:
        """Return the timing after a usable reading.

        Args:
            time: Time stamp of the reading, not earlier than the newest [s].
            stands: True if the arm was commanded to stand still since the last reading: a task that waits for the arm
                has then waited for all of that time.
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

    The velocities are joined by straight lines and averaged over the time T = `time`. If the acceleration of the
    velocities is at most `a`, then the acceleration of the mean is at most `a`, too, and its jerk is at most 2 a / T.

    Attributes:
        time: Averaging time T, a whole number of periods [s].
        ages: shape (k,), ages of the stored velocities, from `time` down to 0 [s].
        knots: shape (k, nv), stored velocities at these ages [rad/s or m/s].
        mean: shape (nv,), mean velocity [rad/s or m/s].
    """

    time: float
    ages: Float[np.ndarray, " k"]
    knots: Float[np.ndarray, "k nv"]
    mean: Vector

    @staticmethod
    def at_rest(limits: Limits, dt: float) -> VelocityAverage | None:
        """Return an average at rest, over the time that keeps the jerk limits; None if there are no jerk limits.

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
        """Return the average after another velocity.

        Args:
            velocity: New velocity, shape (nv,) [rad/s or m/s].
            dt: Time since the previous velocity [s].
        """
        T = self.time
        ages, knots = np.append(self.ages + min(dt, T), 0.0), np.vstack((self.knots, velocity))
        k = int(np.count_nonzero(ages >= T)) - 1  # the newest knot that is at least as old as T
        share = (ages[k] - T) / (ages[k] - ages[k + 1])
        oldest = knots[k] + share * (knots[k + 1] - knots[k])
        ages, knots = np.append(T, ages[k + 1 :]), np.vstack((oldest, knots[k + 1 :]))
        mean = (ages[:-1] - ages[1:]).dot(knots[:-1] + knots[1:]) / (2.0 * T)
        return VelocityAverage(T, ages, knots, mean)
