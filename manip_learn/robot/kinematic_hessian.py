"""dJ/dq of a frame: Pinocchio's kinematic Hessian put into the right order, behind a self-test.

Pinocchio 4.1 hands `getFrameKinematicHessian` out with the right shape (6, nv, nv) and scrambled entries: a
column-major buffer read as row-major. `closed_form` needs no Hessian and serves as the judge, and as the substitute
should a Pinocchio release change the memory order.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from jaxtyping import Float, Int

REFERENCES = {"world": pin.ReferenceFrame.LOCAL_WORLD_ALIGNED, "local": pin.ReferenceFrame.LOCAL}


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
    index = _deepest_frame(model)
    joint_of_column = columns_to_joints(model)
    pin.computeJointKinematicHessians(model, data, q)
    for name, reference in REFERENCES.items():
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


def _deepest_frame(model: pin.Model) -> int:
    depth = [len(model.supports[frame.parentJoint]) for frame in model.frames]
    return int(np.argmax(depth))
