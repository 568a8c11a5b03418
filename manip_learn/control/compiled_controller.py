"""A controller whose step is compiled (the optional extra `fast`): the same commands, several times faster."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.util import find_spec
from operator import itemgetter
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian, goal_rotation
from manip_learn.constraint.features.weighed_velocity import WeighedVelocity, compiled_form
from manip_learn.control.command import STATUSES, Command, Controller, Method, Status, next_posture
from manip_learn.control.compiled import step_table as table
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, ZeroPolicy
from manip_learn.control.resolved_rate_law import ESCAPE_WIDTH, next_slide
from manip_learn.control.tasks import FreeDirection, Hold, PointAttractor, Track
from manip_learn.errors import ConstraintError, MissingExtraError
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix

_DOUBLE = np.dtype(np.float64)  # in the byte order of the machine
# looked up at every step
_INFINITY = math.inf
_array, _empty, _contiguous, _new = np.ndarray, np.empty, np.ascontiguousarray, tuple.__new__
_ESCAPE_PART, _TASK_VELOCITY = table.ESCAPE_PART, table.TASK_VELOCITY
_WORDS = np.array(STATUSES, dtype=object)
FINITE_ACCELERATION = 1e12  # [rad/s2] stands for none in the kernel, which must stay finite


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
    tip = None if controller.limits is None else controller.limits.tip
    chains = [] if tip is None else [batch_kinematics(features.robot, frame) for frame in tip.frames]
    if not all(chain.fast and chain.public_columns is not None for chain in chains):
        return "the speed or the place of a frame is limited that other joints than revolute or prismatic ones move"
    if any(b.kind in ("floating", "planar", "other") for b in features.robot.blocks):
        return "the robot's base moves"
    if constraint.n_constraints > len(kinematics.public_columns):
        return "it has more rows than joints"
    known = type(task) is Hold
    if type(task) is PointAttractor and isinstance(features, FrameJacobian):
        known = _is_packed(features, constraint.n_constraints, task.target)
    if type(task) is FreeDirection:
        known = task.along_rows
    if type(task) is Track:  # elsewhere the rows of the error are others than those held
        known = isinstance(features, FrameJacobian) and features.only_linear
    if not known:
        reference = getattr(features, "reference", type(features).__name__)
        return f"the task is {task!r} with rows {' '.join(features.row_names)} ({reference})"
    if type(policy) is ManipulabilityAscent:
        return None if policy.constraint is constraint else "the policy climbs another constraint's mu"
    if type(policy) is JointAttractor:
        known = policy.robot is features.robot or (policy.robot is None and policy.rest.shape == (features.nv,))
        return None if known else "the rest posture belongs to another robot"
    return None if type(policy) is ZeroPolicy else f"the policy is {type(policy).__name__}"


def packed(controller: ResolvedRateController) -> Float[np.ndarray, "rows 12"]:
    """All constants of the step in one table: one argument costs less than thirty."""
    from manip_learn.robot.batch.compiled_kinematics import JOINTS  # and with it numba

    constraint, task = controller.constraint, controller.task
    features: FrameJacobian = constraint.features  # type: ignore[assignment]  # or rows weighed by the place
    rows, form, reference = compiled_form(features, constraint.selection)  # type: ignore[misc]  # `why_not` has asked
    chain = batch_kinematics(features.robot, features.frame).chain_table(reference)
    chain[1, table.FORM] = form
    header, dofs = np.zeros((table.CHAIN, table.WIDTH)), np.zeros((constraint.nv, table.WIDTH))
    header[0, table.INVERSE], header[0, table.THRESHOLD] = (
        table.INVERSES.index(controller.inverse),
        controller.threshold,
    )
    header[0, table.LIMITS] = controller.limits is not None
    if (limits := controller.limits) is not None:
        dofs[:, :3] = np.stack((limits.velocity, limits.lower, limits.upper), axis=1)
        dofs[:, table.ACCELERATION] = np.minimum(limits.acceleration, FINITE_ACCELERATION)
    header[0, table.N_JOINTS] = chain.shape[0] - JOINTS
    header[0, table.NV], header[0, table.N_CONSTRAINTS] = constraint.nv, constraint.n_constraints
    header[1, table.DAMPING], header[1, table.ESCAPE_WIDTH] = controller.damping, ESCAPE_WIDTH * controller.threshold
    if isinstance(task, PointAttractor):
        header[0, table.GAIN] = task.gain
        header[0, table.MAX_SPEED] = np.inf if task.max_speed is None else task.max_speed
        _pack_target(features, constraint.selection, task.target, header, chain)
    elif isinstance(task, FreeDirection | Track):
        header[0, table.TASK] = table.GIVEN
    _pack_policy(controller, header, dofs)
    constants = np.concatenate([header, chain, dofs, rows])
    if limits is None or (tip := limits.tip) is None:
        return constants
    numbers = np.zeros((1 + len(tip.walls), table.WIDTH))
    numbers[0, table.N_FRAMES], numbers[0, table.N_WALLS] = len(tip.frames), len(tip.walls)
    numbers[0, table.TIP_SPEED], numbers[1:, :4] = tip.speed, tip.walls
    chains = [batch_kinematics(limits.robot, frame).chain_table("world") for frame in tip.frames]
    for limited in chains:
        limited[1, table.LENGTH] = len(limited) - JOINTS
    constants[table.CHAIN + 1, table.TIPS] = len(constants)
    return np.concatenate([constants, numbers, *chains])


def _is_packed(features: FrameJacobian, n_constraints: int, target: np.ndarray) -> bool:
    """Whether a target is fixed in the base by numbers or by a pose, all of whose rotation is given or none."""
    if target.shape == (4, 4) or (features.only_linear and target.shape == (n_constraints,)):
        return True
    whole = (0, 3)  # of x y z, and of rx ry rz
    linear = sum(name in "xyz" for name in features.row_names)
    turns = features.n_rows - linear in whole
    return target.shape == (features.n_rows,) and turns and (features.reference == "world" or linear in whole)


def _pack_target(
    features: FrameJacobian, selection: np.ndarray, target: np.ndarray, header: np.ndarray, chain: np.ndarray
) -> None:
    """Place and rotation of the target as `free_step` takes them, in the frame in which the chain is walked.

    What a target of numbers leaves open is taken as 0: no row of Lambda sees it.
    """
    if target.shape == (4, 4):
        place, rotation = target[:3, 3], goal_rotation(target[:3, :3])
    else:
        numbers = target if target.shape == (features.n_rows,) else selection.T.dot(target)
        given = dict(zip(features.row_names, numbers.tolist(), strict=True))
        place, turn = (np.array([given.get(name, 0.0) for name in names]) for names in (AXES[:3], AXES[3:]))
        rotation = rotation_matrix(turn)
    header[0, table.TASK] = table.POINT
    if not features.only_linear:
        header[0, table.TASK] = table.POSE
        walked = batch_kinematics(features.robot, features.frame).walked(features.reference)
        if features.reference == "local":
            place = walked.tool_position + walked.tool_rotation.dot(place)
            rotation = walked.tool_rotation.dot(rotation)
        else:
            rotation = rotation.dot(walked.tool_rotation.T)
        header[1, table.GOAL :] = rotation.reshape(-1)
    chain[1, table.TARGET_POINT : table.TARGET_POINT + 3] = place


def _pack_policy(controller: ResolvedRateController, header: np.ndarray, dofs: np.ndarray) -> None:
    policy = controller.null_policy
    header[0, table.POLICY] = table.NO_POLICY
    if isinstance(policy, ManipulabilityAscent):
        header[0, table.POLICY] = table.LOG_ASCENT if policy.logarithmic else table.ASCENT
        header[0, table.POLICY_GAIN] = policy.gain
        header[0, table.LONGEST] = np.inf if policy.max_speed is None else policy.max_speed
        header[1, table.ESCAPES] = controller.inverse == "damped" and policy.max_speed is not None
    elif isinstance(policy, JointAttractor):
        header[0, table.POLICY], header[0, table.POLICY_GAIN] = table.REST, policy.gain
        dofs[:, table.REST_AT] = controller.robot.positions(policy.rest)  # type: ignore[union-attr]
        for block in policy.robot.blocks if policy.robot is not None else ():
            dofs[block.v, table.WRAPS] = block.kind == "continuous"


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
    chain of revolute, continuous and prismatic joints, the tasks `Hold`, `FreeDirection` (along positions and
    mechanisms) and `Track` (of positions in the base), whose b is computed in Python, once a call, and, for rows of a
    frame's Jacobian, `PointAttractor` (positions, poses and whole rotations, along the axes of the base or of the
    frame), and a `ManipulabilityAscent` of the same constraint, a `JointAttractor` or no policy; in every state, at
    limits and at singularities too. The original
    controller computes the command only where the posture or the velocity is not finite, where a direction is lost that
    the inverse `"exact"` cannot invert, and where several are lost at once under a policy without a bound. The numbers
    are the same everywhere (to 1e-12 of the largest, to 1e-9 at limits).

    The first one on a machine takes about a minute, which it says through the logger `manip_learn`; the machine
    code is kept on disk.

    Args:
        controller: What is compiled; later changes of its attributes are not seen.
        report: Called with a sentence where the code has to be compiled first.

    Attributes:
        rolls_out: Whether whole rollouts are compiled: not where b is computed in Python.

    Raises:
        ConstraintError: This combination is not compiled; says which part.
        MissingExtraError: numba is not installed.
    """

    def __init__(self, controller: ResolvedRateController, report: Callable[[str], object] | None = None):
        reason = why_not(controller)
        if reason is not None:
            raise ConstraintError(f"this controller cannot be compiled: {reason}; use it as it is")
        if find_spec("numba") is None:
            raise MissingExtraError("a compiled controller", "fast")
        from manip_learn.control.compiled.control_step import command_of, rollout
        from manip_learn.robot.batch.kernel_cache import announce_compilation, entry_point

        self.controller = controller
        self.robot: Robot = controller.robot  # type: ignore[assignment]
        self.nv, s = self.robot.nv, controller.constraint.n_constraints
        b = (table.TASK_VELOCITY, slice(0, s)) if s < self.nv else table.TASK_VELOCITY
        views = itemgetter(table.VELOCITY, table.TASK_PART, table.NULL_PART, b)
        unknown = np.full(self.nv, np.nan)  # the velocity before, where no acceleration is bounded
        self._constants, self._rollout = packed(controller), rollout
        self.rolls_out = self._constants[0, table.TASK] != table.GIVEN
        shape = (table.PARTS, self.nv)
        announce_compilation(command_of, report)
        # compiled, or read from the cache, now and not in the loop
        example = (np.zeros(self.nv), controller.dt, unknown, 0.0, np.zeros(shape))
        step = entry_point(command_of, self._constants, *example)
        # what a call looks up, in one place
        # tasks whose velocity is compiled slide
        given = None if self.rolls_out else (controller.task_velocity, s, controller.task.slides)
        self._known = (step, self._constants, (self.nv,), shape, unknown, controller.dt, views, given)

    def __call__(
        self,
        q: ArrayLike,
        t: float = 0.0,
        dt: float | None = None,
        previous: Float[np.ndarray, " nv"] | None = None,
        slide: float = 0.0,
    ) -> Command:
        """The command at posture q; arguments and errors as for `ResolvedRateController`."""
        step, constants, size, shape, before, held, views, given = self._known
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
        if given is not None:
            task_velocity, s, slides = given
            parts[_TASK_VELOCITY, :s] = task_velocity(q, t, held)
            slide = slide if slides else 0.0
        code, mu, smallest, scale, null_scale, progress, outside, joint, escapes = step(
            constants, x, held, before, slide, parts
        )
        if code < 0:
            return self.controller(q, t, dt, previous, slide)
        u, task, null, b = views(parts)
        # as `Command._make` does it, in half the time
        return _new(Command, (
            u, STATUSES[code], mu, b, task, null, scale, null_scale, smallest,
            parts[_ESCAPE_PART] if escapes else None, progress, outside, joint, 0.0,
        ))  # fmt: skip

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
            ConstraintError: b is computed in Python: `simulate` makes such rollouts, command by command.
        """
        if not self.rolls_out:
            raise ConstraintError(f"the velocity of {self.controller.task!r} is computed in Python: use simulate")
        T, nv = steps + 1, self.nv
        motion, numbers = np.empty((2, T, nv)), np.empty((3, T))
        (q, u), (mu, error, code) = motion, numbers
        bounded = method == "euler" and self.controller.limits is not None
        state = np.zeros(nv + 1)  # the velocity before, and the slide
        if not bounded:
            state[:nv] = np.nan
        q[0] = start
        row, before = 0, state[:nv]
        while row < T:
            row = self._rollout(self._constants, row, dt, method == "rk4", motion, numbers, state)
            if row < T:
                command = self.controller(q[row], row * dt, dt, before if bounded else None, float(state[nv]))
                u[row], mu[row], code[row] = command.velocity, command.manipulability, STATUSES.index(command.status)
                error[row] = self.controller.task_error(q[row], row * dt)
                if bounded:
                    stalls = command.status is Status.STALLED
                    before[:], state[nv] = command.velocity, next_slide(state[nv], stalls, command.progress, dt)
                if row + 1 < T:
                    q[row + 1] = next_posture(None, self.controller, q[row], row * dt, dt, method, command.velocity)
                row += 1
        return CompiledRollout(q, u, mu, error, tuple(_WORDS[code.astype(np.intp)].tolist()))

    def __reduce__(self) -> tuple[object, ...]:
        return CompiledController, (self.controller,)  # machine code stays in its process

    def __repr__(self) -> str:
        return f"CompiledController({self.controller!r})"


def compiled_if_possible(
    controller: Controller, compiled: bool | None, report: Callable[[str], object] | None = None
) -> Controller:
    """The controller, compiled where that can be done.

    Args:
        controller: Any controller.
        compiled: False: as it is; True: compiled. None: compiled where numba is installed and it can be.
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
    if compiled is None and (find_spec("numba") is None or why_not(controller) is not None):
        return controller
    return CompiledController(controller, report)
