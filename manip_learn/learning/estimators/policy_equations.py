"""Normal equations of a policy model with many regressors, for a fixed Lambda.

With N_n = I - A_n^+ A_n and pi = Theta^T beta, |Z^T (u - pi)|^2 = |N (u - pi)|^2, and the Hessian for Theta is sum beta
beta^T (x) N: one matrix product over the samples, where a QR of the rows costs 10 times that. The condition number
is squared thereby: the regressors are made orthonormal first, and since residuals are formed sample by sample, a
further solution for what is left takes off what rounding has left (iterative refinement).

Noise of the joint velocities may be stronger in some joints than in others. With cov e = Sigma = L L^T the residuals
Z^T (u - pi), Z = null(A), have the covariance Z^T Sigma Z. Since L^T Z spans the null space of A L^-T, they are,
whitened, the residuals of the isotropic case on L^-1 u, Phi L^-T and L^-1 pi, which is as linear in its parameters as
pi: generalised least squares without a new estimator.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtri

from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.samples import BEYOND_CHANCE, CUBIC, Samples, rows_beside
from manip_learn.linalg import complement_rows, inverse_triangles_beside, row_bases

# largest variance of a joint's noise over the least below which equal weights cost a few per cent at most
UNEQUAL_NOISE = 2.0
# residuals for each entry of the noise's covariance, below which it is not estimated. Set by hand
RESIDUALS_PER_ENTRY = 20
# variances of the joints' noise beside their mean stay between these. Set by hand
NOISE_RANGE = (1e-2, 1e2)

# regressors that vary less than this beside the others are left out
FLAT = 1e-10
# share of the mean curvature added, so that directions without data stay where they are
FLOOR = 1e-13
REFINEMENTS = 2  # passes: the first leaves the rounding of normal equations, the second that of the products
CHUNK = 1024  # samples whose products of regressors are held at a time
# weight of the isotropic covariance in samples per sample, for entries that the null spaces hardly show
PRIOR = 1e-3
DIFFERENCES = CUBIC - 1  # of neighbouring samples: motion that is a parabola over four samples leaves nothing
MEDIAN = NormalDist().inv_cdf(0.75)  # of the absolute value of a standard normal variable
TYLER_STEPS = 10


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
        beta = model(samples.x, samples.trajectory)
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
        both = np.concatenate([Lambda, complement_rows(Lambda)])
        parts, s = [], len(Lambda)
        for block in samples.blocks():
            rows = rows_beside(both, block.Phi)
            Q, R = row_bases(rows[:s].transpose(1, 0, 2))
            N = np.eye(rows.shape[1])[None] - (Q.transpose(2, 0, 1) @ Q.transpose(2, 1, 0))
            back = np.ascontiguousarray(inverse_triangles_beside(R).transpose(2, 0, 1))
            parts.append((N, back @ Q.transpose(2, 1, 0), N @ rows[s:].transpose(2, 1, 0)))
        return Projections(*(p[0] if len(p) == 1 else np.concatenate(p) for p in zip(*parts, strict=True)))

    def energy(self, y: Float[np.ndarray, "n nv"]) -> float:
        """sum |N y|^2."""
        return float(np.vdot(y, self.project(y)))

    def project(self, y: Float[np.ndarray, "n nv"]) -> Float[np.ndarray, "n nv"]:
        """N y of each sample."""
        return np.einsum("nij,nj->ni", self.N, y)

    def slopes(self, y: Float[np.ndarray, "n nv"]) -> Float[np.ndarray, "n nv m"]:
        """d N (u - pi) / d B for y = u - pi, Kaufman's form, entry by entry of B."""
        a = np.einsum("nsv,nv->ns", self.duals, y)
        return -(a[:, None, :, None] * self.free[:, :, None, :]).reshape(len(y), y.shape[1], -1)

    def equations(
        self, beta: Float[np.ndarray, "n j"], y: Float[np.ndarray, "n nv"], solver: Solver
    ) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient for B with Theta eliminated, for y = u - pi with the best pi."""
        J = self.slopes(y)
        KJ = pull(beta, J)
        rows = J.reshape(-1, J.shape[2])
        return rows.T @ rows - KJ.T @ solver(KJ), rows.T @ y.reshape(-1)


def curvature(beta: Float[np.ndarray, "n j"], N: Float[np.ndarray, "n nv nv"]) -> Float[np.ndarray, "c c"]:
    """sum beta beta^T (x) N, c = j nv, for symmetric N: each pair of regressors and of joints once."""
    return packed_curvature(beta, packed(N))


def packed(N: Float[np.ndarray, "n nv nv"]) -> Float[np.ndarray, "n e"]:
    """Upper triangles of symmetric matrices, row after row."""
    n, nv, _ = N.shape
    v, w = upper(nv)
    return N.reshape(n, nv * nv).take(v * nv + w, axis=1)


def packed_curvature(beta: Float[np.ndarray, "n j"], entries: Float[np.ndarray, "n e"]) -> Float[np.ndarray, "c c"]:
    """`curvature` for packed projectors."""
    pairs = np.zeros((beta.shape[1] * (beta.shape[1] + 1) // 2, entries.shape[1]))
    for start in range(0, len(beta), CHUNK):
        part = slice(start, start + CHUNK)
        pairs += products(beta[part]) @ entries[part]
    return unpacked_curvature(pairs)


def unpacked_curvature(pairs: Float[np.ndarray, "g e"]) -> Float[np.ndarray, "c c"]:
    """The matrix whose blocks, one for each pair of regressors, are packed."""
    k, nv = _side(len(pairs)), _side(pairs.shape[1])
    (i, j), (v, w) = upper(k), upper(nv)
    whole = np.empty((len(i), nv, nv))
    whole[:, v, w] = whole[:, w, v] = pairs
    out = np.empty((k, k, nv, nv))
    out[i, j] = out[j, i] = whole
    return out.transpose(0, 2, 1, 3).reshape(k * nv, k * nv)


def products(beta: Float[np.ndarray, "n j"]) -> Float[np.ndarray, "g n"]:
    """Products of all pairs of regressors, in the order of `upper`."""
    rows = np.ascontiguousarray(beta.T)
    return np.concatenate([rows[a] * rows[a:] for a in range(len(rows))])


@functools.lru_cache(maxsize=64)
def upper(side: int) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " e"]]:
    """Rows and columns of the upper triangle of a square matrix, its diagonal included."""
    return np.triu_indices(side)


def _side(entries: int) -> int:
    """Side of the square matrix whose upper triangle has this number of entries."""
    return (math.isqrt(8 * entries + 1) - 1) // 2


def pull(beta: Float[np.ndarray, "n j"], values: Float[np.ndarray, "n nv m"]) -> Float[np.ndarray, "c m"]:
    """sum beta (x) values: the derivative by Theta, row by row, of what already lies in the null space."""
    n, nv, m = values.shape
    return (beta.T @ values.reshape(n, nv * m)).reshape(-1, m)


@final
class Solver:
    """(H + a trifle)^-1 by Cholesky's factors; SciPy's wrapping takes as long as LAPACK itself for few unknowns."""

    def __init__(self, H: Float[np.ndarray, "c c"]):
        self._scale = 1.0 / np.sqrt(np.maximum(np.diag(H), np.finfo(np.float64).tiny))
        scaled = self._scale[:, None] * H * self._scale
        for floor in (FLOOR, 1e3 * FLOOR, 1e6 * FLOOR):
            self._factor, failed = dpotrf(scaled + floor * np.eye(len(H)), lower=1, clean=0)
            if not failed:
                return  # else rounding has eaten a direction without curvature
        raise np.linalg.LinAlgError("the policy's normal equations are not positive definite")

    @property
    def least_pivot(self) -> float:
        """Least squared diagonal element of Cholesky's factor, the diagonal of H scaled to 1."""
        return float(np.min(np.diag(self._factor))) ** 2

    @property
    def log_determinant(self) -> float:
        """log |H + a trifle|."""
        return 2.0 * float(np.sum(np.log(np.diag(self._factor) / self._scale)))

    def inverse(self) -> Float[np.ndarray, "c c"]:
        """The inverse itself, from the factor: a third of the cost of solving for the unit matrix."""
        half, _ = dpotri(self._factor, lower=1)
        lower = np.tril(half)
        whole = lower + np.tril(half, -1).T
        return self._scale[:, None] * whole * self._scale

    def inverse_diagonal(self) -> Float[np.ndarray, " c"]:
        """Diagonal of the inverse, from the inverse of the factor."""
        back, _ = dtrtri(self._factor, lower=1)
        return self._scale**2 * np.sum(np.tril(back) ** 2, axis=0)

    def __call__(self, y: Float[np.ndarray, "c m"]) -> Float[np.ndarray, "c m"]:
        """Solution for several right sides."""
        if y.size == 0:
            return y
        return self._scale[:, None] * dpotrs(self._factor, self._scale[:, None] * y, lower=1)[0]


def solve_policy(
    beta: Float[np.ndarray, "n j"],
    projections: Projections,
    u: Float[np.ndarray, "n nv"],
    solver: Solver,
    held_out: Bool[np.ndarray, " n"] | None = None,
) -> tuple[Float[np.ndarray, "j nv"], Float[np.ndarray, "n nv"]]:
    """Best Theta' without the samples that are held out, and what it leaves of all, u - pi, with refinement."""
    theta = np.zeros((beta.shape[1], u.shape[1]))
    y = u
    for _ in range(REFINEMENTS):
        e = projections.project(y)
        if held_out is not None:
            e[held_out] = 0.0
        theta = theta + solver(pull(beta, e[:, :, None])).reshape(theta.shape)
        y = u - beta @ theta
    return theta, y


def left_out(
    beta: Float[np.ndarray, "n j"],
    projections: Projections,
    u: Float[np.ndarray, "n nv"],
    folds: Int[np.ndarray, " n"],
    least_pivot: float = 0.0,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "c c"], float]:
    """|N (u - pi)|^2 of each sample, pi fitted to the other folds; the curvature of all folds; the least pivot.

    The regressors are orthonormal. No fold is judged after one whose `Solver.least_pivot` is less than this one.
    """
    entries, held_out = packed(projections.N), [folds == fold for fold in np.unique(folds)]
    parts = [packed_curvature(beta[held], entries[held]) for held in held_out]
    total, squares, least = np.sum(parts, axis=0), np.zeros(len(u)), math.inf
    for held, own in zip(held_out, parts, strict=True):
        solver = Solver(total - own)
        least = min(least, solver.least_pivot)
        if least < least_pivot:
            break
        _, y = solve_policy(beta, projections, u, solver, held)
        squares[held] = np.sum(projections.project(y)[held] ** 2, axis=1)
    return squares, total, least


def whitening_factor(
    samples: Samples, whitened_selection: Float[np.ndarray, "s r"], y: Float[np.ndarray, "n nv"]
) -> Float[np.ndarray, "nv nv"] | None:
    """L with L L^T the covariance of the noise over its mean variance, by y = u - pi; None if nearly isotropic."""
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
    """Variance of what in u is no smooth motion, mean over the joints; bursts do not count [(rad/s)^2]."""
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
