"""The policy that climbs the manipulability that falls towards the joint limits."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.penalised_manipulability import limited_robot, penalised_value_and_vjp
from manip_learn.control.policies.manipulability_ascent import ASCENT_GAIN, ManipulabilityAscent
from manip_learn.control.policies.policy import SampledPolicy


@final
class PenalisedManipulabilityAscent(SampledPolicy):
    """pi = gain * grad log mu_w, at most `max_speed`: `ManipulabilityAscent` with A_w = A W in place of A.

        d log mu_w = A_w^{+T} : dA_w,    dA_w_ij / dq_k = w_j dA_ij / dq_k + delta_jk A_ij dw_j / dq_j

    with the weights w_j of `limit_weights`, 1 in the middle of a joint's range and 0 at its limits. It is bounded as
    `ManipulabilityAscent` is.

    Args:
        constraint: Whose manipulability is climbed; true or learnt.
        gain: Rate [rad^2/s].
        max_speed: Largest norm of pi [rad/s]; None for no bound.

    Raises:
        ConstraintError: The constraint's features have no robot, or `max_speed` is not positive.
    """

    def __init__(self, constraint: Constraint, gain: float = ASCENT_GAIN, *, max_speed: float | None = 4.0):
        limited_robot(constraint)
        self.constraint = constraint
        self._ascent = ManipulabilityAscent(constraint, gain, max_speed=max_speed)
        self.gain, self.max_speed = self._ascent.gain, self._ascent.max_speed

    def __call__(self, q: ArrayLike, t: float = 0.0, dt: float = 0.01) -> Float[np.ndarray, " nv"]:
        """Ascent velocity, finite everywhere.

        Args:
            q: Posture: a configuration or joint positions.
            t: Time [s]; the policy does not depend on it.
            dt: Time for which the velocity is held [s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self._ascent.velocity(*penalised_value_and_vjp(self.constraint, q), dt)

    def __repr__(self) -> str:
        return f"PenalisedManipulabilityAscent(gain={self.gain:g})"
