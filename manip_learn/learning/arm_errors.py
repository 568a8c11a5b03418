"""Constant errors of the arm, joint offsets and links, and their effect on the rates of features.

A link that is not as described displaces all that comes after it, as a joint would that has a rigid motion there. With
the twist (v, w) that one such error makes of the frame, seen at its origin, the joints behind it turn with w, and the
origin moves with v away from those before it. So a motion with the twist V = V_before + V_behind of the frame becomes

    dV = (w_before x v + w x v_behind,  w x w_behind)

as for the derivative by the position of a joint. The rates W V of rows then change by W dV + dW V. Where the first
joint stands is where the base stands, which no recording can show: it is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian
from manip_learn.constraint.features.weighed_velocity import WeighedVelocity
from manip_learn.robot.batch.batch_kinematics import batch_kinematics, link_twists


@final
@dataclass(frozen=True)
class ArmErrors:
    """Prior standard deviations of the errors of an arm.

    Attributes:
        zeros: Of each joint offset [rad, sliding joints m]; with 0, errors that no residual shows are taken for zero,
            of links too.
        links: Of position [m] and orientation [rad], along each axis, of each joint after the first in the frame of the
            previous link, and of the frame in that of the last link.
    """

    zeros: float = 0.0
    links: float = 0.0

    @property
    def ratio(self) -> float:
        """Prior ratio of an error of a link to a joint offset."""
        return self.links / self.zeros if self.zeros > 0.0 else 0.0


AS_DESCRIBED = ArmErrors()


def changes_by_links(
    features: FeatureMap, q: Float[np.ndarray, "n nv"], u: Float[np.ndarray, "n nv k"]
) -> Float[np.ndarray, "n p k e"]:
    """Return the change of Phi(q) u by unit errors of e links, for k velocities at each of n postures.

    There are none (e = 0) if the features are not of one frame in the base.
    """
    n, p, k = len(q), features.n_rows, u.shape[2]
    if not isinstance(features, FrameJacobian | WeighedVelocity):
        return np.zeros((n, p, k, 0))
    robot, frame = features.robot, features.frame
    twists = link_twists(robot, frame, q)
    if twists is None:
        return np.zeros((n, p, k, 0))
    kinematics, model = batch_kinematics(robot, frame), robot.pinocchio_model
    J, pose = kinematics.jacobian(q), kinematics.pose(q)
    joints = [j for j in model.supports[frame.parent_joint] if j > 0]
    behind = {j: number for number, j in enumerate(joints)}
    # the number of the chain's joint that each velocity moves, -1 if none: those from 1 on are behind the first link
    place = np.full(robot.nv, -1)
    for block in robot.blocks:
        place[block.v] = behind.get(block.index, -1)
    V, turned = J @ u, isinstance(features, FrameJacobian) and features.reference != "world"
    # W with Phi u = W V, V along the base's axes
    if isinstance(features, WeighedVelocity):
        W = features.weights(pose[:, :3, 3])[0]
    else:
        W = np.array([np.eye(6)[AXES.index(name)] for name in features.row_names])[None].repeat(n, axis=0)
        if turned:
            back = np.zeros((n, 6, 6))
            back[:, :3, :3] = back[:, 3:, 3:] = pose[:, :3, :3].transpose(0, 2, 1)
            W = W @ back
    out = np.zeros((n, p, k, len(twists), 6))
    for link, E in enumerate(twists):
        own = place > link
        moved = J[:, :, own] @ u[:, own]
        v, w = (E[:, None, part].transpose(0, 1, 3, 2) for part in (slice(0, 3), slice(3, 6)))
        before, later = (V - moved)[:, 3:].transpose(0, 2, 1)[:, :, None], moved.transpose(0, 2, 1)[:, :, None]
        dV = np.concatenate([np.cross(before, v) + np.cross(w, later[..., :3]), np.cross(w, later[..., 3:])], axis=3)
        if turned:  # the frame's own axes turn with it
            whole = V.transpose(0, 2, 1)[:, :, None]
            dV -= np.concatenate([np.cross(w, whole[..., :3]), np.cross(w, whole[..., 3:])], axis=3)
        out[:, :, :, link] = np.einsum("npi,nkei->npke", W, dV)
        if isinstance(features, WeighedVelocity):
            dW = features.weights(pose[:, :3, 3])[1]
            out[:, :, :, link] += np.einsum("npix,nxe,nik->npke", dW, E[:, :3], V, optimize=True)
    return out.reshape(n, p, k, -1)
