"""The joint velocity within bounds that does most of the task, and comes nearest to the null-space policy."""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.small_matrices import dot, put, svd, unit
from manip_learn.control.limits import Bounds
from manip_learn.control.polytope_projection import project

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
    escape: Float[np.ndarray, " nv"]


@final
class Feasible(NamedTuple):
    """What a program keeps a velocity u within: low <= u <= high, and G u >= least.

    Attributes:
        low: Lower ends of the bounds, and behind them those of the barriers and of the scale of a task.
        high: Their upper ends.
        G: Gradients of the barriers, on the approach to a singularity first, where there is one, then on the speeds of
            frames.
        by_library: Whether DAQP solves the programs where it is at hand.
    """

    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    G: Float[np.ndarray, "r nv"]
    by_library: bool


def feasible(
    bounds: Bounds, G: Float[np.ndarray, "r nv"], least: Float[np.ndarray, " r"], by_library: bool
) -> Feasible:
    """The bounds and the barriers G u >= least, with one more row of 0 to 1 behind them for the scale of a task."""
    nv, r = bounds.low.shape[0], least.shape[0]
    low, high = np.zeros(nv + r + 1), np.zeros(nv + r + 1) + math.inf
    put(low[:nv], bounds.low)
    put(high[:nv], bounds.high)
    for i in range(r):
        low[nv + i] = least[i]
    high[nv + r] = 1.0
    return Feasible(low, high, G, by_library)


def bounded_velocity(
    A: Float[np.ndarray, "s nv"],
    desired: Desired,
    null: Float[np.ndarray, "k nv"],
    within: Feasible,
    fastest: Float[np.ndarray, " nv"],
    slide: float,
    damping: float,
) -> BoundedVelocity:
    """The velocity within the bounds that keeps the direction of the task.

    With the null basis Z of A, v = A^+ b slowed down to the velocity limits and w = N pi, in the unknowns y and s

        min |Z y - w|^2 + TASK_WEIGHT^2 max(|v|, |w|)^2 (s* - s)^2  subject to  low <= s v + Z y <= high,  0 <= s <= 1

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
        desired: Parts of the command before bounds.
        null: Z^T with Z Z^T = N, or the projector N itself, which serves as well.
        within: Bounds and barriers; where they allow no velocity, the barriers are given up.
        fastest: Velocity limits.
        slide: 0 keeps the task's direction, 1 slides along what blocks it; in between their mean.
        damping: Singular value of A below which sliding is damped.
    """
    nv, barriers = A.shape[1], within.G.shape[0]
    too_fast = max(1.0, (np.abs(desired.task) / fastest).max())
    # slowed down to the velocity limits, before null-space motion makes room for it
    parts = Desired(desired.task / too_fast, desired.null, desired.escape)
    low, high = within.low[:nv], within.high[:nv]
    for attempt in range(2):
        if attempt == 1:
            if barriers == 0:
                break
            within = without_barriers(within, nv)
        found, u, scale = _program(A, parts, null, within, slide, damping)
        if found:
            inside = np.minimum(np.maximum(u, low), high)
            outside = inside - u
            if dot(outside, outside) <= ROUNDING * ROUNDING:
                return BoundedVelocity(inside, scale / too_fast, dot(dot(null, u), null))
    # a box always holds a point; this is for a solver that gave up
    return BoundedVelocity(np.minimum(np.maximum(desired.task + desired.null, low), high), 0.0, np.zeros(nv))


def without_barriers(within: Feasible, nv: int) -> Feasible:
    """The bounds alone."""
    low, high = within.low[: nv + 1].copy(), within.high[: nv + 1].copy()
    low[nv], high[nv] = 0.0, 1.0
    return Feasible(low, high, within.G[:0], within.by_library)


def _program(
    A: Float[np.ndarray, "s nv"],
    parts: Desired,
    null: Float[np.ndarray, "k nv"],
    within: Feasible,
    slide: float,
    damping: float,
) -> tuple[bool, Float[np.ndarray, " nv"], float]:
    """Whether there is a velocity, that velocity, and the task's scale."""
    rest = parts.null + parts.escape
    most = approach_scale(parts.task, rest, within)
    found, u, scale = _along(parts, most, null, within)
    if found and slide == 0.0:
        return True, u, scale
    wish, (_, sigma, Vt) = most * parts.task + rest, svd(A)
    s = min(A.shape[0], A.shape[1])
    if not found:
        b = dot(A, parts.task)
        length = math.sqrt(dot(b, b))
        moves = length >= NEGLIGIBLE
        direction = b / length if moves else np.zeros(b.shape[0])
        across = svd(A - direction.reshape((-1, 1)) * dot(direction, A))
        found, u = _nearest(wish, across[1], across[2][:s], sigma[0] / DEVIATION_WEIGHT, within)
        if not found:
            return False, wish, 0.0
        scale = float(max(0.0, dot(b, dot(A, u)) / (length * length))) if moves else 0.0
    if slide > 0.0:
        slides, slid = _nearest(wish, sigma, Vt[:s], damping, within)
        if slides:
            u = u + slide * (slid - u)
    return True, u, scale


def approach_scale(v: Float[np.ndarray, " nv"], rest: Float[np.ndarray, " nv"], within: Feasible) -> float:
    """Largest factor on v, 0 to 1, with which `v + rest` is no faster than the barriers allow."""
    scale, G = 1.0, within.G
    for i in range(G.shape[0]):
        approach = -dot(G[i], v)
        if approach > 0.0:
            room = dot(G[i], rest) - within.low[G.shape[1] + i]
            scale = min(scale, max(0.0, room / approach))
    return scale


def _along(
    parts: Desired, most: float, null: Float[np.ndarray, "k nv"], within: Feasible
) -> tuple[bool, Float[np.ndarray, " nv"], float]:
    """The first program: whether the bounds allow any s >= 0, and its u and s, at most `most`."""
    v, w, e = parts
    at, nv = null.shape
    length, speed = math.sqrt(dot(v, v)), math.sqrt(dot(e, e))
    moves, escapes, r = length > NEGLIGIBLE, speed > NEGLIGIBLE, within.G.shape[0]
    # a slow task comes first beside a fast policy, too
    weight = TASK_WEIGHT * max(length, min(math.sqrt(dot(w, w)), LARGEST_RATIO * length))
    k, rows = at + int(moves) + int(escapes), nv + r + int(moves)
    # the unknowns are y, weight * s, and the escape's speed
    C, start = np.zeros((rows, k)), np.zeros(k)
    basis = C[:nv]
    put(basis[:, :at], null.T)
    put(start[:at], dot(null, w))
    if moves:
        put(basis[:, at], v / weight)
        start[at], C[rows - 1, at] = weight * most, 1.0 / weight
    if escapes:
        put(basis[:, k - 1], e / speed)
        start[k - 1] = speed
    if r > 0:
        put(C[nv : nv + r], dot(within.G, basis))
    found, y = project(start, C, within.low[:rows], within.high[:rows], within.by_library)
    if not found and moves:  # too fast to brake: farther along b is better than beside it
        high = within.high.copy()
        high[rows - 1] = math.inf
        found, y = project(start, C, within.low, high, within.by_library)
    return found, dot(basis, y), float(max(0.0, y[at] / weight)) if moves else 1.0


def _nearest(
    wish: Float[np.ndarray, " nv"],
    sigma: Float[np.ndarray, " k"],
    V: Float[np.ndarray, "k nv"],
    damping: float,
    within: Feasible,
) -> tuple[bool, Float[np.ndarray, " nv"]]:
    """The second program: the velocity within the bounds that is nearest to `wish`, mostly in the rows decomposed.

    In x with u = (I + sum_i (r_i - 1) v_i v_i^T) x, r_i = 1 / sqrt(1 + (sigma_i / damping)^2), it is the nearest to x*
    of the wish.
    """
    nv, r = wish.shape[0], within.G.shape[0]
    ratio = sigma / max(damping, 1e-300)
    root = np.sqrt(1.0 + ratio * ratio)
    C = np.zeros((nv + r, nv))
    basis = C[:nv]
    # 1 - 1 / root without cancellation
    put(basis, unit(nv) - dot(V.T * (ratio * ratio / (root * (1.0 + root))), V))
    if r > 0:
        put(C[nv:], dot(within.G, basis))
    start = wish + dot((root - 1.0) * dot(V, wish), V)
    found, x = project(start, C, within.low[: nv + r], within.high[: nv + r], within.by_library)
    return found, dot(basis, x)
