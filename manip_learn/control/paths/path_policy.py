"""The policy that follows a path of postures in the null space of a task."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from manip_learn.control.policies.policy import NullSpacePolicy
from manip_learn.robot.robot import Robot


@final
class PathPolicy(NullSpacePolicy):
    """pi = dq*/dt + gain (q*(t) - q), with q*(t) a cubic spline through knots; at rest in q* behind the last one.

    Args:
        time: Times of the knots, rising [s].
        knots: Joint positions [rad or m], one row per knot.
        gain: Rate at which differences from the path are made up [1/s].
        robot: Whose joints they are; None for a system whose state is a plain vector.
    """

    def __init__(
        self, time: Float[np.ndarray, " K"], knots: Float[np.ndarray, "K nv"], gain: float, robot: Robot | None = None
    ):
        self.time = np.array(time, dtype=np.float64)
        self.knots = np.array(knots, dtype=np.float64)
        self.gain = float(gain)
        self._robot = robot
        self._spline = CubicSpline(self.time, self.knots, bc_type="natural")
        self._rate = self._spline.derivative()

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """Velocity along the path and towards it [rad/s or m/s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        end = float(self.time[-1])
        goal = self._spline(min(t, end))
        posture = np.asarray(q, dtype=np.float64)
        error = goal - posture if self._robot is None else self._robot.difference(posture, goal)
        return self.gain * error + (self._rate(t) if t < end else 0.0)

    def __repr__(self) -> str:
        return f"PathPolicy({len(self.time)} knots over {self.time[-1] - self.time[0]:g} s, gain={self.gain:g})"
