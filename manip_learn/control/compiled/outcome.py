"""`outcome` as loops over plain numbers: the command with its status, before and after limits."""

from __future__ import annotations

from manip_learn.control.compiled.near_singularity import norm
from manip_learn.control.compiled.step_table import (
    ACCELERATION_LIMITED,
    DAMPED_STATUS,
    ESCAPE_PART,
    HAS_ESCAPE,
    LIMITING_JOINT,
    NULL_PART,
    NULL_SCALE,
    NULL_SCALED,
    OK,
    OUTSIDE,
    OUTSIDE_LIMITS,
    POSITION_LIMITED,
    PROGRESS,
    RANK,
    REROUTED,
    SINGULAR,
    STALLED,
    TASK_PART,
    TASK_SCALE,
    TASK_VELOCITY,
    VELOCITY,
    VELOCITY_LIMITED,
)
from manip_learn.control.limits import ACCELERATION as BY_ACCELERATION
from manip_learn.control.limits import POSITION as BY_POSITION
from manip_learn.control.outcome import AT_GOAL, GOING_ON, KEEPING_AFTER, SCALED_BELOW, SLIDING_AFTER, STALLED_BELOW
from manip_learn.robot.batch.kernel_cache import compiled_inside


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
