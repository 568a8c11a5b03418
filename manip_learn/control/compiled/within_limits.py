"""The law brought within the limits, and what came of it (`outcome`), as loops over plain numbers."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.control.compiled.bounded_step import bounded_step, space_of
from manip_learn.control.compiled.constrained_rows import complete, decompose, norm, rank_of, row_space, truncation
from manip_learn.control.compiled.limits import binding, bounds_of, breaks, most_rows, tips_at, with_broken, within
from manip_learn.control.compiled.near_singularity import bounded_approach, is_singular
from manip_learn.control.compiled.step_table import (
    ACCELERATION_LIMITED,
    DAMPED,
    DAMPED_STATUS,
    DAMPING,
    ESCAPE_PART,
    FACTS,
    FOUND,
    HAS_ESCAPE,
    INVERSE,
    LIMITING_JOINT,
    LIMITS,
    NULL_PART,
    NULL_SCALE,
    NULL_SCALED,
    OK,
    OUTSIDE,
    OUTSIDE_LIMITS,
    PARTS,
    POSITION_LIMITED,
    PROGRESS,
    RANK,
    REROUTED,
    SINGULAR,
    SLOPE,
    SMALLEST,
    STALLED,
    TASK_PART,
    TASK_SCALE,
    TASK_VELOCITY,
    THRESHOLD,
    VELOCITY,
    VELOCITY_LIMITED,
    Rows,
    Step,
)
from manip_learn.control.limits import ACCELERATION as BY_ACCELERATION
from manip_learn.control.limits import POSITION as BY_POSITION
from manip_learn.control.resolved_rate_law import (
    AT_GOAL,
    GOING_ON,
    KEEPING_AFTER,
    SCALED_BELOW,
    SLIDING_AFTER,
    STALLED_BELOW,
)
from manip_learn.control.tip_limits import MOST_ROWS
from manip_learn.robot.batch.kernel_cache import compiled, compiled_inside


@compiled
def bounded_law(constants, q, dt, previous, slide, law, work):
    """Bring a law that Python has computed within the limits; its parts are replaced by those commanded.

    Returns the status; the numbers of the command are in the work space afterwards.

    Args:
        constants: The table of a controller without a chain, see `step_table`.
        q: Joint positions [rad or m].
        dt: Time for which the command is held [s].
        previous: Velocity in the step before [rad/s or m/s], NaN where no acceleration is bounded.
        slide: See `ResolvedRateController`.
        law: The velocity, its parts and b, in the rows of `step_table`; the gradient of the smallest singular value
            where the approach to a singularity is bounded, otherwise NaN; A (s, nv), s <= nv.
        work: One row, that of FACTS, with the smallest singular value of A, its rank, which is negative where A is to
            be decomposed, and whether there is a velocity out of a singularity.
    """
    parts, slope, A, facts = law[:PARTS], law[PARTS], law[PARTS + 1 :], work[FACTS]
    s, nv = A.shape
    square, left, space = np.empty((nv + s, nv)), np.empty((s + 1, s)), space_of(nv, most_rows(constants))
    Ut, sigma, Vt = left[:s], left[s], square[:nv]
    rows, step = Rows(A, Ut, sigma, Vt, square[nv:]), Step(constants, q, dt, previous, slide, parts, work)
    if facts[RANK] < 0.0:
        decompose(A, s, Ut, sigma, Vt)
        facts[RANK] = rank_of(sigma, truncation(sigma, nv))
        if is_singular(sigma):
            complete(Vt, rank_of(sigma, 0.0))
    else:
        sigma[0] = -1.0  # unknown
        row_space(A, s, Vt)
    barred = not math.isnan(slope[0])
    if barred:
        for j in range(nv):
            space[SLOPE, j] = slope[j]
        barred = bounded_approach(constants, facts[SMALLEST], dt, space)
    return within_limits(step, rows, barred, tips_at(constants, q, dt, previous), space)


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
    constants, parts, facts, A, sigma = step.constants, step.parts, step.work[FACTS], rows.A, rows.sigma
    s, nv = A.shape
    singular = is_singular(sigma)
    damped = int(constants[0, INVERSE]) == DAMPED and facts[SMALLEST] < constants[0, THRESHOLD]
    if constants[0, LIMITS] == 0.0:
        return plain_outcome(A, singular, damped, 0.0, parts, facts)
    outside = bounds_of(constants, step.q, step.dt, step.previous, space)
    broken, near = breaks(constants, tips, parts[VELOCITY])
    slow = not broken and not (barred and _too_fast(parts, space))
    if slow and within(parts[VELOCITY], space, nv, 0.0):
        return plain_outcome(A, singular, damped, outside, parts, facts)
    if not singular:
        complete(rows.Vt, s)
    if sigma[0] < 0.0 and step.slide > 0.0:
        decompose(A, s, rows.Ut, sigma, rows.Vt)
    # an explicit step of dt follows sliding that is damped that much
    blur = max(constants[1, DAMPING], math.sqrt(2.0 * step.dt * norm(parts[TASK_VELOCITY, :s])))
    barriers, u, scale = 1 if barred else 0, parts[VELOCITY], -1.0
    for turn in range(MOST_ROWS if tips.shape[0] > 0 else 1):  # `TipLimits.bounded`
        more = with_broken(constants, tips, u, space, barriers)
        if turn > 0 and more == barriers:
            break
        barriers, u = more, space[FOUND]
        scale, kept = bounded_step(step, rows, space, barriers, blur)
        if not kept:  # more rows would be kept even less
            break
    fits = within(parts[TASK_PART], space, nv, 0.0)
    joint, cause = binding(parts, space)
    facts[OUTSIDE], facts[LIMITING_JOINT], facts[TASK_SCALE] = outside, joint, max(scale, 0.0)
    split_parts(space[FOUND], rows.Vt, scale >= 0.0, parts, facts)
    status = bounded_outcome(A, singular, damped, cause, fits, parts, facts)
    if not broken or damped or status != DAMPED_STATUS:
        return status
    return POSITION_LIMITED if near else VELOCITY_LIMITED


@compiled_inside
def _too_fast(parts, space):
    """Whether the velocity approaches a singularity faster than the barrier allows."""
    rate, nv = 0.0, parts.shape[1]
    for j in range(nv):
        rate += space[SLOPE, j] * parts[VELOCITY, j]
    return rate < space[SLOPE, nv]


@compiled_inside
def progress_of(A, parts):
    """Velocity along b over the velocity asked for, b^T A u / |b|^2; 1 where nothing is asked for."""
    square = along = 0.0
    for i in range(A.shape[0]):
        b, reached = parts[TASK_VELOCITY, i], 0.0
        for j in range(A.shape[1]):
            reached += A[i, j] * parts[VELOCITY, j]
        square += b * b
        along += b * reached
    return along / square if square > AT_GOAL * AT_GOAL else 1.0


@compiled_inside
def plain_outcome(A, singular, damped, outside, parts, facts):
    """Status and numbers of a command that no limit changes, `outcome.plain_command`."""
    progress, status = 1.0, OK
    if damped or singular:
        progress = progress_of(A, parts)
        status = STALLED if progress < STALLED_BELOW else DAMPED_STATUS
    if singular:
        status = SINGULAR
    facts[TASK_SCALE] = facts[NULL_SCALE] = 1.0
    facts[PROGRESS], facts[OUTSIDE], facts[LIMITING_JOINT] = progress, outside, -1.0
    return OUTSIDE_LIMITS if outside > 0.0 else status


@compiled_inside
def bounded_outcome(A, singular, damped, cause, task_fits, parts, facts):
    """Status of a command that limits change, `outcome.bounded_command`, by the limit that is most in its way.

    The task's scale, how far a joint is outside and the limiting joint are among the facts already.
    """
    scale, progress = facts[TASK_SCALE], progress_of(A, parts)
    facts[TASK_SCALE], facts[PROGRESS] = min(scale, 1.0), progress
    if facts[OUTSIDE] > 0.0:
        return OUTSIDE_LIMITS
    if singular:
        return SINGULAR
    if progress < STALLED_BELOW and cause != BY_ACCELERATION:
        return STALLED
    if scale < SCALED_BELOW:
        if facts[LIMITING_JOINT] < 0.0:
            return DAMPED_STATUS
        if cause == BY_POSITION:
            return POSITION_LIMITED
        return ACCELERATION_LIMITED if cause == BY_ACCELERATION else VELOCITY_LIMITED
    if damped:
        return DAMPED_STATUS
    return NULL_SCALED if task_fits else REROUTED


@compiled_inside
def split_parts(found, Vt, solved, parts, facts):
    """Write the velocity and its parts as commanded into `parts`; see `Command`."""
    nv, rank = Vt.shape[1], int(facts[RANK])
    along = square = 0.0
    for j in range(nv):
        parts[VELOCITY, j], square = found[j], square + parts[NULL_PART, j] * parts[NULL_PART, j]
        parts[TASK_PART, j] = 0.0
    for i in range(rank, nv if solved else rank):
        part = 0.0
        for j in range(nv):
            part += Vt[i, j] * found[j]
        for j in range(nv):
            parts[TASK_PART, j] += part * Vt[i, j]
    for j in range(nv):  # the null-space part of the velocity, still in the place of the task's
        null = parts[TASK_PART, j]
        along += parts[NULL_PART, j] * null
        parts[NULL_PART, j], parts[TASK_PART, j] = null, found[j] - null
    facts[NULL_SCALE] = min(1.0, max(0.0, along / square)) if square > 0.0 else 1.0
    if facts[HAS_ESCAPE] == 0.0:
        return
    size, reached = norm(parts[ESCAPE_PART]), 0.0
    for j in range(nv):
        reached += found[j] * parts[ESCAPE_PART, j]
    factor = min(1.0, max(0.0, reached / max(size * size, 1e-300)))
    for j in range(nv):
        parts[ESCAPE_PART, j] *= factor
        parts[TASK_PART, j] -= parts[ESCAPE_PART, j]


@compiled_inside
def next_slide(slide, status, progress, dt):
    """`slide` after a command that was held for dt, `outcome.next_slide`."""
    if status == STALLED:
        return min(1.0, slide + dt / SLIDING_AFTER)
    return max(0.0, slide - dt / KEEPING_AFTER) if progress > GOING_ON else slide
