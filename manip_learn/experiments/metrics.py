"""Error measures of a learnt constraint and of its policy."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap

Manipulabilities = Float[np.ndarray, " n"]  # mu of the true or of the learnt constraint, at the same n configurations


def manipulability_along(features: FeatureMap, Lambda: np.ndarray, q: np.ndarray) -> Manipulabilities:
    """Return mu(q) = sqrt(det(A A^T)), A = Lambda Phi(q), (n,); equation (4) of Manavalan and Howard.

    It is computed as the product of the singular values of A. Unit: product of the units of the constraint's rows.

    Args:
        features: Phi, with p rows.
        Lambda: Selection (s, p).
        q: Configurations (n, nq).
    """
    return np.prod(np.linalg.svd(Lambda @ features.batch(q), compute_uv=False), axis=1)


def mie(mu: Manipulabilities, learnt: Manipulabilities) -> float:
    """Return the manipulability index error, MIE = 1/n sum_i (mu_i - mu~_i)^2, in the unit of mu squared.

    Args:
        mu: Manipulability of the true constraint (n,).
        learnt: Manipulability mu~ of the learnt constraint at the same configurations (n,).
    """
    return float(np.mean((mu - learnt) ** 2))


def nmie(mu: Manipulabilities, learnt: Manipulabilities) -> float:
    """Return the normalised manipulability index error, NMIE = MIE / var(mu); 1 for the best constant mu~.

    Args:
        mu: Manipulability of the true constraint (n,).
        learnt: Manipulability mu~ of the learnt constraint at the same configurations (n,).
    """
    return float(mie(mu, learnt) / np.var(mu))


def scale_free_nmie(mu: Manipulabilities, learnt: Manipulabilities) -> float:
    """Return the NMIE after the best single factor on mu~: the direction of grad mu does not depend on that factor.

    min_c 1/(n var(mu)) sum_i (mu_i - c mu~_i)^2,  c = mu^T mu~ / |mu~|^2

    Args:
        mu: Manipulability of the true constraint (n,).
        learnt: Manipulability mu~ of the learnt constraint at the same configurations (n,).
    """
    factor = float(mu @ learnt) / max(float(learnt @ learnt), np.finfo(np.float64).tiny)
    return nmie(mu, factor * learnt)


def policy_rmse(pi: Float[np.ndarray, "m T nv"], learnt: Float[np.ndarray, "m T nv"]) -> Float[np.ndarray, " m"]:
    """Return the RMS difference (m,) of two policies along m trajectories, e.g. of pi_mu = grad mu, equation (13).

    RMSE = sqrt(1/T sum_t |pi_t - pi~_t|^2), one value per trajectory, in the unit of the policies.

    Args:
        pi: Velocities of the true policy (m, T, nv) [rad/s or m/s], or the positions that it leads to [rad or m].
        learnt: Velocities or positions of the learnt policy, likewise.
    """
    return np.sqrt(np.mean(np.sum((learnt - pi) ** 2, axis=-1), axis=-1))
