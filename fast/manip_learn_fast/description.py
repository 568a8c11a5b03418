"""A law and its limits in plain numbers, as the engine takes them."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian, goal_rotation
from manip_learn.constraint.features.mechanism_rows import MechanismRows, PlaceRows
from manip_learn.control import policies
from manip_learn.control.law import Law
from manip_learn.control.limits import Limits, farthest_positions
from manip_learn.control.tasks import Hold, PointAttractor, Task
from manip_learn.errors import TargetError
from manip_learn.robot.frame_kinematics import FrameKinematics
from manip_learn.robot.joints import Frame, joint_motions
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix

MOST = 32  # rows and joints that the engine has room for
MOST_WALLS = 128  # of all frames together
PLAIN = ("revolute", "prismatic")  # joints whose positions add up
_chains: WeakKeyDictionary[FrameKinematics, dict[str, Any] | None] = WeakKeyDictionary()


def description(law: Law, limits: Limits | None) -> dict[str, Any]:
    """What the engine is made of; None for rows, a task or a policy that it does not know.

    Raises:
        LookupError: The law in Python has to do the work; says why.
    """
    constraint = law.constraint
    s, nv, robot = constraint.n_constraints, constraint.nv, constraint.robot
    if max(s, nv) > MOST:
        raise LookupError(f"{s} rows of {nv} joints, where {MOST} are the most")
    if limits is not None and limits.robot is not robot:
        raise LookupError("the limits belong to another robot than the rows")
    rows, policy = _rows(constraint), _policy(law.null_policy, law)
    task = _task(law.task, constraint, rows is not None)
    if law.inverse != "damped" and None in (task, policy):
        raise LookupError(f"the inverse {law.inverse!r} with a task or a policy that the engine does not know")
    return {
        **{"n": nv, "s": s, "damped": law.inverse == "damped", "ascends": law.ascends},
        **{"threshold": law.threshold, "damping": law.damping, "slides": law.task.slides},
        **{"rows": rows, "task": task, "policy": policy, "limits": _limits(limits)},
    }


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
    model, motions = chain.model, joint_motions(chain.model)
    joints, turned = [], np.eye(3)
    for j in range(1, model.njoints):
        along, column = motions[j], int(np.argmax(np.abs(chain.lift[j - 1])))
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
    rotation, translation = turned.T @ end.rotation, turned.T @ end.translation
    return {"joints": joints, "rotation": rotation.reshape(-1).tolist(), "translation": translation.tolist()}


def _to_z(axis: np.ndarray) -> np.ndarray:
    """A rotation whose last column is the axis, made of zeros and ones where that has them."""
    x = np.roll(axis, 1) if np.count_nonzero(axis) == 1 else np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    x = x / np.linalg.norm(x)
    return np.column_stack((x, np.cross(axis, x), axis))


def _on_twist(constraint: Constraint) -> np.ndarray:
    """Lambda T_0 (6 columns) and Lambda T_k (18) of affine rows, then Lambda's shares of those of unit length."""
    f, selection = constraint.features, constraint.selection
    if isinstance(f, FrameJacobian):
        return selection @ np.array([[name == axis for axis in AXES] for name in f.row_names], dtype=float)
    place, affine, free = f.place_weights, selection.copy(), list(f.place_weights.free)
    affine[:, free] = 0.0
    numbers = np.concatenate([place.constant, place.by_place.reshape(-1, 18)], axis=1)
    return np.concatenate([affine @ numbers, selection[:, free]], axis=1)


def _rows(constraint: Constraint) -> dict[str, Any] | None:
    """Rows of the form Lambda (T_0 + sum_k p_k T_k) J."""
    f = constraint.features
    if not isinstance(f, FrameJacobian | MechanismRows | PlaceRows):
        return None
    chain, padded, free = _chain(f.robot, f.frame), _on_twist(constraint), []
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


def _task(task: Task, constraint: Constraint, knows_rows: bool) -> dict[str, Any] | None:
    """Rest, a place along positions, or a pose."""
    numbers = {"gain": 1.0, "max_speed": np.inf, "goal": [], "selection": []}
    if type(task) is Hold:
        return {"kind": "hold", **numbers}
    f = constraint.features
    if type(task) is not PointAttractor or not isinstance(f, FrameJacobian) or not knows_rows:
        return None
    target, padded = task.target, _on_twist(constraint)
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
        rows = np.array([AXES.index(name) for name in f.row_names])
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
    barriers, robot = limits.barriers, limits.robot
    frames, walls = [_chain(robot, frame) for frame in barriers.frames], barriers.walls.reshape(-1).tolist()
    if None in frames or len(frames) * len(walls) > 4 * MOST_WALLS:
        raise LookupError("limits of a frame that a floating joint carries, or of too many walls")
    names = ("lower", "upper", "velocity", "acceleration")
    numbers = {name: getattr(limits, name).tolist() for name in names}
    farthest = np.broadcast_to(farthest_positions(robot), (robot.nv,)).tolist()
    return {**numbers, "frames": frames, "walls": walls, "tip_speed": barriers.speed, "farthest": farthest}
