"""Resolved-rate control: u = A^+ b + N pi, within the limits of a real arm."""

from __future__ import annotations

import math
from math import isfinite
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import Vjp
from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control.command import Command
from manip_learn.control.null_space_saturation import BLOCKED, project_policy, saturate_null_space
from manip_learn.control.policies import ManipulabilityAscent, NullSpacePolicy, ZeroPolicy
from manip_learn.control.status import Status
from manip_learn.control.tasks import Hold, Task
from manip_learn.control.velocity_limits import VelocityLimits
from manip_learn.errors import ConfigurationError, ConstraintError, TargetError
from manip_learn.linalg import Inverse, inverse_singular_values, matlab_tolerance, row_inverse, svd
from manip_learn.robot.robot import Robot


@final
class _Law(NamedTuple):
    """Equation (2) at one posture, before limits."""

    A: Float[np.ndarray, "s nv"]
    b: Float[np.ndarray, " s"]
    task_part: Float[np.ndarray, " nv"]
    null_part: Float[np.ndarray, " nv"]
    mu: float
    smallest: float
    singular: bool


@final
class ResolvedRateController:
    """u = A^+ b + N pi, equation (2) of Manavalan and Howard, "Learning Singularity Avoidance", with limits.

    With A = U diag(sigma) V^T, the task part is A^+ b = V diag(g) U^T b, where g_i depends on `inverse`:

        exact:      g = 1 / sigma
        truncated:  g = 1 / sigma where sigma > max(size(A)) eps(sigma_1), else 0      (Matlab's pinv)
        damped:     g = sigma / (sigma^2 + lambda^2),  lambda = damping (1 - (sigma / threshold)^2), 0 above threshold

    N = I - A^+ A = Z Z^T is always the exact projector, Z the null basis of A: a damped one would leak into the task.
    Away from singularities, A^{+T} = (A A^T)^-1 A and N pi = pi - A^+ (A pi) give the same without the decomposition.

    The task part is scaled down as a whole at the limits (clipping joint by joint would change the task's direction),
    and the null-space part is then scaled to what is left. Where a position limit would slow the task down, null-space
    motion first compensates for the joints at their limits, as far as it can.

    Args:
        constraint: A(q).
        task: b(q, t); None holds still (b = 0).
        null_policy: pi(q, t); None is zero.
        inverse: `"damped"` for a real arm; `"exact"` or `"truncated"` (Matlab's tolerance) as in the paper.
        threshold: Singular value of A at which damping sets in, in the constraint's units (m or 1).
        damping: Damping factor at a singular value of 0.
        limits: False ignores the joint limits and scales nothing (the paper's law as printed).
        dt: Look-ahead for the position limits [s], unless the call says otherwise.
        robot: Whose limits count; the features' own robot by default.

    Raises:
        ConstraintError: The null policy belongs to another number of joints, or settings that are not positive.
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
        limits: bool = True,
        dt: float = 0.01,
        robot: Robot | None = None,
    ):
        if inverse not in ("exact", "truncated", "damped"):
            raise ConstraintError(f"inverse must be 'exact', 'truncated' or 'damped', not {inverse!r}")
        for name, value in (("threshold", threshold), ("damping", damping), ("dt", dt)):
            if not (np.isfinite(value) and value > 0.0):
                raise ConstraintError(f"{name} must be a positive number, got {value!r}")
        self.learnt = constraint
        self.constraint = constraint = constraint if task is None else task.rows(constraint)
        self.task: Task = task or Hold()
        self.null_policy: NullSpacePolicy = null_policy or ZeroPolicy(constraint.nv)
        self.inverse: Inverse = inverse
        self.threshold = float(threshold)
        self.damping = float(damping)
        self.limits = bool(limits)
        self.dt = float(dt)
        self.robot: Robot | None = robot or constraint.robot
        self._limits = VelocityLimits(self.robot) if self.limits and self.robot is not None else None
        self._features_check = self.robot is not None and self.robot is constraint.robot
        policy = self.null_policy
        self._ascent = policy if isinstance(policy, ManipulabilityAscent) and policy.constraint is constraint else None

    def __call__(self, q: ArrayLike, t: float = 0.0, dt: float | None = None) -> Command:
        """The command at posture q and time t.

        Args:
            q: Posture: a configuration or joint positions.
            t: Time [s].
            dt: Look-ahead for the position limits [s].

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
        ascent, vjp = self._ascent, None
        if ascent is None:
            A = self.constraint(q)
        else:  # one Hessian and one inverse serve the task and the policy
            A, vjp = self.constraint.value_and_vjp(q)
        b = self._checked(self.task.velocity(self.constraint, q, t), A.shape[0], "the task's velocity b")
        inverse = row_inverse(A)
        if inverse is None or (self.inverse == "damped" and inverse[2] < self.threshold):
            return self._limited(q, dt, self._near_singularity(q, t, dt, A, b, vjp))
        # nothing to damp or to truncate, the case of nearly every step
        X, mu, smallest = inverse
        pi = self._policy(q, t) if ascent is None or vjp is None else ascent.from_inverse(X, mu, vjp)
        return self._limited(q, dt, _Law(A, b, b.dot(X), pi - A.dot(pi).dot(X), mu, smallest, False))

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Distance to the task's goal along the constrained rows [m or rad]."""
        return self.task.error(self.constraint, np.asarray(q, dtype=np.float64), t)

    def _near_singularity(
        self, q: np.ndarray, t: float, dt: float, A: np.ndarray, b: np.ndarray, vjp: Vjp | None
    ) -> _Law:
        """The law by the singular value decomposition, see the class."""
        ascent = self._ascent
        U, sigma, Vt = svd(A)
        if ascent is None or vjp is None:
            pi = self._policy(q, t)
        else:
            pi = ascent.from_decomposition(A.shape, (U, sigma, Vt), vjp)
        gains = inverse_singular_values(sigma, A.shape, self.inverse, self.threshold, self.damping)
        k = sigma.shape[0]
        task_part = (gains * b.dot(U[:, :k])).dot(Vt[:k])
        Z = Vt[np.count_nonzero(sigma > matlab_tolerance(sigma, A.shape)) :]
        smallest, singular = float(sigma[-1]), bool(sigma[-1] <= SINGULAR_RATIO * sigma[0])
        mu = math.prod(sigma.tolist()) if A.shape[0] <= A.shape[1] else 0.0
        null_part = Z.dot(pi).dot(Z)
        if singular and ascent is not None and self._limits is not None:
            # mu rises in both directions out of a singularity: a limit in one of them is no reason to stay
            directions = (null_part, -null_part)
            scales = [self._limits.scale_factors(q, dt, task_part, v).null for v in directions]
            null_part = directions[0] if scales[0] >= scales[1] else directions[1]
        return _Law(A, b, task_part, null_part, mu, smallest, singular)

    def _checked_posture(self, q: ArrayLike) -> np.ndarray:
        if self.robot is not None:
            return self.robot.checked_posture(q)
        vector = np.asarray(q, dtype=np.float64)
        if not np.all(np.isfinite(vector)):
            raise ConfigurationError(f"the posture is not finite: {vector.tolist()}")
        return vector

    def _policy(self, q: np.ndarray, t: float) -> np.ndarray:
        return self._checked(self.null_policy(q, t), self.constraint.nv, "the null-space policy's velocity")

    @staticmethod
    def _checked(vector: ArrayLike, size: int, what: str) -> np.ndarray:
        array = np.asarray(vector, np.float64)
        if array.shape != (size,) or not isfinite(sum(array.tolist())):
            raise TargetError(f"{what} must be {size} finite numbers, got {array.tolist()}")
        return array

    def _limited(self, q: np.ndarray, dt: float, law: _Law) -> Command:
        """The two parts of the law scaled to the limits, and added."""
        A, b, task_part, null_part, mu, smallest, singular = law
        limits, task_scale, null_scale = self._limits, 1.0, 1.0
        position_bound, saturation = False, None
        if limits is not None:
            task_scale, null_scale, position_bound = limits.scale_factors(q, dt, task_part, null_part)
            if position_bound:
                saturation = saturate_null_space(task_part, null_part, A, *limits.bounds(q, dt), task_scale)
            if saturation is not None:
                task_scale, null_part, null_scale = saturation
            elif task_scale == 1.0 and null_scale < BLOCKED:
                null_part, null_scale = project_policy(task_part, null_part, A, *limits.bounds(q, dt))
                null_scale = min(null_scale, 1.0 - BLOCKED)
            elif null_scale < 1.0:
                null_part = null_scale * null_part
            if task_scale < 1.0:
                task_part = task_scale * task_part
        velocity = task_part + null_part
        if not isfinite(sum(velocity.tolist())):
            raise ConfigurationError(
                f"the {self.inverse!r} inverse overflows at this posture (smallest singular value {smallest:.1e}): "
                "use inverse='damped'"
            )
        if singular:
            status = Status.SINGULAR
        elif task_scale < 1.0:
            status = Status.POSITION_LIMITED if position_bound else Status.VELOCITY_LIMITED
        elif self.inverse == "damped" and smallest < self.threshold:
            status = Status.DAMPED
        elif saturation is not None:
            status = Status.REROUTED
        else:
            status = Status.NULL_SCALED if null_scale < 1.0 else Status.OK
        return Command(velocity, status, mu, b, task_part, null_part, task_scale, null_scale, smallest)

    def __repr__(self) -> str:
        return (
            f"ResolvedRateController({self.constraint!r}, task={self.task!r}, null_policy={self.null_policy!r}, "
            f"inverse={self.inverse!r})"
        )
