"""Resolved-rate control: u = A^+ b + N pi, made safe for a real arm."""

from __future__ import annotations

import math
from math import isfinite
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control.null_space_saturation import BLOCKED, Detour, detour, sidestep
from manip_learn.control.policies.manipulability_ascent import ManipulabilityAscent
from manip_learn.control.policies.policy import NullSpacePolicy
from manip_learn.control.policies.zero_policy import ZeroPolicy
from manip_learn.control.tasks.hold import Hold
from manip_learn.control.tasks.task import Task
from manip_learn.control.velocity_limits import VelocityRoom
from manip_learn.errors import ConfigurationError, ConstraintError, TargetError
from manip_learn.linalg import Inverse, inverse_singular_values, matlab_tolerance, row_inverse, svd
from manip_learn.robot.robot import Robot

# worst first: a command has one status, the gravest thing that was done to it
STATUSES = ("singular", "position-limited", "velocity-limited", "damped", "rerouted", "null-scaled", "ok")


@final
class Command(NamedTuple):
    """What the controller asks for at one instant.

    Attributes:
        velocity: u, shape (nv,) [rad/s or m/s], finite and within the limits.
        status: The gravest thing that was done: `"ok"`; `"null-scaled"`: the null-space part was shortened to the room
            that the task left, or done without joints at a limit; `"rerouted"`: joints at a position limit were led
            round it by null-space motion, the task goes on at full speed; `"damped"`: the task part was damped near a
            singularity; `"velocity-limited"`, `"position-limited"`: the task was slowed down for a limit;
            `"singular"`: a task direction is lost.
        manipulability: mu(q).
        task_velocity: b, shape (s,), as the task wanted it.
        task_part: A^+ b as commanded, shape (nv,).
        null_part: N pi as commanded, shape (nv,), and what leads joints round their position limits; A null_part = 0.
        task_scale: Share of the task velocity that is commanded, 0 to 1.
        null_scale: Share of the null-space velocity that is commanded, 0 to 1.
        smallest_singular_value: Of A(q).
    """

    velocity: Float[np.ndarray, " nv"]
    status: str
    manipulability: float
    task_velocity: Float[np.ndarray, " s"]
    task_part: Float[np.ndarray, " nv"]
    null_part: Float[np.ndarray, " nv"]
    task_scale: float
    null_scale: float
    smallest_singular_value: float


@final
class ResolvedRateController:
    """u = A^+ b + N pi, equation (2) of Manavalan and Howard, with limits.

    N is always the exact projector. The task part is damped only where a singular value is below `threshold`. The task
    part is slowed down as a whole at the limits (clipping joint by joint would bend the task's direction), and the
    null-space part is then shortened to the room that is left. Where a position limit would slow the task down, the
    null space leads the joints round it first, as far as it can.

    Args:
        constraint: A(q).
        task: b(q, t); None holds still (b = 0).
        null_policy: pi(q, t); None is zero.
        inverse: `"damped"` for a real arm; `"exact"` or `"truncated"` (Matlab's tolerance) as in the paper.
        threshold: Singular value of A at which damping sets in, in the constraint's units (m or 1).
        damping: Damping factor at a singular value of 0.
        limits: False ignores the joint limits and the room for the null-space part (the paper's law, bare).
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
        self.constraint = constraint
        self.task: Task = task or Hold()
        self.null_policy: NullSpacePolicy = null_policy or ZeroPolicy(constraint.nv)
        self.inverse: Inverse = inverse
        self.threshold = float(threshold)
        self.damping = float(damping)
        self.limits = bool(limits)
        self.dt = float(dt)
        self.robot: Robot | None = robot or getattr(constraint.features, "robot", None)
        self._room = VelocityRoom(self.robot) if self.limits and self.robot is not None else None
        self._features_check = self.robot is not None and self.robot is getattr(constraint.features, "robot", None)
        ours = isinstance(self.null_policy, ManipulabilityAscent) and self.null_policy.constraint is constraint
        self._ascent: ManipulabilityAscent | None = self.null_policy if ours else None  # type: ignore[assignment]

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
        if dt is not None and not 0.0 < dt < math.inf:
            raise ConfigurationError(f"dt must be a positive number of seconds, got {dt!r}")
        if not (self._features_check and type(q) is np.ndarray and q.dtype.char == "d"):
            q = self._checked_posture(q)
        ascent = self._ascent
        if ascent is None:
            A, vjp = self.constraint(q), _not_needed
        else:  # one Hessian and one inverse serve the task and the policy
            A, vjp = self.constraint.value_and_vjp(q)
        b = self._checked(self.task.velocity(self.constraint, q, t), A.shape[0], "the task's velocity b")
        inverse = row_inverse(A)
        if inverse is not None and (self.inverse != "damped" or inverse[2] >= self.threshold):
            # nothing to damp or to drop, the case of nearly every step: A^{+T} b and pi - A^+ A pi as they stand
            X, mu, smallest = inverse
            pi = self._policy(q, t) if ascent is None else ascent.from_inverse(X, mu, vjp)
            return self._limited(q, dt, A, b, b.dot(X), pi - A.dot(pi).dot(X), mu, smallest, False)
        U, sigma, Vt = svd(A)
        if ascent is None:
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
        if singular and ascent is not None and self._room is not None:
            # at a singularity mu climbs both ways: a limit in one way is no reason to stay
            ways = [self._room.shares(q, dt or self.dt, task_part, way).null for way in (null_part, -null_part)]
            null_part = null_part if ways[0] >= ways[1] else -null_part
        return self._limited(q, dt, A, b, task_part, null_part, mu, smallest, singular)

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

    def _limited(
        self,
        q: np.ndarray,
        dt: float | None,
        A: np.ndarray,
        b: np.ndarray,
        task_part: np.ndarray,
        null_part: np.ndarray,
        mu: float,
        smallest: float,
        singular: bool,
    ) -> Command:
        task_scale = null_scale = 1.0
        position_bound = False
        way_round: Detour | None = None
        if self._room is not None:
            task_scale, null_scale, position_bound = self._room.shares(q, dt or self.dt, task_part, null_part)
            if position_bound:
                bounds = self._room.bounds(q, dt or self.dt)
                way_round = detour(task_part, null_part, A, *bounds, task_scale)
            if way_round is not None:
                task_scale, null_part, null_scale = way_round
            elif task_scale == 1.0 and null_scale < BLOCKED:
                null_part, null_scale = sidestep(task_part, null_part, A, *self._room.bounds(q, dt or self.dt))
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
            status = "singular"
        elif task_scale < 1.0:
            status = "position-limited" if position_bound else "velocity-limited"
        elif self.inverse == "damped" and smallest < self.threshold:
            status = "damped"
        elif way_round is not None:
            status = "rerouted"
        else:
            status = "null-scaled" if null_scale < 1.0 else "ok"
        return Command(velocity, status, mu, b, task_part, null_part, task_scale, null_scale, smallest)

    def __repr__(self) -> str:
        return (
            f"ResolvedRateController({self.constraint!r}, task={self.task!r}, null_policy={self.null_policy!r}, "
            f"inverse={self.inverse!r})"
        )


def _not_needed(weights: np.ndarray) -> np.ndarray:
    raise NotImplementedError
