"""One step in time of a controlled robot."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from manip_learn.control.command import Controller
from manip_learn.robot.robot import Robot

Method = Literal["euler", "rk4"]


def next_posture(
    robot: Robot | None,
    controller: Controller,
    q: Float[np.ndarray, " n"],
    t: float,
    dt: float,
    method: Method,
    velocity: Float[np.ndarray, " nv"],
) -> Float[np.ndarray, " n"]:
    """The posture at time t + dt, from the one at time t.

    Euler: q (+) dt k1. The classic Runge-Kutta scheme in Munthe-Kaas form (Munthe-Kaas, 1998), with stages that are
    tangent displacements from q:

        q (+) dt/6 (k1 + 2 k2 + 2 k3 + k4),  k2 = u(q (+) dt/2 k1),  k3 = u(q (+) dt/2 k2),  k4 = u(q (+) dt k3)

    The order is 4 where the tangent coordinates commute (all joints but floating bases), and 2 otherwise.

    Args:
        robot: The robot, for (+) on its configuration manifold; None where positions simply add up.
        controller: u(q, t).
        q: Posture at time t.
        t: Time [s].
        dt: Step [s].
        method: `"euler"` or `"rk4"`.
        velocity: k1 = u(q, t) [rad/s or m/s].
    """
    if method == "euler":
        return _moved(robot, q, dt * velocity)
    k1 = velocity
    k2 = controller(_moved(robot, q, 0.5 * dt * k1), t + 0.5 * dt, dt).velocity
    k3 = controller(_moved(robot, q, 0.5 * dt * k2), t + 0.5 * dt, dt).velocity
    k4 = controller(_moved(robot, q, dt * k3), t + dt, dt).velocity
    return _moved(robot, q, dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4))


def _moved(robot: Robot | None, q: np.ndarray, step: np.ndarray) -> np.ndarray:
    return q + step if robot is None else robot.integrate(q, step)
