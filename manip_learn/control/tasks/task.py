"""Tasks: the velocity b(q) that the constrained rows shall have."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint


class Task(ABC):
    """b(q, t) of equation (1), A(q) u = b."""

    @abstractmethod
    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, " s"]:
        """b in the constraint's rows, in their units a second."""

    @abstractmethod
    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Distance still to go, in the constraint's rows (Euclidean norm)."""
