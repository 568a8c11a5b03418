"""Errors by which a learnt constraint and its policy are judged."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap

Manipulabilities = Float[np.ndarray, " n"]  # of the true constraint, or of the learnt one, at the same n postures


def manipulability_along(features: FeatureMap, Lambda: np.ndarray, q: np.ndarray) -> Manipulabilities:
    """Return mu(q) = sqrt(det(A A^T)) at postures q (n, nq), A = Lambda Phi(q); equation (4) of Manavalan and Howard.

    Computed as the product of the singular values of A. Unit: product of the units of the constraint's rows.
    """
    return np.prod(np.linalg.svd(Lambda @ features.batch(q), compute_uv=False), axis=1)


def mie(mu: Manipulabilities, learnt: Manipulabilities) -> float:
    """Return the manipulability index error, MIE = 1/n sum_i (mu_i - mu~_i)^2, in the unit of mu squared."""
    return float(np.mean((mu - learnt) ** 2))


def nmie(mu: Manipulabilities, learnt: Manipulabilities) -> float:
    """Return the normalised manipulability index error, NMIE = MIE / var(mu); 1 for the best constant mu~."""
    return float(mie(mu, learnt) / np.var(mu))


def scale_free_nmie(mu: Manipulabilities, learnt: Manipulabilities) -> float:
    """Return the NMIE after the best single factor on mu~: the direction of grad mu does not depend on that factor.

    min_c 1/(n var(mu)) sum_i (mu_i - c mu~_i)^2,  c = mu^T mu~ / |mu~|^2
    """
    factor = float(mu @ learnt) / max(float(learnt @ learnt), np.finfo(np.float64).tiny)
    return nmie(mu, factor * learnt)


def policy_rmse(pi: Float[np.ndarray, "m T nv"], learnt: Float[np.ndarray, "m T nv"]) -> Float[np.ndarray, " m"]:
    """Return the RMS difference of two policies along m trajectories, e.g. of pi_mu = grad mu, equation (13).

    RMSE = sqrt(1/T sum_t |pi_t - pi~_t|^2), a value per trajectory, in the unit of the policies: velocities
    [rad/s or m/s], or the postures that they lead to.
    """
    return np.sqrt(np.mean(np.sum((learnt - pi) ** 2, axis=-1), axis=-1))
