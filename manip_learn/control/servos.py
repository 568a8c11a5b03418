"""Model of position servos: they follow their commands late, with friction, backlash and noisy encoders."""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np
from jaxtyping import Float

MAX_LATENCY = 0.2  # [s] largest latency of an arm: servoJ of a UR looks ahead by as much, and no arm takes longer
_SPACING = 0.01  # [s] between two samples of the first motion, and between two candidate delays
_MIN_SAMPLES = 8  # smallest number of samples of a joint for an estimate
HIDDEN = 15.0  # [N m or N] largest joint load that friction and backlash may hide: more is a force
STILL = 2e-4  # [rad or m] largest displacement of a joint at rest, whatever its encoder reads
NOISE_DEVIATIONS = 6.0  # standard deviations that noise does not exceed in a run of hours
PACE = 0.002  # [s] spread of the delays of the joints: dampers of 4 N m s/rad at 2,000 N m/rad
ROUNDING = 1e-12  # [rad or m] rounding error of sums of steps


def shallow_copy(thing: Any) -> Any:
    """Return a shallow copy of an object, in a tenth of the time of `copy.copy`.

    Args:
        thing: Object whose class has no `__slots__`.
    """
    other = object.__new__(type(thing))
    other.__dict__ = thing.__dict__.copy()
    return other


def signed_excess(x: np.ndarray, low: np.ndarray | float, high: np.ndarray | float) -> np.ndarray:
    """Return the excess of numbers above `high` (positive) or below `low` (negative); 0 between them.

    Args:
        x: Numbers of any shape, in any unit.
        low: Lower bounds, broadcast to x.
        high: Upper bounds, broadcast to x.
    """
    return x - np.minimum(np.maximum(x, low), high)


@final
class Servos:
    """Model of position servos: the range of positions in which the arm can be without an external force.

    A servo of stiffness k, with dry friction F in its joint and backlash b in its gears, brings the joint to within

        width = F / k + b / 2    of    c(t - late)

    with the commanded path c and the delay `late`; a distance beyond that range is due to a force. The delay is the
    same for all joints, so that a delayed posture lies on the commanded path. Until the delay is known, any value up to
    `MAX_LATENCY` is possible. It is estimated from the first motion, as the value with the smallest variance of the
    remaining distances; these distances also give the width. Before that, the width of a joint is its commanded motion
    before it was first seen to move, plus 50 %, but at most `hidden`.

    Args:
        dt: Period [s].
        latency: Largest latency of the arm [s].
        hidden: shape (nv,), largest widths [rad or m].

    Attributes:
        late: Measured delay [s]; None until the first motion has shown it.
        width: shape (nv,), half the width of the range without a force [rad or m].
        seen: shape (nv,), True for joints that were seen to move.
        friction: shape (nv,), median lag of a joint behind its delayed command [rad or m].
        variance: shape (nv,), variance of the encoder noise [rad2 or m2].
        at_rest: shape (nv,), distance of the joints from their commanded positions before they moved [rad or m].
        moving: Time for which the commanded posture has moved [s].
        every: Number of periods from one new reading to the next, measured in the first motion; 1 if each is new.
        repeats: True if the newest reading repeats an old one, because readings are requested faster than they come.
        raw: shape (nv,), distance of the newest reading from the delayed commanded posture [rad or m].
        most: shape (nv,), upper end of the range without a force [rad or m].
        newest: shape (nv,), distance of the newest reading beyond the range without a force [rad or m].
        smoothing: Weight of the newest reading in the running mean of the excess.
    """

    def __init__(self, dt: float, latency: float, hidden: Float[np.ndarray, " nv"]):
        # settings, which do not change; the attributes below are the state, whose parts are replaced, never modified
        dry = 6.0  # [N m or N] dry friction of large arms
        self._dt, self._hidden, self._dry = dt, hidden, dry / HIDDEN * hidden
        # slow quantities are evaluated every 4 ms
        self._pace, self._slow_stride = max(1, round(PACE / dt)), max(1, round(0.004 / dt))
        longest = math.ceil(latency / dt - 1e-9) + 1
        lags = np.round(np.arange(0.0, MAX_LATENCY + 0.5 * _SPACING, max(_SPACING, dt)) / dt).astype(np.int64)
        self._lags = np.unique(np.minimum(lags, longest))
        # sum of the commanded steps, now and at the end of each past period, newest first; the readings of these
        # periods, and the newest readings
        zero, rows = np.zeros(len(hidden)), np.zeros((longest + 2 + round(2.0 * MAX_LATENCY / dt), len(hidden)))
        self._sent, self._readings, self._past = rows, rows, (zero,)
        self._since, self._period_count, self.moving, self._moving_periods = 0.0, 0, 0.0, 0
        # position at rest, the mean of so many readings; estimates of the servos
        self.at_rest, self._rest_count, self.variance = zero, 0, np.full(len(hidden), 1e-4**2)
        self.seen, self.width, self.friction, self.late = zero > 0.0, hidden, zero, None
        self._samples: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...] = ()
        # periods since a reading changed, and the largest squared step between two equal readings; squared steps
        # between readings in the first motion
        self.every, self._same, self._repeat_square, self._steps = 1.0, 0, -1.0, tuple[float, ...]()
        # possible range of the delay, and its estimate [periods]; the excess, a running mean over some periods at 1 kHz
        self._window, self._at, self._excess, self.smoothing = (0, longest), 0, zero, dt / (dt + 0.004)
        self.raw, self.most, self.newest, self.repeats = zero, zero, zero, False

    def record_step(self, step: Float[np.ndarray, " nv"], time: float) -> bool:
        """Record a step of the commanded posture.

        Args:
            step: Step of the commanded posture (nv,) [rad or m].
            time: Duration of the step [s]; negative if a call came early, and the step takes back a part of the
                previous one, which the arm may have made already.

        Returns:
            True if a period is complete.
        """
        self._since += time
        over = self._since > 0.99 * self._dt or time < 0.0
        self._sent = np.concatenate(((self._sent[0] + step)[None], self._sent[:-1] if over else self._sent[1:]))
        if over:
            self._readings = np.concatenate((self._past[0][None], self._readings[:-1]))
            self._since, self._period_count, moves = 0.0, self._period_count + 1, float(step.dot(step)) > 0.0
            self.moving, self._moving_periods = self.moving + moves * self._dt, self._moving_periods + moves
        return over

    @property
    def is_slow_period(self) -> bool:
        """True in every n-th period, in which the slowly changing quantities are evaluated."""
        return self._period_count % self._slow_stride == 1 % self._slow_stride

    def travel(self, periods: int) -> Float[np.ndarray, " nv"]:
        """Return the displacement of the commanded posture during the last periods, shape (nv,) [rad or m].

        Args:
            periods: Number of periods; if it exceeds the stored history, the whole history is used.
        """
        return self._sent[0] - self._sent[min(periods, len(self._sent) - 1)]

    @property
    def recent_travel(self) -> Float[np.ndarray, " nv"]:
        """Largest displacement of the commanded posture within the longest possible delay, shape (nv,) [rad or m]."""
        return np.abs(self._sent[: self._window[1] + 1] - self._sent[0]).max(axis=0)

    def excess(self, distance: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
        """Update the model with a reading, and return the arm's distance beyond the range without a force.

        Args:
            distance: Distance of the newest reading from the commanded posture (nv,) [rad or m].

        Returns:
            Running mean of the distance, shape (nv,) [rad or m].
        """
        y = self._sent[0] + distance
        step = y - self._past[0]
        square = float(step.dot(step))
        self._same = self._same + 1 if square <= self._repeat_square else 0
        if self.late is None:
            self._steps = (*self._steps[1 - len(self._sent) :], square) if self.moving else ()
            sent = self._sent[: self._window[1] + 1]
            # a joint that was not seen to move lags by no more than its commanded motion
            high = np.where(self.seen, self.width, np.minimum(np.abs(sent).max(axis=0), self.width))
            high = high + np.abs(self.travel(self._pace)) * (PACE / self._dt / self._pace) + ROUNDING
            raw = y - sent
            excess = signed_excess(raw, -high, high)
            self._at = int(np.einsum("ij,ij->i", excess, excess).argmin())
            raw, excess = raw[self._at], excess[self._at]
            self._update_estimates(y, sent[self._at])
        else:
            c = self._sent[self._at]
            if self._period_count % self._slow_stride == 0:
                self._update_range(y, c)
            low, high, path = self._bounds
            raw = y - c
            excess = signed_excess(raw, low, high)
            if excess.dot(excess) > 0.0:  # the delay is uncertain by this part of the path
                share = float(excess.dot(path)) / max(float(path.dot(path)), ROUNDING * ROUNDING)
                raw = raw - min(max(share, -0.5), 0.5) * path
                excess = signed_excess(raw, low, high)
        self.raw, self.most, self.newest, self._past = raw, high, excess, (y, *self._past[:3])
        self.repeats = 0 < self._same < 1.5 * self.every - 1.0
        self._excess = self._excess + self.smoothing * (excess - self._excess)
        return self._excess

    def _update_range(self, y: np.ndarray, c: np.ndarray) -> None:
        """Compute the range of distances without a force, and the part of the path for which the delay is uncertain."""
        (least, most), width = self._window, self.width
        path = self._sent[least] - self._sent[most]
        spread = np.abs(path) * (PACE / self._dt / (most - least)) + ROUNDING  # each joint has its own delay
        self._place = np.minimum(np.maximum(self._place, c - width), c + width)
        # a joint that still moves in the sense in which friction was measured lags by as much
        nearer = np.where((c - self._place) * self._sense > 0.99 * width, self._margin, 0.0)
        low, high = nearer * (self._sense < 0.0) - width, width - nearer * (self._sense > 0.0)
        if not self.seen.all():
            self._update_estimates(y, c)
            reach = np.minimum(np.abs(c) + np.abs(c - self._sent[self._at + self._slow_stride]), self.width)
            low, high = np.where(self.seen, low, -reach), np.where(self.seen, high, reach)
        self._bounds = low - spread, high + spread, path

    def _update_estimates(self, y: np.ndarray, c: np.ndarray) -> None:
        """Update noise, widths and the delay from a reading."""
        if not self.moving:
            self._rest_count += 1
            self.at_rest = self.at_rest + (y - self.at_rest) / self._rest_count
        if self.late is None and len(self._past) == 4:
            change = y - self._past[2] + 3.0 * (self._past[1] - self._past[0])
            # the third difference of independent noise has 1 + 9 + 9 + 1 times its variance
            self.variance = self.variance + 0.02 * (change * change / 20.0 - self.variance)
        travel = (y - self.at_rest) * np.sign(c)
        new = ~self.seen & (travel > NOISE_DEVIATIONS * np.sqrt(self.variance) + STILL) & (np.abs(c) > STILL)
        if new.any():
            self.friction = np.where(new, np.minimum(np.abs(c) - travel, self._hidden).clip(0.0), self.friction)
            self.width = np.where(new, np.minimum(1.5 * self.friction, self._hidden), self.width)
            # a lag beyond friction is backlash, within which the motion of the other joints moves each joint
            if np.any(new & (self.friction > self._dry + STILL)):
                self.width = self._hidden
            self.seen = self.seen | new
        if self.late is None and self._moving_periods >= max(1, round(_SPACING / self._dt)) and self.seen.any():
            self._moving_periods = 0
            self._samples = (*self._samples, (y - self.at_rest, self._sent[self._lags], self.seen))
            if len(self._samples) >= 16 and len(self._samples) % 4 == 0:  # 16: the delay may be known
                self._fit(y)

    def _fit(self, now: np.ndarray) -> None:
        """Estimate the delay with the smallest residual variance and the widths with it, once from the first motion."""
        n_final = 50  # samples of the first motion after which the estimates of latency and friction are final
        y, sent, has_moved = (np.array(part[-n_final:]) for part in zip(*self._samples, strict=True))
        is_last, self._samples = len(y) == n_final, self._samples[2 - n_final :]
        step = np.sign(sent[:, :-1] - sent[:, 1:])
        sense = step[:, :1]
        counts = np.all(step * sense >= 0.0, axis=1) & (sense[:, 0] != 0.0) & has_moved  # joints that never turned back
        counts &= counts.sum(axis=0) >= _MIN_SAMPLES
        n, noise = counts.sum(axis=0), float(np.mean(self.variance))
        if not n.any():
            return
        behind = sense * (sent[:, :-1] - y[:, None]) * counts[:, None]
        rest = np.sum((behind - behind.sum(axis=0) / np.maximum(n, 1)) ** 2 * counts[:, None], axis=(0, 2)) / n.sum()
        best, apart = int(rest.argmin()), np.pad(rest, 2, constant_values=np.inf)
        is_clear = min(apart[best], apart[best + 4]) - rest[best] > noise + (0.5 * STILL) ** 2
        if not (is_clear and rest[best] < (3.0 * math.sqrt(noise) + STILL) ** 2 or is_last):
            return
        place = _parabola_minimum(rest)[0]
        at = min(int(place), len(self._lags) - 2)
        share, turn, moves = place - at, step[:, at], (step[:, at] != 0.0) & has_moved
        between = (1.0 - share) * sent[:, at] + share * sent[:, at + 1]
        spread = np.abs(sent[:, at] - sent[:, at + 1]) * (PACE / self._dt / float(self._lags[at + 1] - self._lags[at]))
        self._learn_widths(signed_excess(turn * (between - y), -spread, spread), turn, moves)
        lag = float(np.interp(place, np.arange(len(self._lags)), self._lags))  # periods
        around, self._at, self.late = math.ceil(0.25 * lag) + 1, round(lag), lag * self._dt
        self._window = max(0, self._at - around), min(self._window[1], self._at + around)
        self._place, self._bounds = self._sent[self._at], (-self.width, self.width, np.zeros_like(self.width))
        # readings come slowly if some steps are much larger than the others, and make up the motion
        steps = np.sqrt(self._steps)
        quiet = 5.0 * float(np.median(steps)) + ROUNDING
        new, self._repeat_square = np.flatnonzero(steps > quiet), quiet * quiet
        if len(new) > 2 and float(steps[new].sum()) > 0.5 * float(np.linalg.norm(now - self.at_rest)):
            self.every = float(new[-1] - new[0]) / (len(new) - 1)

    def _learn_widths(self, lag: np.ndarray, turn: np.ndarray, moves: np.ndarray) -> None:
        """Estimate widths from samples (rows) of joints (columns): their lag, its sense, and a mask of the valid
        samples.
        """
        more = 0.25  # share by which a width may exceed the widths of the first motion
        enough, noise = moves.sum(axis=0) >= _MIN_SAMPLES, np.sqrt(self.variance)
        lags = np.where(moves | ~enough, lag, np.nan)
        least, middle, most = np.nanquantile(lags, (0.05, 0.5, 0.95), axis=0)
        width = np.maximum(np.maximum(most, -least), 0.0) * (1.0 + more) + noise
        self.friction = np.where(enough, middle, self.friction).clip(0.0, self._hidden)
        self.width = np.where(enough, np.minimum(width, self._hidden), self.width)
        least = np.where(enough, np.maximum(least * (1.0 - more) - noise, -self.width), 0.0)
        sum_of_turns = np.sum(turn * moves, axis=0)
        goes_on = enough & (np.abs(sum_of_turns) == moves.sum(axis=0)) & (most < self._dry)
        if np.any(self.seen & (self.width > (1.0 + more) * self._dry)):
            self.width = np.minimum(np.max(self.width * self.seen), self._hidden)
        self._sense, self._margin = np.sign(sum_of_turns) * goes_on, self.width + least

    def pace(self) -> tuple[float, bool]:
        """Return the speed of an arm that falls behind its commands.

        Returns:
            `(share, stands)`: speed along the commanded path over the commanded speed, NaN if the delay has not grown
            or the arm does not follow that path; and True if no joint moves any more.
        """
        late, off = self._lag(0)
        later = int(late - (self._at if self.late is None else self._window[1]))
        away = self._past[0] - self.at_rest - self._sent[self._at]
        # the speed can be estimated if the delay has grown by three periods, and the distance from the path is no more
        # than a fifth of the motion
        if later < 3 or off > 0.2**2 * float(away.dot(away)):
            return math.nan, False
        # an arm at rest has been at rest, and a slow arm has been slow, for all of the additional delay
        reads = np.concatenate((self._past[0][None], self._readings[:later]))
        few, half = 1 + later // 4, later // 2
        moved = np.abs(np.mean(reads[:few], axis=0) - np.mean(reads[-few:], axis=0))
        stands = bool(np.all(moved < NOISE_DEVIATIONS * np.sqrt(self.variance) / math.sqrt(few)))
        before, then = self._lag(half)[0], self._lag(later)[0]
        first, second = 1.0 - (before - then) / (later - half), 1.0 - (late - before) / half
        stops = later >= 12 and second < 0.7 * first  # as filtered readings do
        return (math.nan if stops else 1.0 - (late - then) / later), stands

    def _lag(self, ago: int) -> tuple[float, float]:
        """Return the delay of a reading on the commanded path [periods], and its squared distance from that path."""
        reading = self._readings[ago - 1] if ago else self._past[0]
        away = self._sent[ago:] - (reading - self.at_rest)
        return _parabola_minimum(np.einsum("ij,ij->i", away, away))

    @property
    def delay(self) -> float:
        """Delay with which `excess` responds to a command [s]: delay of the servos plus smoothing."""
        return self._at * self._dt + (1.0 / self.smoothing - 1.0) * self._dt


def _parabola_minimum(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the position and the value of the minimum of the parabola through the least of some values and its
    neighbours.
    """
    least = int(values.argmin())
    before, value, after = np.pad(values, 1, mode="reflect")[least : least + 3].tolist()
    bend = before - 2.0 * value + after
    step = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return least + step, value - 0.25 * (before - after) * step
