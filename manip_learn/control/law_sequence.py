"""Laws one after the other, an approach of all joints and then the way."""

from __future__ import annotations

import math
from functools import partial
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.other_features import CustomFeatures
from manip_learn.constraint.manipulability import manipulability
from manip_learn.constraint.skill import Gripping
from manip_learn.control.command import Command, LimitedController, Posture, Vector
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.follow_motion import ARRIVED
from manip_learn.control.limits import Limits
from manip_learn.control.tasks import Task
from manip_learn.control.tasks.motion_profile import MotionProfile
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

_RAMP = 0.5  # [s] from rest to the speed, as that of a way
LOOKED = 8  # places on each piece of a path at which its speed is looked at
CLOSING = 0.5  # [s] that a gripper takes to close or to open
_SETTLING = 1.0  # [s] after which the way begins anyhow, with what encoder noise leaves


def every_joint(robot: Robot) -> Constraint:
    """A(q) = I: a row for the velocity of each joint."""
    nv, one, none = robot.nv, np.eye(robot.nv), np.zeros((robot.nv,) * 3)
    same = partial(_same, one)
    return Constraint(one, CustomFeatures(same, robot.joint_names, nv, derivative=partial(_same, none), robot=robot))


def _same(value: np.ndarray, _q: np.ndarray) -> np.ndarray:
    return value  # a function of a module can be pickled


@final
class JointMotion(Task):
    """b = dq*/dt + gain (q*(t) - q): straight from posture to posture, at rest in each, or smoothly through all.

    It begins at time 0 of its law; a `LawSequence` has each law begin there. Each leg takes the time that its slowest
    joint needs, and the tip where its speed is limited.

    Args:
        limits: Of the robot's joints and tip.
        postures: shape (k, nv), joint positions [rad or m], the start first.
        share: Of the joints' velocity limits that is used at most.
        gripper: What a gripper does meanwhile, `"close"` or `"open"`, for which it has half a second at least.
        through: One leg, a spline through all postures, in place of a straight one between each two.

    Attributes:
        start: shape (nv,), the first posture [rad or m].

    Raises:
        ConfigurationError: Postures that are not finite or of another size.
    """

    is_approach = True

    slides = False
    waits = True
    gain = 10.0  # [1/s] rate at which deviations are taken back, as of a way

    def __init__(
        self,
        limits: Limits,
        postures: ArrayLike,
        share: float = 1.0,
        gripper: Gripping | None = None,
        *,
        through: bool = False,
    ):
        robot, table = limits.robot, np.array(postures, dtype=np.float64)
        if table.ndim != 2 or table.shape[1] != robot.nv or not len(table) or not np.all(np.isfinite(table)):
            raise ConfigurationError(f"the path must be postures of {robot.nv} finite joint positions, one a row")
        self._robot = robot
        self.gripper: Gripping | None = gripper
        table = table[np.append(True, np.any(np.diff(table, axis=0) != 0.0, axis=1))]  # those of rest are no legs
        legs = [table][: len(table) - 1] if through else [table[i : i + 2] for i in range(len(table) - 1)]
        self._legs = [_leg(limits, leg, share) for leg in legs]
        self._ends = np.cumsum([profile.duration for _, profile in self._legs])
        self.start, self._last = table[0], table[-1]

    @property
    def duration(self) -> float:
        """How long the motion takes where no limit slows it down [s]."""
        return max([CLOSING if self.gripper else 0.0, *self._ends.tolist()])

    def at(self, t: float) -> tuple[Vector, Vector]:
        """Where the joints should be t [s] after the start, and how fast [rad or m, rad/s or m/s]."""
        leg = int(np.searchsorted(self._ends, t))
        if leg == len(self._legs):
            return self._last, np.zeros_like(self._last)
        path, profile = self._legs[leg]
        share, rate = profile.at(t - float(self._ends[leg]) + profile.duration)
        return path(share), rate * path(share, 1)

    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Vector:
        """b of every joint."""
        goal, rate = self.at(t)
        return rate + self.gain * self._robot.difference(q, goal)

    def is_over(self, q: ArrayLike, t: float) -> bool:
        """Whether it has arrived at posture q at time t [s]; after a second more, with what encoder noise leaves."""
        late, off = t - self.duration, self._robot.difference(np.asarray(q, dtype=np.float64), self._last)
        return late >= 0.0 and (late >= _SETTLING or float(np.linalg.norm(off)) < ARRIVED)

    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """How far the joints are from the last posture [rad or m]."""
        return float(np.linalg.norm(self._robot.difference(q, self._last)))

    def goal(self) -> Vector:
        """The last posture."""
        return self._last.copy()

    def __repr__(self) -> str:
        return f"JointMotion({len(self._legs)} legs, {self.duration:.3g} s)"


def _leg(limits: Limits, knots: Float[np.ndarray, "k nv"], share: float) -> tuple[CubicSpline, MotionProfile]:
    """Return a path through postures, and the share of it in time."""
    robot, tip = limits.robot, limits.tip

    def needed(q: np.ndarray, rates: np.ndarray) -> Posture:
        """Return the time that each joint motion takes at a posture, at full speed."""
        times = np.max(np.abs(rates) / (share * limits.velocity), axis=1)
        if tip is None:
            return times
        fastest = [tip.fastest(robot.configuration(x), d) for x, d in zip(q, rates, strict=True)]
        return np.maximum(times, np.array(fastest) / tip.pace)

    steps = np.diff(knots, axis=0)
    times = np.append(0.0, np.cumsum(needed(knots[:-1] + 0.5 * steps, steps)))
    path = CubicSpline(times / times[-1], knots, bc_type="natural")
    fine = np.linspace(0.0, 1.0, LOOKED * max(4, len(steps)) + 1)  # the law keeps what is between
    return path, MotionProfile(1.0, 1.0 / float(np.max(needed(path(fine), path(fine, 1)))), _RAMP)


@final
class LawSequence(LimitedController):
    """Laws one after the other: motions of all joints to a posture, and ways along what a constraint leaves free.

    It begins with the first call; a call at or before that time after later ones is a new run. A motion of the joints
    is over when it has arrived, a way when all of it is done: from a way that is not done no other law takes over.

    Args:
        laws: In order; the last one stays in force.

    Attributes:
        laws: The same.
        robot: The robot of all.
    """

    def __init__(self, *laws: ResolvedRateController):
        self.laws = laws
        self.robot: Robot | None = laws[-1].robot
        self.reset()

    def reset(self) -> None:
        """Forget the start: the next call is the first one again."""
        self._began, self._latest = [math.inf], -math.inf  # times at which laws took over, and of the last call [s]
        super().reset()

    @property
    def gripper(self) -> Gripping | None:
        """What a gripper was last told, `"close"` or `"open"`; None before that."""
        told = [law.task.gripper for law in self.laws[: len(self._began)] if law.task.gripper]
        return told[-1] if told else None

    @property
    def limits(self) -> Limits | None:
        """Those of the law in force."""
        return self.law.limits

    @property
    def law(self) -> ResolvedRateController:
        """The law that is in force."""
        return self.laws[len(self._began) - 1]

    @property
    def constraint(self) -> Constraint:
        """The rows of `way`."""
        return self.way.constraint

    @property
    def way(self) -> ResolvedRateController:
        """The law in force, of a motion of the joints the one that it leads to."""
        ahead = self.laws[len(self._began) - 1 :]
        return next((law for law in ahead if not law.task.is_approach), ahead[-1])

    def __call__(
        self, q: ArrayLike, t: float = 0.0, dt: float | None = None, previous: Vector | None = None, slide: float = 0.0
    ) -> Command:
        """The command at posture q; arguments and errors as for `ResolvedRateController`.

        The manipulability is always that of a way's rows.
        """
        if t <= self._began[0] < self._latest:
            self.reset()
        self._began[0], self._latest = min(self._began[0], t), t
        if len(self._began) < len(self.laws) and self.law.task.is_over(q, t - self._began[-1]):
            self._began.append(t)
        law, way = self.law, self.way
        command = law(q, t - self._began[-1], dt, previous, slide)
        return command if law is way else command._replace(manipulability=manipulability(way.constraint, q))

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Distance to the goal of the law in force [m or rad]."""
        return self.law.task_error(q, t - (self._began[-1] if self._began[-1] < math.inf else 0.0))

    def with_limits(self, limits: Limits, lag: float = 0.0) -> LawSequence:
        """These laws with other limits; nothing makes up for a lag."""
        return LawSequence(*(law.with_limits(limits) for law in self.laws))

    def __repr__(self) -> str:
        return f"LawSequence({', '.join(repr(law.task) for law in self.laws)})"
