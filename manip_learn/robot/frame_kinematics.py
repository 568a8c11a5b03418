"""Kinematics of one frame: its pose, its Jacobian and the derivative, from one pass over the joints that carry it.

Pinocchio 4.1 hands `getFrameKinematicHessian` out with the right shape (6, nv, nv) and scrambled entries: a
column-major buffer read as row-major. It is put into the right order behind a self-test. `closed_form` needs no Hessian
and serves as the judge, and as the substitute should a Pinocchio release change the memory order.
"""

from __future__ import annotations

import threading
from math import isfinite
from typing import Any, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float, Int

from manip_learn.robot.joints import CarryingJoints, Frame, carrying_joints

PINOCCHIO_REFERENCES = {"world": pin.ReferenceFrame.LOCAL_WORLD_ALIGNED, "local": pin.ReferenceFrame.LOCAL}
DOUBLE = np.dtype(np.float64)  # of this machine's byte order


def closed_form(
    J: Float[np.ndarray, "6 nv"], joint_of_column: Int[np.ndarray, " nv"], reference: str
) -> Float[np.ndarray, "6 nv nv"]:
    """dJ_i/dq_k from the Jacobian's own columns; entry [i, j, k] = d J_ij / d q_k.

    With columns (v_i, w_i) at the frame's origin along world axes, for joint k at or above joint i on the chain:
    d v_i / d q_k = w_k x v_i and d w_i / d q_k = w_k x w_i; for k below i: d v_i / d q_k = w_i x v_k, d w_i = 0.
    In the frame's own axes: dS_i / dq_k = S_i x S_k for k below i, else 0 (motion cross product).

    Args:
        J: Frame Jacobian, linear rows first.
        joint_of_column: Pinocchio joint id of each column; columns outside the frame's chain are zero in J.
        reference: `"world"` (LOCAL_WORLD_ALIGNED) or `"local"`.
    """
    v, w = J[:3].T, J[3:].T
    i, k = joint_of_column[:, None], joint_of_column[None, :]
    if reference == "world":
        above = (k <= i)[..., None]
        dv = np.where(above, np.cross(w[None, :], v[:, None]), np.cross(w[:, None], v[None, :]))
        dw = np.where(above, np.cross(w[None, :], w[:, None]), 0.0)
    else:
        below = (k > i)[..., None]
        dv = np.where(below, np.cross(w[:, None], v[None, :]) + np.cross(v[:, None], w[None, :]), 0.0)
        dw = np.where(below, np.cross(w[:, None], w[None, :]), 0.0)
    return np.concatenate([dv, dw], axis=2).transpose(2, 0, 1)


def centre_of_mass_derivative(
    model: pin.Model,
    Jc: Float[np.ndarray, "3 nv"],
    w: Float[np.ndarray, "nv 3"],
    joint_of_column: Int[np.ndarray, " nv"],
) -> Float[np.ndarray, "3 nv nv"]:
    """dJc_i/dq_k of the centre of mass's Jacobian Jc, with the joints' angular columns w along the base axes.

    For joint k at or above joint i: d Jc_i / d q_k = w_k x Jc_i; for k below i: w_i x Jc_k; else 0.
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


def reordered(H: np.ndarray, nv: int) -> Float[np.ndarray, "6 nv nv"]:
    """Entries [i, j, k] = d J_ij / d q_k out of Pinocchio's mislabelled buffer."""
    return H.reshape(nv, nv, 6).transpose(2, 1, 0)


def pinocchio_order_is_known(model: pin.Model) -> bool:
    """True if `reordered` gives the closed form on this model: checked once per robot, in every reference frame."""
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
        if not np.allclose(reordered(H, model.nv), closed_form(J, joint_of_column, name), rtol=0.0, atol=1e-9):
            return False
    return True


def columns_to_joints(model: pin.Model) -> Int[np.ndarray, " nv"]:
    """Pinocchio joint id of each tangent coordinate."""
    owner = np.zeros(model.nv, dtype=np.int64)
    for j in range(1, model.njoints):
        joint = model.joints[j]
        owner[joint.idx_v : joint.idx_v + joint.nv] = j
    return owner


def is_plain(q: np.ndarray) -> bool:
    """Whether an array can be handed to Pinocchio as it is: another layout would change the last digit."""
    return q.dtype is DOUBLE and q.flags.c_contiguous


@final
class _Pass:
    """The last pass of one thread; no number depends on what was asked before."""

    def __init__(self, model: pin.Model, index: int):
        self.data = model.createData()
        self.posture: bytes | None = None  # that the frame was placed for; b"" is one, of a robot without joints
        placement = self.data.oMf[index]
        # views into Pinocchio's own memory: they follow every pass
        self.position, self.rotation = placement.translation, placement.rotation


@final
class FrameKinematics:
    """Pose, Jacobian and dJ/dq of one frame, see `Robot.pose`, `Robot.jacobian`, `Robot.jacobian_and_derivative`.

    Where all joints between the base and the frame have one degree of freedom, only these are computed: a hand beside
    the chain, or a second arm, costs nothing. The placement of the posture asked for last is kept: a task that asks for
    the pose where the Jacobian has just been computed gets it without another pass.

    One object can be used from many threads: each has its own Pinocchio data.

    Args:
        robot: The `Robot`, whose module imports this one.
        frame: One of its frames.
    """

    def __init__(self, robot: Any, frame: Frame):
        self._robot, self._frame = robot, frame
        self._build()

    def _build(self) -> None:
        robot, frame = self._robot, self._frame
        chain = carrying_joints(robot.pinocchio_model, frame, robot.blocks, robot.coupling)
        self._chain = chain
        self.model, self._index = (robot.pinocchio_model, frame.index) if chain is None else (chain.model, chain.index)
        self.nv, self._shape = robot.nv, (robot.nv,)
        self._columns: Any = None
        self._lift: np.ndarray | None = None
        if chain is None:
            self._lift = None if robot.coupling is None else robot.coupling.lift
        elif chain.columns is None:
            self._lift = chain.lift
        elif not (isinstance(chain.columns, slice) and chain.columns == slice(0, robot.nv)):
            self._columns = chain.columns
        self._plain = chain is not None and self._lift is None and self._columns is None
        self._fast_hessian = pinocchio_order_is_known(self.model)
        self._columns_to_joints = columns_to_joints(self.model)
        self._local = threading.local()

    @property
    def chain(self) -> CarryingJoints | None:
        """The joints that carry the frame; None where one of them has more than one degree of freedom."""
        return self._chain

    # ---- one posture ------------------------------------------------------------------------------------------------

    def _configuration(self, q: np.ndarray) -> Float[np.ndarray, " n"]:
        """Configuration of the model from a checked posture."""
        chain = self._chain
        if chain is None:
            return self._robot.pinocchio_configuration(q)
        positions = q if q.shape[0] == self.nv else self._robot.positions(q)
        if self._lift is not None:
            return chain.lift.dot(positions) + chain.offset
        return positions if self._columns is None else positions[self._columns]

    def _pass(self) -> _Pass:
        try:
            return self._local.last
        except AttributeError:
            self._local.last = last = _Pass(self.model, self._index)
            return last

    def _placed(self, q: Any) -> _Pass:
        """The pass of a posture, with the frame placed."""
        last = self._pass()
        if not (type(q) is np.ndarray and q.dtype is DOUBLE and q.tobytes() == last.posture):
            q = self._robot.checked_posture(q)
            last.posture = None
            pin.forwardKinematics(self.model, last.data, self._configuration(q))
            pin.updateFramePlacement(self.model, last.data, self._index)
            last.posture = q.tobytes()
        return last

    def position(self, q: Any) -> Float[np.ndarray, " 3"]:
        """Origin of the frame in the robot's base [m]."""
        return self._placed(q).position.copy()

    def placement(self, q: Any) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
        """Origin of the frame in the robot's base [m] and rotation to the base, until the next call for this frame."""
        last = self._placed(q)
        return last.position, last.rotation

    def pose(self, q: Any) -> Float[np.ndarray, "4 4"]:
        """Homogeneous transform from the frame to the robot's base [m]."""
        last, out = self._placed(q), np.eye(4)
        out[:3, :3], out[:3, 3] = last.rotation, last.position
        return out

    def jacobian(self, q: Any, reference: str) -> Float[np.ndarray, "6 nv"]:
        """Frame Jacobian, linear rows first; an array of its own."""
        return self._public(self._model_jacobian(q, reference))

    def _model_jacobian(self, q: Any, reference: str) -> Float[np.ndarray, "6 n"]:
        last, checked = self._pass(), self._robot.checked_posture(q)
        last.posture = None
        x = self._configuration(checked)
        J = pin.computeFrameJacobian(self.model, last.data, x, self._index, PINOCCHIO_REFERENCES[reference])
        if reference == "world":  # which places the frame, too
            last.posture = checked.tobytes()
        return J if J.ndim == 2 else J.reshape(6, 1)  # nv == 1

    def jacobian_and_derivative(self, q: Any, reference: str) -> tuple[np.ndarray, np.ndarray]:
        """J (6, nv) and dJ/dq (6, nv, nv)."""
        if self._fast_hessian:
            model, data, ref = self.model, self._differentiated(q).data, PINOCCHIO_REFERENCES[reference]
            J = pin.getFrameJacobian(model, data, self._index, ref).reshape(6, -1)  # nv == 1
            H = reordered(pin.getFrameKinematicHessian(model, data, self._index, ref), model.nv)
        else:  # a robot without joints, too, for which Pinocchio's getters crash
            J = self._model_jacobian(q, reference)
            H = closed_form(J, self._columns_to_joints, reference)
        if self._lift is not None:
            return J @ self._lift, self._lift.T @ (H @ self._lift)
        if self._columns is None:
            return J, H
        out = np.zeros((6, self.nv, self.nv))
        columns = np.arange(self.nv)[self._columns]
        out[:, columns[:, None], columns] = H
        return self._public(J), out

    # ---- internals --------------------------------------------------------------------------------------------------

    def _differentiated(self, q: Any) -> _Pass:
        """The pass of a posture, with Jacobians, their derivatives and the frame's placement."""
        last, checked = self._pass(), q
        if not (q.__class__ is np.ndarray and q.shape == self._shape and is_plain(q) and isfinite(sum(q.tolist()))):
            checked = self._robot.checked_posture(q)
        last.posture = None
        x = checked if self._plain and checked.shape[0] == self.nv else self._configuration(checked)
        pin.computeJointKinematicHessians(self.model, last.data, x)
        pin.updateFramePlacement(self.model, last.data, self._index)
        last.posture = checked.tobytes()
        return last

    def _public(self, rows: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k nv"]:
        """Columns of the model's joints as columns of the robot's."""
        if self._lift is not None:
            return rows.dot(self._lift)
        if self._columns is None:
            return rows
        out = np.zeros((rows.shape[0], self.nv))
        out[:, self._columns] = rows
        return out

    def __getstate__(self) -> dict[str, Any]:
        return {"_robot": self._robot, "_frame": self._frame}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._build()
