"""Kinematics of one frame at many postures: NumPy on arrays with the postures last, Pinocchio as fallback.

With the rotation R and the origin p of one joint's frame, those of the next one are

    R_next = R M (I + sin q [a]x + (1 - cos q) [a]x^2),    p_next = p + R t,    axis = R M a,

M and t the placement of the next joint, a its unit axis: one product of R with a constant matrix for each joint.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import final
from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.robot.batch.postures import checked_postures, positions_of
from manip_learn.robot.joints import Frame, carrying_joints, motion_along
from manip_learn.robot.robot import Reference, Robot
from manip_learn.robot.rotations import skew

CHUNK = 1024  # postures: the columns of a 7-joint chain then stay in a second-level cache of 1 MB
DERIVATIVE_CHUNK = 256  # dJ/dq has as many numbers for each column as the chain has joints
ALL_ROWS = (0, 1, 2, 3, 4, 5)  # of a twist
AFTER = ((1, 2), (2, 0), (0, 1))  # (a x b)_r = a_i b_j - a_j b_i with i, j = AFTER[r]

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
        self.fast = carried is not None
        self._lift = np.eye(robot.nv) if carried is None else carried.lift
        self._steps: list[tuple[bool, Float[np.ndarray, "11 3"]]] = []
        if carried is None:
            return
        model, data = carried.model, carried.model.createData()
        pin.forwardKinematics(model, data, pin.neutral(model), np.zeros(model.nv))
        for j in range(1, model.njoints):
            if (along := motion_along(data.joints[j].S)) is not None:
                M, K = model.jointPlacements[j], skew(along[1])
                turns = (M.rotation.T, (M.rotation @ K).T, (M.rotation @ K @ K).T)
                self._steps.append((along[0] == "P", np.vstack([*turns, M.rotation @ along[1], M.translation])))
        tool = model.frames[carried.index].placement
        self._tool = np.vstack([tool.rotation.T, tool.translation])

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
        for part, v, w in self._motions(postures, reference, CHUNK):
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
        for part in _chunks(len(postures), CHUNK) if self.fast else ():
            *_, R, p = self._sweep(postures[part])
            out[part, :3, :3], out[part, :3, 3] = R.transpose(2, 0, 1), p.T
        for i, posture in enumerate(postures if not self.fast else ()):
            out[i] = self._robot.pose(posture, self._frame)
        return out

    # ---- plumbing -------------------------------------------------------------------------------------------------

    def _sweep(
        self, postures: Float[np.ndarray, "n width"]
    ) -> tuple[
        Float[np.ndarray, "3 j n"], Float[np.ndarray, "3 j n"], Float[np.ndarray, "3 3 n"], Float[np.ndarray, "3 n"]
    ]:
        """Axes and origins [m] of the chain's joints, base first, and rotation and origin of the frame."""
        carried, x = self._carried, positions_of(self._robot, postures).T
        if carried is not None:
            x = self._lift @ x + carried.offset[:, None] if carried.columns is None else x[carried.columns]
        sine, rest = np.sin(x), 1.0 - np.cos(x)
        R, p = np.repeat(np.eye(3)[:, :, None], x.shape[1], axis=2), np.zeros((3, x.shape[1]))
        axis, origin = np.empty((2, 3, *x.shape))
        for i, (slides, step) in enumerate(self._steps):
            out = step @ R
            R, axis[:, i], p = out[:, :3], out[:, 9], p + out[:, 10]
            if slides:
                p += x[i] * axis[:, i]
            else:
                R = R + sine[i] * out[:, 3:6]
                R += rest[i] * out[:, 6:9]
            origin[:, i] = p
        out = self._tool @ R
        return axis, origin, out[:, :3], p + out[:, 3]

    def _motions(
        self, postures: Float[np.ndarray, "n width"], reference: Reference, chunk: int
    ) -> Iterator[tuple[slice, Float[np.ndarray, "3 j m"], Float[np.ndarray, "3 j m"]]]:
        """Linear and angular columns of the chain's joints, chunk by chunk."""
        slides = [slides for slides, _ in self._steps]
        for part in _chunks(len(postures), chunk):
            w, origin, R, p = self._sweep(postures[part])
            lever = p[:, None] - origin
            v = np.stack([w[i] * lever[j] - w[j] * lever[i] for i, j in AFTER])
            v[:, slides], w[:, slides] = w[:, slides], 0.0
            if reference == "local":
                v, w = (np.einsum("cdn,cjn->djn", R, x) for x in (v, w))
            yield part, v, w

    def _public(self, values: Float[np.ndarray, "..."], axis: int) -> Float[np.ndarray, "..."]:
        """Entries of the chain's joints, along an axis, as those of the robot's, of which the others are zero."""
        moved, carried = np.moveaxis(values, axis, 0), self._carried
        if carried is None or carried.columns is None:  # mimic joints: an affine map of the robot's
            return np.moveaxis(np.tensordot(self._lift.T, moved, axes=1), 0, axis)
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
        turned += v[a][:, None] * w[b] - v[b][:, None] * w[a]
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
