"""Kinematics of one frame at many postures: NumPy on structures of arrays, Pinocchio as fallback."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import final
from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.robot.batch.chain import (
    Chain,
    ChainColumns,
    ChainMotion,
    SweepBuffers,
    chain_to,
    jacobian_vjp,
    sweep,
    tip_position,
    write_derivative,
    write_jacobian,
)
from manip_learn.robot.batch.postures import checked_postures
from manip_learn.robot.joints import Frame, carrying_joints
from manip_learn.robot.robot import Reference, Robot

CHUNK = 1024  # postures: the columns of a 7-joint chain then stay in a second-level cache of 1 MB
DERIVATIVE_CHUNK = 256  # dJ/dq has as many numbers for each column as the chain has joints
ALL_ROWS = (0, 1, 2, 3, 4, 5)  # of a twist

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
        self._robot = robot
        self._frame = frame
        carried = carrying_joints(robot.pinocchio_model, frame, robot.blocks, robot.coupling)
        chain = None if carried is None else chain_to(carried)
        self.fast = chain is not None
        if carried is not None and chain is not None:
            self._chain: Chain = chain
            self._reversed = chain.reversed()
            self._columns = ChainColumns(robot, carried)

    def jacobian(
        self,
        q: ArrayLike,
        reference: Reference = "world",
        rows: Sequence[int] = ALL_ROWS,
    ) -> Float[np.ndarray, "n p nv"]:
        """Frame Jacobians, linear rows first [m/s, rad/s per unit joint velocity].

        Args:
            q: Postures, one per row: configurations (nq) or joint positions (nv).
            reference: Along the base axes (`"world"`) or the frame's own (`"local"`).
            rows: Which of x y z rx ry rz, as 0 .. 5.

        Raises:
            ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        """
        return self._tables(q, reference, rows, derivative=False)[0]

    def jacobian_and_derivative(
        self,
        q: ArrayLike,
        reference: Reference = "world",
        rows: Sequence[int] = ALL_ROWS,
    ) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Frame Jacobians J and dJ/dq; entry [n, i, j, k] = d J_ij / d q_k along tangent coordinate k, exact.

        Arguments and errors as for `jacobian`.
        """
        return self._tables(q, reference, rows, derivative=True)

    def vjp(
        self,
        q: ArrayLike,
        weigh: Callable[[Float[np.ndarray, "p nv n"], slice], Float[np.ndarray, "p nv n"]],
        reference: Reference = "world",
        rows: Sequence[int] = ALL_ROWS,
    ) -> Float[np.ndarray, "n nv"]:
        """sum_ij weights_ij dJ_ij / dq_k, with weights that `weigh` makes from J, chunk by chunk.

        The derivative itself is never formed: time and memory grow with the joints, not with their square.

        Args:
            q: Postures, one per row.
            weigh: (J, which postures) -> weights, both (p, nv, n) with the postures last.
            reference: As in `jacobian`.
            rows: As in `jacobian`.
        """
        postures = checked_postures(self._robot, q)
        out = np.zeros((self._robot.nv, len(postures)))
        if not self.fast:
            for start in range(0, len(postures), DERIVATIVE_CHUNK):
                part = slice(start, min(start + DERIVATIVE_CHUNK, len(postures)))
                J, H = self._looped(postures[part], reference, rows)
                out[:, part] = np.einsum("ijn,nijk->kn", weigh(J.transpose(1, 2, 0), part), H)
            return out.T
        for part, motion in self._motions(postures, reference, CHUNK):
            J = self._new_table(len(rows), self._robot.nv, part.stop - part.start)
            write_jacobian(motion, rows, self._columns, J)
            weights = np.zeros((6, *motion.w.shape[1:]))
            weights[list(rows)] = self._columns.gather(weigh(J, part))
            self._columns.scatter(jacobian_vjp(motion, weights), out[:, part])
        return out.T

    def pose(self, q: ArrayLike) -> Float[np.ndarray, "n 4 4"]:
        """Homogeneous transforms from the frame to the robot's base [m]."""
        postures = checked_postures(self._robot, q)
        out = np.zeros((4, 4, len(postures)))
        out[3, 3] = 1.0
        if not self.fast:
            for i, posture in enumerate(postures):
                out[..., i] = self._robot.pose(posture, self._frame)
            return out.transpose(2, 0, 1)
        for part, buffers in self._chunks(len(postures), CHUNK):
            tip = sweep(self._chain, self._columns.positions(postures[part]), buffers)
            here = out[..., part]
            here[:3, 3] = tip_position(tip, self._chain.tool_position, buffers.work)
            for j, turn in enumerate(self._chain.tool_rotation.T):
                here[:3, j] = turn[0] * tip.x + turn[1] * tip.y + turn[2] * tip.z
        return out.transpose(2, 0, 1)

    # ---- plumbing -------------------------------------------------------------------------------------------------

    def _tables(
        self,
        q: ArrayLike,
        reference: Reference,
        rows: Sequence[int],
        *,
        derivative: bool,
    ) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "m p nv nv"]]:
        """J, and dJ/dq, which has no entries unless it is asked for (or comes from Pinocchio's loop)."""
        postures = checked_postures(self._robot, q)
        if not self.fast:
            return self._looped(postures, reference, rows)
        p, n, nv = len(rows), len(postures), self._robot.nv
        J, H = self._new_table(p, nv, n), self._new_table(p, nv, nv, n if derivative else 0)
        for part, motion in self._motions(postures, reference, DERIVATIVE_CHUNK if derivative else CHUNK):
            write_jacobian(motion, rows, self._columns, J[..., part])
            if derivative:
                write_derivative(motion, rows, self._columns, H[..., part])
        return J.transpose(2, 0, 1), H.transpose(3, 0, 1, 2)

    def _motions(self, postures: np.ndarray, reference: str, chunk: int) -> Iterator[tuple[slice, ChainMotion]]:
        """Axes and lever arms of the joints, base first, chunk by chunk; each overwrites the one before."""
        for part, buffers in self._chunks(len(postures), chunk):
            position = self._columns.positions(postures[part])
            if reference == "world":
                tip = sweep(self._chain, position, buffers)
                point = tip_position(tip, self._chain.tool_position, buffers.work)
                np.subtract(point[:, None], buffers.origin, out=buffers.origin)
                axis, lever = buffers.axis, buffers.origin
            else:
                # seen from the frame, whose origin is then the zero: the lever arm is minus the joint's origin
                sweep(self._reversed, -position[::-1], buffers)
                np.negative(buffers.origin, out=buffers.origin)
                axis, lever = buffers.axis[:, ::-1], buffers.origin[:, ::-1]
            yield part, ChainMotion(axis, lever, self._chain.prismatic, reference)

    def _chunks(self, n: int, chunk: int) -> Iterator[tuple[slice, SweepBuffers]]:
        buffers = SweepBuffers.of(self._chain.size, min(n, chunk))
        for start in range(0, n, chunk):
            size = min(chunk, n - start)
            yield slice(start, start + size), buffers.first(size)

    def _new_table(self, *shape: int) -> np.ndarray:
        # columns of joints that do not carry the frame are never written
        return np.empty(shape) if self._columns.full else np.zeros(shape)

    def _looped(self, postures: np.ndarray, reference: Reference, rows: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        nv, chosen = self._robot.nv, list(rows)
        J, H = np.empty((len(postures), len(chosen), nv)), np.empty((len(postures), len(chosen), nv, nv))
        for i, posture in enumerate(postures):
            J_i, H_i = self._robot.jacobian_and_derivative(posture, self._frame, reference)
            J[i], H[i] = J_i[chosen], H_i[chosen]
        return J, H


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
