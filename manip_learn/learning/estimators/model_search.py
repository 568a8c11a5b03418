"""The search for the policy model of the joint estimator, by cross-validation over trajectories.

A model that is too small bends Lambda, silently; one degree too many costs a few percent. So of the models whose
held-out cost does not exceed the least beyond chance, in pairs over the trajectories, the richest is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh

from manip_learn.learning.deciding import (
    CHEAP,
    CLOSER,
    EQUALLY_GOOD,
    ONE_DEGREE,
    POORLY_EXPLAINED,
    PREDICTED,
    RESIDUALS_PER_PARAMETER,
    STANDARD_ERRORS,
    WORTH,
)
from manip_learn.learning.estimators.estimate import JointFit
from manip_learn.learning.estimators.policy_equations import (
    OrthonormalRegressors,
    Projections,
    Solver,
    left_out,
    solve_policy,
)
from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.estimators.variable_projection import fit_joint, held_out_costs
from manip_learn.learning.samples import Samples

N_FOLDS = 5
# share of the energy that is rounding: of a fit by QR; and below which normal equations cannot compare models
ROUNDING, EXACT = 1e-24, 1e-10
VANISHING = 1e-16
# models of at most this many columns are tried one by one where next to nothing is left
SCAN_COLUMNS = 120
# changes of the model
ROUNDS = 4
# models that are fitted although they predicted worse
MOST_TRIALS = 3
# enough steps to compare
COMPARE: dict[str, Any] = {"max_iterations": 8, "gain": 1e-4}


def conditional_pca(samples: Samples, model: PolicyModel) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r r"]]:
    """A closed-form start: directions of whitened feature space by how much the task moved along them, most first.

    g = (Phi Phi^T)^-1 Phi u = G pi(q) + Lambda^T c, so that what a regression of g on the posture leaves over lies in
    the row space of Lambda. Its covariance C is compared with that of isotropic noise: C x = e (sum G G^T) x, and the
    row space is spanned by (sum G G^T) x of the largest e.

    Returns:
        Square roots of the eigenvalues, and the orthonormalised directions as rows.
    """
    r, k = samples.n_rows, model.n_terms
    left, cross = np.zeros((k, k)), np.zeros((k, r))
    right, S_G = np.zeros((r, r)), np.zeros((r, r))
    for block in samples.blocks():
        g, GG, weight = _minimal_features(block.Phi, block.u)
        root = np.sqrt(weight)[:, None]
        beta, g = model(block.x) * root, g * root
        left += beta.T @ beta
        cross += beta.T @ g
        right += g.T @ g
        S_G += np.einsum("n,nij->ij", weight, GG, optimize=True)
    theta = np.linalg.lstsq(left, cross, rcond=1e-14)[0]
    # the residual's covariance, without a second pass: symmetric against rounding
    C = right - cross.T @ theta - theta.T @ cross + theta.T @ left @ theta
    S_G = S_G + 1e-14 * np.trace(S_G) / r * np.eye(r)
    eigenvalues, vectors = eigh(0.5 * (C + C.T), S_G)
    order = np.argsort(eigenvalues)[::-1]
    return np.sqrt(np.maximum(eigenvalues[order], 0.0)), (S_G @ vectors[:, order]).T


def _minimal_features(Phi: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """g, (Phi Phi^T)^-1 and a weight for each sample: near-singular postures count little."""
    gram = np.einsum("npv,nqv->npq", Phi, Phi, optimize=True)
    trace = np.einsum("npp->n", gram)[:, None, None]
    if Phi.shape[1] <= Phi.shape[2]:
        inverse = np.linalg.inv(gram + 1e-13 * trace * np.eye(Phi.shape[1]))
    else:
        inverse = np.linalg.pinv(gram, rcond=1e-10, hermitian=True)
    g = np.einsum("npq,nqv,nv->np", inverse, Phi, u, optimize=True)
    weight = 1.0 / np.maximum(np.einsum("npp->n", inverse), np.finfo(np.float64).tiny)
    return g, inverse, weight


def best_of_starts(
    samples: Samples,
    model: PolicyModel,
    starts: Iterable[Float[np.ndarray, "s r"]],
    is_enough: Callable[[JointFit], bool] = lambda fit: False,
    **steps: Any,
) -> JointFit:
    """The fit of the least cost, one start after the other until it is enough; at least one start is needed.

    Args:
        samples: What was recorded.
        model: The policy model.
        starts: Lambda in whitened coordinates; drawn one at a time.
        is_enough: Whether the best so far leaves nothing to be looked for.
        steps: See `fit_joint`.
    """
    best: JointFit | None = None
    for start in starts:
        if best is not None and is_enough(best):
            break
        fit = fit_joint(samples, start, model, **steps)
        best = fit if best is None or fit.cost < best.cost else best
    if best is None:
        raise ValueError("there is no start")
    return best


@final
@dataclass(frozen=True, eq=False)
class CrossValidatedFit:
    """A fit, cross-validated over trajectories.

    Attributes:
        fit: To all of them.
        held_out: Mean of |Z^T (u - pi)|^2 on left-out trajectories.
        unexplained: The same, as a share of the energy that there is to explain; without any null-space motion,
            rounding is not held against the model.
    """

    fit: JointFit
    held_out: float
    unexplained: float


def cross_validated(samples: Samples, fit: JointFit) -> CrossValidatedFit:
    """A fit with its cost on trajectories that the policy was not fitted to."""
    folds = min(N_FOLDS, samples.n_trajectories)
    held_out = float(held_out_costs(samples, fit.whitened_selection, fit.model, folds).sum())
    return CrossValidatedFit(fit, held_out, held_out / null_energy(samples, fit))


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


def _judged(samples: Samples, projections: Projections, model: PolicyModel) -> JudgedModel:
    beta, folds = OrthonormalRegressors.of(samples, model).values, samples.trajectory % N_FOLDS
    squares, total, _ = left_out(beta, projections, samples.u, folds)
    _, y = solve_policy(beta, projections, samples.u, Solver(total))
    freedom = max(float(np.einsum("nii->", projections.N)) - total.shape[0], 1.0)
    return JudgedModel(model, np.bincount(samples.trajectory, squares), projections.energy(y) / freedom)


def choose_model(judged: Sequence[JudgedModel], most_parameters: float) -> JudgedModel:
    """The richest of the cheap models that predict no worse than the best.

    Args:
        judged: All models at one Lambda.
        most_parameters: Regressors that the residuals are many enough for, see `deciding.CHEAP`.
    """
    best = min(judged, key=lambda one: one.held_out)
    most = _largest_size(best.model, most_parameters)
    near = [one for one in judged if one.model.n_terms <= most and not _is_worse(one.costs, best.costs)]
    return max(near, key=lambda one: one.model.n_terms)


def _largest_size(model: PolicyModel, most_parameters: float) -> float:
    """Regressors that a model richer than a given one may have."""
    return max(min(ONE_DEGREE * model.n_terms, most_parameters), model.n_terms)


def _is_worse(costs: np.ndarray, best: np.ndarray) -> bool:
    difference = costs - best
    if costs.sum() > EQUALLY_GOOD * best.sum():
        return True
    return bool(difference.mean() > STANDARD_ERRORS * difference.std(ddof=1) / np.sqrt(len(difference)))


def _is_better(trial: CrossValidatedFit, best: CrossValidatedFit, factor: float) -> bool:
    """Whether a fit costs less by a factor on left-out trajectories, and leaves less of the motion that there is.

    A Lambda that takes up all motion leaves little, explained or not.
    """
    is_less = trial.held_out < factor * best.held_out
    return is_less and trial.unexplained < max(factor, 1.0) * best.unexplained


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
    best, residuals = first, {first.fit.model.name: first.unexplained}
    usable = [model for model in models if has_enough(samples, s, model)]
    if s == 0 or len(usable) < 2:
        return best, residuals
    if best.unexplained > POORLY_EXPLAINED:
        # a poor model has led Lambda astray: each model from its own closed-form start
        for model in (model for model in usable if model.n_terms * samples.nv <= len(samples)):
            trial = _tried(samples, model, conditional_pca(samples, model)[1][:s])
            best = trial if _is_better(trial, best, 1.0) else best
    residuals_per_joint = len(samples) * (samples.nv - s) / samples.nv
    judged: list[JudgedModel] = []
    for _ in range(ROUNDS):
        if best.held_out <= EXACT * best.fit.energy:
            return _climb_exact_models(samples, usable, best, residuals)
        projections = Projections.of(samples, best.fit.whitened_selection)
        judged = [_judged(samples, projections, model) for model in usable]
        energy = len(samples) * null_energy(samples, best.fit)
        residuals |= {one.model.name: one.held_out / energy for one in judged}
        predicts_best = min(judged, key=lambda one: one.held_out)
        settled = predicts_best.model.name == best.fit.model.name
        # a model that is too rich bends Lambda while that is far off: first the model that predicts best
        chosen = choose_model(judged, residuals_per_joint / CHEAP) if settled else predicts_best
        if chosen.model.name != best.fit.model.name:
            trial = _tried(samples, chosen.model, best.fit.whitened_selection)
            if not _is_better(trial, best, EQUALLY_GOOD if settled else 1.0):
                break
            best = trial
        if settled:
            break
    return _try_closer_models(samples, judged, best, residuals_per_joint / RESIDUALS_PER_PARAMETER), residuals


def _tried(samples: Samples, model: PolicyModel, start: np.ndarray) -> CrossValidatedFit:
    """A fit in a few steps from a start, cross-validated."""
    return cross_validated(samples, fit_joint(samples, start, model, **COMPARE))


def _try_closer_models(
    samples: Samples, judged: list[JudgedModel], best: CrossValidatedFit, most_parameters: float
) -> CrossValidatedFit:
    """A model that leaves a smaller variance, if it predicts better, or nearly everything, at its own Lambda.

    At the Lambda of a model that is too small, a richer one may extrapolate so badly to single trajectories that
    cross-validation rejects it; the variance of its residual shows nevertheless that it describes the motion.
    """
    if best.unexplained > POORLY_EXPLAINED:
        return best
    own = next(one for one in judged if one.model.name == best.fit.model.name)
    most = _largest_size(best.fit.model, most_parameters)
    closer = [one for one in judged if one.variance < CLOSER * own.variance and one.model.n_terms <= most]
    for one in sorted(closer, key=lambda one: one.variance)[:MOST_TRIALS]:
        trial = _tried(samples, one.model, best.fit.whitened_selection)
        if _is_better(trial, best, WORTH) or trial.unexplained < PREDICTED:
            return trial
    return best


def _climb_exact_models(
    samples: Samples, usable: list[PolicyModel], best: CrossValidatedFit, residuals: dict[str, float]
) -> tuple[CrossValidatedFit, dict[str, float]]:
    """The same where next to nothing is left, and normal equations would compare rounding: fits by QR, one by one."""
    for model in (model for model in usable if model.n_terms * samples.nv <= SCAN_COLUMNS):
        if model.name == best.fit.model.name or best.held_out <= ROUNDING * best.fit.energy:
            continue
        candidate = _tried(samples, model, best.fit.whitened_selection)
        residuals[model.name] = candidate.unexplained
        best = candidate if _is_better(candidate, best, WORTH) else best
    return best, residuals
