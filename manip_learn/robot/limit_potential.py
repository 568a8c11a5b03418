"""Joint limit potential, which grows without bound towards the limits, and a margin that stays finite there.

    h(q) = sum_j (u_j - l_j)^2 / (4 (u_j - q_j) (q_j - l_j)),    l_j, u_j the position limits of joint j

Zghal, Dubey and Euler, "Efficient gradient projection optimization for manipulators with multiple degrees of
redundancy" (1990); Chan and Dubey, "A weighted least-norm solution based scheme for avoiding joint limits for redundant
joint manipulators" (1995). With x_j = (2 q_j - u_j - l_j) / (u_j - l_j), which is -1 and 1 at the limits,
h = sum_j 1 / (1 - x_j^2).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.robot.robot import Robot


def has_range(robot: Robot) -> np.ndarray:
    """Return a mask (nv,) of the joints with two finite limits, the lower one below the upper one.

    Args:
        robot: A loaded robot.
    """
    width = ranges(robot)
    return np.isfinite(width) & (width > 0.0)


def ranges(robot: Robot) -> Float[np.ndarray, " nv"]:
    """Return the range of each joint (nv,), upper minus lower limit [rad or m]; infinite if a limit is missing.

    Args:
        robot: A loaded robot.
    """
    return robot.position_upper - robot.position_lower


def joint_range_margin(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the margin 1 - x^2 of joints with scaled positions x, and 0 outside the limits.

    Args:
        x: Joint positions (n,) scaled to their range: -1 at the lower limit, 1 at the upper limit.

    Returns:
        shape (n,), from 0 at or beyond a limit to 1 in the middle of the range.
    """
    return np.clip((1.0 - x) * (1.0 + x), 0.0, None)
