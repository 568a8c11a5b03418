"""Velocity of one frame as seen from another that moves as well: two arms on one object, or a tool on a moving part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.frame_jacobian import PoseRows
from manip_learn.errors import FeatureError
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot


@final
class RelativeFrameJacobian(PoseRows):
    """Twist of one frame relative to another, along the axes of the other.

    With the frames A (`frame`) and B (`relative_to`), d = p_A - p_B and R = R_B, all from Jacobians J = (Jv, Jw) in the
    base axes, the rows are

        linear    R^T (Jv_A - Jv_B + [d]x Jw_B)      the rate of R^T d [m/s]
        rotation  R^T (Jw_A - Jw_B)                  the angular velocity of A relative to B [rad/s]

    so that a tool which keeps still on a part that itself is being carried has zero velocity here. Two arms that carry
    one object are one robot with two tips. An object whose pose was recorded is a floating joint of the robot: see
    `objects` of `load_robot`.

    Args:
        robot: The robot; both frames are its own.
        frame: Name of the frame that moves, e.g. the left tool's tip.
        relative_to: Name of the frame from which it is seen; its axes are the axes of the rows.
        axes: `"xyz"`, `"pose"` (all six), `"planar"`, `"rotation"`, or any of `x y z rx ry rz`.

    Raises:
        UnknownNameError: No such frame; lists near matches.
        FeatureError: Unknown axes, or twice the same frame.
    """

    relative_to: Frame
    kind = "relative-frame-jacobian"
    saved = {"frame": "frame.name", "relative_to": "relative_to.name", "axes": "row_names"}

    def __init__(self, robot: Robot, frame: str, relative_to: str, axes: str | Sequence[str] = "pose"):
        super().__init__(robot, frame, axes, relative_to, False)
        if self.frame.index == self.relative_to.index:
            raise FeatureError(f"frame {frame!r} does not move relative to itself: name two frames")

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Phi(q) [m/s or rad/s per unit joint velocity].

        Raises:
            ConfigurationError: Wrong size or not finite.
        """
        return self.twist_rows(q, False)[self._rows]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Phi(q) and dPhi/dq, as of many postures."""
        Phi, dPhi = self.batch_with_derivative(self.robot.checked_posture(q)[None])
        return Phi[0], dPhi[0]

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Phi at n configurations (nq) or joint positions (nv), the rows of q.

        Raises:
            ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        """
        A, B = (batch_kinematics(self.robot, f) for f in (self.frame, self.relative_to))
        return _seen(A.pose(q), B.pose(q), A.jacobian(q), B.jacobian(q))[0][:, self._rows]

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Phi and dPhi/dq at n configurations; errors as for `batch`."""
        A, B = (batch_kinematics(self.robot, f) for f in (self.frame, self.relative_to))
        (J_A, H_A), (J_B, H_B) = A.jacobian_and_derivative(q), B.jacobian_and_derivative(q)
        Phi, dPhi = _seen(A.pose(q), B.pose(q), J_A, J_B, H_A, H_B)
        return Phi[:, self._rows], dPhi[:, self._rows]

    def twist_rows(self, q: ArrayLike, own_axes: bool) -> Float[np.ndarray, "6 nv"]:
        """All six rows, along the axes of the other frame."""
        frames = self.frame, self.relative_to
        poses, jacobians = ([f(q, frame)[None] for frame in frames] for f in (self.robot.pose, self.robot.jacobian))
        return _seen(*poses, *jacobians)[0][0]


def _seen(
    A: Float[np.ndarray, "n 4 4"],
    B: Float[np.ndarray, "n 4 4"],
    J_A: Float[np.ndarray, "n 6 nv"],
    J_B: Float[np.ndarray, "n 6 nv"],
    H_A: Float[np.ndarray, "n 6 nv nv"] | None = None,
    H_B: Float[np.ndarray, "n 6 nv nv"] | None = None,
) -> tuple[Float[np.ndarray, "n 6 nv"], Any]:
    """All six rows from poses and Jacobians in the base axes, R^T V; with Hessians also d/dq_k of it.

    That is R^T (dV/dq_k - w_k x V), where w_k is the angular velocity of B per unit velocity of joint k.
    """
    R, d = B[:, :3, :3], A[:, :3, 3] - B[:, :3, 3]
    V = J_A - J_B
    slope = V[:, :3].copy()  # of d
    V[:, :3] += np.cross(d[:, :, None], J_B[:, 3:], axis=1)  # the origin of A seen by an observer who turns with B
    if H_A is None or H_B is None:
        return _turned(R, V), None
    dV = H_A - H_B
    dV[:, :3] += np.cross(slope[:, :, None, :], J_B[:, 3:, :, None], axis=1)
    dV[:, :3] += np.cross(d[:, :, None, None], H_B[:, 3:], axis=1)
    w = J_B[:, 3:, None, :]
    for part in (slice(0, 3), slice(3, 6)):
        dV[:, part] -= np.cross(w, V[:, part, :, None], axis=1)
    return _turned(R, V), _turned(R, dV)


def _turned(R: Float[np.ndarray, "n 3 3"], V: np.ndarray) -> np.ndarray:
    """Linear and rotation rows along the axes of B."""
    return np.concatenate([np.einsum("nji,nj...->ni...", R, part) for part in (V[:, :3], V[:, 3:])], axis=1)
