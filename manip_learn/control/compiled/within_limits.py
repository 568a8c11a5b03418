"""The law brought within the limits, and what came of it, as loops over plain numbers.

`bounded_velocity.bounded_velocity` with its program, `project_by_active_set`, and `bounded_command`.
"""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.compiled_rows import add, dot
from manip_learn.control import resolved_rate_law
from manip_learn.control.bounded_velocity import (
    DEPENDENT,
    DEVIATION_WEIGHT,
    LARGEST_RATIO,
    NEGLIGIBLE,
    REORTHOGONAL,
    ROUNDING,
    TASK_WEIGHT,
    TOLERANCE,
)
from manip_learn.control.compiled import step_table as table
from manip_learn.control.compiled.constrained_rows import (
    complete,
    decompose,
    dofs_of,
    norm,
)
from manip_learn.control.compiled.limits import binding, bounds_of, breaks, with_broken, within
from manip_learn.control.compiled.near_singularity import is_singular
from manip_learn.control.limits import MOST_ROWS
from manip_learn.control.resolved_rate_law import AT_GOAL
from manip_learn.robot.batch.kernel_cache import compiled_inside

# rows of the scratch of `project`, each as long as x, before those of the triangle and of the basis
DIRECTION, ALONG, FALL, MULTIPLIERS, BOUNDS, SIGNS, ACTIVE, SCRATCH = range(8)

plain_status = compiled_inside(resolved_rate_law.plain_status)
bounded_status = compiled_inside(resolved_rate_law.bounded_status)
next_slide = compiled_inside(resolved_rate_law.next_slide)


@compiled_inside
def space_of(nv, most):
    """The space for programs of up to `most` rows of the barrier, each row long enough for the bounds of all rows."""
    width = nv + 1 + most
    return np.empty((table.SLOPE + most + width + SCRATCH + 2 * (nv + 2), width))


@compiled_inside
def _program(space, nv):
    """Row where the program begins."""
    return table.SLOPE + space.shape[1] - nv - 1


@compiled_inside
def bounded_step(step, rows, space, barriers, damping):
    """Write the velocity within the bounds, `bounded_velocity`, into row FOUND of the space.

    Returns the task's scale, negative where none was found, and whether the barrier could be kept.

    Args:
        step: Its parts hold A^+ b, N pi and the velocity out of a singularity.
        rows: Singular values and vectors are needed for a step that slides; of Vt always the null space.
        space: LOW and HIGH hold the bounds; from SLOPE on are the rows of the barrier.
        barriers: Number of rows of the barrier.
        damping: See `bounded_velocity`.
    """
    constants, parts, facts, nv = step.constants, step.parts, step.work[table.FACTS], rows.A.shape[1]
    found, too_fast, dofs = space[table.FOUND], 1.0, dofs_of(constants)
    for j in range(nv):
        too_fast = max(too_fast, abs(parts[table.TASK_PART, j]) / constants[dofs + j, table.LIMIT])
    for attempt in range(2 if barriers > 0 else 1):
        n = barriers if attempt == 0 else 0
        scale = _scaled_wish(parts, facts, too_fast, space, n)
        kept = _along(rows.Vt, scale, parts, facts, space, n)
        if kept < 0.0:
            kept = _beside(rows, space, n)
        slides = kept >= 0.0 and step.slide > 0.0
        if slides and _nearest(rows.sigma, rows.Vt, damping, space, n, space[table.SLID]):
            for j in range(nv):
                found[j] += step.slide * (space[table.SLID, j] - found[j])
        if kept >= 0.0 and within(found, space, nv, ROUNDING):
            _clip(found, space, nv)
            return kept / too_fast, attempt == 0
    # a box always holds a point; this is for a solver that gave up
    found[:nv] = parts[table.TASK_PART] + parts[table.NULL_PART]
    _clip(found, space, nv)
    return -1.0, False


@compiled_inside
def _clip(u, space, nv):
    for j in range(nv):
        u[j] = min(max(u[j], space[table.LOW, j]), space[table.HIGH, j])


@compiled_inside
def _scaled_wish(parts, facts, too_fast, space, barriers):
    """v slowed down into row TASK_AIM, the velocity wished for into WISH; returns the scale of v, `approach_scale`."""
    nv, escapes, scale = parts.shape[1], facts[table.HAS_ESCAPE] != 0.0, 1.0
    v, wish = space[table.TASK_AIM, :nv], space[table.WISH, :nv]
    for j in range(nv):
        v[j] = parts[table.TASK_PART, j] / too_fast
        wish[j] = parts[table.NULL_PART, j] + (parts[table.ESCAPE_PART, j] if escapes else 0.0)
    for i in range(barriers):
        slope = space[table.SLOPE + i]
        approach = -dot(v, slope)
        if approach > 0.0:
            scale = min(scale, max(0.0, (dot(wish, slope) - slope[nv]) / approach))
    add(wish, scale, v)
    return scale


@compiled_inside
def _along(Vt, scale, parts, facts, space, barriers):
    """The first program, that keeps the task's direction: its scale, the velocity in FOUND; -1 if there is none."""
    nv, rank = parts.shape[1], int(facts[table.RANK])
    start, v, null, escape = space[table.START], space[table.TASK_AIM, :nv], nv - rank, parts[table.ESCAPE_PART]
    length = norm(v)
    speed = norm(escape) if facts[table.HAS_ESCAPE] != 0.0 else 0.0
    weight = TASK_WEIGHT * max(length, min(norm(parts[table.NULL_PART]), LARGEST_RATIO * length))
    moves, leaves = length > NEGLIGIBLE, speed > NEGLIGIBLE
    at, k, program = null, null, _program(space, nv)
    C = space[program:]
    for c in range(null):
        start[c] = 0.0
        for j in range(nv):
            C[j, c] = Vt[rank + c, j]
            start[c] += Vt[rank + c, j] * parts[table.NULL_PART, j]
    if moves:
        start[k] = weight * scale
        C[:nv, k] = v / weight
        k += 1
    if leaves:
        start[k] = speed
        C[:nv, k] = escape / speed
        k += 1
    m = nv + barriers
    _barrier_rows(C, nv, k, space, barriers)
    if moves:
        C[m] = 0.0
        C[m, at] = 1.0 / weight
        space[table.LOW, m], space[table.HIGH, m] = 0.0, 1.0
        m += 1
    y, work, bounds = space[table.ANSWER], space[program + space.shape[1] :], space[table.LOW : table.HIGH + 1]
    solved = project(start, C, bounds, m, k, y, work)
    if not solved and moves:  # too fast to brake: farther along b is better than beside it
        space[table.HIGH, m - 1] = math.inf
        solved = project(start, C, bounds, m, k, y, work)
    if not solved:
        return -1.0
    _product(C, y, nv, k, space[table.FOUND])
    return max(0.0, y[at] / weight) if moves else 1.0


@compiled_inside
def _barrier_rows(C, nv, k, space, barriers):
    """The barrier along the columns, behind the rows of the joints, and its bounds."""
    for i in range(barriers):
        for c in range(k):
            C[nv + i, c] = dot(C[:nv, c], space[table.SLOPE + i])
        space[table.LOW, nv + i], space[table.HIGH, nv + i] = space[table.SLOPE + i, nv], math.inf


@compiled_inside
def _product(C, y, m, k, u):
    """u = C y."""
    for i in range(m):
        u[i] = dot(C[i, :k], y)


@compiled_inside
def _beside(rows, space, barriers):
    """The second program, beside the task's direction: its scale, the velocity in FOUND; -1 if there is none."""
    A, largest, found = rows.A, rows.sigma[0], space[table.FOUND]
    s, nv = A.shape
    across, b, along = np.empty((s, nv)), np.empty(s), np.empty(nv)
    Ut, sigma, Vt = np.empty((s, s)), np.empty(s), np.empty((s, nv))
    if largest < 0.0:
        decompose(A, s, Ut, sigma, Vt)
        largest = sigma[0]
    _product(A, space[table.TASK_AIM], s, nv, b)
    length = norm(b)
    across[:] = A
    along[:] = 0.0
    for i in range(s):
        add(along, b[i], A[i])
    if length >= NEGLIGIBLE:
        across -= np.outer(b / length, along) / length
    decompose(across, s, Ut, sigma, Vt)
    if not _nearest(sigma, Vt, largest / DEVIATION_WEIGHT, space, barriers, found):
        return -1.0
    if length < NEGLIGIBLE:
        return 0.0
    return max(0.0, dot(along, found) / (length * length))


@compiled_inside
def _nearest(sigma, Vt, damping, space, barriers, u):
    """The velocity within the bounds that is nearest to row WISH, mostly in the rows decomposed; False if none is.

    In x with u = (I + sum_i (r_i - 1) v_i v_i^T) x, r_i = 1 / sqrt(1 + (sigma_i / damping)^2), it is nearest to x* of
    the wish: the symmetric root, which needs no basis of what is left.
    """
    nv = Vt.shape[1]
    program = _program(space, nv)
    C, start, wish, y = space[program:], space[table.START], space[table.WISH], space[table.ANSWER]
    for i in range(nv):
        start[i] = wish[i]
        for j in range(nv):
            C[i, j] = 1.0 if i == j else 0.0
    for r in range(sigma.shape[0]):
        ratio = sigma[r] / max(damping, 1e-300)
        root = math.sqrt(1.0 + ratio * ratio)
        # 1 - 1 / root without cancellation
        factor = ratio * ratio / (root * (1.0 + root))
        add(start[:nv], (root - 1.0) * dot(Vt[r], wish), Vt[r])
        for i in range(nv):
            add(C[i, :nv], -factor * Vt[r, i], Vt[r])
    _barrier_rows(C, nv, nv, space, barriers)
    work = space[program + space.shape[1] :]
    if not project(start, C, space[table.LOW : table.HIGH + 1], nv + barriers, nv, y, work):
        return False
    _product(C, y, nv, nv, u)
    return True


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
    y[:k] = x[:k]
    for _ in range(8 * m):
        worst, excess, sign = _most_exceeded(y, C, bounds, m, k, active, n)
        if worst < 0:
            if n > 0:
                _on_faces(x, y, work, n, k)
            return True
        square, multiplier = dot(C[worst, :k], C[worst]), 0.0
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
                add(y[:k], -step, work[DIRECTION])
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
        reached = dot(C[i, :k], y)
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
    work[ALONG, :n] = 0.0
    slope, direction = 0.0, work[DIRECTION, :k]
    for _ in range(2):
        for a in range(n):
            along = dot(direction, work[SCRATCH + k + a])
            add(direction, -along, work[SCRATCH + k + a])
            work[ALONG, a] += along
        slope = dot(direction, direction)
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
    y[:k] = x[:k]
    for a in range(n):
        reached = work[BOUNDS, a]
        for i in range(a):
            reached -= work[SCRATCH + i, a] * work[FALL, i]
        work[FALL, a] = reached / work[SCRATCH + a, a]  # where the bounds are along the basis
    for a in range(n):
        q = work[SCRATCH + k + a, :k]
        add(y[:k], work[FALL, a] - dot(q, x), q)


@compiled_inside
def within_limits(step, rows, barred, tips, space):
    """Bring the law within the limits; return the status of the command.

    Args:
        step: Its parts are replaced by those commanded.
        rows: As `Rows` says, with the null space in Vt where A is singular.
        barred: Whether the approach to a singularity is bounded; gradient and bound are in the space then.
        tips: The limited frames, see `tips_at`.
        space: See `space_of`.
    """
    constants, parts, facts, A, sigma = step.constants, step.parts, step.work[table.FACTS], rows.A, rows.sigma
    s, nv = A.shape
    singular = is_singular(sigma)
    damped = int(constants[0, table.INVERSE]) == table.DAMPED and facts[table.SMALLEST] < constants[0, table.THRESHOLD]
    if constants[0, table.LIMITS] == 0.0:
        return plain_outcome(A, singular, damped, 0.0, parts, facts)
    outside = bounds_of(constants, step.q, step.dt, step.previous, space)
    broken, near = breaks(constants, tips, parts[table.VELOCITY])
    slow = not broken and not (barred and _too_fast(parts, space))
    if slow and within(parts[table.VELOCITY], space, nv, 0.0):
        return plain_outcome(A, singular, damped, outside, parts, facts)
    if not singular:
        complete(rows.Vt, s)
    if sigma[0] < 0.0 and step.slide > 0.0:
        decompose(A, s, rows.Ut, sigma, rows.Vt)
    # an explicit step of dt follows sliding that is damped that much
    blur = max(constants[1, table.DAMPING], math.sqrt(2.0 * step.dt * norm(parts[table.TASK_VELOCITY, :s])))
    barriers, u, scale = 1 if barred else 0, parts[table.VELOCITY], -1.0
    for turn in range(MOST_ROWS if tips.shape[0] > 0 else 1):  # `TipLimits.bounded`
        more = with_broken(constants, tips, u, space, barriers)
        if turn > 0 and more == barriers:
            break
        barriers, u = more, space[table.FOUND, :nv]
        scale, kept = bounded_step(step, rows, space, barriers, blur)
        if not kept:  # more rows would be kept even less
            break
    fits = within(parts[table.TASK_PART], space, nv, 0.0)
    joint, cause = binding(parts, space)
    split_parts(space[table.FOUND], rows.Vt, scale >= 0.0, parts, facts)
    progress, scale = progress_of(A, parts), max(scale, 0.0)
    facts[table.TASK_SCALE], facts[table.PROGRESS] = min(scale, 1.0), progress
    facts[table.OUTSIDE], facts[table.LIMITING_JOINT] = outside, joint
    status = bounded_status(singular, damped, progress, outside, scale, joint, int(cause), fits)
    if not broken or damped or status != table.DAMPED_STATUS:
        return status
    return table.POSITION_LIMITED if near else table.VELOCITY_LIMITED


@compiled_inside
def _too_fast(parts, space):
    """Whether the velocity approaches a singularity faster than the barrier allows."""
    return dot(parts[table.VELOCITY], space[table.SLOPE]) < space[table.SLOPE, parts.shape[1]]


@compiled_inside
def progress_of(A, parts):
    """Velocity along b over the velocity asked for, b^T A u / |b|^2; 1 where nothing is asked for."""
    square = along = 0.0
    for i in range(A.shape[0]):
        b = parts[table.TASK_VELOCITY, i]
        square += b * b
        along += b * dot(A[i], parts[table.VELOCITY])
    return along / square if square > AT_GOAL * AT_GOAL else 1.0


@compiled_inside
def plain_outcome(A, singular, damped, outside, parts, facts):
    """Status and numbers of a command that no limit changes, `plain_command`."""
    progress = progress_of(A, parts) if damped or singular else 1.0
    facts[table.TASK_SCALE] = facts[table.NULL_SCALE] = 1.0
    facts[table.PROGRESS], facts[table.OUTSIDE], facts[table.LIMITING_JOINT] = progress, outside, -1.0
    return plain_status(singular, damped, progress, outside)


@compiled_inside
def split_parts(found, Vt, solved, parts, facts):
    """Write the velocity and its parts as commanded into `parts`; see `Command`."""
    nv, rank = Vt.shape[1], int(facts[table.RANK])
    velocity, task, escape = parts[table.VELOCITY], parts[table.TASK_PART], parts[table.ESCAPE_PART]
    null_part = parts[table.NULL_PART]
    for j in range(nv):
        velocity[j], task[j] = found[j], 0.0
    for i in range(rank, nv if solved else rank):
        add(task, dot(velocity, Vt[i]), Vt[i])
    square, along = dot(null_part, null_part), dot(null_part, task)
    for j in range(nv):  # the null-space part of the velocity was in the place of the task's
        null_part[j], task[j] = task[j], velocity[j] - task[j]
    facts[table.NULL_SCALE] = min(1.0, max(0.0, along / square)) if square > NEGLIGIBLE * NEGLIGIBLE else 1.0
    if facts[table.HAS_ESCAPE] == 0.0:
        return
    factor = min(1.0, max(0.0, dot(velocity, escape) / max(dot(escape, escape), 1e-300)))
    for j in range(nv):
        escape[j] *= factor
        task[j] -= escape[j]
