"""What position servos do to a posture that is sent: they follow late, with friction, play and noisy encoders."""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np
from jaxtyping import Float

LATEST = 0.2  # [s] by which an arm may follow late: servoJ of a UR looks ahead by as much, and nothing takes longer
# samples of that motion after which lateness and friction may be known, and after which they are what they seem to be
SOONEST, LATEST_SAMPLE = 16, 50
_APART = 0.01  # [s] between two samples of that motion, and between the delays that are tried
_KNOWN = 0.25  # share by which a width may be more than was seen in the first motion
_FEWEST = 8  # samples of a joint that count
# [N m or N] by which dry friction, of large arms, and together with play may hide what loads a joint: more is a force
DRY, HIDDEN = 6.0, 15.0
STILL = 2e-4  # [rad or m] within which a joint may not have moved, whatever its encoder says
NOISES = 6.0  # standard deviations that noise does not reach in a run of hours
PACE = 0.002  # [s] by which joints follow more or less late than each other: dampers of 4 N m s/rad at 2,000 N m/rad
ROUNDING = 1e-12  # [rad or m] of sums of steps


def copied(thing: Any) -> Any:
    """Return a shallow copy of an object without slots, in a tenth of the time of `copy.copy`."""
    other = object.__new__(type(thing))
    other.__dict__ = thing.__dict__.copy()
    return other


def beyond(x: np.ndarray, low: np.ndarray | float, high: np.ndarray | float) -> np.ndarray:
    """Return by how much numbers are above `high` or below `low`; 0 between them."""
    return x - np.minimum(np.maximum(x, low), high)


@final
class Servos:
    """Where the servos may have brought the arm; what is beyond that is a force.

    A servo of stiffness k whose joint has the dry friction F, and whose gears have the play b, brings it to within

        width = F / k + b / 2    of    c(t - late),

    and nowhere else unless something pushes it. The delay is the same for all joints, so that a posture that is late
    lies on the path that was sent. Until it is known it may be any up to `LATEST`; it is then the one for which the
    distances left vary least along the first motion, and what is left with it is the width. Until then the width of a
    joint is how far it was sent before it was first seen to move, and half as much again, `hidden` at most.

    Args:
        dt: Period [s].
        latency: By how much the arm may follow late at the most [s].
        hidden: shape (nv,), largest widths [rad or m].

    Attributes:
        late: Delay that was measured [s]; None until the first motion has told it, and all that it can.
        width: shape (nv,) [rad or m].
        seen: shape (nv,), joints that were seen to move.
        friction: shape (nv,), by how much a joint was behind when it was measured, the median [rad or m].
        variance: shape (nv,), of the encoders [rad2 or m2].
        at_rest: shape (nv,), how far the joints were from where they were sent before they moved [rad or m].
        moving: For how long the commanded posture has moved [s].
        every: Periods from one new reading to the next, as the first motion showed; 1 if each is new.
        repeats: True if the newest reading is an old one, because readings come more slowly than they are asked for.
        raw: shape (nv,), how far the arm is from the posture that it seems to follow, by the newest reading, and
        most: how far forwards it may be from that without a force, and
        newest: how far it is beyond that [rad or m].
        smoothing: Share of the newest reading in the mean that the excess is.
    """

    def __init__(self, dt: float, latency: float, hidden: Float[np.ndarray, " nv"]):
        # settings, which do not change; what follows is the state, whose parts are replaced, never changed in place
        self._dt, self._hidden, self._dry = dt, hidden, DRY / HIDDEN * hidden
        self._pace, self._often = max(1, round(PACE / dt)), max(1, round(0.004 / dt))  # what is slow: every 4 ms
        longest = math.ceil(latency / dt - 1e-9) + 1
        lags = np.round(np.arange(0.0, LATEST + 0.5 * _APART, max(_APART, dt)) / dt).astype(np.int64)
        self._lags = np.unique(np.minimum(lags, longest))
        # what was sent since the beginning, by now and at the end of each period that is over, newest first; what was
        # read last, and in those periods
        zero, rows = np.zeros(len(hidden)), np.zeros((longest + 2 + round(2.0 * LATEST / dt), len(hidden)))
        self._sent, self._reads, self._past = rows, rows, (zero,)
        self._since, self._over, self.moving, self._counted = 0.0, 0, 0.0, 0
        # what is known: where the arm is at rest, the mean of so many readings; servos
        self.at_rest, self._rests, self.variance = zero, 0, np.full(len(hidden), 1e-4**2)
        self.seen, self.width, self.friction, self.late = zero > 0.0, hidden, zero, None
        self._samples: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...] = ()
        # periods since a reading was another than the one before, and the largest step between two that are the same,
        # squared; steps from reading to reading in the first motion, squared
        self.every, self._same, self._quiet, self._steps = 1.0, 0, -1.0, tuple[float, ...]()
        # by how many periods the arm may be late, and seems to be; the excess, the mean of some periods at 1 kHz
        self._window, self._at, self._excess, self.smoothing = (0, longest), 0, zero, dt / (dt + 0.004)
        self.raw, self.most, self.newest, self.repeats = zero, zero, zero, False

    def moved(self, step: Float[np.ndarray, " nv"], time: float) -> bool:
        """Take note of a step of the commanded posture [rad or m] and how long it took [s]; whether a period is over.

        A call that came early takes a part of the step before back, which the arm may have made.
        """
        self._since += time
        over = self._since > 0.99 * self._dt or time < 0.0
        self._sent = np.concatenate(((self._sent[0] + step)[None], self._sent[:-1] if over else self._sent[1:]))
        if over:
            self._reads = np.concatenate((self._past[0][None], self._reads[:-1]))
            self._since, self._over, moves = 0.0, self._over + 1, float(step.dot(step)) > 0.0
            self.moving, self._counted = self.moving + moves * self._dt, self._counted + moves
        return over

    @property
    def has_looked(self) -> bool:
        """Whether this period is one in which what changes slowly is looked at, all of it in the same."""
        return self._over % self._often == 1 % self._often

    def gone(self, periods: int) -> Float[np.ndarray, " nv"]:
        """Return how far the commanded posture has moved in the last periods [rad or m]."""
        return self._sent[0] - self._sent[min(periods, len(self._sent) - 1)]

    @property
    def moved_lately(self) -> Float[np.ndarray, " nv"]:
        """How far the commanded posture has moved within the longest delay that there may be."""
        return np.abs(self._sent[: self._window[1] + 1] - self._sent[0]).max(axis=0)

    def excess(self, distance: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
        """Return how far the arm is from where servos may have brought it, by how far it is from where it was sent."""
        y = self._sent[0] + distance
        step = y - self._past[0]
        square = float(step.dot(step))
        self._same = self._same + 1 if square <= self._quiet else 0
        if self.late is None:
            self._steps = (*self._steps[1 - len(self._sent) :], square) if self.moving else ()
            sent = self._sent[: self._window[1] + 1]
            # a joint that was not seen to move is behind by no more than it was sent
            high = np.where(self.seen, self.width, np.minimum(np.abs(sent).max(axis=0), self.width))
            high = high + np.abs(self.gone(self._pace)) * (PACE / self._dt / self._pace) + ROUNDING
            raw = y - sent
            excess = beyond(raw, -high, high)
            self._at = int(np.einsum("ij,ij->i", excess, excess).argmin())
            raw, excess = raw[self._at], excess[self._at]
            self._look(y, sent[self._at])
        else:
            c = self._sent[self._at]
            if self._over % self._often == 0:
                self._look_again(y, c)
            low, high, path = self._bounds
            raw = y - c
            excess = beyond(raw, low, high)
            if excess.dot(excess) > 0.0:  # the delay is known to within that path
                share = float(excess.dot(path)) / max(float(path.dot(path)), ROUNDING * ROUNDING)
                raw = raw - min(max(share, -0.5), 0.5) * path
                excess = beyond(raw, low, high)
        self.raw, self.most, self.newest, self._past = raw, high, excess, (y, *self._past[:3])
        self.repeats = 0 < self._same < 1.5 * self.every - 1.0
        self._excess = self._excess + self.smoothing * (excess - self._excess)
        return self._excess

    def _look_again(self, y: np.ndarray, c: np.ndarray) -> None:
        """Between which distances there is no force, and the path within which the delay is known."""
        (least, most), width = self._window, self.width
        path = self._sent[least] - self._sent[most]
        own = np.abs(path) * (PACE / self._dt / (most - least)) + ROUNDING  # each joint follows at a pace of its own
        self._place = np.minimum(np.maximum(self._place, c - width), c + width)
        # a joint that goes on as it did when friction was measured is behind by as much
        nearer = np.where((c - self._place) * self._sense > 0.99 * width, self._margin, 0.0)
        low, high = nearer * (self._sense < 0.0) - width, width - nearer * (self._sense > 0.0)
        if not self.seen.all():
            self._look(y, c)
            reach = np.minimum(np.abs(c) + np.abs(c - self._sent[self._at + self._often]), self.width)
            low, high = np.where(self.seen, low, -reach), np.where(self.seen, high, reach)
        self._bounds = low - own, high + own, path

    def _look(self, y: np.ndarray, c: np.ndarray) -> None:
        """Learn noise, widths and the delay from a reading."""
        if not self.moving:
            self._rests += 1
            self.at_rest = self.at_rest + (y - self.at_rest) / self._rests
        if self.late is None and len(self._past) == 4:
            change = y - self._past[2] + 3.0 * (self._past[1] - self._past[0])
            # the third difference of independent noise has 1 + 9 + 9 + 1 times its variance
            self.variance = self.variance + 0.02 * (change * change / 20.0 - self.variance)
        went = (y - self.at_rest) * np.sign(c)
        new = ~self.seen & (went > NOISES * np.sqrt(self.variance) + STILL) & (np.abs(c) > STILL)
        if new.any():
            self.friction = np.where(new, np.minimum(np.abs(c) - went, self._hidden).clip(0.0), self.friction)
            self.width = np.where(new, np.minimum(1.5 * self.friction, self._hidden), self.width)
            # what is more than friction is play, within which the other joints take each to and fro
            if np.any(new & (self.friction > self._dry + STILL)):
                self.width = self._hidden
            self.seen = self.seen | new
        if self.late is None and self._counted >= max(1, round(_APART / self._dt)) and self.seen.any():
            self._counted = 0
            self._samples = (*self._samples, (y - self.at_rest, self._sent[self._lags], self.seen))
            if len(self._samples) >= SOONEST and len(self._samples) % 4 == 0:
                self._fit(y)

    def _fit(self, now: np.ndarray) -> None:
        """The delay for which what is left varies least, and the widths with it: all that the first motion can tell."""
        y, sent, seen = (np.array(part[-LATEST_SAMPLE:]) for part in zip(*self._samples, strict=True))
        is_last, self._samples = len(y) == LATEST_SAMPLE, self._samples[2 - LATEST_SAMPLE :]
        step = np.sign(sent[:, :-1] - sent[:, 1:])
        sense = step[:, :1]
        counts = np.all(step * sense >= 0.0, axis=1) & (sense[:, 0] != 0.0) & seen  # of a joint that never turned
        counts &= counts.sum(axis=0) >= _FEWEST
        n, noise = counts.sum(axis=0), float(np.mean(self.variance))
        if not n.any():
            return
        behind = sense * (sent[:, :-1] - y[:, None]) * counts[:, None]
        left = np.sum((behind - behind.sum(axis=0) / np.maximum(n, 1)) ** 2 * counts[:, None], axis=(0, 2)) / n.sum()
        best, apart = int(left.argmin()), np.pad(left, 2, constant_values=np.inf)
        told = min(apart[best], apart[best + 4]) - left[best] > noise + (0.5 * STILL) ** 2
        if not (told and left[best] < (3.0 * math.sqrt(noise) + STILL) ** 2 or is_last):
            return
        place = _lowest(left)[0]
        at = min(int(place), len(self._lags) - 2)
        share, turn, moves = place - at, step[:, at], (step[:, at] != 0.0) & seen
        between = (1.0 - share) * sent[:, at] + share * sent[:, at + 1]
        own = np.abs(sent[:, at] - sent[:, at + 1]) * (PACE / self._dt / float(self._lags[at + 1] - self._lags[at]))
        self._learn_widths(beyond(turn * (between - y), -own, own), turn, moves)
        lag = float(np.interp(place, np.arange(len(self._lags)), self._lags))  # periods
        around, self._at, self.late = math.ceil(0.25 * lag) + 1, round(lag), lag * self._dt
        self._window = max(0, self._at - around), min(self._window[1], self._at + around)
        self._place, self._bounds = self._sent[self._at], (-self.width, self.width, np.zeros_like(self.width))
        # readings come slowly where some steps are far larger than others, and make up the motion
        steps = np.sqrt(self._steps)
        quiet = 5.0 * float(np.median(steps)) + ROUNDING
        new, self._quiet = np.flatnonzero(steps > quiet), quiet * quiet
        if len(new) > 2 and float(steps[new].sum()) > 0.5 * float(np.linalg.norm(now - self.at_rest)):
            self.every = float(new[-1] - new[0]) / (len(new) - 1)

    def _learn_widths(self, lag: np.ndarray, turn: np.ndarray, moves: np.ndarray) -> None:
        """Learn widths from samples (rows) of joints (columns): how far behind, in which sense, those that count."""
        enough, noise = moves.sum(axis=0) >= _FEWEST, np.sqrt(self.variance)
        lags = np.where(moves | ~enough, lag, np.nan)
        least, middle, most = np.nanquantile(lags, (0.05, 0.5, 0.95), axis=0)
        width = np.maximum(np.maximum(most, -least), 0.0) * (1.0 + _KNOWN) + noise
        self.friction = np.where(enough, middle, self.friction).clip(0.0, self._hidden)
        self.width = np.where(enough, np.minimum(width, self._hidden), self.width)
        least = np.where(enough, np.maximum(least * (1.0 - _KNOWN) - noise, -self.width), 0.0)
        sum_of_turns = np.sum(turn * moves, axis=0)
        goes_on = enough & (np.abs(sum_of_turns) == moves.sum(axis=0)) & (most < self._dry)
        if np.any(self.seen & (self.width > (1.0 + _KNOWN) * self._dry)):
            self.width = np.minimum(np.max(self.width * self.seen), self._hidden)
        self._sense, self._margin = np.sign(sum_of_turns) * goes_on, self.width + least

    def pace(self) -> tuple[float, bool]:
        """Return how an arm goes that is later than it was.

        Returns:
            Share of the commanded speed at which it goes along the path that was sent, NaN if it does not; and whether
            no joint moves any more.
        """
        late, off = self._behind(0)
        later = int(late - (self._at if self.late is None else self._window[1]))
        away = self._past[0] - self.at_rest - self._sent[self._at]
        # a delay of three periods more shows why, if the arm is no more than a fifth of that way off the path
        if later < 3 or off > 0.2**2 * float(away.dot(away)):
            return math.nan, False
        # for so long an arm that stands has stood, and an arm that is slow has been slow all along
        reads = np.concatenate((self._past[0][None], self._reads[:later]))
        few, half = 1 + later // 4, later // 2
        moved = np.abs(np.mean(reads[:few], axis=0) - np.mean(reads[-few:], axis=0))
        stands = bool(np.all(moved < NOISES * np.sqrt(self.variance) / math.sqrt(few)))
        before, then = self._behind(half)[0], self._behind(later)[0]
        first, second = 1.0 - (before - then) / (later - half), 1.0 - (late - before) / half
        stops = later >= 12 and second < 0.7 * first  # as filtered readings do
        return (math.nan if stops else 1.0 - (late - then) / later), stands

    def _behind(self, ago: int) -> tuple[float, float]:
        """Periods by which a reading is behind the path that was sent, and its squared distance from that path."""
        read = self._reads[ago - 1] if ago else self._past[0]
        away = self._sent[ago:] - (read - self.at_rest)
        return _lowest(np.einsum("ij,ij->i", away, away))

    @property
    def delay(self) -> float:
        """Of the excess behind what it is by now [s], the smoothing included."""
        return self._at * self._dt + (1.0 / self.smoothing - 1.0) * self._dt


def _lowest(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return where the parabola through the least of some values and its neighbours is lowest, and its value there."""
    least = int(values.argmin())
    before, value, after = np.pad(values, 1, mode="reflect")[least : least + 3].tolist()
    bend = before - 2.0 * value + after
    step = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return least + step, value - 0.25 * (before - after) * step
