"""The estimator for self-imposed demonstrations: Lambda and pi together from raw (q, u), b unknown."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.estimators.estimate import Estimate
from manip_learn.learning.estimators.joint_fit import JointFit
from manip_learn.learning.estimators.model_search import (
    COMPARE,
    POOR,
    ROUNDING,
    CrossValidatedFit,
    null_energy,
    search_model,
)
from manip_learn.learning.estimators.noise_covariance import whitened, whitening_factor
from manip_learn.learning.estimators.per_trajectory_offsets import estimate_with_offsets, offsets_if_clear
from manip_learn.learning.estimators.policy_model import HarmonicModel, PolicyModel, PolynomialModel, RadialModel
from manip_learn.learning.estimators.policy_prior import ScoredFit, fit_marginal
from manip_learn.learning.estimators.row_count import count_rows
from manip_learn.learning.estimators.variable_projection import fit_joint, scores
from manip_learn.learning.samples import Samples

# share of the motion that is rounding
EXACT = 1e-16
N_CENTRES = 32
RANDOM_STARTS = 2
# models are compared on at most this many samples, and fitted with at most this many columns unless asked for
COMPARE_LIMIT = 1_500
MAX_COLUMNS = 260
# share of the energy below which a residual is rounding
NOTHING = 1e-20
# share of the energy above which a residual is noise that hides a part of the policy
NOISY = 1e-10


def estimate_joint(
    samples: Samples,
    n_constraints: int | None,
    rng: np.random.Generator,
    policy_model: str = "auto",
    unexplained: float = np.inf,
    *,
    isotropic: bool = False,
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
        isotropic: Take the noise as equally strong in all joints, whatever the residual says, and fit the selected
            model alone: for a fit that goes on.

    Raises:
        NotIdentifiableError: One trajectory only, too few samples for even the smallest model, or given up.
    """
    if samples.n_trajectories < 2:
        raise NotIdentifiableError(
            "one trajectory does not identify a constraint whose task velocity is unknown: give several, from "
            "different starts to different targets",
            code="one-trajectory",
        )
    if policy_model == "affine-offset":
        return estimate_with_offsets(samples, n_constraints, rng)
    few = _subsample(samples)
    models = _list_models(few, rng, policy_model)
    counted = count_rows(few, models, rng)
    usable = {} if counted is None else counted.fits
    if counted is None or len(usable) < 2 or (n_constraints is not None and n_constraints not in usable):
        raise NotIdentifiableError(
            f"{len(samples)} samples are too few for the joint estimator on {samples.n_rows} rows and {samples.nv} "
            "joints: record more trajectories, or name fewer axes",
            code="too-few-samples",
        )
    table = counted.table
    if n_constraints is None and table.best == 0:
        raise NotIdentifiableError(
            "a policy of the posture alone explains the motion: nothing in it is steered on purpose, or too few "
            "trajectories show what is; record more, from other starts to other targets",
            code="no-task",
        )
    doubts = () if n_constraints is not None else counted.warnings
    s = n_constraints or table.best
    chosen, residuals = search_model(few, s, models, usable[s])
    is_poor = chosen.held_out > POOR * null_energy(samples, chosen.fit)
    # rich models come close to separate rest postures, which alone are exact then
    is_close = usable[s].held_out > POOR * null_energy(samples, usable[s].fit) and not _is_exact(chosen.fit)
    if policy_model == "auto" and (is_poor or is_close) and not _is_exact(usable[s].fit):
        own = offsets_if_clear(samples, n_constraints, rng, chosen.fit.whitened_selection)
        if own is not None and (is_poor or own.unexplained < EXACT):
            return own
    if chosen.held_out > unexplained * null_energy(samples, chosen.fit):
        raise NotIdentifiableError("no policy model predicts this motion", code="unexplained")
    own_samples, fit, scored = _fit_all(samples, chosen, rng, is_start=isotropic, is_free=policy_model == "auto")
    return Estimate(
        "joint",
        scored.whitened_selection,
        table,
        fit.cost / null_energy(own_samples, fit),
        chosen.held_out / null_energy(samples, chosen.fit),
        scored.gradients,
        scored.hessians,
        fit.model.name,
        residuals,
        noise=chosen.held_out / (samples.nv - s),
        warnings=doubts,
        joint=fit,
        prior=scored.prior,
    )


def _is_exact(fit: JointFit) -> bool:
    """Whether rounding is all that the policy model leaves of the motion."""
    return fit.cost <= EXACT * fit.energy


def _fit_all(
    samples: Samples, chosen: CrossValidatedFit, rng: np.random.Generator, *, is_start: bool, is_free: bool
) -> tuple[Samples, JointFit, ScoredFit]:
    """The selected model fitted to all samples, these weighted where needed; and Lambda without a fixed model.

    Args:
        samples: What was recorded.
        chosen: The selected model.
        rng: For the random starts.
        is_start: The fit goes on elsewhere, with equal weights and with this model.
        is_free: The model was not asked for.
    """
    fit = _fit_from_random_starts(samples, chosen.fit, rng)
    # the residual is noise, and has its covariance, only where the policy model explains the motion
    if not is_start and chosen.held_out <= POOR * null_energy(samples, chosen.fit):
        samples, fit = _fit_whitened(samples, fit)
        if is_free and _is_noisy(fit):
            return samples, fit, fit_marginal(samples, fit, MAX_COLUMNS)
    return samples, fit, ScoredFit(fit.whitened_selection, *scores(samples, fit))


def _is_noisy(fit: JointFit) -> bool:
    """Whether normal equations resolve what is left of the motion."""
    return 0 < len(fit.whitened_selection) < fit.whitened_selection.shape[1] and fit.cost > NOISY * fit.energy


def _subsample(samples: Samples) -> Samples:
    """Every k-th sample of all trajectories, for the comparisons."""
    if len(samples) <= COMPARE_LIMIT:
        return samples
    step = -(-len(samples) // COMPARE_LIMIT)
    return samples.subset(np.arange(len(samples)) % step == 0)


def _list_models(samples: Samples, rng: np.random.Generator, name: str) -> list[PolicyModel]:
    """Models in the order of their size; quadratic stands in for the others in the search for the number of rows."""
    m = samples.q.shape[1]
    if name == "rbf":
        return [_make_radial(samples, rng)]
    if name != "auto":
        if name not in PolynomialModel.NAMES:
            raise NotIdentifiableError(
                f"unknown policy model {name!r}: use 'auto', 'rbf', 'affine-offset' or one of "
                f"{', '.join(PolynomialModel.NAMES)}",
                code="policy-model",
            )
        return [PolynomialModel(PolynomialModel.NAMES.index(name), m)]
    models: list[PolicyModel] = [PolynomialModel(degree, m) for degree in range(1, 6)]
    models += [HarmonicModel(samples.spread, 1), HarmonicModel(samples.spread, 2), _make_radial(samples, rng)]
    models.sort(key=lambda model: model.n_terms)
    return [models[0]] + [model for model in models[1:] if model.n_terms * samples.nv <= MAX_COLUMNS]


def _make_radial(samples: Samples, rng: np.random.Generator) -> RadialModel:
    return RadialModel(np.concatenate([b.x for b in samples.blocks()]), N_CENTRES, rng)


def _fit_whitened(samples: Samples, fit: JointFit) -> tuple[Samples, JointFit]:
    """The fit by generalised least squares where the noise is not the same in all joints, and its samples."""
    if fit.cost <= ROUNDING * fit.energy:
        return samples, fit
    for _ in range(2):
        pi = np.concatenate([fit.model(block.x, block.trajectory) for block in samples.blocks()]) @ fit.theta
        L = whitening_factor(samples, fit.whitened_selection, samples.u - pi)
        if L is None:
            break
        samples = whitened(samples, L)
        fit = fit_joint(samples, fit.whitened_selection, fit.model)
    return samples, fit


def _fit_from_random_starts(samples: Samples, chosen: JointFit, rng: np.random.Generator) -> JointFit:
    """The chosen fit on all samples, and a look from random starts whether there is a better one."""
    best = fit_joint(samples, chosen.whitened_selection, chosen.model)
    s, r = best.whitened_selection.shape
    if s == r or best.cost <= ROUNDING * best.energy:
        return best
    few = _subsample(samples)
    reference = best.cost
    if few is not samples:
        reference = fit_joint(few, best.whitened_selection, chosen.model, **COMPARE).cost
    for _ in range(RANDOM_STARTS):
        start: Float[np.ndarray, "s r"] = rng.standard_normal((s, r))
        other = fit_joint(few, start, chosen.model, **COMPARE)
        if other.cost < 0.9 * reference:
            best, reference = fit_joint(samples, other.whitened_selection, chosen.model), other.cost
    return best
