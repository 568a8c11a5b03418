"""The search for the policy model of the joint estimator, by cross-validation over trajectories."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np

from manip_learn.learning.estimators.conditional_pca import conditional_pca
from manip_learn.learning.estimators.joint_fit import JointFit
from manip_learn.learning.estimators.model_choice import (
    CHEAP,
    MOST_WORSE,
    JudgedModel,
    choose_model,
    judge_models,
    largest_size,
)
from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.estimators.variable_projection import fit_joint, held_out_cost
from manip_learn.learning.samples import Samples

N_FOLDS = 5
# share of left-out motion that no model explains from which a weak gap may be the policy's
POOR = 0.03
# a richer model must lower the held-out cost by this factor to be worth its parameters
WORTH = 0.8
ROUNDING = 1e-24
# share of the energy below which normal equations are not exact enough to compare models
EXACT = 1e-10
VANISHING = 1e-16
# models of at most this many columns are tried one by one where next to nothing is left
SCAN_COLUMNS = 120
# changes of the model
ROUNDS = 4
# held-out share of the energy below which extrapolation no longer decides between models
PREDICTED = 1e-3
# residual variance over that of a smaller model that is not chance with `CLOSER_CHEAP` residuals per parameter
CLOSER = 0.9
CLOSER_CHEAP = 10.0
# models that are fitted although they predicted worse
MOST_TRIALS = 3
# enough steps to compare
COMPARE: dict[str, Any] = {"max_iterations": 8, "gain": 1e-4}


@final
@dataclass(frozen=True, eq=False)
class CrossValidatedFit:
    """A fit with its cross-validated cost."""

    fit: JointFit
    held_out: float  # mean |Z^T (u - pi)|^2 on left-out trajectories


def cross_validate(samples: Samples, model: PolicyModel, start: np.ndarray) -> CrossValidatedFit:
    """A fit in a few steps from a start, and its cost on trajectories that the policy was not fitted to."""
    return cross_validated(samples, fit_joint(samples, start, model, **COMPARE))


def cross_validated(samples: Samples, fit: JointFit) -> CrossValidatedFit:
    """A fit with its cost on trajectories that the policy was not fitted to."""
    folds = min(N_FOLDS, samples.n_trajectories)
    return CrossValidatedFit(fit, held_out_cost(samples, fit.whitened_selection, fit.model, folds))


def is_better(samples: Samples, trial: CrossValidatedFit, best: CrossValidatedFit, factor: float) -> bool:
    """Whether a fit costs less by a factor on left-out trajectories, and leaves less of the motion that there is.

    A Lambda that takes up all motion leaves little, explained or not.
    """
    shares = [one.held_out / null_energy(samples, one.fit) for one in (trial, best)]
    return trial.held_out < factor * best.held_out and shares[0] < max(factor, 1.0) * shares[1]


def has_enough(samples: Samples, s: int, model: PolicyModel) -> bool:
    """Whether there are two residuals for each parameter of a model, one fold left out."""
    return len(samples) * (samples.nv - s) * (1.0 - 1.0 / N_FOLDS) >= 2.0 * model.n_terms * samples.nv


def null_energy(samples: Samples, fit: JointFit) -> float:
    """Energy that there is to explain; without any null-space motion, rounding is not held against the model."""
    return max(fit.energy, VANISHING * samples.energy)


def search_model(
    samples: Samples, s: int, models: list[PolicyModel], first: CrossValidatedFit
) -> tuple[CrossValidatedFit, dict[str, float]]:
    """The model that predicts best or one degree more; held-out share of every model that was tried.

    All models are judged at the Lambda of the best so far, and again at that of the one chosen.
    """
    best, residuals = first, {first.fit.model.name: first.held_out / null_energy(samples, first.fit)}
    usable = [model for model in models if has_enough(samples, s, model)]
    folds = min(N_FOLDS, samples.n_trajectories)
    if s == 0 or len(usable) < 2:
        return best, residuals
    if best.held_out > POOR * null_energy(samples, best.fit):
        best = _fit_from_other_starts(samples, s, usable, best)
    residuals_per_joint = len(samples) * (samples.nv - s) / samples.nv
    judged: list[JudgedModel] = []
    for _ in range(ROUNDS):
        if best.held_out <= EXACT * best.fit.energy:
            return _climb_exact_models(samples, models, usable, best, residuals)
        judged = judge_models(samples, best.fit.whitened_selection, usable, folds)
        energy = len(samples) * null_energy(samples, best.fit)
        residuals |= {one.model.name: one.held_out / energy for one in judged}
        predicts_best = min(judged, key=lambda one: one.held_out)
        settled = predicts_best.model.name == best.fit.model.name
        # a model that is too rich bends Lambda while that is far off: first the model that predicts best
        chosen = choose_model(judged, residuals_per_joint / CHEAP) if settled else predicts_best
        if chosen.model.name != best.fit.model.name:
            trial = cross_validate(samples, chosen.model, best.fit.whitened_selection)
            if not is_better(samples, trial, best, MOST_WORSE if settled else 1.0):
                break
            best = trial
        if settled:
            break
    return _try_closer_models(samples, judged, best, residuals_per_joint / CLOSER_CHEAP), residuals


def _try_closer_models(
    samples: Samples, judged: list[JudgedModel], best: CrossValidatedFit, most_parameters: float
) -> CrossValidatedFit:
    """A model that leaves a smaller variance, if it predicts better, or nearly everything, at its own Lambda.

    At the Lambda of a model that is too small, a richer one may extrapolate so badly to single trajectories that
    cross-validation rejects it; the variance of its residual shows nevertheless that it describes the motion.
    """
    if best.held_out > POOR * null_energy(samples, best.fit):
        return best
    own = next(one for one in judged if one.model.name == best.fit.model.name)
    most = largest_size(best.fit.model, most_parameters)
    closer = [one for one in judged if one.variance < CLOSER * own.variance and one.model.n_terms <= most]
    for one in sorted(closer, key=lambda one: one.variance)[:MOST_TRIALS]:
        trial = cross_validate(samples, one.model, best.fit.whitened_selection)
        if is_better(samples, trial, best, WORTH) or trial.held_out < PREDICTED * null_energy(samples, trial.fit):
            return trial
    return best


def _climb_exact_models(
    samples: Samples,
    models: list[PolicyModel],
    usable: list[PolicyModel],
    best: CrossValidatedFit,
    residuals: dict[str, float],
) -> tuple[CrossValidatedFit, dict[str, float]]:
    """The same where next to nothing is left, and normal equations would compare rounding: fits by QR, one by one."""
    for model in models:
        if model.name == best.fit.model.name or best.held_out <= ROUNDING * best.fit.energy:
            continue
        if model not in usable or model.n_terms * samples.nv > SCAN_COLUMNS:
            continue
        candidate = cross_validate(samples, model, best.fit.whitened_selection)
        residuals[model.name] = candidate.held_out / null_energy(samples, candidate.fit)
        if is_better(samples, candidate, best, WORTH):
            best = candidate
    return best, residuals


def _fit_from_other_starts(
    samples: Samples, s: int, models: list[PolicyModel], best: CrossValidatedFit
) -> CrossValidatedFit:
    """The best of the fits with each model from its own closed-form start, for a poor model has led Lambda astray."""
    for model in models:
        if model.n_terms * samples.nv > len(samples):
            continue
        trial = cross_validate(samples, model, conditional_pca(samples, model)[1][:s])
        if is_better(samples, trial, best, 1.0):
            best = trial
    return best
