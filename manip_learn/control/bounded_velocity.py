"""The joint velocity within bounds that keeps most of a task, and the quadratic program behind it."""

from __future__ import annotations

import math
from functools import cache
from operator import truediv
from typing import NamedTuple, final

import daqp
import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dposv

from manip_learn.constraint.small_matrices import svd
from manip_learn.control.limits import Barrier, BoundedVelocity, Bounds

# how much a bound may be exceeded by rounding, in the unit of the bounds
TOLERANCE = 1e-11
# a row whose part outside the active rows is shorter than this share of it depends on them
DEPENDENT = 1e-18
# ... and than this share, it is projected twice
REORTHOGONAL = 1e-2
# the same for DAQP, whose answer may be off by as much: commands are compared to 1e-12
FINE = 1e-13
SOLVED, INFEASIBLE = 1, -1  # exit flags of DAQP
# weight of the task's scale against the null-space policy, in multiples of the task part
TASK_WEIGHT = 100.0
# the weight grows with the policy's speed up to this multiple of the task's
LARGEST_RATIO = 1e3
# weight of the task's velocity against joint velocities, where its direction cannot be kept
DEVIATION_WEIGHT = 1e2
NEGLIGIBLE = 1e-12  # [rad/s or m/s] below which a velocity has no direction: rounding of ones of about 1
# [rad/s or m/s] by how much rounding may exceed a bound
ROUNDING = 1e-9


def project_by_daqp(
    x: Float[np.ndarray, " k"], C: Float[np.ndarray, "m k"], low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " k"] | None:
    """argmin |y - x|^2 subject to low <= C y <= high, or None if no point meets the bounds.

    By DAQP, a dual active-set solver in C (Arnstrom, Bemporad and Axehill, "A dual active-set solver for embedded
    quadratic programming using recursive LDL^T updates", 2022); where it gives up, by `project_by_active_set`.
    """
    y, _, exit_flag, _ = daqp.solve(_unit(x.shape[0]), -x, C, high, low, _inequalities(low.shape[0]), primal_tol=FINE)
    if exit_flag == SOLVED:
        return np.asarray(y)
    # where 0 is the only point, or one of few, DAQP may not see it
    if exit_flag == INFEASIBLE and not (low.max() <= 0.0 <= high.min()):
        return None
    return project_by_active_set(x, C, low, high)


@cache
def _unit(size: int) -> np.ndarray:
    return np.eye(size)  # DAQP takes no array that may not be written to, and does not write


@cache
def _inequalities(size: int) -> np.ndarray:
    return np.zeros(size, dtype=np.int32)


def project_by_active_set(
    x: Float[np.ndarray, " k"], C: Float[np.ndarray, "m k"], low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " k"] | None:
    """The nearest point y to x with low <= C y <= high, by the dual active-set method of Goldfarb and Idnani (1983).

    It solves programs on which DAQP gives up, and a least-distance program (Lawson and Hanson) errs: those whose
    feasible points are a few hundred times farther away than the bounds are wide.

    Starts from x itself, and brings the row that is exceeded most to its bound, one after another; rows whose
    multiplier would change its sign are let go. The answer depends continuously on all arguments.

    Args:
        x: The point.
        C: One row per constraint.
        low: Lower bounds.
        high: Upper bounds.

    Returns:
        The nearest point; None if no point meets the bounds.
    """
    active: list[int] = []
    bounds: list[float] = []
    rows = np.empty((0, x.shape[0]))  # outward normals of the active rows
    multipliers = np.empty(0)
    y = x
    for _ in range(8 * C.shape[0]):
        reached = C.dot(y)
        beyond = np.maximum(reached - high, low - reached)
        beyond[active] = 0.0
        worst = int(beyond.argmax())
        excess = float(beyond[worst])
        if excess <= TOLERANCE:
            return y if not active else _on_faces(x, y, rows, np.array(bounds))
        above = reached[worst] > high[worst]
        normal, bound = (C[worst], float(high[worst])) if above else (-C[worst], -float(low[worst]))
        square, multiplier = float(normal.dot(normal)), 0.0
        while True:
            r, direction = _across(rows, normal, square) if active else (multipliers, normal)
            slope = float(direction.dot(direction))
            full = excess / slope if slope > DEPENDENT * square else np.inf
            falling = np.flatnonzero(r > 0.0)
            partial, leaving = np.inf, -1
            if falling.size:
                ratios = multipliers[falling] / r[falling]
                leaving = int(falling[ratios.argmin()])
                partial = float(ratios.min())
            step = min(full, partial)
            if step == np.inf:
                return None
            multipliers = multipliers - step * r
            multiplier += step
            if full < np.inf:
                y = y - step * direction
                excess -= step * slope
            if step == full:
                active.append(worst)
                bounds.append(bound)
                rows = np.vstack((rows, normal))
                multipliers = np.append(multipliers, multiplier)
                break
            del active[leaving], bounds[leaving]
            rows = np.delete(rows, leaving, axis=0)
            multipliers = np.delete(multipliers, leaving)
    return None


def _across(rows: np.ndarray, normal: np.ndarray, square: float) -> tuple[np.ndarray, np.ndarray]:
    """(r, normal - r rows): a normal without its part along the active rows."""
    gram = rows.dot(rows.T)
    _, r, failed = dposv(gram, rows.dot(normal))
    if failed:
        r = np.linalg.lstsq(rows.T, normal, rcond=None)[0]
    direction = normal - r.dot(rows)
    if failed or direction.dot(direction) > REORTHOGONAL * square:
        return r, direction
    # the square of the condition number is in the Gram matrix: once more, for what rounding has left
    _, more, failed = dposv(gram, rows.dot(direction))
    return (r, direction) if failed else (r + more, direction - more.dot(rows))


def _on_faces(x: np.ndarray, y: np.ndarray, rows: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """The nearest point to x with rows y = bounds, without the rounding of the steps that led to y."""
    gram = rows.dot(rows.T)
    _, multipliers, failed = dposv(gram, rows.dot(x) - bounds)
    if failed:
        return y
    nearest = x - multipliers.dot(rows)
    _, more, _ = dposv(gram, rows.dot(nearest) - bounds)
    return nearest - more.dot(rows)


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
    null: Float[np.ndarray, "nv k"],
    bounds: Bounds,
    fastest: Float[np.ndarray, " nv"],
    barrier: Barrier | None,
    slide: float = 0.0,
    damping: float = 0.05,
    decomposition: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
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
        null: Z with Z Z^T = N, or the projector N itself, which serves as well.
        bounds: Lowest and highest velocities allowed.
        fastest: Velocity limits.
        barrier: (G, least) for the constraints G u >= least, on the approach to a singularity first, where there is
            one, then on the speeds of frames; None without.
        slide: 0 keeps the task's direction, 1 slides along what blocks it; in between their mean.
        damping: Singular value of A below which sliding is damped.
        decomposition: U, singular values and V^T of A, where they are known.
    """
    nv = null.shape[0]
    for barred in (barrier, None) if barrier is not None else (None,):
        # rows of the programs: joints, barrier, and the task's scale
        least = [] if barred is None else barred[1].tolist()
        m = nv + len(least) + 1
        low = np.fromiter([*bounds.low, *least, 0.0], np.float64, m)
        high = np.fromiter([*bounds.high, *[math.inf] * len(least), 1.0], np.float64, m)
        program = _Program(low, high, barred)
        found = _bounded(A, desired, null, fastest, program, slide, damping, decomposition)
        if found is not None:
            reached = found.velocity.tolist()
            joints = zip(reached, bounds.low, bounds.high, strict=True)
            within = [least if u < least else most if u > most else u for u, least, most in joints]
            if math.dist(within, reached) <= ROUNDING:
                return BoundedVelocity(np.array(within), found.task_scale, found.null_part)
    # a box always holds a point; this is for a solver that gave up
    u = np.clip(desired.task + desired.null, bounds.low, bounds.high)
    return BoundedVelocity(u, 0.0, np.zeros_like(u))


def _bounded(
    A: np.ndarray,
    desired: Desired,
    Z: np.ndarray,
    fastest: np.ndarray,
    program: _Program,
    slide: float,
    damping: float,
    decomposition: tuple[np.ndarray, np.ndarray, np.ndarray] | None,
) -> BoundedVelocity | None:
    v, w, e = desired
    too_fast = max(1.0, *map(truediv, map(abs, v.tolist()), fastest.tolist()))
    if too_fast > 1.0:  # slowed down to the velocity limits, before null-space motion makes room for it
        v = v / too_fast
    rest = w if e is None else w + e
    scale = approach_scale(v, rest, program.barrier)
    wish, along = scale * v + rest, program.along(v, scale, w, e, Z)
    if along is not None:
        u, s = along
    else:
        b = A @ v
        length = math.sqrt(b.dot(b))
        across = A if length < NEGLIGIBLE else A - np.outer(b / length, (b / length) @ A)
        decomposition = decomposition or svd(A)
        u = program.nearest(wish, svd(across), float(decomposition[1][0]) / DEVIATION_WEIGHT)
        if u is None:
            return None
        s = 0.0 if length < NEGLIGIBLE else max(0.0, float(b @ (A @ u)) / length**2)
    if slide > 0.0:
        slid = program.nearest(wish, decomposition or svd(A), damping)
        if slid is not None:
            u = u + slide * (slid - u)
    null_part = Z.dot(u) if Z.shape[0] == Z.shape[1] else Z.dot(u.dot(Z))
    return BoundedVelocity(u, s / too_fast, null_part)


def approach_scale(v: np.ndarray, rest: np.ndarray, barrier: Barrier | None) -> float:
    """Largest factor on v, 0 to 1, with which `v + rest` is no faster than the barrier allows."""
    scale = 1.0
    if barrier is not None:
        for g, least in zip(*barrier, strict=True):
            approach = -float(g.dot(v))
            if approach > 0.0:
                scale = min(scale, max(0.0, (float(g.dot(rest)) - least) / approach))
    return scale


@final
class _Program(NamedTuple):
    """Bounds on the joints, the barrier and, last, the task's scale; and the barrier's rows."""

    low: np.ndarray
    high: np.ndarray
    barrier: Barrier | None

    def along(
        self, v: np.ndarray, scale: float, w: np.ndarray, e: np.ndarray | None, Z: np.ndarray
    ) -> tuple[np.ndarray, float] | None:
        """The first program: (u, s), or None if the bounds allow no s >= 0."""
        nv, at = Z.shape
        length, speed = math.sqrt(v.dot(v)), 0.0 if e is None else math.sqrt(e.dot(e))
        moves, escapes = length > NEGLIGIBLE, speed > NEGLIGIBLE
        # a slow task comes first beside a fast policy, too
        weight = TASK_WEIGHT * max(length, min(math.sqrt(w.dot(w)), LARGEST_RATIO * length))
        k, rows = at + moves + escapes, self.low.shape[0] - (not moves)
        # the unknowns are y, weight * s, and the escape's speed
        C, start = np.zeros((rows, k)), np.empty(k)
        basis = C[:nv]
        # the projector leaves a null-space motion as it is
        basis[:, :at], start[:at] = Z, w if at == nv else w.dot(Z)
        if moves:
            basis[:, at], start[at], C[-1, at] = v / weight, weight * scale, 1.0 / weight
        if e is not None and escapes:
            basis[:, -1], start[-1] = e / speed, speed
        if self.barrier is not None:
            C[nv : nv + self.barrier[0].shape[0]] = self.barrier[0].dot(basis)
        y = project_by_daqp(start, C, self.low[:rows], self.high[:rows])
        if y is None and moves:  # too fast to brake: farther along b is better than beside it
            y = project_by_daqp(start, C, self.low, np.append(self.high[:-1], math.inf))
        if y is None:
            return None
        return basis.dot(y), float(y[at]) / weight if moves else 1.0

    def nearest(
        self, wish: np.ndarray, decomposition: tuple[np.ndarray, np.ndarray, np.ndarray], damping: float
    ) -> np.ndarray | None:
        """The second program: the velocity within the bounds that is nearest, mostly in the rows decomposed."""
        _, sigma, Vt = decomposition
        nv, scale = Vt.shape[0], 1.0 / max(damping, 1e-300)
        root = np.array([math.hypot(1.0, scale * x) for x in sigma.tolist()] + [1.0] * (nv - sigma.shape[0]))
        rows = np.empty((self.low.shape[0] - 1, nv))
        C = np.divide(Vt.T, root, out=rows[:nv])  # u = C x
        if self.barrier is not None:
            rows[nv:] = self.barrier[0].dot(C)
        x = project_by_daqp(root * Vt.dot(wish), rows, self.low[:-1], self.high[:-1])
        return None if x is None else C.dot(x)
