"""What a controller is: a function from posture and time to a command."""

from __future__ import annotations

from typing import NamedTuple, Protocol, final, runtime_checkable

import numpy as np
from jaxtyping import Float

from manip_learn.control.status import Status


@final
class Command(NamedTuple):
    """What a controller commands at one instant.

    Attributes:
        velocity: u, shape (nv,) [rad/s or m/s], finite and within the limits.
        status: The most serious thing that was done to the law, see `Status`.
        manipulability: mu(q).
        task_velocity: b, shape (s,), before limits.
        task_part: A^+ b as commanded, shape (nv,).
        null_part: N pi as commanded, shape (nv,), with the null-space motion that makes room for the task at limits;
            A null_part = 0.
        task_scale: Factor on the task part; 1 is the velocity asked for.
        null_scale: Share of the null-space part that is commanded, 0 to 1.
        smallest_singular_value: Of A(q).
        escape_part: Velocity out of a singularity, shape (nv,); None away from singularities. `velocity` is the sum of
            the three parts.
        progress: Velocity along b over the velocity asked for, b^T A u / |b|^2; 1 where b = 0.
        outside: Largest distance of a joint beyond its position limits [rad or m].
        limiting_joint: Number of the joint whose limit changes the command most, -1 if none does.
        following_error: Largest distance between commanded and measured joint positions [rad or m] (`ServoLoop`).
    """

    velocity: Float[np.ndarray, " nv"]
    status: Status
    manipulability: float
    task_velocity: Float[np.ndarray, " s"]
    task_part: Float[np.ndarray, " nv"]
    null_part: Float[np.ndarray, " nv"]
    task_scale: float
    null_scale: float
    smallest_singular_value: float
    escape_part: Float[np.ndarray, " nv"] | None = None
    progress: float = 1.0
    outside: float = 0.0
    limiting_joint: int = -1
    following_error: float = 0.0


class Controller(Protocol):
    """Anything that `simulate` can run: `ResolvedRateController`, `CompiledController`, or a class of your own."""

    def __call__(self, q: Float[np.ndarray, " n"], t: float = 0.0, dt: float | None = None) -> Command:
        """The command at posture q and time t [s], held for dt [s]."""
        ...


@runtime_checkable
class TaskController(Controller, Protocol):
    """A controller that knows how far its task is from its goal."""

    def task_error(self, q: Float[np.ndarray, " n"], t: float = 0.0) -> float:
        """Distance to the task's goal along the constrained rows [m or rad]."""
        ...
