"""The joint estimator's number of rows: of all explanations of the motion the one with the most evidence, in nats.

An explanation is a Lambda of s rows with a policy model. It accounts for all of u_n = Q_n c_n + Z_n w_n, with Q_n and
Z_n orthonormal bases of the rows and of the null space of A_n: w_n is the policy and white noise of variance sigma^2,
c_n the task's own motion, of which nothing is known but that it is a signal in time. With S_k the mean square of c in
octave k of the cosine transform of each trajectory, which has N_k entries, and m parameters in all,

    l = - n (nv - s) / 2 (log sigma^2 + 1) - sum_k N_k / 2 (log S_k + 1) - m / 2 log n

(the Bayesian information criterion: Schwarz, 1978). [Q Z] is orthonormal, so that likelihoods of different s are those
of the same numbers. A row too many takes a direction that the policy predicts to the noise for one of which nothing is
known: it costs log(S / sigma^2) / 2 a sample, which no residual shows.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.fft import dct

from manip_learn.errors import counted
from manip_learn.learning.deciding import ABOVE_NOISE, NOT_THE_POLICYS, PREDICTS_NOISE, RESOLVED_SHARE
from manip_learn.learning.estimators.estimate import GapTable, JointFit, gaps_of_residuals
from manip_learn.learning.estimators.model_search import (
    COMPARE,
    CrossValidatedFit,
    best_of_starts,
    conditional_pca,
    cross_validated,
    has_enough,
)
from manip_learn.learning.estimators.noise_covariance import noise_in_time
from manip_learn.learning.estimators.policy_model import PolicyModel, PolynomialModel
from manip_learn.learning.samples import Samples, rows_beside, runs
from manip_learn.linalg import row_bases

# random starts where the closed-form one does not lead to the noise
RANDOM_STARTS = 3
# starts with a row less within the rows that were found
SUBSPACES = 4
# share of the evidence that is lacking which a richer model must find for a still richer one to be tried
PROGRESS = 0.1


@final
@dataclass(frozen=True, eq=False)
class Explanation:
    """A Lambda with a policy.

    Attributes:
        judged: Both, and the cost on left-out trajectories.
        nats: Evidence l, see the module.
        task_nats: What the task's motion has of it, before the price of its parameters.
        predicts: Whether the policy predicts trajectories that it was not fitted to, as far as noise lets it.
    """

    judged: CrossValidatedFit
    nats: float
    task_nats: float
    predicts: bool

    @property
    def n_rows(self) -> int:
        """Number of rows s."""
        return len(self.judged.fit.whitened_selection)


@final
@dataclass(frozen=True, eq=False)
class RowCount:
    """The number of rows, with its evidence.

    Attributes:
        table: The gaps, and the number of rows that explains the motion best.
        fits: Number of rows -> the best explanation that predicts left-out trajectories.
        warnings: Doubts.
    """

    table: GapTable
    fits: dict[int, CrossValidatedFit]
    warnings: tuple[str, ...]


def count_rows(samples: Samples, models: Sequence[PolicyModel], rng: np.random.Generator) -> RowCount | None:
    """The number of rows of the explanation with the most evidence, among those that predict left-out trajectories.

    Args:
        samples: What was recorded.
        models: Policy models, smallest first.
        rng: For the random starts.

    Returns:
        None where there are too few samples for any model.
    """
    found = explain(samples, models, rng)
    if not found:
        return None
    chosen = {s: _best_of([one for one in found if one.n_rows == s]) for s in {one.n_rows for one in found}}
    best = _best_of(found)
    residuals = {s: float(np.sqrt(_variance(samples, one.judged.fit))) for s, one in chosen.items()}
    present = {s: r for s, r in residuals.items() if s == 0 or s - 1 in residuals}
    table = gaps_of_residuals(present, 1e-15 * float(np.sqrt(samples.energy)), len(samples))
    rivals = [one for one in found if one.nats > best.nats and one.n_rows != best.n_rows]
    warnings = _doubt(best, rivals) if rivals else ()
    return RowCount(
        dataclasses.replace(table, best=best.n_rows), {s: one.judged for s, one in chosen.items()}, warnings
    )


def explain(samples: Samples, models: Sequence[PolicyModel], rng: np.random.Generator) -> list[Explanation]:
    """All explanations that were tried.

    A richer model is tried where the evidence that it would have, were the noise all that it leaves, exceeds the best;
    fewer rows than one that leaves only noise, where a policy of the posture may do what the task does in it.
    """
    noise = max(noise_in_time(samples), _resolved(samples))
    commanded = _count_commanded(samples, models)
    found: list[Explanation] = []
    for model in models:
        for s in range(min(samples.n_rows, samples.nv - 1) + 1):
            same = [one for one in found if one.n_rows == s]
            if not has_enough(samples, s, model):
                continue
            if same:
                best = _best_of(found)
                is_answered = _left(samples, best.judged.fit) <= ABOVE_NOISE * noise
                if is_answered and (s < commanded or _is_hopeless(same, best)):
                    continue
                most = _most(same)  # were noise all that the richer model leaves:
                left = min(noise, _left(samples, most.judged.fit))
                if best.predicts and most.task_nats + _null_nats(samples, s, model, left) <= best.nats:
                    continue
            warm = [_most(same).judged.fit.whitened_selection] if same else []
            found.append(_explained(samples, _fit_from_starts(samples, s, model, warm, noise, rng)))
    return found + _within(samples, _best_of(found), rng) if found else found


def _within(samples: Samples, best: Explanation, rng: np.random.Generator) -> list[Explanation]:
    """One row less, from starts among the rows of the best: they hold the true ones where these are fewer."""
    Lambda, model = best.judged.fit.whitened_selection, best.judged.fit.model
    s = len(Lambda)
    if s < 2:
        return []
    starts = ((rng.standard_normal((s, s)) @ Lambda)[1:] for _ in range(SUBSPACES))
    return [_explained(samples, best_of_starts(samples, model, starts, **COMPARE))]


def _most(found: Sequence[Explanation]) -> Explanation:
    return max(found, key=lambda one: one.nats)


def _best_of(found: Sequence[Explanation]) -> Explanation:
    """The one with the most evidence among those that predict; the one that errs least on what was left out if none."""
    predicting = [one for one in found if one.predicts]
    return _most(predicting) if predicting else min(found, key=lambda one: one.judged.held_out)


def _is_hopeless(same: Sequence[Explanation], best: Explanation) -> bool:
    """Whether the last of the richer models came hardly closer to the best."""
    if len(same) < 2:
        return False
    return same[-1].nats - _most(same[:-1]).nats < PROGRESS * (best.nats - same[-1].nats)


def _doubt(best: Explanation, rivals: Sequence[Explanation]) -> tuple[str, ...]:
    other = _most(rivals)
    return (
        f"{counted(best.n_rows, 'row')} and a policy model {best.judged.fit.model.name} predict left-out trajectories, "
        f"but {counted(other.n_rows, 'row')} and {other.judged.fit.model.name} fit all of them better: record more "
        "trajectories, or give n_constraints if you know it",
    )


def _explained(samples: Samples, fit: JointFit) -> Explanation:
    task, n_octaves = _task_nats(samples, fit.whitened_selection)
    judged = cross_validated(samples, fit)
    predicts = judged.held_out <= PREDICTS_NOISE * max(fit.energy, _resolved(samples))
    price = 0.5 * n_octaves * np.log(len(samples))
    nats = task + _null_nats(samples, len(fit.whitened_selection), fit.model, _left(samples, fit)) - price
    return Explanation(judged, float(nats), task, predicts)


def _null_nats(samples: Samples, s: int, model: PolicyModel, left: float) -> float:
    """Evidence for s rows with a model that leaves so much of each null direction, but for the task's motion."""
    n, parameters = len(samples), model.n_terms * samples.nv + s * (samples.n_rows - s)
    return _gaussian_nats(n * (samples.nv - s), left, _resolved(samples)) - 0.5 * parameters * float(np.log(n))


def _gaussian_nats(
    count: Float[np.ndarray, " k"] | int, square: Float[np.ndarray, " k"] | float, least: float
) -> float:
    """Largest log-likelihood, but for a constant, of so many numbers with such a mean square and no less a variance."""
    variance = np.maximum(square, least)
    return float(-0.5 * np.sum(count * (np.log(variance) + square / variance)))


def _task_nats(samples: Samples, Lambda: Float[np.ndarray, "s r"]) -> tuple[float, int]:
    """Log-likelihood of the task's own motion c, octave by octave, and the number of octaves."""
    if not len(Lambda):
        return 0.0, 0
    c = np.concatenate([_along_rows(rows_beside(Lambda, block.Phi), block.u) for block in samples.blocks()])
    squares, counts = np.zeros(64), np.zeros(64)
    for own in (c[part] for _, part in runs(samples.trajectory)):
        octave = np.frexp(np.arange(len(own)))[1]  # 0, then 1, 2-3, 4-7, ...
        squares += np.bincount(octave, np.sum(dct(own, axis=0, norm="ortho") ** 2, axis=1), 64)
        counts += np.bincount(octave, minlength=64) * c.shape[1]
    used = counts > 0
    return _gaussian_nats(counts[used], squares[used] / counts[used], _resolved(samples)), int(np.count_nonzero(used))


def _along_rows(A: Float[np.ndarray, "s nv n"], u: Float[np.ndarray, "n nv"]) -> Float[np.ndarray, "n s"]:
    """u in an orthonormal basis of the row space of A that turns as smoothly as A does."""
    Q, R = row_bases(A.transpose(1, 0, 2))
    return np.einsum("vsn,nv,ssn->ns", Q, u, np.sign(R), optimize=True)


def _resolved(samples: Samples) -> float:
    """Variance [(rad/s)^2] that is noise enough."""
    return RESOLVED_SHARE**2 * samples.energy / samples.nv


def _left(samples: Samples, fit: JointFit) -> float:
    """What is left of the motion, a direction of the null space [(rad/s)^2]."""
    return fit.cost / (samples.nv - len(fit.whitened_selection))


def _variance(samples: Samples, fit: JointFit) -> float:
    """The same a degree of freedom, which the policy's parameters take from the samples."""
    n, z = len(samples), samples.nv - len(fit.whitened_selection)
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


def _fit_from_starts(
    samples: Samples,
    s: int,
    model: PolicyModel,
    warm: Sequence[Float[np.ndarray, "s r"]],
    noise: float,
    rng: np.random.Generator,
) -> JointFit:
    """The fit of the least cost from closed-form starts, and from random ones where these do not lead to the noise."""
    random = (rng.standard_normal((s, samples.n_rows)) for _ in range(RANDOM_STARTS))
    return best_of_starts(
        samples,
        model,
        itertools.chain([conditional_pca(samples, model)[1][:s]], warm, random),
        lambda best: s in (0, samples.n_rows) or _left(samples, best) <= ABOVE_NOISE * noise,
        **COMPARE,
    )
