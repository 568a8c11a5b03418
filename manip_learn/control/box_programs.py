"""Many small programs of one shape at once: the nearest velocity within bounds, where few directions count for much."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.control.law import FINE

MOST_ROUNDS = 20  # of Newton's steps; of 20,000 programs of a Sawyer at its limits none took more than 7


def nearest_in_boxes(
    W: Float[np.ndarray, "s nv n"],
    low: Float[np.ndarray, "nv n"],
    high: Float[np.ndarray, "nv n"],
    z: Float[np.ndarray, "s n"],
) -> tuple[Float[np.ndarray, "nv n"], Float[np.ndarray, "s n"], Bool[np.ndarray, " n"]]:
    """argmin |W y|^2 + |y|^2 with low <= y <= high, of n programs at once; z; and which of them were solved.

    With z = W y the solution is y = clip(-W^T z, low, high): as many unknowns as W has rows, the root of the slope of

        f(z) = |z|^2 / 2 + sum_j h_j(-w_j^T z),    dh_j(x) / dx = clip(x, low_j, high_j),

    w_j the columns of W. f is convex, and quadratic as long as no joint comes to a bound or leaves one. Newton's steps,
    each as far as f falls along it, end after a finite number (Li and Swetits, "A new algorithm for solving strictly
    convex quadratic programs", 1997). W^T W, whose large numbers hide the 1 of |y|^2, is never formed.

    Args:
        W: Rows.
        low: Lowest y.
        high: Highest y.
        z: Where to begin: that of a program like it, or 0.
    """
    (s, nv, n), left = W.shape, np.arange(z.shape[1])
    y, end, solved = np.zeros((nv, n)), z.copy(), np.zeros(n, bool)
    x = _back(W, z)
    for _ in range(MOST_ROUNDS):
        bound = np.clip(x, low, high)
        free = bound == x
        bound[free] = 0.0
        K = np.einsum("sjn,tjn->stn", W * free, W)
        K[np.arange(s), np.arange(s)] += 1.0
        newton = _solved(K, np.einsum("sjn,jn->sn", W, bound))
        ahead = _back(W, newton)
        stays = np.where(free, (low - FINE <= ahead) & (ahead <= high + FINE), np.clip(ahead, low, high) == bound)
        done = stays.all(axis=0)
        y[:, left[done]] = np.where(free, ahead, bound)[:, done]
        end[:, left[done]], solved[left[done]] = newton[:, done], True
        if done.all():
            break
        go = np.flatnonzero(~done)
        W, low, high, z, x, newton, ahead = (a.take(go, axis=-1) for a in (W, low, high, z, x, newton, ahead))
        left, way, step = left[go], newton - z, ahead - x
        share = _least_along(np.einsum("sn,sn->n", z, way), np.einsum("sn,sn->n", way, way), x, step, low, high)
        z, x = z + share * way, x + share * step
    return y, end, solved


def _back(W: Float[np.ndarray, "s nv n"], z: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "nv n"]:
    return np.negative(np.einsum("sjn,sn->jn", W, z))


def _least_along(
    zp: Float[np.ndarray, " n"],
    pp: Float[np.ndarray, " n"],
    x: Float[np.ndarray, "nv n"],
    e: Float[np.ndarray, "nv n"],
    low: Float[np.ndarray, "nv n"],
    high: Float[np.ndarray, "nv n"],
) -> Float[np.ndarray, " n"]:
    """t where f(z + t p) is least: its slope z^T p + t p^T p + e^T clip(x + t e, low, high) rises, and has corners."""
    per = 1.0 / np.where(e == 0.0, np.inf, e)
    corners = np.maximum(np.concatenate(((low - x) * per, (high - x) * per, np.zeros((1, len(zp))))), 0.0)
    slope = zp + corners * pp + np.einsum("jn,cjn->cn", e, np.clip(x + corners[:, None] * e, low, high))
    before = np.where(slope <= 0.0, corners, 0.0).max(axis=0)
    after = np.where(slope > 0.0, corners, np.inf).min(axis=0)
    between = x + np.where(np.isfinite(after), 0.5 * (before + after), before + 1.0) * e
    rate = pp + np.einsum("jn,jn->n", e * e, (low < between) & (between < high))
    here = zp + before * pp + np.einsum("jn,jn->n", e, np.clip(x + before * e, low, high))
    return np.minimum(before - here / rate, after)


def _solved(K: Float[np.ndarray, "s s n"], r: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "s n"]:
    """The solutions of n systems of equations, K symmetric."""
    if len(K) == 1:
        return r / K[0]
    if len(K) == 2:  # a tenth of the time of LAPACK's calls
        (a, b), (_, c) = K
        return np.stack((c * r[0] - b * r[1], a * r[1] - b * r[0])) / (a * c - b * b)
    return np.linalg.solve(np.moveaxis(K, -1, 0), r.T[..., None])[..., 0].T
