"""The joint estimator's policy model, by cross-validation over trajectories, and its number of rows, by evidence.

A policy model that is too small bends Lambda, silently; one degree too many costs a few percent. So of the models whose
held-out cost does not exceed the least beyond chance, in pairs over the trajectories, the richest is taken.

The number of rows is that of the explanation of the motion with the most evidence, in nats. An explanation is a Lambda
of s rows with a policy model. It accounts for all of u_n = Q_n c_n + Z_n w_n, with Q_n and Z_n orthonormal bases of the
rows and of the null space of A_n: w_n is the policy and white noise of variance sigma^2, c_n the task's own motion, of
which nothing is known but that it is a signal in time. With S_k the mean square of c in octave k of the cosine
transform of each trajectory, which has N_k entries, and m parameters in all,

    l = - n (nv - s) / 2 (log sigma^2 + 1) - sum_k N_k / 2 (log S_k + 1) - m / 2 log n

(the Bayesian information criterion: Schwarz, 1978). [Q Z] is orthonormal, so that likelihoods of different s are those
of the same numbers. A row too many takes a direction that the policy predicts to the noise for one of which nothing is
known: it costs log(S / sigma^2) / 2 a sample, which no residual shows.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float
from scipy.fft import dct
from scipy.linalg import eigh

from manip_learn.errors import counted
from manip_learn.learning.estimators.estimate import (
    EQUALLY_GOOD,
    RESIDUALS_PER_PARAMETER,
    GapTable,
    JointFit,
    gaps_of_residuals,
)
from manip_learn.learning.estimators.policy_equations import (
    OrthonormalRegressors,
    Projections,
    Solver,
    left_out,
    noise_in_time,
    solve_policy,
)
from manip_learn.learning.estimators.policy_model import PolicyModel, PolynomialModel
from manip_learn.learning.estimators.variable_projection import fit_joint, held_out_costs
from manip_learn.learning.samples import STANDARD_ERRORS, Samples, rows_beside, runs
from manip_learn.linalg import row_bases

# share of the root mean square of u that is noise enough: what is resolved below it, in recordings without noise, is
# how well a model approximates the policy, and with more rows every model comes closer. Set by hand
RESOLVED_SHARE = 1e-3
# variance over that of the noise up to which a fit leaves noise alone: 22 % in amplitude. Set by hand
ABOVE_NOISE = 1.5
# share of the motion along a direction that a rich policy model must leave for the direction to be the task's: half
NOT_THE_POLICYS = 0.5
# left-out motion over that of no policy at all up to which a model predicts it: 1 where there is noise alone to predict
PREDICTS_NOISE = 1.2
# held-out share of the energy below which a model is as good as exact: it is believed unasked, and extrapolation no
# longer decides between models. Set by hand
PREDICTED = 1e-3
# share of left-out motion that no model explains from which a weak gap may be the policy's. Set by hand
POORLY_EXPLAINED = 0.03
# ratio of the held-out cost by which a richer model must lower it to be worth its parameters. Set by hand
WORTH = 0.8
# how many times the regressors of the best a richer model may have. Set by hand
ONE_DEGREE = 3.0
# residuals for each of its parameters that make a richer model cheap. Set by hand
CHEAP = 25.0
# residual variance over that of a smaller model that is not chance with `RESIDUALS_PER_PARAMETER`. Set by hand
CLOSER = 0.9

N_FOLDS = 5  # parts that are left out in turn
# share of the energy that is rounding: of a fit by QR; and below which normal equations cannot compare models
ROUNDING, EXACT = 1e-24, 1e-10
VANISHING = 1e-16  # of the energy, which is rounding where nothing moves in the null space
# models of at most this many columns are tried one by one where next to nothing is left
SCAN_COLUMNS = 120
# changes of the model
ROUNDS = 4
# models that are fitted although they predicted worse
MOST_TRIALS = 3
# enough steps to compare
COMPARE: dict[str, Any] = {"max_iterations": 8, "gain": 1e-4}
# random starts where the closed-form one does not lead to the noise
RANDOM_STARTS = 3
# starts with a row less within the rows that were found
SUBSPACES = 4
# share of the evidence that is lacking which a richer model must find for a still richer one to be tried
PROGRESS = 0.1


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
        gram = np.einsum("npv,nqv->npq", block.Phi, block.Phi, optimize=True)
        trace = np.einsum("npp->n", gram)[:, None, None]
        if r <= samples.nv:
            GG = np.linalg.inv(gram + 1e-13 * trace * np.eye(r))
        else:
            GG = np.linalg.pinv(gram, rcond=1e-10, hermitian=True)
        g = np.einsum("npq,nqv,nv->np", GG, block.Phi, block.u, optimize=True)
        # near-singular postures count little
        weight = 1.0 / np.maximum(np.einsum("npp->n", GG), np.finfo(np.float64).tiny)
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


def best_of_starts(
    samples: Samples,
    model: PolicyModel,
    starts: Iterable[Float[np.ndarray, "s r"]],
    is_enough: Callable[[JointFit], bool] = lambda fit: False,
    **steps: Any,
) -> JointFit:
    """The fit of the least cost, one start in whitened coordinates after the other until the best so far is enough.

    At least one start is needed; for the steps see `fit_joint`.
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


def cross_validated(samples: Samples, fit: JointFit) -> JointFit:
    """A fit with its cost on trajectories that the policy was not fitted to."""
    folds = min(N_FOLDS, samples.n_trajectories)
    held_out = float(held_out_costs(samples, fit.whitened_selection, fit.model, folds).sum())
    return dataclasses.replace(fit, held_out=held_out, unexplained=held_out / null_energy(samples, fit))


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
    """The richest of the models at one Lambda that predict no worse than the best, and of which the residuals can
    afford the regressors: no more than `most_parameters`, see `CHEAP`.
    """
    best = min(judged, key=lambda one: one.held_out)
    most = _largest_size(best.model, most_parameters)
    near = []
    for one in (one for one in judged if one.model.n_terms <= most and one.held_out <= EQUALLY_GOOD * best.held_out):
        difference = one.costs - best.costs
        chance = STANDARD_ERRORS * difference.std(ddof=1) / np.sqrt(len(difference))
        near += [] if difference.mean() > chance else [one]
    return max(near, key=lambda one: one.model.n_terms)


def _largest_size(model: PolicyModel, most_parameters: float) -> float:
    """Regressors that a model richer than a given one may have."""
    return max(min(ONE_DEGREE * model.n_terms, most_parameters), model.n_terms)


def _is_better(trial: JointFit, best: JointFit, factor: float) -> bool:
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
    samples: Samples, s: int, models: list[PolicyModel], first: JointFit
) -> tuple[JointFit, dict[str, float]]:
    """The model that predicts best or one degree more; held-out share of every model that was tried.

    All models are judged at the Lambda of the best so far, and again at that of the one chosen.
    """
    best, residuals = first, {first.model.name: first.unexplained}
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
        if best.held_out <= EXACT * best.energy:
            # next to nothing is left, and normal equations would compare rounding: QR fits, one by one
            for model in (model for model in usable if model.n_terms * samples.nv <= SCAN_COLUMNS):
                if model.name == best.model.name or best.held_out <= ROUNDING * best.energy:
                    continue
                trial = _tried(samples, model, best.whitened_selection)
                residuals[model.name] = trial.unexplained
                best = trial if _is_better(trial, best, WORTH) else best
            return best, residuals
        projections = Projections.of(samples, best.whitened_selection)
        judged = [_judged(samples, projections, model) for model in usable]
        energy = len(samples) * null_energy(samples, best)
        residuals |= {one.model.name: one.held_out / energy for one in judged}
        predicts_best = min(judged, key=lambda one: one.held_out)
        settled = predicts_best.model.name == best.model.name
        # a model that is too rich bends Lambda while that is far off: first the model that predicts best
        chosen = choose_model(judged, residuals_per_joint / CHEAP) if settled else predicts_best
        if chosen.model.name != best.model.name:
            trial = _tried(samples, chosen.model, best.whitened_selection)
            if not _is_better(trial, best, EQUALLY_GOOD if settled else 1.0):
                break
            best = trial
        if settled:
            break
    return _try_closer_models(samples, judged, best, residuals_per_joint / RESIDUALS_PER_PARAMETER), residuals


def _tried(samples: Samples, model: PolicyModel, start: np.ndarray) -> JointFit:
    """A fit in a few steps from a start, cross-validated."""
    return cross_validated(samples, fit_joint(samples, start, model, **COMPARE))


def _try_closer_models(samples: Samples, judged: list[JudgedModel], best: JointFit, most_parameters: float) -> JointFit:
    """A model that leaves a smaller variance, if it predicts better, or nearly everything, at its own Lambda.

    At the Lambda of a model that is too small, a richer one may extrapolate so badly to single trajectories that
    cross-validation rejects it; the variance of its residual shows nevertheless that it describes the motion.
    """
    if best.unexplained > POORLY_EXPLAINED:
        return best
    own = next(one for one in judged if one.model.name == best.model.name)
    most = _largest_size(best.model, most_parameters)
    closer = [one for one in judged if one.variance < CLOSER * own.variance and one.model.n_terms <= most]
    for one in sorted(closer, key=lambda one: one.variance)[:MOST_TRIALS]:
        trial = _tried(samples, one.model, best.whitened_selection)
        if _is_better(trial, best, WORTH) or trial.unexplained < PREDICTED:
            return trial
    return best


@final
@dataclass(frozen=True, eq=False)
class Explanation:
    """A Lambda with a policy.

    Attributes:
        fit: Both, cross-validated.
        nats: Evidence l, see the module.
        task_nats: What the task's motion has of it, before the price of its parameters.
        predicts: Whether the policy predicts trajectories that it was not fitted to, as far as noise lets it.
    """

    fit: JointFit
    nats: float
    task_nats: float
    predicts: bool

    @property
    def n_rows(self) -> int:
        """Number of rows s."""
        return self.fit.n_rows


@final
@dataclass(frozen=True, eq=False)
class RowCount:
    """The gaps with the number of rows that explains the motion best; for each number of rows the best explanation that
    predicts left-out trajectories; and doubts.
    """

    table: GapTable
    fits: dict[int, JointFit]
    warnings: tuple[str, ...]


def count_rows(samples: Samples, models: Sequence[PolicyModel], rng: np.random.Generator) -> RowCount | None:
    """The number of rows of the explanation with the most evidence, among those that predict left-out trajectories.

    None where there are too few samples for any of the models, which come smallest first.
    """
    found = explain(samples, models, rng)
    if not found:
        return None
    chosen = {s: _best_of([one for one in found if one.n_rows == s]) for s in {one.n_rows for one in found}}
    best = _best_of(found)
    residuals = {s: float(np.sqrt(_variance(samples, one.fit))) for s, one in chosen.items()}
    present = {s: r for s, r in residuals.items() if s == 0 or s - 1 in residuals}
    table = gaps_of_residuals(present, 1e-15 * float(np.sqrt(samples.energy)), len(samples))
    rivals, warnings = [one for one in found if one.nats > best.nats and one.n_rows != best.n_rows], ()
    if rivals:
        other = _most(rivals)
        warnings = (
            f"{counted(best.n_rows, 'row')} and a policy model {best.fit.model.name} predict left-out trajectories, "
            f"but {counted(other.n_rows, 'row')} and {other.fit.model.name} fit all of them better: record more "
            "trajectories, or give n_constraints if you know it",
        )
    fits = {s: one.fit for s, one in chosen.items()}
    return RowCount(dataclasses.replace(table, best=best.n_rows), fits, warnings)


def explain(samples: Samples, models: Sequence[PolicyModel], rng: np.random.Generator) -> list[Explanation]:
    """All explanations that were tried.

    A richer model is tried where the evidence that it would have, were the noise all that it leaves, exceeds the best;
    fewer rows than one that leaves only noise, where a policy of the posture may do what the task does in it.
    """
    noise = max(noise_in_time(samples), _resolved(samples))
    enough, commanded = ABOVE_NOISE * noise, _count_commanded(samples, models)
    found: list[Explanation] = []
    for model in models:
        for s in range(min(samples.n_rows, samples.nv - 1) + 1):
            same = [one for one in found if one.n_rows == s]
            if not has_enough(samples, s, model):
                continue
            if same:
                best = _best_of(found)
                is_answered = _left(samples, best.fit) <= enough
                # the last of the richer models came hardly closer to the best
                last, before = same[-1].nats, _most(same[:-1]).nats if len(same) > 1 else -np.inf
                if is_answered and (s < commanded or last - before < PROGRESS * (best.nats - last)):
                    continue
                most = _most(same)  # were noise all that the richer model leaves:
                left = min(noise, _left(samples, most.fit))
                if best.predicts and most.task_nats + _null_nats(samples, s, model, left) <= best.nats:
                    continue
            # closed-form starts, and random ones where these do not lead to the noise
            warm = [_most(same).fit.whitened_selection] if same else []
            random = (rng.standard_normal((s, samples.n_rows)) for _ in range(RANDOM_STARTS))
            starts = itertools.chain([conditional_pca(samples, model)[1][:s]], warm, random)
            stop = (lambda _: True) if s in (0, samples.n_rows) else (lambda fit: _left(samples, fit) <= enough)
            found.append(_explained(samples, best_of_starts(samples, model, starts, stop, **COMPARE)))
    if found and (s := _best_of(found).n_rows) > 1:
        # one row less, from starts among the rows of the best: they hold the true ones where these are fewer
        best = _best_of(found).fit
        starts = ((rng.standard_normal((s, s)) @ best.whitened_selection)[1:] for _ in range(SUBSPACES))
        found.append(_explained(samples, best_of_starts(samples, best.model, starts, **COMPARE)))
    return found


def _most(found: Sequence[Explanation]) -> Explanation:
    return max(found, key=lambda one: one.nats)


def _best_of(found: Sequence[Explanation]) -> Explanation:
    """The one with the most evidence among those that predict; if none does, the least held-out cost."""
    predicting = [one for one in found if one.predicts]
    return _most(predicting) if predicting else min(found, key=lambda one: one.fit.held_out)


def _explained(samples: Samples, fit: JointFit) -> Explanation:
    task, n_octaves = _task_nats(samples, fit.whitened_selection)
    fit = cross_validated(samples, fit)
    predicts = fit.held_out <= PREDICTS_NOISE * max(fit.energy, _resolved(samples))
    price = 0.5 * n_octaves * np.log(len(samples))
    nats = task + _null_nats(samples, fit.n_rows, fit.model, _left(samples, fit)) - price
    return Explanation(fit, float(nats), task, predicts)


def _null_nats(samples: Samples, s: int, model: PolicyModel, left: float) -> float:
    """Evidence for s rows with a model that leaves the variance `left` of each null direction, task's motion aside."""
    n, parameters = len(samples), model.n_terms * samples.nv + s * (samples.n_rows - s)
    return _gaussian_nats(n * (samples.nv - s), left, _resolved(samples)) - 0.5 * parameters * float(np.log(n))


def _gaussian_nats(
    count: Float[np.ndarray, " k"] | int, square: Float[np.ndarray, " k"] | float, least: float
) -> float:
    """Largest log-likelihood, but for a constant, of `count` numbers of this mean square, variance at least `least`."""
    variance = np.maximum(square, least)
    return float(-0.5 * np.sum(count * (np.log(variance) + square / variance)))


def _task_nats(samples: Samples, Lambda: Float[np.ndarray, "s r"]) -> tuple[float, int]:
    """Log-likelihood of the task's own motion c, octave by octave, and the number of octaves."""
    if not len(Lambda):
        return 0.0, 0
    along = []
    for block in samples.blocks():
        Q, R = row_bases(rows_beside(Lambda, block.Phi).transpose(1, 0, 2))
        # the signs make the basis of the row space turn as smoothly as A does
        along.append(np.einsum("vsn,nv,ssn->ns", Q, block.u, np.sign(R), optimize=True))
    c = np.concatenate(along)
    squares, counts = np.zeros(64), np.zeros(64)
    for own in (c[part] for _, part in runs(samples.trajectory)):
        octave = np.frexp(np.arange(len(own)))[1]  # 0, then 1, 2-3, 4-7, ...
        squares += np.bincount(octave, np.sum(dct(own, axis=0, norm="ortho") ** 2, axis=1), 64)
        counts += np.bincount(octave, minlength=64) * c.shape[1]
    used = counts > 0
    return _gaussian_nats(counts[used], squares[used] / counts[used], _resolved(samples)), int(np.count_nonzero(used))


def _resolved(samples: Samples) -> float:
    """Variance [(rad/s)^2] that is noise enough."""
    return RESOLVED_SHARE**2 * samples.energy / samples.nv


def _left(samples: Samples, fit: JointFit) -> float:
    """Mean square of the residual in each direction of the null space [(rad/s)^2]."""
    return fit.cost / (samples.nv - fit.n_rows)


def _variance(samples: Samples, fit: JointFit) -> float:
    """Residual variance per degree of freedom: the policy's parameters take theirs from the samples [(rad/s)^2]."""
    n, z = len(samples), samples.nv - fit.n_rows
    return n * fit.cost / max(n * z - fit.model.n_terms * samples.nv, 1)


def _count_commanded(samples: Samples, models: Sequence[PolicyModel]) -> int:
    """Directions along which the task moves in a way that no policy of the posture explains.

    Judged by the richest model that does not have a regressor for each trajectory, with which it could tell them apart.
    """
    rich = [model for model in models if model.n_terms <= samples.n_trajectories]
    if not rich:
        return 0
    constant = PolynomialModel(0, samples.q.shape[1])
    left, everything = (conditional_pca(samples, model)[0] for model in (rich[-1], constant))
    return int(np.count_nonzero(left > NOT_THE_POLICYS * everything))
