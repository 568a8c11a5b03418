"""Independent joints of a robot: their slices of the vectors, limits, mimic joints, and chains to a frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

JointKind = Literal["revolute", "prismatic", "continuous", "floating", "planar", "other"]

COORDINATE_SUFFIXES: dict[str, tuple[str, ...]] = {
    "floating": (".x", ".y", ".z", ".rx", ".ry", ".rz"),
    "planar": (".x", ".y", ".rz"),
}


@final
@dataclass(frozen=True)
class Frame:
    """Frame of a robot; `Robot.frame` makes it from a name, which it checks (Pinocchio would crash for a wrong name).

    Attributes:
        name: Name in the URDF (a link, else a joint).
        index: Pinocchio frame id.
        parent_joint: Pinocchio id of the joint that carries it; 0 is the fixed world.
    """

    name: str
    index: int
    parent_joint: int


FrameLike = str | Frame  # argument type of the methods of `Robot`; a `Frame` saves the look-up


@final
@dataclass(frozen=True)
class Mimic:
    """Mimic joint: position of `joint` = `multiplier` * position of `leader` + `offset` [rad or m]."""

    joint: str
    leader: str
    multiplier: float
    offset: float


@final
@dataclass(frozen=True)
class Coupling:
    """Affine map from the independent joints to all joints, including mimic joints.

    The positions of all joints are `lift @ positions + offset`, their velocities `lift @ velocities`.

    Attributes:
        lift: Matrix (nv_all, nv).
        offset: shape (nv_all,) [rad or m].
    """

    lift: Float[np.ndarray, "n_all nv"]
    offset: Float[np.ndarray, " n_all"]

    def __post_init__(self) -> None:
        self.lift.setflags(write=False)
        self.offset.setflags(write=False)


@final
@dataclass(frozen=True)
class JointBlock:
    """Slices of one independent joint.

    Attributes:
        name: Joint name in the URDF.
        kind: Type of the joint.
        index: Pinocchio joint id.
        q: Slice in the public configuration (size nq).
        v: Slice in the public tangent vector (size nv).
        pin_q: Slice in Pinocchio's configuration, which also holds the mimic joints.
        pin_v: Slice in Pinocchio's tangent vector.
    """

    name: str
    kind: JointKind
    index: int
    q: slice
    v: slice
    pin_q: slice
    pin_v: slice

    @property
    def direction(self) -> slice:
        """Slice of a configuration with the unit vector of the joint: (cos, sin), or the quaternion of a floating base.

        It is for continuous, floating and planar joints only.
        """
        return slice(self.q.stop - (4 if self.kind == "floating" else 2), self.q.stop)

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """One name per tangent coordinate: the joint's name, or e.g. `base.x`, `base.y` for a floating base."""
        width = self.v.stop - self.v.start
        if width == 1:
            return (self.name,)
        suffixes = COORDINATE_SUFFIXES.get(self.kind, tuple(f".{i}" for i in range(width)))
        return tuple(self.name + s for s in suffixes)

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each tangent coordinate, `"rad"` or `"m"`."""
        if self.kind in COORDINATE_SUFFIXES:
            return tuple("rad" if "r" in suffix else "m" for suffix in COORDINATE_SUFFIXES[self.kind])
        return ("m" if self.kind == "prismatic" else "rad",) * (self.v.stop - self.v.start)


def joint_blocks(model: pin.Model, mimics: Sequence[Mimic]) -> tuple[JointBlock, ...]:
    """Return the independent joints of a model, in its order: joints that move and are no mimic joints.

    Args:
        model: Pinocchio model, in which mimic joints are joints of their own.
        mimics: Mimic joints.
    """
    kinds: tuple[tuple[str, JointKind], ...] = (
        ("JointModelRUB", "continuous"),
        ("JointModelRevoluteUnbounded", "continuous"),
        ("JointModelR", "revolute"),
        ("JointModelPlanar", "planar"),
        ("JointModelP", "prismatic"),
        ("JointModelFreeFlyer", "floating"),
        ("", "other"),
    )  # prefixes of Pinocchio's short names; the first match counts
    followers, blocks, nq, nv = {m.joint for m in mimics}, list[JointBlock](), 0, 0
    for index in range(1, model.njoints):
        joint, name = model.joints[index], model.names[index]
        if name in followers or joint.nv == 0:
            continue
        kind: JointKind = next(k for begin, k in kinds if joint.shortname().startswith(begin))
        slices = slice(nq, nq + joint.nq), slice(nv, nv + joint.nv)
        of_model = slice(joint.idx_q, joint.idx_q + joint.nq), slice(joint.idx_v, joint.idx_v + joint.nv)
        blocks.append(JointBlock(name, kind, index, *slices, *of_model))
        nq, nv = slices[0].stop, slices[1].stop
    return tuple(blocks)


@final
class JointLimits(NamedTuple):
    """Limits of each degree of freedom.

    Attributes:
        lower: Lower position limits (nv,) [rad or m], -inf for a joint without one.
        upper: Upper position limits (nv,) [rad or m], inf for a joint without one.
        velocity: Velocity limits (nv,) [rad/s or m/s], inf for a joint without one.
    """

    lower: Float[np.ndarray, " nv"]
    upper: Float[np.ndarray, " nv"]
    velocity: Float[np.ndarray, " nv"]


def joint_limits(
    model: pin.Model, blocks: Sequence[JointBlock], mimics: Sequence[Mimic]
) -> tuple[JointLimits, tuple[str, ...]]:
    """Return the limits of the independent joints, narrowed by the limits of the mimic joints that follow them.

    Args:
        model: Pinocchio model, in which mimic joints are joints of their own.
        blocks: Its independent joints.
        mimics: Its mimic joints.

    Returns:
        The limits (read-only), and a warning for each mimic joint that narrows or contradicts the limits of its leader.
    """
    nv = sum(b.v.stop - b.v.start for b in blocks)
    limits = JointLimits(np.full(nv, -np.inf), np.full(nv, np.inf), np.full(nv, np.inf))
    for b in blocks:
        if b.kind in ("revolute", "prismatic"):
            limits.lower[b.v] = model.lowerPositionLimit[b.pin_q]
            limits.upper[b.v] = model.upperPositionLimit[b.pin_q]
        velocity = np.asarray(model.velocityLimit[b.pin_v])
        limits.velocity[b.v] = np.where(velocity > 0, velocity, np.inf)
    leaders = {b.name: b for b in blocks}
    warnings = [sentence for m in mimics for sentence in _narrow_leader(m, leaders[m.leader], model, limits)]
    for array in limits:
        array.setflags(write=False)
    return limits, tuple(warnings)


def _narrow_leader(m: Mimic, leader: JointBlock, model: pin.Model, limits: JointLimits) -> list[str]:
    """Narrow a leader's limits by its follower's, divided by the multiplier; return warnings."""
    joint, k = model.joints[model.getJointId(m.joint)], leader.v.start
    if m.multiplier == 0.0:
        return []
    velocity = float(model.velocityLimit[joint.idx_v])
    if velocity > 0:
        limits.velocity[k] = min(limits.velocity[k], velocity / abs(m.multiplier))
    if joint.nq != 1:
        return []
    ends = float(model.lowerPositionLimit[joint.idx_q]), float(model.upperPositionLimit[joint.idx_q])
    if leader.kind == "continuous":
        sentence = f"joint {m.leader!r} turns without end, so the limits of its follower {m.joint!r} are not enforced"
        return [] if all(map(math.isinf, ends)) else [sentence]
    low, high = sorted((end - m.offset) / m.multiplier for end in ends)
    # limits in files are rounded: a follower's may be slightly tighter than its leader's
    room = 1e-6 + 1e-4 * (high - low) if math.isfinite(high - low) else 0.0
    lower, upper = float(limits.lower[k]), float(limits.upper[k])
    if low <= lower + room and high >= upper - room:
        return []
    if max(low, lower) >= min(high, upper):
        return [
            f"joint {m.joint!r} would need {m.leader!r} in {low:.4g} ... {high:.4g}, outside that joint's limits "
            f"{lower:.4g} ... {upper:.4g}; the limits of {m.joint!r} are ignored"
        ]
    limits.lower[k], limits.upper[k] = low, high = max(low, lower), min(high, upper)
    return [f"joint {m.leader!r} is limited to {low:.4g} ... {high:.4g} by its follower {m.joint!r}"]


def full_coupling(model: pin.Model, blocks: Sequence[JointBlock], mimics: Sequence[Mimic]) -> Coupling:
    """Return the affine map from the independent joints to all joints of a model.

    Without mimic joints, it is a permutation.

    Args:
        model: Pinocchio model, in which mimic joints are joints of their own.
        blocks: Its independent joints.
        mimics: Its mimic joints.
    """
    lift, offset = np.zeros((model.nv, sum(b.v.stop - b.v.start for b in blocks))), np.zeros(model.nv)
    for b in blocks:
        lift[b.pin_v, b.v] = np.eye(b.v.stop - b.v.start)
    leaders = {b.name: b.v.start for b in blocks}
    for m in mimics:
        row = model.joints[model.getJointId(m.joint)].idx_v
        lift[row, leaders[m.leader]], offset[row] = m.multiplier, m.offset
    return Coupling(lift, offset)


@final
class CarryingJoints(NamedTuple):
    """Chain of n joints with one degree of freedom each, from the base to a frame.

    The configuration of the chain has one number per joint: `lift @ p + offset`, with the robot's joint positions p
    (nv,). A continuous joint is an unlimited angle in it.

    Attributes:
        model: Pinocchio model with these joints and the frame only.
        index: Index of the frame in that model.
        lift: Matrix (n, nv).
        offset: shape (n,) [rad or m].
    """

    model: pin.Model
    index: int
    lift: Float[np.ndarray, "n nv"]
    offset: Float[np.ndarray, " n"]


def carrying_joints(
    model: pin.Model, frame: Frame, blocks: tuple[JointBlock, ...], coupling: Coupling | None
) -> CarryingJoints | None:
    """Return the chain of joints between the base and a frame.

    Args:
        model: Pinocchio model, in which mimic joints are joints of their own.
        frame: One of its frames.
        blocks: Its independent joints.
        coupling: Map from the independent joints to all joints; None without mimic joints.

    Returns:
        The chain; None if there are no such joints, or if one of them is neither revolute nor prismatic (e.g. a
        floating base).
    """
    chain = [j for j in model.supports[frame.parent_joint] if j > 0]
    motions = joint_motions(model)
    alone, parent = pin.Model(), 0
    for j in chain:
        if (motion := motions[j]) is None:
            return None
        kind, axis = motion
        aligned = np.flatnonzero(np.all(axis == np.eye(3), axis=1))
        if aligned.size:  # joints along x, y or z are exact to the last digit, and faster
            joint = getattr(pin, f"JointModel{kind}{'XYZ'[aligned[0]]}")()
        else:
            joint = pin.JointModelPrismaticUnaligned(axis) if kind == "P" else pin.JointModelRevoluteUnaligned(axis)
        parent = alone.addJoint(parent, joint, model.jointPlacements[j], model.names[j])
    if not chain:
        return None
    placement = model.frames[frame.index].placement
    index = alone.addFrame(pin.Frame(frame.name, parent, 0, placement, pin.FrameType.OP_FRAME))
    rows = [model.joints[j].idx_v for j in chain]
    coupling = coupling or full_coupling(model, blocks, ())
    return CarryingJoints(alone, index, coupling.lift[rows], coupling.offset[rows])


def joint_motions(model: pin.Model) -> list[tuple[Literal["R", "P"], Float[np.ndarray, " 3"]] | None]:
    """Return the type of each joint of a model, revolute (`"R"`) or prismatic (`"P"`), and its axis in its own frame.

    Args:
        model: Pinocchio model.

    Returns:
        One entry per Pinocchio joint id: type and axis (3,). None for the world, for a joint with more degrees of
        freedom, and for a screw joint.
    """
    data, out = model.createData(), list[tuple[Literal["R", "P"], np.ndarray] | None]([None])
    pin.forwardKinematics(model, data, pin.neutral(model), np.zeros(model.nv))
    for j in range(1, model.njoints):
        motion = np.array(data.joints[j].S, dtype=np.float64).reshape(-1)  # its motion subspace
        linear, angular = motion[:3], motion[3:6]
        is_one = motion.shape == (6,) and not (np.any(linear) and np.any(angular))
        out.append((("P", linear) if np.any(linear) else ("R", angular)) if is_one else None)
    return out
