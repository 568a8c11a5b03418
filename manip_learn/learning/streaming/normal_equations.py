"""Normal equations of Lambda and the null-space policy together, over all samples.

With e = N (u - Theta^T beta) and dLambda = B Lambda_perp (Kaufman's form of the derivative):

    d e / d Theta_kv = -beta_k N e_v          d e / d B_ij = -(A^{+T} (u - pi))_i  N (Lambda_perp Phi)_j^T

N is a projector, so that sum (d e / d Theta)^T (d e / d Theta) = sum beta beta^T (x) N: one matrix product per chunk,
where a QR of the rows costs far more. The condition number is squared thereby: the regressors are made orthonormal
beforehand, and since e is formed sample by sample, each further pass takes off what rounding has left (iterative
refinement).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.bootstrap import TrajectoryBlocks
from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.streaming.accumulator import Accumulator, Chunk, SumAccumulator

# a constraint this much weaker in one direction than in another has lost rank at that sample
RANK_RATIO = 1e-9


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
class JointAccumulator(Accumulator):
    """One Gauss-Newton pass of variable projection.

    Gathers the cost, the energy sum |N u|^2, and for each block of trajectories the gradient and the Hessian for
    (Theta, B); Theta is (k', nv) row by row, B is (s, p' - s).

    Attributes:
        features: Phi.
        mixing: Lambda above Lambda_perp, in the features' own units, shape (p', p).
        n_rows: Number of rows s of Lambda.
        regressors: beta'.
        theta: Policy for beta', shape (k', nv).
        blocks: Pool of each trajectory.
    """

    features: FeatureMap
    mixing: Float[np.ndarray, "r p"]
    n_rows: int
    regressors: Regressors
    theta: Float[np.ndarray, "j nv"]
    blocks: TrajectoryBlocks

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
            block: _normal_equations(N[:, part], beta[:, part], J[:, :, part], e[:, part])
            for block, part in self.blocks.runs(chunk.trajectory)
        }
        energy = np.einsum("vn,vn->", u, u) - np.einsum("sn,sn->", task, task)
        return float(np.einsum("vn,vn->", e, e)), float(energy), parts

    def merge(self, before: Evidence, after: Evidence) -> Evidence:
        """Sums, block by block."""
        parts = dict(before[2])
        for block, (gradient, hessian) in after[2].items():
            if block in parts:
                gradient, hessian = parts[block][0] + gradient, parts[block][1] + hessian
            parts[block] = gradient, hessian
        return before[0] + after[0], before[1] + after[1], parts

    def merge_parts(self, before: Evidence, after: Evidence) -> Evidence:
        """Sums, block by block."""
        return self.merge(before, after)

    def finish(self, total: Evidence, notes: tuple[str, ...]) -> Evidence:
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
    crossed = (beta @ J.transpose(2, 0, 1).reshape(n, m * nv)).reshape(-1, m, nv)
    H[:width, width:] = -crossed.transpose(0, 2, 1).reshape(width, m)
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


@final
@dataclass(frozen=True, eq=False)
class NullSpaceAccumulator(SumAccumulator):
    """sum w^T A^+ A w with its gradient and Gauss-Newton Hessian for dLambda = B Lambda_perp, block by block.

    Gathers the cost, the energy sum |w|^2, and for each block of trajectories the gradient (m) and the Hessian (m, m),
    m = s (p' - s), B row by row.

    Attributes:
        features: Phi.
        mixing: Lambda above Lambda_perp, in the features' own units, shape (p', p).
        n_rows: Number of rows s of Lambda.
        blocks: Pool of each trajectory.
    """

    features: FeatureMap
    mixing: Float[np.ndarray, "r p"]
    n_rows: int
    blocks: TrajectoryBlocks

    def of(self, chunk: Chunk) -> tuple[Any, ...]:
        """Cost, energy, gradients and Hessians of a chunk."""
        s = self.n_rows
        Phi, w = chunk.features(self.features, self.mixing)
        spaces = row_spaces(Phi[:s])
        along = spaces.along(w)
        a, null = spaces.dual(along), spaces.away(w, along)  # A^{+T} w and N w
        g = np.einsum("kvn,vn->kn", Phi[s:], null)
        k, n = g.shape
        slopes = (a[:, None] * g[None]).reshape(s * k, n)
        inverse = spaces.inverse_gram()
        m = s * k
        H = np.empty((m, m, n))
        for i in range(s):
            for j in range(s):
                H[i * k : (i + 1) * k, j * k : (j + 1) * k] = inverse[i, j] * g[:, None] * g[None]
        return (
            np.einsum("sn,sn->", along, along),
            np.einsum("vn,vn->", w, w),
            self.blocks.sums(slopes, chunk.trajectory),
            self.blocks.sums(H.reshape(m * m, n), chunk.trajectory).reshape(-1, m, m),
        )


@final
@dataclass(frozen=True, eq=False)
class RowSpaces:
    """A_n = L_n E_n for n samples: E_n has orthonormal rows, L_n is a lower triangle.

    Attributes:
        E: shape (s, nv, n); a row that adds nothing to those before it is zero.
        L: shape (s, s, n).
        usable: False where A loses rank, shape (n,).
    """

    E: Float[np.ndarray, "s nv n"]
    L: Float[np.ndarray, "s s n"]
    usable: Bool[np.ndarray, " n"]

    def along(self, w: Float[np.ndarray, "nv n"]) -> Float[np.ndarray, "s n"]:
        """Coordinates E w of a velocity in the row space; their squares sum to w^T A^+ A w."""
        return np.einsum("svn,vn->sn", self.E, w)

    def away(self, w: Float[np.ndarray, "nv n"], along: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "nv n"]:
        """N w, the part of a velocity outside the row space; `along` is E w."""
        out = w.copy()
        for e, c in zip(self.E, along, strict=True):
            out -= e * c
        return out

    def dual(self, along: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "s n"]:
        """A^{+T} w from E w; zero where A loses rank, so that such a sample has no say."""
        out = np.zeros_like(along)
        for i in reversed(range(len(along))):
            value = along[i].copy()
            for j in range(i + 1, len(along)):
                value -= self.L[j, i] * out[j]
            np.divide(value, self.L[i, i], out=out[i], where=self.usable)
        return out

    def inverse_gram(self) -> Float[np.ndarray, "s s n"]:
        """(A A^T)^-1; zero where A loses rank."""
        s, _, n = self.L.shape
        inverse = np.zeros((s, s, n))  # of L
        for j in range(s):
            np.divide(1.0, self.L[j, j], out=inverse[j, j], where=self.usable)
            for i in range(j + 1, s):
                value = -np.einsum("kn,kn->n", self.L[i, j:i], inverse[j:i, j])
                np.divide(value, self.L[i, i], out=inverse[i, j], where=self.usable)
        return np.einsum("kin,kjn->ijn", inverse, inverse)


def row_spaces(A: Float[np.ndarray, "s nv n"]) -> RowSpaces:
    """Gram-Schmidt, each row twice, which makes it as accurate as Householder's reflections."""
    s, nv, n = A.shape
    E, L = np.zeros((s, nv, n)), np.zeros((s, s, n))
    for i in range(s):
        v = A[i].copy()
        for j in [*range(i), *range(i)]:
            c = np.einsum("vn,vn->n", E[j], v)
            v -= E[j] * c
            L[i, j] += c
        size = np.sqrt(np.einsum("vn,vn->n", v, v))
        L[i, i] = size
        np.divide(v, size, out=E[i], where=size > 0.0)
    diagonal = np.einsum("iin->in", L)
    usable = diagonal.min(axis=0) > RANK_RATIO * diagonal.max(axis=0)
    return RowSpaces(E, L, usable)
