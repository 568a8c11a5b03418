"""The law by the singular value decomposition, as loops over plain numbers."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control.compiled.constrained_rows import chain_rows, joints_at, public_rows, vjp
from manip_learn.control.compiled.decomposition import complete, decompose
from manip_learn.control.compiled.joint_limits import turn_to_freer_sense
from manip_learn.control.compiled.near_singularity import (
    escape_velocity,
    norm,
    outer_product,
    pressed_damping,
    rank_of,
    seed_speed,
    stable_damping,
    task_part,
    truncation,
)
from manip_learn.control.compiled.null_policy import ascent_near_singularity, rest_velocity
from manip_learn.control.compiled.step_table import (
    ASCENT,
    DAMPED,
    DAMPING,
    ESCAPE_PART,
    ESCAPE_WIDTH,
    ESCAPES,
    EXACT,
    FACTS,
    HAS_ESCAPE,
    INVERSE,
    LIMITS,
    LOG_ASCENT,
    LONGEST,
    MU,
    N_JOINTS,
    NULL_PART,
    PI,
    POLICY,
    POSE,
    RANK,
    SMALLEST,
    TASK,
    TASK_PART,
    TASK_VELOCITY,
    VELOCITY,
)
from manip_learn.control.singularity import NOTHING, SEED_SPEED
from manip_learn.robot.batch.kernel_cache import compiled_inside


@compiled_inside
def singular_parts(step, rows, slope):
    """Write the law near a singularity, `ResolvedRateLaw._near_singularity`, and the rank; False: Python's.

    The gradient of the smallest singular value goes into `slope` where it is needed.
    """
    constants, parts, facts, sigma, Vt = step.constants, step.parts, step.work[FACTS], rows.sigma, rows.Vt
    (s, nv), Ut, weights = rows.A.shape, rows.Ut, rows.weights
    posed, along, climb, row = constants[0, TASK] == POSE, np.empty(s), np.empty(nv), np.empty(nv)
    pi = step.work[PI, :nv]
    decompose(rows.A, s, Ut, sigma, Vt)
    singular = sigma[s - 1] <= SINGULAR_RATIO * sigma[0]
    facts[RANK] = rank_of(sigma, truncation(sigma, nv))
    if singular:
        if int(constants[0, INVERSE]) == EXACT:
            return False
        complete(Vt, rank_of(sigma, 0.0))
    facts[SMALLEST] = sigma[s - 1]
    for i in range(s):
        along[i] = 0.0
        for k in range(s):
            along[i] += Ut[i, k] * parts[TASK_VELOCITY, k]
    if not posed:  # mu and the policy are those of A, and known
        facts[MU] = _volume(sigma)
        if not _policy(constants, step.q, step.dt, rows, step.work, climb):
            return False
    task_part(constants, sigma, along, constants[1, DAMPING], Vt, parts[TASK_PART])
    pressed = 0.0
    if int(constants[0, INVERSE]) == DAMPED and constants[0, LIMITS] != 0.0 and not singular:
        pressed = stable_damping(constants, rows, along, step.dt, row, step.work)
    if pressed <= constants[1, DAMPING]:
        pressed = 0.0
    escapes = not posed and constants[1, ESCAPES] != 0.0
    near = not singular and escapes and sigma[s - 1] < constants[1, ESCAPE_WIDTH]
    if pressed > 0.0 or near:
        outer_product(Ut[s - 1], Vt[s - 1], weights)
        vjp(constants, weights, step.work, slope)
    if pressed > 0.0:
        damping = pressed_damping(constants[1, DAMPING], pressed, slope, norm(slope), parts[TASK_PART])
        task_part(constants, sigma, along, damping, Vt, parts[TASK_PART])
    _null_part(Vt, int(facts[RANK]), pi, parts[NULL_PART])
    if escapes:  # `singularity.with_seed`
        speed, seed = norm(parts[NULL_PART]), seed_speed(sigma[s - 1], constants[1, ESCAPE_WIDTH])
        if NOTHING * norm(pi) < speed < seed:
            for j in range(nv):
                parts[NULL_PART, j] *= seed / speed
    for j in range(nv):
        parts[VELOCITY, j] = parts[TASK_PART, j] + parts[NULL_PART, j]
    if escapes:
        facts[HAS_ESCAPE] = 1.0
        if singular:  # the policy has taken the steepest ascent already
            _leave(constants, step.q, sigma, pi, parts)
        else:
            width = constants[1, ESCAPE_WIDTH]
            escape_velocity(sigma, Vt, step.dt, width, climb, norm(slope), parts[ESCAPE_PART])
        for j in range(nv):
            parts[VELOCITY, j] = parts[TASK_PART, j] + parts[NULL_PART, j] + parts[ESCAPE_PART, j]
    return _finite(parts)


@compiled_inside
def _leave(constants, q, sigma, pi, parts):
    """Write the velocity out of a singularity, along pi; N pi turns with it where a joint limit is in the way."""
    nv, escape, along = q.shape[0], parts[ESCAPE_PART], 0.0
    seed = seed_speed(sigma[sigma.shape[0] - 1], constants[1, ESCAPE_WIDTH]) / min(constants[0, LONGEST], SEED_SPEED)
    for j in range(nv):
        escape[j] = seed * pi[j]
    if constants[0, LIMITS] != 0.0:
        # mu rises in both directions out of a singularity: a limit in one of them is no reason to stay
        turn_to_freer_sense(constants, q, escape)
    for j in range(nv):
        along += escape[j] * pi[j]
    for j in range(nv if along < 0.0 else 0):
        parts[NULL_PART, j] = -parts[NULL_PART, j]


@compiled_inside
def posed_policy(constants, q, dt, rows, work):
    """The policy of an ill-conditioned A beside a pose's error, `ResolvedRateLaw._of_error_rows`, then the error's rows
    in the place of A; False: Python's.
    """
    s, nv = rows.A.shape
    joints, sigma = int(constants[0, N_JOINTS]), rows.sigma
    decompose(rows.A, s, rows.Ut, sigma, rows.Vt)
    if sigma[s - 1] <= SINGULAR_RATIO * sigma[0]:
        complete(rows.Vt, rank_of(sigma, 0.0))
    work[FACTS, MU] = _volume(sigma)
    if not _policy(constants, q, dt, rows, work, np.empty(nv)):
        return False
    chain_rows(work, joints_at(s) + joints + 1, s, joints, work)
    public_rows(constants, work, rows.A)
    return True


@compiled_inside
def _policy(constants, q, dt, rows, work, climb):
    """The null-space policy's velocity, and grad log mu of an ascent into `climb`; False: Python's."""
    policy = int(constants[0, POLICY])
    if policy == ASCENT or policy == LOG_ASCENT:
        return ascent_near_singularity(constants, rows, dt, work, climb)
    rest_velocity(constants, q, work[PI])
    return True


@compiled_inside
def _volume(sigma):
    """Product of the singular values."""
    volume = 1.0
    for i in range(sigma.shape[0]):
        volume *= sigma[i]
    return volume


@compiled_inside
def _null_part(Vt, rank, pi, null):
    """N pi, pi less its parts along the rows of A."""
    nv = Vt.shape[1]
    for j in range(nv):
        null[j] = pi[j]
    for i in range(rank):
        along = 0.0
        for j in range(nv):
            along += Vt[i, j] * null[j]
        for j in range(nv):
            null[j] -= along * Vt[i, j]


@compiled_inside
def _finite(parts):
    total = 0.0
    for j in range(parts.shape[1]):
        total += parts[VELOCITY, j]
    return math.isfinite(total)
