"""Postures that hold a handle: inverse kinematics from many starts, so that the elbow is elsewhere each time."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from manip_learn.robot import Robot

NEAR_READY = np.array([0.0, -1.18, 0.0, 2.18, 0.0, 0.57, 3.3161])  # [rad] elbow up, in front of the base
LIMIT_MARGIN = 0.5  # [rad]
LOWEST, NARROWEST = 0.10, 0.20  # [m] above the floor; from the column of the base
MOVING_LINKS = ("right_l3", "right_l4", "right_l5", "right_l6")


def grip_posture(
    robot: Robot, frame: str, position: Float[np.ndarray, " 3"], rotation: Rotation, rng: np.random.Generator
) -> Float[np.ndarray, " 7"] | None:
    """A posture [rad] that puts the frame at a position [m] and rotation of the base frame; None if there is none.

    Random starts, damped Newton steps; postures near a joint limit, the floor or the column are passed over.
    """
    for _ in range(100):
        q = _solve(robot, frame, position, rotation, NEAR_READY + rng.normal(0.0, 0.6, robot.nv))
        if q is not None and _is_comfortable(robot, q):
            return q
    return None


def _solve(robot: Robot, frame: str, position, rotation: Rotation, q: np.ndarray) -> np.ndarray | None:
    tip = robot.frame(frame)
    for _ in range(60):
        pose = robot.pose(q, tip)
        turn = (rotation * Rotation.from_matrix(pose[:3, :3]).inv()).as_rotvec()
        error = np.concatenate([position - pose[:3, 3], turn])
        if np.max(np.abs(error)) < 1e-12:
            return q
        J = robot.jacobian(q, tip)
        damping = 1e-2 * min(float(error @ error), 1.0)
        q = q + np.clip(J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), error), -0.3, 0.3)
    return None


def _is_comfortable(robot: Robot, q: np.ndarray) -> bool:
    if np.any(q < robot.position_lower + LIMIT_MARGIN) or np.any(q > robot.position_upper - LIMIT_MARGIN):
        return False
    origins = np.array([robot.pose(q, robot.frame(link))[:3, 3] for link in MOVING_LINKS])
    return bool(np.all(origins[:, 2] > LOWEST) and np.all(np.hypot(origins[:, 0], origins[:, 1]) > NARROWEST))
