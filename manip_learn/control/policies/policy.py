"""Null-space policies: what the arm would like to do with the freedom that the task leaves."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike


class NullSpacePolicy(ABC):
    """pi(q, t): a desired joint velocity. The controller projects it; no policy knows the projector."""

    @abstractmethod
    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """Desired joint velocity [rad/s or m/s] at posture q and time t [s]."""
