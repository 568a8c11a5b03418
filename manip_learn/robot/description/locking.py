"""Joints that are held still: which ones follow from the names given, and where they stand."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin

from manip_learn.errors import RobotError, UnknownNameError
from manip_learn.robot.description.mimic import Mimics
from manip_learn.robot.description.urdf_elements import UrdfFile, UrdfJoint, as_matrix, as_pose

Locked = Sequence[str] | Mapping[str, float | None]


def names_of(locked: Locked) -> tuple[str, ...]:
    """The names in what a caller passed as `locked`; a single string counts as one name."""
    return (locked,) if isinstance(locked, str) else tuple(str(n) for n in locked)


def locked_positions(urdf: UrdfFile, mimics: Mimics, locked: Locked) -> dict[str, float]:
    """Position of every joint that stands still: locked ones, their followers, and followers of fixed joints.

    A joint locked by name alone stands at zero, or at the limit nearest to zero.

    Returns:
        Joint name -> position [rad or m], in file order; 0 for floating and planar joints, which is accepted again.

    Raises:
        UnknownNameError: A name that is no joint.
        RobotError: Codes `locked-follower`, `locked-position`.
    """
    asked = {name: (locked.get(name) if isinstance(locked, Mapping) else None) for name in names_of(locked)}
    by_name = {j.name: j for j in urdf.joints}
    leader_of = {m.joint: m for m in mimics.followers}
    still = dict(mimics.resting)
    for name, value in asked.items():
        if name not in by_name:
            raise UnknownNameError("joint", name, by_name, f"robot {urdf.name!r}")
        if by_name[name].nv == 0 or name in leader_of or name in still:
            continue
        still[name] = _position(by_name[name], value)
    for name in asked:
        if name in leader_of and leader_of[name].leader not in still:
            raise RobotError(
                f"joint {name!r} cannot be locked alone: it follows {leader_of[name].leader!r}; lock that joint",
                code="locked-follower",
            )
    for m in mimics.followers:
        if m.leader in still:
            still[m.joint] = m.multiplier * still[m.leader] + m.offset
    return {j.name: still[j.name] for j in urdf.joints if j.name in still}


def _position(joint: UrdfJoint, value: float | None) -> float:
    limit = joint.limit
    lower, upper = -math.inf, math.inf
    if limit is not None and limit.lower is not None and limit.upper is not None and joint.type != "continuous":
        # limits that contradict each other say nothing
        lower, upper = (limit.lower, limit.upper) if limit.lower <= limit.upper else (lower, upper)
    if value is None:
        return min(max(0.0, lower), upper)
    if joint.nv != 1 and value != 0.0:
        raise RobotError(
            f"joint {joint.name!r} is {joint.type} and can be locked only where it is: give no position",
            code="locked-position",
        )
    try:
        position = float(value)
    except (TypeError, ValueError) as error:
        raise RobotError(
            f"joint {joint.name!r}: locked at {value!r}, a number is expected", code="locked-position"
        ) from error
    if not lower <= position <= upper:
        raise RobotError(
            f"joint {joint.name!r}: locked at {position:g}, outside its limits {lower:g} ... {upper:g}",
            code="locked-position",
        )
    return position


def with_fixed(urdf: UrdfFile, still: Mapping[str, float]) -> UrdfFile:
    """The same robot with those joints fixed where they stand.

    Pinocchio's own reduction of a model leaves frames with parents that lead in a circle.
    """
    return replace(urdf, joints=tuple(_fixed(j, still[j.name]) if j.name in still else j for j in urdf.joints))


def _fixed(joint: UrdfJoint, position: float) -> UrdfJoint:
    pose = joint.pose
    if position != 0.0 and joint.nv == 1:
        motion, axis = np.eye(4), np.array(joint.axis)
        if joint.type == "prismatic":
            motion[:3, 3] = position * axis
        else:
            motion[:3, :3] = pin.exp3(position * axis)
        pose = as_pose(as_matrix(joint.pose) @ motion)
    return replace(joint, type="fixed", pose=pose, limit=None, mimic=None)
