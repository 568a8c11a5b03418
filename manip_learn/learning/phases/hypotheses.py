"""Candidate constraints from short windows of the recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.learning.phases.motion import PhaseMotion

# lengths of the windows, and the share of a length by which one starts after the other [s]
WINDOWS = (0.6, 1.2)
STRIDE = 0.5
# of windows that are fitted in pairs, and how many of them at most, those with the clearest gaps
LONG_WINDOWS = (1.2, 2.0)
MOST_PAIRED = 60
# a window speaks for s rows if its s-th level is this much below the next one
LEAST_GAP = 2.5
# hypotheses of one number of rows that are scored, those with the clearest gaps
MOST = 400

# keeps what does not move at all positive definite
TINY = 1e-200


@final
@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Row spaces of one dimension, in whitened rows.

    Attributes:
        rows: Orthonormal, shape (h, s, p').
    """

    rows: Float[np.ndarray, "h s r"]


# (all samples, largest number of rows, number of hypotheses for each number of rows) -> hypotheses
Propose = Callable[[PhaseMotion, int, int], list[Hypotheses]]


def window_hypotheses(motion: PhaseMotion, largest: int, most: int = MOST) -> list[Hypotheses]:
    """Fits in windows that move, for s = 1 .. largest.

    Each window solves M x = lambda S x with M = sum r r^T and S = sum Phi Phi^T, whose s least eigenvectors are the s
    rows that its motion uses least; sums over windows are differences of cumulative sums.

    Args:
        motion: All samples.
        largest: Largest number of rows.
        most: Number of windows for each number of rows.
    """
    moments = _window_moments(motion, WINDOWS)
    out: list[Hypotheses] = []
    if len(moments.M) == 0:
        return out
    sizes, directions = _least_used(moments)
    for s in range(1, min(largest, moments.M.shape[1] - 1) + 1):
        gap = sizes[:, s] / sizes[:, s - 1]
        chosen = np.flatnonzero(gap > LEAST_GAP)
        chosen = chosen[np.argsort(-gap[chosen])][:most]
        if len(chosen):
            rows = np.linalg.qr(directions[chosen, :s].transpose(0, 2, 1))[0].transpose(0, 2, 1)
            out.append(Hypotheses(rows))
    return out


def paired_hypotheses(motion: PhaseMotion, largest: int, most: int = MOST) -> list[Hypotheses]:
    """Single rows fitted to two windows of different recordings together.

    One window shows a part of a curved surface that many other surfaces fit as well. What two recordings share is
    determined by a window of each, M = M_1 + M_2 and S = S_1 + S_2; pairs of which one is free motion have no gap.

    Args:
        motion: All samples.
        largest: Largest number of rows; one is all that is looked for.
        most: Number of pairs.
    """
    moments = _window_moments(motion, LONG_WINDOWS)
    if largest < 1 or len(moments.M) < 2:
        return []
    sizes, _ = _least_used(moments)
    moments = moments.chosen(np.argsort(-sizes[:, 1] / sizes[:, 0])[:MOST_PAIRED])
    first, second = np.triu_indices(len(moments.M), 1)
    apart = moments.trajectory[first] != moments.trajectory[second]
    pairs = moments.paired(first[apart], second[apart])
    sizes, directions = _least_used(pairs)
    gap = sizes[:, 1] / sizes[:, 0]
    chosen = np.flatnonzero(gap > LEAST_GAP)
    rows = directions[chosen[np.argsort(-gap[chosen])][:most], :1]
    return [Hypotheses(rows / np.linalg.norm(rows, axis=2, keepdims=True))] if len(rows) else []


@final
@dataclass(frozen=True, eq=False)
class _Moments:
    """Sums over windows.

    Attributes:
        M: sum r r^T, shape (w, p', p').
        S: sum Phi Phi^T, shape (w, p', p').
        noise: Variance of the noise, shape (w,) [(rad/s)^2].
        trajectory: Trajectory of each window, shape (w,).
    """

    M: Float[np.ndarray, "w r r"]
    S: Float[np.ndarray, "w r r"]
    noise: Float[np.ndarray, " w"]
    trajectory: Int[np.ndarray, " w"]

    def chosen(self, numbers: Int[np.ndarray, " k"]) -> _Moments:
        """Some of the windows."""
        return _Moments(self.M[numbers], self.S[numbers], self.noise[numbers], self.trajectory[numbers])

    def paired(self, first: Int[np.ndarray, " k"], second: Int[np.ndarray, " k"]) -> _Moments:
        """The sums over two windows together."""
        noise = 0.5 * (self.noise[first] + self.noise[second])
        return _Moments(self.M[first] + self.M[second], self.S[first] + self.S[second], noise, self.trajectory[first])


def _least_used(moments: _Moments) -> tuple[Float[np.ndarray, "w r"], Float[np.ndarray, "w r r"]]:
    """Levels of all directions of each window, least first and at least the noise, and the directions as rows."""
    M, S = moments.M, moments.S
    r = M.shape[1]
    floor = np.maximum(1e-9 * np.trace(S, axis1=1, axis2=2)[:, None, None] / r, TINY) * np.eye(r)
    inverse = np.linalg.inv(np.linalg.cholesky(S + floor))
    values, vectors = np.linalg.eigh(inverse @ M @ inverse.transpose(0, 2, 1))
    directions = np.matmul(vectors.transpose(0, 2, 1), inverse)  # rows x with x S x^T = 1
    return np.sqrt(np.maximum(values, moments.noise[:, None])), directions


def _window_moments(motion: PhaseMotion, lengths: Sequence[float]) -> _Moments:
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
    sums = np.concatenate(parts)
    M, S = sums[:, : r * r].reshape(-1, r, r), sums[:, r * r : 2 * r * r].reshape(-1, r, r)
    noise = sums[:, 2 * r * r] / np.maximum(sums[:, -1], 1e-12)
    return _Moments(M, S, noise, np.concatenate(numbers).astype(np.int64))


def fitted_rows(
    motion: PhaseMotion, weights: Float[np.ndarray, " n"], s: int
) -> tuple[Float[np.ndarray, "s r"], Float[np.ndarray, " r"]]:
    """The s rows that the weighted samples use least, orthonormal, and the levels of all directions, least first.

    A level is the root of the mean energy along a direction [rad/s].
    """
    M = (motion.rates * weights[:, None]).T @ motion.rates
    return rows_of_moments(M, np.tensordot(weights, motion.gram, axes=1), s)


def rows_of_moments(
    M: Float[np.ndarray, "r r"], S: Float[np.ndarray, "r r"], s: int
) -> tuple[Float[np.ndarray, "s r"], Float[np.ndarray, " r"]]:
    """The same from the weighted sums of r r^T and of Phi Phi^T."""
    r = len(M)
    L = np.linalg.cholesky(S + max(1e-9 * np.trace(S) / r, TINY) * np.eye(r))
    inverse = np.linalg.inv(L)
    values, vectors = np.linalg.eigh(inverse @ M @ inverse.T)
    rows = np.linalg.qr((vectors[:, :s].T @ inverse).T)[0].T
    return rows, np.sqrt(np.maximum(values, 0.0))
