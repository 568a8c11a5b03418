"""Commands of a controller, their status, and the interface of controllers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import StrEnum
from typing import Any, Literal, NamedTuple, Protocol, final

import numpy as np
from jaxtyping import Float

Vector = Float[np.ndarray, " nv"]  # one number a joint: a velocity, or a displacement [rad or m]
Posture = Float[np.ndarray, " n"]  # a configuration or joint positions [rad or m]


@final
class Status(StrEnum):
    """Status of a command: the most serious reason for which it differs from the law; most serious first.

    Members are strings: `command.status == "ok"` works, and files contain these words.

    Attributes:
        INVALID_INPUT: The posture or the time is invalid, or the controller raised: the arm brakes to a stop
            (`ServoLoop`).
        STALE: No new state for too long: the arm brakes to a stop (`ServoLoop`).
        FOLLOWING_ERROR: The measured posture is too far from the commanded one: the arm brakes to a stop
            (`ServoLoop`).
        STOPPED: `ServoLoop.stop` was called: the arm brakes to a stop.
        OUTSIDE_LIMITS: A joint is outside its position limits, and returns where it can.
        SINGULAR: At this posture no joint motion moves the hand in a task direction.
        STALLED: The task has not reached its goal and does not approach it: less than 2 % of the requested velocity
            is left along it, because limits or a singularity block the rest.
        POSITION_LIMITED: The task was slowed down for a position limit.
        VELOCITY_LIMITED: The task was slowed down for a velocity limit.
        ACCELERATION_LIMITED: The task was slowed down for an acceleration limit.
        DAMPED: The task part was damped near a singularity.
        REROUTED: A joint is at a limit, and null-space motion of the others compensates for it, so that the task keeps
            its speed (saturation in the null space).
        NULL_SCALED: The null-space part was reduced, because the limits leave no room for all of it after the task.
        OK: The law without any change.
    """

    INVALID_INPUT = "invalid-input"
    STALE = "stale"
    FOLLOWING_ERROR = "following-error"
    STOPPED = "stopped"
    OUTSIDE_LIMITS = "outside-limits"
    SINGULAR = "singular"
    STALLED = "stalled"
    POSITION_LIMITED = "position-limited"
    VELOCITY_LIMITED = "velocity-limited"
    ACCELERATION_LIMITED = "acceleration-limited"
    DAMPED = "damped"
    REROUTED = "rerouted"
    NULL_SCALED = "null-scaled"
    OK = "ok"

    @property
    def effect(self) -> Literal["ok", "slowed", "stopped"]:
        """Effect on the requested motion: `"ok"` (as requested), `"slowed"` (slower), or `"stopped"`."""
        if self in (Status.OK, Status.NULL_SCALED, Status.REROUTED):
            return "ok"
        stands = (Status.INVALID_INPUT, Status.STALE, Status.FOLLOWING_ERROR, Status.STOPPED, Status.STALLED)
        return "stopped" if self in stands else "slowed"


@final
class Command(NamedTuple):
    r"""Command of a controller at one instant.

    Attributes:
        velocity: Commanded joint velocity :math:`u`, shape (nv,) [rad/s or m/s], finite and within the limits. It is
            the sum of `task_part`, `null_part` and `escape_part`.
        status: The most serious change to the law, see `Status`.
        manipulability: Manipulability :math:`\mu(q)` of the constraint.
        task_velocity: Requested velocity :math:`b` of the constrained rows before limits, shape (s,), in their units
            per second.
        task_part: Part :math:`A^+ b` of the velocity as commanded, shape (nv,) [rad/s or m/s].
        null_part: Part :math:`N \pi` as commanded, shape (nv,) [rad/s or m/s], including the null-space motion that
            makes room for the task at limits. It moves no row: `A @ null_part` is 0.
        task_scale: Factor on the task part; 1 is the requested velocity.
        null_scale: Share of the null-space part that is commanded, 0 to 1.
        smallest_singular_value: Smallest singular value of A(q), in the constraint's units (m or 1).
        escape_part: Velocity out of a singularity, shape (nv,) [rad/s or m/s]; None away from singularities.
        progress: Fraction of the requested velocity along :math:`b` that is achieved,
            :math:`b^T (A u + c) / |b|^2`, where :math:`A u + c` is the rows' mean velocity during the step; 1 if
            :math:`b = 0`.
        outside: Largest distance of a joint beyond its position limits [rad or m].
        limiting_joint: Index of the joint whose limit changes the command most, -1 if none does.
        following_error: Largest distance between commanded and measured joint positions [rad or m] (`ServoLoop`).
    """

    velocity: Vector
    status: Status
    manipulability: float
    task_velocity: Float[np.ndarray, " s"]
    task_part: Vector
    null_part: Vector
    task_scale: float
    null_scale: float
    smallest_singular_value: float
    escape_part: Vector | None = None
    progress: float = 1.0
    outside: float = 0.0
    limiting_joint: int = -1
    following_error: float = 0.0

    @classmethod
    def of_joints(cls, velocity: Vector, status: Status, **more: Any) -> Command:
        """Return a command for a given joint velocity, e.g. of a controller of your own: all of it is the task part.

        Args:
            velocity: Joint velocity (nv,) [rad/s or m/s].
            status: Status of the command.
            **more: Further attributes of the command; by default manipulability 0, task scale 1, null-space scale 0,
                and the defaults of `Command`.
        """
        none = np.zeros_like(velocity)
        values: dict[str, Any] = {"manipulability": 0.0, "task_scale": 1.0, "null_scale": 0.0}
        values |= {"task_velocity": none[:0], "smallest_singular_value": 0.0} | more
        return cls(velocity=velocity, status=status, task_part=velocity, null_part=none, **values)


# kinds of limits, the causes of bounds
POSITION, VELOCITY, ACCELERATION = range(3)


def slowed_by(cause: int) -> Status:
    """Return the status of a task that a limit or a singularity slows down.

    Args:
        cause: Limit that slows it down: POSITION, VELOCITY or ACCELERATION; -1 for a singularity.
    """
    return (Status.POSITION_LIMITED, Status.VELOCITY_LIMITED, Status.ACCELERATION_LIMITED, Status.DAMPED)[cause]


class Controller(Protocol):
    """Interface of controllers that `simulate` can run: a `ResolvedRateController`, or a callable of your own."""

    def __call__(self, q: Posture, t: float = 0.0, dt: float | None = None) -> Command:
        """Return the command for a step.

        Args:
            q: Posture: a configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time at which the step begins [s].
            dt: Length of the step, for which the velocity is applied [s]; `simulate` and `ServoLoop` always pass it.
                None for the controller's own period.

        Returns:
            The command; `Command.of_joints` makes one from a joint velocity.
        """
        ...


class LimitedController(ABC):
    """A controller that a `ServoLoop` can run: within limits, continuing from the velocity of the previous step.

    Attributes:
        robot: The robot.
        limits: Limits that its commands keep; None for none.
        laws: The `ResolvedRateController`s that it runs one after another; empty for a joint motion.
        law: The `ResolvedRateController` that computes the present command; None for a joint motion.
        constraint: Constraint with its held rows and the rows that the task drives; None for a joint motion.
        waits: True if the time of the motion stops while the arm stands still.
        notes: Remarks on its motion, in sentences.
    """

    robot: Any
    limits: Any
    laws: tuple[Any, ...] = ()
    law: Any = None
    constraint: Any = None
    notes: tuple[str, ...] = ()

    @abstractmethod
    def __call__(
        self, q: Any, t: float = 0.0, dt: float | None = None, previous: Any = None, slide: float = 0.0
    ) -> Command:
        """Return the command for a step of dt [s] from posture q at time t [s].

        `previous` is the velocity of the previous step (nv,) [rad/s or m/s], None for no acceleration limit; `slide`
        the share of the task's direction that is given up at limits, 0 to 1.
        """

    @abstractmethod
    def with_limits(self, limits: Any, lag: float = 0.0) -> LimitedController:
        """Return this controller with other limits.

        Args:
            limits: `Limits` of the same robot.
            lag: Time by which the output of the loop lags behind the controller [s], for a controller that can
                compensate for it.
        """

    @property
    def waits(self) -> bool:
        """True if the time of the motion stops while the arm stands still."""
        return self.law is not None and self.law.task.waits

    @property
    def start(self) -> Vector | None:
        """Joint positions (nv,) at which its motion begins [rad or m]; None if it can begin at any posture."""
        return self.laws[0].task.start if self.laws else None

    @property
    def frame(self) -> str | None:
        """Name of the frame that the constraint's rows refer to; None if they do not refer to a frame."""
        frame = None if self.constraint is None else getattr(self.constraint.features, "frame", None)
        return None if frame is None else frame.name

    @property
    def taught_force(self) -> float | None:
        """Largest force along its motions in the demonstrations [N]; None unless known for each of its motions."""
        forces = [law.learnt.shown.force for law in self.laws if law.learnt.shown is not None]
        return max(forces) if forces and None not in forces else None

    def driven_motions(self, q: Posture) -> Float[np.ndarray, "k nv"]:
        """Return the motions of the joints along which the task drives the arm.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Returns:
            shape (k, nv), one joint displacement [rad or m] per driven row: displacement i moves driven row i by 1.
            k = 0 without a law.
        """
        law = self.law
        if law is None:
            return np.zeros((0, self.robot.nv))
        return law.task.driven_rows(law.constraint).dot(np.linalg.pinv(law.constraint(q)).T)

    def reset(self) -> None:
        """Forget previous calls: the next call starts the motion from its beginning."""
        for law in self.laws:
            law.task.reset()
