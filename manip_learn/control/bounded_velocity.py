"""The joint velocity within bounds that does most of the task, and comes nearest to the null-space policy."""

from __future__ import annotations

import math
from functools import cache
from operator import truediv
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.small_matrices import svd
from manip_learn.control.limits import Bounds
from manip_learn.control.polytope_projection import Projection
from manip_learn.linalg import rank_of

# weight of the task's scale against the null-space policy, in multiples of the task part
TASK_WEIGHT = 100.0
# how much faster than the task a policy may be to count in that weight
LARGEST_RATIO = 1e3
# weight of the task's velocity against joint velocities, where its direction cannot be kept
DEVIATION_WEIGHT = 1e2
NEGLIGIBLE = 1e-12
# [rad/s or m/s] by how much rounding may exceed a bound
ROUNDING = 1e-9


@final
class BoundedVelocity(NamedTuple):
    """A joint velocity within bounds.

    Attributes:
        velocity: shape (nv,) [rad/s or m/s].
        task_scale: Factor s on the task, A velocity = s b; above 1 where the arm cannot slow down fast enough.
        null_part: Its component in the null space of A.
    """

    velocity: Float[np.ndarray, " nv"]
    task_scale: float
    null_part: Float[np.ndarray, " nv"]


@final
class Desired(NamedTuple):
    """The parts of a command before bounds.

    Attributes:
        task: A^+ b.
        null: N pi.
        escape: Velocity out of a singularity; zero away from one.
    """

    task: Float[np.ndarray, " nv"]
    null: Float[np.ndarray, " nv"]
    escape: Float[np.ndarray, " nv"] | None


def bounded_velocity(
    A: Float[np.ndarray, "s nv"],
    rows: Float[np.ndarray, "r nv"],
    desired: Desired,
    bounds: Bounds,
    fastest: Float[np.ndarray, " nv"],
    barrier: tuple[Float[np.ndarray, " nv"], float] | None,
    project: Projection,
    slide: float = 0.0,
    damping: float = 0.05,
    decomposition: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> BoundedVelocity:
    """The velocity within the bounds that keeps the direction of the task.

    With v = A^+ b slowed down to the velocity limits and w = N pi, u = s v + n in the unknowns s and n, where

        min |n - w|^2 + TASK_WEIGHT^2 max(|v|, |w|)^2 (s* - s)^2
        subject to  low <= s v + n <= high,  A n = 0,  0 <= s <= 1

    This is saturation in the null space (Flacco, De Luca and Khatib, "Control of redundant robots under hard joint
    constraints: saturation in the null space", 2015) as a quadratic program: null-space motion makes room for the task
    before the task slows down. The program is strictly convex, so that its solution is continuous in all data. s* is 1,
    and less where v + w would approach a singularity too fast: null-space motion makes no room for that.

    Where no s is possible (the arm cannot brake fast enough along the task's direction), the direction is kept as well
    as possible: with u* = v + w, and P the projector across b,

        min (DEVIATION_WEIGHT / sigma_1)^2 |P A (u - u*)|^2 + |u - u*|^2    subject to    low <= u <= high

    With `slide`, P = I and the factor is 1 / damping: the arm comes as near to the task's velocity as the bounds allow.

    Args:
        A: Constraint matrix.
        rows: Independent rows that span those of A; orthonormal where there is an escape.
        desired: Parts of the command before bounds.
        bounds: Lowest and highest velocities allowed.
        fastest: Velocity limits.
        barrier: (g, least) for the constraint g u >= least on the approach to a singularity; None without.
        project: Solver of the quadratic program.
        slide: 0 keeps the task's direction, 1 slides along what blocks it; in between their mean.
        damping: Singular value of A below which sliding is damped.
        decomposition: U, singular values and V^T of A, where they are known.
    """
    r, nv = rows.shape
    for barred in (barrier, None) if barrier is not None else (None,):
        # rows of the programs: A n = 0, joints, barrier, and the task's scale
        m, zeros, least, most = r + nv + 1, [0.0] * r, (0.0,), (1.0,)
        if barred is not None:
            m, least, most = m + 1, (barred[1], 0.0), (math.inf, 1.0)
        low = np.fromiter([*zeros, *bounds.low, *least], np.float64, m)
        high = np.fromiter([*zeros, *bounds.high, *most], np.float64, m)
        found = _bounded(A, rows, desired, low, high, fastest, barred, project, slide, damping, decomposition)
        if found is not None:
            reached = found.velocity.tolist()
            rows_of_joints = zip(reached, bounds.low, bounds.high, strict=True)
            within = [least if u < least else most if u > most else u for u, least, most in rows_of_joints]
            if math.dist(within, reached) <= ROUNDING:
                return BoundedVelocity(np.array(within), found.task_scale, found.null_part)
    # a box always holds a point; this is for a solver that gave up
    u = np.clip(desired.task + desired.null, bounds.low, bounds.high)
    return BoundedVelocity(u, 0.0, np.zeros_like(u))


def _bounded(
    A: np.ndarray,
    rows: np.ndarray,
    desired: Desired,
    low: np.ndarray,
    high: np.ndarray,
    fastest: np.ndarray,
    barrier: tuple[np.ndarray, float] | None,
    project: Projection,
    slide: float,
    damping: float,
    decomposition: tuple[np.ndarray, np.ndarray, np.ndarray] | None,
) -> BoundedVelocity | None:
    v, w, e = desired
    too_fast = max(map(truediv, map(abs, v.tolist()), fastest.tolist()), default=1.0)
    if too_fast > 1.0:  # slowed down to the velocity limits, before null-space motion makes room for it
        v = v / too_fast
    rest = w if e is None else w + e
    scale = approach_scale(v, rest, barrier)
    along = _along(v, scale, w, e, rows, low, high, barrier, project)
    if along is not None and slide == 0.0:
        u, s, null_part = along
        return BoundedVelocity(u, s / max(too_fast, 1.0), null_part)
    decomposition = decomposition or svd(A)
    _, sigma, Vt = decomposition
    bounds = (low[rows.shape[0] : -1], high[rows.shape[0] : -1], barrier, project)
    wish = scale * v + rest
    if along is not None:
        u, s, _ = along
    else:
        b = A @ v
        length = math.sqrt(b.dot(b))
        across = A if length < NEGLIGIBLE else A - np.outer(b / length, (b / length) @ A)
        u = _nearest(wish, svd(across), float(sigma[0]) / DEVIATION_WEIGHT, *bounds)
        if u is None:
            return None
        s = 0.0 if length < NEGLIGIBLE else max(0.0, float(b @ (A @ u)) / length**2)
    if slide > 0.0:
        slid = _nearest(wish, decomposition, damping, *bounds)
        if slid is not None:
            u = u + slide * (slid - u)
    return BoundedVelocity(u, s / max(too_fast, 1.0), _across(Vt[: rank_of(sigma, A.shape)], u))


def _across(rows: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The part of u that orthonormal rows do not see."""
    return u - rows.dot(u).dot(rows)


def approach_scale(v: np.ndarray, rest: np.ndarray, barrier: tuple[np.ndarray, float] | None) -> float:
    """Largest factor on v, 0 to 1, with which `v + rest` approaches a singularity no faster than the barrier allows."""
    if barrier is None:
        return 1.0
    approach = -float(barrier[0].dot(v))
    if approach <= 0.0:
        return 1.0
    room = float(barrier[0].dot(rest)) - barrier[1]
    return min(1.0, max(0.0, room / approach))


def _along(
    v: np.ndarray,
    scale: float,
    w: np.ndarray,
    e: np.ndarray | None,
    K: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    barrier: tuple[np.ndarray, float] | None,
    project: Projection,
) -> tuple[np.ndarray, float, np.ndarray] | None:
    """The first program: (u, s, N u), or None if the bounds allow no s >= 0."""
    r, nv = K.shape
    length, speed = math.sqrt(v.dot(v)), 0.0 if e is None else math.sqrt(e.dot(e))
    moves, escapes = length > NEGLIGIBLE, speed > NEGLIGIBLE
    # a slow task comes first beside a fast policy, too
    weight = TASK_WEIGHT * max(length, min(math.sqrt(w.dot(w)), LARGEST_RATIO * length))
    k, rows = nv + moves + escapes, low.shape[0] - (not moves)
    # the unknowns are n, weight * s, and the escape's speed
    C, start = _rows_of_null_motion(rows, k, r, nv).copy(), np.empty(k)
    joints = C[r : r + nv]  # u = joints y
    C[:r, :nv], start[:nv] = K, w
    if moves:
        joints[:, nv], start[nv], C[-1, nv] = v / weight, weight * scale, 1.0 / weight
    if e is not None and escapes:
        joints[:, -1], start[-1] = e / speed, speed
    if barrier is not None:
        C[r + nv] = barrier[0].dot(joints)
    y = project(start, C, low[:rows], high[:rows], r)
    if y is None and moves:  # too fast to brake: farther along b is better than beside it
        high[-1] = math.inf
        y = project(start, C, low, high, r)
    if y is None:
        return None
    u = joints.dot(y)
    return u, float(y[nv]) / weight if moves else 1.0, _across(K, u) if escapes else y[:nv]


@cache
def _rows_of_null_motion(rows: int, k: int, r: int, nv: int) -> np.ndarray:
    """Zeros, but for the ones by which n is part of u."""
    matrix = np.zeros((rows, k))
    matrix[r : r + nv, :nv] = np.eye(nv)
    matrix.setflags(write=False)
    return matrix


def _nearest(
    wish: np.ndarray,
    decomposition: tuple[np.ndarray, np.ndarray, np.ndarray],
    damping: float,
    low: np.ndarray,
    high: np.ndarray,
    barrier: tuple[np.ndarray, float] | None,
    project: Projection,
) -> np.ndarray | None:
    """The second program: the velocity within the bounds that is nearest to `wish`, mostly in the rows decomposed."""
    _, sigma, Vt = decomposition
    nv, scale = Vt.shape[0], 1.0 / max(damping, 1e-300)
    root = np.array([math.hypot(1.0, scale * x) for x in sigma.tolist()] + [1.0] * (nv - sigma.shape[0]))
    rows = np.empty((nv + (barrier is not None), nv))
    C = np.divide(Vt.T, root, out=rows[:nv])  # u = C x
    if barrier is not None:
        rows[nv] = barrier[0].dot(C)
    x = project(root * Vt.dot(wish), rows, low, high, 0)
    return None if x is None else C.dot(x)
