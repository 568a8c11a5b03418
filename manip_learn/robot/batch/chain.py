"""The joints between the base and one frame, and their Jacobian columns at many postures.

Each joint axis is turned into the z axis of its own frame; each fixed rotation in between is split into
Rz(a) Rx(b) Rz(c), whose outer turns are added to the joint angles before and after it (as Denavit and Hartenberg do;
but no origin slides along its axis, which is what makes their form blow up for nearly parallel axes):

    base_from_frame = start . [joint 0] . fixed_1 . [joint 1] ... fixed_{n-1} . [joint n-1] . tool
    fixed_i = Trans(t_i) Rx(b_i),   [joint i] = Rz(q_i + offset_i) or Tz(q_i) Rz(offset_i)

so that a step along the chain turns two columns twice, and nothing else.

Arrays of many postures are (3, n) or (3, joints, n): component, joint (base first), posture. The postures come last, so
that every NumPy call runs over contiguous memory that fits into the second-level cache.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float

from manip_learn.robot.batch.postures import positions_of
from manip_learn.robot.joints import CarryingJoints, motion_along
from manip_learn.robot.robot import Robot

SNAP = 4e-16  # a right angle written in decimals misses 0 or 1 by this much
AFTER = ((1, 2), (2, 0), (0, 1))  # (a x b)_r = a_i b_j - a_j b_i with i, j = AFTER[r]


@final
@dataclass(frozen=True)
class Chain:
    """Joints of one degree of freedom that carry a frame, base first.

    Attributes:
        prismatic: True where the joint slides, shape (n,).
        offset: Added to the joint angle [rad], shape (n,); a prismatic joint turns by it, whatever its position.
        start_rotation: From the first joint's frame (joint at zero) to the base, shape (3, 3).
        start_position: Origin of the first joint's frame in the base [m], shape (3,).
        tilt_cos: cos b_i of the fixed turn before joint i, shape (n,); unused for the first.
        tilt_sin: sin b_i, shape (n,).
        shift: t_i [m], shape (n, 3); unused for the first.
        tool_rotation: From the frame to the last joint's frame, shape (3, 3).
        tool_position: Origin of the frame in the last joint's frame [m], shape (3,).
    """

    prismatic: Bool[np.ndarray, " n"]
    offset: Float[np.ndarray, " n"]
    start_rotation: Float[np.ndarray, "3 3"]
    start_position: Float[np.ndarray, " 3"]
    tilt_cos: Float[np.ndarray, " n"]
    tilt_sin: Float[np.ndarray, " n"]
    shift: Float[np.ndarray, "n 3"]
    tool_rotation: Float[np.ndarray, "3 3"]
    tool_position: Float[np.ndarray, " 3"]

    @property
    def size(self) -> int:
        """Number of joints n."""
        return len(self.prismatic)

    def reversed(self) -> Chain:
        """The chain seen from the frame: frame_from_base, for Jacobians along the frame's own axes.

        Joint angles and offsets change their signs: joint i of the new chain is joint n-1-i moved by minus its value.
        """
        # (Trans(t) Rx(b))^-1 = Rx(-b) Trans(-t) = Trans(-Rx(-b) t) Rx(-b)
        c, s, t = self.tilt_cos, self.tilt_sin, self.shift
        back = -np.stack([t[:, 0], c * t[:, 1] + s * t[:, 2], -s * t[:, 1] + c * t[:, 2]], axis=1)

        def moved(x: np.ndarray) -> np.ndarray:
            # the turn before joint i becomes the turn after it
            return np.roll(x[::-1], 1, axis=0)

        return Chain(
            prismatic=self.prismatic[::-1].copy(),
            offset=-self.offset[::-1],
            start_rotation=self.tool_rotation.T.copy(),
            start_position=-self.tool_rotation.T @ self.tool_position,
            tilt_cos=moved(c),
            tilt_sin=moved(-s),
            shift=moved(back),
            tool_rotation=self.start_rotation.T.copy(),
            tool_position=-self.start_rotation.T @ self.start_position,
        )


def chain_to(carried: CarryingJoints) -> Chain | None:
    """The chain from the base to the frame that those joints carry; None if an axis is not of unit length."""
    model = carried.model
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model), np.zeros(model.nv))
    placements: list[tuple[np.ndarray, np.ndarray]] = []
    prismatic: list[bool] = []
    turn = np.eye(3)  # from the z-along-the-axis frame of the joint before to the model's frame of that joint
    for j in range(1, model.njoints):
        along = motion_along(data.joints[j].S)
        if along is None or abs(float(np.linalg.norm(along[1])) - 1.0) > 1e-12:
            return None
        slides, axis = along[0] == "P", along[1]
        M, z_to_axis = model.jointPlacements[j], _turn_z_to(axis)
        placements.append((turn.T @ M.rotation @ z_to_axis, turn.T @ M.translation))
        prismatic.append(slides)
        turn = z_to_axis
    n, tool = len(prismatic), model.frames[carried.index].placement
    offset, tilt_cos, tilt_sin, shift = np.zeros(n), np.ones(n), np.zeros(n), np.zeros((n, 3))
    for i in range(1, n):
        R, t = placements[i]
        a, tilt_cos[i], tilt_sin[i], c = _split_zxz(R)
        offset[i - 1] += a
        cos, sin = math.cos(a), math.sin(a)
        shift[i] = _snapped(np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ t)
        offset[i] += c
    return Chain(
        prismatic=np.array(prismatic, dtype=bool),
        offset=offset,
        start_rotation=_snapped(placements[0][0]),
        start_position=placements[0][1],
        tilt_cos=tilt_cos,
        tilt_sin=tilt_sin,
        shift=shift,
        tool_rotation=_snapped(turn.T @ tool.rotation),
        tool_position=_snapped(turn.T @ tool.translation),
    )


def _split_zxz(R: np.ndarray) -> tuple[float, float, float, float]:
    """(a, cos b, sin b, c) with R = Rz(a) Rx(b) Rz(c) and sin b >= 0."""
    R = _snapped(R)
    sin_b, cos_b = math.hypot(R[0, 2], R[1, 2]), float(R[2, 2])
    a = math.atan2(R[0, 2], -R[1, 2]) if sin_b > 0.0 else 0.0
    # c from what a and b leave over: for a tiny tilt a is ill determined, a + c is not
    x = math.cos(a) * R[0, 0] + math.sin(a) * R[1, 0]
    y = math.cos(a) * R[0, 1] + math.sin(a) * R[1, 1]
    return a, cos_b, sin_b, math.atan2(-y, x)


def _turn_z_to(axis: np.ndarray) -> np.ndarray:
    """A rotation whose third column is the unit vector `axis`; a permutation if it is a positive coordinate axis."""
    helper = np.roll(np.eye(3)[int(np.argmax(np.abs(axis)))], 1)
    x = helper - (helper @ axis) * axis
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def _snapped(x: np.ndarray) -> np.ndarray:
    nearest = np.rint(x)
    return np.where((np.abs(x - nearest) < SNAP) & (np.abs(nearest) <= 1.0), nearest, x)


@final
class ChainColumns:
    """Which public joint moves which joint of the chain.

    Attributes:
        full: True if every public joint moves the chain, so that no column of a Jacobian is zero by construction.
        public: Public column of each joint of the chain, shape (j,); None where mimic joints are among them.
    """

    def __init__(self, robot: Robot, carried: CarryingJoints):
        self._robot = robot
        # mimic joints: the chain's joints are an affine map of the public ones
        self._lift, self._offset = (carried.lift if carried.columns is None else None), carried.offset[:, None]
        self._select = slice(0, 0) if carried.columns is None else carried.columns
        self.public = None if carried.columns is None else np.arange(robot.nv)[carried.columns]
        self.full = self.public is not None and len(self.public) == robot.nv

    def positions(self, postures: Float[np.ndarray, "n width"]) -> Float[np.ndarray, "j n"]:
        """Positions of the chain's joints [rad or m], base first."""
        public = positions_of(self._robot, postures).T
        if self._lift is not None:
            return self._lift @ public + self._offset
        return np.ascontiguousarray(public[self._select])

    def view(self, out: Float[np.ndarray, "... nv n"]) -> Float[np.ndarray, "... j n"] | None:
        """The part of a public array that belongs to the chain's joints, or None where that is no view."""
        return out[..., self._select, :] if isinstance(self._select, slice) and self._lift is None else None

    def scatter(self, values: Float[np.ndarray, "... j n"], out: Float[np.ndarray, "... nv n"]) -> None:
        """Columns of the chain's joints into public columns; the others are left alone (or 0 with mimic joints)."""
        if self._lift is not None:
            np.matmul(self._lift.T, values, out=out)
        else:
            out[..., self._select, :] = values

    def scatter_pairs(self, values: Float[np.ndarray, "p j j n"], out: Float[np.ndarray, "p nv nv n"]) -> None:
        """Derivatives by the chain's joints into public columns, in both joint axes."""
        if self._lift is not None:
            out[...] = np.einsum("pabn,aj,bk->pjkn", values, self._lift, self._lift, optimize=True)
        elif isinstance(self._select, slice):
            out[:, self._select, self._select] = values
        else:
            out[:, self._select[:, None], self._select[None, :]] = values

    def gather(self, weights: Float[np.ndarray, "p nv n"]) -> Float[np.ndarray, "p j n"]:
        """The transpose of `scatter`: weights of public columns as weights of the chain's."""
        if self._lift is not None:
            return np.matmul(self._lift, weights)
        return weights[:, self._select]


@final
class SweepBuffers(NamedTuple):
    """Memory of one chunk, used again for the next; belongs to one call, so that threads never share it.

    Attributes:
        axis: shape (3, joints, n), unit axis of each joint.
        origin: shape (3, joints, n) [m], origin of each joint's frame.
        scratch: shape (6, 3, n).
        work: shape (2, 3, n), free after a sweep.
    """

    axis: Float[np.ndarray, "3 j n"]
    origin: Float[np.ndarray, "3 j n"]
    scratch: Float[np.ndarray, "6 3 n"]
    work: Float[np.ndarray, "2 3 n"]

    @staticmethod
    def of(joints: int, n: int) -> SweepBuffers:
        """Memory for a chain of that many joints and chunks of n postures."""
        return SweepBuffers(*map(np.empty, ((3, joints, n), (3, joints, n), (6, 3, n), (2, 3, n))))

    def first(self, n: int) -> SweepBuffers:
        """The part for a last, smaller chunk."""
        return SweepBuffers(*(array[..., :n] for array in self))


@final
class Tip(NamedTuple):
    """Pose of the last joint's frame after its motion; columns of the rotation and the origin, each (3, n)."""

    x: Float[np.ndarray, "3 n"]
    y: Float[np.ndarray, "3 n"]
    z: Float[np.ndarray, "3 n"]
    origin: Float[np.ndarray, "3 n"]


def sweep(chain: Chain, position: Float[np.ndarray, "j n"], buffers: SweepBuffers) -> Tip:
    """Fill `buffers.axis` and `buffers.origin`, base first, and return the pose at the end of the chain.

    Args:
        chain: The chain.
        position: Joint positions [rad or m] in the chain's order, offsets not yet added.
        buffers: Overwritten; the returned tip points into it.
    """
    axis, origin = buffers.axis, buffers.origin
    x_now, x_next, y_now, y_next, y_tilted, work = buffers.scratch
    angle = position + chain.offset[:, None]
    if chain.prismatic.any():
        angle[chain.prismatic] = chain.offset[chain.prismatic, None]
    cos, sin = np.cos(angle), np.sin(angle)

    x, y, z = (column[:, None] for column in chain.start_rotation.T)
    for i in range(chain.size):
        p, w = origin[:, i], axis[:, i]
        if i == 0:
            p[...], w[...] = chain.start_position[:, None], z
        else:
            _shift(origin[:, i - 1], x, y, z, chain.shift[i], p, work)
            y = _tilt(y, z, chain.tilt_cos[i], chain.tilt_sin[i], w, y_tilted, work)
        z = w
        if chain.prismatic[i]:
            p += np.multiply(z, position[i], out=work)
        np.multiply(x, cos[i], out=x_next)
        x_next += np.multiply(y, sin[i], out=work)
        np.multiply(y, cos[i], out=y_next)
        y_next -= np.multiply(x, sin[i], out=work)
        x, y = x_next, y_next
        x_now, x_next, y_now, y_next = x_next, x_now, y_next, y_now
    return Tip(x, y, z, origin[:, -1])


def tip_position(
    tip: Tip, offset: Float[np.ndarray, " 3"], work: Float[np.ndarray, "2 3 n"]
) -> Float[np.ndarray, "3 n"]:
    """Place of a point fixed to the last joint's frame [m]."""
    out = work[0]
    _shift(tip.origin, tip.x, tip.y, tip.z, offset, out, work[1])
    return out


def _shift(
    p: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray, t: np.ndarray, out: np.ndarray, work: np.ndarray
) -> None:
    """Out = p + [x y z] t, leaving out the zeros of t."""
    start = p
    for column, length in ((x, t[0]), (y, t[1]), (z, t[2])):
        if length != 0.0:
            np.add(start, np.multiply(column, length, out=work), out=out)
            start = out
    if start is p:
        out[...] = p


def _tilt(
    y: np.ndarray, z: np.ndarray, c: float, s: float, z_out: np.ndarray, y_out: np.ndarray, work: np.ndarray
) -> np.ndarray:
    """Turn (y, z) about x: z goes into `z_out`, the new y comes back. Right angles cost no multiplication."""
    if c == 1.0 and s == 0.0:  # a tilt of 1e-9 has a cosine of 1, too
        z_out[...] = z
        return y
    if c == 0.0 and s == 1.0:
        np.negative(y, out=z_out)
        return z
    np.multiply(z, c, out=z_out)
    z_out -= np.multiply(y, s, out=work)
    np.multiply(y, c, out=y_out)
    y_out += np.multiply(z, s, out=work)
    return y_out


@final
class ChainMotion:
    """Columns (v_j, w_j) of a frame's Jacobian: (w_j x lever_j, w_j) if joint j turns, (axis, 0) if it slides.

    Args:
        axis: Unit axes of the joints, along the base axes or the frame's own; may be overwritten.
        lever: From the joint to the frame's origin [m].
        prismatic: Which joints slide.
        reference: `"world"` or `"local"`: along which axes.

    Attributes:
        w: Angular columns.
        reference: As given.
    """

    def __init__(
        self,
        axis: Float[np.ndarray, "3 j n"],
        lever: Float[np.ndarray, "3 j n"],
        prismatic: Bool[np.ndarray, " j"],
        reference: str,
    ):
        self.w = axis
        self.reference = reference
        self._lever = lever
        self._sliding = np.flatnonzero(prismatic)
        self._slides = axis[:, self._sliding]  # a copy
        self._v: np.ndarray | None = None
        if self._sliding.size:
            self.w[:, self._sliding] = 0.0

    def write_linear(self, r: int, out: Float[np.ndarray, "j n"], work: Float[np.ndarray, "j n"]) -> None:
        """Component r of the linear columns."""
        cross_row(self.w, self._lever, r, out, work)
        if self._sliding.size:
            out[self._sliding] = self._slides[r]

    @property
    def v(self) -> Float[np.ndarray, "3 j n"]:
        """Linear columns."""
        if self._v is None:
            self._v = np.empty(self.w.shape)
            work = np.empty(self.w.shape[1:])
            for r in range(3):
                self.write_linear(r, self._v[r], work)
        return self._v


def write_jacobian(
    motion: ChainMotion, rows: Sequence[int], columns: ChainColumns, out: Float[np.ndarray, "p nv n"]
) -> None:
    """Rows (0 .. 5: x y z rx ry rz) of the Jacobian into public columns."""
    joints, n = motion.w.shape[1:]
    work = np.empty((2, joints, n))
    for target, row in zip(out, rows, strict=True):
        if row >= 3:
            columns.scatter(motion.w[row - 3], target)
            continue
        direct = columns.view(target)
        motion.write_linear(row, work[0] if direct is None else direct, work[1])
        if direct is None:
            columns.scatter(work[0], target)


def write_derivative(
    motion: ChainMotion, rows: Sequence[int], columns: ChainColumns, out: Float[np.ndarray, "p nv nv n"]
) -> None:
    """Rows of dJ/dq into public columns: entry [r, i, k] = d J_ri / d q_k (see `frame_kinematics.closed_form`)."""
    joints, n = motion.w.shape[1:]
    block = np.empty((1, joints, joints, n))
    for position, row in enumerate(rows):
        _write_row(motion, row, block[0])
        columns.scatter_pairs(block, out[position : position + 1])


def _write_row(motion: ChainMotion, row: int, out: Float[np.ndarray, "j j n"]) -> None:
    w, r, is_linear, is_world = motion.w, row % 3, row < 3, motion.reference == "world"
    column = motion.v if is_linear else w
    work = np.empty(out.shape[1:])
    for k in range(w.shape[1]):
        first = k if is_world else k + 1
        into, scratch = (out[first:, k] if is_world else out[k, first:]), work[first:]
        # w_k x v_i of every joint i below k: the joint above turns the velocity that the lower one gives,
        cross_row(w[:, k, None], column[:, first:], r, into, scratch)
        if is_world:  # whichever of the two the derivative is along
            out[k, k:] = into if is_linear else 0.0
            continue
        if is_linear:
            i, j = AFTER[r]
            into += np.multiply(column[i, k], w[j, first:], out=scratch)
            into -= np.multiply(column[j, k], w[i, first:], out=scratch)
        out[k:, k] = 0.0


def jacobian_vjp(motion: ChainMotion, weights: Float[np.ndarray, "6 j n"]) -> Float[np.ndarray, "j n"]:
    """sum_ri weights_ri dJ_ri / dq_k for each joint k, in time linear in the joints and without dJ/dq.

    The sums over the joints below or above k are running sums of cross products.
    """
    w, v, cv, cw = motion.w, motion.v, weights[:3], weights[3:]
    out = np.zeros(w.shape[1:])
    if motion.reference == "world":
        moment = np.cumsum((cross(v, cv) + cross(w, cw))[:, ::-1], axis=1)[:, ::-1]
        force = np.cumsum(cross(cv, w), axis=1)
        out += np.sum(w * moment, axis=0)
        out[1:] += np.sum(v[:, 1:] * force[:, :-1], axis=0)
        return out
    force = np.cumsum(cross(cv, w), axis=1)[:, :-1]
    moment = np.cumsum(cross(cv, v) + cross(cw, w), axis=1)[:, :-1]
    out[1:] = np.sum(v[:, 1:] * force + w[:, 1:] * moment, axis=0)
    return out


def cross_row(a: np.ndarray, b: np.ndarray, r: int, out: np.ndarray, work: np.ndarray) -> None:
    """Component r of a x b, for arrays (3, ...) that broadcast against each other."""
    i, j = AFTER[r]
    np.multiply(a[i], b[j], out=out)
    out -= np.multiply(a[j], b[i], out=work)


def cross(a: Float[np.ndarray, "3 j n"], b: Float[np.ndarray, "3 j n"]) -> Float[np.ndarray, "3 j n"]:
    """A x b over the first axis."""
    return np.stack([a[i] * b[j] - a[j] * b[i] for i, j in AFTER])
