"""Segment recordings into contacts and free motion: search for a few sets of rows that are zero in some of the samples.

Such a set of rows is a hypothesis (a constraint). Candidates are the directions with the least motion in windows,
recordings, pairs of these, and all samples (one generalised eigenproblem each). Each candidate is fitted to the samples
that it explains, in turns with the most likely sequence of states (Viterbi's algorithm). The best candidate that a gate
accepts is added, and all samples are assigned again. Hypotheses are compared by log-likelihood [nats]. An infinite
switching cost is for recordings that were cut to the contact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, groupby, islice, pairwise, product

import numpy as np

from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import PlaceRows
from manip_learn.learning.table import CHANGE, LEAST_GAIN, MIN_TIME, SLIGHT, WEAK_GAP, Samples, Stretch, Table, View
from manip_learn.linalg import orthonormal_rows, row_space_angle

SCALES = tuple((steady, share) for steady in (1.0, 3.0, 9.0) for share in (0.003, 0.01, 0.03, 0.1, 0.2))
SAME = np.radians(3.0)  # [rad] rows at a smaller angle are one proposal
ROUNDS = 4  # largest number of alternations between fits and states


Scale = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Candidate constraint: rows that are zero in some of the samples.

    Attributes:
        view: Index of the view (feature map) of the rows.
        rows: Whitened orthonormal rows (s, r).
        scale: Standard deviation of the velocity along the rows that still counts as zero, as two numbers: multiple of
            the noise, and share of the velocity of free motion.
        gains: Log-likelihood that the hypothesis adds to the other hypotheses, for each recording [nats].
    """

    view: int
    rows: np.ndarray
    scale: Scale = SCALES[0]
    gains: np.ndarray = field(default_factory=lambda: np.zeros(1))

    @property
    def support(self) -> float:
        """Sum of `gains` without the largest one, so that one recording alone gives no support [nats]."""
        return float(self.gains.sum() - (self.gains.max() if len(self.gains) > 1 else 0.0))

    def price(self, seconds: float) -> float:
        """Return the penalty for the free parameters, from the information criterion of Schwarz (1978) [nats].

        Args:
            seconds: Total duration of the recordings [s].
        """
        s, r = self.rows.shape
        return 0.5 * s * (r - s) * float(np.log(max(seconds / CHANGE, 2.0)))


def broken_energy(m: Samples, rows: np.ndarray) -> np.ndarray:
    """Return the motion energy u^T A^+ A u of each sample that violates each hypothesis.

    Args:
        m: Samples, n of them.
        rows: Rows of h hypotheses, shape (h, s, r).

    Returns:
        Energies (n, h) [(rad/s)^2].
    """
    h, s, r = rows.shape
    flat, L, y = m.gram.reshape(-1, r * r), dict[tuple[int, int], np.ndarray](), list[np.ndarray]()
    for i in range(s):
        for j in range(i + 1):
            entry = flat @ (rows[:, i, :, None] * rows[:, j, None, :]).reshape(h, r * r).T
            for k in range(j):
                entry -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(np.maximum(entry, 1e-15)) if i == j else entry / L[j, j]
        residual = m.rates @ rows[:, i].T
        for k in range(i):
            residual = residual - L[i, k] * y[k]
        y.append(residual / L[i, i])
    return np.sum(np.square(y), axis=0)


def evidence(m: Samples, rows: np.ndarray, scales: Sequence[Scale]) -> np.ndarray:
    """Return the evidence of each sample for each hypothesis.

    It is the log-likelihood with constrained rows minus the log-likelihood with free rows.

    Args:
        m: Samples, n of them.
        rows: Rows of h hypotheses, shape (h, s, r).
        scales: Allowed residuals, k of them, see `Hypothesis.scale`.

    Returns:
        Evidence (n, h, k) [nats], positive for a constraint.
    """
    outliers = 2.0 * SLIGHT  # share of held samples that may be far off: bounds the evidence against them
    energy, (steady, share) = broken_energy(m, rows), np.array(scales).T ** 2
    floor = m.noise[:, None] * steady
    free = np.maximum(m.free[:, None], floor)
    variance = np.minimum(floor + share * free, free)
    exponent = (
        0.5 * rows.shape[1] * np.log(free / variance)[:, None]
        - energy[:, :, None] * (0.5 * (1.0 / variance - 1.0 / free))[:, None]
    )
    ratio = np.log(outliers + (1.0 - outliers) * np.exp(np.minimum(exponent, 50.0)))
    return ratio * (m.weight[:, None, None] / CHANGE)


def viterbi(values: np.ndarray, first: np.ndarray, switch: float, path: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Find the most likely sequence of states (free motion, or one of k constraints) by Viterbi's algorithm.

    Several independent problems are solved at once.

    Args:
        values: Evidence of n samples for k constraints over free motion, for h problems, shape (n, h, k) [nats].
        first: Index of the first sample of each of g recordings, and n, shape (g + 1,).
        switch: Cost of a change of state [nats]; infinite for one state per recording.
        path: False to compute only the gains.

    Returns:
        States (n, h), 0 for free motion and 1 to k for the constraints, and the gains over free motion of the
        recordings (g, h) [nats].
    """
    lengths, half = np.diff(first), 0.5 * switch  # into or out of a constraint costs half a change
    alone = np.insert(np.add.reduceat(values, first[:-1], axis=0), 0, 0.0, axis=2)
    states, gains = np.repeat(alone.argmax(axis=2), lengths, axis=0), alone.max(axis=2)
    if np.isinf(switch):
        return states, gains
    inside = np.arange(lengths.max()) < lengths[:, None]
    padded = np.zeros((*inside.shape, *values.shape[1:]))
    padded[inside] = values
    free, steps = np.zeros(gains.shape), list[tuple[np.ndarray, np.ndarray]]()
    constrained = np.zeros((values.shape[2], *free.shape)) - half
    for step in np.ascontiguousarray(padded.transpose(1, 3, 0, 2)):
        if path:
            steps.append((free, constrained))
        free = np.maximum(free, constrained.max(axis=0) - half)
        constrained = np.maximum(constrained, free - half) + step
    ends = np.concatenate([free[None], constrained - half])
    if path:  # backtracking: the state that each state came from
        free, constrained = (np.array(x) for x in zip(*steps, strict=True))
        leaving, numbers = constrained.max(axis=1) - half, np.arange(1, constrained.shape[1] + 1)[:, None, None]
        source = np.where(leaving > free, constrained.argmax(axis=1) + 1, 0)[:, None]
        stays = constrained >= np.maximum(free, leaving)[:, None] - half
        before = np.concatenate([source, np.where(stays, numbers, source)], axis=1)
        sequence, state = np.zeros(padded.shape[:3], dtype=int), ends.argmax(axis=0)
        recording, problem = np.indices(state.shape)
        for t in reversed(range(len(before))):
            sequence[:, t] = state
            state = before[t, state, recording, problem]
        states = np.where(np.repeat(gains >= ends.max(axis=0), lengths, axis=0), states, sequence[inside])
    return states, np.maximum(gains, ends.max(axis=0))


def least_used(M: np.ndarray, S: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return directions in the order of the motion along them, least first, for each of w windows.

    They are the eigenvectors x of M x = e S x.

    Args:
        M: Sum of y y^T with the velocities y = Phi u, for each window, shape (w, r, r).
        S: Sum of Phi Phi^T, for each window, shape (w, r, r).
        noise: Smallest value of e, for each window, shape (w,).

    Returns:
        Size sqrt(e) of the motion along each direction, shape (w, r), and the directions as rows, shape (w, r, r).
    """
    r = M.shape[1]
    floor = np.maximum(1e-9 * np.trace(S, axis1=1, axis2=2)[:, None, None] / r, 1e-200) * np.eye(r)
    inverse = np.linalg.inv(np.linalg.cholesky(S + floor))
    values, vectors = np.linalg.eigh(inverse @ M @ inverse.transpose(0, 2, 1))
    return np.sqrt(np.maximum(values, noise[:, None])), vectors.transpose(0, 2, 1) @ inverse


def distinct_rows(rows: np.ndarray, most: int | None = None) -> list[int]:
    """Return the indices of sets of rows whose row spaces differ from all earlier returned ones.

    Args:
        rows: Sets of orthonormal rows (h, s, r).
        most: Largest number of results; None for all.
    """
    h, s, r = rows.shape
    P = (rows.transpose(0, 2, 1) @ rows).reshape(h, r * r)
    apart, rest, numbers = s - P @ P.T > np.sin(SAME) ** 2, np.arange(h), list[int]()
    while len(rest) and (most is None or len(numbers) < most):
        numbers.append(int(rest[0]))
        rest = rest[1:][apart[rest[0], rest[1:]]]
    return numbers


def propose_rows(m: Samples, states: np.ndarray, largest: int, whole: bool) -> list[np.ndarray]:
    """Propose candidate rows: the directions with the least motion in parts of the samples.

    The parts are windows of free motion, and the recordings, pairs of recordings, and all samples of each state.

    Args:
        m: Samples, n of them.
        states: Current state of each sample, shape (n,); 0 is free motion.
        largest: Largest number of rows of a candidate.
        whole: True if each recording is one stretch, so that windows are not used.

    Returns:
        For each number of rows s = 1, 2, ...: h candidates (h, s, r).
    """
    # largest number of proposals from windows, and from pairs of them, for each number of rows
    max_windows = 40
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
        present = np.flatnonzero(each[:, -1] > 0.0)
        few = present[:: max(1, len(present) // 16)]
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
        groups.append((w[length < 2.0], max_windows))
        w, owner = w[length > 1.0], owner[length > 1.0]
        sizes, _ = used(w)
        best = np.argsort(-np.max(sizes[:, 1:] / sizes[:, :-1], axis=1))[:60]
        i, j = best[np.array(np.triu_indices(len(best), 1))]
        apart = owner[i] != owner[j]
        groups.append((w[i[apart]] + w[j[apart]], max_windows))
    spectra = [(*used(sums[sums[:, -1] > 0.0]), most) for sums, most in groups]
    out = list[np.ndarray]()
    for s in range(1, largest + 1):
        candidates = []
        for sizes, directions, most in spectra:
            gap = sizes[:, s] / sizes[:, s - 1]
            clear = np.flatnonzero(gap > WEAK_GAP)
            candidates.append(orthonormal_rows(directions[clear[np.argsort(-gap[clear])][:most], :s]))
        rows = np.concatenate(candidates)
        out.append(rows[distinct_rows(rows)])
    return out


class Explanation:
    """Hypotheses (constraints) that together explain the recordings, with the state of each sample.

    The gain of each hypothesis is the log-likelihood that it adds to the other ones.

    Args:
        views: All views of the recordings (samples in different feature maps).
        hypotheses: The hypotheses.
        switch: Cost of a change of state [nats].
    """

    def __init__(self, views: Sequence[View], hypotheses: Sequence[Hypothesis], switch: float):
        self.views, self.hypotheses, self.switch = list(views), list(hypotheses), switch
        m = views[0].thin
        self.values, self.states = self.evaluate([v.thin for v in views])
        self.explained = self.values[np.arange(len(self.values)), self.states]
        # evidence of each sample for its best explanation without each of the hypotheses [nats]
        self.others = [np.delete(self.values, k + 1, axis=1).max(axis=1) for k in range(len(hypotheses))]
        for k, h in enumerate(hypotheses):
            gain = np.where(self.states == k + 1, self.values[:, k + 1] - self.others[k], 0.0)
            gains = np.bincount(m.recording, gain, minlength=len(m.first) - 1)
            self.hypotheses[k] = replace(h, gains=gains)
        self.supports = np.array([h.support for h in self.hypotheses])

    def evaluate(self, samples: Sequence[Samples]) -> tuple[np.ndarray, np.ndarray]:
        """Compute the evidence of samples for each hypothesis, and their most likely states.

        Args:
            samples: The same n samples in each view.

        Returns:
            Evidence (n, 1 + h) [nats], with zeros in the first column for free motion; and states (n,), 0 for free
            motion and k + 1 for hypothesis k.
        """
        free = np.zeros(len(samples[0].time))
        each = (evidence(samples[h.view], h.rows[None], [h.scale])[:, 0, 0] for h in self.hypotheses)
        values = np.column_stack([free, *each])
        if not self.hypotheses:
            return values, np.zeros(len(free), dtype=int)
        return values, viterbi(values[:, None, 1:], samples[0].first, self.switch)[0][:, 0]

    def drop_weakest(self) -> Explanation:
        """Return the explanation without the hypothesis that has the smallest support."""
        others = [h for k, h in enumerate(self.hypotheses) if k != int(self.supports.argmin())]
        return Explanation(self.views, others, self.switch)

    def refit(self, k: int, start: Hypothesis) -> Hypothesis:
        """Fit a hypothesis to the samples that hypothesis k explains.

        Args:
            k: Index of the hypothesis whose samples are used.
            start: Hypothesis with the initial rows.

        Returns:
            The fitted hypothesis.
        """
        own_samples = self.states == k + 1
        baseline = np.where((self.states > 0) & ~own_samples, self.others[k], 0.0)
        return fit_hypotheses(self.views, [start], own_samples[:, None], baseline, self.switch)[0]

    def refit_all(self) -> Explanation:
        """Fit each hypothesis to the samples that it explains, and repeat while the total evidence grows.

        Returns:
            Last explanation that increased the evidence.
        """
        best = self
        for _ in range(ROUNDS):
            refitted = [best.refit(k, h) for k, h in enumerate(best.hypotheses)]
            now = Explanation(self.views, refitted, self.switch)
            if now.explained.sum() <= best.explained.sum():
                break
            best = now
        return best

    def has_duplicates(self) -> bool:
        """Return True if the row spaces of two hypotheses differ by less than their allowed residuals."""
        for a, b in combinations(self.hypotheses, 2):
            if a.view == b.view and len(a.rows) == len(b.rows):
                v = self.views[a.view]
                if row_space_angle(v.selection(a.rows), v.selection(b.rows)) < a.scale[1] + b.scale[1]:
                    return True
        return False

    def stretches(self, k: int, fine: np.ndarray | None = None) -> list[Stretch]:
        """Return the stretches of a state, each from its first to its last moving sample.

        A contact at the beginning or end of a recording is extended to the end of the recording.

        Args:
            k: State: 0 for free motion, i + 1 for hypothesis i.
            fine: State of each sample of the whole table; None for the states of the thinned samples of the search.

        Returns:
            The stretches in order.
        """
        view, out = self.views[0], list[Stretch]()
        m, states = (view.thin, self.states) if fine is None else (view.all, fine)
        in_state = m.moving & (states == k)
        edges = np.unique(np.concatenate([np.flatnonzero(np.diff(states)) + 1, m.first]))
        for a, b in pairwise(edges.tolist()):
            inside = a + np.flatnonzero(in_state[a:b])
            if not len(inside):
                continue
            i = int(m.recording[a])
            ends = view.table.ends[i].tolist()
            start, end = m.time[inside[[0, -1]]].tolist()
            long = end - start >= MIN_TIME
            if k:
                start, end = ends[0] if a == m.first[i] else start, ends[1] if b == m.first[i + 1] else end
            if long or not k or [start, end] == ends:
                out.append(Stretch(i, start, end))
        return out


def score_hypotheses(
    views: Sequence[View], trials: Sequence[Hypothesis], scales: Sequence[Scale], baseline: np.ndarray, switch: float
) -> np.ndarray:
    """Compute the log-likelihood that each hypothesis adds to a baseline, for each recording and allowed residual.

    Args:
        views: All views.
        trials: Hypotheses, h of them.
        scales: Allowed residuals, k of them, see `Hypothesis.scale`.
        baseline: Evidence of each sample without these hypotheses, shape (n,) [nats].
        switch: Cost of a change of state [nats].

    Returns:
        Gains (g, h, k) for g recordings [nats].
    """
    max_numbers = 1_000_000  # largest number of values in memory together
    n, first = len(baseline), views[0].thin.first
    out = [np.zeros((len(first) - 1, 0, len(scales)))]
    at_once = max(1, max_numbers // (n * len(scales)))
    for i in range(0, len(trials), at_once):
        values = []
        for (view, _), alike in groupby(trials[i : i + at_once], key=lambda h: (h.view, len(h.rows))):
            rows = np.stack([h.rows for h in alike])
            values.append(evidence(views[view].thin, rows, scales) - baseline[:, None, None])
        gains = viterbi(np.concatenate(values, axis=1).reshape(n, -1, 1), first, switch, path=False)[1]
        out.append(gains.reshape(len(gains), -1, len(scales)))
    return np.concatenate(out, axis=1)


def fit_hypotheses(
    views: Sequence[View], hypotheses: Sequence[Hypothesis], mask: np.ndarray, baseline: np.ndarray, switch: float
) -> list[Hypothesis]:
    """Fit each hypothesis to its samples: choose the rows with the least motion, and the best allowed residual.

    Args:
        views: All views.
        hypotheses: Hypotheses, h of them. A hypothesis with too few moving samples keeps its rows.
        mask: shape (n, h), True for the samples of each hypothesis.
        baseline: Evidence of each sample without these hypotheses, shape (n,) [nats].
        switch: Cost of a change of state [nats].

    Returns:
        Fitted hypotheses; their `gains` are relative to the baseline.
    """
    out = list[Hypothesis]()
    for h, samples in zip(hypotheses, mask.T, strict=True):
        m, (steady, share) = views[h.view].thin, np.square(h.scale)
        if np.count_nonzero(samples & m.moving) >= 3 * m.rates.shape[1]:
            w = np.where(samples, m.weight / (m.noise * steady + m.free * share), 0.0)  # by their expected variance
            M, S = (m.rates.T * w) @ m.rates, np.tensordot(w, m.gram, axes=1)
            h = replace(h, rows=orthonormal_rows(least_used(M[None], S[None], np.zeros(1))[1][0, : len(h.rows)]))
        out.append(h)
    gains = score_hypotheses(views, out, SCALES, baseline, switch)
    best = gains.sum(axis=0).argmax(axis=1)
    return [replace(out[i], scale=SCALES[k], gains=gains[:, i, k]) for i, k in enumerate(best)]


def candidates(now: Explanation, allowed: Sequence[int]) -> list[Hypothesis]:
    """Propose and fit candidates that could extend an explanation, a few for each view and number of rows.

    Args:
        now: Explanation to extend.
        allowed: Indices of the views to search.

    Returns:
        The fitted candidates, not sorted; their `gains` are relative to the explanation.
    """
    most = 4  # largest number of candidates for each view and number of rows
    views, baseline, switch, best = now.views, now.explained, now.switch, list[Hypothesis]()
    maps = [v.features for v in views]
    whole = [f.frame for f in maps if isinstance(f, PlaceRows) and f.form == "point and rotation"]
    for number in allowed:
        f = maps[number]
        # other views include the whole twist; `explain` moves their hypotheses back to this view at the end
        if isinstance(f, FrameJacobian) and (f.reference, f.n_rows) == ("world", 6) and f.frame in whole:
            continue
        for rows in propose_rows(views[number].thin, now.states, views[number].largest, bool(np.isinf(switch))):
            proposals = [Hypothesis(number, one) for one in rows]
            # two scales suffice for a comparison
            gains = score_hypotheses(views, proposals, ((2.0, 0.1), (2.0, 0.01)), baseline, switch)
            support = (gains.sum(axis=0) - (gains.max(axis=0) if len(gains) > 1 else 0.0)).max(axis=1)
            order = np.argsort(-support, kind="stable")
            order = order[support[order] > 0.0]
            best += [proposals[i] for i in order[distinct_rows(rows[order], most)]]
    going, out = fit_hypotheses(views, best, np.zeros((len(baseline), len(best)), dtype=bool), baseline, switch), []
    for _ in range(ROUNDS):
        if not going:
            break
        each = (evidence(views[h.view].thin, h.rows[None], [h.scale])[:, 0, 0] for h in going)
        values = np.column_stack([nats - baseline for nats in each])
        states = viterbi(values[:, :, None], views[0].thin.first, switch)[0] > 0
        pairs = list(zip(going, fit_hypotheses(views, going, states, baseline, switch), strict=True))
        out += [old for old, new in pairs if new.gains.sum() <= old.gains.sum()]
        going = [new for old, new in pairs if new.gains.sum() > old.gains.sum()]
    return out + going


Test = Callable[[View, Hypothesis, Sequence[Stretch]], bool]


def add_hypotheses(now: Explanation, believed: Test, refused: list[Hypothesis], allowed: Sequence[int]) -> Explanation:
    """Add hypotheses that gain enough and that a gate accepts, one at a time.

    Args:
        now: Explanation to extend.
        believed: Gate: function that takes a view, a hypothesis and its stretches, and returns True to accept it.
        refused: Rejected hypotheses, which are not tried again; hypotheses that this call rejects are appended.
        allowed: Indices of the views to search.

    Returns:
        Explanation with the accepted hypotheses.
    """
    # largest number of hypotheses, and of tests by the gate for each addition
    max_constraints, max_tests = 6, 6
    views, seconds = now.views, now.views[0].table.seconds

    def similar(a: Hypothesis, b: Hypothesis) -> bool:
        """Return True if two hypotheses are rows of one view that hardly differ.

        Args:
            a: One hypothesis.
            b: The other hypothesis.
        """
        return a.view == b.view and row_space_angle(a.rows, b.rows) < SAME

    while len(now.hypotheses) < max_constraints:
        ranked = sorted(candidates(now, allowed), key=lambda h: h.price(seconds) - h.support)
        gaining = (h for h in ranked if h.support - h.price(seconds) > LEAST_GAIN)
        for h in islice((h for h in gaining if not any(similar(h, x) for x in refused)), max_tests):
            trial = Explanation(views, [*now.hypotheses, h], now.switch).refit_all()
            last, stretches = trial.hypotheses[-1], trial.stretches(len(trial.hypotheses))
            if last.support > LEAST_GAIN and not trial.has_duplicates() and believed(views[h.view], last, stretches):
                break
            refused.append(h)
        else:
            return now
        while len(trial.hypotheses) > 1 and trial.supports.min() < LEAST_GAIN:
            trial = trial.drop_weakest()
        refused += [h for h in now.hypotheses if not any(similar(h, x) for x in trial.hypotheses)]
        now = trial
    return now


def explain(views: Sequence[View], believed: Test, switch: float, first: int = 0) -> Explanation:
    """Explain the recordings by hypotheses: add one after the other, as long as one gains enough and a gate accepts it.

    Args:
        views: All views of the recordings.
        believed: Gate: function that takes a view, a hypothesis and its stretches, and returns True to accept it.
        switch: Cost of a change between contact and free motion [nats].
        first: Number of views, the first ones, that are of the hand's position; the other views are searched only if
            these explain little of the motion.

    Returns:
        Explanation of the recordings.
    """
    # share of the motion: if the position of the hand explains less, the whole twist is searched
    least_share = 0.2
    refused = list[Hypothesis]()
    now = add_hypotheses(Explanation(views, (), switch), believed, refused, range(first))
    moving = now.states[views[0].thin.moving]
    if np.count_nonzero(moving) < least_share * max(len(moving), 1):
        now = add_hypotheses(now, believed, refused, range(first, len(views)))
    # move each hypothesis to the first view in which as many rows explain no less, net of their price
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
    while now.has_duplicates():
        now = now.drop_weakest()
    return now


def lone_contacts(
    explanation: Explanation, places: Sequence[int], supported: Callable[[View, Stretch], int]
) -> list[Stretch]:
    """Find contacts that appear in one recording only.

    They are reported, so that the user can record them again; nothing is learnt from them.

    Args:
        explanation: Explanation of all recordings.
        places: Indices of the views that are of the hand's position.
        supported: Function that takes a view and a stretch, and returns the number of rows with evidence.

    Returns:
        Stretches of these contacts.
    """
    out = list[Stretch]()
    for i, moved in enumerate(explanation.views[0].table.moved):
        alone = Table([moved])
        views = [v.for_recording(i, alone) for v in explanation.views]
        rest, m = Explanation(views, explanation.hypotheses, explanation.switch), views[0].thin
        free = np.sum(m.weight[(rest.states == 0) & m.moving])
        proposals = candidates(rest, places) if free > MIN_TIME else []
        firm = [h for h in proposals if h.scale[1] <= SLIGHT and h.support > LEAST_GAIN]
        if not firm:
            continue
        h, k = max(firm, key=lambda h: h.support), len(explanation.hypotheses)
        both = Explanation(views, [*explanation.hypotheses, h], explanation.switch)
        values = both.values[:, k + 1] - both.others[k]
        for s in both.stretches(k + 1, both.evaluate([v.all for v in views])[1]):
            # without the quarter that gains most, net of the price, and of the changes into and out of the stretch
            parts = [values[(m.time >= a) & (m.time < b)].sum() for a, b in pairwise(np.linspace(s.start, s.end, 5))]
            worth = sum(parts) - max(parts) - h.price(s.end - s.start) - explanation.switch
            there = s._replace(recording=i)
            if worth > LEAST_GAIN and supported(explanation.views[h.view], there) >= len(h.rows):
                out.append(there)
    return out
