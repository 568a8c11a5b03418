"""What position servos do to a posture that is sent: they follow late, with friction, play and noisy encoders."""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np
from jaxtyping import Bool, Float

LATEST = 0.2  # [s] by which an arm may follow late: servoJ of a UR looks ahead by as much, and nothing takes longer
# samples of that motion after which lateness and friction may be known, and after which they are what they seem to be
SOONEST, LATEST_SAMPLE = 16, 50
_APART = 0.01  # [s] between two samples of that motion, and between the delays that are tried
_WIDER = 0.5  # share by which a width may be more than was seen when its joint began to move
_KNOWN = 0.25  # and than was seen in the first motion
_FEWEST = 8  # samples of a joint that count
# [N m or N] by which dry friction, of large arms, and together with play may hide what loads a joint: more is a force
DRY, HIDDEN = 6.0, 15.0
ENCODER = 1e-4  # [rad or m] standard deviation of the encoders until it is known
_STILL = 2e-4  # [rad or m] within which a joint may not have moved, whatever its encoder says
NOISES = 6.0  # standard deviations that noise does not reach in a run of hours
PACE = 0.002  # [s] by which joints follow more or less late than each other: dampers of 4 N m s/rad at 2,000 N m/rad
_ROUNDING = 1e-12  # [rad or m] of sums of steps
OFTEN = 0.004  # [s] between two looks at what changes slowly
AROUND = 0.25  # share of the delay by which it may be other than it was
# periods by which an arm is later than it was from which it shows why, and whether it is about to stand
_FEW, _MANY = 3, 12
_QUIET = 5.0  # times the median step between readings above which a step is that of a new one
_STOPS = 0.7  # share of its speed before below which an arm is about to stand
_ON_PATH = 0.2  # share of the distance by which an arm is late that it may be off the path that was sent
_DRAWS = 20.0  # variance of the third difference of independent noise, over its own: 1 + 9 + 9 + 1


def copied(thing: Any) -> Any:
    """Return a shallow copy of an object without slots, in a tenth of the time of `copy.copy`."""
    other = object.__new__(type(thing))
    other.__dict__ = thing.__dict__.copy()
    return other


@final
class History:
    """Rows of the periods that are over; none is ever changed, and what is added shares the memory of what was before.

    Args:
        size: Number of rows that are kept, zeros at first.
        width: Numbers in each.
    """

    def __init__(self, size: int, width: int):
        self._size, self._end, self._claimed = size, size, [size]
        self._table = np.zeros((4 * size, width))

    def add(self, row: Float[np.ndarray, " n"]) -> History:
        """Return the rows with another one."""
        other = copied(self)
        if self._claimed[0] != self._end or self._end == len(self._table):  # it went on otherwise from here, or is full
            other._table = np.empty_like(self._table)
            other._table[: self._size] = self.newest(self._size)
            other._end, other._claimed = self._size, [0]
        other._table[other._end] = row
        other._end += 1
        other._claimed[0] = other._end
        return other

    def back(self, k: int) -> Float[np.ndarray, " n"]:
        """Return the row k before the newest."""
        return self._table[self._end - 1 - k]

    def newest(self, k: int) -> Float[np.ndarray, "k n"]:
        """Return the newest k rows, oldest first."""
        return self._table[self._end - k : self._end]


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
        latency: By how much the arm may follow late at the most [s]; None for `LATEST`.
        hidden: shape (nv,), largest widths [rad or m].

    Attributes:
        late: Delay that was measured [s], or None.
        width: shape (nv,) [rad or m].
        seen: shape (nv,), joints that were seen to move.
        friction: shape (nv,), by how much a joint was behind when it was measured, the median [rad or m].
        raw: shape (nv,), how far the arm is from the posture that it seems to follow, and
        range: between which bounds of it there is no force, of the newest reading [rad or m].
        noise: shape (nv,), standard deviation of the encoders [rad or m].
        sees: shape (nv,), joints whose excess says something of forces: they were seen to move, or were not sent far,
            or are farther away than friction takes.
        is_known: Whether the first motion has told what it can.
        at_rest: shape (nv,), how far the joints were from where they were sent before they moved [rad or m].
        every: Periods from one new reading to the next, as the first motion showed; 1 if each is new.
    """

    def __init__(self, dt: float, latency: float | None, hidden: Float[np.ndarray, " nv"]):
        self._dt, self._hidden = dt, hidden
        self._pace, self._often = max(1, round(PACE / dt)), max(1, round(OFTEN / dt))
        # periods back that are tried, and that there are rows for
        self._longest = math.ceil(((LATEST if latency is None else latency) + max(PACE, OFTEN)) / dt - 1e-9) + 1
        self._longest -= max(self._pace, self._often)
        self._size = self._longest + 2 + max(self._pace, self._often, round(2.0 * LATEST / dt))
        self._own = PACE / dt  # periods
        self._stride = max(1, round(_APART / dt))
        lags = np.arange(0.0, LATEST + 0.5 * _APART, max(_APART, dt))
        self._lags = np.unique(np.minimum(np.round(lags / dt).astype(np.int64), self._longest))
        # until the noise is known, the mean of some periods at 1 kHz
        self._smoothing = dt / (dt + 0.004)
        self.forget()

    def forget(self) -> None:
        """Begin anew, from a posture at rest."""
        nv = len(self._hidden)
        self.late, self.noise, self.is_known = None, np.full(nv, ENCODER), False
        self.width = self._hidden.copy()
        # way of the commanded posture since the beginning, and what was read; of the periods that are over, too
        self.way, self._read, self._since, self._over = np.zeros(nv), np.zeros(nv), 0.0, 0
        self._ways, self._reads = History(self._size, nv), History(self._size, nv)
        self._window = 0, self._longest
        self._at = 0  # periods by which the arm seems to be late now
        self._excess = np.zeros(nv)
        self.seen, self._all_seen = np.zeros(nv, dtype=bool), False
        self.friction = np.zeros(nv)
        self.raw, self.range, self._newest = np.zeros(nv), (np.zeros(nv), np.zeros(nv)), np.zeros(nv)
        # x as friction would have it, the sense in which a joint went when it was measured, and its least lag then
        self._place, self._sense, self._least = np.zeros(nv), np.zeros(nv), np.zeros(nv)
        self.at_rest, self._rests = np.zeros(nv), 0  # where the arm is at rest, the mean of so many readings
        self._past, self._square = tuple[np.ndarray, ...](), np.full(nv, ENCODER**2)
        self._samples: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...] = ()
        self.moving, self._counted = 0.0, 0
        # periods since a reading was another than the one before, and the largest step between two that are the same
        self._same, self._quiet, self.every = 0, -1.0, 1.0
        self._steps: tuple[float, ...] = ()  # from reading to reading, in the first motion

    def moved(self, step: Float[np.ndarray, " nv"], time: float, moves: bool) -> bool:
        """Take note of a step of the commanded posture [rad or m] and how long it took [s]; whether a period is over.

        A call that came early takes a part of the step before back, which the arm may have made.
        """
        before, self.way = self.way, self.way + step
        self._since += time
        over = self._since > 0.99 * self._dt or time < 0.0
        if over:
            self._since, self._over = 0.0, self._over + 1
            self._ways, self._reads = self._ways.add(before), self._reads.add(self._read)
            if moves:
                self.moving += self._dt
                self._counted += 1
        return over

    def copied(self) -> Servos:
        """Return a copy; nothing that it is made of is changed in place."""
        return copied(self)

    def _sent(self, k: int) -> Float[np.ndarray, " nv"]:
        """Return the way of the commanded posture k periods ago."""
        return self._ways.back(k - 1) if k else self.way

    def _path(self, least: int, most: int) -> Float[np.ndarray, "k nv"]:
        """Return the ways of `least` to `most` periods ago."""
        rows = self._ways.newest(most)[::-1]
        return rows[least - 1 :] if least else np.concatenate((self.way[None], rows))

    @property
    def has_looked(self) -> bool:
        """Whether this period is one in which what changes slowly is looked at, all of it in the same."""
        return self._over % self._often == 1 % self._often

    def gone(self, periods: int) -> Float[np.ndarray, " nv"]:
        """How far the commanded posture has moved in the last periods [rad or m]."""
        return self.way - self._sent(min(periods, self._size - 1))

    @property
    def moved_lately(self) -> Float[np.ndarray, " nv"]:
        """How far the commanded posture has moved within the longest delay that there may be."""
        return np.abs(self._ways.newest(self._window[1]) - self.way).max(axis=0, initial=0.0)

    def excess(self, distance: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
        """How far the arm is from where the servos may have brought it, by how far it is from where it was sent."""
        y, (least, most) = self.way + distance, self._window
        self._count(y)
        self._read = y
        if not self.is_known:
            sent = self._path(least, most)
            # a joint that was not seen to move is behind by no more than it was sent
            high = np.where(self.seen, self.width, np.minimum(np.abs(sent).max(axis=0), self.width))
            raw = y - sent
            high = high + np.abs(self.way - self._sent(self._pace)) * (self._own / self._pace) + _ROUNDING
            low = -high
            away = raw - np.minimum(np.maximum(raw, low), high)
            nearest = int(np.einsum("ij,ij->i", away, away).argmin())
            raw, excess, self._at = raw[nearest], away[nearest], least + nearest
            self._look(y, sent[nearest])
        else:
            c = self._sent(self._at)
            raw = y - c
            if self._over % self._often == 0:
                self._look_again(y, c)
            low, high, path, square = self._bounds
            excess = raw - np.minimum(np.maximum(raw, low), high)
            if square > 0.0:  # the delay is known to within that path
                share = min(max(float(excess.dot(path)) / square, -0.5), 0.5)
                if share != 0.0:
                    raw = raw - share * path
                    excess = raw - np.minimum(np.maximum(raw, low), high)
        self.raw, self.range, self._newest = raw, (low, high), excess
        self._excess = self._excess + self._smoothing * (excess - self._excess)
        return self._excess

    @property
    def repeats(self) -> bool:
        """True if the newest reading is an old one, because readings come more slowly than they are asked for."""
        return 0 < self._same < 1.5 * self.every - 1.0

    def _count(self, y: np.ndarray) -> None:
        """Count how often a reading is another than the one before."""
        if self.is_known and self.every == 1.0 or not self.moving:
            return
        step = float(np.linalg.norm(y - self._read))
        self._same = self._same + 1 if step <= self._quiet else 0
        if not self.is_known:
            self._steps = (*self._steps, step)

    def _find_readings(self) -> None:
        """Find how often readings are new: then steps are far larger than between, and make up the motion."""
        steps = np.array(self._steps)
        self._quiet = _QUIET * float(np.median(steps)) + _ROUNDING
        new = np.flatnonzero(steps > self._quiet)
        if len(new) > 2 and float(steps[new].sum()) > 0.5 * float(np.linalg.norm(self._read - self.at_rest)):
            self.every = float(new[-1] - new[0]) / (len(new) - 1)
        self._steps = ()

    @property
    def sees(self) -> Bool[np.ndarray, " nv"]:
        """See the class."""
        return self.seen if self._all_seen else self.seen | (self.range[1] < _STILL) | (self._newest != 0.0)

    def _look_again(self, y: np.ndarray, c: np.ndarray) -> None:
        """Between which distances there is no force, and the path within which the delay is known."""
        least, most = self._window
        path = self._sent(least) - self._sent(most)
        own = np.abs(path) * self._share + _ROUNDING  # each joint follows at a pace of its own
        self._place = np.minimum(np.maximum(self._place, c - self.width), c + self.width)
        # a joint that goes on as it did when friction was measured is behind by as much
        goes = (c - self._place) * self._sense > 0.99 * self.width
        low, high = goes * self._nearer[0] - self.width, self.width - goes * self._nearer[1]
        if not self._all_seen:
            self._look(y, c)
            reach = np.minimum(np.abs(c) + np.abs(c - self._sent(self._at + self._often)), self.width)
            low, high = np.where(self.seen, low, -reach), np.where(self.seen, high, reach)
        self._bounds = low - own, high + own, path, float(path.dot(path))

    def _look(self, y: np.ndarray, c: np.ndarray) -> None:
        """Learn noise, widths and the delay from a reading."""
        if not self.moving:
            self._rests += 1
            self.at_rest = self.at_rest + (y - self.at_rest) / self._rests
        if not self.is_known:
            past = self._past
            if len(past) == 3:
                change = y - past[0] + 3.0 * (past[1] - past[2])
                self._square = self._square + 0.02 * (change * change / _DRAWS - self._square)
                self.noise = np.sqrt(self._square)
            self._past = (*past[-2:], y)
        gone = (y - self.at_rest) * np.sign(c)
        new = ~self.seen & (gone > NOISES * self.noise + _STILL) & (np.abs(c) > _STILL)
        if new.any():
            self.friction = np.where(new, np.minimum(np.abs(c) - gone, self._hidden).clip(0.0), self.friction)
            self.width = np.where(new, np.minimum((1.0 + _WIDER) * self.friction, self._hidden), self.width)
            # what is more than friction is play, within which the other joints take each to and fro
            if np.any(new & (self.friction > DRY / HIDDEN * self._hidden + _STILL)):
                self.width = self._hidden.copy()
            self.seen = self.seen | new
            self._all_seen = bool(self.seen.all())
        if self.is_known:
            return
        if self._counted >= self._stride and self.seen.any():
            self._counted = 0
            sent = self._path(0, self._longest)[self._lags]
            self._samples = (*self._samples, (y - self.at_rest, sent, self.seen))
            if len(self._samples) >= SOONEST and len(self._samples) % 4 == 0:
                self._fit()

    def _fit(self) -> None:
        """The delay for which what is left varies least, and the widths with it: all that the first motion can tell."""
        y, sent, seen = (np.array(part[-LATEST_SAMPLE:]) for part in zip(*self._samples, strict=True))
        step = np.sign(sent[:, :-1] - sent[:, 1:])
        sense = step[:, :1]
        counts = np.all(step * sense >= 0.0, axis=1) & (sense[:, 0] != 0.0) & seen  # of a joint that never turned
        counts &= counts.sum(axis=0) >= _FEWEST
        n, noise = counts.sum(axis=0), float(np.mean(self._square))
        if not n.any():
            return
        behind = sense * (sent[:, :-1] - y[:, None]) * counts[:, None]
        left = np.sum((behind - behind.sum(axis=0) / np.maximum(n, 1)) ** 2 * counts[:, None], axis=(0, 2)) / n.sum()
        best = int(left.argmin())
        beside = min(left[max(best - 2, 0)] if best > 1 else np.inf, left[best + 2] if best + 2 < len(left) else np.inf)
        told = beside - left[best] > noise + (0.5 * _STILL) ** 2 and left[best] < (3.0 * math.sqrt(noise) + _STILL) ** 2
        if not (told or len(self._samples) >= LATEST_SAMPLE):
            return
        place = _lowest(left, best)[0]
        at = min(int(place), len(self._lags) - 2)
        share = place - at
        pace = self._own / float(self._lags[at + 1] - self._lags[at])
        between = (1.0 - share) * sent[:, at] + share * sent[:, at + 1]
        moves = (step[:, at] != 0.0) & seen
        self.friction, self.width = self.friction.copy(), self.width.copy()
        self._sense, self._least = self._sense.copy(), self._least.copy()
        for j in np.flatnonzero(moves.sum(axis=0) >= _FEWEST).tolist():
            rows = moves[:, j]
            own = np.abs(sent[:, at, j] - sent[:, at + 1, j]) * pace
            lag = (step[:, at, j] * (between - y)[:, j])[rows]
            lag = np.sign(lag) * np.maximum(np.abs(lag) - own[rows], 0.0)
            least, self.friction[j], most = np.quantile(lag, (0.05, 0.5, 0.95)).tolist()
            self.width[j] = min(max(most, -least, 0.0) * (1.0 + _KNOWN) + self.noise[j], self._hidden[j])
            turns = np.unique(step[rows, at, j])
            self._sense[j] = turns[0] if len(turns) == 1 and most < DRY / HIDDEN * self._hidden[j] else 0.0
            self._least[j] = max(least * (1.0 - _KNOWN) - self.noise[j], -self.width[j])
        self.friction = np.clip(self.friction, 0.0, self._hidden)
        if np.any(self.seen & (self.width > (1.0 + _KNOWN) * DRY / HIDDEN * self._hidden)):
            self.width = np.minimum(np.max(self.width * self.seen), self._hidden)
        lag = float(np.interp(place, np.arange(len(self._lags)), self._lags))  # periods
        self.is_known, around = True, math.ceil(AROUND * lag) + 1
        self._find_readings()
        self._samples, self._past = (), ()
        self._at, self.late = round(lag), lag * self._dt
        self._window = max(0, self._at - around), min(self._window[1], self._at + around)
        self._share = self._own / (self._window[1] - self._window[0])
        nearer = self.width + self._least
        self._nearer = np.where(self._sense < 0.0, nearer, 0.0), np.where(self._sense > 0.0, nearer, 0.0)
        self._place = self._sent(self._at)
        self._bounds = -self.width, self.width, np.zeros_like(self.width), 0.0

    def smooth(self, periods: float) -> None:
        """Take the mean of about so many readings."""
        self._smoothing = 1.0 / max(1.0, periods)

    def pace(self) -> tuple[float, bool]:
        """Return how an arm goes that is later than it was.

        Returns:
            Share of the commanded speed at which it goes along the path that was sent, NaN if it does not; and whether
            no joint moves any more.
        """
        late, off = self._behind(0)
        later = int(late - (self._window[1] if self.is_known else self._at))
        away = self._read - self.at_rest - self._sent(self._at)
        if later < _FEW or off > _ON_PATH * _ON_PATH * float(away.dot(away)):
            return math.nan, False
        # for so long an arm that stands has stood, and an arm that is slow has been slow all along
        reads = np.concatenate((self._reads.newest(later), self._read[None]))
        few, half = 1 + later // 4, later // 2
        moved = np.abs(np.mean(reads[-few:], axis=0) - np.mean(reads[:few], axis=0))
        stands = bool(np.all(moved < NOISES * self.noise / math.sqrt(few)))
        before, then = self._behind(half)[0], self._behind(later)[0]
        first, second = 1.0 - (before - then) / (later - half), 1.0 - (late - before) / half
        stops = later >= _MANY and second < _STOPS * first  # as filtered readings do
        return (math.nan if stops else 1.0 - (late - then) / later), stands

    def _behind(self, ago: int) -> tuple[float, float]:
        """Periods by which a reading is behind the path that was sent, and its squared distance from that path."""
        read = self._reads.back(ago - 1) if ago else self._read
        away = self._path(ago, self._size - 1) - (read - self.at_rest)
        square = np.einsum("ij,ij->i", away, away)
        return _lowest(square, int(square.argmin()))

    @property
    def delay(self) -> float:
        """Of the excess behind what it is by now [s], the smoothing included."""
        return self._at * self._dt + (1.0 / self._smoothing - 1.0) * self._dt


def _lowest(values: Float[np.ndarray, " n"], least: int) -> tuple[float, float]:
    """Return where the parabola through the least of some values and its neighbours is lowest, and its value there."""
    if not 0 < least < len(values) - 1:
        return float(least), float(values[least])
    before, value, after = values[least - 1 : least + 2].tolist()
    bend = before - 2.0 * value + after
    step = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return least + step, value - 0.25 * (before - after) * step
