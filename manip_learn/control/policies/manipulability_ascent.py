"""The policy that climbs the manipulability of a task."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import Vjp
from manip_learn.constraint.manipulability import SINGULAR_RATIO, escape_direction, gradient_from
from manip_learn.control.policies.policy import NullSpacePolicy
from manip_learn.linalg import row_inverse, svd


@final
class ManipulabilityAscent(NullSpacePolicy):
    """pi = gain * grad log mu, or gain * grad mu as in equation (13) of Manavalan and Howard.

        d mu / d q_k = mu tr((A A^T)^-1 A (dA / dq_k)^T) = mu A^{+T} : dA / dq_k,    grad log mu = grad mu / mu

    grad log mu points the same way and does not depend on the units of the constraint, nor on how small mu has become:
    raw grad mu all but vanishes in SI units where it matters most. At a singularity the direction of steepest ascent is
    taken, also where several directions are lost at once and grad mu is zero (not with `logarithmic=False`).

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
        A, vjp = self.constraint.value_and_vjp(q)
        inverse = row_inverse(A)
        if inverse is not None:
            return self.from_inverse(inverse[0], inverse[1], vjp)
        return self.from_decomposition(A.shape, svd(A), vjp)

    def from_inverse(self, X: Float[np.ndarray, "s nv"], mu: float, vjp: Vjp) -> Float[np.ndarray, " nv"]:
        """The same away from singularities, where d log mu = A^{+T} : dA, from X = A^{+T} that the controller has."""
        return vjp(X) * (self.gain if self.logarithmic else self.gain * mu)

    def from_decomposition(
        self, shape: tuple[int, ...], decomposition: tuple[np.ndarray, np.ndarray, np.ndarray], vjp: Vjp
    ) -> Float[np.ndarray, " nv"]:
        """The same near a singularity too, see `gradient_from`."""
        mu, gradient, floor = gradient_from(shape, decomposition, vjp)
        if not self.logarithmic:
            return gradient * self.gain
        sigma = decomposition[1]
        if 1 < shape[0] <= shape[1] and sigma[-2] <= SINGULAR_RATIO * sigma[0]:
            return escape_direction(decomposition, vjp) * (self.gain / SINGULAR_RATIO)
        return gradient * (self.gain / max(mu, floor, 1e-300))

    def __repr__(self) -> str:
        return f"ManipulabilityAscent(gain={self.gain:g}, logarithmic={self.logarithmic})"
