"""The law u = A^+ b + N pi at one posture, and the command that its limits leave of it."""

from __future__ import annotations

import math
from functools import cache
from math import isfinite
from operator import mul
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import Vjp
from manip_learn.constraint.manipulability import SINGULAR_RATIO, manipulability_of
from manip_learn.constraint.small_matrices import row_inverse, svd
from manip_learn.control.bounded_velocity import NEGLIGIBLE, Desired
from manip_learn.control.command import Command, Status
from manip_learn.control.limits import ACCELERATION, SLOWED_BY, BoundedVelocity, Bounds, Limits
from manip_learn.control.policies import ManipulabilityAscent, NullSpacePolicy, SampledPolicy, WeightedPolicies
from manip_learn.control.singularity import (
    Decomposition,
    escape_velocity,
    is_fast,
    pressed_damping,
    seed_speed,
    smallest_gradient,
    smallest_gradient_of,
    stable_damping,
    steepest_ascent,
    with_seed,
)
from manip_learn.control.tasks import Hold, PointAttractor, Task
from manip_learn.errors import TargetError
from manip_learn.linalg import Inverse, damped_inverse, inverse_singular_values, rank_of

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
# width of the escape from a singularity, as a share of the singular value at which damping sets in
ESCAPE_WIDTH = 0.6


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

    def command(
        self,
        velocity: Float[np.ndarray, " nv"],
        status: Status,
        parts: Desired,
        *,
        task_scale: float = 1.0,
        null_scale: float = 1.0,
        **more: Any,
    ) -> Command:
        """A command under this law, the sum of its parts as commanded; `more` fields as `Command` names them."""
        task, null, escape = parts
        return Command(
            velocity, status, self.mu, self.b, task, null, task_scale, null_scale, self.smallest, escape, **more
        )


@cache
def _unit(size: int) -> Float[np.ndarray, "n n"]:
    matrix = np.eye(size)
    matrix.setflags(write=False)
    return matrix


def plain_command(law: Law, velocity: Float[np.ndarray, " nv"], damped: bool, outside: float = 0.0) -> Command:
    """The command where no limit changes the law."""
    lost = _direction_lost(law)
    progress = _progress(law, velocity) if damped or lost else 1.0
    status = plain_status(lost, damped, progress, outside)
    return law.command(velocity, status, law.desired, progress=progress, outside=outside)


def plain_status(lost: bool, damped: bool, progress: float, outside: float) -> Status:
    """The status of a command that no limit changes."""
    if outside > 0.0:
        return Status.OUTSIDE_LIMITS
    if lost:
        return Status.SINGULAR
    if not damped:
        return Status.OK
    return Status.STALLED if progress < STALLED_BELOW else Status.DAMPED


def bounded_status(
    lost: bool, damped: bool, progress: float, outside: float, task_scale: float, joint: int, cause: int, fits: bool
) -> Status:
    """The status of a command that limits change, by the limit that is most in its way.

    Args:
        lost: Whether A loses a direction of the task.
        damped: Whether the task part is damped.
        progress: Velocity along b over the velocity asked for.
        outside: Largest distance of a joint beyond its position limits [rad or m].
        task_scale: Factor on the task.
        joint: Number of the joint whose limit changes the command most, -1 if none does.
        cause: Which limit of that joint it is, POSITION, VELOCITY or ACCELERATION.
        fits: Whether the task part alone is within the bounds.
    """
    if outside > 0.0:
        return Status.OUTSIDE_LIMITS
    if lost:
        return Status.SINGULAR
    if progress < STALLED_BELOW and cause != ACCELERATION:
        return Status.STALLED
    if task_scale < SCALED_BELOW:
        return SLOWED_BY[cause] if joint >= 0 else Status.DAMPED
    if damped:
        return Status.DAMPED
    return Status.NULL_SCALED if fits else Status.REROUTED


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
    # what rounding leaves of a policy that asks for nothing is not scaled: the processor would decide by how much
    asks = square > NEGLIGIBLE * NEGLIGIBLE
    null_scale = min(1.0, max(0.0, float(null.dot(null_part)) / square)) if asks else 1.0
    progress = _progress(law, velocity)
    joint, cause = bounds.binding(velocity, wish)
    outcome = progress, bounds.outside, task_scale, joint, cause, bounds.admit(task)
    status = bounded_status(_direction_lost(law), damped, *outcome)
    numbers = {"task_scale": min(task_scale, 1.0), "null_scale": null_scale, "progress": progress}
    parts = Desired(task_part, null_part, escape)
    return law.command(velocity, status, parts, **numbers, outside=bounds.outside, limiting_joint=joint)


def next_slide(slide: float, stalls: bool, progress: float, dt: float) -> float:
    """`slide` after a command that was held for dt [s]: it grows while the task stalls, and falls when it goes on."""
    if stalls:
        return min(1.0, slide + dt / SLIDING_AFTER)
    return max(0.0, slide - dt / KEEPING_AFTER) if progress > GOING_ON else slide


def _direction_lost(law: Law) -> bool:
    """Whether A loses a direction of the task: at a singularity, or with more rows than joints that b does not fit."""
    s, nv = law.A.shape
    return law.singular or (s > nv and _progress(law, law.desired.task) < SCALED_BELOW)


def _progress(law: Law, velocity: np.ndarray) -> float:
    """Velocity along b over the velocity asked for, b^T A u / |b|^2; 1 where nothing is asked for."""
    square = float(law.b.dot(law.b))
    return float(law.b.dot(law.A.dot(velocity))) / square if square > AT_GOAL * AT_GOAL else 1.0


@final
class ResolvedRateLaw:
    """Equation (2) of Manavalan and Howard, u = A^+ b + N pi, as `ResolvedRateController` describes it, before limits.

    Args:
        constraint: A(q).
        task: b(q, t).
        null_policy: pi(q, t).
        inverse: Kind of A^+.
        threshold: Singular value of A at which damping sets in.
        damping: Damping factor at a singular value of 0.
        limits: Within which the command will be brought; None for none.
    """

    def __init__(
        self,
        constraint: Constraint,
        task: Task,
        null_policy: NullSpacePolicy,
        inverse: Inverse,
        threshold: float,
        damping: float,
        limits: Limits | None,
    ):
        self.constraint, self.task, self.null_policy, self.limits = constraint, task, null_policy, limits
        self.inverse: Inverse = inverse
        self.threshold, self.damping = threshold, damping
        self._own_task = type(task) in (PointAttractor, Hold)  # whose velocities need no check
        policy = null_policy
        self._ascent = policy if isinstance(policy, ManipulabilityAscent) and policy.constraint is constraint else None
        climbs = self._ascent is not None and self._ascent.max_speed is not None
        climbs = climbs or (isinstance(policy, WeightedPolicies) and policy.climbs(constraint))
        self._escapes = inverse == "damped" and climbs
        self._samples = policy if isinstance(policy, SampledPolicy) else None
        self._brakes = inverse == "damped" and limits is not None

    def with_limits(self, limits: Limits) -> ResolvedRateLaw:
        """This law for a command within other limits."""
        settings = (self.inverse, self.threshold, self.damping)
        return ResolvedRateLaw(self.constraint, self.task, self.null_policy, *settings, limits)

    def __call__(self, q: np.ndarray, t: float, dt: float) -> Law:
        """The parts of the law at a posture.

        Raises:
            ConfigurationError: The posture has the wrong size or is not finite.
            TargetError: The task's target does not fit the constraint, or a velocity is not finite.
        """
        ascent, vjp = self._ascent, None
        if ascent is None and not self._escapes:
            A = self.constraint(q)
        else:  # one Hessian and one inverse serve the task and the policy
            A, vjp = self.constraint.value_and_vjp(q)
        b, E = self.task_velocity(q, t, dt)
        if E is not None:  # orientation targets: the rows whose velocity b is are those of the error
            return self._of_error_rows(q, t, dt, A, E, b, vjp)
        inverse = row_inverse(A)
        if inverse is None or (self.inverse == "damped" and inverse[2] < self.threshold):
            return self._near_singularity(q, t, dt, A, b, vjp)
        # nothing to damp or to truncate, the case of nearly every step
        X, mu, smallest = inverse
        pi = self._policy(q, t, dt) if ascent is None or vjp is None else ascent.from_inverse(X, mu, smallest, vjp, dt)
        desired = Desired(b.dot(X), pi - A.dot(pi).dot(X), None)
        return Law(A, b, desired, mu, smallest, False, None, vjp, X)

    def task_velocity(
        self, q: np.ndarray, t: float, dt: float
    ) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, "s nv"] | None]:
        """b for the time dt [s] that begins at t, in the rows' units per second, and E (see `Task.error_jacobian`).

        Raises:
            TargetError: The task's target does not fit the constraint, or b is not finite.
        """
        sampled = (dt,) if self.task.sampled else ()
        b, E = self.task.velocity_and_jacobian(self.constraint, q, t, *sampled)
        if not self._own_task:
            b = self._checked(b, self.constraint.n_constraints, "the task's velocity b")
        return b, E

    def _of_error_rows(
        self, q: np.ndarray, t: float, dt: float, A: np.ndarray, E: np.ndarray, b: np.ndarray, vjp: Vjp | None
    ) -> Law:
        """The law with E in the place of A (see `Task.error_jacobian`); mu and its ascent are those of A."""
        own, ascent = row_inverse(A), self._ascent
        if ascent is None or vjp is None:
            pi = self._policy(q, t, dt)
        elif own is None:
            pi = ascent.from_decomposition(A.shape, svd(A), vjp, dt)
        else:
            pi = ascent.from_inverse(*own, vjp, dt)
        mu, inverse = manipulability_of(A) if own is None else own[1], row_inverse(E)
        if inverse is None or (self.inverse == "damped" and inverse[2] < self.threshold):
            return self._near_singularity(q, t, dt, E, b, None, pi)._replace(mu=mu, barred=False)
        X, _, smallest = inverse
        return Law(
            E, b, Desired(b.dot(X), pi - E.dot(pi).dot(X), None), mu, smallest, False, None, None, X, barred=False
        )

    def _near_singularity(
        self,
        q: np.ndarray,
        t: float,
        dt: float,
        A: np.ndarray,
        b: np.ndarray,
        vjp: Vjp | None,
        pi: np.ndarray | None = None,
    ) -> Law:
        """The law by the singular value decomposition, see the class."""
        U, sigma, Vt = decomposition = Decomposition(*svd(A))
        values, ascent, climb, slope, escape = sigma.tolist(), self._ascent, None, None, None
        smallest, k, threshold = values[-1], len(values), self.threshold
        V, singular, fits = Vt[:k], smallest <= SINGULAR_RATIO * values[0], A.shape[0] <= A.shape[1]
        if pi is None and ascent is not None and vjp is not None:
            if singular and fits and ascent.logarithmic and ascent.max_speed is not None:
                climb = steepest_ascent(decomposition, vjp)
                pi = ascent.seed * climb
            elif singular or not (fits and ascent.logarithmic):
                pi = ascent.from_decomposition(A.shape, decomposition, vjp, dt)
            else:
                climb = vjp((U / sigma).dot(V))  # grad log mu
                pi = ascent.bounded(climb, smallest, dt)
        elif pi is None:
            pi = self._policy(q, t, dt)
        along, damping = b.dot(U).tolist(), self.damping
        task_part, stable = self._task_part(sigma, along, A, V, damping), 0.0
        if not singular and smallest < threshold and (self._brakes or self._escapes):
            rates = vjp or self.constraint.value_and_vjp(q)[1]
            if self._brakes:
                stable = stable_damping(decomposition, along, threshold, dt, rates)
            if stable > damping or (self._escapes and smallest < ESCAPE_WIDTH * threshold):
                slope = smallest_gradient(decomposition, rates)
            if stable > damping and slope is not None:
                damping = pressed_damping(damping, stable, slope, task_part)
                task_part = self._task_part(sigma, along, A, V, damping)
        Z = Vt[rank_of(sigma, A.shape) :]
        if self._escapes and vjp is not None:
            escape = escape_velocity(decomposition, vjp, dt, ESCAPE_WIDTH * threshold, climb, slope)
            if singular and self.limits is not None:
                # mu rises in both directions out of a singularity: a limit in one of them is no reason to stay
                freer = self.limits.freer_sense(q, escape)
                pi, escape = (pi if freer is escape or ascent is None else -pi), freer
        null = Z.dot(pi).dot(Z)
        if self._escapes and vjp is not None:
            null = with_seed(null, pi, seed_speed(smallest, ESCAPE_WIDTH * threshold))
        desired = Desired(task_part, null, escape)
        mu = math.prod(values) if fits else 0.0
        return Law(A, b, desired, mu, smallest, singular, decomposition, vjp, None, slope)

    def _task_part(
        self, sigma: np.ndarray, along: list[float], A: np.ndarray, V: np.ndarray, damping: float
    ) -> np.ndarray:
        """A^+ b = V diag(g) U^T b."""
        if self.inverse == "damped":  # in plain numbers
            gains = [damped_inverse(value, self.threshold, damping) for value in sigma.tolist()]
        else:
            gains = inverse_singular_values(sigma, A.shape, self.inverse).tolist()
        return np.fromiter(map(mul, gains, along), np.float64, len(gains)).dot(V)

    def approach(
        self, q: Float[np.ndarray, " n"], dt: float, law: Law, u: Float[np.ndarray, " nv"]
    ) -> Float[np.ndarray, " nv"] | None:
        """Gradient of the smallest singular value, where u could approach the singularity too fast; None elsewhere.

        Args:
            q: Posture.
            dt: Time for which the velocity is held [s].
            law: Of this posture.
            u: Joint velocity [rad/s or m/s].
        """
        A, smallest, limits = law.A, law.smallest, self.limits
        if not (self._brakes and law.barred) or limits is None or law.singular or A.shape[0] > A.shape[1]:
            return None
        flat = A.reshape(-1)
        if not is_fast(float(u.dot(u)), float(flat.dot(flat)), limits.weakest, smallest, dt):
            return None
        if law.slope is not None:
            return law.slope
        vjp = law.vjp or self.constraint.value_and_vjp(q)[1]
        if law.decomposition is None:
            return smallest_gradient_of(A, law.X, law.mu, smallest, vjp)
        return smallest_gradient(law.decomposition, vjp)

    def _policy(self, q: np.ndarray, t: float, dt: float) -> np.ndarray:
        pi = self.null_policy(q, t) if self._samples is None else self._samples(q, t, dt)
        return self._checked(pi, self.constraint.nv, "the null-space policy's velocity")

    @staticmethod
    def _checked(vector: ArrayLike, size: int, what: str) -> np.ndarray:
        array = np.asarray(vector, np.float64)
        if array.shape != (size,) or not isfinite(sum(array.tolist())):
            raise TargetError(f"{what} must be {size} finite numbers, got {array.tolist()}")
        return array
