"""Round joints that are at their limits: null-space motion that lets the task, and the policy, go on."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.linalg import null_basis

# shares of the task velocity that are tried, largest first
SHARES = (1.0, 0.5, 0.25, 0.1)
# the null space counts as able to move the joints in question if all singular values there are above this
ABLE = 1e-3
# [rad/s or m/s] what rounding leaves of a bound
ROUNDING = 1e-10
# a null-space velocity of which less than this share fits is blocked by a joint at its bound
BLOCKED = 1e-6


@final
class Detour(NamedTuple):
    """How the task can go on.

    Attributes:
        task: Share of the task part, 0 to 1.
        null_part: Null-space velocity to be added to that share, shape (nv,).
        null: Share of the policy's part that is in it, in what freedom is left, 0 to 1.
    """

    task: float
    null_part: Float[np.ndarray, " nv"]
    null: float


def detour(
    task_part: Float[np.ndarray, " nv"],
    null_part: Float[np.ndarray, " nv"],
    A: Float[np.ndarray, "s nv"],
    low: Float[np.ndarray, " nv"],
    high: Float[np.ndarray, " nv"],
    better_than: float,
) -> Detour | None:
    """The largest of SHARES of the task that fits between the bounds with the null space's help.

    Saturation in the null space (Flacco, De Luca and Khatib, 2012), in its null-basis form: a joint that would go
    beyond its bound is put on it by the smallest null-space velocity that does so, until none is beyond. Adding a
    null-space velocity does not change A u. What the policy wants is added in the freedom that is left after that.

    Args:
        task_part: A^+ b.
        null_part: N pi.
        A: Constraint matrix.
        low: Lowest velocities allowed, at most 0.
        high: Highest velocities allowed, at least 0.
        better_than: Share of the task that is possible without help.

    Returns:
        None if there is no better share than that.
    """
    Z = null_basis(A)
    for share in SHARES:
        if share <= better_than:
            return None
        found = _saturated(share * task_part, Z, low, high)
        if found is not None:
            helping, at_bound = found
            extra, null = _policy(share * task_part + helping, null_part - helping, Z, at_bound, low, high)
            return Detour(share, helping + extra, null)
    return None


def _saturated(v: np.ndarray, Z: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, list[int]] | None:
    """Null-space velocity that brings v within the bounds, and the joints that are on theirs."""
    at_bound: list[int] = []
    wanted: list[float] = []
    w = np.zeros(v.shape[0])
    for _ in range(Z.shape[1] + 1):
        u = v + w
        beyond = np.maximum(u - high, low - u)
        beyond[at_bound] = 0.0
        worst = int(np.argmax(beyond))
        if beyond[worst] <= ROUNDING:
            return w, at_bound
        at_bound.append(worst)
        wanted.append(float(np.clip(u[worst], low[worst], high[worst]) - v[worst]))
        U, sigma, Vt = np.linalg.svd(Z[at_bound], full_matrices=False)
        if len(at_bound) > Z.shape[1] or sigma[-1] < ABLE:
            return None
        w = Z @ (Vt.T @ ((U.T @ np.array(wanted)) / sigma))
    return None


def sidestep(
    task_part: Float[np.ndarray, " nv"],
    null_part: Float[np.ndarray, " nv"],
    A: Float[np.ndarray, "s nv"],
    low: Float[np.ndarray, " nv"],
    high: Float[np.ndarray, " nv"],
) -> tuple[Float[np.ndarray, " nv"], float]:
    """What the policy can do where a joint at its bound blocks it: its velocity without the blocked joints.

    Args:
        task_part: A^+ b as it will be commanded.
        null_part: N pi.
        A: Constraint matrix.
        low: Lowest velocities allowed.
        high: Highest velocities allowed.

    Returns:
        A null-space velocity that fits, and its share of N pi's projection on what is not blocked.
    """
    return _policy(task_part, null_part, null_basis(A), [], low, high)


def _policy(
    u: np.ndarray, wanted: np.ndarray, Z: np.ndarray, at_bound: list[int], low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, float]:
    """What fits of the policy's velocity, in the null space of A that leaves the joints at their bounds alone."""
    blocked = set(at_bound)
    for _ in range(Z.shape[1] + 1):
        free = Z @ null_basis(Z[sorted(blocked)]) if blocked else Z
        p = free @ (free.T @ wanted)
        moving = np.flatnonzero(np.abs(p) > ROUNDING)
        room = np.maximum(np.where(p > 0.0, high - u, u - low), 0.0)[moving] / np.abs(p[moving])
        null = float(np.min(room, initial=1.0))
        if null >= BLOCKED:
            return null * p, null
        blocked.update(moving[room < BLOCKED].tolist())
    return np.zeros(u.shape[0]), 0.0
