"""The estimator for self-imposed demonstrations: Lambda and pi together from raw (q, u), b unknown."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.estimators.estimate import EXPLAINED, Estimate, GapTable, JointFit, gaps_of_residuals
from manip_learn.learning.estimators.model_search import (
    ABOVE_NOISE,
    COMPARE,
    N_FOLDS,
    POORLY_EXPLAINED,
    PREDICTED,
    ROUNDING,
    RowCount,
    best_of_starts,
    conditional_pca,
    count_rows,
    null_energy,
    search_model,
)
from manip_learn.learning.estimators.policy_equations import (
    UNEQUAL_NOISE,
    noise_in_time,
    shape_in_time,
    whitened,
    whitening_factor,
)
from manip_learn.learning.estimators.policy_model import (
    HarmonicModel,
    PolicyModel,
    PolynomialModel,
    RadialModel,
    TrajectoryOffsetModel,
)
from manip_learn.learning.estimators.variable_projection import (
    ScoredFit,
    fit_joint,
    fit_marginal,
    held_out_costs,
    scores,
)
from manip_learn.learning.samples import Samples, runs

# ratio of joint estimates' gap, beyond which the null-space estimator's answer to the same data is not asked for
BEYOND_DOUBT_GAP = 30.0
# root mean square distance from a path over its extent within which a motion repeats it: replays with 3 % of another
# motion in them have 0.05 to 0.14, generated reaches in threes and more 0.32 and above (12, 192 sets, seeds from 30000)
SAME_PATH = 0.15
RADIAL_CENTRES = 32  # of the radial policy models. Set by hand

# share of the motion that is rounding
EXACT = 1e-16
RANDOM_STARTS = 2  # beside those that are computed
# models are compared on at most this many samples, and fitted with at most this many columns unless asked for
COMPARE_LIMIT = 1_500
MAX_COLUMNS = 260  # of normal equations, which take its square in memory and its cube in time
MOST_POSTURES = 2_000  # between the samples of a path, against noise that makes it long
# share of the energy above which a residual is noise that hides a part of the policy
NOISY = 1e-10
# a rest posture for each trajectory makes the cost bumpy: the search begins from many starts on a few trajectories and
# samples, until IDLE_ROUNDS rounds of starts have found nothing better, and goes on with the best of each round
FEW, FEW_SAMPLES = 16, 600
STARTS, IDLE_ROUNDS, REFINED = 20, 2, 8  # starts of a round, rounds, and starts of a round that are refined
# the first look at a start: stops where a step gains less than a thousandth
LOOK: dict[str, Any] = {"max_iterations": 5, "gain": 1e-3}


def estimate_joint(
    samples: Samples,
    n_constraints: int | None,
    rng: np.random.Generator,
    policy_model: str = "auto",
    unexplained: float = np.inf,
) -> Estimate:
    """Number of rows and policy model by cross-validation over trajectories, then variable projection on all data.

    Args:
        samples: What was recorded.
        n_constraints: Number of rows; found from the data by default.
        rng: For k-means and the random starts.
        policy_model: `"auto"` (tries them all), `"constant"`, `"affine"`, `"quadratic"`, `"cubic"`, `"quartic"`,
            `"quintic"` or `"rbf"`; or
            `"affine-offset"`: affine, with an offset per trajectory, where demonstrators rest in different postures.
        unexplained: Held-out share of the energy above which to give up before the expensive part.

    Raises:
        NotIdentifiableError: One trajectory or motion only, too few samples for even the smallest model, no task in
            them, or given up.
    """
    if samples.n_trajectories < 2:
        raise NotIdentifiableError(
            "one trajectory does not identify a constraint whose task velocity is unknown: give several, from "
            "different starts to different targets",
            code="one-trajectory",
        )
    if _repeat_one_motion(samples):
        raise NotIdentifiableError(
            f"the {samples.n_trajectories} recordings repeat one motion: like a single one they cannot show which part "
            "of it is steered on purpose; record motions that differ, from other starts to other targets",
            code="repeated-motion",
        )
    if policy_model == "affine-offset":
        return estimate_with_offsets(samples, n_constraints, rng)
    few = samples.thinned(COMPARE_LIMIT)
    models = _list_models(few, rng, policy_model)
    counted = _count(few, models, n_constraints, rng)
    weighted = samples
    L = _unequal_noise(samples, few, counted.fits[n_constraints or counted.table.best])
    if L is not None:
        weighted, few = whitened(samples, L), whitened(few, L)
        counted = _count(few, models, n_constraints, rng)
    s = n_constraints or counted.table.best
    if s == 0:
        raise NotIdentifiableError(
            "a policy of the posture alone explains the motion: nothing in it is steered on purpose, or too few "
            "trajectories show what is; record more, from other starts to other targets",
            code="no-task",
        )
    first = counted.fits[s]
    chosen, residuals = search_model(few, s, models, first)
    if policy_model == "auto":
        own = _offsets_if_clear(weighted, n_constraints, first, chosen, rng)
        if own is not None:
            return own
    if chosen.unexplained > unexplained:
        raise NotIdentifiableError("no policy model predicts this motion", code="unexplained")
    samples, fit, scored = weighted, _fit_from_random_starts(weighted, chosen, rng), None
    # the residual is noise, and has its covariance, only where the policy model explains the motion
    if chosen.unexplained <= POORLY_EXPLAINED:
        samples, fit = _fit_whitened(samples, fit)
        # normal equations resolve the residual
        is_free = policy_model == "auto" and 0 < len(fit.whitened_selection) < samples.n_rows
        scored = fit_marginal(samples, fit, MAX_COLUMNS) if is_free and not fit.leaves_only(NOISY) else None
    scored = scored or ScoredFit(fit.whitened_selection, *scores(samples, fit))
    warnings = () if n_constraints is not None else counted.warnings
    estimate = _estimate(samples, fit, scored, counted.table, residuals, chosen.held_out, chosen.unexplained)
    return dataclasses.replace(estimate, warnings=warnings)


def _estimate(
    samples: Samples,
    fit: JointFit,
    scored: ScoredFit,
    table: GapTable,
    residuals: dict[str, float],
    held_out: float,
    share: float,
) -> Estimate:
    """The answer of a fit; of left-out trajectories it leaves `held_out`, a share of the energy."""
    return Estimate(
        "joint",
        scored.whitened_selection,
        table,
        fit.cost / null_energy(samples, fit),
        share,
        scored.gradients,
        scored.hessians,
        fit.model.name,
        residuals,
        held_out / (samples.nv - fit.n_rows),
        prior=scored.prior,
    )


def _repeat_one_motion(samples: Samples) -> bool:
    """Whether all trajectories lie on the path of the longest one, whatever their time, direction and rate."""
    paths = [samples.q[part] for _, part in runs(samples.trajectory)]
    extents = [float(np.sum(np.var(path, axis=0))) ** 0.5 for path in paths]
    most = SAME_PATH * max(extents)
    longest = paths[int(np.argmax(extents))]
    # with postures added between its samples, until none are farther apart than that [rad]
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(longest, axis=0), axis=1)))
    n = min(int(along[-1] / most) + 1, MOST_POSTURES) if most > 0.0 else 0
    places = np.union1d(along, np.linspace(0.0, along[-1], n + 1))
    tree = cKDTree(np.column_stack([np.interp(places, along, column) for column in longest.T]))
    return all(float(np.mean(tree.query(path)[0] ** 2)) <= most**2 for path in paths)


def _count(
    samples: Samples, models: list[PolicyModel], n_constraints: int | None, rng: np.random.Generator
) -> RowCount:
    """The number of rows, with fits for one more and one less.

    Raises:
        NotIdentifiableError: Too few samples.
    """
    counted = count_rows(samples, models, rng)
    if counted is None or len(counted.fits) < 2 or (n_constraints is not None and n_constraints not in counted.fits):
        raise NotIdentifiableError(
            f"{len(samples)} samples are too few for the joint estimator on {samples.n_rows} rows and {samples.nv} "
            "joints: record more trajectories, or name fewer axes",
            code="too-few-samples",
        )
    return counted


def _unequal_noise(samples: Samples, few: Samples, fit: JointFit) -> Float[np.ndarray, "nv nv"] | None:
    """Factor of the covariance of noise that is stronger in some joints than in others; None where it is not.

    Equal weights draw Lambda to where its null space is least noisy, so far with strong noise (32 degrees at 10 %, each
    joint in proportion to its motion) that the residual shows nothing of the covariance: it is seen in time, and
    believed where weights by it leave as much noise as is seen.
    """
    S = shape_in_time(samples)
    if S is None or np.linalg.cond(S) < UNEQUAL_NOISE or fit.leaves_only(NOISY):
        return None
    L = np.linalg.cholesky(S)
    weighted = whitened(few, L)
    again = fit_joint(weighted, fit.whitened_selection, fit.model, **COMPARE)
    left = again.cost / (samples.nv - len(again.whitened_selection)) / noise_in_time(whitened(samples, L))
    return L if 1.0 / ABOVE_NOISE < left < ABOVE_NOISE else None


def _offsets_if_clear(
    samples: Samples, n_constraints: int | None, first: JointFit, chosen: JointFit, rng: np.random.Generator
) -> Estimate | None:
    """The estimate with a rest posture for each trajectory, where a shared policy explains the motion poorly.

    None where it is not worth a try, or its answer not beyond doubt. `first` is the fit that gave the number of rows,
    `chosen` the one with the selected policy model.
    """
    if first.leaves_only(EXACT):
        return None
    is_poor = chosen.unexplained > POORLY_EXPLAINED
    # rich models come close to separate rest postures, which alone are exact then
    is_close = first.unexplained > POORLY_EXPLAINED and not chosen.leaves_only(EXACT)
    few, needed = _few_trajectories(samples)
    if not (is_poor or is_close) or len(few) < needed:
        return None
    shared, Lambda = PolynomialModel(1, samples.q.shape[1]), chosen.whitened_selection
    without, offsets = (_held_out_samples(few, Lambda, model) for model in (shared, _offset_model(few)))
    if offsets > EXPLAINED * without:
        return None
    own = estimate_with_offsets(samples, n_constraints, rng)
    is_clear = own.table.gap(len(own.whitened_selection)) >= BEYOND_DOUBT_GAP and own.held_out < PREDICTED
    return own if is_clear and (is_poor or own.unexplained < EXACT) else None


def estimate_with_offsets(samples: Samples, n_constraints: int | None, rng: np.random.Generator) -> Estimate:
    """Lambda where each demonstrator rests in a posture of their own: pi(q) = Theta^T (q, 1) + c_trajectory.

    The number of rows is found by leaving out samples, and not trajectories, whose constants would be unknown.

    Raises:
        NotIdentifiableError: Too few samples per trajectory.
    """
    few, needed = _few_trajectories(samples)
    if len(few) < needed:
        raise NotIdentifiableError(
            f"{len(samples)} samples of {samples.n_trajectories} trajectories are too few for a policy with an "
            f"offset for each trajectory: about {2 * samples.nv * (1 + samples.nv)} samples per trajectory are needed",
            code="too-few-samples",
        )
    fits = {s: _search_from_starts(few, s, rng) for s in range(min(samples.n_rows, samples.nv - 1) + 1)}
    held_out = {s: _held_out_samples(few, fit.whitened_selection, fit.model) for s, fit in fits.items()}
    residuals = {s: float(np.sqrt(c / (samples.nv - s))) for s, c in held_out.items()}
    table = gaps_of_residuals(residuals, 1e-15 * float(np.sqrt(samples.energy)), len(few))
    s = n_constraints or table.best
    fit = fit_joint(samples, fits[s].whitened_selection, _offset_model(samples))
    share = held_out[s] / fits[s].energy
    scored = ScoredFit(fit.whitened_selection, *scores(samples, fit))
    return _estimate(samples, fit, scored, table, {fit.model.name: share}, held_out[s], share)


def _few_trajectories(samples: Samples) -> tuple[Samples, int]:
    """What the search with offsets looks at, and how many samples it needs: two for each parameter."""
    few = samples.subset(samples.trajectory < FEW).thinned(FEW_SAMPLES)
    return few, 2 * few.nv * _offset_model(few).n_terms


def _offset_model(samples: Samples) -> TrajectoryOffsetModel:
    return TrajectoryOffsetModel(PolynomialModel(1, samples.q.shape[1]), samples.n_trajectories)


def _held_out_samples(samples: Samples, Lambda: Float[np.ndarray, "s r"], model: PolicyModel) -> float:
    """Mean of |Z^T (u - pi)|^2 on samples that pi was not fitted to."""
    return float(held_out_costs(samples, Lambda, model, N_FOLDS, by_sample=True).sum())


def _search_from_starts(samples: Samples, s: int, rng: np.random.Generator) -> JointFit:
    """The best fit from a closed-form start and many random ones, in rounds of which the best go on."""
    model, r = _offset_model(samples), samples.n_rows
    starts = [conditional_pca(samples, PolynomialModel(1, samples.q.shape[1]))[1][:s]]
    if s in (0, r):
        return fit_joint(samples, starts[0], model)
    best, idle = None, 0
    while best is None or (idle < IDLE_ROUNDS and not best.leaves_only(ROUNDING)):
        starts += [rng.standard_normal((s, r)) for _ in range(STARTS - len(starts))]
        looks = sorted((fit_joint(samples, start, model, **LOOK) for start in starts), key=lambda fit: fit.cost)
        begin = [look.whitened_selection for look in looks[:REFINED]]
        trial = best_of_starts(samples, model, begin, lambda fit: fit.leaves_only(ROUNDING))
        idle = 0 if best is None or trial.cost < 0.9 * best.cost else idle + 1
        best, starts = trial if best is None or trial.cost < best.cost else best, []
    return best


def _list_models(samples: Samples, rng: np.random.Generator, name: str) -> list[PolicyModel]:
    """Models in the order of their size; quadratic stands in for the others in the search for the number of rows."""
    m = samples.q.shape[1]
    if name == "rbf":
        return [RadialModel(samples.x, RADIAL_CENTRES, rng)]
    if name != "auto":
        if name not in PolynomialModel.NAMES:
            raise NotIdentifiableError(
                f"unknown policy model {name!r}: use 'auto', 'rbf', 'affine-offset' or one of "
                f"{', '.join(PolynomialModel.NAMES)}",
                code="policy-model",
            )
        return [PolynomialModel(PolynomialModel.NAMES.index(name), m)]
    models: list[PolicyModel] = [
        *(PolynomialModel(degree, m) for degree in range(1, 6)),
        HarmonicModel(samples.spread, 1),
        HarmonicModel(samples.spread, 2),
        RadialModel(samples.x, RADIAL_CENTRES, rng),
    ]
    models.sort(key=lambda model: model.n_terms)
    return [models[0]] + [model for model in models[1:] if model.n_terms * samples.nv <= MAX_COLUMNS]


def _fit_whitened(samples: Samples, fit: JointFit) -> tuple[Samples, JointFit]:
    """The fit by generalised least squares where the noise is not the same in all joints, and its samples."""
    if fit.leaves_only(ROUNDING):
        return samples, fit
    for _ in range(2):
        left = samples.u - fit.model(samples.x, samples.trajectory) @ fit.theta
        L = whitening_factor(samples, fit.whitened_selection, left)
        if L is None:
            break
        samples = whitened(samples, L)
        fit = fit_joint(samples, fit.whitened_selection, fit.model)
    return samples, fit


def _fit_from_random_starts(samples: Samples, chosen: JointFit, rng: np.random.Generator) -> JointFit:
    """The chosen fit on all samples, and a look from random starts whether there is a better one."""
    best = fit_joint(samples, chosen.whitened_selection, chosen.model)
    s, r = best.whitened_selection.shape
    if s == r or best.leaves_only(ROUNDING):
        return best
    few = samples.thinned(COMPARE_LIMIT)
    reference = best.cost
    if few is not samples:
        reference = fit_joint(few, best.whitened_selection, chosen.model, **COMPARE).cost
    for _ in range(RANDOM_STARTS):
        start: Float[np.ndarray, "s r"] = rng.standard_normal((s, r))
        other = fit_joint(few, start, chosen.model, **COMPARE)
        if other.cost < 0.9 * reference:
            best, reference = fit_joint(samples, other.whitened_selection, chosen.model), other.cost
    return best
