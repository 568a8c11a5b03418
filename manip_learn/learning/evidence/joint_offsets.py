"""Joint offsets: what a constant error of each joint's zero does to a Lambda learnt from A(q) u = 0.

Recorded q + delta in place of q leaves a pattern in the residual e_n = R_n^{-T} Lambda Phi_n u_n, A^T = Q R:

    e = J B + K delta + noise,    K_n,k = R_n^{-T} Lambda (dPhi/dq_k) u_n

to first order, of which B takes up what it can: an error -(J^T J)^-1 J^T K delta of Lambda. What is left of the
pattern tells how large the offsets are. With delta ~ N(0, tau^2 I), S = K^T (I - J J^+) K = V diag(lambda) V^T and h =
V^T K^T e the likelihood of tau is

    h_i ~ N(0, lambda_i sigma^2 + lambda_i^2 tau^2)       (restricted maximum likelihood: B is eliminated)

No offsets at all are as likely beforehand as offsets of TAU_RANGE together; the data decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.learning.samples import Samples
from manip_learn.linalg import batch_row_spaces, complement_rows, inverse_triangles

# offsets to be thought of [rad]: from an encoder's rounding to what the eye sees
TAU_RANGE = (1e-6, 3e-2)
TAU_STEPS = 60
MOST_SAMPLES = 5000  # enough to see offsets
LAGS = 40  # samples over which smoothing spreads noise
LEAST_VARIANCE = 1e-200  # of a residual: none at all is a limit, not a division by zero
UNSEEN = 1e-12  # share of the largest curvature below which a combination of offsets shows nowhere


@final
@dataclass(frozen=True, eq=False)
class JointOffsets:
    """What the residual says about the joints' offsets.

    Attributes:
        response: -(J^T J)^-1 J^T K, the error of B that offsets make, shape (m, nv) [1/rad].
        directions: V, shape (nv, nv).
        curvatures: lambda, shape (nv,).
        pattern: h, shape (nv,).
        variance: sigma^2 of the residual [(rad/s)^2].
    """

    response: Float[np.ndarray, "m nv"]
    directions: Float[np.ndarray, "nv nv"]
    curvatures: Float[np.ndarray, " nv"]
    pattern: Float[np.ndarray, " nv"]
    variance: float

    @staticmethod
    def of(samples: Samples, whitened_selection: Float[np.ndarray, "s r"]) -> JointOffsets | None:
        """From the residual of A u = 0 at the optimum; None where Lambda has no freedom or nothing is left over."""
        s, r = whitened_selection.shape
        if s == r or samples.q.shape[1] != samples.nv:
            return None
        every = -(-len(samples) // MOST_SAMPLES)
        few = samples.subset(np.arange(len(samples)) % every == 0) if every > 1 else samples
        e, J, K = _linearised(few, whitened_selection)
        freedom = len(e) - J.shape[1] - K.shape[1]
        if freedom < 1 or float(e @ e) <= 1e-20 * len(few) * samples.energy:
            return None
        response = -np.linalg.lstsq(J, np.concatenate([K, e[:, None]], axis=1), rcond=1e-12)[0]
        rest = K + J @ response[:, :-1]
        e = e + J @ response[:, -1]
        curvatures, V = np.linalg.eigh(rest.T @ rest)
        curvatures = np.where(curvatures > UNSEEN * max(float(curvatures[-1]), 0.0), curvatures, 0.0)
        pattern = np.where(curvatures > 0.0, V.T @ (rest.T @ e), 0.0)
        seen = curvatures > 0.0
        left = float(e @ e) - float(np.sum(pattern[seen] ** 2 / curvatures[seen]))
        # neither curvature nor pattern is scaled up to all samples: chance in the pattern would look like offsets
        # what the offsets themselves make is alike in neighbours too, and no noise
        noise = e - rest @ (V @ np.divide(pattern, curvatures, out=np.zeros_like(pattern), where=seen))
        variance = max(left, 1e-12 * float(e @ e)) / freedom * _correlation(noise.reshape(-1, s))
        return JointOffsets(response[:, :-1], V, curvatures, pattern, variance)

    def errors(self, n: int, rng: np.random.Generator) -> Float[np.ndarray, "n m"]:
        """Draws of the error of B that the offsets make, given the data."""
        taus = np.concatenate([[0.0], np.geomspace(*TAU_RANGE, TAU_STEPS)])
        tau2 = taus[:, None] ** 2
        lam, sigma2 = self.curvatures, max(self.variance, LEAST_VARIANCE)
        seen = lam > 0.0
        spread = lam[seen] * sigma2 + lam[seen] ** 2 * tau2
        log_weight = -0.5 * np.sum(np.log(spread) + self.pattern[seen] ** 2 / spread, axis=1)
        log_weight[1:] -= np.log(TAU_STEPS)
        weight = np.exp(log_weight - log_weight.max())
        drawn = tau2[rng.choice(len(taus), n, p=weight / weight.sum())]
        shrink = drawn / (sigma2 + lam * drawn)  # posterior variance over sigma^2
        delta = shrink * self.pattern + np.sqrt(shrink * sigma2) * rng.standard_normal((n, len(lam)))
        return delta @ self.directions.T @ self.response.T


def _correlation(e: Float[np.ndarray, "n s"]) -> float:
    """By how much the variance of a sum of neighbouring residuals exceeds that of independent ones, at least 1.

    Velocities that are derived from positions share their noise within a window; a pattern over the postures is a sum
    of many of them, and would otherwise look like offsets.
    """
    total = float(np.sum(e * e))
    lags = range(1, min(LAGS, len(e) - 1) + 1)
    return max(1.0, 1.0 + 2.0 * sum(abs(float(np.sum(e[k:] * e[:-k]))) for k in lags) / total) if total > 0.0 else 1.0


def _linearised(samples: Samples, Lambda: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """e, J and K of all samples, row by row."""
    s, perp = len(Lambda), complement_rows(Lambda)
    _, dPhi = samples.features.batch_with_derivative(samples.q)
    n = len(samples)
    dA_u = np.einsum("sp,npvk,nv->nsk", Lambda @ samples.whitening, dPhi, samples.u, optimize=True)
    Phi = np.concatenate([block.Phi for block in samples.blocks()])
    Q, R = batch_row_spaces(np.einsum("sr,nrv->nsv", Lambda, Phi, optimize=True))
    along = np.einsum("nvs,nv->ns", Q[:, :, :s], samples.u, optimize=True)
    null = samples.u - np.einsum("nvs,ns->nv", Q[:, :, :s], along, optimize=True)
    back = inverse_triangles(R).transpose(0, 2, 1)  # R^{-T}
    free = np.einsum("kr,nrv,nv->nk", perp, Phi, null, optimize=True)
    J = np.einsum("nis,nk->nisk", back, free, optimize=True)
    return along.reshape(-1), J.reshape(n * s, -1), (back @ dA_u).reshape(n * s, -1)
