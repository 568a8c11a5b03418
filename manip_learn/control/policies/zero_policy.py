"""The policy that wants nothing."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.control.policies.policy import NullSpacePolicy


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
