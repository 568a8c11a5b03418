"""Substitute shapes for a robot without shapes: bones from joint to joint, and their thickness.

A bone leaves a joint along its axis and arrives at the next joint along the next axis, as the links of arms do.
"""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.robot.joints import joint_motions


@final
class Bone(NamedTuple):
    """Straight piece of a link, in the frame of the joint that carries the link.

    Attributes:
        joint: Pinocchio id of the joint that carries the link; 0 is the world.
        child: Pinocchio id of the next joint; 0 at the end of an arm.
        ends: Both ends (2, 3), the one near `joint` first [m].
        radii: Radius at each end [m].
    """

    joint: int
    child: int
    ends: Float[np.ndarray, "2 3"]
    radii: tuple[float, float]


def bones(model: pin.Model, radius: Float[np.ndarray, " J"]) -> tuple[Bone, ...]:
    """Return the bones of all links, sorted by joint.

    Args:
        model: Pinocchio model of the robot.
        radius: Radius (J,) at each joint [m], from `link_radii`.
    """
    shortest, tip = 0.2, 0.8  # shortest bone over its radius; radius at the end over the radius at the last joint
    out, axes = list[Bone](), [motion[1] if motion else np.zeros(3) for motion in joint_motions(model)]
    axes[0] = np.array([0.0, 0.0, 1.0])  # the link on the floor rises first
    targets = [(int(model.parents[c]), c, model.jointPlacements[c]) for c in range(1, model.njoints)]
    targets += [(i, 0, pin.SE3(np.eye(3), end)) for i, end in link_ends(model).items()]
    for i, child, place in targets:
        end, last = place.translation, place.rotation @ axes[child] * bool(child)
        first = axes[i] * (end @ axes[i])
        path = [np.zeros(3)]
        for corner in (first, end - last * ((end - first) @ last), end):
            if np.linalg.norm(corner - path[-1]) > shortest * radius[i]:
                path.append(corner)
        path[1:] = [*path[1:-1], end][: len(path) - 1]  # a short last piece joins the piece before it
        thick = np.linspace(radius[i], radius[child] if child else tip * radius[i], len(path))
        out += [Bone(i, child, np.array(path[k : k + 2]), (thick[k], thick[k + 1])) for k in range(len(path) - 1)]
    return tuple(sorted(out, key=lambda bone: bone.joint))


def link_ends(model: pin.Model) -> dict[int, Float[np.ndarray, " 3"]]:
    """Return the end of each chain of joints: the position of the farthest link that is fixed to its last joint.

    Args:
        model: Pinocchio model of the robot.

    Returns:
        Dictionary from the Pinocchio id of the last joint to a position (3,) in its frame [m].
    """
    inner = set(model.parents[1:])
    ends: dict[int, np.ndarray] = {}
    for i in range(1, model.njoints):
        points = [f.placement.translation for f in model.frames if f.parentJoint == i and f.type == pin.FrameType.BODY]
        if i not in inner and points:
            ends[i] = max(points, key=lambda p: float(np.linalg.norm(p)))
    return ends


def link_radii(model: pin.Model) -> Float[np.ndarray, " J"]:
    """Return the radius of the bones at each joint [m]: proportional to the robot's reach, smaller towards the tip.

    Args:
        model: Pinocchio model of the robot.
    """
    # radius at the base over the reach, as in real arms; radius at the last joint over the radius at the base
    thickness, taper = 0.043, 0.55
    depth, reach = np.zeros(model.njoints), np.zeros(model.njoints)  # number of joints and path length from the base
    for i in range(1, model.njoints):
        depth[i] = depth[model.parents[i]] + 1
        reach[i] = reach[model.parents[i]] + float(np.linalg.norm(model.jointPlacements[i].translation))
    tips = [reach[i] + float(np.linalg.norm(p)) for i, p in link_ends(model).items()]
    scale = max([float(reach.max()), *tips, 1e-3])
    return thickness * scale * (1.0 - (1.0 - taper) * depth / max(int(depth.max()), 1))
