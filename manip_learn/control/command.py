"""Commands of a controller, and their status."""

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
    """The most serious change to a command; the members are in that order, most serious first.

    Members are strings: `command.status == "ok"` works, and files hold the words.

    Attributes:
        INVALID_INPUT: The posture or the time is not a number, or the controller failed: the arm brakes to a stop
            (`ServoLoop`).
        STALE: No new state for too long: the arm brakes to a stop (`ServoLoop`).
        FOLLOWING_ERROR: The measured posture is too far from the commanded one: the arm brakes to a stop
            (`ServoLoop`).
        STOPPED: `ServoLoop.stop` was called: the arm brakes to a stop.
        OUTSIDE_LIMITS: A joint is outside its position limits, and returns where it can.
        SINGULAR: A task direction is lost at this posture.
        STALLED: The task has not reached its goal and does not approach it: less than 2 % of the requested velocity
            is left along it, because limits or a singularity block the rest.
        POSITION_LIMITED: The task was slowed down for a position limit.
        VELOCITY_LIMITED: The task was slowed down for a velocity limit.
        ACCELERATION_LIMITED: The task was slowed down for an acceleration limit.
        DAMPED: The task part was damped near a singularity.
        REROUTED: Null-space motion keeps limits from slowing the task down (saturation in the null space).
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
        """Effect on the requested motion: it is done as requested, it is slowed down, or the arm stops."""
        if self in (Status.OK, Status.NULL_SCALED, Status.REROUTED):
            return "ok"
        stands = (Status.INVALID_INPUT, Status.STALE, Status.FOLLOWING_ERROR, Status.STOPPED, Status.STALLED)
        return "stopped" if self in stands else "slowed"


@final
class Command(NamedTuple):
    """Command of a controller at one instant.

    Attributes:
        velocity: u, shape (nv,) [rad/s or m/s], finite and within the limits.
        status: The most serious change to the law, see `Status`.
        manipulability: mu(q).
        task_velocity: b, shape (s,), before limits.
        task_part: A^+ b as commanded, shape (nv,).
        null_part: N pi as commanded, shape (nv,), with the null-space motion that makes room for the task at limits;
            A null_part = 0.
        task_scale: Factor on the task part; 1 is the requested velocity.
        null_scale: Share of the null-space part that is commanded, 0 to 1.
        smallest_singular_value: Of A(q).
        escape_part: Velocity out of a singularity, shape (nv,); None away from singularities. `velocity` is the sum of
            the three parts.
        progress: Fraction of the requested velocity along b that is achieved, b^T (A u + c) / |b|^2, mean of the step;
            1 where b = 0.
        outside: Largest distance of a joint beyond its position limits [rad or m].
        limiting_joint: Number of the joint whose limit changes the command most, -1 if none does.
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
        """Return a command without a law: all of the velocity is its task part.

        Args:
            velocity: Joint velocity (nv,) [rad/s or m/s].
            status: Status of the command.
            **more: Further attributes; by default manipulability 0, task scale 1, null-space scale 0, and the defaults
                of `Command`.
        """
        none = np.zeros_like(velocity)
        values: dict[str, Any] = {"manipulability": 0.0, "task_scale": 1.0, "null_scale": 0.0}
        values |= {"task_velocity": none[:0], "smallest_singular_value": 0.0} | more
        return cls(velocity=velocity, status=status, task_part=velocity, null_part=none, **values)


# kinds of limits, the causes of bounds
POSITION, VELOCITY, ACCELERATION = range(3)


def slowed_by(cause: int) -> Status:
    """Return the status of a task that is slowed down.

    Args:
        cause: Limit that slows it down: POSITION, VELOCITY or ACCELERATION; -1 for a singularity.
    """
    return (Status.POSITION_LIMITED, Status.VELOCITY_LIMITED, Status.ACCELERATION_LIMITED, Status.DAMPED)[cause]


class Controller(Protocol):
    """Anything that `simulate` can run: a `ResolvedRateController`, or a class of your own."""

    def __call__(self, q: Posture, t: float = 0.0, dt: float | None = None) -> Command:
        """Return the command at posture q and time t [s], held for dt [s]."""
        ...


class LimitedController(ABC):
    """A controller that a `ServoLoop` can run: within limits, continuing from the velocity of the previous step.

    Attributes:
        robot: The robot.
        limits: Limits that its commands keep; None for none.
        laws: The `ResolvedRateController`s that it runs one after the other; none for a motion of the joints.
        law: The law in force; None if there is none.
        constraint: Rows that it keeps, with the rows that its task drives; None if there are none.
        waits: True if its clock stands still while the arm does.
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
        """Return the command at posture q and time t [s], for dt [s], after the velocity `previous`."""

    @abstractmethod
    def with_limits(self, limits: Any, lag: float = 0.0) -> LimitedController:
        """Return this controller with other limits.

        Args:
            limits: `Limits` of the same robot.
            lag: Time by which the output of the loop lags behind [s], for a controller that can compensate for it.
        """

    @property
    def waits(self) -> bool:
        """True if its clock stands still while the arm does."""
        return self.law is not None and self.law.task.waits

    @property
    def start(self) -> Vector | None:
        """Joint positions at which its motion begins [rad or m]; None if it begins anywhere."""
        return self.laws[0].task.start if self.laws else None

    @property
    def frame(self) -> str | None:
        """Name of the frame that its rows constrain; None if they constrain no frame."""
        frame = None if self.constraint is None else getattr(self.constraint.features, "frame", None)
        return None if frame is None else frame.name

    @property
    def taught_force(self) -> float | None:
        """Largest force along its motions in the demonstrations [N]; None if the force of one motion is unknown."""
        forces = [law.learnt.shown.force for law in self.laws if law.learnt.shown is not None]
        return max(forces) if forces and None not in forces else None

    def driven_motions(self, q: Posture) -> Float[np.ndarray, "k nv"]:
        """Return the motions of the joints along which the task drives the arm.

        Args:
            q: Posture.

        Returns:
            Joint motions (k, nv), one per driven row: row i moves driven row i by 1; k = 0 without a law.
        """
        law = self.law
        if law is None:
            return np.zeros((0, self.robot.nv))
        return law.task.driven_rows(law.constraint).dot(np.linalg.pinv(law.constraint(q)).T)

    def reset(self) -> None:
        """Forget the past: the next call is the first one again."""
        for law in self.laws:
            law.task.reset()
