"""The paper's own route: the null-space part of recorded motions, u = v + w -> w~(q), by consistency; then Lambda.

Towell, Howard and Vijayakumar (2010), equation (8) of Manavalan and Howard:

    min over the parameters of w~ of  sum_n ( w^_n . u_n - |w~_n| )^2,   w^ = w~ / |w~|

v is orthogonal to w, so that u shows the length of w along its direction, whatever the task did. A low cost does not
certify w~: w~ -> 0 costs nothing, and where the null space has more than one dimension so does any w~ on the sphere
over w in it. Such a w~ still serves to find Lambda, but it is no policy.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from manip_learn.errors import NotIdentifiableError, advice
from manip_learn.learning.estimate import Estimate, estimate_null_space
from manip_learn.learning.policy import radial
from manip_learn.learning.samples import STILL_ENERGY, Samples

# centres of the radial policy models, at least and at most. Set by hand
FEWEST_CENTRES, MOST_CENTRES = 4, 96
SAMPLES_PER_CENTRE = 10  # a rule of thumb of regression
_MAX_ITERATIONS = 200  # of each of the stages
# directions of the regressors' space below this share of the strongest take no part; from coarse to fine, for the
# descent from the regression alone ends in a poor minimum now and then
STAGES = (1e-6, 1e-8, 1e-10)
# relative decrease of the cost in a step below which to stop; the coarse stages only lead the way
NO_GAIN = (1e-3, 1e-3, 1e-6)
STALLED = 5  # steps of little gain in a row that end a stage
# the descent is dense in samples times parameters: 4,000 samples of 7 joints and 96 centres are 21 MB
SEPARATION_LIMIT = 4_000


def separate(beta: Float[np.ndarray, "n k"], u: Float[np.ndarray, "n nv"]) -> tuple[Float[np.ndarray, "k nv"], float]:
    """Weights of w~ = beta(x) weights, and the mean of (w^ . u - |w~|)^2 [(rad/s)^2].

    Levenberg-Marquardt from the regression of u on the posture; random starts end in poor minima now and then.
    """
    # orthonormal combinations of the regressors: the normal equations of wide radial functions are hopeless as they are
    basis, sigma, Vt = np.linalg.svd(beta, full_matrices=False)
    weights, cost = np.zeros((0, u.shape[1])), np.inf
    for share, no_gain in zip(STAGES, NO_GAIN, strict=True):
        k = int(np.count_nonzero(sigma > share * sigma[0]))
        if len(weights):
            start = np.concatenate([weights, np.zeros((k - len(weights), u.shape[1]))])
        else:
            start = basis[:, :k].T @ u  # the regression
        weights, cost = _descend(basis[:, :k], start, u, no_gain)
    k = len(weights)
    return (Vt[:k].T / sigma[:k]) @ weights, cost / len(u)


def _descend(basis: np.ndarray, weights: np.ndarray, u: np.ndarray, no_gain: float) -> tuple[np.ndarray, float]:
    residual, J = residual_and_jacobian(basis, weights, u)
    cost, damping, stalled = float(residual @ residual), 1e-3, 0
    for _ in range(_MAX_ITERATIONS):
        if stalled == STALLED or cost == 0.0:
            break
        H, g = J.T @ J, J.T @ residual
        scale = np.maximum(np.diag(H), 1e-12 * np.max(np.diag(H)))
        try:
            factor = cho_factor(H + damping * np.diag(scale), lower=True, check_finite=False)
        except LinAlgError:  # rounding has eaten a direction without curvature
            damping = max(damping * 100.0, 1e-8)
            continue
        step = -cho_solve(factor, g)
        moved = weights + step.reshape(weights.shape)
        trial, trial_J = residual_and_jacobian(basis, moved, u)
        trial_cost = float(trial @ trial)
        if trial_cost < cost:
            stalled = stalled + 1 if trial_cost > cost * (1.0 - no_gain) else 0
            weights, residual, J, cost, damping = moved, trial, trial_J, trial_cost, max(damping * 0.2, 1e-14)
        else:
            damping *= 5.0
            stalled = stalled + 1 if damping > 1e8 else stalled
    return weights, cost


def residual_and_jacobian(
    basis: Float[np.ndarray, "n k"], weights: Float[np.ndarray, "k nv"], u: Float[np.ndarray, "n nv"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n k*nv"]]:
    """e = w^ . u - |w~| and its derivative by the weights, row by row: d e / d w~ = (u - (w^ . u) w^) / |w~| - w^."""
    w = basis @ weights
    length = np.linalg.norm(w, axis=1)
    safe = np.maximum(length, np.finfo(np.float64).tiny ** 0.5)
    direction = w / safe[:, None]
    along = np.einsum("nv,nv->n", direction, u)
    slope = (u - along[:, None] * direction) / safe[:, None] - direction
    return along - length, (basis[:, :, None] * slope[:, None, :]).reshape(len(u), -1)


def estimate_separate(samples: Samples, n_constraints: int | None, rng: np.random.Generator) -> Estimate:
    """Separate u into task and null-space part, then learn Lambda from A w~ = 0, equation (10) of the paper.

    The number of rows is from the gap of the levels of w~ by default.

    Raises:
        NotIdentifiableError: Too few samples, or no null-space motion to be found.
    """
    null_motion, cost = separate_null_motion(samples, rng)
    name = f"rbf{_n_centres(samples)}"
    return dataclasses.replace(
        estimate_null_space(null_motion, n_constraints),
        name="separate",
        policy_model=name,
        policy_residuals={name: cost / samples.energy},
    )


def _n_centres(samples: Samples) -> int:
    return min(MOST_CENTRES, len(samples) // SAMPLES_PER_CENTRE)


def separate_null_motion(samples: Samples, rng: np.random.Generator) -> tuple[Samples, float]:
    """The samples with their null-space part w~ in place of u, and the cost of the separation [(rad/s)^2].

    Raises:
        NotIdentifiableError: Too few samples for even the smallest model, or no null-space motion to be found.
    """
    n_centres = _n_centres(samples)
    if n_centres < FEWEST_CENTRES:
        raise NotIdentifiableError(
            f"{len(samples)} samples are too few to separate task and null-space part: at least "
            f"{FEWEST_CENTRES * SAMPLES_PER_CENTRE} are needed, and many more are better",
            code="too-few-samples",
        )
    every = -(-len(samples) // SEPARATION_LIMIT)
    beta = radial(samples.x, n_centres, rng)(samples)
    weights, cost = separate(beta[::every], samples.u[::every])
    w = beta @ weights
    if float(np.mean(w**2)) * samples.nv < STILL_ENERGY * samples.energy:
        raise NotIdentifiableError(
            "the separation finds no null-space motion: what is left of the motion after the task is nothing to learn "
            "from" + advice("; use {}", "estimator='joint'", "--estimator joint"),
            code="no-null-motion",
        )
    return dataclasses.replace(samples, u=w), cost
