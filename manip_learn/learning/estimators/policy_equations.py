"""Normal equations of a policy model with many regressors, for a fixed Lambda.

With N_n = I - A_n^+ A_n and pi = Theta^T beta, |Z^T (u - pi)|^2 = |N (u - pi)|^2, and the Hessian for Theta is
sum beta beta^T (x) N: one matrix product over the samples, where a QR of the rows costs ten times as much. The
condition number is squared thereby: the regressors are made orthonormal first, and since residuals are formed sample by
sample, a further solution for what is left takes off what rounding has left (iterative refinement).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.samples import Samples
from manip_learn.linalg import batch_row_spaces, complement_rows, inverse_triangles

# regressors that vary less than this beside the others are left out
FLAT = 1e-10
# share of the mean curvature added, so that directions without data stay where they are
FLOOR = 1e-13
REFINEMENTS = 2
CHUNK = 1024  # samples whose products of regressors are held at a time


@final
@dataclass(frozen=True, eq=False)
class OrthonormalRegressors:
    """beta' = T beta with mean beta' beta'^T = I over some samples.

    Attributes:
        mixing: T^T, shape (k, k').
        values: beta' of each sample, shape (n, k').
        back: Theta' = back Theta, shape (k', k).
    """

    mixing: Float[np.ndarray, "k j"]
    values: Float[np.ndarray, "n j"]
    back: Float[np.ndarray, "j k"]

    @staticmethod
    def of(samples: Samples, model: PolicyModel) -> OrthonormalRegressors:
        """Those of a model over all samples; combinations that hardly vary are left out."""
        beta = np.concatenate([model(block.x, block.trajectory) for block in samples.blocks()])
        R = np.linalg.qr(beta / np.sqrt(len(beta)), mode="r")
        _, sigma, Vt = np.linalg.svd(R)
        kept = sigma > FLAT * sigma[0]
        mixing = Vt[kept].T / sigma[kept]
        return OrthonormalRegressors(mixing, beta @ mixing, (Vt[kept].T * sigma[kept]).T)


@final
@dataclass(frozen=True, eq=False)
class Projections:
    """What a Lambda leaves of all samples.

    Attributes:
        N: Projectors, shape (n, nv, nv).
        duals: A^{+T}, shape (n, s, nv).
        free: N (Lambda_perp Phi)^T, shape (n, nv, p'-s).
    """

    N: Float[np.ndarray, "n nv nv"]
    duals: Float[np.ndarray, "n s nv"]
    free: Float[np.ndarray, "n nv k"]

    @staticmethod
    def of(samples: Samples, Lambda: Float[np.ndarray, "s r"]) -> Projections:
        """For a Lambda in whitened coordinates."""
        s, perp = len(Lambda), complement_rows(Lambda)
        parts = []
        for block in samples.blocks():
            A = np.einsum("sr,nrv->nsv", Lambda, block.Phi, optimize=True)
            Q, R = batch_row_spaces(A)
            Z = Q[:, :, s:]
            N = Z @ Z.transpose(0, 2, 1)
            rows = Q[:, :, :s].transpose(0, 2, 1)
            duals = inverse_triangles(R) @ rows if s else rows
            parts.append((N, duals, N @ np.einsum("kr,nrv->nvk", perp, block.Phi, optimize=True)))
        N, duals, free = (np.concatenate(p) for p in zip(*parts, strict=True))
        return Projections(N, duals, free)

    def slopes(self, y: Float[np.ndarray, "n nv"]) -> Float[np.ndarray, "n nv m"]:
        """d N (u - pi) / d B for y = u - pi, Kaufman's form, entry by entry of B."""
        a = np.einsum("nsv,nv->ns", self.duals, y, optimize=True)
        return -np.einsum("ns,nvk->nvsk", a, self.free, optimize=True).reshape(len(y), y.shape[1], -1)

    def equations(
        self, beta: Float[np.ndarray, "n j"], y: Float[np.ndarray, "n nv"], solver: Solver
    ) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient for B with Theta eliminated, for y = u - pi with the best pi."""
        J = self.slopes(y)
        KJ = pull(beta, J)
        H = np.einsum("nvi,nvj->ij", J, J, optimize=True) - KJ.T @ solver(KJ)
        return H, np.einsum("nvi,nv->i", J, y, optimize=True)


def curvature(beta: Float[np.ndarray, "n j"], N: Float[np.ndarray, "n nv nv"]) -> Float[np.ndarray, "c c"]:
    """sum beta beta^T (x) N, c = j nv."""
    (n, k), nv = beta.shape, N.shape[1]
    i, j = np.triu_indices(k)
    pairs = np.zeros((len(i), nv * nv))
    for start in range(0, n, CHUNK):
        part = slice(start, start + CHUNK)
        b = beta[part]
        pairs += (b[:, i] * b[:, j]).T @ N[part].reshape(-1, nv * nv)
    out = np.empty((k, k, nv, nv))
    out[i, j] = out[j, i] = pairs.reshape(-1, nv, nv)
    return out.transpose(0, 2, 1, 3).reshape(k * nv, k * nv)


def pull(beta: Float[np.ndarray, "n j"], values: Float[np.ndarray, "n nv m"]) -> Float[np.ndarray, "c m"]:
    """sum beta (x) values: the derivative by Theta, row by row, of what already lies in the null space."""
    n, nv, m = values.shape
    return (beta.T @ values.reshape(n, nv * m)).reshape(-1, m)


@final
class Solver:
    """(H + a trifle)^-1 by Cholesky's factors."""

    def __init__(self, H: Float[np.ndarray, "c c"]):
        self._scale = 1.0 / np.sqrt(np.maximum(np.diag(H), np.finfo(np.float64).tiny))
        scaled = self._scale[:, None] * H * self._scale
        for floor in (FLOOR, 1e3 * FLOOR, 1e6 * FLOOR):
            try:
                self._factor = cho_factor(scaled + floor * np.eye(len(H)), lower=True, check_finite=False)
                return
            except np.linalg.LinAlgError:  # rounding has eaten a direction without curvature
                continue
        raise np.linalg.LinAlgError("the policy's normal equations are not positive definite")

    @property
    def log_determinant(self) -> float:
        """log |H + a trifle|."""
        return 2.0 * float(np.sum(np.log(np.diag(self._factor[0]) / self._scale)))

    def __call__(self, y: Float[np.ndarray, "c m"]) -> Float[np.ndarray, "c m"]:
        """Solution for several right sides."""
        return self._scale[:, None] * cho_solve(self._factor, self._scale[:, None] * y, check_finite=False)


def solve_policy(
    beta: Float[np.ndarray, "n j"], N: Float[np.ndarray, "n nv nv"], u: Float[np.ndarray, "n nv"], solver: Solver
) -> tuple[Float[np.ndarray, "j nv"], Float[np.ndarray, "n nv"]]:
    """Best Theta' and what it leaves, u - pi, with refinement."""
    theta = np.zeros((beta.shape[1], u.shape[1]))
    y = u
    for _ in range(REFINEMENTS):
        e = np.einsum("nij,nj->ni", N, y, optimize=True)
        theta = theta + solver(pull(beta, e[:, :, None])).reshape(theta.shape)
        y = u - beta @ theta
    return theta, y
