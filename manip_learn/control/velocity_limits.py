"""How much of a joint velocity fits between the limits."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.robot.robot import Robot

# [rad/s or m/s] A joint at its limit must not stop the arm because rounding asks it for less than this.
NEGLIGIBLE = 1e-12


@final
class Shares(NamedTuple):
    """Shares of the two parts of a command that fit, 0 to 1.

    Attributes:
        task: Of the task part.
        null: Of the null-space part, in the room that the task part leaves.
        position_bound: True if a position limit is what shortens the task part, not a velocity limit.
    """

    task: float
    null: float
    position_bound: bool


EVERYTHING = Shares(1.0, 1.0, False)


@final
class VelocityRoom:
    """Velocity limits of a robot, and the position limits seen as velocities that reach them within dt.

    Whole vectors are shortened, never single joints: that would bend the direction of the task. Plain numbers, as an
    arm has too few joints for NumPy to pay.

    Args:
        robot: The robot.
    """

    def __init__(self, robot: Robot):
        self._robot = robot
        bounds = (robot.velocity_limit, robot.position_lower, robot.position_upper)
        self._limits: list[tuple[float, float, float]] = list(zip(*(b.tolist() for b in bounds), strict=True))

    def shares(
        self,
        q: Float[np.ndarray, " n"],
        dt: float,
        task_part: Float[np.ndarray, " nv"],
        null_part: Float[np.ndarray, " nv"],
    ) -> Shares:
        """Largest shares that keep every joint within its bounds for the next dt.

        Standing still is always allowed, also outside the limits.
        """
        # a posture that has been checked already; as many numbers as joints are joint positions
        positions = q.tolist() if q.shape[0] == len(self._limits) else self._robot.positions(q).tolist()
        task_speeds, null_speeds = task_part.tolist(), null_part.tolist()
        for x, v, w, (limit, lower, upper) in zip(positions, task_speeds, null_speeds, self._limits, strict=True):
            speed = abs(v) + abs(w)
            if not (speed <= limit and lower <= x - speed * dt and x + speed * dt <= upper):
                break
        else:
            return EVERYTHING  # both parts fit into the room in either direction: nearly every step
        task, position_bound = 1.0, False
        room: list[tuple[float, float, float]] = []
        for x, v, (limit, lower, upper) in zip(positions, task_speeds, self._limits, strict=True):
            low, high = (lower - x) / dt, (upper - x) / dt
            low = -limit if low < -limit else min(low, 0.0)
            high = limit if high > limit else max(high, 0.0)
            room.append((low, high, v))
            bound = high if v > 0.0 else low
            if abs(bound) < abs(v) * task and abs(v) > NEGLIGIBLE:
                task, position_bound = bound / v, abs(bound) < limit
        null = 1.0
        for w, (low, high, v) in zip(null_speeds, room, strict=True):
            left = high - task * v if w > 0.0 else task * v - low
            if left < abs(w) * null and abs(w) > NEGLIGIBLE:
                null = max(left, 0.0) / abs(w)
        return Shares(task, null, position_bound)

    def bounds(
        self, q: Float[np.ndarray, " n"], dt: float
    ) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"]]:
        """Lowest and highest velocity of each joint that keep it within its bounds for the next dt."""
        robot = self._robot
        x = q if q.shape[0] == len(self._limits) else robot.positions(q)
        limit = robot.velocity_limit
        low = np.maximum(-limit, np.minimum((robot.position_lower - x) / dt, 0.0))
        return low, np.minimum(limit, np.maximum((robot.position_upper - x) / dt, 0.0))
