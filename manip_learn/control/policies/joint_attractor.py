"""The policy that pulls towards a rest posture."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.control.policies.policy import NullSpacePolicy
from manip_learn.errors import TargetError
from manip_learn.robot.robot import Robot


@final
class JointAttractor(NullSpacePolicy):
    """pi = gain * (rest - q), the point attractor of the paper's comparisons.

    Differences are taken on the configuration manifold if the robot is given, so that a continuous joint goes the
    short way; without it they are plain differences.

    Args:
        rest: Rest posture psi*, the same kind of vector as q.
        gain: Rate [1/s].
        robot: The robot, for differences on its configuration manifold.

    Raises:
        TargetError: Not finite, or not a vector.
        ConfigurationError: Wrong size for the robot.
    """

    def __init__(self, rest: ArrayLike, gain: float = 1.0, robot: Robot | None = None):
        self.rest = np.array(rest, dtype=np.float64)
        if self.rest.ndim != 1 or not np.all(np.isfinite(self.rest)):
            raise TargetError(f"the rest posture must be finite numbers in one row, got {rest!r}")
        if robot is not None:
            robot.configuration(self.rest)
        self.rest.setflags(write=False)
        self.gain = float(gain)
        self.robot = robot

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """gain * (rest - q) [rad/s or m/s].

        Raises:
            TargetError: q and the rest posture have different sizes.
        """
        if self.robot is not None:
            return self.gain * self.robot.difference(q, self.rest)
        here = np.asarray(q, dtype=np.float64)
        if here.shape != self.rest.shape:
            raise TargetError(f"the rest posture has {self.rest.size} numbers, the posture has shape {here.shape}")
        return self.gain * (self.rest - here)

    def __repr__(self) -> str:
        return f"JointAttractor({np.array2string(self.rest, precision=3)}, gain={self.gain:g})"
