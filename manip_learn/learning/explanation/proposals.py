"""Candidate rows: those that windows, recordings, pairs of either, and everything use least."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.learning.deciding import LONG_WINDOWS_SECONDS, PROPOSAL_GAP, SHORT_WINDOWS_SECONDS
from manip_learn.learning.explanation.row_motion import RowMotion

STRIDE = 0.5  # share of a window's length by which one starts after the other
MOST_PAIRED = 60  # windows that are taken in pairs
# recordings, and pairs of them, that are taken at most: more propose the same rows again
MOST_ALONE, MOST_PAIRS = 16, 24
# windows, and pairs of them, that propose s rows, those with the clearest gaps
MOST = 100
# rows closer together than this are one proposal [rad]
SAME = np.radians(3.0)

# keeps what does not move at all positive definite
TINY = 1e-200


class Moments(NamedTuple):
    """Sums over windows or recordings.

    Attributes:
        M: sum r r^T, shape (w, r, r).
        S: sum Phi Phi^T, shape (w, r, r).
        noise: Variance of the noise, shape (w,) [(rad/s)^2].
        trajectory: Trajectory of each, shape (w,).
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

    @staticmethod
    def joined(parts: Sequence[Moments]) -> Moments:
        """One after the other."""
        return Moments(*map(np.concatenate, zip(*parts, strict=True)))


def proposed(
    motion: RowMotion, states: Int[np.ndarray, " n"], largest: int, *, whole: bool = False
) -> dict[int, Float[np.ndarray, "h s r"]]:
    """Rows for each number of rows s = 1 .. largest, orthonormal.

    Each window or recording solves M x = lambda S x with M = sum r r^T and S = sum Phi Phi^T, whose s least
    eigenvectors are the s rows that its motion uses least. Windows are of what is not explained yet (state 0);
    recordings and pairs of them are of each state by itself, so that rows may be added to an explanation, or it may be
    divided.

    Args:
        motion: Chosen samples.
        states: What explains each of them.
        largest: Largest number of rows.
        whole: Whether a recording is one state throughout, so that no window says more than it.
    """
    out: dict[int, list[np.ndarray]] = {s: [] for s in range(1, largest + 1)}
    wholes = [part for k in range(int(states.max(initial=0)) + 1) for part in _recordings(motion, states == k)]
    windows = [] if whole else _windows(motion, states == 0)
    for parts, most in ((wholes, None), (windows, MOST)):
        moments = Moments.joined(parts) if parts else None
        if moments is None or not len(moments.M):
            continue
        sizes, directions = _least_used(moments)
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
    apart = s - projectors @ projectors.T > np.sin(SAME) ** 2
    left, kept = np.arange(h), list[int]()
    while len(left) and (most is None or len(kept) < most):
        kept.append(int(left[0]))
        left = left[apart[left[0], left]]
    return kept


def _windows(motion: RowMotion, chosen: Bool[np.ndarray, " n"]) -> list[Moments]:
    """Windows of these samples, and windows of two recordings together."""
    motion = dataclasses.replace(motion, weight=motion.weight * chosen)
    parts, long = [_window_moments(motion, SHORT_WINDOWS_SECONDS)], _window_moments(motion, LONG_WINDOWS_SECONDS)
    if len(long.M) > 1:
        sizes, _ = _least_used(long)
        long = long.chosen(np.argsort(-np.max(sizes[:, 1:] / sizes[:, :-1], axis=1))[:MOST_PAIRED])
        first, second = np.triu_indices(len(long.M), 1)
        apart = long.trajectory[first] != long.trajectory[second]
        parts.append(long.paired(first[apart], second[apart]))
    return parts


def _recordings(motion: RowMotion, chosen: Bool[np.ndarray, " n"]) -> list[Moments]:
    """These samples of each recording, of pairs of recordings, and of all."""
    starts, weight = motion.first[:-1], motion.weight * chosen
    products = motion.rates[:, :, None] * motion.rates[:, None, :]
    M = np.add.reduceat(products * weight[:, None, None], starts, axis=0)
    S = np.add.reduceat(motion.gram * weight[:, None, None], starts, axis=0)
    shown = np.flatnonzero(np.add.reduceat(weight, starts) > 0.0)
    if not len(shown):
        return []
    each = Moments(M, S, motion.noise[starts], np.arange(len(M)))
    few = shown[:: max(1, len(shown) // MOST_ALONE)]
    pairs = np.array(list(combinations(few, 2)), dtype=np.int64).reshape(-1, 2)
    pairs = pairs[:: max(1, -(-len(pairs) // MOST_PAIRS))]
    together = Moments(M.sum(axis=0)[None], S.sum(axis=0)[None], each.noise[shown].mean()[None], np.zeros(1, np.int64))
    return [each.chosen(few), each.paired(pairs[:, 0], pairs[:, 1]), together]


def _least_used(moments: Moments) -> tuple[Float[np.ndarray, "w r"], Float[np.ndarray, "w r r"]]:
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
    n = len(motion)
    columns = np.concatenate(
        [
            (motion.rates[:, :, None] * motion.rates[:, None, :]).reshape(n, -1),
            motion.gram.reshape(n, -1),
            motion.noise[:, None],
            motion.moving[:, None].astype(float),
            np.ones((n, 1)),
        ],
        axis=1,
    )
    total = np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(columns * motion.weight[:, None], axis=0)])
    parts, numbers = [], []
    for i, (a, b) in enumerate(zip(motion.first[:-1], motion.first[1:], strict=True)):
        time = motion.time[a:b]
        for length in lengths:
            starts = np.arange(time[0], max(time[-1] - length, time[0]) + 1e-9, STRIDE * length)
            low, high = np.searchsorted(time, starts), np.searchsorted(time, starts + length)
            sums = total[a + high] - total[a + low]
            kept = (sums[:, -2] > 0.5 * length) & (sums[:, -1] > 0.8 * length) & (high - low > 2 * r)
            parts.append(sums[kept])
            numbers.append(np.full(np.count_nonzero(kept), i))
    sums = np.concatenate(parts) if parts else np.zeros((0, columns.shape[1]))
    M, S = sums[:, : r * r].reshape(-1, r, r), sums[:, r * r : 2 * r * r].reshape(-1, r, r)
    noise = sums[:, 2 * r * r] / np.maximum(sums[:, -1], 1e-12)
    return Moments(M, S, noise, np.concatenate(numbers).astype(np.int64))


def fitted_rows(motion: RowMotion, weights: Float[np.ndarray, "n h"], s: int) -> Float[np.ndarray, "h s r"]:
    """The s rows that the weighted samples use least, orthonormal, for each set of weights."""
    n, r = motion.rates.shape
    products = (motion.rates[:, :, None] * motion.rates[:, None, :]).reshape(n, r * r)
    M, S = ((weights.T @ one).reshape(-1, r, r) for one in (products, motion.gram.reshape(n, r * r)))
    _, directions = _least_used(Moments(M, S, np.zeros(len(M)), np.zeros(len(M), dtype=np.int64)))
    return np.linalg.qr(directions[:, :s].transpose(0, 2, 1))[0].transpose(0, 2, 1)
