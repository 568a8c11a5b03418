"""Velocity and position limits: by how much a joint velocity must be scaled down to respect them."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.robot.robot import Robot

# [rad/s or m/s] rounding that commands a joint at its limit less than this must not stop the arm
NEGLIGIBLE = 1e-12


@final
class ScaleFactors(NamedTuple):
    """Factors that bring the two parts of a command within the limits, 0 to 1.

    Attributes:
        task: On the task part.
        null: On the null-space part, after the scaled task part has been subtracted from the limits.
        position_bound: True if it is a position limit, not a velocity limit, that scales the task part down.
    """

    task: float
    null: float
    position_bound: bool


UNSCALED = ScaleFactors(1.0, 1.0, False)


@final
class VelocityLimits:
    """Velocity limits of a robot, and the position limits seen as velocities that reach them within dt.

    Whole vectors are scaled, never single joints: that would change the direction of the task. Loops over Python
    floats, because NumPy calls on vectors as short as an arm's cost more.

    Args:
        robot: The robot.
    """

    def __init__(self, robot: Robot):
        self._robot = robot
        bounds = (robot.velocity_limit, robot.position_lower, robot.position_upper)
        self._limits: list[tuple[float, float, float]] = list(zip(*(b.tolist() for b in bounds), strict=True))

    def scale_factors(
        self,
        q: Float[np.ndarray, " n"],
        dt: float,
        task_part: Float[np.ndarray, " nv"],
        null_part: Float[np.ndarray, " nv"],
    ) -> ScaleFactors:
        """The largest factors that keep every joint within its bounds for the next dt.

        With the bounds of joint j, l_j <= u_j <= h_j (see `bounds`), task part v and null-space part w:

            task = min(1, min_j h_j / v_j over v_j > 0, min_j l_j / v_j over v_j < 0)

        and the same for w between the bounds l - task v and h - task v. Standing still is always allowed, also outside
        the limits.
        """
        # a posture that has been checked already; as many numbers as joints are joint positions
        positions = q.tolist() if q.shape[0] == len(self._limits) else self._robot.positions(q).tolist()
        task_speeds, null_speeds = task_part.tolist(), null_part.tolist()
        for x, v, w, (limit, lower, upper) in zip(positions, task_speeds, null_speeds, self._limits, strict=True):
            speed = abs(v) + abs(w)
            if not (speed <= limit and lower <= x - speed * dt and x + speed * dt <= upper):
                break
        else:
            return UNSCALED  # both parts fit in either direction: nearly every step
        task, position_bound = 1.0, False
        bounds: list[tuple[float, float, float]] = []
        for x, v, (limit, lower, upper) in zip(positions, task_speeds, self._limits, strict=True):
            low, high = (lower - x) / dt, (upper - x) / dt
            low = -limit if low < -limit else min(low, 0.0)
            high = limit if high > limit else max(high, 0.0)
            bounds.append((low, high, v))
            bound = high if v > 0.0 else low
            if abs(bound) < abs(v) * task and abs(v) > NEGLIGIBLE:
                task, position_bound = bound / v, abs(bound) < limit
        null = 1.0
        for w, (low, high, v) in zip(null_speeds, bounds, strict=True):
            left = high - task * v if w > 0.0 else task * v - low
            if left < abs(w) * null and abs(w) > NEGLIGIBLE:
                null = max(left, 0.0) / abs(w)
        return ScaleFactors(task, null, position_bound)

    def bounds(
        self, q: Float[np.ndarray, " n"], dt: float
    ) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"]]:
        """Lowest and highest velocity of each joint that keep it within its position limits for the next dt.

        l = max(-limit, min((lower - q) / dt, 0)),  h = min(limit, max((upper - q) / dt, 0))
        """
        robot = self._robot
        x = q if q.shape[0] == len(self._limits) else robot.positions(q)
        limit = robot.velocity_limit
        low = np.maximum(-limit, np.minimum((robot.position_lower - x) / dt, 0.0))
        return low, np.minimum(limit, np.maximum((robot.position_upper - x) / dt, 0.0))
