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
        """Return Phi at n configurations (nq) or joint positions (nv), the rows of q.

        Raises:
            ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        """
        both = (batch_kinematics(self.robot, frame) for frame in (self.frame, self.relative_to))
        return _seen(*[(each.pose(q), each.jacobian(q)) for each in both])[0][:, self._rows]

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Return Phi and dPhi/dq at n configurations; errors as for `batch`."""
        both = (batch_kinematics(self.robot, frame) for frame in (self.frame, self.relative_to))
        Phi, dPhi = _seen(*[(each.pose(q), *each.jacobian_and_derivative(q)) for each in both])
        return Phi[:, self._rows], dPhi[:, self._rows]

    def twist_rows(self, q: ArrayLike, own_axes: bool) -> Float[np.ndarray, "6 nv"]:
        """Return all six rows, along the axes of the other frame."""
        both, robot = (self.frame, self.relative_to), self.robot
        return _seen(*[(robot.pose(q, frame)[None], robot.jacobian(q, frame)[None]) for frame in both])[0][0]


def _seen(A: Sequence[np.ndarray], B: Sequence[np.ndarray]) -> tuple[Float[np.ndarray, "n 6 nv"], Any]:
    """Return all six rows R^T V of frame A as seen from B, and d/dq_k of them, R^T (dV/dq_k - w_k x V).

    w_k is the angular velocity of B per unit velocity of joint k.

    Args:
        A: Poses (n, 4, 4), Jacobians (n, 6, nv) and, where the derivative is wanted, Hessians (n, 6, nv, nv) of the
            frame, all in the base axes.
        B: Those of the frame from which it is seen.
    """
    (pose_A, J_A, *H_A), (pose_B, J_B, *H_B) = A, B
    R, d = pose_B[:, :3, :3], pose_A[:, :3, 3] - pose_B[:, :3, 3]
    V = J_A - J_B
    slope = V[:, :3].copy()  # of d
    V[:, :3] += np.cross(d[:, :, None], J_B[:, 3:], axis=1)  # the origin of A seen by an observer who turns with B
    if not H_A:
        return _turned(R, V), None
    dV = H_A[0] - H_B[0]
    dV[:, :3] += np.cross(slope[:, :, None, :], J_B[:, 3:, :, None], axis=1)
    dV[:, :3] += np.cross(d[:, :, None, None], H_B[0][:, 3:], axis=1)
    for part in (slice(0, 3), slice(3, 6)):
        dV[:, part] -= np.cross(J_B[:, 3:, None, :], V[:, part, :, None], axis=1)
    return _turned(R, V), _turned(R, dV)


def _turned(R: Float[np.ndarray, "n 3 3"], V: np.ndarray) -> np.ndarray:
    """Return linear and rotation rows along the axes of B."""
    return np.concatenate([np.einsum("nji,nj...->ni...", R, part) for part in (V[:, :3], V[:, 3:])], axis=1)
