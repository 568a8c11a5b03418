"""The estimator for self-imposed demonstrations: Lambda and pi together from raw (q, u), b unknown."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

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
from manip_learn.learning.estimators.noise_covariance import (
    UNEQUAL,
    noise_in_time,
    shape_in_time,
    whitened,
    whitening_factor,
)
from manip_learn.learning.estimators.per_trajectory_offsets import estimate_with_offsets, offsets_if_clear
from manip_learn.learning.estimators.policy_model import HarmonicModel, PolicyModel, PolynomialModel, RadialModel
from manip_learn.learning.estimators.policy_prior import ScoredFit, fit_marginal
from manip_learn.learning.estimators.row_count import ABOVE_NOISE, RowCount, count_rows
from manip_learn.learning.estimators.variable_projection import fit_joint, scores
from manip_learn.learning.samples import Samples

# share of the motion that is rounding
EXACT = 1e-16
N_CENTRES = 32
RANDOM_STARTS = 2
# models are compared on at most this many samples, and fitted with at most this many columns unless asked for
COMPARE_LIMIT = 1_500
MAX_COLUMNS = 260
# root mean square distance from a path over its extent within which a motion repeats it: replays with 3 % of another
# motion in them have 0.05 to 0.14, generated reaches in threes and more 0.32 and above (12, 192 sets, seeds from 30000)
SAME_PATH = 0.15
MOST_POSTURES = 2_000  # between the samples of a path, against noise that makes it long
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
        NotIdentifiableError: One trajectory or motion only, too few samples for even the smallest model, no task in
            them, or given up.
    """
    _check_trajectories(samples)
    if policy_model == "affine-offset":
        return estimate_with_offsets(samples, n_constraints, rng)
    few = _subsample(samples)
    models = _list_models(few, rng, policy_model)
    counted = _count(few, models, n_constraints, rng)
    weighted = samples
    L = _unequal_noise(samples, few, counted.fits[n_constraints or counted.table.best].fit)
    if L is not None:
        weighted, few = whitened(samples, L), whitened(few, L)
        counted = _count(few, models, n_constraints, rng)
    s = n_constraints or counted.table.best
    _check_task(s)
    first = counted.fits[s]
    chosen, residuals = search_model(few, s, models, first)
    if policy_model == "auto":
        own = _with_own_postures(weighted, n_constraints, first, chosen, rng)
        if own is not None:
            return own
    if chosen.held_out > unexplained * null_energy(weighted, chosen.fit):
        raise NotIdentifiableError("no policy model predicts this motion", code="unexplained")
    samples = samples if isotropic else weighted
    samples, fit, scored = _fit_all(samples, chosen, rng, is_start=isotropic, is_free=policy_model == "auto")
    return Estimate(
        "joint",
        scored.whitened_selection,
        counted.table,
        fit.cost / null_energy(samples, fit),
        chosen.held_out / null_energy(weighted, chosen.fit),
        scored.gradients,
        scored.hessians,
        fit.model.name,
        residuals,
        noise=chosen.held_out / (samples.nv - s),
        warnings=() if n_constraints is not None else counted.warnings,
        joint=fit,
        prior=scored.prior,
    )


def _check_trajectories(samples: Samples) -> None:
    """Refuse what shows the task once only.

    Raises:
        NotIdentifiableError: One trajectory, or one motion several times.
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


def _repeat_one_motion(samples: Samples) -> bool:
    """Whether all trajectories lie on the path of the longest one, whatever their time, direction and rate."""
    starts = np.flatnonzero(np.diff(samples.trajectory, prepend=-1)).tolist()
    paths = [samples.q[a:b] for a, b in zip(starts, [*starts[1:], len(samples)], strict=True)]
    extents = [float(np.sum(np.var(path, axis=0))) ** 0.5 for path in paths]
    most = SAME_PATH * max(extents)
    tree = cKDTree(_densely(paths[int(np.argmax(extents))], most))
    return all(float(np.mean(tree.query(path)[0] ** 2)) <= most**2 for path in paths)


def _densely(path: Float[np.ndarray, "t nq"], step: float) -> Float[np.ndarray, "k nq"]:
    """The path with so many postures between its samples that none are farther apart than a step [rad]."""
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    n = min(int(along[-1] / step) + 1, MOST_POSTURES) if step > 0.0 else 0
    places = np.union1d(along, np.linspace(0.0, along[-1], n + 1))
    return np.column_stack([np.interp(places, along, column) for column in path.T])


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


def _check_task(s: int) -> None:
    """Refuse motion without rows.

    Raises:
        NotIdentifiableError: A policy explains all of it.
    """
    if s == 0:
        raise NotIdentifiableError(
            "a policy of the posture alone explains the motion: nothing in it is steered on purpose, or too few "
            "trajectories show what is; record more, from other starts to other targets",
            code="no-task",
        )


def _unequal_noise(samples: Samples, few: Samples, fit: JointFit) -> Float[np.ndarray, "nv nv"] | None:
    """Factor of the covariance of noise that is stronger in some joints than in others; None where it is not.

    Equal weights draw Lambda to where its null space is least noisy, so far with strong noise (32 degrees at 10 %, each
    joint in proportion to its motion) that the residual shows nothing of the covariance: it is seen in time, and
    believed where weights by it leave as much noise as is seen.
    """
    S = shape_in_time(samples)
    if S is None or np.linalg.cond(S) < UNEQUAL or fit.cost <= NOISY * fit.energy:
        return None
    L = np.linalg.cholesky(S)
    weighted = whitened(few, L)
    again = fit_joint(weighted, fit.whitened_selection, fit.model, **COMPARE)
    left = again.cost / (samples.nv - len(again.whitened_selection)) / noise_in_time(whitened(samples, L))
    return L if 1.0 / ABOVE_NOISE < left < ABOVE_NOISE else None


def _without_policy(samples: Samples, fit: JointFit) -> Float[np.ndarray, "n nv"]:
    """u - pi."""
    return samples.u - np.concatenate([fit.model(b.x, b.trajectory) for b in samples.blocks()]) @ fit.theta


def _with_own_postures(
    samples: Samples,
    n_constraints: int | None,
    first: CrossValidatedFit,
    chosen: CrossValidatedFit,
    rng: np.random.Generator,
) -> Estimate | None:
    """The estimate with a rest posture for each trajectory, where a shared policy explains the motion poorly.

    Args:
        samples: What was recorded.
        n_constraints: As asked for.
        first: The fit that gave the number of rows.
        chosen: The fit with the selected policy model.
        rng: For the starts.
    """
    if _is_exact(first.fit):
        return None
    is_poor = chosen.held_out > POOR * null_energy(samples, chosen.fit)
    # rich models come close to separate rest postures, which alone are exact then
    is_close = first.held_out > POOR * null_energy(samples, first.fit) and not _is_exact(chosen.fit)
    if not (is_poor or is_close):
        return None
    own = offsets_if_clear(samples, n_constraints, rng, chosen.fit.whitened_selection)
    return own if own is not None and (is_poor or own.unexplained < EXACT) else None


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
        L = whitening_factor(samples, fit.whitened_selection, _without_policy(samples, fit))
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
