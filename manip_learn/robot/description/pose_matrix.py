"""Poses as URDF writes them, and as 4x4 matrices."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.robot.description.urdf_elements import Pose

Matrix = Float[np.ndarray, "4 4"]


def as_pose(T: Matrix) -> Pose:
    """xyz and roll, pitch, yaw of a homogeneous matrix."""
    x, y, z = (float(c) for c in T[:3, 3])
    R = T[:3, :3]
    # atan2 throughout: exact also where the pitch is a quarter turn
    pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    if math.hypot(R[0, 0], R[1, 0]) > 1e-9:
        yaw, roll = math.atan2(R[1, 0], R[0, 0]), math.atan2(R[2, 1], R[2, 2])
    else:
        yaw, roll = math.atan2(-R[0, 1], R[1, 1]), 0.0
    return Pose((x, y, z), (roll, pitch, yaw))


def as_matrix(pose: Pose) -> Matrix:
    """Homogeneous matrix of xyz and roll, pitch, yaw."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = pin.rpy.rpyToMatrix(*pose.rpy), pose.xyz
    return T
