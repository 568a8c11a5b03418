"""The policy that keeps the links of a robot apart."""

from __future__ import annotations

import math
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.control.policies.policy import NullSpacePolicy, positive
from manip_learn.robot.collision import SelfCollision
from manip_learn.robot.robot import Robot


@final
class SelfCollisionAvoidance(NullSpacePolicy):
    """pi pushes links apart that are nearer to each other than `distance`, with a bounded speed.

        p = gain sum_i (1 - d_i / distance)^2 grad d_i    over the pairs of links with d_i < distance
        pi = p / sqrt(1 + |p|^2 / max_speed^2)

    Value and slope are 0 where a pair comes into range, so that pi is continuous however many pairs there are, but for
    where the nearest points of two shapes jump (see `SelfCollision`). Shapes are convex, meshes their convex hulls.

    Args:
        robot: A robot with collision shapes, or a `SelfCollision` with other settings.
        distance: Distance below which links are pushed apart [m].
        gain: Largest rate, times a lever arm in m, at contact [1/(m s)].
        max_speed: Largest norm of pi [rad/s].

    Raises:
        RobotError: The robot has no collision shapes, or one of them cannot be used.
        ConfigurationError: The distance, the gain or the speed is not positive.
    """

    def __init__(
        self, robot: Robot | SelfCollision, distance: float = 0.1, gain: float = 10.0, *, max_speed: float = 2.0
    ):
        self.distance = positive("distance", distance)
        self.gain = positive("gain", gain)
        self.max_speed = positive("max_speed", max_speed)
        self.collision = robot if isinstance(robot, SelfCollision) else SelfCollision(robot)

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """Velocity that increases the distances of the pairs in range [rad/s or m/s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        push = np.zeros(self.collision.robot.nv)
        for near in self.collision.closer_than(q, self.distance):
            push += self.gain * (1.0 - near.distance / self.distance) ** 2 * near.gradient
        return push / math.sqrt(1.0 + push.dot(push) / self.max_speed**2)

    def __repr__(self) -> str:
        return (
            f"SelfCollisionAvoidance({self.collision.robot.name!r}, distance={self.distance:g}, gain={self.gain:g}, "
            f"max_speed={self.max_speed:g})"
        )
