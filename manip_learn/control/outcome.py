"""The law brought within the limits, and what was done to it: NumPy runs it, and numba compiles the same source."""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.small_matrices import dot
from manip_learn.control.bounded_velocity import bounded_velocity, feasible
from manip_learn.control.command import Command
from manip_learn.control.limits import (
    ACCELERATION,
    POSITION,
    Bounds,
    LimitTable,
    admitted,
    binding,
)
from manip_learn.control.resolved_rate_law import DAMPED, Law, LawSettings, null_rows
from manip_learn.control.status import STATUSES, Status

# a task stalls where less than this share of the velocity asked for is left
STALLED_BELOW = 0.01
# [s] for which a task stalls until the arm slides along what blocks it, and goes on until its direction is kept again
SLIDING_AFTER, KEEPING_AFTER = 0.5, 1.0
# share of the velocity asked for from which a task goes on
GOING_ON = 0.5
# [m/s or rad/s] a task that asks for less than this has reached its goal
AT_GOAL = 1e-6
# [rad2/s2 or m2/s2] square of a null-space part of which nothing can be left
NOTHING = 1e-24
# a task is slowed down where less than this share of its velocity is commanded
SCALED_BELOW = 0.999

# places in `STATUSES`
OK, IS_DAMPED, STALLED, SINGULAR, OUTSIDE_LIMITS, POSITION_LIMITED, VELOCITY_LIMITED, ACCELERATION_LIMITED = map(
    STATUSES.index,
    (
        Status.OK,
        Status.DAMPED,
        Status.STALLED,
        Status.SINGULAR,
        Status.OUTSIDE_LIMITS,
        Status.POSITION_LIMITED,
        Status.VELOCITY_LIMITED,
        Status.ACCELERATION_LIMITED,
    ),
)
REROUTED, NULL_SCALED = STATUSES.index(Status.REROUTED), STATUSES.index(Status.NULL_SCALED)

# rows of the parts of a compiled command, each as long as there are degrees of freedom; b takes the first s of the last
VELOCITY, TASK_PART, NULL_PART, ESCAPE_PART, TASK_VELOCITY, PARTS = range(6)


@final
class Outcome(NamedTuple):
    """A command without what the law says of it; the attributes are those of `Command`.

    Attributes:
        code: Place of the status in `STATUSES`.
        velocity: See `Command`.
        task: The part of the task.
        null: The part in the null space.
        escape: The part out of a singularity.
        task_scale: See `Command`.
        null_scale: See `Command`.
        progress: See `Command`.
        outside: See `Command`.
        joint: The limiting joint.
    """

    code: int
    velocity: Float[np.ndarray, " nv"]
    task: Float[np.ndarray, " nv"]
    null: Float[np.ndarray, " nv"]
    escape: Float[np.ndarray, " nv"]
    task_scale: float
    null_scale: float
    progress: float
    outside: float
    joint: int


def barrier_of(
    slope: Float[np.ndarray, " nv"], bound: float
) -> tuple[Float[np.ndarray, "r nv"], Float[np.ndarray, " r"]]:
    """(G, least) for G u >= least: the bound on the approach to a singularity, no row where it is infinite.

    Args:
        slope: Gradient of the smallest singular value.
        bound: `approach_bound`.
    """
    rows = int(bound < math.inf)
    return slope.reshape((1, -1))[:rows], np.zeros(rows) - bound


def within_limits(
    settings: LawSettings,
    limits: LimitTable,
    law: Law,
    bounds: Bounds,
    slide: float,
    G: Float[np.ndarray, "r nv"],
    least: Float[np.ndarray, " r"],
) -> Outcome:
    """The law brought within the limits.

    Args:
        settings: Of the law.
        limits: Of the robot.
        law: At this posture.
        bounds: On the next velocity.
        slide: See `ResolvedRateController`.
        G: Barriers on the joint velocity, G u >= least.
        least: See `G`.
    """
    desired = law.desired
    wish = desired.task + desired.null
    velocity = wish + desired.escape
    slow = True
    for i in range(G.shape[0]):
        slow = slow and dot(G[i], velocity) >= least[i]
    if slow and admitted(bounds, velocity):
        return plain_outcome(settings, law, velocity, bounds.outside)
    # an explicit step of dt follows sliding that is damped that much
    blur = max(settings.damping, math.sqrt(2.0 * limits.dt * math.sqrt(dot(law.b, law.b))))
    within = feasible(bounds, G, least, settings.by_library)
    null = null_rows(law)
    u, task_scale, null_part = bounded_velocity(law.A, desired, null, within, limits.velocity, slide, blur)
    escape, square = desired.escape, dot(desired.escape, desired.escape)
    if square > 0.0:
        escape = escape * min(1.0, max(0.0, dot(u, escape) / square))
    square = dot(desired.null, desired.null)
    progress, (joint, cause) = progress_of(law, u), binding(bounds, u, wish)
    return Outcome(
        code=_bounded_code(settings, law, bounds, task_scale, progress, joint, cause),
        velocity=u,
        task=u - null_part - escape,
        null=null_part,
        escape=escape,
        task_scale=min(task_scale, 1.0),
        null_scale=min(1.0, max(0.0, dot(desired.null, null_part) / square)) if square > NOTHING else 1.0,
        progress=progress,
        outside=bounds.outside,
        joint=joint,
    )


def plain_outcome(settings: LawSettings, law: Law, velocity: Float[np.ndarray, " nv"], outside: float) -> Outcome:
    """The command where no limit changes the law."""
    code, progress, lost = OK, 1.0, _direction_lost(law)
    if lost or is_damped(settings, law):
        progress = progress_of(law, velocity)
        code = STALLED if progress < STALLED_BELOW else IS_DAMPED
    if lost:
        code = SINGULAR
    if outside > 0.0:
        code = OUTSIDE_LIMITS
    return Outcome(
        code=code,
        velocity=velocity,
        task=law.desired.task,
        null=law.desired.null,
        escape=law.desired.escape,
        task_scale=1.0,
        null_scale=1.0,
        progress=progress,
        outside=outside,
        joint=-1,
    )


def _bounded_code(
    settings: LawSettings, law: Law, bounds: Bounds, task_scale: float, progress: float, joint: int, cause: int
) -> int:
    """Place of the status of a command that limits change."""
    if bounds.outside > 0.0:
        return OUTSIDE_LIMITS
    if _direction_lost(law):
        return SINGULAR
    if progress < STALLED_BELOW and cause != ACCELERATION:
        return STALLED
    if task_scale < SCALED_BELOW:
        if joint < 0:
            return IS_DAMPED
        if cause == POSITION:
            return POSITION_LIMITED
        return ACCELERATION_LIMITED if cause == ACCELERATION else VELOCITY_LIMITED
    if is_damped(settings, law):
        return IS_DAMPED
    return NULL_SCALED if admitted(bounds, law.desired.task) else REROUTED


def is_damped(settings: LawSettings, law: Law) -> bool:
    """Whether the task part is damped near a singularity."""
    return settings.inverse == DAMPED and law.smallest < settings.threshold


def _direction_lost(law: Law) -> bool:
    """Whether A loses a direction of the task: at a singularity, or with more rows than joints that b does not fit."""
    s, nv = law.A.shape
    return law.singular or (s > nv and progress_of(law, law.desired.task) < SCALED_BELOW)


def progress_of(law: Law, velocity: Float[np.ndarray, " nv"]) -> float:
    """Velocity along b over the velocity asked for, b^T A u / |b|^2; 1 where nothing is asked for."""
    square = dot(law.b, law.b)
    return dot(law.b, dot(law.A, velocity)) / square if square > AT_GOAL * AT_GOAL else 1.0


def next_slide(slide: float, command: Command, dt: float) -> float:
    """`slide` after a command that was held for dt."""
    return slide_after(slide, command.status is Status.STALLED, command.progress, dt)


def slide_after(slide: float, stalls: bool, progress: float, dt: float) -> float:
    """`slide` after dt [s]: it grows while the task stalls, and falls when it goes on."""
    if stalls:
        return min(1.0, slide + dt / SLIDING_AFTER)
    return max(0.0, slide - dt / KEEPING_AFTER) if progress > GOING_ON else slide
