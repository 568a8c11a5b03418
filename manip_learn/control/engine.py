"""The law compiled: `manip_learn_fast`, built from `fast/`, in the place of `law.Law` where it is installed.

It is never needed: the law in Python is the text, the compiled one follows it section by section and gives the same
numbers. What it does not know (rows, tasks and policies of users, ways) is computed in Python and handed in.
"""

from __future__ import annotations

import logging
import os
from functools import cache
from importlib import import_module
from typing import Any, final
from weakref import WeakKeyDictionary

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian, goal_rotation
from manip_learn.constraint.features.mechanism_rows import MechanismRows, PlaceRows
from manip_learn.control import policies
from manip_learn.control.command import Command, Status
from manip_learn.control.law import Law
from manip_learn.control.limits import Limits, farthest_positions
from manip_learn.control.tasks import Hold, PointAttractor, Task
from manip_learn.errors import TargetError
from manip_learn.robot.frame_kinematics import FrameKinematics
from manip_learn.robot.joints import Frame, motion_along
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix

_LOGGER = logging.getLogger("manip_learn")
LAW_VERSION = 1  # of the numbers that the law gives: fast/src/law.hpp has the same
MOST = 32  # rows, joints and walls that the compiled law has room for
PLAIN = ("revolute", "prismatic")  # joints whose positions add up
_chains: WeakKeyDictionary[FrameKinematics, dict[str, Any] | None] = WeakKeyDictionary()


@cache
def _compiled() -> tuple[Any, str]:
    """The compiled module, or None and why; says once what is wrong with one that is there."""
    try:
        module = import_module("manip_learn_fast")
        version = module.LAW_VERSION
    except Exception as error:  # whatever is wrong with it, the law in Python does the work
        reason = "manip_learn_fast is not installed"
        if not (isinstance(error, ModuleNotFoundError) and error.name == "manip_learn_fast"):
            reason = f"manip_learn_fast cannot be loaded ({error}): build it again with pip install ./fast"
            _LOGGER.warning("%s; the law in Python is used", reason)
        return None, reason
    if version != LAW_VERSION:
        reason = f"manip_learn_fast has version {version} of the law, {LAW_VERSION} is needed: pip install ./fast"
        _LOGGER.warning("%s; the law in Python is used", reason)
        return None, reason
    return module, ""


@final
class NativeLaw:
    """`Law.command` of one law within one set of limits, compiled.

    Args:
        law: The law.
        limits: Its limits, or None.

    Attributes:
        whole: Whether all of it is compiled, so that whole rollouts are.

    Raises:
        LookupError: It cannot be compiled; says why.
    """

    def __init__(self, law: Law, limits: Limits | None):
        if os.environ.get("MANIP_LEARN_ENGINE", "") == "python":
            raise LookupError("MANIP_LEARN_ENGINE=python")
        module, reason = _compiled()
        if module is None:
            raise LookupError(reason)
        self._law, self._limits, self._constraint = law, limits, law.constraint
        robot = self._robot = law.constraint.robot
        s, nv = law.constraint.n_constraints, law.constraint.nv
        if max(s, nv) > MOST or (limits is not None and limits.robot is not robot):
            raise LookupError(f"more than {MOST} rows or joints, or the limits of another robot")
        rows, task, policy = _rows(law.constraint), _task(law.task, law.constraint), _policy(law.null_policy, law)
        if task is not None and task["kind"] != "hold" and rows is None:
            task = None
        if law.inverse != "damped" and (task is None or policy is None):
            raise LookupError(f"inverse={law.inverse!r} with a task or a policy that is not compiled")
        self._knows = rows is not None, task is not None, policy is not None
        self.whole = all(self._knows) and limits is not None and nv == limits.robot.nq and law.inverse == "damped"
        self._engine = module.Engine(
            {
                **{"n": nv, "s": s, "damped": law.inverse == "damped", "ascends": law.ascends},
                **{"threshold": law.threshold, "damping": law.damping, "slides": law.task.slides},
                **{"rows": rows, "task": task, "policy": policy, "limits": _limits(limits)},
            },
            Command,
            list(Status),
        )
        self.roll = self._engine.roll

    def command(self, q: np.ndarray, t: float, dt: float, previous: np.ndarray | None, slide: float) -> Command | None:
        """As `Law.command`; None where that has to do it, as for input that is none."""
        knows_rows, knows_task, knows_policy = self._knows
        if knows_rows and knows_task and knows_policy and q.shape[0] == self._constraint.nv:
            return self._engine.command(q, dt, previous, slide, None, None, None, None, None, None)
        law, constraint, plain = self._law, self._constraint, np.ascontiguousarray
        if not (self._robot is None or np.all(np.isfinite(q))):
            return None
        x = q if self._robot is None else self._robot.positions(q)
        A = rates = b = E = D = w = None
        if not knows_rows:
            A, rates = plain(constraint(q), np.float64), _Rates(constraint, q)
        if not knows_task:
            b, E = law.task_velocity(q, t, dt)
            D = plain(law.task.driven_rows(constraint), np.float64)
            b, E = plain(b), None if E is None else plain(E, np.float64)
        if not knows_policy:
            w = plain(law.policy_velocity(q, t, dt))
        return self._engine.command(plain(x), dt, previous, slide, b, E, D, w, A, rates)

    def __reduce__(self) -> tuple[Any, ...]:
        return native_law, (self._law, self._limits)


def native_law(law: Law, limits: Limits | None) -> NativeLaw | None:
    """The compiled law; None where that in Python does the work."""
    try:
        return NativeLaw(law, limits)
    except LookupError:
        return None


@final
class _Rates:
    """The vector-Jacobian product of rows at a posture, computed when it is first asked for."""

    def __init__(self, constraint: Constraint, q: np.ndarray):
        self._constraint, self._q, self._vjp = constraint, q, None

    def __call__(self, weights: np.ndarray) -> np.ndarray:
        if self._vjp is None:
            self._vjp = self._constraint.value_and_vjp(self._q)[1]
        return self._vjp(weights)


def _chain(robot: Robot, frame: Frame) -> dict[str, Any] | None:
    """The joints that carry a frame, each turned so that it moves along its own z."""
    kinematics = robot.frame_kinematics(frame)
    if kinematics not in _chains:
        _chains[kinematics] = _chain_of(kinematics)
    return _chains[kinematics]


def _chain_of(kinematics: FrameKinematics) -> dict[str, Any] | None:
    chain = kinematics.chain
    if chain is None or np.any(np.count_nonzero(chain.lift, axis=1) > 1):
        return None
    model, data = chain.model, chain.model.createData()
    import pinocchio as pin

    pin.forwardKinematics(model, data, pin.neutral(model), np.zeros(model.nv))
    joints, turned = [], np.eye(3)
    for j in range(1, model.njoints):
        along, column = motion_along(data.joints[j].S), int(np.argmax(np.abs(chain.lift[j - 1])))
        if along is None:
            return None
        placement, turn = model.jointPlacements[j], _to_z(along[1])
        joints.append(
            {
                "rotation": (turned.T @ placement.rotation @ turn).reshape(-1).tolist(),
                "translation": (turned.T @ placement.translation).tolist(),
                **{"slides": along[0] == "P", "column": column, "factor": float(chain.lift[j - 1, column])},
                "offset": float(chain.offset[j - 1]),
            }
        )
        turned = turn
    end = model.frames[chain.index].placement
    tip = {
        "rotation": (turned.T @ end.rotation).reshape(-1).tolist(),
        "translation": (turned.T @ end.translation).tolist(),
    }
    return {"joints": joints, **tip}


def _to_z(axis: np.ndarray) -> np.ndarray:
    """A rotation whose last column is the axis, made of zeros and ones where that has them."""
    x = np.roll(axis, 1) if np.count_nonzero(axis) == 1 else np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    x = x / np.linalg.norm(x)
    return np.column_stack((x, np.cross(axis, x), axis))


def _rows(constraint: Constraint) -> dict[str, Any] | None:
    """Rows of the form Lambda (T_0 + sum_k p_k T_k) J."""
    f = constraint.features
    if not isinstance(f, FrameJacobian | MechanismRows | PlaceRows):
        return None
    chain, padded, free = _chain(f.robot, f.frame), f.padded(constraint.selection), []
    if chain is None:
        return None
    own = isinstance(f, FrameJacobian) and f.own_axes
    if not isinstance(f, FrameJacobian):
        weights = f.place_weights
        for share, (i, (b, h)) in zip(padded[:, 24:].T, weights.free.items(), strict=True):
            fixed, by_place = weights.constant[i, :3].tolist(), weights.by_place[i, :3].reshape(-1).tolist()
            free.append({"constant": fixed, "by_place": by_place, "b": b.tolist(), "h": h, "share": share.tolist()})
    numbers = {"constant": padded[:, :6].reshape(-1).tolist(), "slopes": padded[:, 6:24].reshape(-1).tolist()}
    return {"chain": chain, "own_axes": own, "free": free, **numbers}


def _task(task: Task, constraint: Constraint) -> dict[str, Any] | None:
    """Rest, a place along positions, or a pose."""
    numbers = {"gain": 1.0, "max_speed": np.inf, "goal": [], "selection": []}
    if type(task) is Hold:
        return {"kind": "hold", **numbers}
    f = constraint.features
    if type(task) is not PointAttractor or not isinstance(f, FrameJacobian):
        return None
    target, padded = task.target, f.padded(constraint.selection)
    numbers |= {"gain": task.gain, "max_speed": np.inf if task.max_speed is None else float(task.max_speed)}
    pose = target.shape == (4, 4)
    try:
        turn = goal_rotation(target[:3, :3]) if pose else np.eye(3)
    except TargetError:  # which every call raises
        return None
    if f.only_linear:
        goal = padded[:, :3] @ target[:3, 3] if pose else target
        if target.shape == (f.n_rows,):
            goal = constraint.selection @ target
        elif goal.shape != (constraint.n_constraints,):
            return None
        return {"kind": "place", **numbers, "goal": goal.tolist(), "selection": padded[:, :3].reshape(-1).tolist()}
    place, given = target[:3, 3] if pose else np.zeros(3), np.ones(3)
    if not pose:  # numbers along the rows, all of the rotation vector among them
        rows = np.array(["x y z rx ry rz".split().index(name) for name in f.row_names])
        if target.shape != (f.n_rows,) or np.count_nonzero(rows > 2) < 3 or (f.own_axes and len(rows) not in (3, 6)):
            return None
        everything = np.zeros(6)
        everything[rows] = target
        place, given, turn = everything[:3], np.isin(np.arange(3), rows).astype(float), rotation_matrix(everything[3:])
    numbers["selection"] = padded.reshape(-1).tolist()
    goal = {"place": place.tolist(), "given": given.tolist(), "rotation": turn.reshape(-1).tolist()}
    return {"kind": "pose", **numbers, **goal}


def _policy(policy: policies.NullSpacePolicy, law: Law) -> dict[str, Any] | None:
    """The library's policies, where they belong to the same rows and joints."""
    robot, constraint = law.constraint.robot, law.constraint
    kind, columns, parts, settings = "", [], [], {"gain": 0.0, "max_speed": np.inf, "enough": 0.0, "logarithmic": True}
    weights: list[float] = []
    if type(policy) is policies.ZeroPolicy:
        kind = "zero"
    elif type(policy) is policies.JointAttractor and robot is not None and policy.robot in (None, robot):
        plain = all(block.kind in PLAIN for block in robot.blocks) and robot.nq == robot.nv == policy.rest.size
        kind, columns, settings["gain"] = "attractor" if plain else "", [policy.rest], policy.gain
    elif type(policy) is policies.JointLimitAvoidance and policy.robot is robot:
        kind, columns = "avoidance", policy.numbers
    elif type(policy) is policies.ManipulabilityAscent and policy.constraint is constraint:
        kind, settings["logarithmic"] = "ascent", policy.logarithmic
    elif type(policy) is policies.RoomAscent and policy.constraint is constraint:
        kind, settings["enough"], *columns = "room", *policy.numbers
    elif type(policy) is policies.WeightedPolicies:
        parts, weights = [_policy(part, law) for part in policy.policies], list(policy.weights)
        kind = "" if None in parts else "sum"
    if isinstance(policy, policies.ManipulabilityAscent | policies.RoomAscent):
        settings |= {"gain": policy.gain, "max_speed": np.inf if policy.max_speed is None else policy.max_speed}
    described = {"columns": [np.asarray(c, float).tolist() for c in columns], "parts": parts, "weights": weights}
    return {"kind": kind, **settings, **described} if kind else None


def _limits(limits: Limits | None) -> dict[str, Any] | None:
    if limits is None:
        return None
    tip, robot = limits.tip, limits.robot
    frames = [] if tip is None else [_chain(robot, frame) for frame in tip.frames]
    walls = [] if tip is None else tip.walls.reshape(-1).tolist()
    if None in frames or len(frames) * len(walls) > 4 * MOST:
        raise LookupError("limits of a frame that a floating joint carries, or of too many walls")
    names = ("lower", "upper", "velocity", "acceleration")
    numbers = {name: getattr(limits, name).tolist() for name in names}
    farthest = np.broadcast_to(farthest_positions(robot), (robot.nv,)).tolist()
    speed = np.inf if tip is None else tip.speed
    return {**numbers, "frames": frames, "walls": walls, "tip_speed": speed, "farthest": farthest}
