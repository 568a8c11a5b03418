"""The law by the singular value decomposition, as loops over plain numbers."""

from __future__ import annotations

import numpy as np

from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control.compiled.constrained_rows import public_rows, vjp
from manip_learn.control.compiled.decomposition import complete, decompose
from manip_learn.control.compiled.free_step import chain_rows
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
    CHAIN,
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
    MATRICES,
    MU,
    N_JOINTS,
    NULL_PART,
    PI,
    POLICY,
    POSE,
    SMALLEST,
    TASK,
    TASK_PART,
    TASK_VELOCITY,
    VELOCITY,
)
from manip_learn.control.singularity import NOTHING, SEED_SPEED
from manip_learn.robot.batch.compiled_kinematics import JOINTS
from manip_learn.robot.batch.kernel_cache import compiled_inside


@compiled_inside
def singular_parts(constants, q, dt, A, Ut, sigma, Vt, weights, slope, parts, work):
    """Write the law near a singularity, `ResolvedRateLaw._near_singularity`; return the rank, -1 if refused.

    The gradient of the smallest singular value goes into `slope` where it is needed; `weights` is scratch.
    """
    s, nv = A.shape
    joints, posed = int(constants[0, N_JOINTS]), constants[0, TASK] == POSE
    base = MATRICES + 3 * s
    along, climb, row, facts, pi = np.empty(s), np.empty(nv), np.empty(nv), work[FACTS], work[PI, :nv]
    decompose(A, s, Ut, sigma, Vt)
    singular = sigma[s - 1] <= SINGULAR_RATIO * sigma[0]
    rank = rank_of(sigma, truncation(sigma, nv))
    if singular:
        if int(constants[0, INVERSE]) == EXACT:
            return -1
        complete(Vt, rank_of(sigma, 0.0))
    facts[SMALLEST] = sigma[s - 1]
    for i in range(s):
        along[i] = 0.0
        for k in range(s):
            along[i] += Ut[i, k] * parts[TASK_VELOCITY, k]
    if not posed:  # mu and the policy are those of A, and known
        facts[MU] = _volume(sigma)
        if not _policy(constants, q, dt, Ut, sigma, Vt, weights, work, climb, pi):
            return -1
    task_part(constants, sigma, along, constants[1, DAMPING], Vt, parts[TASK_PART])
    pressed = 0.0
    if int(constants[0, INVERSE]) == DAMPED and constants[0, LIMITS] != 0.0 and not singular:
        pressed = stable_damping(constants, s, joints, Ut, sigma, along, dt, weights, row, work, base)
    if pressed <= constants[1, DAMPING]:
        pressed = 0.0
    escapes = not posed and constants[1, ESCAPES] != 0.0
    near = not singular and escapes and sigma[s - 1] < constants[1, ESCAPE_WIDTH]
    if pressed > 0.0 or near:
        outer_product(Ut[s - 1], Vt[s - 1], weights)
        vjp(constants, s, joints, weights, work, base, slope)
    if pressed > 0.0:
        damping = pressed_damping(constants[1, DAMPING], pressed, slope, norm(slope), parts[TASK_PART])
        task_part(constants, sigma, along, damping, Vt, parts[TASK_PART])
    _null_part(Vt, rank, pi, parts[NULL_PART])
    if escapes:  # `singularity.with_seed`
        speed, seed = norm(parts[NULL_PART]), seed_speed(sigma[s - 1], constants[1, ESCAPE_WIDTH])
        if NOTHING * norm(pi) < speed < seed:
            for j in range(nv):
                parts[NULL_PART, j] *= seed / speed
    for j in range(nv):
        parts[VELOCITY, j] = parts[TASK_PART, j] + parts[NULL_PART, j]
    if escapes:
        facts[HAS_ESCAPE] = 1.0
        _leave(constants, q, dt, singular, sigma, Vt, climb, norm(slope), pi, parts)
    return rank


@compiled_inside
def _leave(constants, q, dt, singular, sigma, Vt, climb, steepness, pi, parts):
    """Write the velocity out of a singularity, and add it; N pi turns with it where a joint limit is in the way."""
    nv, escape, width = Vt.shape[1], parts[ESCAPE_PART], constants[1, ESCAPE_WIDTH]
    if not singular:
        escape_velocity(sigma, Vt, dt, width, climb, steepness, escape)
    else:  # the policy has taken the steepest ascent already
        seed, along = seed_speed(sigma[sigma.shape[0] - 1], width) / min(constants[0, LONGEST], SEED_SPEED), 0.0
        for j in range(nv):
            escape[j] = seed * pi[j]
        if constants[0, LIMITS] != 0.0:
            # mu rises in both directions out of a singularity: a limit in one of them is no reason to stay
            turn_to_freer_sense(constants, CHAIN + JOINTS + int(constants[0, N_JOINTS]), nv, q, escape)
        for j in range(nv):
            along += escape[j] * pi[j]
        for j in range(nv if along < 0.0 else 0):
            parts[NULL_PART, j] = -parts[NULL_PART, j]
    for j in range(nv):
        parts[VELOCITY, j] = parts[TASK_PART, j] + parts[NULL_PART, j] + escape[j]


@compiled_inside
def posed_policy(constants, q, dt, A, Ut, sigma, Vt, weights, work):
    """The policy of an ill-conditioned A beside a pose's error, `ResolvedRateLaw._of_error_rows`, then the error's rows
    in the place of A; False: Python's.
    """
    s, nv = A.shape
    joints, base, climb = int(constants[0, N_JOINTS]), MATRICES + 3 * s, np.empty(nv)
    decompose(A, s, Ut, sigma, Vt)
    if sigma[s - 1] <= SINGULAR_RATIO * sigma[0]:
        complete(Vt, rank_of(sigma, 0.0))
    work[FACTS, MU] = _volume(sigma)
    if not _policy(constants, q, dt, Ut, sigma, Vt, weights, work, climb, work[PI, :nv]):
        return False
    chain_rows(work, base + joints + 1, s, joints, work, base)
    public_rows(constants, s, joints, work, MATRICES, A)
    return True


@compiled_inside
def _policy(constants, q, dt, Ut, sigma, Vt, weights, work, climb, pi):
    """The null-space policy's velocity into `pi`, and grad log mu of an ascent into `climb`; False: Python's."""
    s, nv, joints = sigma.shape[0], Vt.shape[1], int(constants[0, N_JOINTS])
    dofs, base, policy = CHAIN + JOINTS + joints, MATRICES + 3 * s, int(constants[0, POLICY])
    if policy == ASCENT or policy == LOG_ASCENT:
        return ascent_near_singularity(constants, s, joints, Ut, sigma, Vt, dt, weights, work, base, climb, pi)
    rest_velocity(constants, dofs, nv, q, pi)
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
