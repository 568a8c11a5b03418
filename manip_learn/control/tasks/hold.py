"""The task of moving nothing along the constrained rows."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.tasks.task import Task


@final
class Hold(Task):
    """b = 0: the constrained rows stand still, all motion is in the null space."""

    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, " s"]:
        """Zeros, shape (s,)."""
        return np.zeros(constraint.n_constraints)

    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Always 0: there is nowhere to go."""
        return 0.0

    def __repr__(self) -> str:
        return "Hold()"
