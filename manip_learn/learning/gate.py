"""Accept or reject rows as constrained: by the recombination test, or because they rest at one value each time.

The recombination test aligns the recordings in phase (the share of the path covered) and exchanges their joints at
random: joint 1 moves as in recording a, joint 2 as in b, and so on. Each joint keeps its own motion; only the
coordination that a contact enforces is lost. The strength of a row is the ratio by which its motion grows; the rank of
the recorded motion among the recombined ones is its p-value.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import counted
from manip_learn.learning.repeats import drop_duplicates
from manip_learn.learning.search import Hypothesis, least_used
from manip_learn.learning.table import CLEAR_GAP, OVER_NOISE, SLIGHT, STRENGTH, Stretch, View, tangents, whitening
from manip_learn.recordings.trajectory import Trajectory

FEWEST = 3  # smallest number of recordings for clear evidence
CHANCE = 0.01  # largest p-value of a supported row
NODES = 4  # postures in a bin of phase. Set by hand


class RowSupport(NamedTuple):
    """Evidence that one row is constrained, from the recombination test.

    Attributes:
        strength: Motion along the row if the joints moved independently, divided by the recorded motion along it.
        p_value: Probability of as little motion along the row as recorded, if the joints moved independently.
        state: `"held"` (constrained), `"free"`, or `"untried"` if the recordings hardly exercise the row.
    """

    strength: float
    p_value: float
    state: str


@dataclass(frozen=True)
class Evidence:
    """Evidence from the recombination test for each row, most firmly constrained first.

    Attributes:
        strengths, lower: Strength of each row (see `RowSupport`), and its lower bound with 99 % confidence, shape (r,).
        chances: p-value of each row, shape (r,).
        levels: Recorded RMS displacement along each row, relative to the motion of the joints, shape (r,).
        n_pieces: Number of pieces of recordings whose joints were exchanged.
        believed: Smallest lower bound of a strength with which a row is accepted.
        firm: Number of rows that are accepted without recombination, because they rest at one value each time.
    """

    strengths: np.ndarray
    lower: np.ndarray
    chances: np.ndarray
    levels: np.ndarray
    n_pieces: int
    believed: float = STRENGTH
    firm: int = 0

    @property
    def n_rows(self) -> int:
        """Number of rows with evidence of a constraint; they are the first ones."""
        n = 0
        rows = zip(self.strengths, self.lower, self.chances, self.levels, strict=True)
        for i, (strength, lower, p, level) in enumerate(rows):
            if strength < self.believed and level <= self.believed * self.levels[0]:
                continue  # not exercised, nor by exchanged joints: it counts with a held row after it
            if p > CHANCE or strength < self.believed:
                break
            n = i + 1 if lower >= self.believed else n
        return max(n, min(self.firm, len(self.strengths)))

    def verdict(self, s: int, fewest: int = FEWEST) -> str:
        """Rate the evidence that the first s rows are constrained.

        Args:
            s: Number of rows.
            fewest: Smallest number of pieces of recordings for clear evidence.

        Returns:
            `"none"`, `"weak"` or `"clear"`.
        """
        clear = self.n_pieces >= fewest and 0 < s <= self.n_rows and self.lower[s - 1] >= max(OVER_NOISE, self.believed)
        return "none" if not self.n_rows else "clear" if clear else "weak"

    @property
    def rows(self) -> tuple[RowSupport, ...]:
        """Evidence for each row, most firmly constrained first."""
        n, most = self.n_rows, max(self.levels, default=0.0)
        states = ["held"] * n + ["free" if x >= most / 6.0 and x > 0.0 else "untried" for x in self.levels[n:]]
        return tuple(map(RowSupport, self.strengths.tolist(), self.chances.tolist(), states))

    def sentence(self) -> str:
        """Return the evidence in words."""
        if not len(self.strengths):
            return "the recordings do not move, so no row can be tested"
        if not (n := self.n_rows):
            best = f"best strength {self.strengths[0]:.2g}, with 99 % confidence above {self.lower[0]:.2g}"
            return f"no row is confirmed ({best}; at least {self.believed:g} is needed)"
        soft, firm = "held softly, or only by habit", "held firmly at one place each time, or never exercised"
        state = "held" if self.verdict(n) == "clear" else firm if n == self.firm else soft
        strengths = ", ".join(f"{x:.3g}" for x in self.strengths[:n])
        text = f"{counted(n, 'row')} {state} (strength {strengths}, p = {max(self.chances[:n]):.2g})"
        few = f"; too few to be sure with {self.n_pieces} recordings, record 5 or more"
        return text if self.n_pieces >= FEWEST else text + few


def _aligned(pieces: Sequence[Trajectory], scale: np.ndarray, n_bins: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pieces at evenly spaced phases: postures, displacements relative to their length, weights of the bins.

    Backward strokes are reversed, and so are pieces that mostly run backward: A u = 0 also holds for -u.

    Args:
        pieces: g pieces.
        scale: Array (nv,), usual size of each velocity.
        n_bins: Number of bins k of `NODES` steps each.

    Returns:
        Arrays (g, k NODES, nq), (g, k NODES, nv) and (g, k).
    """
    aligned = []
    for t in pieces:
        time, u = t.time, np.asarray(t.u)
        half = 0.5 * np.diff(time)[:, None]
        rate = np.linalg.norm(u / scale, axis=1, keepdims=True)
        rates = np.concatenate([u, rate + 1e-6 * rate.mean()], axis=1)
        ways = np.insert(np.cumsum(half * (rates[1:] + rates[:-1]), axis=0), 0, 0.0, axis=0).T
        length = ways[-1, -1]
        at = np.interp(np.linspace(0.0, 1.0, 2 * NODES * n_bins + 1), ways[-1] / length, time)
        nodes = np.stack([np.interp(at[::2], time, way) for way in ways[:-1]], axis=1)
        q = np.stack([np.interp(at[1::2], time, x) for x in t.q.T], axis=1)
        weight = 1.0 / np.maximum(np.diff(at[:: 2 * NODES]), 1e-12 * t.duration)
        aligned.append((q, np.diff(nodes, axis=0) / length, length**2 * weight / weight.mean()))
    q, steps, weight = (np.stack(x) for x in zip(*aligned, strict=True))
    bins = steps.reshape(len(steps), n_bins, NODES, -1).sum(axis=2) / scale
    common = np.linalg.svd(np.concatenate(bins), full_matrices=False)[2][0]
    for i, direction in enumerate(np.linalg.svd(bins, full_matrices=False)[2][:, 0]):
        along = bins[i] @ (direction if direction @ common >= 0.0 else -direction)
        steps[i] *= np.repeat(np.where(along < 0.0, -1.0, 1.0), NODES)[:, None]
        if along.sum() < -0.5 * np.abs(along).sum():
            q[i], steps[i], weight[i] = q[i, ::-1], steps[i, ::-1], weight[i, ::-1]
    return q, steps, weight


def recombination_test(
    features: FeatureMap, pieces: Sequence[Trajectory], seed: int = 0, choices: float = 1.0, believed: float = STRENGTH
) -> Evidence:
    """Test if combinations of feature rows are constrained, by exchanging the joints' motions between recordings.

    See the docstring of this module.

    Args:
        features: Feature map Phi.
        pieces: Recorded motions during contact, with velocities.
        seed: Seed of the random exchanges.
        choices: Number of hypotheses among which the tested one was selected (Bonferroni correction).
        believed: Smallest 99 % lower confidence bound of a strength with which a row is accepted.

    Returns:
        Evidence for each row, most firmly constrained first.
    """
    # largest number of phase bins, duration of a bin [s], and largest number of pieces. Set by hand
    max_bins, bin_seconds, max_pieces = 24, 0.25, 16
    # number of recombinations at first, and largest number if the result is not decided; smaller levels may be
    # interpolation errors; normal quantile of that decision
    n_first, n_last, floor, sure = 199, 3184, 1e-5, NormalDist().inv_cdf(0.995)
    rng, none = np.random.default_rng(seed), np.zeros(0)
    pieces = [t for t in pieces if len(t) > 2 and np.any(t.u)]
    if len(pieces) > max_pieces:
        pieces = [pieces[i] for i in np.sort(rng.choice(len(pieces), max_pieces, replace=False))]
    if not pieces:
        return Evidence(none, none, none, none, 0)
    size = np.sqrt(np.mean([np.mean(np.square(np.asarray(t.u)), axis=0) for t in pieces], axis=0))
    scale = np.maximum(size, 0.3 * size.max())
    most = int(min(max_bins, max(np.median([len(t) for t in pieces]) // 2, 1)))
    n_bins = int(np.clip(round(float(np.median([t.duration for t in pieces])) / bin_seconds), min(4, most), most))
    (q, steps, weight), g = _aligned(pieces, scale, n_bins), len(pieces)
    Phi = np.stack([features.batch(x) for x in q])
    W = whitening(Phi.reshape(-1, *Phi.shape[2:]), features.row_units)
    if not len(W):
        return Evidence(none, none, none, none, g)
    bins = steps.reshape(g, n_bins, NODES, -1).sum(axis=2)
    if g < FEWEST:  # too few pieces to exchange joints: joints are also shifted in phase against each other
        steps = np.concatenate([np.roll(steps, round(k * NODES * n_bins / 8), axis=1) for k in range(8)])
    parts = np.einsum("gnpv,anv->gnvap", W @ Phi, steps)
    parts = parts.reshape(g, n_bins, NODES, *parts.shape[2:]).sum(axis=2) * np.sqrt(weight)[:, :, None, None, None]
    energy = float(np.mean(weight[:, :, None] * bins**2))

    def moments(order: np.ndarray) -> np.ndarray:
        """Return the mean of r r^T over the bins of each piece for m arrangements of the joints.

        Args:
            order: Array (m, nv, g), piece that each joint is taken from.
        """
        out = []
        for some in np.array_split(order, -(-len(order) // 64)):
            motion = np.sum([parts[np.arange(g), :, v, some[:, v]] for v in range(features.nv)], axis=0)
            out.append(motion.transpose(0, 1, 3, 2) @ motion / n_bins)
        return np.concatenate(out)

    (recorded,) = moments(np.broadcast_to(np.arange(g), (1, features.nv, g)))
    held_out = np.zeros(len(W))
    if g > 1:  # a few strokes leave some direction unused by chance; the next stroke uses it
        others = np.linalg.eigh((recorded.sum(axis=0) - recorded) / (g - 1))[1]
        squares = np.mean(np.einsum("dis,dij,djs->ds", others, recorded, others), axis=0)
        held_out = np.sqrt(np.maximum(squares, 0.0) / energy)
    z = -NormalDist().inv_cdf(max(CHANCE / choices, 1e-300))
    mean = recorded.mean(axis=0)
    directions, all_moments, n = np.linalg.eigh(mean)[1].T, mean[None], 0
    while True:
        n = max(n_first, 4 * n)
        shape = (n + 1 - len(all_moments), features.nv, g)
        order = np.argsort(rng.random(shape), axis=2) if len(steps) == g else rng.integers(0, len(steps), shape)
        all_moments = np.concatenate([all_moments, moments(order).mean(axis=1)])
        # search for row s outside rows 1 .. s-1 of the recorded motion, also in the recombined motions
        turned = directions @ all_moments @ directions.T
        least = np.stack([np.linalg.eigvalsh(turned[:, s:, s:])[:, 0] for s in range(len(W))], axis=1)
        levels = np.maximum(np.sqrt(np.maximum(least, 0.0) / energy), floor)
        ratios = levels[1:] / np.maximum(held_out, levels[0])
        strengths, spread = np.median(ratios, axis=0), np.std(np.log(np.maximum(ratios, floor)), axis=0)
        chances = (1.0 + np.count_nonzero(levels[1:] <= levels[0], axis=0)) / (1.0 + n)
        evidence = Evidence(strengths, strengths * np.exp(-z * spread), chances, levels[0], g, believed)
        error = sure * math.sqrt((0.5 * math.pi + 0.5 * z**2) / n) * spread
        near = np.abs(np.log(np.maximum(evidence.lower, 1e-300) / believed)) < error
        near |= (np.abs(chances - CHANCE) < sure * math.sqrt(CHANCE / n)) & (chances * (n + 1) > 1.5)
        decided = np.append((chances > CHANCE) | (strengths < believed), True)
        if n >= n_last or not near[: np.argmax(decided) + 1].any():
            return evidence


def simultaneous_joints(u: np.ndarray, noise: float) -> tuple[float, float]:
    """Measure how many joints move at the same time.

    Args:
        u: Joint velocities (n, nv) [rad/s or m/s].
        noise: Variance of the noise of the velocities [(rad/s)^2].

    Returns:
        Effective number of joints that move at once (1 if only one joint moves at a time, 0 at rest); and the mean
        square velocity of all joints but the fastest, divided by `noise`.
    """
    square = u**2
    others = np.sort(np.mean(square, axis=0))[:-1].mean() / max(noise, 1e-300)
    square = square[np.sum(square, axis=1) > OVER_NOISE**2 * noise * square.shape[1]]
    at_once = np.median(np.sum(square, axis=1) ** 2 / np.sum(square**2, axis=1)) if len(square) else 0.0
    return float(at_once), float(others)


def is_firm(view: View, rows: np.ndarray, share: float, stretches: Sequence[Stretch]) -> bool:
    """Return whether rows rest at one value in at least three recordings, each time after a motion along them.

    During the stretches the rows move no more than the noise, and far less than free rows. The recombination test does
    not apply to such rows, because joints at rest have no motion to exchange.

    Args:
        view: View of the rows.
        rows: Whitened rows (s, r).
        share: Share of the velocity of free motion that violates the rows.
        stretches: Stretches in which the rows are supposed to be constrained.

    Returns:
        True if all conditions hold.
    """
    table, m, s, recordings = view.table, view.all, len(rows), {x.recording for x in stretches}
    if len(recordings) < FEWEST or share > SLIGHT or table.q.shape != table.u.shape or s >= view.r:
        return False
    inside = table.inside(stretches)
    w = m.weight * inside
    M, S = (m.rates.T * w) @ m.rates, np.tensordot(w, m.gram, axes=1)
    (sizes,), _ = least_used(M[None], S[None], m.noise[inside].mean()[None])
    if sizes[s] < OVER_NOISE * CLEAR_GAP * sizes[s - 1]:
        return False
    middles, approaches = [], []
    for x in stretches:
        way = view.way((m.recording == x.recording) & (m.time < x.start), rows)
        approaches.append(np.linalg.norm(np.ptp(way, axis=0)) if len(way) else 0.0)
        t = table.moved[x.recording]
        middles.append(t.q[np.searchsorted(t.time, 0.5 * (x.start + x.end))])
    off, features = [], view.features
    for line in (np.linspace(middles[0], q, 21) for q in middles[1:]):
        steps = tangents(features.robot, line)
        moved = np.einsum("npv,nv->p", features.batch(0.5 * (line[1:] + line[:-1])), steps)
        off.append(np.linalg.norm(rows @ view.W @ moved))
    return bool(max(off) <= SLIGHT * np.median(approaches))


@dataclass(frozen=True)
class Gate:
    """Test if candidate rows are constrained: `gate(view, hypothesis, stretches)` is True if there is evidence.

    It allows for the selection of the rows as the best of many candidates (views of the features, numbers of rows).

    Attributes:
        seed: Seed of the random exchanges of the recombination test.
        believed: A row is accepted if the 99 % lower confidence bound of its strength is at least this.
    """

    seed: int = 0
    believed: float = STRENGTH

    def evidence(self, view: View, stretches: Sequence[Stretch], choices: float | None = None) -> Evidence:
        """Apply the recombination test to some stretches.

        Args:
            view: View of the rows.
            stretches: Stretches in which the rows are supposed to be constrained.
            choices: Number of hypotheses among which the tested one was selected. None to compute it: number of ways to
                choose that many stretches of this length from all recordings, times the hypotheses of all views.

        Returns:
            Evidence for each row, most firmly constrained first.
        """
        pieces = drop_duplicates(view.table, stretches)
        m, n, numbers = view.thin, len(view.table.moved), Counter(s.recording for s in pieces)
        moving = m.weight * m.moving
        whole = np.bincount(m.recording, moving, minlength=n)
        log_ways = math.lgamma(n + 1) - math.lgamma(len(numbers) + 1) - math.lgamma(n - len(numbers) + 1)
        log_ways -= sum(math.lgamma(k + 1) for k in numbers.values())
        for s in pieces:
            span = np.sum(moving[(m.recording == s.recording) & (m.time >= s.start) & (m.time <= s.end)])
            log_ways += math.log(whole[s.recording] / span) if span > 0.0 else 0.0
        ways = view.tried * math.exp(min(max(log_ways, 0.0), 700.0))  # larger numbers overflow
        choices = ways if choices is None else choices
        return recombination_test(view.features, list(pieces.values()), self.seed, choices, self.believed)

    def __call__(self, view: View, h: Hypothesis, stretches: Sequence[Stretch]) -> bool:
        """Return True if there is evidence that rows are constrained, from the recombination test or `is_firm`.

        Args:
            view: View of the rows.
            h: Hypothesis with the rows.
            stretches: Stretches in which the rows are supposed to be constrained.
        """
        if view.curved and len(h.rows) > 2:  # three surfaces meet in points
            return False
        agreeing = view.steady_stretches(h.rows, stretches)
        for some in (stretches, agreeing) if len(agreeing) < len(stretches) else (stretches,):
            recs = {s.recording for s in some}
            if not recs or len(recs) < min(2, len(view.table.moved)):
                return False
            table = view.table
            each = [(np.asarray(p.u), table.noises[s.recording]) for s, p in drop_duplicates(table, some).items()]
            together, others = np.median([simultaneous_joints(*x) for x in each], axis=0) if each else (0.0, 0.0)
            if together >= 1.1 or others >= OVER_NOISE**2:
                evidence = self.evidence(view, some)
                s = len(h.rows)
                if evidence.n_rows >= s and (len(recs) >= FEWEST or evidence.verdict(s, 0) == "clear"):
                    return True
        return is_firm(view, h.rows, h.scale[1], stretches)
