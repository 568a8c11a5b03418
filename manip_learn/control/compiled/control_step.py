"""One control step as loops over plain numbers: the law of `controller`, in every state.

numba compiles these functions (the optional extra `fast`); without it they are plain Python, the same function objects.
First the step where A is well-conditioned and no limit changes the law, as in most steps. Handed back to Python is what
is not finite, a lost direction where the inverse is "exact", and one where a policy has no bound. Calls are nested as
little as possible: numba optimises a function again in each of its callers.
"""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.compiled_rows import mix_rows
from manip_learn.control.compiled import step_table as table
from manip_learn.control.compiled.constrained_rows import (
    chain_rows,
    chain_vjp,
    dofs_of,
    form_of,
    joints_at,
    mix_at,
    norm,
    places,
    public_rows,
    row_inverse,
    row_space,
    sizes_of,
    turn_joints,
)
from manip_learn.control.compiled.limits import admitted, braking_rate, breaks, has_tips, most_rows, tips_at
from manip_learn.control.compiled.near_singularity import (
    barrier,
    is_fast,
    may_approach,
    policy_velocity,
    posed_policy,
    singular_parts,
    smallest_weights,
)
from manip_learn.control.compiled.within_limits import next_slide, space_of, within_limits
from manip_learn.control.singularity import BRAKING_SHARE
from manip_learn.robot.batch.compiled_kinematics import END_ORIGIN, GRADIENT, LOCAL, SLIDE, columns_of, six
from manip_learn.robot.batch.kernel_cache import compiled, compiled_inside
from manip_learn.robot.rotations import SMALL_ANGLE


@compiled_inside
def free_step(constants, q, dt, previous, parts, work):
    """Write the law into the parts; return OK, REFUSED, or LIMITED, ILL_CONDITIONED or ILL_POSED: more to be done."""
    facts = work[table.FACTS]
    joints, nv, s = sizes_of(constants)
    for j in range(nv):
        if not math.isfinite(q[j]):
            return table.REFUSED
    dofs, base, posed = dofs_of(constants), joints_at(s), constants[0, table.TASK] == table.POSE
    turn_joints(constants, table.CHAIN, joints, q, work, base)
    place = columns_of(constants, table.CHAIN, joints, work, base, SLIDE, 1, work, base)
    mix = mix_at(s, joints)
    mix_rows(constants, dofs + nv, s, form_of(constants), place[0], place[1], place[2], work, mix)
    chain_rows(work, mix, s, joints, work)
    if posed:
        facts[table.ERROR] = pose_velocity(
            constants, dofs + nv, s, place, work, base + joints, parts[table.TASK_VELOCITY]
        )
    else:
        facts[table.ERROR] = task_velocity(constants, dofs + nv, s, place, parts[table.TASK_VELOCITY])
    # parts of rows: LLVM would vectorise loops over whole ones, which are too short for that
    scratch_rows = work[table.MATRICES : table.MATRICES + 3 * s]
    A, X, squares = scratch_rows[:s, :joints], scratch_rows[s : 2 * s, :joints], scratch_rows[2 * s :]
    G, L = squares[:, :s], squares[:, s : 2 * s]
    volume, smallest = row_inverse(A, X, G, L)
    facts[table.MU], facts[table.SMALLEST], facts[table.HAS_ESCAPE] = volume, smallest, 0.0
    facts[table.TASK_SCALE] = facts[table.NULL_SCALE] = facts[table.PROGRESS] = 1.0
    facts[table.OUTSIDE], facts[table.LIMITING_JOINT], facts[table.RANK] = 0.0, -1.0, s
    damps = int(constants[0, table.INVERSE]) == table.DAMPED
    if volume == 0.0 or (damps and not posed and smallest < constants[0, table.THRESHOLD]):
        return table.ILL_CONDITIONED
    policy_velocity(constants, q, dt, volume, X, work)
    if posed:  # the policy is that of A; those of the error take its place
        chain_rows(work, base + joints + 1, s, joints, work)
        volume, facts[table.SMALLEST] = row_inverse(A, X, G, L)
        if volume == 0.0 or (damps and facts[table.SMALLEST] < constants[0, table.THRESHOLD]):
            return table.ILL_POSED
    size = regular_parts(constants, A, X, L, work[table.PI], parts)
    square, weakest = 0.0, math.inf
    for j in range(nv):
        square += parts[table.VELOCITY, j] * parts[table.VELOCITY, j]
        weakest = min(weakest, constants[dofs + j, table.ACCELERATION])
    if not math.isfinite(square + size):
        return table.REFUSED
    if constants[0, table.LIMITS] == 0.0:
        return table.OK
    if damps and not posed and is_fast(square, size, weakest, smallest, dt):
        if s > 2 or _approaches(constants, A, X, weakest, dt, parts, work):
            return table.LIMITED
    return table.OK if admitted(constants, q, dt, parts[table.VELOCITY], previous) else table.LIMITED


@compiled_inside
def scratch(joints, nv, s):
    """The work space of a step: numbers, A, its inverse, two squares, the joints, the chain's end, a pose's error, and
    the weights of (v, w).
    """
    return np.empty((mix_at(s, joints) + s + 1, max(table.LEAST_WIDTH, nv, 2 * s)))


@compiled_inside
def task_velocity(constants, first, s, p, b):
    """Write the task velocity b = gain Lambda (r* - r(q)), norm at most max_speed; return the error, 0 of a given b."""
    if constants[0, table.TASK] == table.GIVEN:
        return 0.0
    if constants[0, table.TASK] != table.POINT:
        for i in range(s):
            b[i] = 0.0
        return 0.0
    at = table.CHAIN + 1
    d0, d1 = constants[at, table.TARGET_POINT] - p[0], constants[at, table.TARGET_POINT + 1] - p[1]
    d2 = constants[at, table.TARGET_POINT + 2] - p[2]
    for i in range(s):
        b[i] = constants[first + i, 0] * d0 + constants[first + i, 1] * d1 + constants[first + i, 2] * d2
    return attracted(constants, s, b)


@compiled_inside
def _approaches(constants, A, X, weakest, dt, parts, work):
    """Whether a singularity is approached faster than the weakest joint could brake before it, for one or two rows.

    `singularity.approach_bound` allows no less. X is scratch.
    """
    (s, joints), smallest = A.shape, work[table.FACTS, table.SMALLEST]
    smallest_weights(A, smallest, X)
    chain_vjp(constants, X, work)
    base, approach, square = joints_at(s), 0.0, 0.0
    for j in range(joints):
        column, place = places(constants, j)
        slope = work[base + place, GRADIENT]
        square += slope * slope
        approach -= slope * parts[table.VELOCITY, column]
    return approach > braking_rate(smallest, BRAKING_SHARE * math.sqrt(square) * weakest, dt)


@compiled_inside
def regular_parts(constants, A, X, scratch, pi, parts):
    """A^+ b and N pi from X = A^{+T}, and their sum; returns the sum of the squares of A."""
    s, joints = A.shape
    along, size = scratch[0], 0.0
    for i in range(s):
        along[i] = 0.0
    for j in range(joints):
        column, place = places(constants, j)
        for i in range(s):
            along[i] += A[i, place] * pi[column]
            size += A[i, place] * A[i, place]
    for j in range(parts.shape[1]):
        parts[table.TASK_PART, j], parts[table.NULL_PART, j], parts[table.VELOCITY, j] = 0.0, pi[j], pi[j]
    for j in range(joints):
        column, place = places(constants, j)
        task, null = 0.0, pi[column]
        for i in range(s):
            task += parts[table.TASK_VELOCITY, i] * X[i, place]
            null -= along[i] * X[i, place]
        parts[table.TASK_PART, column], parts[table.NULL_PART, column], parts[table.VELOCITY, column] = (
            task,
            null,
            task + null,
        )
    return size


@compiled_inside
def pose_velocity(constants, first, s, place, work, at, b):
    """Write b = gain Lambda e, norm at most max_speed, and return |Lambda e|.

    The s rows of Lambda's table begin at row `first`. As many rows of scratch behind row `at`, which holds the end of
    the chain (`columns_of`), take Lambda M, with d/dt e = -M (v, w), for the rows E = Lambda M J of the error; the next
    one is scratch.
    """
    own_axes = constants[table.CHAIN + 1, LOCAL] != 0.0
    e0, e1, e2 = place_error(constants, own_axes, place, work[at])
    r0, r1, r2 = turn_error(constants, own_axes, work[at], work[at + 1 + s])
    sign = 1.0 if own_axes else -1.0
    for i in range(s):
        x, y, z, u, v, w = six(constants, first + i, 0)
        b[i] = x * e0 + y * e1 + z * e2 + u * r0 + v * r1 + w * r2
        u, v, w = turned_row(u, v, w, sign * r0, sign * r1, sign * r2)
        if own_axes:  # the frame turns under the displacement: less Lambda_lin [e_lin]x
            u, v, w = u + e1 * z - e2 * y, v + e2 * x - e0 * z, w + e0 * y - e1 * x
        row = work[at + 1 + i]
        row[0], row[1], row[2], row[3], row[4], row[5] = x, y, z, u, v, w
    return attracted(constants, s, b)


@compiled_inside
def attracted(constants, s, b):
    """Scale a displacement to the task's velocity, norm at most max_speed; return its own norm."""
    error = norm(b[:s])
    gain, fastest = constants[0, table.GAIN], constants[0, table.MAX_SPEED]
    if gain * error > fastest:
        gain *= fastest / (gain * error)
    for i in range(s):
        b[i] *= gain
    return error


@compiled_inside
def place_error(constants, own_axes, p, end):
    """p* - p, along the axes of the base or of the frame, from which the chain is walked then."""
    k = table.CHAIN + 1
    t0, t1, t2 = (
        constants[k, table.TARGET_POINT],
        constants[k, table.TARGET_POINT + 1],
        constants[k, table.TARGET_POINT + 2],
    )
    if not own_axes:
        return t0 - p[0], t1 - p[1], t2 - p[2]
    return (
        end[END_ORIGIN] + end[0] * t0 + end[1] * t1 + end[2] * t2,
        end[END_ORIGIN + 1] + end[3] * t0 + end[4] * t1 + end[5] * t2,
        end[END_ORIGIN + 2] + end[6] * t0 + end[7] * t1 + end[8] * t2,
    )


@compiled_inside
def turn_error(constants, own_axes, end, product):
    """log(R* R^T) = log(G X^T), or log(R^T R*) = log(X G), from the rotation X at the end of the chain."""
    goal = constants[1]
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                if own_axes:
                    total += end[3 * i + k] * goal[table.GOAL + 3 * k + j]
                else:
                    total += goal[table.GOAL + 3 * i + k] * end[3 * j + k]
            product[3 * i + j] = total
    return rotation_vector(product)


@compiled_inside
def rotation_vector(R):
    """`rotations.rotation_vector` of a matrix whose rows follow each other."""
    a, b, c, d, e, f, g, h, i = R[0], R[1], R[2], R[3], R[4], R[5], R[6], R[7], R[8]
    # the quaternion by its largest part, so that nothing is divided by something small
    trace, p, q, r = a + e + i, a - e - i, e - a - i, i - a - e
    if trace >= p and trace >= q and trace >= r:
        w, x, y, z = 1.0 + trace, h - f, c - g, d - b
    elif p >= q and p >= r:
        w, x, y, z = h - f, 1.0 + p, b + d, c + g
    elif q >= r:
        w, x, y, z = c - g, b + d, 1.0 + q, f + h
    else:
        w, x, y, z = d - b, c + g, f + h, 1.0 + r
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 0.0, 0.0, 0.0
    scale = 2.0 * math.atan2(length, abs(w)) / length
    if w < 0.0:
        scale = -scale
    return scale * x, scale * y, scale * z


@compiled_inside
def turned_row(a, b, c, x, y, z):
    """The row (a, b, c) times the inverse of the left Jacobian of (x, y, z), `rotations.left_jacobian_inverse`."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < SMALL_ANGLE:
        second = 1.0 / 12.0 + square / 720.0 * (1.0 + square / 42.0 * (1.0 + square / 40.0))
    else:
        half = 0.5 * angle
        second = (1.0 - half * math.cos(half) / math.sin(half)) / square
    rest, along = 1.0 - second * square, second * (a * x + b * y + c * z)
    return (
        rest * a + along * x - 0.5 * (b * z - c * y),
        rest * b + along * y - 0.5 * (c * x - a * z),
        rest * c + along * z - 0.5 * (a * y - b * x),
    )


@compiled
def command_of(constants, q, dt, previous, slide, parts):
    """One command: its parts go into `parts`, and back come its status, or REFUSED, and its numbers.

    Arguments as for `Step`, whose work space is made here; a b that is GIVEN is among the parts before.
    """
    joints, nv, s = sizes_of(constants)
    work = scratch(joints, nv, s)
    status, facts = control_step(constants, q, dt, previous, slide, parts, work), work[table.FACTS]
    scale, null_scale, progress = facts[table.TASK_SCALE], facts[table.NULL_SCALE], facts[table.PROGRESS]
    joint = int(facts[table.LIMITING_JOINT]) if status > table.REFUSED else -1
    escapes, outside = facts[table.HAS_ESCAPE] != 0.0, facts[table.OUTSIDE]
    return status, facts[table.MU], facts[table.SMALLEST], scale, null_scale, progress, outside, joint, escapes


@compiled_inside
def control_step(constants, q, dt, previous, slide, parts, work):
    """Write one command, u = A^+ b + N pi within the limits; return its status, or REFUSED.

    Arguments as for `Step`, which takes longer to make than most steps should wait.
    """
    state = free_step(constants, q, dt, previous, parts, work)
    if state >= table.REFUSED and (state == table.REFUSED or not has_tips(constants)):
        return state
    tips = tips_at(constants, q, dt, previous)
    if state > table.REFUSED and not breaks(constants, tips, parts[table.VELOCITY])[0]:
        return state
    _, nv, s = sizes_of(constants)
    # few arrays: making one takes as long as a product of a matrix and a vector
    right, left, space = np.empty((2 * s + nv, nv)), np.empty((s + 1, s)), space_of(nv, most_rows(constants))
    step = table.Step(constants, q, dt, previous, slide, parts, work)
    rows = table.Rows(right[:s], left[:s], left[s], right[2 * s :], right[s : 2 * s])
    space[table.SLOPE, 0] = math.nan  # unknown
    public_rows(constants, work, rows.A)
    rows.sigma[0] = -1.0  # unknown
    posed = constants[0, table.TASK] == table.POSE
    if state == table.ILL_CONDITIONED or state == table.ILL_POSED:
        if posed and state == table.ILL_CONDITIONED and not posed_policy(constants, q, dt, rows, work):
            return table.REFUSED
        if not singular_parts(step, rows, space[table.SLOPE, :nv]):
            return table.REFUSED
    else:
        row_space(rows.A, rows.Vt, rows.Ut)
    barred = not posed and constants[0, table.LIMITS] != 0.0
    barred = barred and may_approach(
        constants, rows.A, rows.sigma, work[table.FACTS, table.SMALLEST], dt, parts[table.VELOCITY]
    )
    barred = barred and barrier(constants, rows, dt, space, work)
    return within_limits(step, rows, barred, tips, space)


@compiled
def rollout(constants, first, dt, rk4, motion, numbers, state):
    """From sample `first` on; returns the sample that Python must do, or T.

    Args:
        constants: The table, see `step_table`.
        first: Its posture is known.
        dt: [s].
        rk4: Whether the method is that of Runge and Kutta, otherwise Euler's.
        motion: Joint positions and velocities, shape (2, T, nv).
        numbers: mu, the error and the code of the status of each sample, shape (3, T).
        state: The velocity before, NaN for every step where no acceleration is bounded, and `slide`.
    """
    q, u = motion[0], motion[1]
    steps, nv = q.shape
    joints, _, s = sizes_of(constants)
    parts, work = np.empty((table.PARTS, nv)), scratch(joints, nv, s)
    point, slope = np.empty(nv), np.empty(nv)
    bounded = not math.isnan(state[0])
    for i in range(first, steps):
        for j in range(nv):
            point[j], slope[j] = q[i, j], 0.0
        for stage in range(4 if rk4 and i + 1 < steps else 1):
            if stage > 0:
                length = dt if stage == 3 else 0.5 * dt
                for j in range(nv):
                    point[j] = q[i, j] + length * parts[table.VELOCITY, j]
            done = control_step(constants, point, dt, state, state[nv], parts, work)
            if done == table.REFUSED:
                return i
            if stage == 0:
                numbers[0, i], numbers[1, i], numbers[2, i] = (
                    work[table.FACTS, table.MU],
                    work[table.FACTS, table.ERROR],
                    done,
                )
                for j in range(nv):
                    u[i, j] = parts[table.VELOCITY, j]
                    if bounded:
                        state[j] = u[i, j]
                if bounded:
                    state[nv] = next_slide(state[nv], done == table.STALLED, work[table.FACTS, table.PROGRESS], dt)
            weight = 2.0 if stage == 1 or stage == 2 else 1.0
            for j in range(nv):
                slope[j] += weight * parts[table.VELOCITY, j]
        if i + 1 < steps:
            factor = dt / 6.0 if rk4 else dt
            for j in range(nv):
                q[i + 1, j] = q[i, j] + factor * slope[j]
    return steps
