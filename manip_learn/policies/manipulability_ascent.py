"""The policy that climbs the manipulability of a task."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint import Constraint
from manip_learn.manipulability_measure import gradient_of
from manip_learn.policies.policy import NullSpacePolicy


@final
class ManipulabilityAscent(NullSpacePolicy):
    """pi = gain * grad log mu, or gain * grad mu as printed in the paper (equation 13).

    grad log mu points the same way and does not depend on the units of the constraint, nor on how small mu has become:
    raw grad mu all but vanishes in SI units where it matters most.

    Args:
        constraint: Whose manipulability is climbed; true or learnt.
        gain: Rate; for grad log mu [rad^2/s], so that 1.0 gives about 1 rad/s.
        logarithmic: False for the paper's raw gradient.
    """

    def __init__(self, constraint: Constraint, gain: float = 1.0, *, logarithmic: bool = True):
        self.constraint = constraint
        self.gain = float(gain)
        self.logarithmic = bool(logarithmic)

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """Ascent velocity, finite everywhere.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.from_constraint_matrix(*self.constraint.value_and_derivative(q))

    def from_constraint_matrix(
        self, A: Float[np.ndarray, "s nv"], dA: Float[np.ndarray, "s nv nv"]
    ) -> Float[np.ndarray, " nv"]:
        """The same from A(q) and dA/dq, where the controller has them already."""
        mu, gradient, floor = gradient_of(A, dA)
        if self.logarithmic:
            return gradient * (self.gain / max(mu, floor, 1e-300))
        return gradient * self.gain

    def __repr__(self) -> str:
        return f"ManipulabilityAscent(gain={self.gain:g}, logarithmic={self.logarithmic})"
