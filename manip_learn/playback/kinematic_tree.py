"""What the browser needs for forward kinematics: the parent of each joint, and how it moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.robot.joints import joint_motions
from manip_learn.robot.robot import Robot


@final
@dataclass(frozen=True, eq=False)
class TreeJoint:
    """One moving joint, mimic joints included.

    Attributes:
        name: Name in the URDF.
        parent: Index of the parent joint; the world is 0.
        placement: shape (4, 4), from the joint at rest to its parent [m].
        motion: `"revolute"` and `"prismatic"` move along `axis` by one number; `"free"` is given as a whole pose of
            seven (x, y, z, quaternion x, y, z, w); only the world is `"fixed"`.
        axis: shape (3,), unit vector in the joint's own frame; zero for `"free"` and `"fixed"`.
    """

    name: str
    parent: int
    placement: Float[np.ndarray, "4 4"]
    motion: Literal["fixed", "revolute", "prismatic", "free"]
    axis: Float[np.ndarray, " 3"]


def kinematic_tree(robot: Robot) -> tuple[TreeJoint, ...]:
    """The joints of a robot, parents first; entry 0 is the world."""
    model, tree = robot.pinocchio_model, [TreeJoint("", 0, np.eye(4), "fixed", np.zeros(3))]
    for i, along in list(enumerate(joint_motions(model)))[1:]:
        motion, axis = "free", np.zeros(3)
        if along is not None and np.isclose(np.linalg.norm(along[1]), 1.0):
            motion, axis = ("revolute" if along[0] == "R" else "prismatic"), along[1]
        placement = model.jointPlacements[i].homogeneous
        tree.append(TreeJoint(model.names[i], int(model.parents[i]), placement, motion, axis))
    return tuple(tree)


def joint_tracks(
    robot: Robot, tree: tuple[TreeJoint, ...], postures: Float[np.ndarray, "K n"]
) -> Float[np.ndarray, "K w"]:
    """Postures as the numbers that move the tree, joint after joint (see `TreeJoint.motion`).

    Angles of continuous joints are unwrapped, so that a motion between two key frames takes the short way.

    Raises:
        ConfigurationError: A posture of the wrong size or with NaN.
    """
    model, columns = robot.pinocchio_model, [np.zeros((len(postures), 0))]
    full = np.array([robot.pinocchio_configuration(q) for q in postures])
    for node, joint in list(zip(tree, model.joints, strict=True))[1:]:
        part = full[:, joint.idx_q : joint.idx_q + joint.nq]
        if node.motion == "free":
            data, poses = joint.createData(), np.empty((len(full), 7))
            for k, q in enumerate(full):
                joint.calc(data, q)
                poses[k] = pin.SE3ToXYZQUAT(data.M)
                if k and poses[k, 3:] @ poses[k - 1, 3:] < 0.0:  # q and -q turn alike: keep the signs continuous
                    poses[k, 3:] *= -1.0
            columns.append(poses)
        else:
            columns.append(part if joint.nq == 1 else np.unwrap(np.arctan2(part[:, 1:], part[:, :1]), axis=0))
    return np.concatenate(columns, axis=1)
