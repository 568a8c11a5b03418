"""Many rollouts of one controller at once: one step of all arms is a few NumPy calls.

Arms near a singularity, tasks and policies that are not the library's are asked one by one, so that every rollout is
the one that `simulate` gives for its start alone (to 1e-10).
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.manipulability_batch import row_inverses
from manip_learn.control.compiled.compiled_controller import CompiledController, why_not
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.null_space_saturation import BLOCKED
from manip_learn.control.policies.joint_attractor import JointAttractor
from manip_learn.control.policies.manipulability_ascent import ManipulabilityAscent
from manip_learn.control.policies.zero_policy import ZeroPolicy
from manip_learn.control.tasks.hold import Hold
from manip_learn.control.tasks.point_attractor import PointAttractor
from manip_learn.control.velocity_limits import NEGLIGIBLE
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.batch.postures import checked_postures, positions_of
from manip_learn.robot.robot import Robot

TOGETHER_FROM = 16  # starts: fewer do not share NumPy's calls enough
COMPILED_FROM = 20_000  # control steps: fewer are not worth loading the compiled kernels
STATUSES = np.array(["ok", "null-scaled", "velocity-limited", "position-limited"], dtype=object)


@final
class BatchCommand(NamedTuple):
    """What the controller asks of n arms at one instant: velocity (n, nv), mu (n,), distance to go (n,), words (n,)."""

    velocity: Float[np.ndarray, "n nv"]
    mu: Float[np.ndarray, " n"]
    error: Float[np.ndarray, " n"]
    status: np.ndarray


@final
class BatchRun(NamedTuple):
    """Rollouts of n arms over T samples: postures (n, T, width), u (n, T, nv), mu, error and words (n, T)."""

    q: Float[np.ndarray, "n T width"]
    u: Float[np.ndarray, "n T nv"]
    mu: Float[np.ndarray, "n T"]
    error: Float[np.ndarray, "n T"]
    status: np.ndarray


def run_batch(
    robot: Robot,
    controller: ResolvedRateController,
    starts: ArrayLike,
    steps: int,
    dt: float,
    method: str = "euler",
    *,
    compiled: bool | None = None,
) -> BatchRun:
    """Roll a controller out from many starts.

    Args:
        robot: The controller's robot; none of its joints may be a floating or planar base.
        controller: What commands it.
        starts: Postures, one a row; the results are the same kind of vector.
        steps: Number of steps.
        dt: [s].
        method: `"euler"` or `"rk4"`, as in `simulate`.
        compiled: Use the compiled controller; None: if it can be, numba is installed, and there are many steps.

    Raises:
        ConfigurationError: A start has the wrong size or is not finite; names its row and joint.
        ConstraintError: `compiled=True` and the controller cannot be compiled.
        MissingExtraError: `compiled=True` without numba.
    """
    postures = checked_postures(robot, starts)
    q = np.array(positions_of(robot, postures))
    n, T = len(q), steps + 1
    if compiled or (compiled is None and _compiles(controller, n * T, method)):
        engine = CompiledController(controller)
        rows = [engine.rollout(start, steps, dt, method) for start in q]
        run = BatchRun(
            np.array([row.q for row in rows]),
            np.array([row.u for row in rows]),
            np.array([row.mu for row in rows]),
            np.array([row.error for row in rows]),
            np.array([row.status for row in rows], dtype=object).reshape(n, T),
        )
    else:
        run = _stepped(BatchController(controller), q, steps, dt, method)
    if postures.shape[1] == robot.nv:
        return run
    return run._replace(q=np.array([[robot.configuration(x) for x in row] for row in run.q]))


def pays(controller: ResolvedRateController, n: int, steps: int, method: str) -> bool:
    """Whether n rollouts together are faster than one after the other."""
    return n >= TOGETHER_FROM or _compiles(controller, n * (steps + 1), method)


def _compiles(controller: ResolvedRateController, samples: int, method: str) -> bool:
    many = samples * (4 if method == "rk4" else 1) >= COMPILED_FROM
    return many and find_spec("numba") is not None and why_not(controller) is None


def _stepped(controller: BatchController, q: np.ndarray, steps: int, dt: float, method: str) -> BatchRun:
    (n, nv), T = q.shape, steps + 1
    run = BatchRun(
        np.empty((n, T, nv)), np.empty((n, T, nv)), np.empty((n, T)), np.empty((n, T)), np.empty((n, T), dtype=object)
    )
    for i in range(T):
        t = i * dt
        command = controller(q, t, dt)
        run.q[:, i] = q
        run.u[:, i], run.mu[:, i], run.error[:, i], run.status[:, i] = command
        if i == steps:
            break
        k1 = command.velocity
        if method == "euler":
            q = q + dt * k1
            continue
        k2 = controller(q + 0.5 * dt * k1, t + 0.5 * dt, dt).velocity
        k3 = controller(q + 0.5 * dt * k2, t + 0.5 * dt, dt).velocity
        k4 = controller(q + dt * k3, t + dt, dt).velocity
        q = q + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return run


@final
class BatchController:
    """The commands of a `ResolvedRateController` for many arms of one kind at a time.

    Args:
        controller: The controller of one arm.
    """

    def __init__(self, controller: ResolvedRateController):
        self.controller = controller
        policy = controller.null_policy
        same = isinstance(policy, ManipulabilityAscent) and policy.constraint is controller.constraint
        self._ascent: ManipulabilityAscent | None = policy if same else None  # type: ignore[assignment]

    def __call__(self, q: Float[np.ndarray, "n nv"], t: float = 0.0, dt: float | None = None) -> BatchCommand:
        """The commands at joint positions q [rad or m] and time t.

        Raises:
            ConfigurationError: Wrong size or not finite; names the first bad row and joint.
            TargetError: The task's target does not fit the constraint.
        """
        controller = self.controller
        dt = dt or controller.dt
        A, X, mu, one_by_one, pi = self._matrices(q)
        if controller.inverse == "damped":
            one_by_one = one_by_one | (_smallest(A, mu) < controller.threshold)
        if pi is None:
            pi = self._policy(q, t)
        b, error = self._task(q, t)
        task_part = np.einsum("sn,sjn->nj", b, X)
        null_part = pi - np.einsum("sn,sjn->nj", np.einsum("sjn,nj->sn", A, pi), X)
        velocity, status, blocked = self._limited(q, dt, task_part, null_part)
        one_by_one = one_by_one | blocked  # there may be a way round
        for i in np.flatnonzero(one_by_one | ~np.isfinite(velocity).all(axis=1)):
            command = controller(q[i], t, dt)
            velocity[i], mu[i], status[i] = command.velocity, command.manipulability, command.status
        return BatchCommand(velocity, mu, error, status)

    def _matrices(
        self, q: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Bool[np.ndarray, " n"], np.ndarray | None]:
        """A and A^{+T} (s, nv, n), mu, which of them are ill-conditioned, and pi if the policy climbs this mu."""
        constraint, ascent = self.controller.constraint, self._ascent
        shape = (constraint.n_constraints, constraint.nv, len(q))
        A, X, mu, ill = np.zeros(shape), np.zeros(shape), np.zeros(len(q)), np.ones(len(q), dtype=bool)
        if shape[0] > shape[1]:
            return A, X, mu, ill, np.zeros(q.shape)

        def weigh(Phi: np.ndarray, part: slice) -> np.ndarray:
            A[..., part] = np.tensordot(constraint.selection, Phi, axes=1)
            X[..., part], mu[part], ill[part] = row_inverses(A[..., part])
            return np.tensordot(constraint.selection.T, X[..., part], axes=1)

        if ascent is None:
            weigh(constraint.features.batch(q).transpose(1, 2, 0), slice(0, len(q)))
            return A, X, mu, ill, None
        gradient = constraint.features.batch_vjp(q, weigh)
        return A, X, mu, ill, gradient * (ascent.gain if ascent.logarithmic else ascent.gain * mu[:, None])

    def _policy(self, q: np.ndarray, t: float) -> np.ndarray:
        policy = self.controller.null_policy
        if isinstance(policy, ZeroPolicy):
            return np.zeros(q.shape)
        if isinstance(policy, JointAttractor) and policy.robot is None and policy.rest.shape == q.shape[1:]:
            return policy.gain * (policy.rest - q)
        return np.array([policy(row, t) for row in q]).reshape(q.shape)

    def _task(self, q: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray]:
        """B (s, n) and the distance to go (n,)."""
        task, constraint = self.controller.task, self.controller.constraint
        features = constraint.features
        if isinstance(task, Hold):
            return np.zeros((constraint.n_constraints, len(q))), np.zeros(len(q))
        if not (
            isinstance(task, PointAttractor)
            and isinstance(features, FrameJacobian)
            and features.only_linear
            and task.target.shape == (features.n_rows,)
        ):
            b = np.empty((constraint.n_constraints, len(q)))
            for i, row in enumerate(q):
                b[:, i] = task.velocity(constraint, row, t)
            return b, np.array([task.error(constraint, row, t) for row in q])
        places = ["xyz".index(name) for name in features.row_names]
        position = batch_kinematics(features.robot, features.frame).pose(q)[:, places, 3]
        displacement = constraint.selection @ (task.target - position).T
        error = np.sqrt(np.sum(displacement**2, axis=0))
        b = task.gain * displacement
        if task.max_speed is not None:
            speed = abs(task.gain) * error
            b *= np.divide(task.max_speed, speed, out=np.ones_like(speed), where=speed > task.max_speed)
        return b, error

    def _limited(
        self, q: np.ndarray, dt: float, task_part: np.ndarray, null_part: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The velocities within the limits, what was done, and which are blocked: `VelocityRoom` for many arms."""
        robot, n = self.controller.robot, len(q)
        if not self.controller.limits or robot is None:
            return task_part + null_part, STATUSES[np.zeros(n, dtype=int)], np.zeros(n, dtype=bool)
        limit = robot.velocity_limit
        low = np.maximum(-limit, np.minimum((robot.position_lower - q) / dt, 0.0))
        high = np.minimum(limit, np.maximum((robot.position_upper - q) / dt, 0.0))
        ratio = _ratio(np.where(task_part > 0.0, high, -low), np.abs(task_part))
        binding = np.argmin(ratio, axis=1)
        task = np.minimum(1.0, ratio[np.arange(n), binding])[:, None]
        bound = np.where(task_part > 0.0, high, -low)[np.arange(n), binding]
        used = task * task_part
        left = np.maximum(np.where(null_part > 0.0, high - used, used - low), 0.0)
        null = np.minimum(1.0, np.min(_ratio(left, np.abs(null_part)), axis=1))[:, None]
        slowed = np.where(bound < limit[binding], 3, 2)
        code = np.where(task[:, 0] < 1.0, slowed, np.where(null[:, 0] < 1.0, 1, 0))
        blocked = (code == 3) | ((task[:, 0] == 1.0) & (null[:, 0] < BLOCKED))
        return used + null * null_part, STATUSES[code], blocked


def _ratio(room: np.ndarray, speed: np.ndarray) -> np.ndarray:
    return np.divide(room, speed, out=np.full(speed.shape, np.inf), where=speed > NEGLIGIBLE)


def _smallest(A: Float[np.ndarray, "s nv n"], mu: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Smallest singular values."""
    G = np.einsum("ijn,kjn->nik", A, A)
    if A.shape[0] == 1:
        return mu
    if A.shape[0] == 2:
        largest = 0.5 * (G[:, 0, 0] + G[:, 1, 1]) + np.hypot(0.5 * (G[:, 0, 0] - G[:, 1, 1]), G[:, 0, 1])
        return np.divide(mu, np.sqrt(largest), out=np.zeros_like(mu), where=largest > 0.0)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(G)[:, 0], 0.0))
