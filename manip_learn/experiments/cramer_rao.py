"""How well Lambda can be known at all: the Cramer-Rao bound, and the NMIE that it implies.

The model of the noisy experiments: recorded u_n = A_n^+ b_n + N_n pi(q_n) + e_n with e_n ~ N(0, Sigma), A_n = Lambda
Phi(q_n) and pi(q) = Theta^T beta(q). Every b_n and Theta are unknown; the class beta of the policy is known, and so is
Sigma up to a factor. With L L^T = Sigma everything is written for L^-1 u, L^-1 pi and Phi L^-T. What an unknown b_n can
imitate is the row space of A_n, so that Z_n^T u_n, with Z_n the null basis of A_n, is all there is to learn from. For
dLambda = B Lambda_perp, B (s, p - s), y = (mean of u) - pi and K_n = d(Z_n^T pi) / dTheta,

    J_n,ij = -Z_n^T (Lambda_perp,j Phi_n)^T (A_n^{+T} y_n)_i,    J~ = (I - K K^+) J,    cov vec(B) >= (J~^T J~)^-1

for unbiased estimators: the inverse Fisher information of B with the nuisance parameters eliminated (Kay, Fundamentals
of Statistical Signal Processing: Estimation Theory, 1993, sections 3.7 and 3.9). One step of a Gauss-Newton method from
the truth would reach it if the error of Lambda were small; where the bound itself is not small, it is optimistic. Parts
of the policy that show nowhere (along the rows, at every posture) are taken as they truly are; to leave them open too
raises the bound by a few per cent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.linalg import complement_rows

UNSEEN = 1e-11  # share of the largest singular value below which a policy parameter shows nowhere
LEAST_INFORMATION = 1e-12  # of what the motion does not tell: an angle of 90 degrees
BLOCK = 20_000  # numbers of postures times draws that are worked on at once


@final
@dataclass(frozen=True, eq=False)
class NoiseFreeMotion:
    """The truth behind noisy samples.

    Attributes:
        features: Phi.
        selection: Lambda, orthonormal rows.
        q: Postures.
        u: Velocities without noise [rad/s].
        pi: The null-space policy at these postures [rad/s].
        beta: Regressors of the class that the policy is of, pi = Theta^T beta.
    """

    features: FeatureMap
    selection: Float[np.ndarray, "s p"]
    q: Float[np.ndarray, "n nq"]
    u: Float[np.ndarray, "n nv"]
    pi: Float[np.ndarray, "n nv"]
    beta: Float[np.ndarray, "n k"]


def affine_regressors(q: Float[np.ndarray, "n nq"]) -> Float[np.ndarray, "n k"]:
    """beta(q) = (1, q): the class of an attractor."""
    return np.concatenate([np.ones((len(q), 1)), q], axis=1)


def information(motion: NoiseFreeMotion, covariance: Float[np.ndarray, "nv nv"]) -> Float[np.ndarray, "m m"]:
    """Fisher information J~^T J~ of vec(B), B (s, p - s) row by row, the policy and every b_n unknown.

    Args:
        motion: The truth.
        covariance: Sigma of the noise on one sample of u [(rad/s)^2].
    """
    Lambda, back = motion.selection, np.linalg.inv(np.linalg.cholesky(covariance))
    # u has its task part in the range of A^T: the range of L^-1 A^T is that of (A L^-T)^T
    Phi = motion.features.batch(motion.q) @ back.T
    A = Lambda @ Phi
    Z = np.linalg.svd(A)[2][:, len(Lambda) :].transpose(0, 2, 1)
    task = np.einsum("nvs,nv->ns", np.linalg.pinv(A), (motion.u - motion.pi) @ back.T)
    F = np.einsum("nvz,kp,npv->nzk", Z, complement_rows(Lambda), Phi, optimize=True)
    J = -np.einsum("ns,nzk->nzsk", task, F).reshape(-1, task.shape[1] * F.shape[2])
    K = np.einsum("nk,nvz,vw->nzkw", motion.beta, Z, back, optimize=True).reshape(len(J), -1)
    rest = _beside(J, K)
    return rest.T @ rest


def _beside(J: Float[np.ndarray, "r m"], K: Float[np.ndarray, "r k"]) -> Float[np.ndarray, "r m"]:
    """(I - K K^+) J, twice for what rounding leaves."""
    K = K / np.maximum(np.linalg.norm(K, axis=0), np.finfo(np.float64).tiny)
    # by the singular values of K itself: reaches of 0.2 s hardly tell some parameters, and K^T K would lose these
    basis, values, _ = np.linalg.svd(K, full_matrices=False)
    basis = basis[:, values > UNSEEN * values[0]]
    for _ in range(2):
        J = J - basis @ (basis.T @ J)
    return J


def least_covariance(motion: NoiseFreeMotion, covariance: Float[np.ndarray, "nv nv"]) -> Float[np.ndarray, "m m"]:
    """Cramer-Rao bound on the covariance of vec(B); 1e12 where the motion does not tell at all.

    Args:
        motion: The truth.
        covariance: Sigma of the noise on one sample of u [(rad/s)^2].
    """
    values, vectors = np.linalg.eigh(information(motion, covariance))
    return (vectors / np.maximum(values, LEAST_INFORMATION)) @ vectors.T


def draw_selections(
    Lambda: Float[np.ndarray, "s p"], bound: Float[np.ndarray, "m m"], n: int, rng: np.random.Generator
) -> Float[np.ndarray, "n s p"]:
    """Answers of an estimator at the bound: orthonormal rows of Lambda + B Lambda_perp, B ~ N(0, bound)."""
    perp = complement_rows(Lambda)
    values, vectors = np.linalg.eigh(bound)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    B = (rng.standard_normal((n, len(bound))) @ root.T).reshape(n, len(Lambda), len(perp))
    return np.linalg.qr((Lambda + B @ perp).transpose(0, 2, 1))[0].transpose(0, 2, 1)


def implied_nmie(
    features: FeatureMap,
    Lambda: Float[np.ndarray, "s p"],
    learnt: Float[np.ndarray, "n s p"],
    q: Float[np.ndarray, "t nq"],
) -> Float[np.ndarray, " n"]:
    """NMIE at the postures q of many answers, NMIE = 1/(t var(mu)) sum (mu - mu~)^2 with mu = sqrt(det(A A^T)).

    Args:
        features: Phi.
        Lambda: The true one.
        learnt: Orthonormal rows of each answer, see `draw_selections`.
        q: Test postures.
    """
    Phi = features.batch(q)
    gram = Phi @ Phi.transpose(0, 2, 1)

    def mu(rows: Float[np.ndarray, "k s p"]) -> Float[np.ndarray, "k t"]:
        AAT = np.einsum("ksp,tpr,kvr->ktsv", rows, gram, rows, optimize=True)
        return np.sqrt(np.maximum(np.linalg.det(AAT), 0.0))

    true, step = mu(Lambda[None]), max(1, BLOCK // len(q))
    errors = [np.mean((mu(learnt[i : i + step]) - true) ** 2, axis=1) for i in range(0, len(learnt), step)]
    return np.concatenate(errors) / np.var(true)


def angle_of(bound: Float[np.ndarray, "m m"]) -> float:
    """Root of the trace of the bound as an angle [deg]: the least root mean square error of the row space."""
    return float(np.degrees(np.arctan(np.sqrt(max(float(np.trace(bound)), 0.0)))))
