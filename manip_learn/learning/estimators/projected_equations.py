"""Variable projection by normal equations: the steps of `fit_joint`, at a tenth of the cost of a QR of all rows.

Normal equations square the condition number. They are used where what is left of the motion is noise, far above their
rounding, and where their Cholesky factor shows that they are well conditioned; a QR of the rows answers otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.learning.estimators.descent import descend
from manip_learn.learning.estimators.joint_fit import JointFit
from manip_learn.learning.estimators.policy_equations import (
    OrthonormalRegressors,
    Projections,
    Solver,
    curvature,
    packed,
    packed_curvature,
    solve_policy,
)
from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.samples import Samples
from manip_learn.linalg import orthonormal_rows

# share of the energy below which what is left is no noise
NEARLY_EXACT = 1e-6
# square of the least pivot, the diagonal scaled to 1, below which the equations are ill-conditioned
LEAST_PIVOT = 1e-8


@final
@dataclass(frozen=True, eq=False)
class _State:
    """The best policy for a Lambda."""

    samples: Samples
    regressors: OrthonormalRegressors
    Lambda: Float[np.ndarray, "s r"]
    projections: Projections
    solver: Solver
    theta: Float[np.ndarray, "j nv"]
    y: Float[np.ndarray, "n nv"]
    cost: float

    @staticmethod
    def at(samples: Samples, regressors: OrthonormalRegressors, Lambda: Float[np.ndarray, "s r"]) -> _State:
        projections = Projections.of(samples, Lambda)
        solver = Solver(curvature(regressors.values, projections.N))
        theta, y = solve_policy(regressors.values, projections, samples.u, solver)
        cost = projections.energy(y) / len(samples)
        return _State(samples, regressors, Lambda, projections, solver, theta, y, cost)

    @property
    def energy(self) -> float:
        """Mean of |Z^T u|^2."""
        return self.projections.energy(self.samples.u) / len(self.samples)

    @property
    def is_nearly_exact(self) -> bool:
        """Whether what is left is no noise."""
        return self.cost <= NEARLY_EXACT * self.energy

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """See `descend`."""
        return self.projections.equations(self.regressors.values, self.y, self.solver)


def fit_projected(
    samples: Samples,
    start: Float[np.ndarray, "s r"],
    model: PolicyModel,
    max_iterations: int,
    tolerance: float,
    gain: float,
    least_pivot: float = LEAST_PIVOT,
) -> JointFit | None:
    """`fit_joint` by normal equations, see there; None where these are ill-conditioned by a positive least pivot."""
    regressors = OrthonormalRegressors.of(samples, model)
    if least_pivot > 0.0 and regressors.values.shape[1] < model.n_terms:
        return None
    here, iterations = descend(
        _State.at(samples, regressors, orthonormal_rows(start)),
        lambda Lambda: _State.at(samples, regressors, Lambda),
        *(max_iterations, tolerance, gain),
        usable=lambda state: state.solver.least_pivot >= least_pivot,
        enough=lambda state: least_pivot > 0.0 and state.is_nearly_exact,
    )
    if here.solver.least_pivot < least_pivot:
        return None
    return JointFit(here.Lambda, regressors.mixing @ here.theta, here.cost, here.energy, iterations, model)


def held_out_by_fold(
    samples: Samples, Lambda: Float[np.ndarray, "s r"], model: PolicyModel, folds: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " f"] | None:
    """Sum of |Z^T (u - pi)|^2 over each fold, pi fitted to the others.

    Args:
        samples: What was recorded.
        Lambda: In whitened coordinates.
        model: beta(q).
        folds: Fold of each sample.

    Returns:
        One sum for each fold that has samples, in their order; None where the equations are ill-conditioned, or what
        is left is no noise.
    """
    present = np.unique(folds)
    beta, projections = OrthonormalRegressors.of(samples, model).values, Projections.of(samples, Lambda)
    if beta.shape[1] < model.n_terms:
        return None
    parts, entries = [folds == fold for fold in present], packed(projections.N)
    own = [packed_curvature(beta[held], entries[held]) for held in parts]
    total, costs = np.sum(own, axis=0), np.zeros(len(present))
    for i, held in enumerate(parts):
        solver = Solver(total - own[i])
        if solver.least_pivot < LEAST_PIVOT:
            return None
        _, y = solve_policy(beta, projections, samples.u, solver, held)
        costs[i] = float(np.sum(projections.project(y)[held] ** 2))
    return costs if costs.sum() > NEARLY_EXACT * projections.energy(samples.u) else None
