"""Following error: how far the measured posture is from the commanded one, and whether that is too far."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

# [rad] and [m] default largest distance between the commanded and the measured position of a joint
FOLLOWING_ERROR = 0.1
PRISMATIC_FOLLOWING_ERROR = 0.02


@final
class FollowingError:
    """Distance between the commanded and the measured posture, beyond what a late measurement explains.

    Args:
        robot: The robot.
        limit: shape (nv,) or a number [rad or m]; None for `FOLLOWING_ERROR` and `PRISMATIC_FOLLOWING_ERROR`.
        latency: Time by which a measurement may lag behind the command that it is compared with [s].

    Attributes:
        largest: Largest distance of a joint in the newest comparison [rad or m].
        tripped: Whether a joint has ever been farther away than its limit.

    Raises:
        ConfigurationError: A limit that is not positive or has the wrong size.
    """

    def __init__(self, robot: Robot, limit: ArrayLike | None, latency: float):
        if limit is None:
            limit = np.full(robot.nv, FOLLOWING_ERROR)
            for block in robot.blocks:
                if block.kind == "prismatic":
                    limit[block.v] = PRISMATIC_FOLLOWING_ERROR
        array = np.asarray(limit, dtype=np.float64)
        if array.shape not in ((), (robot.nv,)) or not np.all(array > 0.0):
            raise ConfigurationError(
                f"following_error_limit must be one positive number or {robot.nv}, got {array.tolist()}"
            )
        self.limit = np.array(np.broadcast_to(array, (robot.nv,)))
        self.latency = latency
        self._robot = robot
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.largest, self.tripped = 0.0, False

    def compare(
        self,
        commanded: Float[np.ndarray, " n"],
        measured: Float[np.ndarray, " n"],
        velocity: Float[np.ndarray, " nv"],
        acceleration: Float[np.ndarray, " nv"],
    ) -> None:
        """Compare two postures; `velocity` and `acceleration` are those of the commanded one, at most."""
        away = np.abs(self._robot.difference(commanded, measured))
        # without an acceleration limit, the velocity before the command is unknown
        change = self.latency * np.where(np.isfinite(acceleration), acceleration, 0.0)
        excess = np.maximum(away - self.latency * (np.abs(velocity) + change), 0.0)
        self.largest = float(excess.max(initial=0.0))
        if self.largest > 0.0 and np.any(excess > self.limit):
            self.tripped = True
