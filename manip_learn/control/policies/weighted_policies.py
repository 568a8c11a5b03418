"""The weighted sum of several objectives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.policies.manipulability_ascent import ManipulabilityAscent
from manip_learn.control.policies.policy import NullSpacePolicy, SampledPolicy
from manip_learn.errors import ConfigurationError, TargetError


@final
class WeightedPolicies(SampledPolicy):
    """pi = sum_i w_i pi_i: several objectives in one null space, their compromise set by the weights.

    Where one of them is a `ManipulabilityAscent` of the controller's own constraint, singularities are left as they are
    with that policy alone.

    Args:
        policies: pi_i.
        weights: w_i >= 0, one a policy; 1 each by default.

    Raises:
        ConfigurationError: No policies, another number of weights, or a weight that is negative or not finite.
    """

    def __init__(self, policies: Sequence[NullSpacePolicy], weights: Sequence[float] | None = None):
        self.policies = tuple(policies)
        self.weights = (1.0,) * len(self.policies) if weights is None else tuple(float(w) for w in weights)
        if not self.policies or len(self.weights) != len(self.policies):
            raise ConfigurationError(f"{len(self.policies)} policies need as many weights, got {len(self.weights)}")
        if not all(math.isfinite(w) and w >= 0.0 for w in self.weights):
            raise ConfigurationError(f"weights must be numbers of at least 0, got {list(self.weights)}")

    def __call__(self, q: ArrayLike, t: float = 0.0, dt: float = 0.01) -> Float[np.ndarray, " nv"]:
        """Weighted sum of the policies' velocities [rad/s or m/s].

        Args:
            q: Posture: a configuration or joint positions.
            t: Time [s].
            dt: Time for which the velocity is held [s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
            TargetError: The policies belong to different numbers of joints.
        """
        parts = [
            w * (policy(q, t, dt) if isinstance(policy, SampledPolicy) else policy(q, t))
            for w, policy in zip(self.weights, self.policies, strict=True)
        ]
        if len({part.shape for part in parts}) > 1:
            sizes = ", ".join(str(part.size) for part in parts)
            raise TargetError(f"the policies of a weighted sum return {sizes} velocities: they belong to one robot")
        return np.sum(parts, axis=0)

    def climbs(self, constraint: Constraint) -> bool:
        """Whether a bounded `ManipulabilityAscent` of this very constraint has a weight, here or in a sum within."""
        for w, policy in zip(self.weights, self.policies, strict=True):
            if w > 0.0 and isinstance(policy, ManipulabilityAscent):
                if policy.constraint is constraint and policy.max_speed is not None:
                    return True
            elif w > 0.0 and isinstance(policy, WeightedPolicies) and policy.climbs(constraint):
                return True
        return False

    def __repr__(self) -> str:
        terms = " + ".join(f"{w:g} {policy!r}" for w, policy in zip(self.weights, self.policies, strict=True))
        return f"WeightedPolicies({terms})"


def climbing(policy: NullSpacePolicy, before: Constraint, after: Constraint) -> NullSpacePolicy:
    """The same policy, its ascents of one constraint climbing the manipulability of another."""
    if isinstance(policy, ManipulabilityAscent) and policy.constraint is before:
        speed = policy.max_speed
        return ManipulabilityAscent(after, policy.gain, logarithmic=policy.logarithmic, max_speed=speed)
    if isinstance(policy, WeightedPolicies):
        return WeightedPolicies([climbing(part, before, after) for part in policy.policies], policy.weights)
    return policy
