"""The law brought within the limits, as loops over plain numbers: `ResolvedRateController` behind its law."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.control.compiled.barrier import bounded_approach, is_singular
from manip_learn.control.compiled.bounded_step import (
    FOUND,
    HIGH,
    HIGH_CAUSE,
    LOW,
    LOW_CAUSE,
    SLOPE,
    bounded_step,
    space_of,
)
from manip_learn.control.compiled.decomposition import complete, decompose, row_space
from manip_learn.control.compiled.joint_limits import binding, bounds_of, within
from manip_learn.control.compiled.near_singularity import rank_of, truncation
from manip_learn.control.compiled.outcome import bounded_outcome, plain_outcome, split_parts
from manip_learn.control.compiled.step_table import (
    CHAIN,
    DAMPED,
    DAMPED_STATUS,
    DAMPING,
    ESCAPE_PART,
    HAS_ESCAPE,
    INVERSE,
    LIMIT,
    LIMITING_JOINT,
    LIMITS,
    N_FACTS,
    N_JOINTS,
    NULL_SCALE,
    OUTSIDE,
    POSITION_LIMITED,
    PROGRESS,
    SMALLEST,
    TASK_PART,
    TASK_SCALE,
    TASK_VELOCITY,
    THRESHOLD,
    VELOCITY,
    VELOCITY_LIMITED,
)
from manip_learn.control.compiled.tip_rows import breaks, most_rows, tips_at, with_broken
from manip_learn.control.tip_limits import MOST_ROWS
from manip_learn.robot.batch.compiled_kinematics import JOINTS
from manip_learn.robot.batch.kernel_cache import compiled, compiled_inside


@compiled
def bounded_law(constants, q, dt, previous, slide, parts, A, slope, smallest, ill_conditioned, escapes):
    """Bring a law that Python has computed within the limits; its parts are replaced by those commanded.

    Returns the status, the scales of the task and of the null-space part, progress, outside and the limiting joint.

    Args:
        constants: The table of a controller without a chain, see `step_table`.
        q: Joint positions [rad or m].
        dt: Time for which the command is held [s].
        previous: Velocity in the step before [rad/s or m/s], NaN where no acceleration is bounded.
        slide: See `ResolvedRateController`.
        parts: The velocity, its parts and b, in the rows of `step_table`.
        A: shape (s, nv), s <= nv.
        slope: Gradient of the smallest singular value where the approach to a singularity is bounded, otherwise NaN.
        smallest: Smallest singular value of A.
        ill_conditioned: Whether A is to be decomposed.
        escapes: Whether there is a velocity out of a singularity.
    """
    s, nv = A.shape
    Vt, left, facts = np.empty((nv, nv)), np.empty((s + 1, s)), np.empty(N_FACTS)
    Ut, sigma, space, rank = left[:s], left[s], space_of(nv, most_rows(constants)), s
    if ill_conditioned:
        decompose(A, s, Ut, sigma, Vt)
        rank = rank_of(sigma, truncation(sigma, nv))
        if is_singular(sigma):
            complete(Vt, rank_of(sigma, 0.0))
    else:
        sigma[0] = -1.0  # unknown
        row_space(A, s, Vt)
    facts[SMALLEST], facts[HAS_ESCAPE] = smallest, escapes
    barred = not math.isnan(slope[0])
    if barred:
        for j in range(nv):
            space[SLOPE, j] = slope[j]
        barred = bounded_approach(constants, smallest, dt, space)
    tips = tips_at(constants, q, dt, previous)
    code = within_limits(constants, q, dt, previous, slide, A, Ut, sigma, Vt, rank, barred, tips, space, parts, facts)
    numbers = facts[TASK_SCALE], facts[NULL_SCALE], facts[PROGRESS], facts[OUTSIDE]
    return code, numbers[0], numbers[1], numbers[2], numbers[3], int(facts[LIMITING_JOINT])


@compiled_inside
def within_limits(constants, q, dt, previous, slide, A, Ut, sigma, Vt, rank, barred, tips, space, parts, facts):
    """Bring the law within the limits; return the status of the command.

    Arguments as for `bounded_law`, and the decomposition of A: left singular vectors in the rows of Ut and sigma, whose
    first is negative where they are not known; in Vt orthonormal rows that span those of A, with its null space behind
    them where A is singular; its rank. Where the approach to a singularity is `barred`, gradient and bound are in the
    space (see `bounded_step`). `tips` are the limited frames (see `tips_at`). `facts` holds the numbers of the command.
    """
    s, nv = A.shape
    singular = is_singular(sigma)
    damped = int(constants[0, INVERSE]) == DAMPED and facts[SMALLEST] < constants[0, THRESHOLD]
    if constants[0, LIMITS] == 0.0:
        return plain_outcome(A, singular, damped, 0.0, parts, facts)
    dofs = CHAIN + JOINTS + int(constants[0, N_JOINTS])
    causes = space[LOW_CAUSE : HIGH_CAUSE + 1]
    outside = bounds_of(constants, dofs, nv, q, dt, previous, space[LOW], space[HIGH], causes[0], causes[1])
    broken, near = breaks(constants, tips, parts[VELOCITY])
    slow = not broken and not (barred and _too_fast(parts, space))
    if slow and within(parts[VELOCITY], space[LOW], space[HIGH], nv, 0.0):
        return plain_outcome(A, singular, damped, outside, parts, facts)
    if not singular:
        complete(Vt, s)
    if sigma[0] < 0.0 and slide > 0.0:
        decompose(A, s, Ut, sigma, Vt)
    # an explicit step of dt follows sliding that is damped that much
    blur = max(constants[1, DAMPING], math.sqrt(2.0 * dt * _length(parts[TASK_VELOCITY], s)))
    escape, escapes, rows = parts[ESCAPE_PART], facts[HAS_ESCAPE] != 0.0, 1 if barred else 0
    fastest, u, scale = constants[dofs : dofs + nv, LIMIT], parts[VELOCITY], -1.0
    for turn in range(MOST_ROWS if tips.shape[0] > 0 else 1):  # `TipLimits.bounded`
        more = with_broken(constants, tips, u, space, rows)
        if turn > 0 and more == rows:
            break
        rows, u = more, space[FOUND]
        scale, kept = bounded_step(A, parts, escape, escapes, fastest, sigma, Vt, rank, space, rows, slide, blur)
        if not kept:  # more rows would be kept even less
            break
    fits = within(parts[TASK_PART], space[LOW], space[HIGH], nv, 0.0)
    joint, cause = binding(space[FOUND], parts, space[LOW], space[HIGH], causes, nv)
    split_parts(space[FOUND], Vt, rank, scale >= 0.0, parts, facts)
    status = bounded_outcome(A, singular, damped, outside, joint, cause, max(scale, 0.0), fits, parts, facts)
    if not broken or damped or status != DAMPED_STATUS:
        return status
    return POSITION_LIMITED if near else VELOCITY_LIMITED


@compiled_inside
def _length(b, s):
    square = 0.0
    for i in range(s):
        square += b[i] * b[i]
    return math.sqrt(square)


@compiled_inside
def _too_fast(parts, space):
    """Whether the velocity approaches a singularity faster than the barrier allows."""
    rate, nv = 0.0, parts.shape[1]
    for j in range(nv):
        rate += space[SLOPE, j] * parts[VELOCITY, j]
    return rate < space[SLOPE, nv]
