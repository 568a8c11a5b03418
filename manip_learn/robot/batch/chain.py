"""The joints between the base and one frame, rewritten for batch kinematics.

Each joint axis is turned into the z axis of its own frame; each fixed rotation in between is split into
Rz(a) Rx(b) Rz(c), whose outer turns are added to the joint angles before and after it (as Denavit and Hartenberg do;
but no origin slides along its axis, which is what makes their form blow up for nearly parallel axes):

    base_from_frame = start . [joint 0] . fixed_1 . [joint 1] ... fixed_{n-1} . [joint n-1] . tool
    fixed_i = Trans(t_i) Rx(b_i),   [joint i] = Rz(q_i + offset_i) or Tz(q_i) Rz(offset_i)

so that a step along the chain turns two columns twice, and nothing else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float, Int

from manip_learn.robot.batch.postures import positions_of
from manip_learn.robot.frame import Frame
from manip_learn.robot.robot import Robot

SNAP = 4e-16  # a right angle written in decimals misses 0 or 1 by this much


@final
@dataclass(frozen=True)
class Chain:
    """Joints of one degree of freedom that carry a frame, base first.

    Attributes:
        columns: Column of each joint in Pinocchio's tangent vector, shape (n,).
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

    columns: Int[np.ndarray, " n"]
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
        return int(self.columns.shape[0])

    def reversed(self) -> Chain:
        """The same joints seen from the frame: frame_from_base, for Jacobians along the frame's own axes.

        Joint angles and offsets change their signs: joint i of the new chain is joint n-1-i moved by minus its value.
        """
        # (Trans(t) Rx(b))^-1 = Rx(-b) Trans(-t) = Trans(-Rx(-b) t) Rx(-b)
        c, s, t = self.tilt_cos, self.tilt_sin, self.shift
        back = -np.stack([t[:, 0], c * t[:, 1] + s * t[:, 2], -s * t[:, 1] + c * t[:, 2]], axis=1)

        def moved(x: np.ndarray) -> np.ndarray:
            # the turn before joint i becomes the turn after it
            return np.roll(x[::-1], 1, axis=0)

        return Chain(
            columns=self.columns[::-1].copy(),
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


def chain_to(model: pin.Model, frame: Frame) -> Chain | None:
    """The chain from the base to a frame.

    None if no joint carries the frame, or if one on the way is not revolute, continuous or prismatic.
    """
    joints = [j for j in model.supports[frame.parent_joint] if j > 0]
    if not joints or any(model.joints[j].nv != 1 or model.joints[j].nq > 2 for j in joints):
        return None
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model), np.zeros(model.nv))
    placements: list[tuple[np.ndarray, np.ndarray]] = []
    prismatic: list[bool] = []
    turn = np.eye(3)  # from the z-along-the-axis frame of the joint before to the model's frame of that joint
    for j in joints:
        S = np.array(data.joints[j].S, dtype=np.float64).reshape(-1)
        slides = not np.any(S[3:])
        axis = S[:3] if slides else S[3:]
        if (not slides and np.any(S[:3])) or abs(float(np.linalg.norm(axis)) - 1.0) > 1e-12:
            return None
        M, z_to_axis = model.jointPlacements[j], _turn_z_to(axis)
        placements.append((turn.T @ M.rotation @ z_to_axis, turn.T @ M.translation))
        prismatic.append(slides)
        turn = z_to_axis
    M = model.frames[frame.index].placement
    placements.append((turn.T @ M.rotation, turn.T @ M.translation))
    columns = np.array([model.joints[j].idx_v for j in joints], dtype=np.int64)
    return _assembled(columns, np.array(prismatic, dtype=bool), placements)


def _assembled(columns: np.ndarray, prismatic: np.ndarray, placements: list[tuple[np.ndarray, np.ndarray]]) -> Chain:
    n = len(columns)
    offset, tilt_cos, tilt_sin, shift = np.zeros(n), np.ones(n), np.zeros(n), np.zeros((n, 3))
    for i in range(1, n):
        R, t = placements[i]
        a, tilt_cos[i], tilt_sin[i], c = _split_zxz(R)
        offset[i - 1] += a
        shift[i] = _snapped(_turn_z(a).T @ t)
        offset[i] += c
    return Chain(
        columns=columns,
        prismatic=prismatic,
        offset=offset,
        start_rotation=_snapped(placements[0][0]),
        start_position=placements[0][1],
        tilt_cos=tilt_cos,
        tilt_sin=tilt_sin,
        shift=shift,
        tool_rotation=_snapped(placements[n][0]),
        tool_position=_snapped(placements[n][1]),
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


def _turn_z(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


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

    def __init__(self, robot: Robot, chain: Chain):
        self._robot = robot
        self._lift: np.ndarray | None = None
        self.public: np.ndarray | None = None
        self._select: slice | np.ndarray = slice(0, 0)
        coupling = robot.coupling
        columns = None if coupling is None else coupling.columns_of(chain.columns)
        if coupling is not None and columns is None:
            # mimic joints: the chain's joints are an affine map of the public ones
            self._lift = np.ascontiguousarray(coupling.lift[chain.columns])
            self._offset = coupling.offset[chain.columns][:, None]
            self.full = False
            return
        if columns is None:
            public = {block.pin_v.start: block.v.start for block in robot.blocks}
            columns = np.array([public[int(c)] for c in chain.columns], dtype=np.int64)
        self.public = columns
        self.full = len(columns) == robot.nv
        contiguous = np.array_equal(columns, np.arange(columns[0], columns[0] + len(columns)))
        self._select = slice(int(columns[0]), int(columns[0]) + len(columns)) if contiguous else columns

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
