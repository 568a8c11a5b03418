"""Noise of the joint velocities that is stronger in some joints than in others, in the joint estimator.

With cov e = Sigma = L L^T the residuals Z^T (u - pi), Z = null(A), have the covariance Z^T Sigma Z. Since L^T Z spans
the null space of A L^-T, they are, whitened, the residuals of the isotropic case on L^-1 u, Phi L^-T and L^-1 pi, which
is as linear in its parameters as pi: generalised least squares without a new estimator.
"""

from __future__ import annotations

import dataclasses
import math
from statistics import NormalDist

import numpy as np
from jaxtyping import Float

from manip_learn.learning.deciding import BEYOND_CHANCE, CUBIC, NOISE_RANGE, RESIDUALS_PER_ENTRY, UNEQUAL_NOISE
from manip_learn.learning.estimators.policy_equations import Projections
from manip_learn.learning.samples import Samples

# weight of the isotropic covariance in samples per sample, for entries that the null spaces hardly show
PRIOR = 1e-3
DIFFERENCES = CUBIC - 1  # of neighbouring samples: motion that is a parabola over four samples leaves nothing
MEDIAN = NormalDist().inv_cdf(0.75)  # of the absolute value of a standard normal variable
TYLER_STEPS = 10


def whitening_factor(
    samples: Samples, whitened_selection: Float[np.ndarray, "s r"], y: Float[np.ndarray, "n nv"]
) -> Float[np.ndarray, "nv nv"] | None:
    """L with L L^T the covariance of the noise over its mean variance; None where it is nearly isotropic.

    Args:
        samples: What was recorded.
        whitened_selection: Lambda in whitened coordinates.
        y: u - pi of each sample.
    """
    N, nv = Projections.of(samples, whitened_selection).N, samples.nv
    z, entries = nv - len(whitened_selection), nv * (nv + 1) // 2
    e = np.einsum("nij,nj->ni", N, y, optimize=True)
    if len(y) * z < RESIDUALS_PER_ENTRY * entries or float(np.sum(e**2)) <= 0.0:
        return None
    sigma2 = float(np.sum(e**2)) / (len(y) * z)
    Sigma = _covariance(N, e / np.sqrt(sigma2))
    if np.linalg.cond(Sigma) < UNEQUAL_NOISE:
        return None
    gain = _log_likelihood_ratio(N, e / np.sqrt(sigma2), Sigma, z)
    if gain < entries + BEYOND_CHANCE * np.sqrt(2.0 * entries):
        return None
    return np.linalg.cholesky(Sigma * nv / np.trace(Sigma))


def shape_in_time(samples: Samples) -> Float[np.ndarray, "nv nv"] | None:
    """Covariance over its mean variance of what in u is no smooth motion; None for too few neighbouring samples.

    Whatever moves the arm, policy or task, moves it smoothly, and noise does not: differences of neighbouring samples
    show it without any model. Bursts at singular postures have their direction, not their length, in it (Tyler, 1987,
    Annals of Statistics 15(1): the shape S with mean e e^T / (e^T S^-1 e) = S / nv).
    """
    e, nv = _differences(samples), samples.nv
    e = e[np.any(e != 0.0, axis=1)]
    if len(e) < RESIDUALS_PER_ENTRY * nv:
        return None
    S = np.eye(nv)
    for _ in range(TYLER_STEPS):
        length = np.einsum("ni,ni->n", e, np.linalg.solve(S, e.T).T)
        S = (e / length[:, None]).T @ e
        S *= nv / np.trace(S)
    return S


def noise_in_time(samples: Samples) -> float:
    """Variance of the same, the mean over the joints; bursts do not count [(rad/s)^2]."""
    e = _differences(samples)
    return float(np.mean((np.median(np.abs(e), axis=0) / MEDIAN) ** 2)) if len(e) else 0.0


def _differences(samples: Samples) -> Float[np.ndarray, "k nv"]:
    """Of neighbouring samples of a trajectory, with the variance of white noise."""
    inside = samples.trajectory[DIFFERENCES:] == samples.trajectory[:-DIFFERENCES]
    return np.diff(samples.u, DIFFERENCES, axis=0)[inside] / np.sqrt(math.comb(2 * DIFFERENCES, DIFFERENCES))


def whitened(samples: Samples, L: Float[np.ndarray, "nv nv"]) -> Samples:
    """The samples as L^-1 u and Phi L^-T: for the joint estimator only, A u = 0 does not hold for these."""
    back = np.linalg.inv(L)
    mixing = back.T if samples.mixing is None else samples.mixing @ back.T
    return dataclasses.replace(samples, u=samples.u @ back.T, mixing=mixing)


def _covariance(N: np.ndarray, e: np.ndarray) -> Float[np.ndarray, "nv nv"]:
    """Least squares of e e^T = N Sigma N over all samples, drawn to the unit matrix where they say nothing."""
    n, nv = e.shape
    M = np.einsum("nij,nkl->ikjl", N, N, optimize=True).reshape(nv * nv, nv * nv) / n
    right = (e.T @ e / n).reshape(-1) - M @ np.eye(nv).reshape(-1)
    deviation = np.linalg.solve(M + PRIOR * np.eye(nv * nv), right).reshape(nv, nv)
    values, vectors = np.linalg.eigh(np.eye(nv) + 0.5 * (deviation + deviation.T))
    return (vectors * np.clip(values, *NOISE_RANGE)) @ vectors.T


def _log_likelihood_ratio(N: np.ndarray, e: np.ndarray, Sigma: np.ndarray, z: int) -> float:
    """Twice the gain in log-likelihood of Z^T Sigma Z over the unit matrix."""
    # N Sigma N + (I - N) has the eigenvalues of Z^T Sigma Z, and ones
    whole = N @ Sigma @ N + (np.eye(len(Sigma)) - N)
    _, log_determinants = np.linalg.slogdet(whole)
    quadratic = np.einsum("ni,ni->", e, np.linalg.solve(whole, e[:, :, None])[:, :, 0])
    return float(np.sum(e**2) - quadratic - np.sum(log_determinants))
