"""Laws one after the other: an approach, and then the way."""

from __future__ import annotations

import math
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.manipulability import manipulability
from manip_learn.control.command import Command
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.limits import Limits
from manip_learn.control.tasks.joint_motion import JointMotion
from manip_learn.robot.robot import Robot

ARRIVED = 1e-3  # [rad or m] of all joints together: the hand is within a millimetre of where it takes hold
SETTLING = 1.0  # [s] after which the way begins anyhow, with what encoder noise leaves


@final
class LawSequence:
    """A controller that moves the joints to a posture, and from there on does its task.

    It begins with the first call; a call at or before that time after later ones is a new run.

    Args:
        approach: Its task is a `JointMotion`.
        way: What follows.

    Attributes:
        robot: The robot of both.
        way_begins: Time at which the second law took over [s]; None as long as it has not.
    """

    def __init__(self, approach: ResolvedRateController, way: ResolvedRateController):
        self.approach, self.way = approach, way
        self.robot: Robot | None = way.robot
        self.reset()

    def reset(self) -> None:
        """Forget the start: the next call is the first one again."""
        self._begun, self._latest, self.way_begins = math.inf, -math.inf, None
        self.approach.task.reset()
        self.way.task.reset()

    @property
    def limits(self) -> Limits | None:
        """Those of the way."""
        return self.way.limits

    @property
    def current(self) -> ResolvedRateController:
        """The law that is in force."""
        return self.approach if self.way_begins is None else self.way

    @property
    def duration(self) -> float:
        """How long the approach takes where no limit slows it down [s]."""
        task = self.approach.task
        return task.duration if isinstance(task, JointMotion) else 0.0

    def __call__(
        self,
        q: ArrayLike,
        t: float = 0.0,
        dt: float | None = None,
        previous: Float[np.ndarray, " nv"] | None = None,
        slide: float = 0.0,
    ) -> Command:
        """The command at posture q; arguments and errors as for `ResolvedRateController`.

        The manipulability is always that of the way's rows.
        """
        if t <= self._begun < self._latest:
            self.reset()
        self._begun, self._latest = min(self._begun, t), t
        late = t - self._begun - self.duration
        if self.way_begins is None and late >= 0.0 and (late >= SETTLING or self.approach.task_error(q) < ARRIVED):
            self.way_begins = t
        if self.way_begins is not None:
            return self.way(q, t - self.way_begins, dt, previous, slide)
        command = self.approach(q, t - self._begun, dt, previous, slide)
        return command._replace(manipulability=manipulability(self.way.constraint, q))

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Distance to the goal of the law in force [m or rad]."""
        return self.current.task_error(q, t - (self.way_begins or 0.0))

    def with_limits(self, limits: Limits) -> LawSequence:
        """The same laws with other limits."""
        return LawSequence(self.approach.with_limits(limits), self.way.with_limits(limits))

    def __repr__(self) -> str:
        return f"LawSequence({self.approach.task!r}, {self.way.task!r})"
