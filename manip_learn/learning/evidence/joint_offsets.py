"""Joint offsets: what a constant error of each joint's zero does to a Lambda learnt from A(q) u = 0.

Recorded q + delta in place of q leaves a pattern in the residual e_n = Q_n^T u_n, A^T = Q R:

    e = J B + K delta + noise,    K_n,k = R_n^{-T} Lambda (dPhi/dq_k) N_n u_n,    N = I - Q Q^T

to first order, of which B takes up what it can: an error -(J^T J)^-1 J^T K delta of Lambda. What is left of the
pattern tells how large the offsets are. With delta ~ N(0, tau^2 I), S = K^T (I - J J^+) K = V diag(lambda) V^T and h =
V^T K^T e the likelihood of tau is

    h_i ~ N(0, lambda_i sigma^2 + lambda_i^2 tau^2)       (restricted maximum likelihood: B is eliminated)

No offsets at all are NONE_TO_SOME times as likely beforehand as offsets of TAU_RANGE together; the data decide.

The regressor is made of N u and not of u. Both are N u on the constraint, but the rest of u is the residual itself:
with it K v of a combination v that no motion shows is made of the noise of e alone (errors in variables; W. A. Fuller,
Measurement Error Models, 1987, section 1.1), and K^T e grows with the data however large the offsets are. The noise of
N u is independent of that of Q^T u where that of u is alike in all joints. A turn v of the base gives Lambda dPhi[v] =
Lambda [w] Phi, so that K v lies in the span of J exactly, at any noise: no residual shows it, whatever the recordings.
A combination that shows nowhere is taken to be as large as the others are found to be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.learning.bootstrap import influences
from manip_learn.learning.samples import Samples
from manip_learn.linalg import batch_row_spaces, complement_rows, inverse_triangles

# offsets to be thought of [rad]: from an encoder's rounding to what the eye sees
TAU_RANGE = (1e-6, 3e-2)
TAU_STEPS = 60
# odds beforehand of no offsets: strong evidence for them is wanted (Kass and Raftery, 1995). At even odds 11 of 180
# sets of drawers with 1e-3 rad of noise alone were stated more than three times as wide (100 Hz, seeds from 30000)
NONE_TO_SOME = 20.0
MOST_SAMPLES = 5000  # enough to see offsets
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
        variance: sigma^2 by which the patterns' shares scatter, see `_variance` [(rad/s)^2].
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
        if len(e) <= J.shape[1] + K.shape[1] or float(e @ e) <= 1e-20 * len(few) * samples.energy:
            return None
        response = -np.linalg.lstsq(J, np.concatenate([K, e[:, None]], axis=1), rcond=1e-12)[0]
        rest = K + J @ response[:, :-1]
        e = e + J @ response[:, -1]
        curvatures, V = np.linalg.eigh(rest.T @ rest)
        curvatures = np.where(curvatures > UNSEEN * max(float(curvatures[-1]), 0.0), curvatures, 0.0)
        pattern = np.where(curvatures > 0.0, V.T @ (rest.T @ e), 0.0)
        seen = curvatures > 0.0
        # neither curvature nor pattern is scaled up to all samples: chance in the pattern would look like offsets
        patterns = rest @ (V[:, seen] / np.sqrt(curvatures[seen]))
        unknowns = np.concatenate([J, patterns], axis=1)
        variance = _variance(e - patterns @ (patterns.T @ e), unknowns, np.repeat(few.trajectory, s))
        return JointOffsets(response[:, :-1], V, curvatures, pattern, variance)

    def errors(self, n: int, rng: np.random.Generator) -> Float[np.ndarray, "n m"]:
        """Draws of the error of B that the offsets make, given the data."""
        taus = np.concatenate([[0.0], np.geomspace(*TAU_RANGE, TAU_STEPS)])
        tau2 = taus[:, None] ** 2
        lam, sigma2 = self.curvatures, max(self.variance, LEAST_VARIANCE)
        seen = lam > 0.0
        spread = lam[seen] * sigma2 + lam[seen] ** 2 * tau2
        log_weight = -0.5 * np.sum(np.log(spread) + self.pattern[seen] ** 2 / spread, axis=1)
        log_weight[1:] -= np.log(NONE_TO_SOME * TAU_STEPS)
        weight = np.exp(log_weight - log_weight.max())
        drawn = tau2[rng.choice(len(taus), n, p=weight / weight.sum())]
        shrink = drawn / (sigma2 + lam * drawn)  # posterior variance over sigma^2
        delta = shrink * self.pattern + np.sqrt(shrink * sigma2) * rng.standard_normal((n, len(lam)))
        return delta @ self.directions.T @ self.response.T


def _variance(e: Float[np.ndarray, " k"], M: Float[np.ndarray, "k d"], trajectory: Int[np.ndarray, " k"]) -> float:
    """sigma^2 for which the unknowns of M, fitted to e, have the covariance sigma^2 (M^T M)^-1 in the mean.

    By how their shares scatter over the trajectories, as in the bootstrap: neighbours share their noise where
    velocities are derived from positions, by how much depends on the window, and a pattern over the postures is a sum
    of many of them. Of one trajectory the residual has to do.
    """
    starts, white = np.flatnonzero(np.diff(trajectory, prepend=-1)), float(e @ e) / (len(e) - M.shape[1])
    if len(starts) < 2:
        return white
    gradients = np.add.reduceat(M * e[:, None], starts, axis=0)
    hessians = np.array([part.T @ part for part in np.split(M, starts[1:])])
    moves = influences(gradients, hessians)
    return max(white, float(np.einsum("gi,ij,gj->", moves, hessians.sum(axis=0), moves)) / M.shape[1])


def _linearised(samples: Samples, Lambda: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """e, J and K of all samples, row by row."""
    s, perp = len(Lambda), complement_rows(Lambda)
    _, dPhi = samples.features.batch_with_derivative(samples.q)
    n = len(samples)
    Phi = np.concatenate([block.Phi for block in samples.blocks()])
    Q, R = batch_row_spaces(np.einsum("sr,nrv->nsv", Lambda, Phi, optimize=True))
    along = np.einsum("nvs,nv->ns", Q[:, :, :s], samples.u, optimize=True)
    null = samples.u - np.einsum("nvs,ns->nv", Q[:, :, :s], along, optimize=True)
    dA_null = np.einsum("sp,npvk,nv->nsk", Lambda @ samples.whitening, dPhi, null, optimize=True)
    back = inverse_triangles(R).transpose(0, 2, 1)  # R^{-T}
    free = np.einsum("kr,nrv,nv->nk", perp, Phi, null, optimize=True)
    J = np.einsum("nis,nk->nisk", back, free, optimize=True)
    return along.reshape(-1), J.reshape(n * s, -1), (back @ dA_null).reshape(n * s, -1)
