"""The potential that grows without bound towards the joint limits, and what is finite of it at the limits.

    h(q) = sum_j (u_j - l_j)^2 / (4 (u_j - q_j) (q_j - l_j)),    l_j, u_j the position limits of joint j

Zghal, Dubey and Euler, "Efficient gradient projection optimization for manipulators with multiple degrees of
redundancy" (1990); Chan and Dubey, "A weighted least-norm solution based scheme for avoiding joint limits for redundant
joint manipulators" (1995). With x_j = (2 q_j - u_j - l_j) / (u_j - l_j), which is -1 and 1 at the limits,
h = sum_j 1 / (1 - x_j^2).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.robot.robot import Robot


def limit_weights(robot: Robot, q: ArrayLike) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"]]:
    """w_j = (1 + (dh/dq_j)^2)^(-1/4) and dw_j/dq_j: 1 in the middle of a joint's range, 0 at its limits, finite.

    Vahrenkamp, Asfour, Metta, Sandini and Dillmann, "Manipulability analysis" (2012) have (1 + |dh/dq_j|)^(-1/2), after
    Chan and Dubey, for motion towards the nearer limit, and 1 for motion away from it. That has a kink in the middle of
    the range, where its slope changes sign; this one is smooth, the same at both ends, at most 1.19 times as large in
    between, and holds for both directions of motion. At a limit the derivative is that of the side within; outside,
    w and its derivative are 0.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
    """
    limited, width = has_range(robot), ranges(robot)
    # place of each joint in its range, -1 and 1 at the limits; 0 for joints not limited on both sides
    x, positions = np.zeros(robot.nv), robot.positions(q)
    twice = 2.0 * positions[limited] - robot.position_upper[limited] - robot.position_lower[limited]
    x[limited] = twice / width[limited]
    inside = np.abs(x) <= 1.0
    room, width = room_of(x), np.where(limited, width, 1.0)
    # (1 + h'^2)^(-1/4) = room sqrt(width) / D^(1/4), D = (width room^2)^2 + (4 x)^2 > 0: no division at the limits
    D = (width * room * room) ** 2 + 16.0 * x * x
    w = room * np.sqrt(width) / D**0.25
    slope_of_D = -8.0 * x * room**3 * width * width + 32.0 * x
    slope = np.sqrt(width) * (-2.0 * x / D**0.25 - 0.25 * room * slope_of_D / D**1.25) * (2.0 / width)
    return np.where(limited, w, 1.0), np.where(limited & inside, slope, 0.0)


def has_range(robot: Robot) -> np.ndarray:
    """Which joints are limited on both sides, with room between the limits; shape (nv,)."""
    width = ranges(robot)
    return np.isfinite(width) & (width > 0.0)


def ranges(robot: Robot) -> Float[np.ndarray, " nv"]:
    """u_j - l_j [rad or m], infinite where a limit is missing."""
    return robot.position_upper - robot.position_lower


def room_of(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """1 - x^2, and 0 outside the limits."""
    return np.clip((1.0 - x) * (1.0 + x), 0.0, None)
