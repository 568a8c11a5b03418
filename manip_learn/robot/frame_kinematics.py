"""Kinematics of one frame: its pose, its Jacobian and the derivative, from one pass over the joints that carry it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from math import isfinite
from typing import Any, Protocol, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.robot.carrying_joints import carrying_joints
from manip_learn.robot.description.mimic import Coupling
from manip_learn.robot.frame import Frame
from manip_learn.robot.joints import JointBlock
from manip_learn.robot.kinematic_hessian import (
    REFERENCES,
    closed_form,
    columns_to_joints,
    pinocchio_order_is_known,
    reordered,
)
from manip_learn.robot.weighted_vjp import WeightedVjp

DOUBLE = np.dtype(np.float64)  # of this machine's byte order


class Postures(Protocol):
    """What `FrameKinematics` needs of a `Robot`."""

    blocks: tuple[JointBlock, ...]
    nv: int

    @property
    def coupling(self) -> Coupling | None:
        """How mimic joints follow."""
        ...

    @property
    def pinocchio_model(self) -> pin.Model:
        """The model of all joints."""
        ...

    def checked_posture(self, q: ArrayLike) -> np.ndarray:
        """A configuration or joint positions, checked."""
        ...

    def positions(self, q: ArrayLike) -> np.ndarray:
        """Joint positions (nv)."""
        ...

    def pinocchio_configuration(self, q: ArrayLike) -> np.ndarray:
        """Configuration of the model."""
        ...


def is_plain(q: np.ndarray) -> bool:
    """Whether an array can be handed to Pinocchio as it is: another layout would change the last digit."""
    return q.dtype is DOUBLE and q.flags.c_contiguous


@final
class _Pass:
    """What one thread keeps of the posture that it asked for last; no number depends on what was asked before."""

    def __init__(self, model: pin.Model, index: int):
        self.data = model.createData()
        self.posture: bytes | None = None  # that the frame was placed for; b"" is one, of a robot without joints
        self.has_derivatives = False  # whether the Jacobians and their derivatives at that posture are there
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
    """

    def __init__(self, robot: Postures, frame: Frame):
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
        self._hessian_shape = (self.model.nv, 6 * self.model.nv)
        self._local = threading.local()

    # ---- one posture ------------------------------------------------------------------------------------------------

    def _configuration(self, q: np.ndarray) -> Float[np.ndarray, " n"]:
        """What the model takes, from a checked posture."""
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
            last.posture, last.has_derivatives = None, False
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
        last.posture, last.has_derivatives = None, False
        x = self._configuration(checked)
        J = pin.computeFrameJacobian(self.model, last.data, x, self._index, REFERENCES[reference])
        if reference == "world":  # which places the frame, too
            last.posture = checked.tobytes()
        return J if J.ndim == 2 else J.reshape(6, 1)  # nv == 1

    def jacobian_beside_vjp(self, q: Any, reference: str) -> Float[np.ndarray, "6 nv"]:
        """The same where `weighted_vjp` has just been called at this posture, and nearly free there.

        (Its last digits are those of `weighted_vjp`, whatever was called before.)
        """
        if not self._fast_hessian:
            return self.jacobian(q, reference)
        last = self._pass()
        if not (last.has_derivatives and type(q) is np.ndarray and q.tobytes() == last.posture):
            last = self._differentiated(q)
        J = pin.getFrameJacobian(self.model, last.data, self._index, REFERENCES[reference])
        return self._public(J if J.ndim == 2 else J.reshape(6, 1))

    def jacobian_and_derivative(self, q: Any, reference: str) -> tuple[np.ndarray, np.ndarray]:
        """J (6, nv) and dJ/dq (6, nv, nv)."""
        model, index, ref = self.model, self._index, REFERENCES[reference]
        if self._fast_hessian:
            last, n = self._differentiated(q), self.model.nv
            J = pin.getFrameJacobian(model, last.data, index, ref).reshape(6, n)
            H = reordered(pin.getFrameKinematicHessian(model, last.data, index, ref), n)
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

    def weighted_vjp(
        self, q: Any, reference: str, selection: Float[np.ndarray, "s 6"]
    ) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        """A = Lambda J and its vector-Jacobian product, see `Robot.weighted_jacobian_vjp`."""
        if not self._fast_hessian:
            J, H = self.jacobian_and_derivative(q, reference)
            flat = H.reshape(6 * self.nv, self.nv)
            return selection.dot(J), lambda weights: selection.T.dot(weights).reshape(-1).dot(flat)
        model, index, ref = self.model, self._index, REFERENCES[reference]
        data = self._differentiated(q).data
        J = pin.getFrameJacobian(model, data, index, ref)
        # Pinocchio's buffer as it lies in memory is [k, j, i] (see `reordered`)
        by_joint = pin.getFrameKinematicHessian(model, data, index, ref).reshape(self._hessian_shape)
        A = selection.dot(J) if J.ndim == 2 else selection.dot(J.reshape(6, 1))  # nv == 1
        vjp = WeightedVjp(by_joint, selection, self._columns, self._lift, self.nv)
        return A if self._plain else self._public(A), vjp

    # ---- internals --------------------------------------------------------------------------------------------------

    def _differentiated(self, q: Any) -> _Pass:
        """The pass of a posture, with Jacobians, their derivatives and the frame's placement."""
        last, checked = self._pass(), q
        if not (q.__class__ is np.ndarray and q.shape == self._shape and is_plain(q) and isfinite(sum(q.tolist()))):
            checked = self._robot.checked_posture(q)
        last.posture, last.has_derivatives = None, True
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
