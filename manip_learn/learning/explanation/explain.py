"""A few hypotheses and free motion explain the recordings: propose, assign, test, until nothing gains enough.

Proposed are the rows that windows, recordings, pairs of either, and everything use least.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import NamedTuple, TypeVar, final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.learning.explanation.evidence import (
    CHANGE_SECONDS,
    SCALES,
    SWITCH_NATS,
    HeldScale,
    evidence,
    gains_of,
    held_by,
    states_of,
)
from manip_learn.learning.explanation.row_motion import RowMotion, View, broken_energy
from manip_learn.learning.samples import SHORT_WINDOWS_SECONDS
from manip_learn.linalg import row_space_angle

# [nats] least gain of a hypothesis, without its best supporter and after the price of its parameters. Set by hand, on
# sets with seeds below 20000
LEAST_GAIN_NATS = 40.0
# samples that determine rows, for each direction of the features. Set by hand
SAMPLES_PER_DIRECTION = 3
# [s] lengths of windows that are taken in pairs, for one on a curved surface fits many rows. Set by hand
LONG_WINDOWS_SECONDS = (1.2, 2.0)
# ratio of the next level to the s-th from which a window proposes s rows. Set by hand
PROPOSAL_GAP = 2.5

STRIDE = 0.5  # share of a window's length by which one starts after the other
MOST_PAIRED = 60  # windows that are taken in pairs
# recordings, and pairs of them, that are taken at most: more propose the same rows again
MOST_ALONE, MOST_PAIRS = 16, 24
# windows, and pairs of them, that propose s rows, those with the clearest gaps
_MOST = 100
# rows closer together than this are one proposal [rad]
_SAME = np.radians(3.0)

# keeps what does not move at all positive definite
TINY = 1e-200
MOST_CONSTRAINTS = 6  # of one set of recordings: more would be one for each few stretches
# hypotheses that are tested in a row without one that passes
MOST_TESTED = 6
# scales with which proposals are compared: rows of a window are off by degrees, those of a recording hardly
FIRST_SCALES = (HeldScale(2.0, 0.1), HeldScale(2.0, 0.01))
# proposals of each view and number of rows that are fitted, the turns of a fit, and the turns of all together
_KEPT, TURNS, SETTLING = 4, 4, 4
# numbers of the evidence of samples for hypotheses that are held in memory at a time: 16 MB, and as much again a few
# times over on the way
AT_ONCE = 2**21


class Moments(NamedTuple):
    """Sums over w windows or recordings, sum r r^T and sum Phi Phi^T, the variance of the noise [(rad/s)^2] and the
    trajectory of each.
    """

    M: Float[np.ndarray, "w r r"]
    S: Float[np.ndarray, "w r r"]
    noise: Float[np.ndarray, " w"]
    trajectory: Int[np.ndarray, " w"]

    def chosen(self, numbers: Int[np.ndarray, " k"]) -> Moments:
        """Some of them."""
        return Moments(*(one[numbers] for one in self))

    def paired(self, first: Int[np.ndarray, " k"], second: Int[np.ndarray, " k"]) -> Moments:
        """Sums over two together."""
        noise = 0.5 * (self.noise[first] + self.noise[second])
        return Moments(self.M[first] + self.M[second], self.S[first] + self.S[second], noise, self.trajectory[first])


def proposed(
    motion: RowMotion, states: Int[np.ndarray, " n"], largest: int, *, whole: bool = False
) -> dict[int, Float[np.ndarray, "h s r"]]:
    """Rows for each number of rows s = 1 .. largest, orthonormal.

    Each window or recording solves M x = lambda S x with M = sum r r^T and S = sum Phi Phi^T, whose s least
    eigenvectors are the s rows that its motion uses least. Windows are of motion not explained yet (state 0);
    recordings and pairs of them are of each state by itself, so that rows may be added to an explanation, or it may be
    divided.

    `states` tell what explains each chosen sample. Where a recording is one state throughout (`whole`), no window says
    more than it.
    """
    out: dict[int, list[np.ndarray]] = {s: [] for s in range(1, largest + 1)}
    wholes = [part for k in range(int(states.max(initial=0)) + 1) for part in _recordings(motion, states == k)]
    windows = [] if whole else _windows(motion, states == 0)
    for parts, most in ((wholes, None), (windows, _MOST)):
        if not sum(len(part.M) for part in parts):
            continue
        sizes, directions = least_used(Moments(*map(np.concatenate, zip(*parts, strict=True))))
        for s, kept in out.items():
            gap = sizes[:, s] / sizes[:, s - 1]
            chosen = np.flatnonzero(gap > PROPOSAL_GAP)
            chosen = chosen[np.argsort(-gap[chosen])][:most]
            kept.append(np.linalg.qr(directions[chosen, :s].transpose(0, 2, 1))[0].transpose(0, 2, 1))
    joined = {s: np.concatenate(kept) for s, kept in out.items() if kept}
    return {s: rows[distinct(rows)] for s, rows in joined.items() if len(rows)}


def distinct(rows: Float[np.ndarray, "h s r"], most: int | None = None) -> list[int]:
    """The first few of orthonormal rows whose row spaces differ."""
    h, s, r = rows.shape
    projectors = (rows.transpose(0, 2, 1) @ rows).reshape(h, r * r)
    # tr(P1 P2) is the sum of the squared cosines of the principal angles
    apart = s - projectors @ projectors.T > np.sin(_SAME) ** 2
    left, kept = np.arange(h), list[int]()
    while len(left) and (most is None or len(kept) < most):  # what falls: the number of those that are left
        kept.append(int(left[0]))
        left = left[1:][apart[left[0], left[1:]]]
    return kept


def _windows(motion: RowMotion, chosen: Bool[np.ndarray, " n"]) -> list[Moments]:
    """Windows of these samples, and windows of two recordings together."""
    motion = dataclasses.replace(motion, weight=motion.weight * chosen)
    parts, long = ([_window_moments(motion, SHORT_WINDOWS_SECONDS)], _window_moments(motion, LONG_WINDOWS_SECONDS))
    if len(long.M) > 1:
        sizes, _ = least_used(long)
        long = long.chosen(np.argsort(-np.max(sizes[:, 1:] / sizes[:, :-1], axis=1))[:MOST_PAIRED])
        first, second = np.triu_indices(len(long.M), 1)
        apart = long.trajectory[first] != long.trajectory[second]
        parts.append(long.paired(first[apart], second[apart]))
    return parts


def _recordings(motion: RowMotion, chosen: Bool[np.ndarray, " n"]) -> list[Moments]:
    """These samples of each recording, of pairs of recordings, and of all."""
    starts, weight = motion.first[:-1], motion.weight * chosen
    spans = [slice(a, b) for a, b in pairwise(motion.first)]
    M = np.stack([(motion.rates[own].T * weight[own]) @ motion.rates[own] for own in spans])
    S = np.stack([np.tensordot(weight[own], motion.gram[own], axes=1) for own in spans])
    shown = np.flatnonzero(np.add.reduceat(weight, starts) > 0.0)
    if not len(shown):
        return []
    each = Moments(M, S, motion.noise[starts], np.arange(len(M)))
    few = shown[:: max(1, len(shown) // MOST_ALONE)]
    pairs = np.array(list(combinations(few, 2)), dtype=np.int64).reshape(-1, 2)
    pairs = pairs[:: max(1, -(-len(pairs) // MOST_PAIRS))]
    together = Moments(M.sum(axis=0)[None], S.sum(axis=0)[None], each.noise[shown].mean()[None], np.zeros(1, np.int64))
    return [each.chosen(few), each.paired(pairs[:, 0], pairs[:, 1]), together]


def least_used(moments: Moments) -> tuple[Float[np.ndarray, "w r"], Float[np.ndarray, "w r r"]]:
    """Levels of all directions of each window, least first and at least the noise, and the directions as rows."""
    M, S = moments.M, moments.S
    r = M.shape[1]
    floor = np.maximum(1e-9 * np.trace(S, axis1=1, axis2=2)[:, None, None] / r, TINY) * np.eye(r)
    inverse = np.linalg.inv(np.linalg.cholesky(S + floor))
    values, vectors = np.linalg.eigh(inverse @ M @ inverse.transpose(0, 2, 1))
    directions = np.matmul(vectors.transpose(0, 2, 1), inverse)  # rows x with x S x^T = 1
    return np.sqrt(np.maximum(values, moments.noise[:, None])), directions


def _window_moments(motion: RowMotion, lengths: Sequence[float]) -> Moments:
    """M and S of each window that moves, and the variance of its noise."""
    r = motion.rates.shape[1]
    parts, numbers = [np.zeros((0, 2 * r * r + 3))], [np.zeros(0, dtype=np.int64)]
    for i in range(motion.n_trajectories):
        one = motion.of_recordings(i, i + 1)
        n, time = len(one), one.time
        products = (one.rates[:, :, None] * one.rates[:, None, :]).reshape(n, -1)
        columns = np.column_stack([products, one.gram.reshape(n, -1), one.noise, one.moving, np.ones(n)])
        total = np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(columns * one.weight[:, None], axis=0)])
        for length in lengths:
            starts = np.arange(time[0], max(time[-1] - length, time[0]) + 1e-9, STRIDE * length)
            low, high = np.searchsorted(time, starts), np.searchsorted(time, starts + length)
            sums = total[high] - total[low]
            kept = (sums[:, -2] > 0.5 * length) & (sums[:, -1] > 0.8 * length) & (high - low > 2 * r)
            parts.append(sums[kept])
            numbers.append(np.full(np.count_nonzero(kept), i))
    sums = np.concatenate(parts)
    M, S = sums[:, : r * r].reshape(-1, r, r), sums[:, r * r : 2 * r * r].reshape(-1, r, r)
    noise = sums[:, 2 * r * r] / np.maximum(sums[:, -1], 1e-12)
    return Moments(M, S, noise, np.concatenate(numbers))


_Key = TypeVar("_Key", bound=Hashable)


@final
@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Rows that are zero in some samples.

    Attributes:
        view: Number of the view.
        rows: Whitened, orthonormal, shape (s, r).
        scale: How large velocities along them are.
        gains: Evidence of each recording beyond the other explanations [nats], shape (g,).
    """

    view: int
    rows: Float[np.ndarray, "s r"]
    scale: HeldScale
    gains: Float[np.ndarray, " g"]

    @property
    def n_rows(self) -> int:
        """Number of rows s."""
        return len(self.rows)

    @property
    def support(self) -> float:
        """Gain without the best supporter's, where there are several recordings [nats]."""
        return float(supports_of(self.gains[:, None])[0])

    def price(self, seconds: float) -> float:
        """Of the s (r - s) parameters of Lambda, learnt from this much motion (G. Schwarz, 1978) [nats]."""
        s, r = self.rows.shape
        return 0.5 * s * (r - s) * float(np.log(max(seconds / CHANGE_SECONDS, 2.0)))

    def worth(self, seconds: float) -> float:
        """Support less the price [nats]."""
        return self.support - self.price(seconds)


def supports_of(gains: Float[np.ndarray, "g h"]) -> Float[np.ndarray, " h"]:
    """Gain of the recordings beside the best supporter; all of a single recording."""
    return gains.sum(axis=0) - (gains.max(axis=0) if len(gains) > 1 else 0.0)


# (view, hypothesis, which chosen samples it explains) -> whether to believe it
Test = Callable[[View, Hypothesis, Bool[np.ndarray, " n"]], bool]


@final
class Explanation:
    """Hypotheses that together explain the recordings; a change of state costs `switch` nats.

    Attributes:
        states: Of each chosen sample: 0 free motion, k the k-th hypothesis.
        gains: Of each recording and hypothesis, beyond the best other explanation [nats].
        refused: Hypotheses that gained enough and were not believed, in the order of their test.
    """

    def __init__(self, views: Sequence[View], hypotheses: Sequence[Hypothesis] = (), switch: float = SWITCH_NATS):
        self.views, self.hypotheses, self.switch = views, tuple(hypotheses), switch
        self.thin = views[0].thin
        self.values = _evidence_of([v.thin for v in views], self.hypotheses)[:, :, 0]
        self.states = states_of(self.values, self.thin.first, switch)
        gains = np.zeros((self.thin.n_trajectories, len(hypotheses)))
        for k in range(len(hypotheses)):
            gain = np.where(self.states == k + 1, self.values[:, k] - self.others(k), 0.0)
            gains[:, k] = np.bincount(self.thin.trajectory, gain, minlength=len(gains))
        self.gains = gains
        self.refused: tuple[Hypothesis, ...] = ()

    def fine_states(self) -> Int[np.ndarray, " n"]:
        """State of each sample of the views' full motion."""
        values = _evidence_of([v.motion for v in self.views], self.hypotheses)[:, :, 0]
        return states_of(values, self.views[0].motion.first, self.switch)

    def others(self, k: int) -> Float[np.ndarray, " n"]:
        """Evidence of each sample for the best explanation beside the k-th hypothesis; 0 is free motion."""
        rest = np.delete(self.values, k, axis=1)
        return np.maximum(np.max(rest, axis=1, initial=0.0), 0.0)

    @property
    def explained(self) -> Float[np.ndarray, " n"]:
        """Evidence of each sample for what explains it."""
        values = np.concatenate([np.zeros((len(self.values), 1)), self.values], axis=1)
        return values[np.arange(len(values)), self.states]

    @property
    def supports(self) -> Float[np.ndarray, " k"]:
        """Of each hypothesis, beyond the others [nats]."""
        return supports_of(self.gains)

    @property
    def has_twins(self) -> bool:
        """Whether two hypotheses differ by less than each leaves open itself: a row that moves by a share of the free
        rows' velocity is one whose direction changes by that angle.
        """
        pairs = combinations(enumerate(self.hypotheses), 2)
        return any(self.angle(i, j) < a.scale.share + b.scale.share for (i, a), (j, b) in pairs)

    def angle(self, i: int, j: int) -> float:
        """Between the rows of two hypotheses; a right one where they are not of the same view and number [rad]."""
        one, other = self.hypotheses[i], self.hypotheses[j]
        if one.view != other.view:
            return 0.5 * np.pi
        motion = self.views[one.view].motion
        return row_space_angle(motion.selection(one.rows), motion.selection(other.rows))

    def with_one_more(self, hypothesis: Hypothesis) -> Explanation:
        """All hypotheses and one more, each fitted to the samples that it explains best, in turns."""
        best = now = Explanation(self.views, (*self.hypotheses, hypothesis), self.switch)
        for _ in range(SETTLING):
            fitted = [now._refitted(k, h) for k, h in enumerate(now.hypotheses)]
            now = Explanation(self.views, fitted, self.switch)
            # a soft fit also accepts free motion, and so becomes softer with each turn
            if float(now.explained.sum()) <= float(best.explained.sum()):
                break
            best = now
        return best

    def without_idle(self) -> Explanation:
        """Without hypotheses whose samples the others explain as well."""
        now = self  # what falls: the number of its hypotheses
        while len(now.hypotheses) > 1 and np.min(now.supports) < LEAST_GAIN_NATS:
            idle = int(np.argmin(now.supports))
            now = Explanation(now.views, [h for k, h in enumerate(now.hypotheses) if k != idle], now.switch)
        return now

    def plainest(self) -> Explanation:
        """Each hypothesis in the first view in which as many rows explain no less, their price considered."""
        now, seconds = self, float(self.thin.weight.sum())
        for k, h in enumerate(self.hypotheses):
            for number, view in enumerate(self.views[: h.view]):
                if view.largest < h.n_rows:
                    continue
                width = view.thin.rates.shape[1]
                plain = dataclasses.replace(h, view=number, rows=np.eye(h.n_rows, width))
                others = now.hypotheses
                fitted = (*others[:k], now._refitted(k, plain), *others[k + 1 :])
                trial = Explanation(now.views, fitted, now.switch)
                saved = h.price(seconds) - plain.price(seconds)
                if float(trial.explained.sum()) + saved >= float(now.explained.sum()):
                    now = trial
                    break
        return now

    def _refitted(self, k: int, start: Hypothesis) -> Hypothesis:
        """The start, fitted to the samples that the k-th hypothesis explains."""
        held = self.states == k + 1
        baseline = np.where((self.states > 0) & ~held, self.others(k), 0.0)
        return _again(self.views, [start], held[:, None], baseline, self.switch)[0]


def explain(views: Sequence[View], believed: Test, switch: float = SWITCH_NATS) -> Explanation:
    """Add one hypothesis after the other, as long as one gains enough and is believed.

    Proposals come from windows of unexplained motion, and from recordings and pairs of them in each state; so a
    new hypothesis may explain more, hold more rows than an old one or divide it. Then all compete for every sample, and
    what the others explain as well is dropped.

    The plainest feature map comes first among the views. At an infinite price of a change recordings are taken as a
    whole.
    """
    now, refused = Explanation(views, (), switch), list[Hypothesis]()
    seconds = float(views[0].thin.weight.sum())
    # What falls: the turns that are left, for a better hypothesis may replace others, and be replaced by one alike. Of
    # 378 sets of benchmarks/fits_end.py none takes more than seven.
    for _ in range(MOST_CONSTRAINTS * MOST_TESTED):
        is_full = len(now.hypotheses) >= MOST_CONSTRAINTS
        gaining = [] if is_full else [h for h in candidates(now) if h.worth(seconds) > LEAST_GAIN_NATS]
        accepted, tested = None, 0
        for h in sorted(gaining, key=lambda h: -h.worth(seconds)):
            if tested == MOST_TESTED or any(_similar(h, r) for r in refused):
                continue
            trial, tested = now.with_one_more(h), tested + 1
            if trial.supports[-1] > LEAST_GAIN_NATS and not trial.has_twins:
                held = trial.states == len(trial.hypotheses)
                if believed(views[h.view], trial.hypotheses[-1], held):
                    accepted = trial.without_idle()
                    break
            refused.append(h)
        if accepted is None:
            break
        # what a better one has replaced would otherwise be found, and replace that one, again and again
        refused += [h for h in now.hypotheses if not any(_similar(h, other) for other in accepted.hypotheses)]
        now = accepted
    now = now.plainest()
    while now.has_twins:  # that were in two views before; what falls: the number of hypotheses
        weakest = int(np.argmin(now.supports))
        rest = [h for k, h in enumerate(now.hypotheses) if k != weakest]
        now = Explanation(views, rest[:-1], switch).with_one_more(rest[-1])
    now.refused = tuple(refused)
    return now


def candidates(now: Explanation) -> list[Hypothesis]:
    """The proposals that gain most beyond the explanation so far, of each view and number of rows, fitted."""
    baseline, whole, tried, chosen = now.explained, bool(np.isinf(now.switch)), list[Hypothesis](), list[Hypothesis]()
    for number, view in enumerate(now.views):
        for rows in proposed(view.thin, now.states, view.largest, whole=whole).values():
            tried += [Hypothesis(number, one, SCALES[0], np.zeros(0)) for one in rows]
    gains = _gains(now.views, tried, FIRST_SCALES, baseline, now.switch)
    supports = np.max([supports_of(of_scale) for of_scale in np.moveaxis(gains, 2, 0)], axis=0)
    for _, numbers in _grouped((h.view, h.n_rows) for h in tried):
        order = sorted((i for i in numbers if supports[i] > 0.0), key=lambda i: -supports[i])
        rows = np.stack([tried[i].rows for i in order]) if order else np.zeros((0, 1, 1))
        chosen += [tried[order[i]] for i in distinct(rows, _KEPT)]
    return _fitted(now.views, chosen, baseline, now.switch)


def _fitted(
    views: Sequence[View], starts: Sequence[Hypothesis], baseline: Float[np.ndarray, " n"], switch: float
) -> list[Hypothesis]:
    """Each fitted to the samples that it explains, in turns with its scale; the best of its turns."""
    best = _scaled(views, starts, baseline, switch)
    going = list(range(len(best)))
    for _ in range(TURNS):
        if not going:
            break
        now = [best[i] for i in going]
        held = np.empty((len(baseline), len(now)), dtype=bool)
        for _, own, thin in _batches(views, len(now)):
            values = _evidence_of(thin, now)[:, :, 0] - baseline[own, None]
            held[own] = held_by(values, thin[0].first, switch)
        again = zip(going, _again(views, now, held, baseline, switch), strict=True)
        better = {i: h for i, h in again if h.gains.sum() > best[i].gains.sum()}
        best = [better.get(i, h) for i, h in enumerate(best)]
        going = list(better)
    return best


def _batches(views: Sequence[View], width: int) -> Iterator[tuple[slice, slice, list[RowMotion]]]:
    """Neighbouring recordings, as many as make a table of this width no larger than AT_ONCE: which ones, their samples,
    and what these are in each view.
    """
    first, start = views[0].thin.first, 0  # what falls: the recordings from the start on
    while start + 1 < len(first):
        most = int(first[start]) + AT_ONCE // max(width, 1)
        end = max(start + 1, int(np.searchsorted(first, most, side="right")) - 1)
        motions = [v.thin.of_recordings(start, end) for v in views]
        yield slice(start, end), slice(int(first[start]), int(first[end])), motions
        start = end


def _gains(
    views: Sequence[View],
    hypotheses: Sequence[Hypothesis],
    scales: Sequence[HeldScale],
    baseline: Float[np.ndarray, " n"],
    switch: float,
) -> Float[np.ndarray, "g h k"]:
    """Gain of each recording over the baseline by each hypothesis under each of the scales."""
    h, k = len(hypotheses), len(scales)
    gains = np.zeros((views[0].thin.n_trajectories, h, k))
    for recordings, own, motions in _batches(views, h * k) if h else ():
        n = len(motions[0])
        values = _evidence_of(motions, hypotheses, scales) - baseline[own, None, None]
        gains[recordings] = gains_of(values.reshape(n, -1), motions[0].first, switch).reshape(-1, h, k)
    return gains


def _evidence_of(
    motions: Sequence[RowMotion], hypotheses: Sequence[Hypothesis], scales: Sequence[HeldScale] | None = None
) -> Float[np.ndarray, "n h k"]:
    """Evidence of each sample for each hypothesis under some scales, by default under its own.

    The motions are those of the same samples in each view.
    """
    values = np.empty((len(motions[0]), len(hypotheses), len(scales or SCALES[:1])))
    for (view, s, own), numbers in _grouped((h.view, h.n_rows, () if scales else (h.scale,)) for h in hypotheses):
        energy = broken_energy(motions[view], np.stack([hypotheses[i].rows for i in numbers]))
        values[:, numbers] = evidence(motions[view], energy, s, scales or own)
    return values


def _grouped(keys: Iterable[_Key]) -> list[tuple[_Key, list[int]]]:
    """Places of the same key: what is the same for all of them is computed once."""
    out: dict[_Key, list[int]] = {}
    for i, key in enumerate(keys):
        out.setdefault(key, []).append(i)
    return list(out.items())


def _again(
    views: Sequence[View],
    hypotheses: Sequence[Hypothesis],
    held: Bool[np.ndarray, "n h"],
    baseline: Float[np.ndarray, " n"],
    switch: float,
) -> list[Hypothesis]:
    """Each fitted to its held samples, where these are enough to determine its rows, which the samples use least; each
    sample is weighted by the inverse of the variance that is expected of it.
    """
    fitted = list(hypotheses)
    for (view, s), numbers in _grouped((h.view, h.n_rows) for h in hypotheses):
        thin = views[view].thin
        enough = np.count_nonzero(held[:, numbers] & thin.moving[:, None], axis=0)
        numbers = [i for i, n in zip(numbers, enough, strict=True) if n >= SAMPLES_PER_DIRECTION * thin.rates.shape[1]]
        scales = [hypotheses[i].scale for i in numbers]
        variance = np.outer(thin.noise, [x.steady**2 for x in scales])
        variance += np.outer(thin.free, [x.share**2 for x in scales])
        weights = np.where(held[:, numbers], thin.weight[:, None] / variance, 0.0)
        r = thin.rates.shape[1]
        M = np.stack([(thin.rates.T * w) @ thin.rates for w in weights.T]) if numbers else np.zeros((0, r, r))
        S = np.tensordot(weights, thin.gram, axes=(0, 0))
        _, directions = least_used(Moments(M, S, np.zeros(len(M)), np.zeros(len(M), dtype=np.int64)))
        least = np.linalg.qr(directions[:, :s].transpose(0, 2, 1))[0].transpose(0, 2, 1)
        for i, rows in zip(numbers, least, strict=True):
            fitted[i] = dataclasses.replace(hypotheses[i], rows=rows)
    return _scaled(views, fitted, baseline, switch)


def _scaled(
    views: Sequence[View], hypotheses: Sequence[Hypothesis], baseline: Float[np.ndarray, " n"], switch: float
) -> list[Hypothesis]:
    """Each with the scale that gains most."""
    gains = _gains(views, hypotheses, SCALES, baseline, switch)
    most = np.argmax(gains.sum(axis=0), axis=1)
    return [
        dataclasses.replace(h, scale=SCALES[k], gains=gains[:, i, k])
        for i, (h, k) in enumerate(zip(hypotheses, most, strict=True))
    ]


def _similar(first: Hypothesis, second: Hypothesis) -> bool:
    return first.view == second.view and row_space_angle(first.rows, second.rows) < _SAME
