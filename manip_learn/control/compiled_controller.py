"""A controller whose step is compiled (the optional extra `fast`): the same commands, several times faster."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian
from manip_learn.constraint.features.pose_error import goal_rotation
from manip_learn.constraint.features.weighed_velocity import WeighedVelocity, compiled_form
from manip_learn.control.command import Command, Controller
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.integration import Method, next_posture
from manip_learn.control.limits import limit_table
from manip_learn.control.outcome import (
    ESCAPE_PART,
    NULL_PART,
    PARTS,
    TASK_PART,
    TASK_VELOCITY,
    VELOCITY,
    next_slide,
)
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, ZeroPolicy
from manip_learn.control.status import STATUSES, Status
from manip_learn.control.tasks import Hold, PointAttractor
from manip_learn.errors import ConstraintError, MissingExtraError
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix

__all__ = ["CompiledController", "CompiledRollout", "compiled_if_possible", "why_not"]

_DOUBLE = np.dtype(np.float64)  # in the byte order of the machine
# looked up at every step
_INFINITY = math.inf
_array, _empty, _contiguous = np.ndarray, np.empty, np.ascontiguousarray
_WORDS = np.array(STATUSES, dtype=object)


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

    For rows of a frame's Jacobian and for doors, tethers, screws and all that `MechanismRows` and `PlaceRows` hold, a
    chain of revolute, continuous and prismatic joints, the tasks `Hold` and, for rows of a frame's Jacobian,
    `PointAttractor` (positions, poses and whole rotations, along the axes of the base or of the frame), and a
    `ManipulabilityAscent` of the same constraint, a `JointAttractor` or no policy; in every state, at limits and at
    singularities too. (For all others there is the original's solver `"compiled"`.) The original controller computes
    the command only where the posture or the velocity is not finite, where a direction is lost that the inverse
    `"exact"` cannot invert, and where several are lost at once under a policy without a bound. The numbers are the same
    everywhere (to 1e-12 of the largest, to 1e-9 at limits).

    The first one on a machine takes about a minute, which it says through the logger `manip_learn`; the machine
    code is kept on disk.

    Args:
        controller: What is compiled; later changes of its attributes are not seen.
        report: Called with a sentence where the code has to be compiled first.

    Raises:
        ConstraintError: This combination is not compiled; says which part.
        MissingExtraError: numba is not installed.
    """

    def __init__(self, controller: ResolvedRateController, report: Callable[[str], object] | None = None):
        reason = why_not(controller)
        if reason is not None:
            raise ConstraintError(
                f"this controller cannot be compiled: {reason}; use it as it is, or "
                "controller.with_solver('compiled'), which compiles what keeps the limits"
            )
        if find_spec("numba") is None:
            raise MissingExtraError("a compiled controller", "fast")
        from manip_learn.control.compiled_step import commands
        from manip_learn.robot.batch.kernel_cache import announce_compilation, entry_point

        self.controller = controller
        self.robot: Robot = controller.robot  # type: ignore[assignment]
        self.nv, s = self.robot.nv, controller.constraint.n_constraints
        unknown = np.full(self.nv, np.nan)  # the velocity before, where no acceleration is bounded
        self._constants = packed(controller)
        shape = (PARTS, self.nv)
        announce_compilation(commands, report)
        # compiled, or read from the cache, now and not in the loop
        nothing = np.empty((0, self.nv)), np.empty(0), np.empty(0), np.empty(0, np.int64)
        example = np.zeros((1, self.nv)), controller.dt, False, 0, unknown, 0.0, np.empty(shape), *nothing
        self._commands = step = entry_point(commands, self._constants, *example)
        # what a call looks up, in one place
        self._known = (step, self._constants, (self.nv,), shape, unknown, controller.dt, nothing, s)

    def __call__(
        self,
        q: ArrayLike,
        t: float = 0.0,
        dt: float | None = None,
        previous: Float[np.ndarray, " nv"] | None = None,
        slide: float = 0.0,
    ) -> Command:
        """The command at posture q; arguments and errors as for `ResolvedRateController`."""
        step, constants, size, shape, before, held, nothing, s = self._known
        if type(q) is _array and q.shape == size and q.dtype is _DOUBLE:
            x = _contiguous(q)
        else:
            x = _contiguous(self.robot.positions(q), np.float64)
        if dt is not None:
            held = dt
        if previous is not None:
            before = _contiguous(previous, np.float64)
            if before.shape != size:
                return self.controller(q, t, dt, previous, slide)
        if not 0.0 < held < _INFINITY:
            return self.controller(q, t, dt, previous, slide)
        parts = _empty(shape)
        row, _, code, mu, smallest, task_scale, null_scale, progress, outside, joint, escapes, _ = step(
            constants, x[None], held, False, 0, before, slide, parts, *nothing
        )
        if row == 0:
            return self.controller(q, t, dt, previous, slide)
        velocity, task, null, b = parts[VELOCITY], parts[TASK_PART], parts[NULL_PART], parts[TASK_VELOCITY, :s]
        return Command(
            velocity=velocity,
            status=STATUSES[code],
            manipulability=mu,
            task_velocity=b,
            task_part=task,
            null_part=null,
            task_scale=task_scale,
            null_scale=null_scale,
            smallest_singular_value=smallest,
            escape_part=parts[ESCAPE_PART] if escapes else None,
            progress=progress,
            outside=outside,
            limiting_joint=joint,
        )

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Distance to the task's goal along the constrained rows [m or rad]."""
        return self.controller.task_error(q, t)

    def rollout(
        self, start: Float[np.ndarray, " nv"], steps: int, dt: float, method: Method = "euler"
    ) -> CompiledRollout:
        """The start and `steps` steps after it, in compiled code.

        With limits and the method `"euler"` the velocity starts from rest and changes within the acceleration limits,
        as in a `ServoLoop` without jerk limits.

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
        code = np.zeros(T, dtype=np.int64)
        bounded = method == "euler" and self.controller.limits is not None
        before, slide, parts = np.zeros(nv) if bounded else np.full(nv, np.nan), 0.0, np.empty(self._known[3])
        q[0] = start
        row = 0
        while row < T:
            log = parts, u, mu, error, code
            row, slide, *_ = self._commands(self._constants, q, dt, method == "rk4", row, before, slide, *log)
            if row < T:
                command = self.controller(q[row], row * dt, dt, before if bounded else None, slide)
                u[row], mu[row], code[row] = command.velocity, command.manipulability, STATUSES.index(command.status)
                error[row] = self.controller.task_error(q[row], row * dt)
                if bounded:
                    before[:], slide = command.velocity, next_slide(slide, command, dt)
                if row + 1 < T:
                    q[row + 1] = next_posture(None, self.controller, q[row], row * dt, dt, method, command.velocity)
                row += 1
        return CompiledRollout(q, u, mu, error, tuple(_WORDS[code].tolist()))

    def __reduce__(self) -> tuple[object, ...]:
        return CompiledController, (self.controller,)  # machine code stays in its process

    def __repr__(self) -> str:
        return f"CompiledController({self.controller!r})"


def why_not(controller: ResolvedRateController) -> str | None:
    """Why a controller cannot be compiled; None if it can where numba is installed.

    Children of the classes that are compiled are not: what they change would be lost.
    """
    constraint, task, policy = controller.constraint, controller.task, controller.null_policy
    features = constraint.features
    if type(features) is not FrameJacobian and not isinstance(features, WeighedVelocity):
        return f"the features are {type(features).__name__}, not rows of one frame seen from the base or from itself"
    kinematics = batch_kinematics(features.robot, features.frame)
    if not kinematics.fast or kinematics.public_columns is None:
        return (
            "not all joints between the base and the frame are revolute, continuous or prismatic ones that move freely"
        )
    if controller.robot is not features.robot:
        return "its limits are those of another robot"
    if controller.limits is not None and controller.limits.tip is not None:
        return "the speed of frames is limited"
    if any(b.kind in ("floating", "planar", "other") for b in features.robot.blocks):
        return "the robot's base moves"
    if constraint.n_constraints > len(kinematics.public_columns):
        return "it has more rows than joints"
    known = type(task) is Hold
    if type(task) is PointAttractor and isinstance(features, FrameJacobian):
        known = _is_packed(features, constraint.n_constraints, task.target)
    if not known:
        reference = getattr(features, "reference", type(features).__name__)
        return f"the task is {task!r} with rows {' '.join(features.row_names)} ({reference})"
    if type(policy) is ManipulabilityAscent:
        return None if policy.constraint is constraint else "the policy climbs another constraint's mu"
    if type(policy) is JointAttractor:
        known = policy.robot is features.robot or (policy.robot is None and policy.rest.shape == (features.nv,))
        return None if known else "the rest posture belongs to another robot"
    return None if type(policy) is ZeroPolicy else f"the policy is {type(policy).__name__}"


def packed(controller: ResolvedRateController) -> tuple[Any, ...]:
    """What the compiled step is made of, `compiled_step.Constants`."""
    from manip_learn.control.compiled_posture import HOLD, POINT, POSE  # and with it numba
    from manip_learn.control.compiled_step import Constants
    from manip_learn.robot.batch.compiled_kinematics import JOINTS

    constraint, limits, task, policy = controller.constraint, controller.limits, controller.task, controller.null_policy
    features: FrameJacobian = constraint.features  # type: ignore[assignment]  # or rows weighed by the place
    weights, form, reference = compiled_form(features, constraint.selection)  # type: ignore[misc]  # `why_not` has asked
    chain = batch_kinematics(features.robot, features.frame).chain_table(reference)
    free, rest, wraps = np.full(constraint.nv, np.inf), np.zeros(constraint.nv), np.zeros(constraint.nv)
    table = limit_table(-free, free, free, free, controller.dt) if limits is None else limits.table(controller.dt)
    if isinstance(policy, JointAttractor):
        rest = controller.robot.positions(policy.rest)  # type: ignore[union-attr]
        for block in policy.robot.blocks if policy.robot is not None else ():
            wraps[block.v] = block.kind == "continuous"
    place, turn, kind, gain, max_speed = np.zeros(3), np.eye(3), HOLD, 0.0, math.inf
    if isinstance(task, PointAttractor):
        place, turn = _target(features, constraint.selection, task.target)
        kind, gain = POINT if features.only_linear else POSE, task.gain
        max_speed = math.inf if task.max_speed is None else task.max_speed
    arrays = chain, weights, *table[:7], rest, wraps, place, turn
    return Constants(
        settings=controller.settings,
        form=int(form),
        s=constraint.n_constraints,
        nv=constraint.nv,
        joints=chain.shape[0] - JOINTS,
        kind=kind,
        gain=float(gain),
        max_speed=float(max_speed),
        rest_gain=policy.gain if isinstance(policy, JointAttractor) else 0.0,
        dt=controller.dt,
        weakest=float(table.weakest),
        numbers=np.concatenate([array.reshape(-1) for array in arrays]),
    )


def _target(features: FrameJacobian, selection: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Place and rotation of the target, in the frame in which the chain is walked.

    What a target of numbers leaves open is taken as 0: no row of Lambda sees it.
    """
    if target.shape == (4, 4):
        place, turn = target[:3, 3], goal_rotation(target[:3, :3])
    else:
        numbers = target if target.shape == (features.n_rows,) else selection.T.dot(target)
        given = dict(zip(features.row_names, numbers.tolist(), strict=True))
        place, angles = (np.array([given.get(name, 0.0) for name in names]) for names in (AXES[:3], AXES[3:]))
        turn = rotation_matrix(angles)
    if features.only_linear:
        return place, turn
    walked = batch_kinematics(features.robot, features.frame).walked(features.reference)
    if features.reference == "local":
        return walked.tool_position + walked.tool_rotation.dot(place), walked.tool_rotation.dot(turn)
    return place, turn.dot(walked.tool_rotation.T)


def _is_packed(features: FrameJacobian, n_constraints: int, target: np.ndarray) -> bool:
    """Whether a target is fixed in the base by numbers or by a pose, all of whose rotation is given or none."""
    if target.shape == (4, 4) or (features.only_linear and target.shape == (n_constraints,)):
        return True
    whole = (0, 3)  # of x y z, and of rx ry rz
    linear = sum(name in "xyz" for name in features.row_names)
    turns = features.n_rows - linear in whole
    return target.shape == (features.n_rows,) and turns and (features.reference == "world" or linear in whole)


def compiled_if_possible(
    controller: Controller, compiled: bool | None, report: Callable[[str], object] | None = None
) -> Controller:
    """The controller, compiled where that can be done.

    Args:
        controller: Any controller.
        compiled: False: as it is; True: compiled. None: where numba is installed, compiled if it can be, and otherwise
            with compiled limits behind a law in Python (`ResolvedRateController`'s solver `"compiled"`).
        report: As for `CompiledController`.

    Raises:
        ConstraintError: True for a controller that cannot be compiled.
        MissingExtraError: True without numba.
    """
    if compiled is False or isinstance(controller, CompiledController):
        return controller
    if not isinstance(controller, ResolvedRateController):
        if compiled:
            raise ConstraintError(f"only a ResolvedRateController can be compiled, not {type(controller).__name__}")
        return controller
    if compiled is None and find_spec("numba") is None:
        return controller
    if compiled is None and why_not(controller) is not None:
        return controller.with_solver("compiled", report) if controller.solver == "qp" else controller
    return CompiledController(controller, report)
