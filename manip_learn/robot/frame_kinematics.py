"""Kinematics of one frame at one posture or many, by Pinocchio: its pose, its Jacobian and the derivative.

Pinocchio 4.1 returns `getFrameKinematicHessian` with the right shape (6, nv, nv) but scrambled entries: a column-major
buffer read as row-major. A self-test checks the reordering. `closed_form` needs no Hessian: it is the reference of the
self-test, the substitute if Pinocchio changes the memory order, and the method for many postures.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import Any, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from manip_learn.errors import UnknownNameError
from manip_learn.robot.joints import CarryingJoints, Frame, carrying_joints

PINOCCHIO_REFERENCES = {"world": pin.ReferenceFrame.LOCAL_WORLD_ALIGNED, "local": pin.ReferenceFrame.LOCAL}
DOUBLE = np.dtype(np.float64)  # in this machine's byte order
ALL_ROWS = (0, 1, 2, 3, 4, 5)  # all rows of a twist
DERIVATIVE_CHUNK = 256  # postures per chunk; limits the memory of dJ/dq


def _pinocchio_reference(reference: str) -> Any:
    """Return Pinocchio's constant for a reference; refuse another word."""
    if reference not in ("world", "local"):
        raise UnknownNameError("reference", reference, PINOCCHIO_REFERENCES)
    return PINOCCHIO_REFERENCES[reference]


def closed_form(
    J: Float[np.ndarray, "*n 6 nv"],
    joint_of_column: Int[np.ndarray, " nv"],
    reference: str,
    rows: Sequence[int] = ALL_ROWS,
) -> Float[np.ndarray, "*n p nv nv"]:
    """Compute the derivative dJ/dq of frame Jacobians from their own columns.

    Column i of J is (v_i, w_i), at the frame's origin along world axes. If joint k is joint i or nearer to the base,
    d v_i / d q_k = w_k x v_i and d w_i / d q_k = w_k x w_i. If joint k is farther from the base, d v_i / d q_k =
    w_i x v_k and d w_i / d q_k = 0. In the frame's own axes, with columns S_i, d S_i / d q_k = S_i x S_k (motion cross
    product) if joint k is farther from the base than joint i, else 0.

    Args:
        J: Frame Jacobians (..., 6, nv), linear rows first.
        joint_of_column: Pinocchio joint id of each column; columns outside the frame's chain are zero in J.
        reference: `"world"` (LOCAL_WORLD_ALIGNED) or `"local"`.
        rows: Rows to compute: x y z rx ry rz as 0 .. 5.

    Returns:
        Derivatives (..., p, nv, nv) of the p rows, with the entry [i, j, k] = d J_ij / d q_k. The axes of the different
        Jacobians are the last ones in memory.
    """
    columns = np.ascontiguousarray(np.moveaxis(J, (-2, -1), (0, 1)))
    v, w, nv = columns[:3], columns[3:], columns.shape[1]
    is_below = (joint_of_column[None, :] > joint_of_column[:, None]).reshape(nv, nv, *[1] * (J.ndim - 2))
    out = np.empty((len(rows), nv, nv, *J.shape[:-2]))
    for row, derivative in zip(rows, out, strict=True):
        a, b, c = (row + 1) % 3, (row + 2) % 3, v if row < 3 else w
        turned = w[a][:, None] * c[b] - w[b][:, None] * c[a]  # this row of w_i x c_k, at [i, k]
        if reference == "world":
            derivative[:] = np.where(is_below, turned if row < 3 else 0.0, turned.swapaxes(0, 1))
        else:
            derivative[:] = np.where(is_below, turned - turned.swapaxes(0, 1) if row < 3 else turned, 0.0)
    return np.moveaxis(out, (0, 1, 2), (-3, -2, -1))


def centre_of_mass_derivative(
    model: pin.Model,
    Jc: Float[np.ndarray, "3 nv"],
    w: Float[np.ndarray, "nv 3"],
    joint_of_column: Int[np.ndarray, " nv"],
) -> Float[np.ndarray, "3 nv nv"]:
    """Compute the derivative of the Jacobian Jc of the centre of mass.

    With column i of Jc and the rotation axis w_i of joint i: d Jc_i / d q_k = w_k x Jc_i if joint k is joint i or
    nearer to the base on its chain; w_i x Jc_k if joint k is farther from the base; 0 for joints of different chains.

    Args:
        model: Pinocchio model of the robot.
        Jc: Jacobian (3, nv) of the centre of mass along the base axes.
        w: Angular velocity (nv, 3) per unit velocity of each joint, along the base axes.
        joint_of_column: Pinocchio joint id of each column.

    Returns:
        shape (3, nv, nv), with the entry [i, j, k] = d Jc_ij / d q_k.
    """
    owner, c = joint_of_column, Jc.T
    is_above = np.zeros((model.njoints, model.njoints), dtype=bool)
    for j in range(model.njoints):
        is_above[list(model.supports[j]), j] = True
    k_above_i = is_above[owner[None, :], owner[:, None]]
    i_above_k = is_above[owner[:, None], owner[None, :]] & ~k_above_i
    H = np.where(k_above_i[..., None], np.cross(w[None, :], c[:, None]), 0.0)
    H += np.where(i_above_k[..., None], np.cross(w[:, None], c[None, :]), 0.0)
    return H.transpose(2, 0, 1)


def reorder_hessian(H: np.ndarray, nv: int) -> Float[np.ndarray, "6 nv nv"]:
    """Reorder the entries of Pinocchio's Hessian to [i, j, k] = d J_ij / d q_k.

    Args:
        H: Result of `getFrameKinematicHessian`, whose 6 nv^2 entries are in another order.
        nv: Number of columns of the Jacobian.

    Returns:
        shape (6, nv, nv).
    """
    return H.reshape(nv, nv, 6).transpose(2, 1, 0)


def pinocchio_order_is_known(model: pin.Model) -> bool:
    """Test that `reorder_hessian` gives the same derivative as `closed_form`, in every reference frame.

    Args:
        model: Pinocchio model. The test uses its deepest frame at a random configuration.

    Returns:
        True if the two agree; False also for a model without joints.
    """
    if model.nv == 0:
        return False
    data = model.createData()
    rng = np.random.default_rng(0)
    q = pin.integrate(model, pin.neutral(model), rng.uniform(-1.0, 1.0, model.nv))
    index = int(np.argmax([len(model.supports[frame.parentJoint]) for frame in model.frames]))  # the deepest
    joint_of_column = columns_to_joints(model)
    pin.computeJointKinematicHessians(model, data, q)
    for name, reference in PINOCCHIO_REFERENCES.items():
        J = pin.computeFrameJacobian(model, data, q, index, reference).reshape(6, model.nv)
        H = pin.getFrameKinematicHessian(model, data, index, reference)
        if H.size != 6 * model.nv**2:
            return False
        if not np.allclose(reorder_hessian(H, model.nv), closed_form(J, joint_of_column, name), rtol=0.0, atol=1e-9):
            return False
    return True


def columns_to_joints(model: pin.Model) -> Int[np.ndarray, " nv"]:
    """Return the Pinocchio joint id of each tangent coordinate (nv,), i.e. of each column of a Jacobian.

    Args:
        model: Pinocchio model.
    """
    owner = np.zeros(model.nv, dtype=np.int64)
    for j in range(1, model.njoints):
        joint = model.joints[j]
        owner[joint.idx_v : joint.idx_v + joint.nv] = j
    return owner


@final
class _Pass:
    """Latest results of one thread; they are a cache and change no result."""

    def __init__(self, model: pin.Model, index: int):
        self.data = model.createData()
        self.posture: bytes | None = None  # posture of the frame's placement; b"" for a robot without joints
        placement = self.data.oMf[index]
        # views into Pinocchio's own memory: they follow every pass
        self.position, self.rotation = placement.translation, placement.rotation
        self.table, self.swept = np.empty((0, 0)), (np.empty((0, 6, 0)), np.empty((0, 4, 4)))


@final
class FrameKinematics:
    """Fast kinematics of one frame: pose, Jacobian and its derivative; `Robot.frame_kinematics` makes it.

    If all joints between the base and the frame have one degree of freedom, only these joints are computed; other
    joints, e.g. of fingers or a second arm, cost nothing. The pose at the latest configuration is cached, and so are
    Jacobians and poses at the latest array of configurations.

    One object can be used from many threads; each thread has its own Pinocchio data.

    Args:
        robot: The `Robot`.
        frame: One of its frames.

    Attributes:
        chain: The joints that move the frame; None if there are none or one has more than one degree of freedom.
        model: Pinocchio model of these joints, or of the whole robot if `chain` is None.
    """

    def __init__(self, robot: Any, frame: Frame):
        self._robot, self._frame = robot, frame
        self._build()

    def _build(self) -> None:
        robot, frame = self._robot, self._frame
        self.chain: CarryingJoints | None = carrying_joints(robot.pinocchio_model, frame, robot.blocks, robot.coupling)
        lift: np.ndarray | None
        if self.chain is None:
            self.model, self._index = robot.pinocchio_model, frame.index
            lift = None if robot.coupling is None else robot.coupling.lift
        else:
            self.model, self._index, lift = self.chain.model, self.chain.index, self.chain.lift
            if np.array_equal(lift, np.eye(robot.nv)) and not self.chain.offset.any():
                lift = None
        self._lift = lift  # maps the robot's velocities to the model's; None for the identity
        self._fast_hessian = pinocchio_order_is_known(self.model)
        self._columns_to_joints = columns_to_joints(self.model)
        self._local = threading.local()

    def _configuration(self, q: np.ndarray) -> Float[np.ndarray, " n"]:
        """Return the configuration of the model for a checked posture."""
        chain, robot = self.chain, self._robot
        if chain is None:
            return robot.pinocchio_configuration(q)
        positions = q if q.shape[0] == robot.nv else robot.positions(q)
        return positions if self._lift is None else chain.lift.dot(positions) + chain.offset

    def _pass(self) -> _Pass:
        """Return the cache of this thread."""
        try:
            return self._local.last
        except AttributeError:
            self._local.last = last = _Pass(self.model, self._index)
            return last

    # ---- one posture ------------------------------------------------------------------------------------------------

    def _pass_at(self, q: Any) -> _Pass:
        """Return the cache of this thread, with the frame placed at a posture."""
        last = self._pass()
        if not (type(q) is np.ndarray and q.dtype is DOUBLE and q.tobytes() == last.posture):
            q = self._robot.checked_posture(q)
            last.posture = None
            pin.forwardKinematics(self.model, last.data, self._configuration(q))
            pin.updateFramePlacement(self.model, last.data, self._index)
            last.posture = q.tobytes()
        return last

    def position(self, q: ArrayLike) -> Float[np.ndarray, " 3"]:
        """Return the position (3,) of the frame's origin in the robot's base frame [m].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
        """
        return self._pass_at(q).position.copy()

    def placement(self, q: ArrayLike) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
        """Return position and orientation of the frame in the robot's base frame.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Returns:
            Position (3,) [m] and rotation matrix (3, 3). The arrays are views that the next call overwrites.
        """
        last = self._pass_at(q)
        return last.position, last.rotation

    def pose(self, q: ArrayLike) -> Float[np.ndarray, "4 4"]:
        """Return the pose (4, 4) of the frame in the robot's base frame [m].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
        """
        last, out = self._pass_at(q), np.eye(4)
        out[:3, :3], out[:3, 3] = last.rotation, last.position
        return out

    def jacobian(self, q: ArrayLike, reference: str) -> Float[np.ndarray, "6 nv"]:
        """Return the frame Jacobian (6, nv), linear rows first [m/s, rad/s per unit joint velocity], as a new array.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            reference: Along the base axes (`"world"`) or the frame's own (`"local"`).
        """
        J = self._model_jacobian(q, reference)
        return J if self._lift is None else J.dot(self._lift)

    def _model_jacobian(self, q: Any, reference: str) -> Float[np.ndarray, "6 n"]:
        """Compute the Jacobian with respect to the model's velocities."""
        last, checked = self._pass(), self._robot.checked_posture(q)
        last.posture = None
        x = self._configuration(checked)
        J = pin.computeFrameJacobian(self.model, last.data, x, self._index, _pinocchio_reference(reference))
        if reference == "world":  # this Jacobian also updates the frame's placement
            last.posture = checked.tobytes()
        return J if J.ndim == 2 else J.reshape(6, 1)  # nv == 1

    def jacobian_and_derivative(self, q: ArrayLike, reference: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the frame Jacobian J and its exact derivative.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            reference: Along the base axes (`"world"`) or the frame's own (`"local"`).

        Returns:
            J (6, nv), and dJ/dq (6, nv, nv) with the entry [i, j, k] = d J_ij / d q_k along tangent coordinate k.
        """
        if self._fast_hessian:
            model, index, ref = self.model, self._index, _pinocchio_reference(reference)
            last, checked = self._pass(), self._robot.checked_posture(q)
            last.posture = None
            pin.computeJointKinematicHessians(model, last.data, self._configuration(checked))
            pin.updateFramePlacement(model, last.data, index)
            last.posture = checked.tobytes()
            J = pin.getFrameJacobian(model, last.data, index, ref).reshape(6, -1)  # nv == 1
            H = reorder_hessian(pin.getFrameKinematicHessian(model, last.data, index, ref), model.nv)
        else:  # this also covers robots without joints, for which Pinocchio's getters crash
            J = self._model_jacobian(q, reference)
            H = closed_form(J, self._columns_to_joints, reference)
        return (J, H) if self._lift is None else (J @ self._lift, self._lift.T @ (H @ self._lift))

    # ---- many postures ----------------------------------------------------------------------------------------------

    def _configurations(self, table: Float[np.ndarray, "n width"]) -> Iterator[Float[np.ndarray, " n"]]:
        """Yield the configuration of the model for each checked posture."""
        if self.chain is None or table.shape[1] != self._robot.nv:
            return map(self._configuration, table)
        return iter(table if self._lift is None else table @ self.chain.lift.T + self.chain.offset)

    def _sweep(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n 6 m"], Float[np.ndarray, "n 4 4"]]:
        """Compute the Jacobians of the model along the base axes, and the poses, at each posture."""
        table, last = self._robot.checked_postures(q), self._pass()
        if table.shape == last.table.shape and np.array_equal(table, last.table):
            return last.swept
        model, data, index = self.model, last.data, self._index
        world = PINOCCHIO_REFERENCES["world"]
        J, T = np.zeros((len(table), 6, model.nv)), np.tile(np.eye(4), (len(table), 1, 1))
        R, p, last.posture = T[:, :3, :3], T[:, :3, 3], None
        for i, x in enumerate(self._configurations(table)):
            J[i] = pin.computeFrameJacobian(model, data, x, index, world).reshape(6, -1)  # also places the frame
            R[i], p[i] = last.rotation, last.position
        if len(table) <= 32_768:  # postures: 16 MB for 7 joints
            last.table, last.swept = table.copy(), (J, T)
        return J, T

    def poses(self, q: ArrayLike) -> Float[np.ndarray, "n 4 4"]:
        """Return the poses (n, 4, 4) of the frame at n configurations, in the robot's base frame [m].

        Args:
            q: Configurations (n, nq) or joint positions (n, nv) [rad or m], one per row.

        Raises:
            ConfigurationError: q has the wrong size or is not finite; names the first bad row and joint.
        """
        return self._sweep(q)[1].copy()

    def jacobians(
        self, q: ArrayLike, reference: str = "world", rows: Sequence[int] = ALL_ROWS
    ) -> Float[np.ndarray, "n p nv"]:
        """Return rows of the frame Jacobian at n configurations, shape (n, p, nv) [m/s, rad/s per unit joint velocity].

        Args:
            q: Configurations (n, nq) or joint positions (n, nv) [rad or m], one per row.
            reference: Along the base axes (`"world"`) or the frame's own (`"local"`).
            rows: Rows to return: x y z rx ry rz as 0 .. 5.

        Raises:
            ConfigurationError: q has the wrong size or is not finite; names the first bad row and joint.
        """
        J = self._rotate_to(*self._sweep(q), reference)[:, list(rows)]
        return J if self._lift is None else J @ self._lift

    def _rotate_to(self, J: Float[np.ndarray, "n 6 m"], T: Float[np.ndarray, "n 4 4"], reference: str) -> np.ndarray:
        """Rotate Jacobians along the base axes into the axes of a reference."""
        if reference == "world":
            return J
        return (T[:, None, :3, :3].swapaxes(2, 3) @ J.reshape(len(J), 2, 3, -1)).reshape(J.shape)

    def jacobians_and_derivatives(
        self, q: ArrayLike, reference: str = "world", rows: Sequence[int] = ALL_ROWS
    ) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Return rows of the frame Jacobian J and their exact derivatives at n configurations.

        Args:
            q: Configurations (n, nq) or joint positions (n, nv) [rad or m], one per row.
            reference: Along the base axes (`"world"`) or the frame's own (`"local"`).
            rows: Rows to return: x y z rx ry rz as 0 .. 5.

        Returns:
            J (n, p, nv), and dJ/dq (n, p, nv, nv) with the entry [., i, j, k] = d J_ij / d q_k along tangent coordinate
            k.

        Raises:
            ConfigurationError: q has the wrong size or is not finite; names the first bad row and joint.
        """
        J, selected = self._rotate_to(*self._sweep(q), reference), list(rows)
        parts = [J[i : i + DERIVATIVE_CHUNK] for i in range(0, max(len(J), 1), DERIVATIVE_CHUNK)]
        H = np.concatenate([closed_form(part, self._columns_to_joints, reference, selected) for part in parts])
        lift = self._lift
        return (J[:, selected], H) if lift is None else (J[:, selected] @ lift, lift.T @ (H @ lift))

    def link_twists(self, q: Float[np.ndarray, "n nv"]) -> Float[np.ndarray, "l n 6 6"] | None:
        """Return the twist of the frame per unit error of each link's geometry.

        Args:
            q: Joint positions (n, nv) [rad or m], one configuration per row.

        Returns:
            shape (l, n, 6, 6) for l links on the chain: twists along the base axes at the frame's origin, first for
            three displacements of the link's end along the axes of its joint, then for three rotations about these
            axes. None if `chain` is None.
        """
        if self.chain is None:
            return None
        model, data = self.model, self._pass().data
        self._pass().posture = None
        joints = [(data.oMi[j].rotation, data.oMi[j].translation) for j in range(1, model.njoints)]
        rotations, positions = np.empty((len(joints), len(q), 3, 3)), np.empty((len(joints), len(q), 3))
        for i, x in enumerate(self._configurations(q)):
            pin.forwardKinematics(model, data, x)
            for j, (rotation, translation) in enumerate(joints):
                rotations[j, i], positions[j, i] = rotation, translation
        tip = self.poses(q)[:, :3, 3]
        lever = tip - np.concatenate([positions[1:], tip[None]])  # a link ends at the next joint
        twists = np.zeros((len(joints), len(q), 6, 6))
        twists[..., :3, :3] = twists[..., 3:, 3:] = rotations
        twists[..., :3, 3:] = np.cross(rotations, lever[..., None], axisa=2, axisb=2, axisc=2)
        return twists

    def __getstate__(self) -> dict[str, Any]:
        return {"_robot": self._robot, "_frame": self._frame}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._build()
