"""The joints that carry one frame, as a Pinocchio model of their own: what else the robot moves costs nothing."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.robot.description.mimic import Coupling
from manip_learn.robot.frame import Frame
from manip_learn.robot.joints import JointBlock

ALIGNED_AXES = ("X", "Y", "Z")
KINDS = ("revolute", "continuous", "prismatic")


@final
class CarryingJoints(NamedTuple):
    """A chain of joints of one degree of freedom, from the base to a frame.

    Its configuration x is one number per joint, the robot's joint positions p mapped by x = lift p + offset; a
    continuous joint is an unlimited angle in it.

    Attributes:
        model: Pinocchio model of these joints and the frame alone.
        index: Number of the frame in that model.
        columns: The public joint of each joint of the chain, as a slice where they lie side by side; None where mimic
            joints are among them.
        lift: shape (n, nv).
        offset: shape (n,) [rad or m].
    """

    model: pin.Model
    index: int
    columns: slice | np.ndarray | None
    lift: Float[np.ndarray, "n nv"]
    offset: Float[np.ndarray, " n"]


def carrying_joints(
    model: pin.Model, frame: Frame, blocks: tuple[JointBlock, ...], coupling: Coupling | None
) -> CarryingJoints | None:
    """The joints between the base and a frame.

    None if there are none, or one of them has more than one degree of freedom (a floating base).
    """
    chain = [j for j in model.supports[frame.parent_joint] if j > 0]
    independent = {block.index: block for block in blocks}
    if not chain or any(j in independent and independent[j].kind not in KINDS for j in chain):
        return None
    if any(j not in independent and model.joints[j].nv != 1 for j in chain):
        return None
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model), np.zeros(model.nv))
    alone, parent = pin.Model(), 0
    for j in chain:
        joint = _joint_along(np.array(data.joints[j].S, dtype=np.float64).reshape(-1))
        if joint is None:
            return None
        parent = alone.addJoint(parent, joint, model.jointPlacements[j], model.names[j])
    placement = model.frames[frame.index].placement
    index = alone.addFrame(pin.Frame(frame.name, parent, 0, placement, pin.FrameType.OP_FRAME))
    rows = np.array([model.joints[j].idx_v for j in chain])
    nv = sum(block.v.stop - block.v.start for block in blocks)
    if coupling is None:
        lift, offset = np.zeros((model.nv, nv)), np.zeros(model.nv)
        for block in blocks:
            lift[block.pin_v, block.v] = np.eye(block.v.stop - block.v.start)
        columns = np.argmax(lift[rows], axis=1)
    else:
        lift, offset, columns = coupling.lift, coupling.offset, coupling.columns_of(rows)
    return CarryingJoints(alone, index, _as_slice(columns), np.array(lift[rows]), np.array(offset[rows]))


def _joint_along(motion: np.ndarray) -> pin.JointModel | None:
    """A joint that moves along a twist (linear, angular) with one of the parts zero, without limits."""
    linear, angular = motion[:3], motion[3:]
    if motion.shape != (6,) or (np.any(linear) and np.any(angular)):
        return None
    kind, axis = ("P", linear) if np.any(linear) else ("R", angular)
    for letter, unit in zip(ALIGNED_AXES, np.eye(3), strict=True):
        if np.array_equal(axis, unit):
            return getattr(pin, f"JointModel{kind}{letter}")()
    return pin.JointModelPrismaticUnaligned(axis) if kind == "P" else pin.JointModelRevoluteUnaligned(axis)


def _as_slice(columns: np.ndarray | None) -> slice | np.ndarray | None:
    """A slice makes views where an array of numbers copies."""
    if columns is None or not np.array_equal(columns, np.arange(columns[0], columns[0] + len(columns))):
        return columns
    return slice(int(columns[0]), int(columns[0]) + len(columns))
