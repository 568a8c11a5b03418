"""Search for a few hypotheses that, with free motion, explain the recordings: rows that are zero in some samples.

Candidates are the rows that windows, recordings, pairs of either, and all samples use least (one generalised
eigenproblem each). Each is fitted to the samples that it explains, in turns with Viterbi's sequence of states. The best
one that a gate accepts is added, and all compete again. The currency is the log-likelihood, in nats. A cut recording is
the case of an infinite switching cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise, product

import numpy as np

from manip_learn.learning.table import CHANGE, SHORTEST, SWITCH, Samples, Stretch, View
from manip_learn.linalg import row_space_angle

LEAST_GAIN = 40.0  # [nats] of a hypothesis, without its best supporter, less the price of its parameters
FAR_OFF = 0.02  # share of held samples that may be far off: bounds the evidence against
SCALES = tuple((steady, share) for steady in (1.0, 3.0, 9.0) for share in (0.003, 0.01, 0.03, 0.1, 0.2))
FIRST = ((2.0, 0.1), (2.0, 0.01))  # scales by which proposals are compared
SAME = np.radians(3.0)  # rows closer together are one proposal
PROPOSAL_GAP = 2.5  # below it nothing is proposed; less than WEAK_GAP, which decides in the end
MOST_CONSTRAINTS, MOST_TESTED, KEPT, TURNS = 6, 6, 4, 4  # answered; tested by the gate a time; of each kind; of fits
FEW_HELD = 0.4  # share of the motion, below which what no place explains is looked for in the whole twist
MOST_OF_WINDOWS = 40  # proposals of windows, and of pairs of them, of each view and number of rows
AT_ONCE = 4_000_000  # numbers in memory together


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
    scale: tuple[float, float] = SCALES[0]
    gains: np.ndarray = field(default_factory=lambda: np.zeros(1))

    @property
    def s(self) -> int:
        """Number of rows."""
        return len(self.rows)

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
    flat, y, total = m.gram.reshape(-1, r * r), [m.rates @ rows[:, i].T for i in range(s)], np.zeros((len(m.rates), h))
    L: list[list[np.ndarray]] = [[] for _ in range(s)]
    for i in range(s):
        for j in range(i + 1):
            entry = flat @ (rows[:, i, :, None] * rows[:, j, None, :]).reshape(h, r * r).T
            for k in range(j):
                entry -= L[i][k] * L[j][k]
            L[i].append(np.sqrt(np.maximum(entry, 1e-15)) if i == j else entry / L[j][j])
        for k in range(i):
            y[i] = y[i] - L[i][k] * y[k]
        y[i] = y[i] / L[i][i]
        total = total + y[i] ** 2
    return total


def evidence(m: Samples, energy: np.ndarray, s: int, scales: Sequence[tuple[float, float]]) -> np.ndarray:
    """Return the evidence of each sample: log-likelihood with constrained rows less that with free rows [nats].

    Args:
        m: n samples.
        energy: shape (n, h), u^T A^+ A u for each hypothesis, see `broken_energy`.
        s: Number of rows.
        scales: k scales, see `Hypothesis`.

    Returns:
        shape (n, h, k).
    """
    steady, share = np.array(scales).T ** 2
    floor = m.noise[:, None] * steady
    free = np.maximum(m.free[:, None], floor)
    held = np.minimum(floor + share * free, free)
    exponent = 0.5 * s * np.log(free / held)[:, None] - energy[:, :, None] * (0.5 * (1.0 / held - 1.0 / free))[:, None]
    ratio = np.log(FAR_OFF + (1.0 - FAR_OFF) * np.exp(np.minimum(exponent, 50.0)))
    return ratio * (m.weight[:, None, None] / CHANGE)


def viterbi(values: np.ndarray, first: np.ndarray, switch: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the most likely states of many problems at once, or one state throughout, as in a cut recording.

    Args:
        values: shape (n, h, k), evidence of each sample for k states of h problems [nats]; state 0 is free motion.
        first: shape (g + 1,), first sample of each recording, and n.
        switch: Switching cost [nats]; infinite: one state for each recording.

    Returns:
        States (n, h), and gains of the recordings (g, h) [nats].
    """
    n, h, k = values.shape
    whole = np.add.reduceat(values, first[:-1], axis=0)
    alone, best = whole.argmax(axis=2), whole.max(axis=2)
    if np.isinf(switch):
        return np.repeat(alone, np.diff(first), axis=0), best
    lengths = np.diff(first)
    padded = np.zeros((int(lengths.max()), len(lengths), h, k))
    for i, (a, b) in enumerate(pairwise(first)):
        padded[: b - a, i] = values[a:b]
    border = 0.5 * switch * (np.arange(k) > 0)  # into or out of a constraint costs half a change
    value, back = np.broadcast_to(-border, padded.shape[1:]), np.zeros(padded.shape, dtype=np.int8)
    cost = border[:, None] + border
    np.fill_diagonal(cost, 0.0)
    for t, step in enumerate(padded):
        if k == 2:  # the usual case, much faster written out
            away, stay = value[..., 0] - cost[0, 1], value[..., 1]
            left, free = value[..., 1] - cost[1, 0], value[..., 0]
            back[t, ..., 1], back[t, ..., 0] = stay >= away, left > free
            value = np.stack([np.maximum(free, left), np.maximum(stay, away)], axis=-1) + step
        else:
            arrivals = value[..., :, None] - cost
            back[t] = arrivals.argmax(axis=-2)
            value = arrivals.max(axis=-2) + step
    ends = value - border
    state, out = ends.argmax(axis=-1), np.zeros(padded.shape[:3], dtype=np.int64)
    for t in range(len(padded) - 1, -1, -1):
        out[t] = state
        state = np.take_along_axis(back[t], state[..., None], axis=-1)[..., 0]
    found = np.concatenate([out[: b - a, i] for i, (a, b) in enumerate(pairwise(first))])
    better = best >= ends.max(axis=-1)
    found = np.where(np.repeat(better, lengths, axis=0), np.repeat(alone, lengths, axis=0), found)
    return found, np.maximum(best, ends.max(axis=-1))


def two_state_gains(values: np.ndarray, first: np.ndarray, switch: float) -> np.ndarray:
    """Return the gain of each recording by each hypothesis alone, shape (g, h) [nats]: `viterbi` without the path."""
    whole = np.maximum(np.add.reduceat(values, first[:-1], axis=0), 0.0)
    if np.isinf(switch):
        return whole
    lengths, half = np.diff(first), 0.5 * switch
    padded = np.zeros((int(lengths.max()), len(lengths), values.shape[1]))
    for i, (a, b) in enumerate(pairwise(first)):
        padded[: b - a, i] = values[a:b]
    free = np.zeros(padded.shape[1:])
    held = free - half
    for step in padded:
        held, free = np.maximum(held, free - half) + step, np.maximum(free, held - half)
    return np.maximum(whole, np.maximum(free, held - half))


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


def orthonormal(directions: np.ndarray, s: int) -> np.ndarray:
    """Return orthonormal rows that span the first s of each set of directions, shape (w, s, r)."""
    return np.linalg.qr(directions[:, :s].transpose(0, 2, 1))[0].transpose(0, 2, 1)


def distinct(rows: np.ndarray, most: int | None = None) -> list[int]:
    """Return the numbers of the first orthonormal rows (h, s, r) with different row spaces, at most `most`."""
    h, s, r = rows.shape
    P = (rows.transpose(0, 2, 1) @ rows).reshape(h, r * r)
    apart, left, kept = s - P @ P.T > np.sin(SAME) ** 2, np.arange(h), list[int]()
    while len(left) and (most is None or len(kept) < most):
        kept.append(int(left[0]))
        left = left[1:][apart[left[0], left[1:]]]
    return kept


def proposed(m: Samples, states: np.ndarray, largest: int, whole: bool) -> dict[int, np.ndarray]:
    """Return candidate rows for each number of rows, s -> (h, s, r).

    They are the least used rows of windows of free motion, and of recordings, pairs and all samples in each state.

    Args:
        m: n samples.
        states: shape (n,), current state of each sample; 0 is free motion.
        largest: Largest number of rows.
        whole: True if each recording is one stretch: windows are left out.
    """
    r, n = m.rates.shape[1], len(m.rates)
    products = np.concatenate(
        [
            (m.rates[:, :, None] * m.rates[:, None]).reshape(n, -1),
            m.gram.reshape(n, -1),
            m.noise[:, None],
            m.moving()[:, None],
            np.ones((n, 1)),
        ],
        axis=1,
    )

    def cumulated(mask: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [np.zeros((1, products.shape[1])), np.cumsum(products * (m.weight * mask)[:, None], axis=0)]
        )

    groups: list[tuple[np.ndarray, int | None]] = []
    for k in range(int(states.max(initial=0)) + 1):
        total = cumulated(states == k)
        each = total[m.first[1:]] - total[m.first[:-1]]
        shown = np.flatnonzero(each[:, -1] > 0.0)
        few = shown[:: max(1, len(shown) // 16)]
        pairs = np.array(list(combinations(few, 2)), dtype=int).reshape(-1, 2)
        pairs = pairs[:: max(1, -(-len(pairs) // 24))]
        pooled = [each[few], each[pairs[:, 0]] + each[pairs[:, 1]], each.sum(axis=0, keepdims=True)]
        groups.append((np.concatenate(pooled), None))
    if not whole:
        total, short, long, owner = cumulated(states == 0), [], [], []
        for (a, b), length in product(pairwise(m.first), (0.6, 1.2, 2.0)):
            time = m.time[a:b]
            starts = np.arange(time[0], max(time[-1] - length, time[0]) + 1e-9, 0.5 * length)
            low, high = np.searchsorted(time, starts) + a, np.searchsorted(time, starts + length) + a
            some = (total[high] - total[low])[high - low > 2 * r]
            some = some[(some[:, -2] > 0.5 * length) & (some[:, -1] > 0.8 * length)]
            if length < 2.0:
                short.append(some)
            if length > 1.0:
                long.append(some)
                owner.append(np.full(len(some), a))
        groups.append((np.concatenate(short), MOST_OF_WINDOWS))
        if sum(map(len, long)) > 1:
            w, owner = np.concatenate(long), np.concatenate(owner)
            sizes, _ = least_used(*_split(w, r))
            best = np.argsort(-np.max(sizes[:, 1:] / sizes[:, :-1], axis=1))[:60]
            i, j = np.triu_indices(len(best), 1)
            i, j = best[i], best[j]
            apart = owner[i] != owner[j]
            groups.append((w[i[apart]] + w[j[apart]], MOST_OF_WINDOWS))
    out: dict[int, list[np.ndarray]] = {s: [] for s in range(1, largest + 1)}
    for w, most in groups:
        w = w[w[:, -1] > 0.0]
        if not len(w):
            continue
        sizes, directions = least_used(*_split(w, r))
        for s, kept in out.items():
            gap = sizes[:, s] / sizes[:, s - 1]
            chosen = np.flatnonzero(gap > PROPOSAL_GAP)
            kept.append(orthonormal(directions[chosen[np.argsort(-gap[chosen])][:most]], s))
    joined = {s: np.concatenate(kept) for s, kept in out.items() if kept}
    return {s: rows[distinct(rows)] for s, rows in joined.items() if len(rows)}


def _split(w: np.ndarray, r: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return (
        w[:, : r * r].reshape(-1, r, r),
        w[:, r * r : 2 * r * r].reshape(-1, r, r),
        w[:, -3] / np.maximum(w[:, -1], 1e-12),
    )


class Explanation:
    """Hypotheses that together explain the recordings, with the state of each sample."""

    def __init__(self, views: Sequence[View], hypotheses: Sequence[Hypothesis] = (), switch: float = SWITCH):
        self.views, self.hypotheses, self.switch = list(views), list(hypotheses), switch
        m = views[0].thin
        self.values = np.concatenate([np.zeros((len(m.time), 1)), self._of([v.thin for v in views])], axis=1)
        self.states = viterbi(self.values[:, None], m.first, switch)[0][:, 0]
        self.explained = self.values[np.arange(len(self.values)), self.states]
        self.gains = np.zeros((len(m.first) - 1, len(self.hypotheses)))
        for k in range(len(self.hypotheses)):
            gain = np.where(self.states == k + 1, self.values[:, k + 1] - self.others(k), 0.0)
            self.gains[:, k] = np.bincount(m.recording, gain, minlength=len(self.gains))
        self.supports = np.array(
            [replace(h, gains=g).support for h, g in zip(self.hypotheses, self.gains.T, strict=True)]
        )

    def _of(self, samples: Sequence[Samples]) -> np.ndarray:
        out = [
            evidence(samples[h.view], broken_energy(samples[h.view], h.rows[None]), h.s, [h.scale])[:, :, 0]
            for h in self.hypotheses
        ]
        return np.concatenate([np.zeros((len(samples[0].time), 0)), *out], axis=1)

    def others(self, k: int) -> np.ndarray:
        """Return the evidence of each sample for its best explanation without the k-th hypothesis [nats]."""
        return np.delete(self.values, k + 1, axis=1).max(axis=1)

    def fine_states(self) -> np.ndarray:
        """Return the state of each sample of the whole table, 0 for free motion."""
        values = self._of([v.all for v in self.views])
        values = np.concatenate([np.zeros((len(values), 1)), values], axis=1)
        return viterbi(values[:, None], self.views[0].all.first, self.switch)[0][:, 0]

    def with_(self, hypotheses: Sequence[Hypothesis]) -> Explanation:
        """Return the explanation by other hypotheses."""
        return Explanation(self.views, hypotheses, self.switch)

    def settled(self) -> Explanation:
        """Fit each hypothesis to the samples that it explains, and repeat while the total evidence grows."""
        best = self
        for _ in range(TURNS):
            fitted = list[Hypothesis]()
            for k, h in enumerate(best.hypotheses):
                held = best.states == k + 1
                baseline = np.where((best.states > 0) & ~held, best.others(k), 0.0)
                fitted += refitted(best.views, [h], held[:, None], baseline, best.switch)
            now = best.with_(fitted)
            if now.explained.sum() <= best.explained.sum():
                break
            best = now
        return best

    def without_idle(self) -> Explanation:
        """Remove hypotheses with too little support, the weakest first."""
        now = self
        while len(now.hypotheses) > 1 and now.supports.min() < LEAST_GAIN:
            now = now.with_([h for k, h in enumerate(now.hypotheses) if k != int(now.supports.argmin())])
        return now

    def has_twins(self) -> bool:
        """Return True if two hypotheses differ by less than their own scales."""
        for a, b in combinations(self.hypotheses, 2):
            if a.view == b.view and a.s == b.s:
                v = self.views[a.view]
                if row_space_angle(v.selection(a.rows), v.selection(b.rows)) < a.scale[1] + b.scale[1]:
                    return True
        return False

    def plainest(self) -> Explanation:
        """Move each hypothesis to the first view in which as many rows explain no less, net of their price."""
        now, seconds = self, self.views[0].table.seconds
        for k, h in enumerate(self.hypotheses):
            for number in range(h.view):
                view = self.views[number]
                if view.largest < h.s:
                    continue
                held = now.states == k + 1
                start = Hypothesis(number, np.eye(h.s, view.r), h.scale)
                baseline = np.where((now.states > 0) & ~held, now.others(k), 0.0)
                fitted = refitted(now.views, [start], held[:, None], baseline, now.switch)[0]
                trial = now.with_([*now.hypotheses[:k], fitted, *now.hypotheses[k + 1 :]])
                if trial.explained.sum() + h.price(seconds) - fitted.price(seconds) >= now.explained.sum():
                    now = trial
                    break
        return now

    def stretches(self, k: int, states: np.ndarray | None = None) -> list[Stretch]:
        """Return the stretches of state k, from the first to the last moving sample, or to ends of the recording."""
        fine = states is not None
        m, t = (self.views[0].all if fine else self.views[0].thin), self.views[0].table
        states, moving, out = (states if fine else self.states), m.moving(), []
        edges = np.unique(np.concatenate([np.flatnonzero(np.diff(states)) + 1, m.first]))
        for a, b in pairwise(edges.tolist()):
            inside = np.flatnonzero(moving[a:b] & (states[a] == k))
            if not len(inside):
                continue
            i = int(m.recording[a])
            start, end = float(m.time[a + inside[0]]), float(m.time[a + inside[-1]])
            long = end - start >= SHORTEST
            if k:
                start = float(t.ends[i, 0]) if a == m.first[i] else start
                end = float(t.ends[i, 1]) if b == m.first[i + 1] else end
            if long or not k or (start, end) == tuple(t.ends[i]):
                out.append(Stretch(i, start, end))
        return out


def scored(
    views: Sequence[View], tried: Sequence[Hypothesis], scales, baseline: np.ndarray, switch: float
) -> np.ndarray:
    """Return the gain of each recording over the baseline by each hypothesis at each scale, shape (g, h, k) [nats]."""
    m = views[0].thin
    out = np.zeros((len(m.first) - 1, len(tried), len(scales)))
    for (view, s), numbers in grouped([(h.view, h.s) for h in tried]):
        at_once = max(1, AT_ONCE // (len(m.time) * len(scales)))
        for some in (numbers[i : i + at_once] for i in range(0, len(numbers), at_once)):
            thin = views[view].thin
            values = evidence(thin, broken_energy(thin, np.stack([tried[i].rows for i in some])), s, scales)
            values = (values - baseline[:, None, None]).reshape(len(m.time), -1)
            out[:, some] = two_state_gains(values, m.first, switch).reshape(len(out), len(some), -1)
    return out


def scaled(views, hypotheses, baseline, switch) -> list[Hypothesis]:
    """Return the hypotheses with the scales that gain most over the baseline (n,) [nats]."""
    gains = scored(views, hypotheses, SCALES, baseline, switch)
    most = gains.sum(axis=0).argmax(axis=1)
    return [
        replace(h, scale=SCALES[k], gains=gains[:, i, k]) for i, (h, k) in enumerate(zip(hypotheses, most, strict=True))
    ]


def refitted(
    views, hypotheses: Sequence[Hypothesis], held: np.ndarray, baseline: np.ndarray, switch: float
) -> list[Hypothesis]:
    """Fit each hypothesis to its samples: the rows that these use least, weighted by their expected variance.

    Args:
        views: All views.
        hypotheses: h hypotheses; those with too few moving samples keep their rows.
        held: shape (n, h), True for samples of the hypothesis.
        baseline: shape (n,), evidence of each sample without them [nats].
        switch: Switching cost [nats].
    """
    out = list(hypotheses)
    for (view, s), numbers in grouped([(h.view, h.s) for h in hypotheses]):
        m = views[view].thin
        r = m.rates.shape[1]
        numbers = [i for i in numbers if np.count_nonzero(held[:, i] & m.moving()) >= 3 * r]
        if not numbers:
            continue
        scale = np.array([hypotheses[i].scale for i in numbers]).T ** 2
        weights = np.where(
            held[:, numbers], m.weight[:, None] / (np.outer(m.noise, scale[0]) + np.outer(m.free, scale[1])), 0.0
        )
        M = np.stack([(m.rates.T * w) @ m.rates for w in weights.T])
        rows = orthonormal(least_used(M, np.tensordot(weights, m.gram, axes=(0, 0)), np.zeros(len(M)))[1], s)
        for i, one in zip(numbers, rows, strict=True):
            out[i] = replace(out[i], rows=one)
    return scaled(views, out, baseline, switch)


def grouped(keys: Sequence) -> list[tuple]:
    """Return each distinct key with its indices."""
    out: dict = {}
    for i, key in enumerate(keys):
        out.setdefault(key, []).append(i)
    return list(out.items())


def contained(view: View, views: Sequence[View]) -> bool:
    """Return True if another view has these rows and more; `plainest` moves its hypotheses back in the end."""
    f = view.features
    if getattr(f, "reference", "") != "world":
        return False
    if len(f.row_names) < 6:  # the rows of the place alone: plainest first, as they are few
        return False
    return any(
        set(f.row_names) <= set(v.features.row_names) and getattr(v.features, "form", "").startswith("point")
        for v in views
        if v is not view
    )


def candidates(now: Explanation, allowed: Sequence[int] | None = None) -> list[Hypothesis]:
    """Return the fitted candidates that gain most over an explanation, a few for each view and number of rows."""
    views, baseline, switch = now.views, now.explained, now.switch
    tried = [
        Hypothesis(number, one)
        for number, view in enumerate(views)
        if (allowed is None or number in allowed) and not contained(view, views)
        for rows in proposed(view.thin, now.states, view.largest, bool(np.isinf(switch))).values()
        for one in rows
    ]
    if not tried:
        return []
    gains = scored(views, tried, FIRST, baseline, switch)
    support = (gains.sum(axis=0) - (gains.max(axis=0) if len(gains) > 1 else 0.0)).max(axis=1)
    best = list[Hypothesis]()
    for _, numbers in grouped([(h.view, h.s) for h in tried]):
        order = [i for i in sorted(numbers, key=lambda i: -support[i]) if support[i] > 0.0]
        if order:
            best += [tried[order[i]] for i in distinct(np.stack([tried[i].rows for i in order]), KEPT)]
    best = scaled(views, best, baseline, switch) if best else []
    going = list(range(len(best)))
    for _ in range(TURNS):
        if not going:
            break
        now_, m = [best[i] for i in going], views[0].thin
        energies = [broken_energy(views[h.view].thin, h.rows[None]) for h in now_]
        values = np.concatenate(
            [evidence(views[h.view].thin, e, h.s, [h.scale])[:, 0] for h, e in zip(now_, energies, strict=True)], axis=1
        )
        values = np.stack([np.zeros_like(values), values - baseline[:, None]], axis=2)
        held = viterbi(values, m.first, switch)[0] > 0
        again = refitted(views, now_, held, baseline, switch)
        better = {i: h for i, h in zip(going, again, strict=True) if h.gains.sum() > best[i].gains.sum()}
        best = [better.get(i, h) for i, h in enumerate(best)]
        going = list(better)
    return best


Test = Callable[[View, Hypothesis, list[Stretch]], bool]


def added(
    now: Explanation, believed: Test, refused: list[Hypothesis], allowed: Sequence[int] | None
) -> tuple[Explanation, list[Hypothesis]]:
    """Add accepted hypotheses from the allowed views, one at a time; return the explanation and all refused ones."""
    views, seconds = now.views, now.views[0].table.seconds

    def similar(a: Hypothesis, b: Hypothesis) -> bool:
        """Return True for rows of one view that hardly differ."""
        return a.view == b.view and row_space_angle(a.rows, b.rows) < SAME

    while len(now.hypotheses) < MOST_CONSTRAINTS:
        found = candidates(now, allowed)
        gaining = {id(h): h.support - h.price(seconds) for h in found}
        accepted, tested = None, 0
        for h in sorted(found, key=lambda h: -gaining[id(h)]):
            if gaining[id(h)] <= LEAST_GAIN or tested == MOST_TESTED:
                break
            if any(similar(h, x) for x in refused):
                continue
            trial, tested = now.with_([*now.hypotheses, h]).settled(), tested + 1
            k = len(trial.hypotheses)
            if (
                trial.supports[-1] > LEAST_GAIN
                and not trial.has_twins()
                and believed(views[h.view], trial.hypotheses[-1], trial.stretches(k))
            ):
                accepted = trial.without_idle()
                break
            refused.append(h)
        if accepted is None:
            break
        refused += [h for h in now.hypotheses if not any(similar(h, x) for x in accepted.hypotheses)]
        now = accepted
    return now, refused


def explain(views: Sequence[View], believed: Test, switch: float = SWITCH, first: int = 0) -> Explanation:
    """Add one hypothesis after the other, as long as one gains enough and the gate accepts it.

    Args:
        views: All views.
        believed: Gate: function of a view, a hypothesis and its stretches.
        switch: Switching cost [nats].
        first: Number of views of the position of the hand; the others are searched if these explain little motion.
    """
    now, refused = Explanation(views, (), switch), list[Hypothesis]()
    if first:
        now, refused = added(now, believed, refused, range(first))
    moving = views[0].thin.moving()
    if not first or not moving.any() or np.mean(now.states[moving] > 0) < FEW_HELD:
        now, _ = added(now, believed, refused, range(first, len(views)) if first else None)
    now = now.plainest()
    while now.has_twins():
        now = now.with_([h for k, h in enumerate(now.hypotheses) if k != int(now.supports.argmin())])
    return now
