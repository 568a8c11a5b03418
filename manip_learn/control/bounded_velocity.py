"""The joint velocity within bounds that does most of the task, and comes nearest to the null-space policy."""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.polytope_projection import Projection
from manip_learn.linalg import matlab_tolerance, svd

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
    desired: Desired,
    low: Float[np.ndarray, " nv"],
    high: Float[np.ndarray, " nv"],
    fastest: Float[np.ndarray, " nv"],
    barrier: tuple[Float[np.ndarray, " nv"], float] | None,
    project: Projection,
    slide: float = 0.0,
    damping: float = 0.05,
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
        low: Lowest velocities allowed.
        high: Highest velocities allowed.
        fastest: Velocity limits.
        barrier: (g, least) for the constraint g u >= least on the approach to a singularity; None without.
        project: Solver of the quadratic program.
        slide: 0 keeps the task's direction, 1 slides along what blocks it; in between their mean.
        damping: Singular value of A below which sliding is damped.
    """
    for bound in (barrier, None) if barrier is not None else (None,):
        found = _bounded(A, desired, low, high, fastest, bound, project, slide, damping)
        if found is not None and _within(found.velocity, low, high):
            return found._replace(velocity=np.clip(found.velocity, low, high))  # rounding
    # a box always holds a point; this is for a solver that gave up
    u = np.clip(desired.task + desired.null, low, high)
    return BoundedVelocity(u, 0.0, np.zeros_like(u))


def _within(u: np.ndarray, low: np.ndarray, high: np.ndarray) -> bool:
    return bool(np.all(u >= low - ROUNDING) and np.all(u <= high + ROUNDING))


def _bounded(
    A: np.ndarray,
    desired: Desired,
    low: np.ndarray,
    high: np.ndarray,
    fastest: np.ndarray,
    barrier: tuple[np.ndarray, float] | None,
    project: Projection,
    slide: float,
    damping: float,
) -> BoundedVelocity | None:
    v, w, e = desired
    decomposition = svd(A)
    _, sigma, Vt = decomposition
    Z = Vt[int(np.count_nonzero(sigma > matlab_tolerance(sigma, A.shape))) :].T
    too_fast = float(np.max(np.abs(v) / fastest, initial=1.0))
    v = v / too_fast  # slowed down to the velocity limits, before null-space motion makes room for it
    scale = approach_scale(v, w if e is None else w + e, barrier)
    wish = scale * v + w if e is None else scale * v + w + e
    bounds = (low, high, barrier, project)
    along = _along(v, scale, w, e, Z, *bounds)
    if along is not None:
        u, s = along
    else:
        b = A @ v
        length = math.sqrt(b.dot(b))
        across = A if length < NEGLIGIBLE else A - np.outer(b / length, (b / length) @ A)
        u = _nearest(wish, svd(across), sigma[0] / DEVIATION_WEIGHT, *bounds)
        if u is None:
            return None
        s = 0.0 if length < NEGLIGIBLE else max(0.0, float(b @ (A @ u)) / length**2)
    if slide > 0.0:
        slid = _nearest(wish, decomposition, damping, *bounds)
        if slid is not None:
            u = u + slide * (slid - u)
    return BoundedVelocity(u, s / too_fast, Z @ (Z.T @ u))


def approach_scale(v: np.ndarray, rest: np.ndarray, barrier: tuple[np.ndarray, float] | None) -> float:
    """Largest factor on v, 0 to 1, with which `v + rest` approaches a singularity no faster than the barrier allows."""
    if barrier is None:
        return 1.0
    approach = -float(barrier[0].dot(v))
    room = float(barrier[0].dot(rest)) - barrier[1]
    return min(1.0, max(0.0, room / approach)) if approach > 0.0 else 1.0


def _along(
    v: np.ndarray,
    scale: float,
    w: np.ndarray,
    e: np.ndarray | None,
    Z: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    barrier: tuple[np.ndarray, float] | None,
    project: Projection,
) -> tuple[np.ndarray, float] | None:
    """The first program: (u, s), or None if the bounds allow no s >= 0."""
    columns, x = [Z], [Z.T @ w]
    length, speed = math.sqrt(v.dot(v)), 0.0 if e is None else math.sqrt(e.dot(e))
    # a slow task comes first beside a fast policy, too
    weight = TASK_WEIGHT * max(length, min(math.sqrt(w.dot(w)), LARGEST_RATIO * length))
    if length > NEGLIGIBLE:
        columns.append(v[:, None] / weight)
        x.append(np.array([weight * scale]))
    if e is not None and speed > NEGLIGIBLE:
        columns.append(e[:, None] / speed)
        x.append(np.array([speed]))
    basis = np.hstack(columns)
    rows, lows, highs = [basis], [low], [high]
    if barrier is not None:
        rows.append((barrier[0] @ basis)[None])
        lows.append(np.array([barrier[1]]))
        highs.append(np.array([np.inf]))
    at = Z.shape[1]
    if length > NEGLIGIBLE:
        row = np.zeros((1, basis.shape[1]))
        row[0, at] = 1.0 / weight
        rows.append(row)
        lows.append(np.zeros(1))
        highs.append(np.ones(1))
    start, C, least = np.concatenate(x), np.vstack(rows), np.concatenate(lows)
    y = project(start, C, least, np.concatenate(highs))
    if y is None and length > NEGLIGIBLE:  # too fast to brake: farther along b is better than beside it
        highs[-1] = np.array([np.inf])
        y = project(start, C, least, np.concatenate(highs))
    if y is None:
        return None
    return basis @ y, float(y[at] / weight) if length > NEGLIGIBLE else 1.0


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
    root = np.ones(Vt.shape[0])
    root[: sigma.shape[0]] = np.sqrt(1.0 + (sigma / max(damping, 1e-300)) ** 2)
    C = Vt.T / root  # u = C x
    rows, lows, highs = C, low, high
    if barrier is not None:
        rows = np.vstack((C, barrier[0] @ C))
        lows, highs = np.append(low, barrier[1]), np.append(high, np.inf)
    x = project(root * (Vt @ wish), rows, lows, highs)
    return None if x is None else C @ x
