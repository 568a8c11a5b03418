"""Efforts that move a robot freely: inverse dynamics, and its regressor for inertias not known."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.robot.frame import FrameLike
from manip_learn.robot.robot import Robot

# [kg or kg m2] inertia of a hand in directions in which the arm cannot move: more than any arm weighs
MOST_INERTIA = 1e3


def has_inertias(robot: Robot) -> bool:
    """Whether every link that a joint carries was described with a mass."""
    return all(inertia.mass > 0.0 for inertia in list(robot.pinocchio_model.inertias)[1:])


def hand_inertia(robot: Robot, q: ArrayLike, frame: FrameLike) -> Float[np.ndarray, "6 6"] | None:
    """(J M(q)^-1 J^T)^-1, the inertia that a frame's origin has for forces and moments along the axes of the base.

    O. Khatib, "A unified approach for motion and force control of robot manipulators", 1987. None without inertias.
    """
    if not has_inertias(robot):
        return None
    lift = _lift(robot)
    M = np.triu(pin.crba(robot.pinocchio_model, robot.pinocchio_model.createData(), robot.pinocchio_configuration(q)))
    M = lift.T @ (M + np.triu(M, 1).T) @ lift
    J = robot.jacobian(q, frame)
    return np.linalg.inv(J @ np.linalg.solve(M, J.T) + np.eye(6) / MOST_INERTIA)


def inverse_dynamics(
    robot: Robot, q: Float[np.ndarray, "T n"], u: Float[np.ndarray, "T nv"], du: Float[np.ndarray, "T nv"]
) -> Float[np.ndarray, "T nv"]:
    """M(q) du + C(q, u) u + g(q), by recursive Newton-Euler [N m or N]; gravity along -z of the base.

    Args:
        robot: With inertias, see `has_inertias`. Mimic joints load their leaders.
        q: Postures.
        u: Velocities [rad/s or m/s].
        du: Accelerations [rad/s^2 or m/s^2].
    """
    model, data, lift = robot.pinocchio_model, robot.pinocchio_model.createData(), _lift(robot)
    out = np.empty((len(u), robot.nv))
    for i, (posture, v, a) in enumerate(zip(q, u, du, strict=True)):
        out[i] = pin.rnea(model, data, robot.pinocchio_configuration(posture), lift @ v, lift @ a) @ lift
    return out


def torque_regressor(
    robot: Robot, q: Float[np.ndarray, "T n"], u: Float[np.ndarray, "T nv"], du: Float[np.ndarray, "T nv"]
) -> Float[np.ndarray, "T nv k"]:
    """Y with M(q) du + C(q, u) u + g(q) = Y theta, theta the ten inertial parameters of each link."""
    model, data, lift = robot.pinocchio_model, robot.pinocchio_model.createData(), _lift(robot)
    rows = []
    for posture, v, a in zip(q, u, du, strict=True):
        Y = pin.computeJointTorqueRegressor(model, data, robot.pinocchio_configuration(posture), lift @ v, lift @ a)
        rows.append(lift.T @ Y)
    return np.array(rows)


def _lift(robot: Robot) -> Float[np.ndarray, "n_all nv"]:
    return np.eye(robot.nv) if robot.coupling is None else robot.coupling.lift
