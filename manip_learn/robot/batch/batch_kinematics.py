"""Kinematics of one frame at many postures: NumPy on arrays with the postures last, Pinocchio as fallback.

Each joint axis is turned into the z axis of its own frame; each fixed rotation in between is split into
Rz(a) Rx(b) Rz(c), whose outer turns are added to the joint angles before and after it (as Denavit and Hartenberg do;
but no origin slides along its axis, which is what makes their form blow up for nearly parallel axes):

    base_from_frame = start . [joint 0] . fixed_1 . [joint 1] ... fixed_{n-1} . [joint n-1] . tool
    fixed_i = Trans(t_i) Rx(b_i),   [joint i] = Rz(q_i + offset_i) or Tz(q_i) Rz(offset_i)

so that a step along the chain turns two columns twice, and nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final
from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from manip_learn.robot.batch.postures import checked_postures, positions_of
from manip_learn.robot.joints import CarryingJoints, Frame, carrying_joints, motion_along
from manip_learn.robot.robot import Reference, Robot

POSTURE_CHUNK = 1024  # postures: the columns of a 7-joint chain then stay in a second-level cache of 1 MB
DERIVATIVE_CHUNK = 256  # dJ/dq has as many numbers for each column as the chain has joints
ALL_ROWS = (0, 1, 2, 3, 4, 5)  # of a twist
AFTER = ((1, 2), (2, 0), (0, 1))  # (a x b)_r = a_i b_j - a_j b_i with i, j = AFTER[r]

SNAP = 4e-16  # a right angle written in decimals misses 0 or 1 by this much

_KNOWN: WeakKeyDictionary[Robot, dict[int, BatchKinematics]] = WeakKeyDictionary()


def batch_kinematics(robot: Robot, frame: Frame) -> BatchKinematics:
    """The batch kinematics of a frame, made once per robot."""
    frames = _KNOWN.setdefault(robot, {})
    if frame.index not in frames:
        frames[frame.index] = BatchKinematics(robot, frame)
    return frames[frame.index]


@final
class BatchKinematics:
    """Jacobians, their derivatives and poses of one frame at many postures.

    Only the joints that carry the frame are computed. Chains of revolute, continuous and prismatic joints (mimic joints
    included) run in NumPy; all others call Pinocchio in a loop.

    Args:
        robot: The robot.
        frame: One of its frames.

    Attributes:
        fast: False if Pinocchio is called in a loop.
    """

    def __init__(self, robot: Robot, frame: Frame):
        self._robot, self._frame = robot, frame
        self._carried = carried = carrying_joints(robot.pinocchio_model, frame, robot.blocks, robot.coupling)
        self._chain = None if carried is None else _Chain.of(carried)
        self.fast = self._chain is not None

    def jacobian(
        self, q: ArrayLike, reference: Reference = "world", rows: Sequence[int] = ALL_ROWS
    ) -> Float[np.ndarray, "n p nv"]:
        """Frame Jacobians, linear rows first [m/s, rad/s per unit joint velocity].

        Args:
            q: Postures, one per row: configurations (nq) or joint positions (nv).
            reference: Along the base axes (`"world"`) or the frame's own (`"local"`).
            rows: Which of x y z rx ry rz, as 0 .. 5.

        Raises:
            ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        """
        postures, nv = checked_postures(self._robot, q), self._robot.nv
        if not self.fast:
            return self._looped(postures, reference, rows)[0]
        J = np.zeros((len(rows), nv, len(postures)))
        for part, v, w in self._motions(postures, reference, POSTURE_CHUNK):
            J[..., part] = self._public(np.concatenate([v, w])[list(rows)], 1)
        return J.transpose(2, 0, 1)

    def jacobian_and_derivative(
        self, q: ArrayLike, reference: Reference = "world", rows: Sequence[int] = ALL_ROWS
    ) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Frame Jacobians J and dJ/dq; entry [n, i, j, k] = d J_ij / d q_k along tangent coordinate k, exact.

        Arguments and errors as for `jacobian`.
        """
        postures, nv = checked_postures(self._robot, q), self._robot.nv
        if not self.fast:
            return self._looped(postures, reference, rows)
        J, H = np.zeros((len(rows), nv, len(postures))), np.zeros((len(rows), nv, nv, len(postures)))
        for part, v, w in self._motions(postures, reference, DERIVATIVE_CHUNK):
            J[..., part] = self._public(np.concatenate([v, w])[list(rows)], 1)
            for row, out in zip(rows, H, strict=True):
                out[..., part] = self._public(self._public(_derivative_row(v, w, row, reference), 0), 1)
        return J.transpose(2, 0, 1), H.transpose(3, 0, 1, 2)

    def pose(self, q: ArrayLike) -> Float[np.ndarray, "n 4 4"]:
        """Homogeneous transforms from the frame to the robot's base [m].

        Raises:
            ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        """
        postures = checked_postures(self._robot, q)
        out = np.zeros((len(postures), 4, 4))
        out[:, 3, 3] = 1.0
        if (chain := self._chain) is None:
            for i, posture in enumerate(postures):
                out[i] = self._robot.pose(posture, self._frame)
            return out
        for part in _chunks(len(postures), POSTURE_CHUNK):
            _, _, (x, y, z), p = chain.sweep(self._positions(postures[part]))
            out[part, :3, 3] = p.T
            for j, turn in enumerate(chain.tool_rotation.T):
                out[part, :3, j] = (turn[0] * x + turn[1] * y + turn[2] * z).T
        return out

    # ---- plumbing -------------------------------------------------------------------------------------------------

    def _positions(self, postures: Float[np.ndarray, "m width"]) -> Float[np.ndarray, "j m"]:
        """Positions of the chain's joints [rad or m], base first."""
        public, carried = positions_of(self._robot, postures).T, self._carried
        if carried is not None and carried.columns is not None:
            return np.ascontiguousarray(public[carried.columns])
        return public if carried is None else carried.lift @ public + carried.offset[:, None]

    def _motions(
        self, postures: Float[np.ndarray, "n width"], reference: Reference, chunk: int
    ) -> Iterator[tuple[slice, Float[np.ndarray, "3 j m"], Float[np.ndarray, "3 j m"]]]:
        """Linear and angular columns of the chain's joints, chunk by chunk."""
        if (chain := self._chain) is None:
            return
        for part in _chunks(len(postures), chunk):
            x = self._positions(postures[part])
            if reference == "world":
                w, origin, _, tip = chain.sweep(x)
                lever = tip[:, None] - origin
            else:  # seen from the frame, whose origin is then the zero
                w, origin, *_ = chain.reversed().sweep(-x[::-1])
                w, lever = w[:, ::-1].copy(), -origin[:, ::-1]
            v = np.stack([w[i] * lever[j] - w[j] * lever[i] for i, j in AFTER])
            v[:, chain.slides], w[:, chain.slides] = w[:, chain.slides], 0.0
            yield part, v, w

    def _public(self, values: Float[np.ndarray, "..."], axis: int) -> Float[np.ndarray, "..."]:
        """Entries of the chain's joints, along an axis, as those of the robot's, of which the others are zero."""
        moved, carried = np.moveaxis(values, axis, 0), self._carried
        if carried is None or carried.columns is None:  # mimic joints: an affine map of the robot's
            lift = np.eye(self._robot.nv) if carried is None else carried.lift
            return np.moveaxis(np.tensordot(lift.T, moved, axes=1), 0, axis)
        out = np.zeros((self._robot.nv, *moved.shape[1:]))
        out[carried.columns] = moved
        return np.moveaxis(out, 0, axis)

    def _looped(self, postures: np.ndarray, reference: Reference, rows: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        nv, chosen = self._robot.nv, list(rows)
        J, H = np.empty((len(postures), len(chosen), nv)), np.empty((len(postures), len(chosen), nv, nv))
        for i, posture in enumerate(postures):
            J_i, H_i = self._robot.jacobian_and_derivative(posture, self._frame, reference)
            J[i], H[i] = J_i[chosen], H_i[chosen]
        return J, H


@final
@dataclass(frozen=True)
class _Chain:
    """Joints of one degree of freedom that carry a frame, base first; see the formulas above.

    Attributes:
        slides: Whether a joint is prismatic.
        offset: Added to the joint angle [rad]; a prismatic joint turns by it, whatever its position.
        start_rotation, start_position: From the first joint's frame (joint at zero) to the base [m].
        tilt: cos b_i and sin b_i of the fixed turn before each joint; unused for the first.
        shift: t_i [m]; unused for the first.
        tool_rotation, tool_position: From the frame to the last joint's frame [m].
    """

    slides: Bool[np.ndarray, " j"]
    offset: Float[np.ndarray, " j"]
    start_rotation: Float[np.ndarray, "3 3"]
    start_position: Float[np.ndarray, " 3"]
    tilt: Float[np.ndarray, "j 2"]
    shift: Float[np.ndarray, "j 3"]
    tool_rotation: Float[np.ndarray, "3 3"]
    tool_position: Float[np.ndarray, " 3"]

    @staticmethod
    def of(carried: CarryingJoints) -> _Chain:
        """The chain from the base to the frame that those joints carry."""
        model, data = carried.model, carried.model.createData()
        pin.forwardKinematics(model, data, pin.neutral(model), np.zeros(model.nv))
        placements: list[tuple[np.ndarray, np.ndarray]] = []
        n, tool = model.njoints - 1, model.frames[carried.index].placement
        slides, offset, tilt, shift = (
            np.zeros(n, dtype=bool),
            np.zeros(n),
            np.tile([1.0, 0.0], (n, 1)),
            np.zeros((n, 3)),
        )
        turn = np.eye(3)  # from the z-along-the-axis frame of the joint before to the model's frame of that joint
        for j in range(n):
            kind, axis = motion_along(data.joints[j + 1].S) or ("R", np.eye(3)[2])
            M, slides[j] = model.jointPlacements[j + 1], kind == "P"
            helper = np.roll(np.eye(3)[int(np.argmax(np.abs(axis)))], 1)
            x = helper - (helper @ axis) * axis
            x /= np.linalg.norm(x)
            z_to_axis = np.stack([x, np.cross(axis, x), axis], axis=1)
            placements.append((turn.T @ M.rotation @ z_to_axis, turn.T @ M.translation))
            turn = z_to_axis
        for i in range(1, n):
            R, t = _snapped(placements[i][0]), placements[i][1]
            # (a, b, c) with R = Rz(a) Rx(b) Rz(c) and sin b >= 0
            tilt[i] = R[2, 2], math.hypot(R[0, 2], R[1, 2])
            a = math.atan2(R[0, 2], -R[1, 2]) if tilt[i, 1] > 0.0 else 0.0
            cos, sin = math.cos(a), math.sin(a)
            # c from what a and b leave over: for a tiny tilt a is ill determined, a + c is not
            offset[i - 1] += a
            offset[i] += math.atan2(-(cos * R[0, 1] + sin * R[1, 1]), cos * R[0, 0] + sin * R[1, 0])
            shift[i] = _snapped(np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ t)
        start, end = (_snapped(placements[0][0]), placements[0][1]), (turn.T @ tool.rotation, turn.T @ tool.translation)
        return _Chain(slides, offset, *start, tilt, shift, *map(_snapped, end))

    def reversed(self) -> _Chain:
        """The chain seen from the frame: frame_from_base, for Jacobians along the frame's own axes.

        Joint angles and offsets change their signs: joint i of the new chain is joint n-1-i moved by minus its value.
        """
        # (Trans(t) Rx(b))^-1 = Rx(-b) Trans(-t) = Trans(-Rx(-b) t) Rx(-b)
        (c, s), t = self.tilt.T, self.shift
        back = -np.stack([t[:, 0], c * t[:, 1] + s * t[:, 2], -s * t[:, 1] + c * t[:, 2]], axis=1)
        # the turn before joint i becomes the turn after it
        tilt, shift = (np.roll(x[::-1], 1, axis=0) for x in (np.stack([c, -s], axis=1), back))
        start, end = (
            (R.T.copy(), -R.T @ p)
            for R, p in ((self.tool_rotation, self.tool_position), (self.start_rotation, self.start_position))
        )
        return _Chain(self.slides[::-1], -self.offset[::-1], *start, tilt, shift, *end)

    def sweep(
        self, position: Float[np.ndarray, "j n"]
    ) -> tuple[
        Float[np.ndarray, "3 j n"],
        Float[np.ndarray, "3 j n"],
        tuple[Float[np.ndarray, "3 n"], Float[np.ndarray, "3 n"], Float[np.ndarray, "3 n"]],
        Float[np.ndarray, "3 n"],
    ]:
        """Axes and origins [m] of the joints, the columns of the last rotation, and the place of the frame [m]."""
        angle = np.where(self.slides[:, None], self.offset[:, None], position + self.offset[:, None])
        cos, sin = np.cos(angle), np.sin(angle)
        axis, origin = np.empty((2, 3, *position.shape))
        x, y, z = (np.repeat(column[:, None], position.shape[1], axis=1) for column in self.start_rotation.T)
        p = np.repeat(self.start_position[:, None], position.shape[1], axis=1)
        for i, (c, s) in enumerate(self.tilt):
            if i:
                p = _shifted(p, x, y, z, self.shift[i])
                y, z = y * c + z * s, z * c - y * s
            if self.slides[i]:
                p = p + z * position[i]
            axis[:, i], origin[:, i] = z, p
            x, y = x * cos[i] + y * sin[i], y * cos[i] - x * sin[i]
        return axis, origin, (x, y, z), _shifted(p, x, y, z, self.tool_position)


def _shifted(p: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray, t: np.ndarray) -> np.ndarray:
    """P + [x y z] t, leaving out the zeros of t, of which a chain has many."""
    for column, length in ((x, t[0]), (y, t[1]), (z, t[2])):
        if length != 0.0:
            p = p + column * length
    return p


def _snapped(x: np.ndarray) -> np.ndarray:
    nearest = np.rint(x)
    return np.where((np.abs(x - nearest) < SNAP) & (np.abs(nearest) <= 1.0), nearest, x)


def _chunks(n: int, size: int) -> list[slice]:
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]


def _derivative_row(
    v: Float[np.ndarray, "3 j n"], w: Float[np.ndarray, "3 j n"], row: int, reference: Reference
) -> Float[np.ndarray, "j j n"]:
    """One row of dJ/dq: entry [i, k] = d J_i / d q_k (see `frame_kinematics.closed_form`)."""
    (a, b), c = AFTER[row % 3], v if row < 3 else w
    is_below = np.triu(np.ones((v.shape[1],) * 2, dtype=bool), 1)[..., None]  # k below i
    turned = w[a][:, None] * c[b] - w[b][:, None] * c[a]  # of w_i x c_k
    if reference == "world":
        # the joint above turns the velocity that the lower one gives, whichever of the two the derivative is along
        return np.where(is_below, turned if row < 3 else 0.0, turned.swapaxes(0, 1))
    if row < 3:
        turned += v[a][:, None] * w[b]
        turned -= v[b][:, None] * w[a]
    return np.where(is_below, turned, 0.0)


def link_twists(robot: Robot, frame: Frame, q: Float[np.ndarray, "n nv"]) -> Float[np.ndarray, "l n 6 6"] | None:
    """Twists of a frame, along the base's axes and at its origin, that unit errors of each of l links make: three of
    their places, three of their turns. None where other joints than those that turn or slide carry it.
    """
    if not batch_kinematics(robot, frame).fast:
        return None
    model = robot.pinocchio_model
    joints = [j for j in model.supports[frame.parent_joint] if j > 0]
    frames = [Frame(model.names[j], model.getFrameId(model.names[j], pin.FrameType.JOINT), j) for j in joints]
    poses = np.stack([batch_kinematics(robot, f).pose(q) for f in (*frames, frame)])
    turn, lever = poses[:-1, :, :3, :3], poses[-1, :, :3, 3] - poses[1:, :, :3, 3]
    twists = np.zeros((len(joints), len(q), 6, 6))
    twists[..., :3, :3] = twists[..., 3:, 3:] = turn
    twists[..., :3, 3:] = np.cross(turn, lever[..., None], axisa=2, axisb=2, axisc=2)
    return twists
