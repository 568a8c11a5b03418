"""The point of a polytope that is nearest to another: the quadratic program behind bounded commands."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import daqp
import numpy as np
from jaxtyping import Float

# how much a bound may be exceeded by rounding, in the unit of the bounds
TOLERANCE = 1e-11
# square of a row's part outside the active rows, as a share of its own, below which it depends on them
DEPENDENT = 1e-18
# ... and below which it is projected twice
REORTHOGONAL = 1e-2

# how much DAQP may exceed a bound: commands are compared to 1e-12
FINE = 1e-13
SOLVED, INFEASIBLE = 1, -1  # exit flags of DAQP
# rows of the scratch, each as long as x, before those of the triangle and of the basis
DIRECTION, ALONG, FALL, MULTIPLIERS, BOUNDS, SIGNS, ACTIVE, SCRATCH = range(8)


def project(
    x: Float[np.ndarray, " k"],
    C: Float[np.ndarray, "m k"],
    low: Float[np.ndarray, " m"],
    high: Float[np.ndarray, " m"],
    by_library: bool,
) -> tuple[bool, Float[np.ndarray, " k"]]:
    """`project_by_active_set`, by DAQP where that is asked for and at hand, in a fifth of the time.

    DAQP is a dual active-set solver in C (Arnstrom, Bemporad and Axehill, "A dual active-set solver for embedded
    quadratic programming using recursive LDL^T updates", 2022); compiled laws do not need it.
    """
    if by_library:
        k, m = x.shape[0], low.shape[0]
        y, _, exit_flag, _ = daqp.solve(_unit(k), -x, C, high, low, _inequalities(m), primal_tol=FINE)
        if exit_flag == SOLVED:
            return True, np.asarray(y)
        # where 0 is the only point, or one of few, DAQP may not see it
        if exit_flag == INFEASIBLE and not (low.max() <= 0.0 <= high.min()):
            return False, x
    return project_by_active_set(x, C, low, high)


@cache
def _unit(size: int) -> np.ndarray:
    return np.eye(size)  # DAQP takes no array that may not be written to, and does not write


@cache
def _inequalities(size: int) -> np.ndarray:
    return np.zeros(size, dtype=np.int32)


def project_by_active_set(
    x: Float[np.ndarray, " k"],
    C: Float[np.ndarray, "m k"],
    low: Float[np.ndarray, " m"],
    high: Float[np.ndarray, " m"],
) -> tuple[bool, Float[np.ndarray, " k"]]:
    """Whether a point meets the bounds, and the nearest, argmin |y - x|^2 subject to low <= C y <= high.

    By the dual active-set method of Goldfarb and Idnani, "A numerically stable dual method for solving strictly convex
    quadratic programs" (1983): it starts from x itself, and brings the row that is exceeded most to its bound, one
    after another; rows whose multiplier would change its sign are let go. The answer depends continuously on all
    arguments. An orthonormal basis of the active rows' normals is kept with its triangle, and mended when a row comes
    or goes. In loops over plain numbers: array by array it is compiled into code that takes two to three times as long.

    Args:
        x: The point.
        C: One row per constraint.
        low: Lower bounds.
        high: Upper bounds.
    """
    m, k = C.shape
    y, work = np.empty(k), np.zeros((SCRATCH + 2 * k, k))
    multipliers, active = work[MULTIPLIERS], work[ACTIVE]
    n = k - k  # none; no literal 0, for which numba would compile everything below a second time
    for c in range(k):
        y[c] = x[c]
    for _ in range(8 * m):
        worst, excess, sign = _most_exceeded(y, C, low, high, active, n)
        if worst < 0:
            if n > 0:
                _on_faces(x, y, work, n)
            return True, y
        square = 0.0
        for c in range(k):
            square += C[worst, c] * C[worst, c]
        multiplier = 0.0
        while True:
            slope = _across(C, worst, sign, square, work, n)
            full = excess / slope if slope > DEPENDENT * square and n < k else math.inf
            partial, leaving = math.inf, n
            for a in range(n):
                if work[FALL, a] > 0.0 and multipliers[a] < partial * work[FALL, a]:
                    partial, leaving = multipliers[a] / work[FALL, a], a
            step = min(full, partial)
            if step == math.inf:
                return False, y
            for a in range(n):
                multipliers[a] -= step * work[FALL, a]
            multiplier += step
            if full < math.inf:
                for c in range(k):
                    y[c] -= step * work[DIRECTION, c]
                excess -= step * slope
            if step == full:
                active[n], multipliers[n], work[SIGNS, n] = worst, multiplier, sign
                work[BOUNDS, n] = high[worst] if sign > 0.0 else -low[worst]
                _enter(work, n, slope)
                n += 1
                break
            n = _leave(C, work, leaving, n)
    return False, y


def _most_exceeded(y: Any, C: Any, low: Any, high: Any, active: Any, n: int) -> tuple[int, float, float]:
    """(row, by how much, 1 above and -1 below) of the row whose bound is exceeded most; row -1 if none is."""
    m, k = C.shape
    worst, excess, sign = -1, TOLERANCE, 1.0
    for i in range(m):
        reached = 0.0
        for c in range(k):
            reached += C[i, c] * y[c]
        beyond = max(reached - high[i], low[i] - reached)
        if beyond > excess:
            known = False
            for a in range(n):
                known = known or active[a] == i
            if not known:
                worst, excess, sign = i, beyond, 1.0 if reached > high[i] else -1.0
    return worst, excess, sign


def _across(C: Any, row: int, sign: float, square: float, work: Any, n: int) -> float:
    """A row's normal without its part along the active ones; returns its square.

    Its coordinates along the basis go into ALONG, how fast the multipliers of the active rows fall into FALL. Where
    little is left it is projected twice, for what rounding has left.
    """
    k = C.shape[1]
    for c in range(k):
        work[DIRECTION, c] = sign * C[row, c]
    for a in range(n):
        work[ALONG, a] = 0.0
    slope = 0.0
    for _ in range(2):
        for a in range(n):
            q, along = SCRATCH + k + a, 0.0
            for c in range(k):
                along += work[q, c] * work[DIRECTION, c]
            for c in range(k):
                work[DIRECTION, c] -= along * work[q, c]
            work[ALONG, a] += along
        slope = 0.0
        for c in range(k):
            slope += work[DIRECTION, c] * work[DIRECTION, c]
        if n == 0 or slope > REORTHOGONAL * square:
            break
    for a in range(n - 1, -1, -1):
        total = work[ALONG, a]
        for c in range(a + 1, n):
            total -= work[SCRATCH + a, c] * work[FALL, c]
        work[FALL, a] = total / work[SCRATCH + a, a]
    return slope


def _enter(work: Any, n: int, slope: float) -> None:
    """The direction and its coordinates become column n of the basis and of its triangle."""
    k, length = work.shape[1], math.sqrt(slope)
    for a in range(n):
        work[SCRATCH + a, n] = work[ALONG, a]
    work[SCRATCH + n, n] = length
    for c in range(k):
        work[SCRATCH + k + n, c] = work[DIRECTION, c] / length


def _leave(C: Any, work: Any, leaving: int, n: int) -> int:
    """Let an active row go, and make the basis of those behind it anew; returns the number of active rows."""
    active = work[ACTIVE]
    for a in range(leaving, n - 1):
        active[a] = active[a + 1]
        for i in range(MULTIPLIERS, SIGNS + 1):
            work[i, a] = work[i, a + 1]
        slope = _across(C, int(active[a]), work[SIGNS, a], math.inf, work, a)
        _enter(work, a, slope)
    return n - 1


def _on_faces(x: Any, y: Any, work: Any, n: int) -> None:
    """The nearest point to x on all active bounds, without the rounding of the steps that led to y."""
    k = x.shape[0]
    for c in range(k):
        y[c] = x[c]
    for a in range(n):
        reached = work[BOUNDS, a]
        for i in range(a):
            reached -= work[SCRATCH + i, a] * work[FALL, i]
        work[FALL, a] = reached / work[SCRATCH + a, a]  # where the bounds are along the basis
    for a in range(n):
        q, along = SCRATCH + k + a, 0.0
        for c in range(k):
            along += work[q, c] * x[c]
        for c in range(k):
            y[c] += (work[FALL, a] - along) * work[q, c]
