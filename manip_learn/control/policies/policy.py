"""Null-space policies: the motion that the redundant degrees of freedom should make."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.errors import ConfigurationError


class NullSpacePolicy(ABC):
    """pi(q, t) of equation (2), u = A^+ b + N pi: a desired joint velocity.

    The controller projects it; a policy does not know the projector.
    """

    @abstractmethod
    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """Desired joint velocity [rad/s or m/s] at posture q and time t [s]."""


class SampledPolicy(NullSpacePolicy):
    """A policy that takes into account for how long its velocity is held, so that explicit steps can follow it."""

    @abstractmethod
    def __call__(self, q: ArrayLike, t: float = 0.0, dt: float = 0.01) -> Float[np.ndarray, " nv"]:
        """Desired joint velocity [rad/s or m/s] at posture q and time t [s], held for dt [s]."""


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


def positive(name: str, value: float) -> float:
    """A setting that must be a positive number.

    Raises:
        ConfigurationError: It is not.
    """
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigurationError(f"{name} must be a positive number, got {value!r}")
    return float(value)
