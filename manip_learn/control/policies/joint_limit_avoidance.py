"""The policy that leads the joints away from their limits."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.control.policies.policy import NullSpacePolicy, positive
from manip_learn.robot.limit_potential import has_range, ranges, room_of
from manip_learn.robot.robot import Robot

# [1/s] half ranges a second that a joint moves at most, for joints whose range is short
LARGEST_RATE = 1.0


@final
class JointLimitAvoidance(NullSpacePolicy):
    """Gradient descent of the joint-limit potential h of `limit_potential`, with a bounded speed.

    With x_j in -1 ... 1 the place of joint j in its range u_j - l_j, h = sum_j 1 / (1 - x_j^2) and

        p_j = gain ((u_j - l_j) / 2)^2 dh / dq_j = gain (u_j - l_j) x_j / (1 - x_j^2)^2
        pi_j = -p_j / sqrt(1 + (p_j / v_j)^2)

    The descent is that of h in the coordinates x, so that joints of different ranges and units return to the middle at
    the same rate, 2 gain. The speed is v_j at a limit and outside; in between it is smooth. Joints that are not limited
    on both sides are left out.

    Args:
        robot: Whose limits are avoided.
        gain: Rate [1/s].
        max_speed: v_j, the largest speed of a joint [rad/s or m/s], and at most half its range a second.

    Raises:
        ConfigurationError: The gain or the speed is not positive.
    """

    def __init__(self, robot: Robot, gain: float = 0.1, *, max_speed: float = 0.5):
        self.robot = robot
        self.gain = positive("gain", gain)
        self.max_speed = positive("max_speed", max_speed)
        limited = has_range(robot)
        width = np.where(limited, ranges(robot), 0.0)
        self._strength = self.gain * width
        self._middle = np.zeros(robot.nv)
        self._middle[limited] = 0.5 * (robot.position_lower[limited] + robot.position_upper[limited])
        self._per_half = np.divide(2.0, width, out=np.zeros(robot.nv), where=limited)
        self._longest = np.where(limited, np.minimum(self.max_speed, 0.5 * LARGEST_RATE * width), 1.0)

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """Velocity towards the middle of the ranges [rad/s or m/s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        x = (self.robot.positions(q) - self._middle) * self._per_half
        room, pull = room_of(x), self._strength * x
        # multiplied by room^2 above and below: finite at the limits
        return -pull / np.hypot(room * room, pull / self._longest)

    def __repr__(self) -> str:
        return f"JointLimitAvoidance(gain={self.gain:g}, max_speed={self.max_speed:g})"
