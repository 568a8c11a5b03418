"""One control step as loops over plain numbers: the law of `controller`, in every state.

numba compiles these functions (the optional extra `fast`); without it they are plain Python, the same function objects.
Handed back to Python is what is not finite, a lost direction where the inverse is "exact", and one where a policy has
no bound. Calls are nested as little as possible: numba optimises a function again in each of its callers.
"""

from __future__ import annotations

import math

import numpy as np

from manip_learn.control.compiled.barrier import barrier, may_approach
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
    MU,
    N_CONSTRAINTS,
    N_JOINTS,
    NULL_SCALE,
    NV,
    OUTSIDE,
    POSE,
    PROGRESS,
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

    Arguments as for `Step`, whose work space is made here; a b that is GIVEN is among the parts before.
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

    Arguments as for `Step`, which takes longer to make than most steps should wait.
    """
    state = free_step(constants, q, dt, previous, parts, work)
    if state >= REFUSED and (state == REFUSED or not has_tips(constants)):
        return state
    tips = tips_at(constants, q, dt, previous)
    if state > REFUSED and not breaks(constants, tips, parts[VELOCITY])[0]:
        return state
    nv, s = int(constants[0, NV]), int(constants[0, N_CONSTRAINTS])
    # few arrays: making one takes as long as a product of a matrix and a vector
    right, left, space = np.empty((2 * s + nv, nv)), np.empty((s + 1, s)), space_of(nv, most_rows(constants))
    step = Step(constants, q, dt, previous, slide, parts, work)
    rows = Rows(right[:s], left[:s], left[s], right[2 * s :], right[s : 2 * s])
    space[SLOPE, 0] = math.nan  # unknown
    public_rows(constants, work, rows.A)
    rows.sigma[0] = -1.0  # unknown
    posed = constants[0, TASK] == POSE
    if state == ILL_CONDITIONED or state == ILL_POSED:
        if posed and state == ILL_CONDITIONED and not posed_policy(constants, q, dt, rows, work):
            return REFUSED
        if not singular_parts(step, rows, space[SLOPE, :nv]):
            return REFUSED
    else:
        row_space(rows.A, s, rows.Vt)
    barred = not posed and constants[0, LIMITS] != 0.0
    barred = barred and may_approach(constants, rows.A, rows.sigma, work[FACTS, SMALLEST], dt, parts[VELOCITY])
    barred = barred and barrier(constants, rows, dt, space, work)
    return within_limits(step, rows, barred, tips, space)
