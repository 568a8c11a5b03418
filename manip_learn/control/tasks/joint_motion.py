"""Motion of all joints along a path of postures: no constraint holds the hand, each joint's velocity is a row."""

from __future__ import annotations

import math
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.custom_features import CustomFeatures
from manip_learn.control.tasks.point_attractor import Task
from manip_learn.control.tasks.straight_motion import MotionProfile
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

RAMP = 0.5  # [s] from rest to the speed, as that of a way


def every_joint(robot: Robot) -> Constraint:
    """A(q) = I: a row for the velocity of each joint."""
    nv, one, none = robot.nv, np.eye(robot.nv), np.zeros((robot.nv,) * 3)
    rows = CustomFeatures(lambda _q: one, robot.joint_names, nv, derivative=lambda _q: none, robot=robot)
    return Constraint(one, rows)


@final
class JointMotion(Task):
    """b = dq*/dt + gain (q*(t) - q): straight from posture to posture, at rest in each of them.

    It begins with the first call, as a `FreeDirection` does; a call at or before that time after later ones is a new
    run.

    Args:
        robot: The robot.
        postures: shape (k, nv), joint positions [rad or m], the start first.
        speed: shape (nv,), largest speed of each joint [rad/s or m/s].
        gain: Rate at which deviations are taken back [1/s].

    Raises:
        ConfigurationError: Postures that are not finite or of another size, or speeds that are not positive.
    """

    slides = False
    waits = True

    def __init__(self, robot: Robot, postures: ArrayLike, speed: ArrayLike, gain: float = 10.0):
        table = np.array(postures, dtype=np.float64)
        most = np.broadcast_to(np.asarray(speed, dtype=np.float64), (robot.nv,))
        if table.ndim != 2 or table.shape[1] != robot.nv or not len(table) or not np.all(np.isfinite(table)):
            raise ConfigurationError(f"the path must be postures of {robot.nv} finite joint positions, one a row")
        if not np.all(most > 0.0):
            raise ConfigurationError(f"the speeds of the joints must be positive, got {most.tolist()}")
        self._robot, self.gain = robot, float(gain)
        steps = np.diff(table, axis=0)
        times = np.max(np.abs(steps) / most, axis=1, initial=0.0)  # [s] at full speed
        moves = times > 0.0
        self._starts, self._steps = table[:-1][moves], steps[moves]
        self._profiles = [MotionProfile(1.0, 1.0 / time, RAMP) for time in times[moves].tolist()]
        self._ends = np.cumsum([profile.duration for profile in self._profiles])
        self._last = table[-1]
        self.reset()

    @property
    def duration(self) -> float:
        """How long the motion takes where no limit slows it down [s]."""
        return float(self._ends[-1]) if len(self._ends) else 0.0

    def reset(self) -> None:
        """Forget the start: the next call is the first one again."""
        self._begun, self._latest = math.inf, -math.inf

    def at(self, t: float) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"]]:
        """Where the joints should be t [s] after the start, and how fast [rad or m, rad/s or m/s]."""
        leg = int(np.searchsorted(self._ends, t))
        if leg >= len(self._ends):
            return self._last, np.zeros_like(self._last)
        profile = self._profiles[leg]
        share, rate = profile.at(t - float(self._ends[leg]) + profile.duration)
        return self._starts[leg] + share * self._steps[leg], rate * self._steps[leg]

    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, " nv"]:
        """b of every joint."""
        if t <= self._begun < self._latest:
            self.reset()
        self._begun, self._latest = min(self._begun, t), t
        goal, rate = self.at(t - self._begun)
        return rate + self.gain * self._robot.difference(q, goal)

    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """How far the joints are from the last posture [rad or m]."""
        return float(np.linalg.norm(self._robot.difference(q, self._last)))

    def goal(self) -> Float[np.ndarray, " nv"]:
        """The last posture."""
        return self._last.copy()

    def __repr__(self) -> str:
        return f"JointMotion({len(self._profiles)} legs, {self.duration:.3g} s)"
