"""Null-space policies: the motion that the redundant degrees of freedom should make."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike


class NullSpacePolicy(ABC):
    """pi(q, t) of equation (2), u = A^+ b + N pi: a desired joint velocity.

    The controller projects it; a policy does not know the projector.
    """

    @abstractmethod
    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """Desired joint velocity [rad/s or m/s] at posture q and time t [s]."""


@final
class ZeroPolicy(NullSpacePolicy):
    """pi = 0: the plain pseudo-inverse, equation (2) with its second term left out.

    Args:
        nv: Number of velocities.
    """

    def __init__(self, nv: int):
        self._zero = np.zeros(nv)
        self._zero.setflags(write=False)

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """Zeros, shape (nv,)."""
        return self._zero

    def __repr__(self) -> str:
        return "ZeroPolicy()"
