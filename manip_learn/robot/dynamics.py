"""The inertia that a hand has for what it pushes against."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.robot.frame import FrameLike
from manip_learn.robot.robot import Robot

# [kg or kg m2] inertia of a hand in directions in which the arm cannot move: more than any arm weighs
MOST_INERTIA = 1e3


def hand_inertia(robot: Robot, q: ArrayLike, frame: FrameLike) -> Float[np.ndarray, "6 6"] | None:
    """(J M(q)^-1 J^T)^-1, the inertia that a frame's origin has for forces and moments along the axes of the base.

    O. Khatib, "A unified approach for motion and force control of robot manipulators", 1987. None where a
    link that a joint carries was described without a mass.
    """
    if not all(inertia.mass > 0.0 for inertia in list(robot.pinocchio_model.inertias)[1:]):
        return None
    lift = np.eye(robot.nv) if robot.coupling is None else robot.coupling.lift
    M = np.triu(pin.crba(robot.pinocchio_model, robot.pinocchio_model.createData(), robot.pinocchio_configuration(q)))
    M = lift.T @ (M + np.triu(M, 1).T) @ lift
    J = robot.jacobian(q, frame)
    return np.linalg.inv(J @ np.linalg.solve(M, J.T) + np.eye(6) / MOST_INERTIA)
