"""One control step as loops over plain numbers: the law of `controller`, in every state.

numba compiles these functions (the optional extra `fast`); without it they are plain Python, the same function objects.
Handed back to Python is what is not finite, a lost direction where the inverse is "exact", and one where a policy has
no bound. Calls are nested as little as possible: numba optimises a function again in each of its callers.
"""

from __future__ import annotations

import math

import numpy as np

from manip_learn.control.compiled.bounded_step import space_of
from manip_learn.control.compiled.constrained_rows import public_rows, row_space
from manip_learn.control.compiled.free_step import free_step, scratch
from manip_learn.control.compiled.limits import breaks, has_tips, most_rows, tips_at
from manip_learn.control.compiled.near_singularity import barrier, may_approach, posed_policy, singular_parts
from manip_learn.control.compiled.step_table import (
    ERROR,
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
    PARTS,
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
from manip_learn.control.compiled.within_limits import next_slide, within_limits
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
    joints, s = int(constants[0, N_JOINTS]), int(constants[0, N_CONSTRAINTS])
    parts, work = np.empty((PARTS, nv)), scratch(joints, nv, s)
    point, slope = np.empty(nv), np.empty(nv)
    bounded = not math.isnan(state[0])
    for i in range(first, steps):
        for j in range(nv):
            point[j], slope[j] = q[i, j], 0.0
        for stage in range(4 if rk4 and i + 1 < steps else 1):
            if stage > 0:
                length = dt if stage == 3 else 0.5 * dt
                for j in range(nv):
                    point[j] = q[i, j] + length * parts[VELOCITY, j]
            done = control_step(constants, point, dt, state, state[nv], parts, work)
            if done == REFUSED:
                return i
            if stage == 0:
                numbers[0, i], numbers[1, i], numbers[2, i] = work[FACTS, MU], work[FACTS, ERROR], done
                for j in range(nv):
                    u[i, j] = parts[VELOCITY, j]
                    if bounded:
                        state[j] = u[i, j]
                if bounded:
                    state[nv] = next_slide(state[nv], done, work[FACTS, PROGRESS], dt)
            weight = 2.0 if stage == 1 or stage == 2 else 1.0
            for j in range(nv):
                slope[j] += weight * parts[VELOCITY, j]
        if i + 1 < steps:
            factor = dt / 6.0 if rk4 else dt
            for j in range(nv):
                q[i + 1, j] = q[i, j] + factor * slope[j]
    return steps
