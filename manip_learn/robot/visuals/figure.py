"""The figure that stands for a robot without shapes: bones from joint to joint, and their thickness.

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
    """A straight piece of a link, in the frame of the joint that carries it.

    Attributes:
        joint: Pinocchio id of that joint; 0 is the world.
        child: Pinocchio id of the joint that the link leads to; 0 for the end of an arm.
        ends: shape (2, 3), from the side of that joint [m].
        radii: Radii at both ends [m].
    """

    joint: int
    child: int
    ends: Float[np.ndarray, "2 3"]
    radii: tuple[float, float]


def bones(model: pin.Model, radius: Float[np.ndarray, " J"]) -> tuple[Bone, ...]:
    """Return the bones of all links, sorted by joint.

    Args:
        model: Pinocchio model of the robot.
        radius: Radius of the figure at each joint [m], see `link_radii`.
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
    """Return the farthest fixed link on each joint that carries no other joint [m], in the joint's frame.

    Args:
        model: Pinocchio model of the robot.

    Returns:
        Pinocchio id of the joint -> position (3,).
    """
    inner = set(model.parents[1:])
    ends: dict[int, np.ndarray] = {}
    for i in range(1, model.njoints):
        points = [f.placement.translation for f in model.frames if f.parentJoint == i and f.type == pin.FrameType.BODY]
        if i not in inner and points:
            ends[i] = max(points, key=lambda p: float(np.linalg.norm(p)))
    return ends


def link_radii(model: pin.Model) -> Float[np.ndarray, " J"]:
    """Return the radius of the figure at each joint [m]: proportional to the robot's reach, smaller towards the tip.

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
