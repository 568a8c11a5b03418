"""Candidate constraints from short windows of the recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.learning.phases.motion import PhaseMotion

# lengths of the windows, and the share of a length by which one starts after the other [s]
WINDOWS = (0.6, 1.2)
STRIDE = 0.5
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


def window_hypotheses(motion: PhaseMotion, largest: int, most: int = MOST) -> list[Hypotheses]:
    """Fits in windows that move, for s = 1 .. largest.

    Each window solves M x = lambda S x with M = sum r r^T and S = sum Phi Phi^T, whose s least eigenvectors are the s
    rows that its motion uses least; sums over windows are differences of cumulative sums.

    Args:
        motion: All samples.
        largest: Largest number of rows.
        most: Number of windows for each number of rows.
    """
    M, S, counts = _window_moments(motion)
    out: list[Hypotheses] = []
    if len(M) == 0:
        return out
    r = M.shape[1]
    floor = np.maximum(1e-9 * np.trace(S, axis1=1, axis2=2)[:, None, None] / r, TINY) * np.eye(r)
    inverse = np.linalg.inv(np.linalg.cholesky(S + floor))
    values, vectors = np.linalg.eigh(inverse @ M @ inverse.transpose(0, 2, 1))
    directions = np.matmul(vectors.transpose(0, 2, 1), inverse)  # rows x with x S x^T = 1
    sizes = np.sqrt(np.maximum(values, counts[:, None]))
    for s in range(1, min(largest, r - 1) + 1):
        gap = sizes[:, s] / sizes[:, s - 1]
        chosen = np.flatnonzero(gap > LEAST_GAP)
        chosen = chosen[np.argsort(-gap[chosen])][:most]
        if len(chosen):
            rows = np.linalg.qr(directions[chosen, :s].transpose(0, 2, 1))[0].transpose(0, 2, 1)
            out.append(Hypotheses(rows))
    return out


def _window_moments(motion: PhaseMotion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M and S of each window, and the variance of its noise."""
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
    parts = []
    for a, b in zip(motion.first[:-1], motion.first[1:], strict=True):
        time = motion.time[a:b]
        for length in WINDOWS:
            starts = np.arange(time[0], max(time[-1] - length, time[0]) + 1e-9, STRIDE * length)
            low, high = np.searchsorted(time, starts), np.searchsorted(time, starts + length)
            sums = total[a + high] - total[a + low]
            parts.append(sums[(sums[:, -2] > 0.5 * length) & (sums[:, -1] > 0.8 * length) & (high - low > 2 * r)])
    sums = np.concatenate(parts)
    M, S = sums[:, : r * r].reshape(-1, r, r), sums[:, r * r : 2 * r * r].reshape(-1, r, r)
    return M, S, sums[:, 2 * r * r] / np.maximum(sums[:, -1], 1e-12)


def fitted_rows(
    motion: PhaseMotion, weights: Float[np.ndarray, " n"], s: int
) -> tuple[Float[np.ndarray, "s r"], Float[np.ndarray, " r"]]:
    """The s rows that the weighted samples use least, orthonormal, and the levels of all directions, least first.

    A level is the root of the mean energy along a direction [rad/s].
    """
    r = motion.rates.shape[1]
    M = (motion.rates * weights[:, None]).T @ motion.rates
    S = np.tensordot(weights, motion.gram, axes=1)
    L = np.linalg.cholesky(S + max(1e-9 * np.trace(S) / r, TINY) * np.eye(r))
    inverse = np.linalg.inv(L)
    values, vectors = np.linalg.eigh(inverse @ M @ inverse.T)
    rows = np.linalg.qr((vectors[:, :s].T @ inverse).T)[0].T
    return rows, np.sqrt(np.maximum(values, 0.0))
