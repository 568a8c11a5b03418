"""The figure that stands in for a robot without shapes: bones from joint to joint, and how thick they are.

A bone leaves a joint along its axis and comes to the next one along that one's, as the links of arms do.
"""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.robot.joints import joint_motions

_THICK = 0.043  # radius at the base, share of the reach, as of arms that are sold
TAPER = 0.55  # radius at the last joint, share of the radius at the base
TIP = 0.8  # radius at the end, share of the radius at the last joint
SHORTEST_BONE = 0.2  # length from which there is a bone, share of its radius


@final
class Bone(NamedTuple):
    """A straight piece of a link, in the frame of the joint that carries it.

    Attributes:
        joint: Pinocchio id of that joint; 0 is the world.
        child: Pinocchio id of the joint that the link leads to; 0 for the end of an arm.
        ends: shape (2, 3), from that joint's side [m].
        radii: At both ends [m].
    """

    joint: int
    child: int
    ends: Float[np.ndarray, "2 3"]
    radii: tuple[float, float]


def bones(model: pin.Model, radius: Float[np.ndarray, " J"]) -> tuple[Bone, ...]:
    """The bones of all links, those of one link one after the other.

    Args:
        model: The robot.
        radius: At each joint [m].
    """
    found, axes = list[Bone](), [motion[1] if motion else np.zeros(3) for motion in joint_motions(model)]
    axes[0] = np.array([0.0, 0.0, 1.0])  # what stands on the floor rises first
    targets = [(int(model.parents[c]), c, model.jointPlacements[c]) for c in range(1, model.njoints)]
    targets += [(i, 0, pin.SE3(np.eye(3), end)) for i, end in link_ends(model).items()]
    for i, child, place in targets:
        end, last = place.translation, place.rotation @ axes[child] * bool(child)
        first = axes[i] * (end @ axes[i])
        path = [np.zeros(3)]
        for corner in (first, end - last * ((end - first) @ last), end):
            if np.linalg.norm(corner - path[-1]) > SHORTEST_BONE * radius[i]:
                path.append(corner)
        path[1:] = [*path[1:-1], end][: len(path) - 1]  # what is short at the end belongs to the piece before it
        thick = np.linspace(radius[i], radius[child] if child else TIP * radius[i], len(path))
        found += [Bone(i, child, np.array(path[k : k + 2]), (thick[k], thick[k + 1])) for k in range(len(path) - 1)]
    return tuple(sorted(found, key=lambda bone: bone.joint))


def link_ends(model: pin.Model) -> dict[int, Float[np.ndarray, " 3"]]:
    """For joints that carry no other joint: the farthest fixed link on each [m], in the joint's frame."""
    inner = set(model.parents[1:])
    ends: dict[int, np.ndarray] = {}
    for i in range(1, model.njoints):
        points = [f.placement.translation for f in model.frames if f.parentJoint == i and f.type == pin.FrameType.BODY]
        if i not in inner and points:
            ends[i] = max(points, key=lambda p: float(np.linalg.norm(p)))
    return ends


def link_radii(model: pin.Model) -> Float[np.ndarray, " J"]:
    """Radius of the figure at each joint [m]: in proportion to the robot, slimmer towards the tip."""
    depth, reach = np.zeros(model.njoints), np.zeros(model.njoints)  # joints, and length of the path, from the base
    for i in range(1, model.njoints):
        depth[i] = depth[model.parents[i]] + 1
        reach[i] = reach[model.parents[i]] + float(np.linalg.norm(model.jointPlacements[i].translation))
    tips = [reach[i] + float(np.linalg.norm(p)) for i, p in link_ends(model).items()]
    scale = max([float(reach.max()), *tips, 1e-3])
    return _THICK * scale * (1.0 - (1.0 - TAPER) * depth / max(int(depth.max()), 1))
