"""Joint-limit avoidance by saturation in the null space: the task, and the policy, go on when joints are at limits."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.linalg import null_basis

# scale factors of the task velocity that are tried, largest first
TASK_SCALES = (1.0, 0.5, 0.25, 0.1)
# the null space can move the saturated joints if all singular values of their rows of the null basis are above this
LEAST_SINGULAR_VALUE = 1e-3
# [rad/s or m/s] tolerance on a bound
ROUNDING = 1e-10
# a null-space velocity that must be scaled by less than this is blocked by a joint at its bound
BLOCKED = 1e-6


@final
class NullSpaceSaturation(NamedTuple):
    """How the task can go on with joints at their bounds.

    Attributes:
        task_scale: Factor on the task part, 0 to 1.
        null_part: Null-space velocity to be added to the scaled task part, shape (nv,).
        null_scale: Factor on the policy's velocity in the freedom that is left, 0 to 1.
    """

    task_scale: float
    null_part: Float[np.ndarray, " nv"]
    null_scale: float


def saturate_null_space(
    task_part: Float[np.ndarray, " nv"],
    null_part: Float[np.ndarray, " nv"],
    A: Float[np.ndarray, "s nv"],
    low: Float[np.ndarray, " nv"],
    high: Float[np.ndarray, " nv"],
    better_than: float,
) -> NullSpaceSaturation | None:
    """The largest of `TASK_SCALES` at which null-space motion brings the task part within the bounds.

    Saturation in the null space (Flacco, De Luca and Khatib, 2012), in its null-basis form. Let Z be the null basis of
    A, Z_S its rows for the saturated joints S, v the scaled task part and c the bounds that v exceeds:

        w = Z (Z_S)^+ (c_S - v_S),

    the smallest null-space velocity that puts the joints S on their bounds. The joint that exceeds its bound most
    enters S until none does. A u is unchanged, as A w = 0. The policy's velocity is added in the freedom that is left.

    Args:
        task_part: A^+ b.
        null_part: N pi.
        A: Constraint matrix.
        low: Lowest velocities allowed, at most 0.
        high: Highest velocities allowed, at least 0.
        better_than: Scale factor that is possible without null-space motion.

    Returns:
        None if no larger factor is possible.
    """
    Z = null_basis(A)
    for scale in TASK_SCALES:
        if scale <= better_than:
            return None
        found = _within_bounds(scale * task_part, Z, low, high)
        if found is not None:
            w, saturated = found
            policy_part, null_scale = _scaled_policy(scale * task_part + w, null_part - w, Z, saturated, low, high)
            return NullSpaceSaturation(scale, w + policy_part, null_scale)
    return None


def _within_bounds(
    v: np.ndarray, Z: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, list[int]] | None:
    """The null-space velocity w that brings v + w within the bounds, and the joints that it puts on them."""
    saturated: list[int] = []
    change: list[float] = []
    w = np.zeros(v.shape[0])
    for _ in range(Z.shape[1] + 1):
        u = v + w
        beyond = np.maximum(u - high, low - u)
        beyond[saturated] = 0.0
        worst = int(np.argmax(beyond))
        if beyond[worst] <= ROUNDING:
            return w, saturated
        saturated.append(worst)
        change.append(float(np.clip(u[worst], low[worst], high[worst]) - v[worst]))
        U, sigma, Vt = np.linalg.svd(Z[saturated], full_matrices=False)
        if len(saturated) > Z.shape[1] or sigma[-1] < LEAST_SINGULAR_VALUE:
            return None
        w = Z @ (Vt.T @ ((U.T @ np.array(change)) / sigma))
    return None


def project_policy(
    task_part: Float[np.ndarray, " nv"],
    null_part: Float[np.ndarray, " nv"],
    A: Float[np.ndarray, "s nv"],
    low: Float[np.ndarray, " nv"],
    high: Float[np.ndarray, " nv"],
) -> tuple[Float[np.ndarray, " nv"], float]:
    """The policy's velocity projected onto the null-space motions that leave the blocked joints at rest, and scaled.

    Args:
        task_part: A^+ b as commanded.
        null_part: N pi.
        A: Constraint matrix.
        low: Lowest velocities allowed.
        high: Highest velocities allowed.

    Returns:
        A null-space velocity within the bounds, and its scale factor on the projection of N pi.
    """
    return _scaled_policy(task_part, null_part, null_basis(A), [], low, high)


def _scaled_policy(
    u: np.ndarray, policy: np.ndarray, Z: np.ndarray, saturated: list[int], low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, float]:
    """The part of the policy's velocity that moves no blocked joint, scaled to the bounds, and its scale factor."""
    blocked = set(saturated)
    for _ in range(Z.shape[1] + 1):
        free = Z @ null_basis(Z[sorted(blocked)]) if blocked else Z
        p = free @ (free.T @ policy)
        moving = np.flatnonzero(np.abs(p) > ROUNDING)
        ratio = np.maximum(np.where(p > 0.0, high - u, u - low), 0.0)[moving] / np.abs(p[moving])
        null_scale = float(np.min(ratio, initial=1.0))
        if null_scale >= BLOCKED:
            return null_scale * p, null_scale
        blocked.update(moving[ratio < BLOCKED].tolist())
    return np.zeros(u.shape[0]), 0.0
