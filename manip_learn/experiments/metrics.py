"""Error measures of a learnt constraint and of its policy."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap

Manipulabilities = Float[np.ndarray, " n"]  # mu of the true or of the learnt constraint, at the same n configurations


def manipulability_along(features: FeatureMap, Lambda: np.ndarray, q: np.ndarray) -> Manipulabilities:
    """Return the manipulability mu(q) = sqrt(det(A A^T)) with A = Lambda Phi(q) at n configurations.

    Equation (4) of Manavalan and Howard, computed as the product of the singular values of A.

    Args:
        features: Feature map Phi with p rows.
        Lambda: Selection matrix (s, p).
        q: Configurations (n, nq) [rad or m].

    Returns:
        mu, shape (n,); its unit is the product of the units of the constraint's rows.
    """
    return np.prod(np.linalg.svd(Lambda @ features.batch(q), compute_uv=False), axis=1)


def mie(mu: Manipulabilities, learnt: Manipulabilities) -> float:
    """Return the manipulability index error (MIE): the mean square difference of two manipulabilities.

    Args:
        mu: Manipulability of the true constraint (n,).
        learnt: Manipulability of the learnt constraint at the same configurations (n,).

    Returns:
        MIE, in the unit of mu squared.
    """
    return float(np.mean((mu - learnt) ** 2))


def nmie(mu: Manipulabilities, learnt: Manipulabilities) -> float:
    """Return the normalised manipulability index error (NMIE): the MIE divided by the variance of the true mu.

    Args:
        mu: Manipulability of the true constraint (n,).
        learnt: Manipulability of the learnt constraint at the same configurations (n,).

    Returns:
        NMIE: 0 if the two are equal, 1 if `learnt` is the mean of `mu` everywhere.
    """
    return float(mie(mu, learnt) / np.var(mu))


def scale_free_nmie(mu: Manipulabilities, learnt: Manipulabilities) -> float:
    """Return the NMIE of the learnt manipulability multiplied by the best constant factor, mu^T learnt / |learnt|^2.

    A constant factor does not change the direction of the gradient of the manipulability.

    Args:
        mu: Manipulability of the true constraint (n,).
        learnt: Manipulability of the learnt constraint at the same configurations (n,).
    """
    factor = float(mu @ learnt) / max(float(learnt @ learnt), np.finfo(np.float64).tiny)
    return nmie(mu, factor * learnt)


def policy_rmse(pi: Float[np.ndarray, "m T nv"], learnt: Float[np.ndarray, "m T nv"]) -> Float[np.ndarray, " m"]:
    """Return the root mean square difference of two policies along each of m trajectories.

    It is the root of the mean over time of the squared length of the difference vector.

    Args:
        pi: Velocities of the true policy (m, T, nv) [rad/s or m/s], or the positions to which it leads [rad or m].
        learnt: Velocities or positions of the learnt policy, with the same shape and unit.

    Returns:
        RMSE (m,), in the unit of `pi`.
    """
    return np.sqrt(np.mean(np.sum((learnt - pi) ** 2, axis=-1), axis=-1))
