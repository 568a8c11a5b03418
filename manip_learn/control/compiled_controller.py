"""A controller whose step is compiled (the optional extra `fast`): the same commands, several times faster."""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.control.command import Command
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.integration import Method, next_posture
from manip_learn.control.outcome import next_slide
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, ZeroPolicy
from manip_learn.control.status import STATUSES, Status
from manip_learn.control.tasks import Hold, PointAttractor
from manip_learn.errors import ConstraintError, MissingExtraError
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.robot import Robot

LARGEST_ACCELERATION = 1e12  # [rad/s2] stands for none in the kernel, which must stay finite


@final
class CompiledRollout(NamedTuple):
    """Samples of a rollout: joint positions [rad or m], velocities [rad/s or m/s], mu, task error and status."""

    q: Float[np.ndarray, "T nv"]
    u: Float[np.ndarray, "T nv"]
    mu: Float[np.ndarray, " T"]
    error: Float[np.ndarray, " T"]
    status: tuple[Status, ...]


@final
class CompiledController:
    """The commands of a `ResolvedRateController`, computed by compiled code.

    For rows of a frame's Jacobian, a chain of revolute, continuous and prismatic joints, the tasks `Hold` and
    `PointAttractor` (along x, y, z of the base), and a policy of the library. Near singularities and at position limits
    the original controller computes the command, so that the numbers are the same everywhere (to 1e-12 of the largest).

    Args:
        controller: What is compiled; later changes of its attributes are not seen.

    Raises:
        ConstraintError: This combination is not compiled; says which part.
        MissingExtraError: numba is not installed.
    """

    def __init__(self, controller: ResolvedRateController):
        reason = why_not(controller)
        if reason is not None:
            raise ConstraintError(f"this controller cannot be compiled: {reason}; use it as it is")
        if find_spec("numba") is None:
            raise MissingExtraError("a compiled controller", "fast")
        from manip_learn.control import kernel

        self.controller = controller
        self.robot: Robot = controller.robot  # type: ignore[assignment]
        self.nv, self._s = self.robot.nv, controller.constraint.n_constraints
        self._dt = controller.dt
        self._unknown = np.full(self.nv, np.nan)  # the velocity before, where no acceleration is bounded
        self._kernel = kernel
        self._step = kernel.control_step
        self._constants = _packed(controller)
        self._shape = kernel.results_shape(int(self._constants[0, kernel.N_JOINTS]), self.nv, self._s)
        self(self.robot.neutral())  # compiled, or read from the cache, now and not in the loop

    def __call__(
        self,
        q: ArrayLike,
        t: float = 0.0,
        dt: float | None = None,
        previous: Float[np.ndarray, " nv"] | None = None,
        slide: float = 0.0,
    ) -> Command:
        """The command at posture q; arguments and errors as for `ResolvedRateController`."""
        if not (type(q) is np.ndarray and q.shape == (self.nv,) and q.dtype == np.float64 and q.flags.c_contiguous):
            q = self.robot.positions(q)
        out, nv = np.empty(self._shape), self.nv
        before = self._unknown if previous is None else previous
        code = self._step(self._constants, q, self._dt if dt is None else dt, before, out)
        if code < 0:
            return self.controller(q, t, dt, previous, slide)
        mu, smallest = out[4, :2].tolist()
        parts = (out[3, : self._s], out[1, :nv], out[2, :nv])
        return Command(out[0, :nv], STATUSES[code], mu, *parts, 1.0, 1.0, smallest)

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Distance to the task's goal along the constrained rows [m or rad]."""
        return self.controller.task_error(q, t)

    def rollout(
        self, start: Float[np.ndarray, " nv"], steps: int, dt: float, method: Method = "euler"
    ) -> CompiledRollout:
        """The start and `steps` steps after it, in compiled code except near singularities and at limits.

        Args:
            start: Joint positions [rad or m].
            steps: Number of steps.
            dt: [s].
            method: `"euler"` or `"rk4"`, as in `simulate`.

        Raises:
            ConfigurationError: A posture is not finite.
        """
        T, nv = steps + 1, self.nv
        q, u, mu, error = np.empty((T, nv)), np.empty((T, nv)), np.empty(T), np.empty(T)
        code, work = np.zeros(T, dtype=np.int64), (np.empty(self._shape), np.empty(nv), np.empty(nv))
        bounded = method == "euler" and self.controller.limits is not None
        previous = np.zeros(nv) if bounded else np.full(nv, np.nan)
        q[0] = start
        by_python: dict[int, Status] = {}
        row, kernel, slide = 0, self._kernel, 0.0
        while row < T:
            row = kernel.rollout(self._constants, row, dt, method == "rk4", q, u, mu, error, code, *work, previous)
            if row < T:
                command = self.controller(q[row], row * dt, dt, previous if bounded else None, slide)
                slide = next_slide(slide, command, dt) if bounded else 0.0
                u[row], mu[row], by_python[row] = command.velocity, command.manipulability, command.status
                error[row] = self.controller.task_error(q[row], row * dt)
                if bounded:
                    previous[:] = command.velocity
                if row + 1 < T:
                    q[row + 1] = next_posture(None, self.controller, q[row], row * dt, dt, method, command.velocity)
                row += 1
        status = tuple(by_python.get(i) or STATUSES[c] for i, c in enumerate(code.tolist()))
        return CompiledRollout(q, u, mu, error, status)

    def __repr__(self) -> str:
        return f"CompiledController({self.controller!r})"


def why_not(controller: ResolvedRateController) -> str | None:
    """Why a controller cannot be compiled; None if it can where numba is installed."""
    features, task, policy = controller.constraint.features, controller.task, controller.null_policy
    if not isinstance(features, FrameJacobian):
        return f"the features are {type(features).__name__}, not FrameJacobian"
    kinematics = batch_kinematics(features.robot, features.frame)
    if not kinematics.fast or kinematics.public_columns is None:
        return (
            "not all joints between the base and the frame are revolute, continuous or prismatic ones that move freely"
        )
    if controller.robot is not features.robot:
        return "its limits are those of another robot"
    if any(b.kind in ("floating", "planar", "other") for b in features.robot.blocks):
        return "the robot's base moves"
    if controller.constraint.n_constraints > len(kinematics.public_columns):
        return "it has more rows than joints"
    reaches = isinstance(task, PointAttractor) and features.only_linear and task.target.shape == (features.n_rows,)
    if not (reaches or isinstance(task, Hold)):
        return f"the task is {task!r} with rows {' '.join(features.row_names)} ({features.reference})"
    if isinstance(policy, ManipulabilityAscent):
        return None if policy.constraint is controller.constraint else "the policy climbs another constraint's mu"
    if isinstance(policy, JointAttractor):
        known = policy.robot is features.robot or (policy.robot is None and policy.rest.shape == (features.nv,))
        return None if known else "the rest posture belongs to another robot"
    return None if isinstance(policy, ZeroPolicy) else f"the policy is {type(policy).__name__}"


def _packed(controller: ResolvedRateController) -> Float[np.ndarray, "rows 12"]:
    """All constants of the step in one table: one argument costs less than thirty."""
    from manip_learn.control import kernel

    constraint, task = controller.constraint, controller.task
    features: FrameJacobian = constraint.features  # type: ignore[assignment]
    chain = batch_kinematics(features.robot, features.frame).chain_table(features.reference)
    rows = np.zeros((constraint.n_constraints, chain.shape[1]))
    rows[:, :6] = features.padded(constraint.selection)
    dofs = np.zeros((constraint.nv, chain.shape[1]))
    limits = controller.limits
    if limits is not None:
        dofs[:, :3] = np.stack((limits.velocity, limits.lower, limits.upper), axis=1)
        dofs[:, kernel.ACCELERATION] = np.minimum(limits.acceleration, LARGEST_ACCELERATION)
    header = np.zeros((1, chain.shape[1]))
    header[0, kernel.N_JOINTS] = chain.shape[0] - kernel.JOINTS
    header[0, kernel.NV], header[0, kernel.N_CONSTRAINTS] = constraint.nv, constraint.n_constraints
    header[0, kernel.DAMPS], header[0, kernel.THRESHOLD] = controller.inverse == "damped", controller.threshold
    header[0, kernel.LIMITS] = limits is not None
    if isinstance(task, PointAttractor):
        header[0, kernel.REACHES], header[0, kernel.GAIN] = True, task.gain
        header[0, kernel.MAX_SPEED] = np.inf if task.max_speed is None else task.max_speed
        places = [kernel.TARGET_POINT + "xyz".index(name) for name in features.row_names]
        chain[1, places] = task.target
    _pack_policy(controller, header[0], dofs)
    return np.concatenate([header, chain, dofs, rows])


def _pack_policy(controller: ResolvedRateController, header: np.ndarray, dofs: np.ndarray) -> None:
    from manip_learn.control import kernel

    policy = controller.null_policy
    header[kernel.POLICY] = kernel.NO_POLICY
    if isinstance(policy, ManipulabilityAscent):
        header[kernel.POLICY] = kernel.LOG_ASCENT if policy.logarithmic else kernel.ASCENT
        header[kernel.POLICY_GAIN] = policy.gain
        header[kernel.LONGEST] = np.inf if policy.max_speed is None else policy.max_speed
    elif isinstance(policy, JointAttractor):
        header[kernel.POLICY], header[kernel.POLICY_GAIN] = kernel.REST, policy.gain
        dofs[:, kernel.REST_AT] = controller.robot.positions(policy.rest)  # type: ignore[union-attr]
        for block in policy.robot.blocks if policy.robot is not None else ():
            dofs[block.v, kernel.WRAPS] = block.kind == "continuous"
