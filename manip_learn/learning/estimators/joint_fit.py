"""What the joint estimator found: Lambda and the null-space policy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.learning.estimators.policy_model import PolicyModel


@final
@dataclass(frozen=True, eq=False)
class JointFit:
    """Result of the joint estimator.

    Attributes:
        whitened_selection: Lambda in whitened coordinates, orthonormal rows, shape (s, p').
        theta: Parameters of the policy model, shape (k, nv).
        cost: Mean of |Z^T (u - pi)|^2.
        energy: Mean of |Z^T u|^2.
        iterations: Gauss-Newton steps.
        model: The policy model.
    """

    whitened_selection: Float[np.ndarray, "s r"]
    theta: Float[np.ndarray, "k nv"]
    cost: float
    energy: float
    iterations: int
    model: PolicyModel
