"""The control step where A is well-conditioned and no limit changes the law, as in most steps."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.compiled_rows import mix_rows
from manip_learn.control.compiled.constrained_rows import (
    chain_rows,
    chain_vjp,
    dofs_of,
    form_of,
    joints_at,
    mix_at,
    places,
    turn_joints,
)
from manip_learn.control.compiled.joint_limits import admitted
from manip_learn.control.compiled.near_singularity import smallest_weights
from manip_learn.control.compiled.null_policy import policy_velocity
from manip_learn.control.compiled.pose_target import attracted, pose_velocity
from manip_learn.control.compiled.row_inverse import row_inverse
from manip_learn.control.compiled.step_table import (
    ACCELERATION,
    CHAIN,
    DAMPED,
    ERROR,
    FACTS,
    GIVEN,
    HAS_ESCAPE,
    ILL_CONDITIONED,
    ILL_POSED,
    INVERSE,
    LEAST_WIDTH,
    LIMITED,
    LIMITING_JOINT,
    LIMITS,
    MATRICES,
    MU,
    N_CONSTRAINTS,
    N_JOINTS,
    NULL_PART,
    NULL_SCALE,
    NV,
    OK,
    OUTSIDE,
    PI,
    POINT,
    POSE,
    PROGRESS,
    RANK,
    REFUSED,
    SMALLEST,
    TARGET_POINT,
    TASK,
    TASK_PART,
    TASK_SCALE,
    TASK_VELOCITY,
    THRESHOLD,
    VELOCITY,
)
from manip_learn.control.singularity import APPROACH_RATE, BRAKING_SHARE
from manip_learn.robot.batch.compiled_kinematics import columns_of
from manip_learn.robot.batch.compiled_vjp import GRADIENT, SLIDE
from manip_learn.robot.batch.kernel_cache import compiled_inside


@compiled_inside
def free_step(constants, q, dt, previous, parts, work):
    """Write the law into the parts; return OK, REFUSED, or LIMITED, ILL_CONDITIONED or ILL_POSED: more to be done."""
    facts = work[FACTS]
    joints, nv, s = int(constants[0, N_JOINTS]), int(constants[0, NV]), int(constants[0, N_CONSTRAINTS])
    for j in range(nv):
        if not math.isfinite(q[j]):
            return REFUSED
    dofs, base, posed = dofs_of(constants), joints_at(s), constants[0, TASK] == POSE
    turn_joints(constants, CHAIN, joints, q, work, base)
    place = columns_of(constants, CHAIN, joints, work, base, SLIDE, 1, work, base)
    mix = mix_at(s, joints)
    mix_rows(constants, dofs + nv, s, form_of(constants), place[0], place[1], place[2], work, mix)
    chain_rows(work, mix, s, joints, work)
    if posed:
        facts[ERROR] = pose_velocity(constants, dofs + nv, s, place, work, base + joints, parts[TASK_VELOCITY])
    else:
        facts[ERROR] = task_velocity(constants, dofs + nv, s, place, parts[TASK_VELOCITY])
    # parts of rows: LLVM would vectorise loops over whole ones, which are too short for that
    A, X = work[MATRICES : MATRICES + s, :joints], work[MATRICES + s : MATRICES + 2 * s, :joints]
    squares = work[MATRICES + 2 * s : MATRICES + 3 * s]
    G, L = squares[:, :s], squares[:, s : 2 * s]
    volume, smallest = row_inverse(A, X, G, L)
    facts[MU], facts[SMALLEST], facts[HAS_ESCAPE] = volume, smallest, 0.0
    facts[TASK_SCALE] = facts[NULL_SCALE] = facts[PROGRESS] = 1.0
    facts[OUTSIDE], facts[LIMITING_JOINT], facts[RANK] = 0.0, -1.0, s
    damps = int(constants[0, INVERSE]) == DAMPED
    if volume == 0.0 or (damps and not posed and smallest < constants[0, THRESHOLD]):
        return ILL_CONDITIONED
    policy_velocity(constants, q, dt, volume, X, work)
    if posed:  # the policy is that of A; those of the error take its place
        chain_rows(work, base + joints + 1, s, joints, work)
        volume, facts[SMALLEST] = row_inverse(A, X, G, L)
        if volume == 0.0 or (damps and facts[SMALLEST] < constants[0, THRESHOLD]):
            return ILL_POSED
    size = regular_parts(constants, A, X, L, work[PI], parts)
    square, weakest = 0.0, math.inf
    for j in range(nv):
        square += parts[VELOCITY, j] * parts[VELOCITY, j]
        weakest = min(weakest, constants[dofs + j, ACCELERATION])
    if not math.isfinite(square + size):
        return REFUSED
    if constants[0, LIMITS] == 0.0:
        return OK
    if damps and not posed:
        # |grad sigma| is about as large as A itself: slow enough to stop at a singularity
        rate = min(APPROACH_RATE, 0.5 / dt) * smallest
        if square * size >= min(2.0 * BRAKING_SHARE * weakest * math.sqrt(size) * smallest, rate * rate):
            if s > 2 or _approaches(constants, A, X, weakest, rate, parts, work):
                return LIMITED
    return OK if admitted(constants, q, dt, parts[VELOCITY], previous) else LIMITED


@compiled_inside
def scratch(joints, nv, s):
    """The work space of a step: numbers, A, its inverse, two squares, the joints, the chain's end, a pose's error, and
    the weights of (v, w).
    """
    return np.empty((mix_at(s, joints) + s + 1, max(LEAST_WIDTH, nv, 2 * s)))


@compiled_inside
def task_velocity(constants, first, s, p, b):
    """Write the task velocity b = gain Lambda (r* - r(q)), norm at most max_speed; return the error, 0 of a given b."""
    if constants[0, TASK] == GIVEN:
        return 0.0
    if constants[0, TASK] != POINT:
        for i in range(s):
            b[i] = 0.0
        return 0.0
    at = CHAIN + 1
    d0, d1 = constants[at, TARGET_POINT] - p[0], constants[at, TARGET_POINT + 1] - p[1]
    d2 = constants[at, TARGET_POINT + 2] - p[2]
    for i in range(s):
        b[i] = constants[first + i, 0] * d0 + constants[first + i, 1] * d1 + constants[first + i, 2] * d2
    return attracted(constants, s, b)


@compiled_inside
def _approaches(constants, A, X, weakest, rate, parts, work):
    """Whether a singularity is approached faster than the weakest joint could brake before it, for one or two rows.

    `singularity.approach_bound` allows no less. X is scratch.
    """
    (s, joints), smallest = A.shape, work[FACTS, SMALLEST]
    smallest_weights(A, smallest, X)
    chain_vjp(constants, X, work)
    base, approach, square = joints_at(s), 0.0, 0.0
    for j in range(joints):
        column, place = places(constants, j)
        slope = work[base + place, GRADIENT]
        square += slope * slope
        approach -= slope * parts[VELOCITY, column]
    deceleration = BRAKING_SHARE * math.sqrt(square) * weakest
    return approach > min(rate, math.sqrt(2.0 * deceleration * smallest))


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
        parts[TASK_PART, j], parts[NULL_PART, j], parts[VELOCITY, j] = 0.0, pi[j], pi[j]
    for j in range(joints):
        column, place = places(constants, j)
        task, null = 0.0, pi[column]
        for i in range(s):
            task += parts[TASK_VELOCITY, i] * X[i, place]
            null -= along[i] * X[i, place]
        parts[TASK_PART, column], parts[NULL_PART, column], parts[VELOCITY, column] = task, null, task + null
    return size
