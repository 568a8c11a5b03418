"""Search for a few hypotheses that, with free motion, explain the recordings: rows that are zero in some samples.

Candidates are the rows that windows, recordings, pairs of either, and all samples use least (one generalised
eigenproblem each). Each is fitted to the samples that it explains, in turns with Viterbi's sequence of states. The best
one that a gate accepts is added, and all compete again. The currency is the log-likelihood, in nats. A cut recording is
the case of an infinite switching cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, groupby, islice, pairwise, product

import numpy as np

from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import PlaceRows
from manip_learn.learning.table import CHANGE, LEAST_GAIN, SHORTEST, SLIGHT, WEAK_GAP, Samples, Stretch, Table, View
from manip_learn.linalg import orthonormal_rows, row_space_angle

SCALES = tuple((steady, share) for steady in (1.0, 3.0, 9.0) for share in (0.003, 0.01, 0.03, 0.1, 0.2))
FAR_OFF = 2.0 * SLIGHT  # share of held samples that may be far off: bounds the evidence against
SAME = np.radians(3.0)  # rows closer together are one proposal
MOST_CONSTRAINTS, MOST_TESTED, KEPT, TURNS = 6, 6, 4, 4  # answered; tested by the gate a time; of each kind; of fits
FEW_HELD = 0.2  # share of the motion, below which what no place explains is looked for in the whole twist
MOST_OF_WINDOWS = 40  # proposals of windows, and of pairs of them, of each view and number of rows
AT_ONCE = 1_000_000  # numbers in memory together


Scale = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Rows that are zero in some samples.

    Attributes:
        view: Number of the view.
        rows: shape (s, r), whitened and orthonormal.
        scale: Residual that is allowed: multiple of the noise, and share of the free velocity (standard deviations).
        gains: Gain of each recording over the other hypotheses [nats].
    """

    view: int
    rows: np.ndarray
    scale: Scale = SCALES[0]
    gains: np.ndarray = field(default_factory=lambda: np.zeros(1))

    @property
    def support(self) -> float:
        """Gain without the recording that gains most [nats]."""
        return float(self.gains.sum() - (self.gains.max() if len(self.gains) > 1 else 0.0))

    def price(self, seconds: float) -> float:
        """Return the price of the free parameters for recordings of a total duration [s], in nats (Schwarz, 1978)."""
        s, r = self.rows.shape
        return 0.5 * s * (r - s) * float(np.log(max(seconds / CHANGE, 2.0)))


def broken_energy(m: Samples, rows: np.ndarray) -> np.ndarray:
    """Return u^T A^+ A u of each sample for h hypotheses of s rows (h, s, r), by Cholesky's recursion; (n, h)."""
    h, s, r = rows.shape
    flat, L, y = m.gram.reshape(-1, r * r), dict[tuple[int, int], np.ndarray](), list[np.ndarray]()
    for i in range(s):
        for j in range(i + 1):
            entry = flat @ (rows[:, i, :, None] * rows[:, j, None, :]).reshape(h, r * r).T
            for k in range(j):
                entry -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(np.maximum(entry, 1e-15)) if i == j else entry / L[j, j]
        left = m.rates @ rows[:, i].T
        for k in range(i):
            left = left - L[i, k] * y[k]
        y.append(left / L[i, i])
    return np.sum(np.square(y), axis=0)


def evidence(m: Samples, rows: np.ndarray, scales: Sequence[Scale]) -> np.ndarray:
    """Return the evidence of each sample: log-likelihood with constrained rows less that with free rows [nats].

    Args:
        m: n samples.
        rows: shape (h, s, r), rows of h hypotheses.
        scales: k scales, see `Hypothesis`.

    Returns:
        shape (n, h, k).
    """
    energy, (steady, share) = broken_energy(m, rows), np.array(scales).T ** 2
    floor = m.noise[:, None] * steady
    free = np.maximum(m.free[:, None], floor)
    held = np.minimum(floor + share * free, free)
    exponent = (
        0.5 * rows.shape[1] * np.log(free / held)[:, None]
        - energy[:, :, None] * (0.5 * (1.0 / held - 1.0 / free))[:, None]
    )
    ratio = np.log(FAR_OFF + (1.0 - FAR_OFF) * np.exp(np.minimum(exponent, 50.0)))
    return ratio * (m.weight[:, None, None] / CHANGE)


def viterbi(values: np.ndarray, first: np.ndarray, switch: float, path: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return the most likely states of many problems at once, or one state throughout, as in a cut recording.

    Args:
        values: shape (n, h, k), evidence of each sample for k constraints over free motion, for h problems [nats].
        first: shape (g + 1,), first sample of each recording, and n.
        switch: Switching cost [nats]; infinite: one state for each recording.
        path: False if only the gains are needed.

    Returns:
        States (n, h), 0 for free motion, and gains of the recordings (g, h) [nats].
    """
    lengths, half = np.diff(first), 0.5 * switch  # into or out of a constraint costs half a change
    alone = np.insert(np.add.reduceat(values, first[:-1], axis=0), 0, 0.0, axis=2)
    states, gains = np.repeat(alone.argmax(axis=2), lengths, axis=0), alone.max(axis=2)
    if np.isinf(switch):
        return states, gains
    inside = np.arange(lengths.max()) < lengths[:, None]
    padded = np.zeros((*inside.shape, *values.shape[1:]))
    padded[inside] = values
    free, kept = np.zeros(gains.shape), list[tuple[np.ndarray, np.ndarray]]()
    held = np.zeros((values.shape[2], *free.shape)) - half
    for step in np.ascontiguousarray(padded.transpose(1, 3, 0, 2)):
        if path:
            kept.append((free, held))
        free = np.maximum(free, held.max(axis=0) - half)
        held = np.maximum(held, free - half) + step
    ends = np.concatenate([free[None], held - half])
    if path:  # the way back: which state each one came from
        free, held = (np.array(x) for x in zip(*kept, strict=True))
        left, own = held.max(axis=1) - half, np.arange(1, held.shape[1] + 1)[:, None, None]
        source = np.where(left > free, held.argmax(axis=1) + 1, 0)[:, None]
        stays = held >= np.maximum(free, left)[:, None] - half
        before = np.concatenate([source, np.where(stays, own, source)], axis=1)
        found, state = np.zeros(padded.shape[:3], dtype=int), ends.argmax(axis=0)
        recording, problem = np.indices(state.shape)
        for t in reversed(range(len(before))):
            found[:, t] = state
            state = before[t, state, recording, problem]
        states = np.where(np.repeat(gains >= ends.max(axis=0), lengths, axis=0), states, found[inside])
    return states, np.maximum(gains, ends.max(axis=0))


def least_used(M: np.ndarray, S: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions that motion uses least, by the eigenvectors of M x = e S x for each of w windows.

    Args:
        M: shape (w, r, r), sums of r r^T of the rates r = Phi u.
        S: shape (w, r, r), sums of Phi Phi^T.
        noise: shape (w,), smallest level squared.

    Returns:
        Levels sqrt(e), smallest first, shape (w, r), and the directions as rows, shape (w, r, r).
    """
    r = M.shape[1]
    floor = np.maximum(1e-9 * np.trace(S, axis1=1, axis2=2)[:, None, None] / r, 1e-200) * np.eye(r)
    inverse = np.linalg.inv(np.linalg.cholesky(S + floor))
    values, vectors = np.linalg.eigh(inverse @ M @ inverse.transpose(0, 2, 1))
    return np.sqrt(np.maximum(values, noise[:, None])), vectors.transpose(0, 2, 1) @ inverse


def distinct(rows: np.ndarray, most: int | None = None) -> list[int]:
    """Return the numbers of the first orthonormal rows (h, s, r) with different row spaces, at most `most`."""
    h, s, r = rows.shape
    P = (rows.transpose(0, 2, 1) @ rows).reshape(h, r * r)
    apart, left, kept = s - P @ P.T > np.sin(SAME) ** 2, np.arange(h), list[int]()
    while len(left) and (most is None or len(kept) < most):
        kept.append(int(left[0]))
        left = left[1:][apart[left[0], left[1:]]]
    return kept


def proposed(m: Samples, states: np.ndarray, largest: int, whole: bool) -> list[np.ndarray]:
    """Return candidate rows for each number of rows s from 1 on, each of shape (h, s, r).

    They are the least used rows of windows of free motion, and of recordings, pairs and all samples in each state.

    Args:
        m: n samples.
        states: shape (n,), current state of each sample; 0 is free motion.
        largest: Largest number of rows.
        whole: True if each recording is one stretch: windows are left out.
    """
    n, r = m.rates.shape
    squares = (m.rates[:, :, None] * m.rates[:, None]).reshape(n, -1)
    products = np.column_stack([squares, m.gram.reshape(n, -1), m.noise, m.moving, np.ones(n)])

    def used(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        M, S = (np.ascontiguousarray(x).reshape(-1, r, r) for x in np.split(sums[:, : 2 * r * r], 2, axis=1))
        return least_used(M, S, sums[:, -3] / np.maximum(sums[:, -1], 1e-12))

    weights = [m.weight * (states == k) for k in range(int(states.max(initial=0)) + 1)]
    totals = [np.insert(np.cumsum(products * w[:, None], axis=0), 0, 0.0, axis=0) for w in weights]
    groups: list[tuple[np.ndarray, int | None]] = []
    for total in totals:
        each = total[m.first[1:]] - total[m.first[:-1]]
        shown = np.flatnonzero(each[:, -1] > 0.0)
        few = shown[:: max(1, len(shown) // 16)]
        pairs = np.array(list(combinations(few, 2)), dtype=int).reshape(-1, 2)
        pairs = pairs[:: max(1, -(-len(pairs) // 24))]
        pooled = [each[few], each[pairs].sum(axis=1), each.sum(axis=0, keepdims=True)]
        groups.append((np.concatenate(pooled), None))
    if not whole:
        windows, owner = [], []
        for (a, b), length in product(pairwise(m.first), (0.6, 1.2, 2.0)):
            time = m.time[a:b]
            starts = np.arange(time[0], max(time[-1] - length, time[0]) + 1e-9, 0.5 * length)
            low, high = np.searchsorted(time, starts) + a, np.searchsorted(time, starts + length) + a
            some = (totals[0][high] - totals[0][low])[high - low > 2 * r]
            some = some[(some[:, -2] > 0.5 * length) & (some[:, -1] > 0.8 * length)]
            windows.append(some)
            owner += [(a, length)] * len(some)
        w, (owner, length) = np.concatenate(windows), np.reshape(owner, (-1, 2)).T
        groups.append((w[length < 2.0], MOST_OF_WINDOWS))
        w, owner = w[length > 1.0], owner[length > 1.0]
        sizes, _ = used(w)
        best = np.argsort(-np.max(sizes[:, 1:] / sizes[:, :-1], axis=1))[:60]
        i, j = best[np.array(np.triu_indices(len(best), 1))]
        apart = owner[i] != owner[j]
        groups.append((w[i[apart]] + w[j[apart]], MOST_OF_WINDOWS))
    found = [(*used(sums[sums[:, -1] > 0.0]), most) for sums, most in groups]
    out = list[np.ndarray]()
    for s in range(1, largest + 1):
        kept = []
        for sizes, directions, most in found:
            gap = sizes[:, s] / sizes[:, s - 1]
            chosen = np.flatnonzero(gap > WEAK_GAP)
            kept.append(orthonormal_rows(directions[chosen[np.argsort(-gap[chosen])][:most], :s]))
        rows = np.concatenate(kept)
        out.append(rows[distinct(rows)])
    return out


class Explanation:
    """Hypotheses that together explain the recordings, with the state of each sample.

    The gains of each hypothesis are those over the others.
    """

    def __init__(self, views: Sequence[View], hypotheses: Sequence[Hypothesis], switch: float):
        self.views, self.hypotheses, self.switch = list(views), list(hypotheses), switch
        m = views[0].thin
        self.values, self.states = self.seen([v.thin for v in views])
        self.explained = self.values[np.arange(len(self.values)), self.states]
        # evidence of each sample for its best explanation without each of the hypotheses [nats]
        self.others = [np.delete(self.values, k + 1, axis=1).max(axis=1) for k in range(len(hypotheses))]
        for k, h in enumerate(hypotheses):
            gain = np.where(self.states == k + 1, self.values[:, k + 1] - self.others[k], 0.0)
            gains = np.bincount(m.recording, gain, minlength=len(m.first) - 1)
            self.hypotheses[k] = replace(h, gains=gains)
        self.supports = np.array([h.support for h in self.hypotheses])

    def seen(self, samples: Sequence[Samples]) -> tuple[np.ndarray, np.ndarray]:
        """Return the evidence of samples of each view for free motion and all hypotheses, and their states."""
        free = np.zeros(len(samples[0].time))
        each = (evidence(samples[h.view], h.rows[None], [h.scale])[:, 0, 0] for h in self.hypotheses)
        values = np.column_stack([free, *each])
        if not self.hypotheses:
            return values, np.zeros(len(free), dtype=int)
        return values, viterbi(values[:, None, 1:], samples[0].first, self.switch)[0][:, 0]

    def without_weakest(self) -> Explanation:
        """Return the explanation without the hypothesis that has the least support."""
        kept = [h for k, h in enumerate(self.hypotheses) if k != int(self.supports.argmin())]
        return Explanation(self.views, kept, self.switch)

    def refit(self, k: int, start: Hypothesis) -> Hypothesis:
        """Return a hypothesis fitted to the samples of the k-th one, against the others."""
        held = self.states == k + 1
        baseline = np.where((self.states > 0) & ~held, self.others[k], 0.0)
        return fitted(self.views, [start], held[:, None], baseline, self.switch)[0]

    def settled(self) -> Explanation:
        """Fit each hypothesis to the samples that it explains, and repeat while the total evidence grows."""
        best = self
        for _ in range(TURNS):
            refitted = [best.refit(k, h) for k, h in enumerate(best.hypotheses)]
            now = Explanation(self.views, refitted, self.switch)
            if now.explained.sum() <= best.explained.sum():
                break
            best = now
        return best

    def has_twins(self) -> bool:
        """Return True if two hypotheses differ by less than their own scales."""
        for a, b in combinations(self.hypotheses, 2):
            if a.view == b.view and len(a.rows) == len(b.rows):
                v = self.views[a.view]
                if row_space_angle(v.selection(a.rows), v.selection(b.rows)) < a.scale[1] + b.scale[1]:
                    return True
        return False

    def stretches(self, k: int, fine: np.ndarray | None = None) -> list[Stretch]:
        """Return the stretches of state k, from the first to the last moving sample, or to ends of the recording.

        Args:
            k: Number of the state.
            fine: State of each sample of the whole table; by default those of the samples of the search.
        """
        view, out = self.views[0], list[Stretch]()
        m, states = (view.thin, self.states) if fine is None else (view.all, fine)
        shown = m.moving & (states == k)
        edges = np.unique(np.concatenate([np.flatnonzero(np.diff(states)) + 1, m.first]))
        for a, b in pairwise(edges.tolist()):
            inside = a + np.flatnonzero(shown[a:b])
            if not len(inside):
                continue
            i = int(m.recording[a])
            ends = view.table.ends[i].tolist()
            start, end = m.time[inside[[0, -1]]].tolist()
            long = end - start >= SHORTEST
            if k:
                start, end = ends[0] if a == m.first[i] else start, ends[1] if b == m.first[i + 1] else end
            if long or not k or [start, end] == ends:
                out.append(Stretch(i, start, end))
        return out


def scored(
    views: Sequence[View], tried: Sequence[Hypothesis], scales: Sequence[Scale], baseline: np.ndarray, switch: float
) -> np.ndarray:
    """Return the gain of each recording over the baseline by each hypothesis at each scale, shape (g, h, k) [nats]."""
    n, first = len(baseline), views[0].thin.first
    out = [np.zeros((len(first) - 1, 0, len(scales)))]
    at_once = max(1, AT_ONCE // (n * len(scales)))
    for i in range(0, len(tried), at_once):
        values = []
        for (view, _), alike in groupby(tried[i : i + at_once], key=lambda h: (h.view, len(h.rows))):
            rows = np.stack([h.rows for h in alike])
            values.append(evidence(views[view].thin, rows, scales) - baseline[:, None, None])
        gains = viterbi(np.concatenate(values, axis=1).reshape(n, -1, 1), first, switch, path=False)[1]
        out.append(gains.reshape(len(gains), -1, len(scales)))
    return np.concatenate(out, axis=1)


def fitted(
    views: Sequence[View], hypotheses: Sequence[Hypothesis], held: np.ndarray, baseline: np.ndarray, switch: float
) -> list[Hypothesis]:
    """Fit each hypothesis to its samples: the rows that these use least, at the scale that then gains most.

    Args:
        views: All views.
        hypotheses: h hypotheses; those with too few moving samples keep their rows.
        held: shape (n, h), True for samples of the hypothesis.
        baseline: shape (n,), evidence of each sample without them [nats].
        switch: Switching cost [nats].
    """
    out = list[Hypothesis]()
    for h, own in zip(hypotheses, held.T, strict=True):
        m, (steady, share) = views[h.view].thin, np.square(h.scale)
        if np.count_nonzero(own & m.moving) >= 3 * m.rates.shape[1]:
            w = np.where(own, m.weight / (m.noise * steady + m.free * share), 0.0)  # by their expected variance
            M, S = (m.rates.T * w) @ m.rates, np.tensordot(w, m.gram, axes=1)
            h = replace(h, rows=orthonormal_rows(least_used(M[None], S[None], np.zeros(1))[1][0, : len(h.rows)]))
        out.append(h)
    gains = scored(views, out, SCALES, baseline, switch)
    best = gains.sum(axis=0).argmax(axis=1)
    return [replace(out[i], scale=SCALES[k], gains=gains[:, i, k]) for i, k in enumerate(best)]


def candidates(now: Explanation, allowed: Sequence[int]) -> list[Hypothesis]:
    """Return the fitted candidates that gain most over an explanation, a few for each view and number of rows."""
    views, baseline, switch, best = now.views, now.explained, now.switch, list[Hypothesis]()
    maps = [v.features for v in views]
    whole = [f.frame for f in maps if isinstance(f, PlaceRows) and f.form == "point and rotation"]
    for number in allowed:
        f = maps[number]
        # other views have the whole twist and more; `explain` moves their hypotheses back in the end
        if isinstance(f, FrameJacobian) and (f.reference, f.n_rows) == ("world", 6) and f.frame in whole:
            continue
        for rows in proposed(views[number].thin, now.states, views[number].largest, bool(np.isinf(switch))):
            tried = [Hypothesis(number, one) for one in rows]
            # two scales tell enough to compare
            gains = scored(views, tried, ((2.0, 0.1), (2.0, 0.01)), baseline, switch)
            support = (gains.sum(axis=0) - (gains.max(axis=0) if len(gains) > 1 else 0.0)).max(axis=1)
            order = np.argsort(-support, kind="stable")
            order = order[support[order] > 0.0]
            best += [tried[i] for i in order[distinct(rows[order], KEPT)]]
    going, out = fitted(views, best, np.zeros((len(baseline), len(best)), dtype=bool), baseline, switch), []
    for _ in range(TURNS):
        if not going:
            break
        each = (evidence(views[h.view].thin, h.rows[None], [h.scale])[:, 0, 0] for h in going)
        values = np.column_stack([nats - baseline for nats in each])
        held = viterbi(values[:, :, None], views[0].thin.first, switch)[0] > 0
        pairs = list(zip(going, fitted(views, going, held, baseline, switch), strict=True))
        out += [old for old, new in pairs if new.gains.sum() <= old.gains.sum()]
        going = [new for old, new in pairs if new.gains.sum() > old.gains.sum()]
    return out + going


Test = Callable[[View, Hypothesis, Sequence[Stretch]], bool]


def added(now: Explanation, believed: Test, refused: list[Hypothesis], allowed: Sequence[int]) -> Explanation:
    """Add accepted hypotheses from the allowed views, one at a time; all refused ones are added to `refused`."""
    views, seconds = now.views, now.views[0].table.seconds

    def similar(a: Hypothesis, b: Hypothesis) -> bool:
        """Return True for rows of one view that hardly differ."""
        return a.view == b.view and row_space_angle(a.rows, b.rows) < SAME

    while len(now.hypotheses) < MOST_CONSTRAINTS:
        found = sorted(candidates(now, allowed), key=lambda h: h.price(seconds) - h.support)
        gaining = (h for h in found if h.support - h.price(seconds) > LEAST_GAIN)
        for h in islice((h for h in gaining if not any(similar(h, x) for x in refused)), MOST_TESTED):
            trial = Explanation(views, [*now.hypotheses, h], now.switch).settled()
            last, stretches = trial.hypotheses[-1], trial.stretches(len(trial.hypotheses))
            if last.support > LEAST_GAIN and not trial.has_twins() and believed(views[h.view], last, stretches):
                break
            refused.append(h)
        else:
            return now
        while len(trial.hypotheses) > 1 and trial.supports.min() < LEAST_GAIN:
            trial = trial.without_weakest()
        refused += [h for h in now.hypotheses if not any(similar(h, x) for x in trial.hypotheses)]
        now = trial
    return now


def explain(views: Sequence[View], believed: Test, switch: float, first: int = 0) -> Explanation:
    """Add one hypothesis after the other, as long as one gains enough and the gate accepts it.

    Args:
        views: All views.
        believed: Gate: function of a view, a hypothesis and its stretches.
        switch: Switching cost [nats].
        first: Number of views of the position of the hand; the others are searched if these explain little motion.
    """
    refused = list[Hypothesis]()
    now = added(Explanation(views, (), switch), believed, refused, range(first))
    moving = now.states[views[0].thin.moving]
    if np.count_nonzero(moving) < FEW_HELD * max(len(moving), 1):
        now = added(now, believed, refused, range(first, len(views)))
    # each one in the first view in which as many rows explain no less, net of their price
    for k, h in enumerate(now.hypotheses):
        for number, view in enumerate(views[: h.view]):
            if view.largest < len(h.rows):
                continue
            moved = now.refit(k, Hypothesis(number, np.eye(len(h.rows), view.r), h.scale))
            trial = Explanation(views, [*now.hypotheses[:k], moved, *now.hypotheses[k + 1 :]], switch)
            price = moved.price(views[0].table.seconds) - h.price(views[0].table.seconds)
            if trial.explained.sum() - price >= now.explained.sum():
                now = trial
                break
    while now.has_twins():
        now = now.without_weakest()
    return now


def lone_contacts(
    found: Explanation, places: Sequence[int], supported: Callable[[View, Stretch], int]
) -> list[Stretch]:
    """Return further stretches in which rows are firmly constrained in one recording alone.

    They are named, so that they can be recorded again, and not learnt.

    Args:
        found: Explanation of all recordings.
        places: Numbers of the views of the position of the hand.
        supported: Function of a view and a stretch: number of rows for which it is evidence.
    """
    out = list[Stretch]()
    for i, moved in enumerate(found.views[0].table.moved):
        alone = Table([moved])
        views = [v.of_recording(i, alone) for v in found.views]
        rest, m = Explanation(views, found.hypotheses, found.switch), views[0].thin
        free = np.sum(m.weight[(rest.states == 0) & m.moving])
        tried = candidates(rest, places) if free > SHORTEST else []
        firm = [h for h in tried if h.scale[1] <= SLIGHT and h.support > LEAST_GAIN]
        if not firm:
            continue
        h, k = max(firm, key=lambda h: h.support), len(found.hypotheses)
        both = Explanation(views, [*found.hypotheses, h], found.switch)
        values = both.values[:, k + 1] - both.others[k]
        for s in both.stretches(k + 1, both.seen([v.all for v in views])[1]):
            # less the quarter that gains most, the price, and the change into it and out of it
            parts = [values[(m.time >= a) & (m.time < b)].sum() for a, b in pairwise(np.linspace(s.start, s.end, 5))]
            worth = sum(parts) - max(parts) - h.price(s.end - s.start) - found.switch
            there = s._replace(recording=i)
            if worth > LEAST_GAIN and supported(found.views[h.view], there) >= len(h.rows):
                out.append(there)
    return out
