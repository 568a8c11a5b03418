"""The policy that climbs the manipulability of a task."""

from __future__ import annotations

import math
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import Vjp
from manip_learn.constraint.small_matrices import row_inverse, svd
from manip_learn.control.policies.policy import SampledPolicy
from manip_learn.control.singularity import (
    Ascent,
    Decomposition,
    ascent_near_singularity,
    ascent_velocity,
    climbing_direction,
)
from manip_learn.errors import ConstraintError

# [rad^2/s] default gain: the highest manipulability of the gains that were compared (docs/control.md)
ASCENT_GAIN = 3.0


@final
class ManipulabilityAscent(SampledPolicy):
    """pi = gain * grad log mu, at most `max_speed`; or gain * grad mu as in equation (13) of Manavalan and Howard.

        d mu / d q_k = mu tr((A A^T)^-1 A (dA / dq_k)^T) = mu A^{+T} : dA / dq_k,    grad log mu = grad mu / mu

    grad log mu points the same way and does not depend on the units of the constraint, nor on how small mu has become:
    raw grad mu all but vanishes in SI units where it matters most. It grows as 1 / sigma towards a singularity, where
    an explicit step would jump from one side to the other; its length is therefore bounded by

        max_speed sigma / sqrt(sigma^2 + r^2),    r = dt max_speed |grad log mu| sigma / STABLE_SLOPE,

    sigma the smallest singular value of A: continuous, with a slope that a step of dt can follow. It vanishes towards
    the singularity; at it, `SEED_SPEED` along the steepest ascent of mu is left, and the controller adds the motion
    that leaves it (see `singularity`).

    Args:
        constraint: Whose manipulability is climbed; true or learnt.
        gain: Rate; for grad log mu [rad^2/s].
        logarithmic: False for the paper's raw gradient, which is not bounded.
        max_speed: Largest norm of pi [rad/s]; None for no bound. At a singularity the unbounded gradient has the
            direction of steepest ascent, also where several directions are lost at once.

    Raises:
        ConstraintError: `max_speed` is not positive.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
        >>> climb = ml.ResolvedRateController(constraint, null_policy=ml.ManipulabilityAscent(constraint))
        >>> rollout = ml.simulate(robot, climb, [0.3, 0.8, 0.4], duration=3.0)  # the tip keeps its y
        >>> rollout.manipulability[[0, -1]].round(1)
        array([1.6, 2.6])
    """

    def __init__(
        self,
        constraint: Constraint,
        gain: float = ASCENT_GAIN,
        *,
        logarithmic: bool = True,
        max_speed: float | None = 10.0,
    ):
        if max_speed is not None and not max_speed > 0.0:
            raise ConstraintError(f"max_speed must be positive [rad/s], or None for no bound, got {max_speed!r}")
        self.constraint = constraint
        self.gain = float(gain)
        self.logarithmic = bool(logarithmic)
        self.max_speed = None if max_speed is None or not logarithmic else float(max_speed)
        self.ascent = Ascent(self.gain, self.logarithmic, math.inf if self.max_speed is None else self.max_speed)

    def __call__(self, q: ArrayLike, t: float = 0.0, dt: float = 0.01) -> Float[np.ndarray, " nv"]:
        """Ascent velocity, finite everywhere.

        Args:
            q: Posture: a configuration or joint positions.
            t: Time [s]; the policy does not depend on it.
            dt: Time for which the velocity is held [s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.velocity(*self.constraint.value_and_vjp(q), dt)

    def velocity(self, A: Float[np.ndarray, "s nv"], vjp: Vjp, dt: float) -> Float[np.ndarray, " nv"]:
        """The same for a matrix and its vector-Jacobian product."""
        X, mu, _ = row_inverse(A)
        if mu > 0.0:  # away from singularities d log mu = A^{+T} : dA
            return ascent_velocity(self.ascent, vjp(X), mu, dt)
        if A.shape[0] > A.shape[1]:
            return np.zeros(A.shape[1])
        decomposition = Decomposition(*svd(A))
        climb = climbing_direction(decomposition, vjp)
        return ascent_near_singularity(self.ascent, decomposition, climb, vjp, dt)

    def __repr__(self) -> str:
        return f"ManipulabilityAscent(gain={self.gain:g}, logarithmic={self.logarithmic})"
