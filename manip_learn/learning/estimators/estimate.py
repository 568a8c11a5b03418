"""What an estimator hands to the learner."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.learning.estimators.rank import GapTable
from manip_learn.learning.estimators.variable_projection import JointFit


@final
@dataclass(frozen=True, eq=False)
class Estimate:
    """A learnt row space with its evidence, in whitened coordinates.

    Attributes:
        name: Of the estimator.
        selection: Lambda, shape (s, p').
        table: Evidence for the number of rows.
        unexplained: Share of the energy that is not explained on the data it was fitted to.
        held_out: The same on trajectories that were left out.
        gradients, hessians: Of each trajectory at the optimum, for the bootstrap.
        policy_model: Name of the policy model, if there is one.
        policy_residuals: Policy model -> held-out share of unexplained energy.
        noise: Held-out residual energy a degree of freedom [(rad/s)^2]; 0 where there is no such thing.
        warnings: Doubts.
        joint: Joint estimator: the fit with the policy's parameters, from where more samples can improve on it.
    """

    name: str
    selection: Float[np.ndarray, "s r"]
    table: GapTable
    unexplained: float
    held_out: float
    gradients: Float[np.ndarray, "g m"]
    hessians: Float[np.ndarray, "g m m"]
    policy_model: str | None = None
    policy_residuals: dict[str, float] = field(default_factory=dict)
    noise: float = 0.0
    warnings: tuple[str, ...] = ()
    joint: JointFit | None = None
