"""Normal equations of Lambda and the null-space policy together, over all samples.

With e = N (u - Theta^T beta) and dLambda = B Lambda_perp (Kaufman's form of the derivative):

    d e / d Theta_kv = -beta_k N e_v          d e / d B_ij = -(A^{+T} (u - pi))_i  N (Lambda_perp Phi)_j^T

N is a projector, so that sum (d e / d Theta)^T (d e / d Theta) = sum beta beta^T (x) N: one matrix product a chunk,
where a QR of the rows costs far more. The condition number is squared thereby: the regressors are made orthonormal
beforehand, and since e is formed sample by sample, each further pass takes off what rounding has left (iterative
refinement).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.streaming.accumulator import Chunk, Tally
from manip_learn.learning.streaming.row_spaces import RowSpaces, row_spaces
from manip_learn.learning.streaming.trajectory_pools import Pools


@final
@dataclass(frozen=True, eq=False)
class Regressors:
    """beta'(q) = T beta((q - centre) / spread), orthonormal on the samples that T was made from; picklable.

    Attributes:
        model: beta.
        centre, spread: shape (m,).
        mixing: T, shape (k', k).
    """

    model: PolicyModel
    centre: Float[np.ndarray, " m"]
    spread: Float[np.ndarray, " m"]
    mixing: Float[np.ndarray, "j k"]

    def __call__(self, q: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "j n"]:
        """beta' with the samples along the last axis."""
        return self.mixing @ self.model((q - self.centre) / self.spread).T


Evidence = tuple[float, float, dict[int, tuple[np.ndarray, np.ndarray]]]


@final
@dataclass(frozen=True, eq=False)
class JointTally(Tally):
    """One Gauss-Newton pass of variable projection.

    Gathers the cost, the energy sum |N u|^2, and for each pool of trajectories the gradient and the Hessian for
    (Theta, B); Theta is (k', nv) row by row, B is (s, p' - s).

    Attributes:
        features: Phi.
        mixing: Lambda above Lambda_perp, in the features' own units, shape (p', p).
        n_rows: Number of rows s of Lambda.
        regressors: beta'.
        theta: Policy for beta', shape (k', nv).
        pools: Pool of each trajectory.
    """

    features: FeatureMap
    mixing: Float[np.ndarray, "r p"]
    n_rows: int
    regressors: Regressors
    theta: Float[np.ndarray, "j nv"]
    pools: Pools

    def of(self, chunk: Chunk) -> Evidence:
        """What a chunk says."""
        s = self.n_rows
        Phi, u = chunk.features(self.features, self.mixing)
        spaces = row_spaces(Phi[:s])
        beta = self.regressors(chunk.q)
        y = u - self.theta.T @ beta
        along, task = spaces.along(y), spaces.along(u)
        e = spaces.away(y, along)
        J = _slopes(spaces, Phi[s:], spaces.dual(along))
        N = _projectors(spaces)
        parts = {
            pool: _normal_equations(N[:, part], beta[:, part], J[:, :, part], e[:, part])
            for pool, part in self.pools.runs(chunk.group)
        }
        energy = np.einsum("vn,vn->", u, u) - np.einsum("sn,sn->", task, task)
        return float(np.einsum("vn,vn->", e, e)), float(energy), parts

    def joined(self, before: Evidence, after: Evidence) -> Evidence:
        """Sums, pool by pool."""
        parts = dict(before[2])
        for pool, (gradient, hessian) in after[2].items():
            if pool in parts:
                gradient, hessian = parts[pool][0] + gradient, parts[pool][1] + hessian
            parts[pool] = gradient, hessian
        return before[0] + after[0], before[1] + after[1], parts

    def joined_parts(self, before: Evidence, after: Evidence) -> Evidence:
        """Sums, pool by pool."""
        return self.joined(before, after)

    def finished(self, total: Evidence, notes: tuple[str, ...]) -> Evidence:
        """As it is."""
        return total


def _slopes(spaces: RowSpaces, perp: np.ndarray, a: np.ndarray) -> Float[np.ndarray, "m nv n"]:
    """d e / d B, entry by entry."""
    s, (k, nv, n) = len(a), perp.shape
    out = np.empty((s, k, nv, n))
    for j in range(k):
        free = spaces.away(perp[j], spaces.along(perp[j]))
        for i in range(s):
            np.multiply(free, -a[i], out=out[i, j])
    return out.reshape(s * k, nv, n)


def _projectors(spaces: RowSpaces) -> Float[np.ndarray, "c n"]:
    """N, the entries on and above its diagonal."""
    v, w = np.triu_indices(spaces.E.shape[1])
    N = -np.einsum("svn,svn->vn", spaces.E[:, v], spaces.E[:, w])
    N[v == w] += 1.0
    return N


def _normal_equations(
    N: np.ndarray, beta: np.ndarray, J: np.ndarray, e: np.ndarray
) -> tuple[Float[np.ndarray, " w"], Float[np.ndarray, "w w"]]:
    """Gradient and Hessian of some samples."""
    m, nv, n = J.shape
    width = beta.shape[0] * nv
    flat = np.ascontiguousarray(J).reshape(m, nv * n)
    H = np.empty((width + m, width + m))
    H[:width, :width] = _policy_hessian(N, beta, nv)
    both = (beta @ J.transpose(2, 0, 1).reshape(n, m * nv)).reshape(-1, m, nv)
    H[:width, width:] = -both.transpose(0, 2, 1).reshape(width, m)
    H[width:, :width] = H[:width, width:].T
    H[width:, width:] = flat @ flat.T
    return np.concatenate([-(beta @ e.T).reshape(-1), np.einsum("mvn,vn->m", J, e)]), H


def _policy_hessian(N: np.ndarray, beta: np.ndarray, nv: int) -> Float[np.ndarray, "w w"]:
    """sum beta beta^T (x) N, both symmetric: each pair of entries once."""
    k = len(beta)
    (v, w), (i, j) = np.triu_indices(nv), np.triu_indices(k)
    pairs = (beta[i] * beta[j]) @ N.T
    out = np.empty((k, k, nv, nv))
    for a, b in ((v, w), (w, v)):
        out[i[:, None], j[:, None], a, b] = pairs
        out[j[:, None], i[:, None], a, b] = pairs
    return out.transpose(0, 2, 1, 3).reshape(k * nv, k * nv)
