"""What was done to a command: the law before limits, and the command with its status after them."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import Vjp
from manip_learn.control.bounded_velocity import BoundedVelocity, Desired
from manip_learn.control.command import Command
from manip_learn.control.limits import ACCELERATION, POSITION, VELOCITY, Bounds
from manip_learn.control.singularity import Decomposition
from manip_learn.control.status import Status
from manip_learn.linalg import rank_of

# a task stalls where less than this share of the velocity asked for is left
STALLED_BELOW = 0.01
# [s] for which a task stalls until the arm slides along what blocks it, and goes on until its direction is kept again
SLIDING_AFTER, KEEPING_AFTER = 0.5, 1.0
# share of the velocity asked for from which a task goes on
GOING_ON = 0.5
# [m/s or rad/s] a task that asks for less than this has reached its goal
AT_GOAL = 1e-6
# a task is slowed down where less than this share of its velocity is commanded
SCALED_BELOW = 0.999
SLOWED = {
    POSITION: Status.POSITION_LIMITED,
    VELOCITY: Status.VELOCITY_LIMITED,
    ACCELERATION: Status.ACCELERATION_LIMITED,
}


@final
class Law(NamedTuple):
    """Equation (2) at one posture, before limits."""

    A: Float[np.ndarray, "s nv"]
    b: Float[np.ndarray, " s"]
    desired: Desired
    mu: float
    smallest: float
    singular: bool
    decomposition: Decomposition | None  # near singularities, X elsewhere
    vjp: Vjp | None
    X: Float[np.ndarray, "s nv"] | None = None  # A^{+T}
    slope: Float[np.ndarray, " nv"] | None = None  # grad of the smallest singular value, where it is known
    barred: bool = True  # whether the approach to the rows' singularities is bounded

    def null_space(self) -> Float[np.ndarray, "nv k"]:
        """Z with Z Z^T = N, the null basis near singularities and N itself elsewhere."""
        unit = _unit(self.A.shape[1])
        if self.decomposition is not None:
            rank = rank_of(self.decomposition.sigma, self.A.shape)
            return self.decomposition.Vt[rank:].T if rank else unit
        return unit if self.X is None else unit - self.A.T.dot(self.X)


@cache
def _unit(size: int) -> Float[np.ndarray, "n n"]:
    matrix = np.eye(size)
    matrix.setflags(write=False)
    return matrix


def plain_command(law: Law, velocity: Float[np.ndarray, " nv"], damped: bool, outside: float = 0.0) -> Command:
    """The command where no limit changes the law."""
    progress, status, lost = 1.0, Status.OK, _direction_lost(law)
    if damped or lost:
        progress, status = _progress(law, velocity), Status.DAMPED
        if progress < STALLED_BELOW:
            status = Status.STALLED
    if lost:
        status = Status.SINGULAR
    if outside > 0.0:
        status = Status.OUTSIDE_LIMITS
    return Command(
        velocity=velocity,
        status=status,
        manipulability=law.mu,
        task_velocity=law.b,
        task_part=law.desired.task,
        null_part=law.desired.null,
        task_scale=1.0,
        null_scale=1.0,
        smallest_singular_value=law.smallest,
        escape_part=law.desired.escape,
        progress=progress,
        outside=outside,
    )


def bounded_command(
    law: Law, wish: Float[np.ndarray, " nv"], found: BoundedVelocity, bounds: Bounds, damped: bool
) -> Command:
    """The command where limits change the law, whose task and null-space part together are `wish`."""
    task, null, escape = law.desired
    velocity, task_scale, null_part = found
    task_part = velocity - null_part
    if escape is not None:
        share = float(velocity.dot(escape)) / max(float(escape.dot(escape)), 1e-300)
        escape = escape if share >= 1.0 else escape * max(0.0, share)
        task_part = task_part - escape
    square = float(null.dot(null))
    null_scale = min(1.0, max(0.0, float(null.dot(null_part)) / square)) if square > 0.0 else 1.0
    progress = _progress(law, velocity)
    joint, cause = bounds.binding(velocity, wish)
    if bounds.outside > 0.0:
        status = Status.OUTSIDE_LIMITS
    elif _direction_lost(law):
        status = Status.SINGULAR
    elif progress < STALLED_BELOW and cause != ACCELERATION:
        status = Status.STALLED
    elif task_scale < SCALED_BELOW:
        status = Status.DAMPED if joint < 0 else SLOWED[cause]
    elif damped:
        status = Status.DAMPED
    else:
        status = Status.NULL_SCALED if bounds.admit(task) else Status.REROUTED
    return Command(
        velocity=velocity,
        status=status,
        manipulability=law.mu,
        task_velocity=law.b,
        task_part=task_part,
        null_part=null_part,
        task_scale=min(task_scale, 1.0),
        null_scale=null_scale,
        smallest_singular_value=law.smallest,
        escape_part=escape,
        progress=progress,
        outside=bounds.outside,
        limiting_joint=joint,
    )


def next_slide(slide: float, command: Command, dt: float) -> float:
    """`slide` after a command that was held for dt: it grows while the task stalls, and falls when it goes on."""
    if command.status is Status.STALLED:
        return min(1.0, slide + dt / SLIDING_AFTER)
    return max(0.0, slide - dt / KEEPING_AFTER) if command.progress > GOING_ON else slide


def _direction_lost(law: Law) -> bool:
    """Whether A loses a direction of the task: at a singularity, or with more rows than joints that b does not fit."""
    s, nv = law.A.shape
    return law.singular or (s > nv and _progress(law, law.desired.task) < SCALED_BELOW)


def _progress(law: Law, velocity: np.ndarray) -> float:
    """Velocity along b over the velocity asked for, b^T A u / |b|^2; 1 where nothing is asked for."""
    square = float(law.b.dot(law.b))
    return float(law.b.dot(law.A.dot(velocity))) / square if square > AT_GOAL * AT_GOAL else 1.0
