"""Tasks: the velocity b(q) of the constrained rows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint


class Task(ABC):
    """b(q, t) of equation (1), A(q) u = b."""

    # whether an arm that limits keep from going on may leave the task's direction, to come as near as it can
    slides: bool = True
    # whether the task's time stands still while a `ServoLoop` does, and goes on as the commanded posture does
    waits: bool = False
    # whether b is the mean one of the time for which it is held: `velocity_and_jacobian` then gets that as well [s]
    sampled: bool = False

    @abstractmethod
    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, " s"]:
        """b along the constraint's rows, in their units per second."""

    @abstractmethod
    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Distance to the goal along the constraint's rows (Euclidean norm)."""

    def reset(self) -> None:  # noqa: B027  most tasks remember nothing
        """Forget the past, before another motion."""

    def rows(self, constraint: Constraint) -> Constraint:
        """The constraint along whose rows b is given: the controller's own, unless the task drives further rows."""
        return constraint

    def error_jacobian(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, "s nv"] | None:
        """E with d/dt (error along the rows) = -E u for a goal at rest; None where E = A(q), as for positions.

        With E in the place of A in u = E^+ b + N pi the error decays as the task asks, and motion in the null space of
        E leaves it alone. The rate of an orientation error is not the angular velocity; at a target that is a pose
        E = A again (see `FeatureMap.error_jacobian`).
        """
        return None

    def goal(self) -> Float[np.ndarray, "..."] | None:
        """Where the frame is to arrive: numbers for the features' rows (p,) or the constraint's (s,), or a pose (4, 4).

        None where there is no such place, or where it depends on a start that is not known yet.
        """
        return None

    def velocity_and_jacobian(
        self, constraint: Constraint, q: np.ndarray, t: float
    ) -> tuple[Any, Float[np.ndarray, "s nv"] | None]:
        """b (s,) and E together, cheaper than one by one where a child shares work."""
        return self.velocity(constraint, q, t), self.error_jacobian(constraint, q, t)


@final
class Hold(Task):
    """b = 0: nothing moves along the constrained rows, all motion is in the null space."""

    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, " s"]:
        """Zeros, shape (s,)."""
        return np.zeros(constraint.n_constraints)

    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Always 0: there is no goal to reach."""
        return 0.0

    def __repr__(self) -> str:
        return "Hold()"
