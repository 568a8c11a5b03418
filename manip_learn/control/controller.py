"""Resolved-rate control: u = A^+ b + N pi, within the limits of a real arm."""

from __future__ import annotations

import copy
import math
from math import isfinite
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import Vjp
from manip_learn.constraint.manipulability import SINGULAR_RATIO, manipulability_of
from manip_learn.control.bounded_velocity import Desired, bounded_velocity
from manip_learn.control.command import Command
from manip_learn.control.limits import Limits
from manip_learn.control.outcome import Law, bounded_command, plain_command
from manip_learn.control.policies import (
    ManipulabilityAscent,
    NullSpacePolicy,
    SampledPolicy,
    WeightedPolicies,
    ZeroPolicy,
)
from manip_learn.control.polytope_projection import Solver, projection_by
from manip_learn.control.singularity import (
    APPROACH_RATE,
    BRAKING_SHARE,
    Decomposition,
    approach_bound,
    escape_velocity,
    pressed_damping,
    smallest_gradient,
    stable_damping,
)
from manip_learn.control.tasks import Hold, Task
from manip_learn.errors import ConfigurationError, ConstraintError, TargetError
from manip_learn.linalg import Inverse, inverse_singular_values, matlab_tolerance, row_inverse, svd
from manip_learn.robot.robot import Robot

# width of the escape from a singularity, as a share of the singular value at which damping sets in
ESCAPE_WIDTH = 0.6


@final
class ResolvedRateController:
    """u = A^+ b + N pi, equation (2) of Manavalan and Howard, "Learning Singularity Avoidance", with limits.

    With A = U diag(sigma) V^T, the task part is A^+ b = V diag(g) U^T b, where g_i depends on `inverse`:

        exact:      g = 1 / sigma
        truncated:  g = 1 / sigma where sigma > max(size(A)) eps(sigma_1), else 0      (Matlab's pinv)
        damped:     g = sigma / (sigma^2 + lambda^2),  lambda = damping (1 - (sigma / threshold)^2), 0 above threshold

    N = I - A^+ A = Z Z^T is always the exact projector, Z the null basis of A: a damped one would leak into the task.
    Away from singularities, A^{+T} = (A A^T)^-1 A and N pi = pi - A^+ (A pi) give the same without the decomposition.

    Within limits, the command is the nearest one that keeps the task's direction (see `bounded_velocity`); where no
    motion along it is possible, the arm slides along what blocks it. With `inverse="damped"`, a singularity is
    approached no faster than the arm can brake, and, where the null policy climbs this constraint's mu, left again (see
    `singularity`).

    Args:
        constraint: A(q).
        task: b(q, t); None holds still (b = 0).
        null_policy: pi(q, t); None is zero.
        inverse: `"damped"` for a real arm; `"exact"` or `"truncated"` (Matlab's tolerance) as in the paper.
        threshold: Singular value of A at which damping sets in, in the constraint's units (m or 1).
        damping: Damping factor at a singular value of 0; within limits a larger one for a task that presses into the
            singularity (see `stable_damping`).
        limits: `True` for the robot's own (see `Limits` for the accelerations); a `Limits`; `False` ignores the
            joint limits and scales nothing (the paper's law as printed).
        dt: Time for which a command is held [s], unless the call says otherwise.
        robot: Whose limits count; the features' own robot by default.
        solver: `"active-set"` finds the bounded command by a method of the library; `"qp"` by DAQP (the extra `qp`).

    Raises:
        ConstraintError: The null policy belongs to another number of joints, or settings that are not positive.
        MissingExtraError: DAQP is not installed.
    """

    def __init__(
        self,
        constraint: Constraint,
        task: Task | None = None,
        null_policy: NullSpacePolicy | None = None,
        inverse: Inverse = "damped",
        *,
        threshold: float = 0.05,
        damping: float = 0.05,
        limits: bool | Limits = True,
        dt: float = 0.01,
        robot: Robot | None = None,
        solver: Solver = "active-set",
    ):
        if inverse not in ("exact", "truncated", "damped"):
            raise ConstraintError(f"inverse must be 'exact', 'truncated' or 'damped', not {inverse!r}")
        for name, value in (("threshold", threshold), ("damping", damping), ("dt", dt)):
            if not (np.isfinite(value) and value > 0.0):
                raise ConstraintError(f"{name} must be a positive number, got {value!r}")
        self.task: Task = task or Hold()
        self.learnt = constraint
        self.constraint = constraint = self.task.rows(constraint)
        self.null_policy: NullSpacePolicy = null_policy or ZeroPolicy(constraint.nv)
        self.inverse: Inverse = inverse
        self.threshold = float(threshold)
        self.damping = float(damping)
        self.dt = float(dt)
        own = limits.robot if isinstance(limits, Limits) else None
        self.robot: Robot | None = robot or own or constraint.robot
        self.limits = self._limits_of(limits)
        self.solver: Solver = solver
        self._project = projection_by(solver)
        self._features_check = self.robot is not None and self.robot is constraint.robot
        policy = self.null_policy
        self._ascent = policy if isinstance(policy, ManipulabilityAscent) and policy.constraint is constraint else None
        climbs = self._ascent is not None and self._ascent.max_speed is not None
        climbs = climbs or (isinstance(policy, WeightedPolicies) and policy.climbs(constraint))
        self._escapes = inverse == "damped" and climbs
        self._samples = policy if isinstance(policy, SampledPolicy) else None
        self._brakes = inverse == "damped" and self.limits is not None

    def __call__(
        self,
        q: ArrayLike,
        t: float = 0.0,
        dt: float | None = None,
        previous: Float[np.ndarray, " nv"] | None = None,
        slide: float = 0.0,
    ) -> Command:
        """The command at posture q and time t.

        Args:
            q: Posture: a configuration or joint positions.
            t: Time [s].
            dt: Time for which the command is held [s].
            previous: Velocity commanded in the step before [rad/s or m/s], within whose reach the acceleration limits
                keep the command; None bounds no acceleration.
            slide: 0 keeps the task's direction where limits allow any motion along it, and else the nearest one; 1
                comes as near to the task's velocity as limits allow, whatever the direction.

        Raises:
            ConfigurationError: q has the wrong size or is not finite, or dt is not positive.
            TargetError: The task's target does not fit the constraint.
        """
        if dt is None:
            dt = self.dt
        elif not 0.0 < dt < math.inf:
            raise ConfigurationError(f"dt must be a positive number of seconds, got {dt!r}")
        if not (self._features_check and type(q) is np.ndarray and q.dtype.char == "d"):
            q = self._checked_posture(q)
        return self._limited(q, dt, self._law(q, t, dt), previous, slide)

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Distance to the task's goal along the constrained rows [m or rad]."""
        return self.task.error(self.constraint, np.asarray(q, dtype=np.float64), t)

    def with_limits(self, limits: Limits) -> ResolvedRateController:
        """The same controller with other limits."""
        other = copy.copy(self)
        other.limits = other._limits_of(limits)
        other._brakes = other.inverse == "damped"
        return other

    def _law(self, q: np.ndarray, t: float, dt: float) -> Law:
        """The parts of equation (2), before limits."""
        ascent, vjp = self._ascent, None
        if ascent is None and not self._escapes:
            A = self.constraint(q)
        else:  # one Hessian and one inverse serve the task and the policy
            A, vjp = self.constraint.value_and_vjp(q)
        b = self._checked(self.task.velocity(self.constraint, q, t), A.shape[0], "the task's velocity b")
        E = self.task.error_jacobian(self.constraint, q, t)
        if E is not None:  # orientation targets: the rows whose velocity b is are those of the error
            return self._near_singularity(q, t, dt, E, b, None)._replace(mu=manipulability_of(A), barred=False)
        inverse = row_inverse(A)
        if inverse is None or (self.inverse == "damped" and inverse[2] < self.threshold):
            return self._near_singularity(q, t, dt, A, b, vjp)
        # nothing to damp or to truncate, the case of nearly every step
        X, mu, smallest = inverse
        pi = self._policy(q, t, dt) if ascent is None or vjp is None else ascent.from_inverse(X, mu, smallest, vjp, dt)
        desired = Desired(b.dot(X), pi - A.dot(pi).dot(X), None)
        return Law(A, b, desired, mu, smallest, False, None, vjp)

    def _near_singularity(
        self, q: np.ndarray, t: float, dt: float, A: np.ndarray, b: np.ndarray, vjp: Vjp | None
    ) -> Law:
        """The law by the singular value decomposition, see the class."""
        ascent, escape = self._ascent, None
        U, sigma, Vt = decomposition = Decomposition(*svd(A))
        if ascent is None or vjp is None:
            pi = self._policy(q, t, dt)
        else:
            pi = ascent.from_decomposition(A.shape, decomposition, vjp, dt)
        k = sigma.shape[0]
        along = b.dot(U[:, :k])
        gains = inverse_singular_values(sigma, A.shape, self.inverse, self.threshold, self.damping)
        task_part = (gains * along).dot(Vt[:k])
        stable = stable_damping(sigma, along, self.threshold, dt)
        if self._brakes and stable > self.damping and sigma[-1] > SINGULAR_RATIO * sigma[0]:
            slope = smallest_gradient(decomposition, vjp or self.constraint.value_and_vjp(q)[1])
            damping = pressed_damping(self.damping, stable, slope, task_part)
            gains = inverse_singular_values(sigma, A.shape, self.inverse, self.threshold, damping)
            task_part = (gains * along).dot(Vt[:k])
        Z = Vt[np.count_nonzero(sigma > matlab_tolerance(sigma, A.shape)) :]
        smallest, singular = float(sigma[-1]), bool(sigma[-1] <= SINGULAR_RATIO * sigma[0])
        mu = math.prod(sigma.tolist()) if A.shape[0] <= A.shape[1] else 0.0
        if self._escapes and vjp is not None:
            escape = escape_velocity(decomposition, vjp, dt, ESCAPE_WIDTH * self.threshold)
            if singular and self.limits is not None:
                # mu rises in both directions out of a singularity: a limit in one of them is no reason to stay
                escape = self.limits.freer_sense(q, escape)
        desired = Desired(task_part, Z.dot(pi).dot(Z), escape)
        return Law(A, b, desired, mu, smallest, singular, decomposition, vjp)

    def _barrier(self, q: np.ndarray, dt: float, law: Law, u: np.ndarray) -> tuple[np.ndarray, float] | None:
        """(g, least): the approach to a singularity, g u >= least, where u could exceed it; None elsewhere."""
        A, smallest, limits = law.A, law.smallest, self.limits
        if not (self._brakes and law.barred) or limits is None or law.singular or A.shape[0] > A.shape[1]:
            return None
        # |grad sigma| is about as large as A itself: no closer look where that is slow enough
        size = float(np.vdot(A, A))
        least_deceleration = BRAKING_SHARE * limits.weakest * math.sqrt(size)
        rate = min(APPROACH_RATE, 0.5 / dt) * smallest
        if float(u.dot(u)) * size < min(2.0 * least_deceleration * smallest, rate * rate):
            return None
        decomposition = law.decomposition or Decomposition(*svd(A))
        vjp = law.vjp or self.constraint.value_and_vjp(q)[1]
        slope = smallest_gradient(decomposition, vjp)
        bound = approach_bound(smallest, slope, limits.acceleration, dt)
        return (slope, -bound) if bound < math.inf else None

    def _limits_of(self, limits: bool | Limits) -> Limits | None:
        if isinstance(limits, Limits):
            if self.robot is not limits.robot:
                raise ConstraintError("the limits belong to another robot than the constraint's")
            return limits
        return Limits(self.robot) if limits and self.robot is not None else None

    def _checked_posture(self, q: ArrayLike) -> np.ndarray:
        if self.robot is not None:
            return self.robot.checked_posture(q)
        vector = np.asarray(q, dtype=np.float64)
        if not np.all(np.isfinite(vector)):
            raise ConfigurationError(f"the posture is not finite: {vector.tolist()}")
        return vector

    def _policy(self, q: np.ndarray, t: float, dt: float) -> np.ndarray:
        pi = self.null_policy(q, t) if self._samples is None else self._samples(q, t, dt)
        return self._checked(pi, self.constraint.nv, "the null-space policy's velocity")

    @staticmethod
    def _checked(vector: ArrayLike, size: int, what: str) -> np.ndarray:
        array = np.asarray(vector, np.float64)
        if array.shape != (size,) or not isfinite(sum(array.tolist())):
            raise TargetError(f"{what} must be {size} finite numbers, got {array.tolist()}")
        return array

    def _limited(self, q: np.ndarray, dt: float, law: Law, previous: np.ndarray | None, slide: float) -> Command:
        """The parts of the law brought within the limits, and added."""
        task, null, escape = law.desired
        velocity = task + null if escape is None else task + null + escape
        if not isfinite(sum(velocity.tolist())):
            raise ConfigurationError(
                f"the {self.inverse!r} inverse overflows at this posture (smallest singular value {law.smallest:.1e}): "
                "use inverse='damped'"
            )
        limits, damped = self.limits, self.inverse == "damped" and law.smallest < self.threshold
        if limits is None:
            return plain_command(law, velocity, damped)
        barrier = self._barrier(q, dt, law, velocity)
        slow = barrier is None or float(barrier[0].dot(velocity)) >= barrier[1]
        if slow and limits.admit(q, dt, velocity, previous):
            return plain_command(law, velocity, damped)
        bounds = limits.bounds(q, dt, previous)
        if slow and bounds.admit(velocity):
            return plain_command(law, velocity, damped, bounds.outside)
        low, high = np.array(bounds.low), np.array(bounds.high)
        # an explicit step of dt follows sliding that is damped that much
        blur = max(self.damping, math.sqrt(2.0 * dt * math.sqrt(law.b.dot(law.b))))
        found = bounded_velocity(law.A, law.desired, low, high, limits.velocity, barrier, self._project, slide, blur)
        return bounded_command(law, found, bounds, damped)

    def __repr__(self) -> str:
        return (
            f"ResolvedRateController({self.constraint!r}, task={self.task!r}, null_policy={self.null_policy!r}, "
            f"inverse={self.inverse!r})"
        )
