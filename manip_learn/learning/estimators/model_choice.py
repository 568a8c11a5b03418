"""Which policy model: the one that predicts left-out trajectories best, and a richer one where that is no worse.

A model that is too small bends Lambda, silently; one degree too many costs a few percent. So of the models whose
held-out cost does not exceed the least beyond chance, in pairs over the trajectories, the richest is taken.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.learning.estimators.policy_equations import (
    OrthonormalRegressors,
    Projections,
    Solver,
    packed,
    packed_curvature,
    solve_policy,
)
from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.samples import Samples

# standard errors of a difference of held-out costs, over trajectories, that count as worse
WORSE = 2.0
# held-out cost over the least beyond which a model is worse, however much the trajectories scatter
MOST_WORSE = 1.1
# how many times the regressors of the best a richer model may have
ONE_DEGREE = 3.0
# residuals for each of its parameters that make a richer model cheap
CHEAP = 25.0


@final
@dataclass(frozen=True, eq=False)
class JudgedModel:
    """A policy model at a given Lambda.

    Attributes:
        model: beta(q).
        costs: sum |N (u - pi)|^2 of each trajectory, pi fitted to the others, shape (g,).
        variance: Residual variance per degree of freedom, pi fitted to all [(rad/s)^2].
    """

    model: PolicyModel
    costs: Float[np.ndarray, " g"]
    variance: float

    @property
    def held_out(self) -> float:
        """Cost of all trajectories, each left out in its turn."""
        return float(self.costs.sum())


def judge_models(
    samples: Samples, whitened_selection: Float[np.ndarray, "s r"], models: Sequence[PolicyModel], n_folds: int
) -> list[JudgedModel]:
    """All models at one Lambda, by normal equations."""
    projections = Projections.of(samples, whitened_selection)
    entries = packed(projections.N)
    return [_judged(samples, projections, entries, model, n_folds) for model in models]


def choose_model(judged: Sequence[JudgedModel], most_parameters: float) -> JudgedModel:
    """The richest of the cheap models that predict no worse than the best.

    Args:
        judged: All models at one Lambda.
        most_parameters: Regressors that the residuals are many enough for, see `CHEAP`.
    """
    best = min(judged, key=lambda one: one.held_out)
    most = largest_size(best.model, most_parameters)
    near = [one for one in judged if one.model.n_terms <= most and not _is_worse(one.costs, best.costs)]
    return max(near, key=lambda one: one.model.n_terms)


def largest_size(model: PolicyModel, most_parameters: float) -> float:
    """Regressors that a model richer than a given one may have."""
    return max(min(ONE_DEGREE * model.n_terms, most_parameters), model.n_terms)


def _is_worse(costs: np.ndarray, best: np.ndarray) -> bool:
    difference = costs - best
    if costs.sum() > MOST_WORSE * best.sum():
        return True
    return bool(difference.mean() > WORSE * difference.std(ddof=1) / np.sqrt(len(difference)))


def _judged(
    samples: Samples, projections: Projections, entries: np.ndarray, model: PolicyModel, n_folds: int
) -> JudgedModel:
    beta, u = OrthonormalRegressors.of(samples, model).values, samples.u
    held_out = list(_folds(samples.trajectory, n_folds))
    parts = [packed_curvature(beta[held], entries[held]) for held in held_out]
    total = np.sum(parts, axis=0)
    costs = np.zeros(samples.n_trajectories)
    for held, own in zip(held_out, parts, strict=True):
        _, y = solve_policy(beta, projections, u, Solver(total - own), held)
        square = np.sum(y * projections.project(y), axis=1)
        costs += np.bincount(samples.trajectory[held], square[held], len(costs))
    _, y = solve_policy(beta, projections, u, Solver(total))
    freedom = max(float(np.einsum("nii->", projections.N)) - total.shape[0], 1.0)
    # y^T N y of a motion without any policy is rounding of either sign, and a negative sum is worse than itself
    return JudgedModel(model, np.maximum(costs, 0.0), projections.energy(y) / freedom)


def _folds(trajectory: Int[np.ndarray, " n"], n_folds: int) -> Iterator[np.ndarray]:
    """Masks of the samples that each fold leaves out: trajectories, dealt out in turn."""
    for fold in range(n_folds):
        held = trajectory % n_folds == fold
        if held.any() and not held.all():
            yield held
