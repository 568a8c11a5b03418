"""Rows out of which the distance of a frame from any fixed point is made, so that a sphere is a constant row, too."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.robot import Robot


@final
class DistanceRows(FeatureMap):
    """Velocity of a frame's origin p, and the rate of half its squared distance from a point m near by.

    Phi(q) = [J_v; (p - m)^T J_v]. A frame that keeps its distance from a point c has (p - c).v = 0, the constant row
    Lambda = [-(c - m)^T, 1], whatever the posture; a plane is the limit of a far centre, Lambda = [n^T, 0].

    Args:
        robot: The robot.
        frame: Name of the frame.
        middle: m in the base frame [m]; in the middle of the motion the rows are the least alike.
    """

    def __init__(self, robot: Robot, frame: str, middle: Float[np.ndarray, " 3"]):
        self.robot, self.frame, self.middle = robot, robot.frame(frame), np.array(middle, dtype=np.float64)
        self.nv = robot.nv
        self.row_names, self.row_units = ("x", "y", "z", "distance"), ("m/s", "m/s", "m/s", "m^2/s")
        self._velocity = FrameJacobian(robot, frame, "xyz")

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "4 nv"]:
        """[J_v; (p - m)^T J_v].

        Raises:
            ConfigurationError: Wrong size or not finite.
        """
        J = self._velocity(q)
        return np.vstack([J, (self.robot.position(q, self.frame) - self.middle) @ J])

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "4 nv nv"]:
        """dPhi/dq; of the last row J_v^T J_v + (p - m)^T dJ_v/dq.

        Raises:
            ConfigurationError: Wrong size or not finite.
        """
        J, H = self._velocity.value_and_derivative(q)
        away = self.robot.position(q, self.frame) - self.middle
        return np.concatenate([H, (J.T @ J + np.einsum("i,ijk->jk", away, H))[None]])

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n 4 nv"]:
        """Phi at n postures, the rows of q, in bulk.

        Raises:
            ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        """
        kinematics = batch_kinematics(self.robot, self.frame)
        J, away = kinematics.jacobian(q, "world")[:, :3], kinematics.pose(q)[:, :3, 3] - self.middle
        return np.concatenate([J, (away[:, None] @ J)], axis=1)

    def __repr__(self) -> str:
        return f"DistanceRows({self.robot.name!r}, frame={self.frame.name!r})"
