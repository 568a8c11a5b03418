"""Joint estimation where each demonstrator rests in a posture of their own: pi(q) = Theta^T (q, 1) + c_trajectory.

An offset per trajectory makes the cost bumpy: the search begins from many starts on a few trajectories, and the best
goes on with all of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.estimators.conditional_pca import conditional_pca
from manip_learn.learning.estimators.estimate import Estimate, gaps_of_residuals
from manip_learn.learning.estimators.joint_fit import JointFit
from manip_learn.learning.estimators.policy_model import PolynomialModel, TrajectoryOffsetModel
from manip_learn.learning.estimators.variable_projection import fit_joint, held_out_cost, scores
from manip_learn.learning.samples import Samples

FEW = 16  # trajectories on which the starts are compared
FEW_SAMPLES = 600
STARTS = 20
IDLE_ROUNDS = 2  # so many rounds of starts without anything better end the search
REFINED = 8
LOOK: dict[str, Any] = {"max_iterations": 5, "gain": 1e-3}
ROUNDING = 1e-24
N_FOLDS = 5
# offsets must lower the cost by so much to be tried, and explain the motion so well to be believed unasked
HELPFUL, BEYOND_DOUBT, EXACT = 0.3, 30.0, 1e-3


def estimate_with_offsets(samples: Samples, n_constraints: int | None, rng: np.random.Generator) -> Estimate:
    """Lambda with an affine policy that has a constant of its own for each trajectory.

    Args:
        samples: What was recorded.
        n_constraints: Number of rows; by leaving out samples (not trajectories: their constants would be unknown).
        rng: For the starts.

    Raises:
        NotIdentifiableError: Too few samples per trajectory.
    """
    few = _subsample(samples)
    if len(few) < 2 * samples.nv * _make_model(few).n_terms:
        raise NotIdentifiableError(
            f"{len(samples)} samples of {samples.n_trajectories} trajectories are too few for a policy with an "
            f"offset for each trajectory: about {2 * samples.nv * (1 + samples.nv)} samples per trajectory are needed",
            code="too-few-samples",
        )
    counts = range(min(samples.n_rows, samples.nv - 1) + 1)
    fits = {s: _search_from_starts(few, s, rng) for s in counts}
    held_out = {s: held_out_cost(few, f.whitened_selection, f.model, N_FOLDS, by_sample=True) for s, f in fits.items()}
    residuals = {s: float(np.sqrt(c / (samples.nv - s))) for s, c in held_out.items()}
    table = gaps_of_residuals(residuals, 1e-15 * float(np.sqrt(samples.energy)), len(few))
    s = n_constraints or table.best
    fit = fit_joint(samples, fits[s].whitened_selection, _make_model(samples))
    gradients, hessians = scores(samples, fit)
    share = held_out[s] / fits[s].energy
    return Estimate(
        "joint",
        fit.whitened_selection,
        table,
        fit.cost / fit.energy,
        share,
        gradients,
        hessians,
        fit.model.name,
        {fit.model.name: share},
        noise=held_out[s] / (samples.nv - s),
    )


def offsets_if_clear(
    samples: Samples, n_constraints: int | None, rng: np.random.Generator, whitened_selection: Float[np.ndarray, "s r"]
) -> Estimate | None:
    """The same where it is worth a try and its answer beyond doubt; else None.

    Args:
        samples: What was recorded.
        n_constraints: Number of rows, or None.
        rng: For the starts.
        whitened_selection: What was learnt without offsets: if they do not help there, they are not tried.
    """
    few = _subsample(samples)
    shared = PolynomialModel(1, samples.q.shape[1])
    if len(few) < 2 * samples.nv * _make_model(few).n_terms:
        return None
    without, offsets = (
        held_out_cost(few, whitened_selection, model, N_FOLDS, by_sample=True) for model in (shared, _make_model(few))
    )
    if offsets > HELPFUL * without:
        return None
    estimate = estimate_with_offsets(samples, n_constraints, rng)
    s = estimate.whitened_selection.shape[0]
    return estimate if estimate.table.gap(s) >= BEYOND_DOUBT and estimate.held_out < EXACT else None


def _subsample(samples: Samples) -> Samples:
    every = -(-int(np.count_nonzero(samples.trajectory < FEW)) // FEW_SAMPLES)
    return samples.subset((samples.trajectory < FEW) & (np.arange(len(samples)) % every == 0))


def _make_model(samples: Samples) -> TrajectoryOffsetModel:
    return TrajectoryOffsetModel(PolynomialModel(1, samples.q.shape[1]), samples.n_trajectories)


def _search_from_starts(samples: Samples, s: int, rng: np.random.Generator) -> JointFit:
    model, r = _make_model(samples), samples.n_rows
    first = conditional_pca(samples, PolynomialModel(1, samples.q.shape[1]))[1][:s]
    if s in (0, r):
        return fit_joint(samples, first, model)
    best: JointFit | None = None
    idle, starts = 0, [first]
    while idle < IDLE_ROUNDS:
        starts += [rng.standard_normal((s, r)) for _ in range(STARTS - len(starts))]
        trial = _refine_best([fit_joint(samples, start, model, **LOOK) for start in starts], samples)
        idle = 0 if best is None or trial.cost < 0.9 * best.cost else idle + 1
        best = trial if best is None or trial.cost < best.cost else best
        if best.cost <= ROUNDING * best.energy:
            break
        starts = []
    return best if best is not None else fit_joint(samples, first, model)


def _refine_best(fits: list[JointFit], samples: Samples) -> JointFit:
    fits = sorted(fits, key=lambda fit: fit.cost)
    best = fits[0]
    for fit in fits[:REFINED]:
        best = min(best, fit_joint(samples, fit.whitened_selection, fit.model), key=lambda f: f.cost)
        if best.cost <= ROUNDING * best.energy:
            break
    return best
