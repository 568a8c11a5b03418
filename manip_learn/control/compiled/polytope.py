"""`polytope_projection.project_by_active_set` as loops over plain numbers."""

from __future__ import annotations

import math

from manip_learn.control.polytope_projection import DEPENDENT, REORTHOGONAL, TOLERANCE
from manip_learn.robot.batch.kernel_cache import compiled_inside

# rows of the scratch of `project`, each as long as x, before those of the triangle and of the basis
DIRECTION, ALONG, FALL, MULTIPLIERS, BOUNDS, SIGNS, ACTIVE, SCRATCH = range(8)


@compiled_inside
def project(x, C, bounds, m, k, y, work):
    """y = argmin |y - x|^2 subject to low <= C y <= high for the first m rows and k columns; False if there is no y.

    The dual active-set method of Goldfarb and Idnani (1983). An orthonormal basis of the active rows' normals is kept
    with its triangle, and mended when a row comes or goes.

    Args:
        x: The point.
        C: One row per constraint.
        bounds: Lower and upper bounds, in two rows.
        m: Number of rows.
        k: Number of columns.
        y: The answer.
        work: Scratch, SCRATCH + 2 k rows of k columns or more.
    """
    multipliers, active = work[MULTIPLIERS], work[ACTIVE]
    n = k - k  # none; no literal 0, for which numba would compile everything below a second time
    for c in range(k):
        y[c] = x[c]
    for _ in range(8 * m):
        worst, excess, sign = _most_exceeded(y, C, bounds, m, k, active, n)
        if worst < 0:
            if n > 0:
                _on_faces(x, y, work, n, k)
            return True
        square = 0.0
        for c in range(k):
            square += C[worst, c] * C[worst, c]
        multiplier = 0.0
        while True:
            slope = _across(C, worst, sign, square, work, n, k)
            full = excess / slope if slope > DEPENDENT * square and n < k else math.inf
            partial, leaving = math.inf, n
            for a in range(n):
                if work[FALL, a] > 0.0 and multipliers[a] < partial * work[FALL, a]:
                    partial, leaving = multipliers[a] / work[FALL, a], a
            step = min(full, partial)
            if step == math.inf:
                return False
            for a in range(n):
                multipliers[a] -= step * work[FALL, a]
            multiplier += step
            if full < math.inf:
                for c in range(k):
                    y[c] -= step * work[DIRECTION, c]
                excess -= step * slope
            if step == full:
                active[n], multipliers[n], work[SIGNS, n] = worst, multiplier, sign
                work[BOUNDS, n] = bounds[1, worst] if sign > 0.0 else -bounds[0, worst]
                _enter(work, n, k, slope)
                n += 1
                break
            n = _leave(C, work, active, leaving, n, k)
    return False


@compiled_inside
def _most_exceeded(y, C, bounds, m, k, active, n):
    """(row, by how much, 1 above and -1 below) of the row whose bound is exceeded most; row -1 if none is."""
    worst, excess, sign = -1, TOLERANCE, 1.0
    for i in range(m):
        reached = 0.0
        for c in range(k):
            reached += C[i, c] * y[c]
        beyond = max(reached - bounds[1, i], bounds[0, i] - reached)
        if beyond > excess:
            known = False
            for a in range(n):
                known = known or active[a] == i
            if not known:
                worst, excess, sign = i, beyond, 1.0 if reached > bounds[1, i] else -1.0
    return worst, excess, sign


@compiled_inside
def _across(C, row, sign, square, work, n, k):
    """A row's normal without its part along the active ones; returns its square.

    Its coordinates along the basis go into ALONG, how fast the multipliers of the active rows fall into FALL. Where
    little is left it is projected twice, for what rounding has left.
    """
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


@compiled_inside
def _enter(work, n, k, slope):
    """The direction and its coordinates become column n of the basis and of its triangle."""
    length = math.sqrt(slope)
    for a in range(n):
        work[SCRATCH + a, n] = work[ALONG, a]
    work[SCRATCH + n, n] = length
    for c in range(k):
        work[SCRATCH + k + n, c] = work[DIRECTION, c] / length


@compiled_inside
def _leave(C, work, active, leaving, n, k):
    """Let an active row go, and make the basis of those behind it anew; returns the number of active rows."""
    for a in range(leaving, n - 1):
        active[a] = active[a + 1]
        for i in range(MULTIPLIERS, SIGNS + 1):
            work[i, a] = work[i, a + 1]
        slope = _across(C, int(active[a]), work[SIGNS, a], math.inf, work, a, k)
        _enter(work, a, k, slope)
    return n - 1


@compiled_inside
def _on_faces(x, y, work, n, k):
    """The nearest point to x on all active bounds, without the rounding of the steps that led to y."""
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
