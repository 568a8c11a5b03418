"""One control step as loops over plain numbers: the law of `controller`, in every state.

numba compiles these functions (the optional extra `fast`); without it they are plain Python, the same function objects.
Handed back to Python is what is not finite, a lost direction where the inverse is "exact", and one where a policy has
no bound. Calls are nested as little as possible: numba optimises a function again in each of its callers.
"""

from __future__ import annotations

import math

import numpy as np

from manip_learn.control.compiled.barrier import barrier
from manip_learn.control.compiled.bounded_step import space_of
from manip_learn.control.compiled.constrained_rows import public_rows
from manip_learn.control.compiled.decomposition import row_space
from manip_learn.control.compiled.free_step import free_step, scratch
from manip_learn.control.compiled.singular_parts import posed_policy, singular_parts
from manip_learn.control.compiled.step_table import (
    FACTS,
    HAS_ESCAPE,
    ILL_CONDITIONED,
    ILL_POSED,
    LIMITING_JOINT,
    LIMITS,
    MATRICES,
    MU,
    N_CONSTRAINTS,
    N_JOINTS,
    NULL_SCALE,
    NV,
    OUTSIDE,
    POSE,
    PROGRESS,
    RANK,
    REFUSED,
    SLOPE,
    SMALLEST,
    TASK,
    TASK_SCALE,
    VELOCITY,
    Rows,
    Step,
)
from manip_learn.control.compiled.tip_rows import breaks, has_tips, most_rows, tips_at
from manip_learn.control.compiled.within_limits import within_limits
from manip_learn.robot.batch.kernel_cache import compiled, compiled_inside


@compiled
def command_of(constants, q, dt, previous, slide, parts):
    """One command: its parts go into `parts`, and back come its status, or REFUSED, and its numbers.

    Arguments as for `control_step`; one array fewer to hand over.
    """
    joints, nv, s = int(constants[0, N_JOINTS]), int(constants[0, NV]), int(constants[0, N_CONSTRAINTS])
    work = scratch(joints, nv, s)
    status, facts = control_step(constants, q, dt, previous, slide, parts, work), work[FACTS]
    scale, null_scale, progress = facts[TASK_SCALE], facts[NULL_SCALE], facts[PROGRESS]
    joint = int(facts[LIMITING_JOINT]) if status > REFUSED else -1
    escapes, outside = facts[HAS_ESCAPE] != 0.0, facts[OUTSIDE]
    return status, facts[MU], facts[SMALLEST], scale, null_scale, progress, outside, joint, escapes


@compiled_inside
def control_step(constants, q, dt, previous, slide, parts, work):
    """Write one command, u = A^+ b + N pi within the limits; return its status, or REFUSED.

    Args:
        constants: The table, see `step_table`.
        q: Joint positions [rad or m].
        dt: Time for which the command is held [s].
        previous: Velocity in the step before [rad/s or m/s], NaN where no acceleration is bounded.
        slide: See `ResolvedRateController`.
        parts: The velocity, its parts and b, in the rows of `step_table`; a b that is GIVEN is there before.
        work: Its row FACTS holds the command's numbers afterwards.
    """
    state = free_step(constants, q, dt, previous, parts, work)
    if state >= REFUSED and (state == REFUSED or not has_tips(constants)):
        return state
    tips = tips_at(constants, q, dt, previous)
    if state > REFUSED and not breaks(constants, tips, parts[VELOCITY])[0]:
        return state
    joints, nv, s = int(constants[0, N_JOINTS]), int(constants[0, NV]), int(constants[0, N_CONSTRAINTS])
    # few arrays: making one takes as long as a product of a matrix and a vector
    rows, left, space = np.empty((2 * s + nv, nv)), np.empty((s + 1, s)), space_of(nv, most_rows(constants))
    A, weights, Vt, Ut, sigma = rows[:s], rows[s : 2 * s], rows[2 * s :], left[:s], left[s]
    space[SLOPE, 0] = math.nan  # unknown
    public_rows(constants, s, joints, work, MATRICES, A)
    rank, sigma[0] = s, -1.0  # unknown
    step, driven = Step(constants, q, dt, previous, slide, parts, work), Rows(A, Ut, sigma, Vt, weights)
    posed = constants[0, TASK] == POSE
    if state == ILL_CONDITIONED or state == ILL_POSED:
        if posed and state == ILL_CONDITIONED and not posed_policy(constants, q, dt, A, Ut, sigma, Vt, weights, work):
            return REFUSED
        rank = singular_parts(constants, q, dt, A, Ut, sigma, Vt, weights, space[SLOPE, :nv], parts, work)
        if rank < 0 or not _finite(parts):
            return REFUSED
    else:
        row_space(A, s, Vt)
    barred = not posed and constants[0, LIMITS] != 0.0
    barred = barred and barrier(constants, A, Ut, sigma, Vt, weights, dt, parts[VELOCITY], space, work)
    work[FACTS, RANK] = rank
    return within_limits(step, driven, barred, tips, space)


@compiled_inside
def _finite(parts):
    total = 0.0
    for j in range(parts.shape[1]):
        total += parts[VELOCITY, j]
    return math.isfinite(total)
