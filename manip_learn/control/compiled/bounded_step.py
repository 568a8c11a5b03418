"""`bounded_velocity.bounded_velocity` as loops over plain numbers."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.control.bounded_velocity import DEVIATION_WEIGHT, LARGEST_RATIO, NEGLIGIBLE, ROUNDING, TASK_WEIGHT
from manip_learn.control.compiled.decomposition import decompose
from manip_learn.control.compiled.joint_limits import within
from manip_learn.control.compiled.near_singularity import norm
from manip_learn.control.compiled.polytope import SCRATCH, project
from manip_learn.control.compiled.step_table import NULL_PART, TASK_PART
from manip_learn.robot.batch.kernel_cache import compiled_inside

# Rows of the space that the programs share. From SLOPE on come those of the barrier, the gradient of the smallest
# singular value first, with their lower bounds behind them; then the program's rows, and what `project` needs.
LOW, HIGH, TASK, WISH, START, FOUND, SLID, ANSWER, LOW_CAUSE, HIGH_CAUSE, SLOPE = range(11)


@compiled_inside
def space_of(nv, most):
    """The space for programs of up to `most` rows of the barrier, each row long enough for the bounds of all rows."""
    width = nv + 1 + most
    return np.empty((SLOPE + most + width + SCRATCH + 2 * (nv + 2), width))


@compiled_inside
def _program(space, nv):
    """Row where the program begins."""
    return SLOPE + space.shape[1] - nv - 1


@compiled_inside
def bounded_step(A, parts, escape, escapes, fastest, sigma, Vt, rank, space, rows, slide, damping):
    """Write the velocity within the bounds, `bounded_velocity`, into row FOUND of the space.

    Returns the task's scale, negative where none was found, and whether the barrier could be kept.

    Args:
        A: shape (s, nv).
        parts: Holds A^+ b and N pi in its rows TASK_PART and NULL_PART.
        escape: Velocity out of a singularity.
        escapes: Whether there is one.
        fastest: Velocity limits.
        sigma: Singular values of A, needed for `slide`; the first is negative where they are unknown.
        Vt: Right singular vectors, the null basis in its rows from `rank` on.
        rank: See `Vt`.
        space: LOW and HIGH hold the bounds; from SLOPE on are the rows of the barrier.
        rows: Number of rows of the barrier.
        slide: See `bounded_velocity`.
        damping: See `bounded_velocity`.
    """
    nv = A.shape[1]
    low, high, v, wish, found = space[LOW], space[HIGH], space[TASK], space[WISH], space[FOUND]
    too_fast = 1.0
    for j in range(nv):
        too_fast = max(too_fast, abs(parts[TASK_PART, j]) / fastest[j])
    for attempt in range(2 if rows > 0 else 1):
        n = rows if attempt == 0 else 0
        scale = _scaled_wish(parts, escape, escapes, too_fast, space, n)
        kept = _along(nv, scale, parts, escape, escapes, Vt, rank, space, n)
        if kept < 0.0:
            kept = _beside(A, v, wish, sigma[0], space, n)
        if kept >= 0.0 and slide > 0.0 and _nearest(wish, A.shape[0], sigma, Vt, damping, space, n, space[SLID]):
            for j in range(nv):
                found[j] += slide * (space[SLID, j] - found[j])
        if kept >= 0.0 and within(found, low, high, nv, ROUNDING):
            for j in range(nv):
                found[j] = min(max(found[j], low[j]), high[j])
            return kept / too_fast, attempt == 0
    for j in range(nv):  # a box always holds a point; this is for a solver that gave up
        found[j] = min(max(parts[TASK_PART, j] + parts[NULL_PART, j], low[j]), high[j])
    return -1.0, False


@compiled_inside
def _scaled_wish(parts, escape, escapes, too_fast, space, rows):
    """v slowed down into row TASK, the velocity wished for into WISH; returns the scale of v, `approach_scale`."""
    nv = parts.shape[1]
    for j in range(nv):
        space[TASK, j] = parts[TASK_PART, j] / too_fast
        space[WISH, j] = parts[NULL_PART, j] + (escape[j] if escapes else 0.0)
    scale = 1.0
    for i in range(rows):
        approach = room = 0.0
        for j in range(nv):
            approach -= space[SLOPE + i, j] * space[TASK, j]
            room += space[SLOPE + i, j] * space[WISH, j]
        if approach > 0.0:
            scale = min(scale, max(0.0, (room - space[SLOPE + i, nv]) / approach))
    for j in range(nv):
        space[WISH, j] += scale * space[TASK, j]
    return scale


@compiled_inside
def _along(nv, scale, parts, escape, escapes, Vt, rank, space, rows):
    """The first program, that keeps the task's direction: its scale, the velocity in FOUND; -1 if there is none."""
    found, start, v, null = space[FOUND], space[START], space[TASK, :nv], nv - rank
    length = norm(v)
    speed = norm(escape) if escapes else 0.0
    weight = TASK_WEIGHT * max(length, min(norm(parts[NULL_PART]), LARGEST_RATIO * length))
    moves, leaves = length > NEGLIGIBLE, speed > NEGLIGIBLE
    at, k, program = null, null, _program(space, nv)
    C = space[program:]
    for c in range(null):
        start[c] = 0.0
        for j in range(nv):
            C[j, c] = Vt[rank + c, j]
            start[c] += Vt[rank + c, j] * parts[NULL_PART, j]
    if moves:
        start[k] = weight * scale
        for j in range(nv):
            C[j, k] = v[j] / weight
        k += 1
    if leaves:
        start[k] = speed
        for j in range(nv):
            C[j, k] = escape[j] / speed
        k += 1
    m = nv + rows
    _barrier_rows(C, nv, k, space, rows)
    if moves:
        for c in range(k):
            C[m, c] = 0.0
        C[m, at] = 1.0 / weight
        space[LOW, m], space[HIGH, m] = 0.0, 1.0
        m += 1
    y, work = space[ANSWER], space[program + space.shape[1] :]
    solved = project(start, C, space[LOW], space[HIGH], m, k, y, work)
    if not solved and moves:  # too fast to brake: farther along b is better than beside it
        space[HIGH, m - 1] = math.inf
        solved = project(start, C, space[LOW], space[HIGH], m, k, y, work)
    if not solved:
        return -1.0
    _product(C, y, nv, k, found)
    return max(0.0, y[at] / weight) if moves else 1.0


@compiled_inside
def _barrier_rows(C, nv, k, space, rows):
    """The barrier along the columns, behind the rows of the joints, and its bounds."""
    for i in range(rows):
        for c in range(k):
            total = 0.0
            for j in range(nv):
                total += space[SLOPE + i, j] * C[j, c]
            C[nv + i, c] = total
        space[LOW, nv + i], space[HIGH, nv + i] = space[SLOPE + i, nv], math.inf


@compiled_inside
def _product(C, y, m, k, u):
    """u = C y."""
    for i in range(m):
        total = 0.0
        for c in range(k):
            total += C[i, c] * y[c]
        u[i] = total


@compiled_inside
def _beside(A, v, wish, largest, space, rows):
    """The second program, beside the task's direction: its scale, the velocity in FOUND; -1 if there is none."""
    s, nv = A.shape
    found = space[FOUND]
    across, b, along = np.empty((s, nv)), np.empty(s), np.empty(nv)
    Ut, sigma, Vt = np.empty((s, s)), np.empty(s), np.empty((s, nv))
    if largest < 0.0:
        decompose(A, s, Ut, sigma, Vt)
        largest = sigma[0]
    _product(A, v, s, nv, b)
    length = norm(b)
    for j in range(nv):
        along[j] = 0.0
        for i in range(s):
            along[j] += b[i] * A[i, j]
    for i in range(s):
        for j in range(nv):
            across[i, j] = A[i, j]
            if length >= NEGLIGIBLE:
                across[i, j] -= b[i] / length * along[j] / length
    decompose(across, s, Ut, sigma, Vt)
    if not _nearest(wish, s, sigma, Vt, largest / DEVIATION_WEIGHT, space, rows, found):
        return -1.0
    if length < NEGLIGIBLE:
        return 0.0
    scale = 0.0
    for j in range(nv):
        scale += along[j] * found[j]
    return max(0.0, scale / (length * length))


@compiled_inside
def _nearest(wish, s, sigma, Vt, damping, space, rows, u):
    """The velocity within the bounds that is nearest to `wish`, mostly in the rows decomposed; False if none is.

    In x with u = (I + sum_i (r_i - 1) v_i v_i^T) x, r_i = 1 / sqrt(1 + (sigma_i / damping)^2), it is nearest to x* of
    the wish: the symmetric root, which needs no basis of what is left.
    """
    nv = Vt.shape[1]
    program = _program(space, nv)
    C, start, y = space[program:], space[START], space[ANSWER]
    for i in range(nv):
        start[i] = wish[i]
        for j in range(nv):
            C[i, j] = 1.0 if i == j else 0.0
    for r in range(s):
        ratio = sigma[r] / max(damping, 1e-300)
        root = math.sqrt(1.0 + ratio * ratio)
        # 1 - 1 / root without cancellation
        factor, along = ratio * ratio / (root * (1.0 + root)), 0.0
        for j in range(nv):
            along += Vt[r, j] * wish[j]
        for i in range(nv):
            start[i] += (root - 1.0) * along * Vt[r, i]
            for j in range(nv):
                C[i, j] -= factor * Vt[r, i] * Vt[r, j]
    _barrier_rows(C, nv, nv, space, rows)
    work = space[program + space.shape[1] :]
    if not project(start, C, space[LOW], space[HIGH], nv + rows, nv, y, work):
        return False
    _product(C, y, nv, nv, u)
    return True
