"""Learnt tasks and null-space policies as tasks of Pink, which can be combined with all others of Pink."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.policies import NullSpacePolicy
from manip_learn.control.tasks import Task
from manip_learn.errors import ConfigurationError, ConstraintError, MissingExtraError, UnknownNameError
from manip_learn.robot.robot import Robot

try:
    from pink.tasks import Task as _Task
except ImportError as error:
    raise MissingExtraError("Pink tasks", "pink") from error


class _RobotTask(_Task):
    """A task of a robot's joints, in the model of a Pink configuration, which may have more of them."""

    def __init__(self, robot: Robot | None, dt: float, cost: float | None, lm_damping: float = 0.0):
        super().__init__(cost=None if cost is None else float(cost), gain=1.0, lm_damping=lm_damping)
        if robot is None or robot.coupling is not None:
            what = "belong to no robot" if robot is None else f"of {robot.name!r} include mimic joints"
            raise ConstraintError(f"joints {what}: Pink needs joints that its model has by the same names")
        if not (np.isfinite(dt) and dt > 0.0):
            raise ConfigurationError(f"dt must be a positive number of seconds, got {dt!r}")
        self.robot, self.dt, self.time = robot, float(dt), 0.0

    def _posture(self, configuration: Any) -> Float[np.ndarray, " nq"]:
        """Return the robot's configuration."""
        return np.ascontiguousarray(configuration.q[self._columns(configuration.model)[0]])

    def _widened(self, configuration: Any, rows: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "s nv"]:
        """Return rows in the columns of the robot's joints."""
        out = np.zeros((len(rows), configuration.model.nv))
        out[:, self._columns(configuration.model)[1]] = rows
        return out

    def _columns(self, model: Any) -> tuple[list[int], list[int]]:
        """Return the places of the robot's joints in the model's configurations and velocities."""
        q, v = [], []
        for block in self.robot.blocks:
            if not model.existJointName(block.name):
                raise UnknownNameError("joint", block.name, list(model.names)[1:], "Pink's model")
            joint = model.joints[model.getJointId(block.name)]
            q += range(joint.idx_q, joint.idx_q + joint.nq)
            v += range(joint.idx_v, joint.idx_v + joint.nv)
        return q, v


@final
class PinkConstraintTask(_RobotTask):
    """Task of Pink for a learnt constraint and its task: equation (1), A(q) u = b(q, t), for `pink.solve_ik`.

    Pink solves J dq = -gain e for the displacement dq = dt u, so that J = A and e = -dt b. Leave Pink's `gain` at 1:
    the task has a gain of its own. Passed among the `constraints` of `solve_ik` it is a hard equality; among the
    `tasks` it is weighted by `cost`. With `PinkPolicyTask` as the only task, and neither limits nor damping, Pink
    returns the same velocity as `ResolvedRateController`, u = A^+ b + N pi, equation (2).

    Args:
        constraint: Constraint A(q). The joints of its robot are found by name in Pink's model, which may have more.
        task: Task b(q, t).
        dt: Time step of `solve_ik` [s].
        cost: Weight of the rows; it has no effect on a hard constraint.
        lm_damping: Pink's Levenberg-Marquardt damping.

    Attributes:
        time: Time t of b(q, t) [s]; set it before each step if the task depends on time.

    Raises:
        ConstraintError: The features have no robot, or its mimic joints are not supported by Pink.
        ConfigurationError: dt is not a positive number.
    """

    def __init__(
        self, constraint: Constraint, task: Task, dt: float, cost: float | None = 1.0, lm_damping: float = 0.0
    ):
        super().__init__(constraint.robot, dt, cost, lm_damping)
        self.constraint, self.task = constraint, task

    def compute_error(self, configuration: Any) -> Float[np.ndarray, " s"]:
        """Return the error e = -dt b of Pink's task at a configuration, shape (s,) in the rows' units.

        Args:
            configuration: A `pink.Configuration`.
        """
        return -self.dt * self.task.velocity(self.constraint, self._posture(configuration), self.time)

    def compute_jacobian(self, configuration: Any) -> Float[np.ndarray, "s nv"]:
        """Return A in the columns of its joints in Pink's model, and zeros for all others, shape (s, nv of that model).

        Args:
            configuration: A `pink.Configuration`.
        """
        return self._widened(configuration, self.constraint(self._posture(configuration)))

    def __repr__(self) -> str:
        return f"PinkConstraintTask({self.constraint!r}, {self.task!r}, dt={self.dt:g}, cost={self.cost})"


@final
class PinkPolicyTask(_RobotTask):
    """Task of Pink for a null-space policy, u = pi(q, t): J is the identity on the robot's joints and e = -dt pi.

    With `ManipulabilityAscent` it climbs the manipulability of the learnt rows, with their exact gradient; Pink's own
    `ManipulabilityTask` cannot combine rows of the Jacobian.

    Args:
        policy: Policy pi(q, t).
        robot: Robot whose joints the policy moves, found in Pink's model by their names.
        dt: Time step of `solve_ik` [s].
        cost: Weight.

    Attributes:
        time: Time t of pi(q, t) [s]; set it before each step if the policy depends on time.

    Raises:
        ConstraintError: The robot has mimic joints, which Pink does not support.
        ConfigurationError: dt is not a positive number.
    """

    def __init__(self, policy: NullSpacePolicy, robot: Robot, dt: float, cost: float = 1.0):
        super().__init__(robot, dt, cost)
        self.policy = policy

    def compute_error(self, configuration: Any) -> Float[np.ndarray, " n"]:
        """Return the error e = -dt pi of Pink's task at a configuration, shape (n,) [rad or m].

        Args:
            configuration: A `pink.Configuration`.
        """
        return -self.dt * self.policy(self._posture(configuration), self.time)

    def compute_jacobian(self, configuration: Any) -> Float[np.ndarray, "n nv"]:
        """Return a row per joint (n, nv of Pink's model): 1 in the column of that joint, 0 in all others.

        Args:
            configuration: A `pink.Configuration`.
        """
        return self._widened(configuration, np.eye(self.robot.nv))

    def __repr__(self) -> str:
        return f"PinkPolicyTask({self.policy!r}, dt={self.dt:g}, cost={self.cost})"
