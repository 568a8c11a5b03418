"""A closed-form start for the joint estimator: which directions of g vary beyond what the posture explains."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh

from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.samples import Samples


def conditional_pca(samples: Samples, model: PolicyModel) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r r"]]:
    """Directions of whitened feature space by how much the task moved along them, most first.

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
        g, GG, weight = _minimal_features(block.Phi, block.u)
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


def _minimal_features(Phi: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """g, (Phi Phi^T)^-1 and a weight for each sample: near-singular postures count little."""
    gram = np.einsum("npv,nqv->npq", Phi, Phi, optimize=True)
    trace = np.einsum("npp->n", gram)[:, None, None]
    if Phi.shape[1] <= Phi.shape[2]:
        inverse = np.linalg.inv(gram + 1e-13 * trace * np.eye(Phi.shape[1]))
    else:
        inverse = np.linalg.pinv(gram, rcond=1e-10, hermitian=True)
    g = np.einsum("npq,nqv,nv->np", inverse, Phi, u, optimize=True)
    weight = 1.0 / np.maximum(np.einsum("npp->n", inverse), np.finfo(np.float64).tiny)
    return g, inverse, weight
