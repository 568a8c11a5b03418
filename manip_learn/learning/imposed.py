"""The constraint that the demonstrator imposes: Lambda and the null-space policy together, from raw (q, u), b unknown.

A Lambda of s rows accounts for all of u_n = Q_n c_n + Z_n w_n, Q_n and Z_n orthonormal bases of the rows and of the
null space of A_n = Lambda Phi(q_n). w_n is a policy of the posture and white noise of variance sigma^2; c_n is the
task's own motion, of which nothing is known but that it is a signal in time. [Q Z] is orthonormal, so that the
likelihoods of all Lambda, whatever their number of rows, are those of the same numbers: in nats

    l(Lambda) = - sum_k N_k / 2 (log S_k + 1) - d / 2 log n + log N(Z^T u; 0, sigma^2 I + K T K^T)

S_k is the mean square of c in octave k of the cosine transform of each trajectory, which has N_k entries; d is the
number of these octaves and of the entries of Lambda (Schwarz, 1978).

The policy is pi(q) = Theta^T beta(q), Theta ~ N(0, T) with one variance tau_g^2 for all parameters of grade g (the
monomials of one degree, the waves of one frequency), K = d (Z^T pi) / d Theta; Theta is integrated out. With
C = K^T K = sum beta beta^T (x) N, P = sigma^2 T^-1 and theta the posterior mean of Theta,

    - 2 log N = n z log sigma^2 + log |C + P| - log |P| + (|Z^T (u - pi)|^2 + theta^T P theta) / sigma^2

tau and sigma by maximum likelihood too (MacKay, 1992, Neural Computation 4(3), eq. (2.33) and following). No degree has
to be chosen: one that the data do not need has tau = 0, one of which they cannot tell widens the angle. Lambda moves by
Gauss-Newton steps on the Grassmann manifold with Theta eliminated (Golub and Pereyra, 1973; Kaufman, 1975).

Noise may be stronger in some joints than in others. With covariance L L^T all this holds for L^-1 u, Phi L^-T and
L^-1 pi, and l less log |L| a sample is the likelihood of the same u.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from statistics import NormalDist
from typing import final

import numpy as np
from jaxtyping import Float, Int
from scipy.fft import dct
from scipy.linalg import eigh
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtri
from scipy.spatial import cKDTree

from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.descent import descend
from manip_learn.learning.estimators.estimate import Estimate, PolicyPrior, gaps_of_residuals
from manip_learn.learning.samples import BEYOND_CHANCE, CUBIC, Samples, in_blocks, rows_beside, runs
from manip_learn.linalg import complement_rows, inverse_triangles_beside, orthonormal_rows, row_bases, turned

NAMES = ("constant", "affine", "quadratic", "cubic", "quartic", "quintic")
# of the general prior, in the order in which grades are taken while there is room
GENERAL = ("constant", "affine", "harmonic1", "quadratic", "cubic", "harmonic2")
MOST_COLUMNS = 400  # parameters of the policy: the time of a step grows with their cube
CHUNK = 1024
LEAST = 1e-12
START = 4.0
FIRST_UPDATES, UPDATES = 4, 2
DETERMINED = 1e-6
FLOOR = 1e-13
RANK = 1e-13
SETTLED = 1e-6
STEPS = 40
LOOK_STEPS = 6
COMPARE_LIMIT = 1_500
RESOLVED_SHARE = 1e-3
ABOVE_NOISE = 1.5
RANDOM_STARTS = 3
MAX_BLOCKS = 100
EXACT = 1e-10
SAME_PATH = 0.15
MOST_POSTURES = 2_000
MEDIAN = NormalDist().inv_cdf(0.75)
DIFFERENCES = CUBIC - 1
UNEQUAL_NOISE = 2.0
RESIDUALS_PER_ENTRY = 20
NOISE_RANGE = (1e-2, 1e2)
PRIOR = 1e-3
TYLER_STEPS = 10

Grade = Callable[[Samples], Float[np.ndarray, "n k"]]


def monomials(degree: int) -> Grade:
    """All products of so many joints, such that sum beta_i(x) beta_i(y) = (x . y / m)^degree."""

    def beta(samples: Samples) -> Float[np.ndarray, "n k"]:
        m = samples.q.shape[1]
        terms = list(combinations_with_replacement(range(m), degree))
        counts = [
            math.factorial(degree) / math.prod(math.factorial(t.count(i)) for i in set(t)) / m**degree for t in terms
        ]
        return np.prod(samples.x[:, np.array(terms, dtype=int).reshape(len(terms), degree)], axis=2) * np.sqrt(counts)

    return beta


def waves(multiple: int) -> Grade:
    """Sines and cosines of a multiple of each joint's angle."""

    def beta(samples: Samples) -> Float[np.ndarray, "n k"]:
        angle = multiple * (samples.q - samples.centre)
        return np.concatenate([np.sin(angle), np.cos(angle)], axis=1) / np.sqrt(2.0 * angle.shape[1])

    return beta


def offsets(samples: Samples) -> Float[np.ndarray, "n k"]:
    """A constant for each trajectory."""
    return np.eye(samples.n_trajectories)[samples.trajectory]


def radial(x: Float[np.ndarray, "n m"], n_centres: int, rng: np.random.Generator, width: float = 8.0) -> Grade:
    """Normalised Gaussian functions."""
    from scipy.cluster.vq import kmeans2

    few = x if len(x) <= 4000 else x[rng.choice(len(x), 4000, replace=False)]
    centres, _ = kmeans2(few, min(n_centres, len(np.unique(few, axis=0))), minit="++", seed=rng)
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    nearest = float(np.mean(np.min(gaps, axis=1))) if len(centres) > 1 else 1.0
    size = width * max(nearest, 1e-6)

    def beta(samples: Samples) -> Float[np.ndarray, "n k"]:
        d2 = np.sum((samples.x[:, None, :] - centres[None]) ** 2, axis=2) / (2.0 * size**2)
        d2 -= d2.min(axis=1, keepdims=True)
        phi = np.exp(-d2)
        return phi / phi.sum(axis=1, keepdims=True)

    return beta


@final
@dataclass(frozen=True, eq=False)
class Regressors:
    """beta of each sample, and what shares a variance."""

    values: Float[np.ndarray, "n k"]
    grades: Int[np.ndarray, " k"]

    @staticmethod
    def of(samples: Samples, grades: Sequence[Grade]) -> Regressors:
        parts = [grade(samples) for grade in grades]
        return Regressors(
            np.concatenate(parts, axis=1), np.repeat(np.arange(len(parts)), [part.shape[1] for part in parts])
        )


def curvature(beta: Float[np.ndarray, "n k"], N: Float[np.ndarray, "n nv nv"]) -> Float[np.ndarray, "c c"]:
    """sum beta beta^T (x) N, c = k nv: each pair of regressors and of joints once."""
    k, nv = beta.shape[1], N.shape[1]
    (i, j), (v, w) = np.triu_indices(k), np.triu_indices(nv)
    entries, rows = N[:, v, w], np.ascontiguousarray(beta.T)
    sums = np.zeros((len(i), len(v)))
    for start in range(0, len(beta), CHUNK):
        part = slice(start, start + CHUNK)
        own = rows[:, part]
        sums += np.concatenate([own[a] * own[a:] for a in range(k)]) @ entries[part]
    whole, out = np.empty((len(i), nv, nv)), np.empty((k, k, nv, nv))
    whole[:, v, w] = whole[:, w, v] = sums
    out[i, j] = out[j, i] = whole
    return out.transpose(0, 2, 1, 3).reshape(k * nv, k * nv)


def pull(beta: Float[np.ndarray, "n k"], values: Float[np.ndarray, "n nv m"]) -> Float[np.ndarray, "c m"]:
    """sum beta (x) values: the derivative by Theta, row by row, of what already lies in the null space."""
    n, nv, m = values.shape
    return (beta.T @ values.reshape(n, nv * m)).reshape(-1, m)


@final
class Solver:
    """(H + a trifle)^-1 by Cholesky's factor; SciPy's wrapping takes as long as LAPACK itself for few unknowns."""

    def __init__(self, H: Float[np.ndarray, "c c"]):
        self._scale = 1.0 / np.sqrt(np.maximum(np.diag(H), np.finfo(np.float64).tiny))
        scaled = self._scale[:, None] * H * self._scale
        for floor in (FLOOR, 1e3 * FLOOR, 1e6 * FLOOR):
            self._factor, failed = dpotrf(scaled + floor * np.eye(len(H)), lower=1, clean=0)
            if not failed:
                return  # else rounding has eaten a direction without curvature
        raise np.linalg.LinAlgError("the policy's normal equations are not positive definite")

    @property
    def log_determinant(self) -> float:
        """log |C + P|."""
        return 2.0 * float(np.sum(np.log(np.diag(self._factor) / self._scale)))

    def inverse(self) -> Float[np.ndarray, "c c"]:
        """The inverse itself, from the factor: a third of the cost of solving for the unit matrix."""
        half, _ = dpotri(self._factor, lower=1)
        lower = np.tril(half)
        return self._scale[:, None] * (lower + np.tril(half, -1).T) * self._scale

    def inverse_diagonal(self) -> Float[np.ndarray, " c"]:
        """Diagonal of the inverse, from the inverse of the factor."""
        back, _ = dtrtri(self._factor, lower=1)
        return self._scale**2 * np.sum(np.tril(back) ** 2, axis=0)

    def __call__(self, y: Float[np.ndarray, "c m"]) -> Float[np.ndarray, "c m"]:
        """Solution for several right sides."""
        if y.size == 0:
            return y
        return self._scale[:, None] * dpotrs(self._factor, self._scale[:, None] * y, lower=1)[0]


@final
@dataclass(frozen=True, eq=False)
class Projections:
    """What a Lambda in whitened coordinates makes of all samples.

    Attributes:
        N: Projectors onto the null spaces, shape (n, nv, nv).
        duals: A^{+T}, shape (n, s, nv).
        free: N (Lambda_perp Phi)^T, shape (n, nv, p'-s).
        along: c = Q^T u, shape (n, s).
    """

    N: Float[np.ndarray, "n nv nv"]
    duals: Float[np.ndarray, "n s nv"]
    free: Float[np.ndarray, "n nv k"]
    along: Float[np.ndarray, "n s"]

    @staticmethod
    def of(samples: Samples, Lambda: Float[np.ndarray, "s r"]) -> Projections:
        """For a Lambda in whitened coordinates."""
        both, s, parts = np.concatenate([Lambda, complement_rows(Lambda)]), len(Lambda), []
        for block in samples.blocks():
            rows = rows_beside(both, block.Phi)
            Q, R = row_bases(rows[:s].transpose(1, 0, 2))
            N = np.eye(samples.nv)[None] - Q.transpose(2, 0, 1) @ Q.transpose(2, 1, 0)
            back = np.ascontiguousarray(inverse_triangles_beside(R).transpose(2, 0, 1))
            # the signs make the basis of the row space turn as smoothly as A does
            along = np.einsum("vsn,nv,ssn->ns", Q, block.u, np.sign(R), optimize=True)
            parts.append((N, back @ Q.transpose(2, 1, 0), N @ rows[s:].transpose(2, 1, 0), along))
        return Projections(*map(np.concatenate, zip(*parts, strict=True)))

    def project(self, y: Float[np.ndarray, "n nv"]) -> Float[np.ndarray, "n nv"]:
        """N y of each sample."""
        return np.einsum("nij,nj->ni", self.N, y)

    def slopes(self, y: Float[np.ndarray, "n nv"]) -> Float[np.ndarray, "n nv m"]:
        """d N (u - pi) / d B for y = u - pi, Kaufman's form, entry by entry of B."""
        a = np.einsum("nsv,nv->ns", self.duals, y)
        return -(a[:, None, :, None] * self.free[:, :, None, :]).reshape(len(y), y.shape[1], -1)


@final
class ExactPolicy:
    """The policy of the least residual for a Lambda, by an orthonormal basis of what it can do.

    Normal equations lose half the digits, and a prior draws what the null spaces hardly show towards zero.
    """

    def __init__(self, samples: Samples, regressors: Regressors, Lambda: Float[np.ndarray, "s r"]):
        self.samples, self.regressors, self.Lambda = samples, regressors, Lambda
        self.at = Projections.of(samples, Lambda)
        beta, N = regressors.values, self.at.N
        Q, R = np.linalg.qr(np.einsum("nk,nvw->nvkw", beta, N).reshape(N.shape[0] * N.shape[1], -1))
        U, sigma, Vt = np.linalg.svd(R)
        kept = sigma > RANK * sigma[0]
        self._basis = Q @ U[:, kept]
        null_part = self.at.project(samples.u).reshape(-1)
        theta = Vt[kept].T @ (self._basis.T @ null_part / sigma[kept])
        self._y = samples.u - beta @ theta.reshape(-1, samples.nv)
        self._e = self._without_policy(self._without_policy(null_part))
        self.cost = float(self._e @ self._e)

    def _without_policy(self, rows: np.ndarray) -> np.ndarray:
        return rows - self._basis @ (self._basis.T @ rows)

    def moved(self, step: Float[np.ndarray, " m"]) -> ExactPolicy:
        """After a step."""
        return ExactPolicy(self.samples, self.regressors, turned(self.Lambda, step))

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient of the cost's half for B."""
        J = self.at.slopes(self._y)
        J = self._without_policy(J.reshape(-1, J.shape[2]))
        return J.T @ J, J.T @ self._e


@final
class Posterior:
    """The policy given a Lambda, in whitened coordinates, with the variances of the largest likelihood."""

    def __init__(
        self,
        samples: Samples,
        regressors: Regressors,
        Lambda: Float[np.ndarray, "s r"],
        before: Posterior | None = None,
    ):
        self.samples, self.regressors, self.Lambda = samples, regressors, Lambda
        self.at = Projections.of(samples, Lambda)
        self._curvature = curvature(regressors.values, self.at.N)
        null_part = self.at.project(samples.u)
        self.energy = float(np.sum(null_part**2))
        self._pulled = pull(regressors.values, null_part[:, :, None])[:, 0]
        self._grades = np.repeat(regressors.grades, samples.nv)
        self.n_residuals = len(samples) * (samples.nv - len(Lambda))
        scale = float(np.mean(samples.u**2))
        self._least = LEAST * scale
        if before is None:
            self._settle(0.1 * scale, np.full(int(regressors.grades.max()) + 1, START * scale), FIRST_UPDATES)
        else:
            self._settle(before.noise, before.variances, UPDATES)

    def _settle(self, noise: float, variances: Float[np.ndarray, " g"], updates: int) -> None:
        """MacKay's updates: sums of squares over the numbers of parameters, and of residuals, that data determine."""
        self._solve(noise, variances)
        for _ in range(updates):
            n_grades = len(self.variances)
            self.determined = np.maximum(
                np.bincount(self._grades, 1.0 - self.precision * self._solver.inverse_diagonal(), n_grades), DETERMINED
            )
            parameters = np.maximum(np.bincount(self._grades, self.theta**2, n_grades) / self.determined, self._least)
            freedom = max(self.n_residuals - float(self.determined.sum()), 1.0)
            self._solve(max(self.residual / freedom, self._least), parameters)

    def _solve(self, noise: float, variances: Float[np.ndarray, " g"]) -> None:
        self.noise, self.variances = noise, variances
        self.precision = noise / variances[self._grades]
        self._solver = Solver(self._curvature + np.diag(self.precision))
        self.theta = self._solver(self._pulled[:, None])[:, 0]
        self.y = self.samples.u - self.regressors.values @ self.theta.reshape(-1, self.samples.nv)
        self.residual = float(np.sum(self.at.project(self.y) ** 2))

    @property
    def cost(self) -> float:
        """- 2 log N, see the module."""
        return self.cost_at_least(0.0)

    def cost_at_least(self, noise: float) -> float:
        """The same with a noise of at least this variance."""
        log_prior = float(np.sum(np.log(self.precision)))
        penalty = float(np.sum(self.precision * self.theta**2))
        noise = max(noise, self.noise)
        return (
            self.n_residuals * math.log(noise) + self._solver.log_determinant - log_prior + (self.residual + penalty) / noise
        )

    def moved(self, step: Float[np.ndarray, " m"]) -> Posterior:
        """After a step, settled from the variances here."""
        return Posterior(self.samples, self.regressors, turned(self.Lambda, step), self)

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient of the cost's half for B."""
        J, beta = self.at.slopes(self.y), self.regressors.values
        n, nv, m = J.shape
        theta = self._solver(pull(beta, J))
        by_theta = (beta @ theta.reshape(beta.shape[1], nv * m)).reshape(n, nv, m)
        rows = (J - self.at.N @ by_theta).reshape(-1, m)
        H, gradient = rows.T @ rows + theta.T @ (self.precision[:, None] * theta), rows.T @ self.y.reshape(-1)
        return H / self.noise, gradient / self.noise + self._spread_slopes(np.ones(n))[0]

    def _spread_slopes(self, weights: Float[np.ndarray, "*g n"]) -> Float[np.ndarray, "g m"]:
        """Half the derivative by B of log |C + P|, each sample's share weighted: that of the posterior spread of pi."""
        beta, nv = self.regressors.values, self.samples.nv
        k = beta.shape[1]
        (i, j), (v, w) = np.triu_indices(k), np.triu_indices(nv)
        inverse = self._solver.inverse().reshape(k, nv, k, nv).transpose(0, 2, 1, 3)[i, j]
        shares = (inverse[:, v, w] + inverse[:, w, v]) * np.where(i == j, 0.5, 1.0)[:, None]
        slopes, rows = [], np.ascontiguousarray(beta.T)
        for start in range(0, len(beta), CHUNK):
            part = slice(start, start + CHUNK)
            own = rows[:, part]
            entries = np.concatenate([own[a] * own[a:] for a in range(k)]).T @ shares
            spread = np.empty((len(entries), nv, nv))
            spread[:, v, w] = spread[:, w, v] = entries
            slopes.append(-np.einsum("nsv,nvw,nwk->nsk", self.at.duals[part], spread, self.at.free[part], optimize=True))
        return np.atleast_2d(weights) @ np.concatenate(slopes).reshape(len(beta), -1)

    def blocks(self) -> list[slice]:
        return [part for _, part in in_blocks(self.samples.trajectory, self.samples.n_trajectories, MAX_BLOCKS)]

    def held_out(self) -> float:
        """Mean of |Z^T (u - pi)|^2 on recordings that pi was not fitted to, each left out in its turn."""
        beta, total, parts = self.regressors.values, 0.0, self.blocks()
        if len(parts) < 2:
            return math.inf
        whole = self._curvature + np.diag(self.precision)
        for part in parts:
            e = self.at.project(self.y)[part]
            without = Solver(whole - curvature(beta[part], self.at.N[part]))
            change = without(-pull(beta[part], e[:, :, None]))[:, 0]
            left = self.y[part] - beta[part] @ change.reshape(-1, self.samples.nv)
            total += float(np.sum(np.einsum("nij,nj->ni", self.at.N[part], left) ** 2))
        return total / len(beta)

    def scores(self) -> tuple[Float[np.ndarray, "g d"], Float[np.ndarray, "g d d"]]:
        """Gradient and Hessian of sigma^2 l of each block of trajectories, for (Theta, B), see `_without_noise`.

        With e = N y and dLambda = B Lambda_perp: d e / d Theta_kv = -beta_k N_v, d e / d B as in `slopes`.
        """
        beta, parts, sums = self.regressors.values, self.blocks(), []
        membership = np.zeros((len(parts), len(beta)))
        J, e = self.at.slopes(self.y), self.at.project(self.y)
        for own, part in zip(membership, parts, strict=True):
            own[part] = 1.0
            flat, crossed = J[part].reshape(-1, J.shape[2]), -pull(beta[part], J[part])
            gradient = [-pull(beta[part], e[part][:, :, None])[:, 0], flat.T @ e[part].reshape(-1)]
            H = np.block([[curvature(beta[part], self.at.N[part]), crossed], [crossed.T, flat.T @ flat]])
            sums.append((np.concatenate(gradient), H))
        gradients, hessians = map(np.array, zip(*sums, strict=True))
        gradients[:, len(self.theta) :] += self.noise * self._spread_slopes(membership)
        return gradients, self._without_noise(hessians, membership)

    def _without_noise(
        self, hessians: Float[np.ndarray, "g d d"], membership: Float[np.ndarray, "g n"]
    ) -> Float[np.ndarray, "g d d"]:
        """Gauss-Newton Hessians without what the noise of u adds to them in the mean.

        A^{+T} (u - pi) carries noise of covariance sigma^2 A^{+T} A^+, independent of the residual's; the curvature of
        l itself has no such part (errors in variables). Where noise is most of the Hessian in some direction, no more
        is taken off than leaves it positive (Fuller, 1987, section 2.5: the least root less one over the samples).
        """
        C, F = self.at.duals @ self.at.duals.transpose(0, 2, 1), self.at.free.transpose(0, 2, 1) @ self.at.free
        each = np.einsum("gn,nst,nkl->gsktl", membership, C, F, optimize=True)
        c, m = len(self.theta), C.shape[1] * F.shape[1]
        added = self.noise * each.reshape(-1, m, m)
        total = hessians.sum(axis=0)
        own = total[c:, c:] - total[c:, :c] @ self._solver(total[:c, c:])
        least = 1.0 / float(np.max(np.linalg.eigvals(np.linalg.solve(own, added.sum(axis=0))).real, initial=1e-300))
        share = min(1.0, least * (1.0 - 1.0 / len(self.samples)))
        hessians[:, c:, c:] -= share * added
        return hessians

    def task_nats(self, floor: float) -> float:
        """Log-likelihood of the task's own motion c, octave by octave, less the price of its parameters."""
        c = self.at.along
        if not c.shape[1]:
            return 0.0
        squares, counts = np.zeros(64), np.zeros(64)
        for own in (c[part] for _, part in runs(self.samples.trajectory)):
            octave = np.frexp(np.arange(len(own)))[1]  # 0, then 1, 2-3, 4-7, ...
            squares += np.bincount(octave, np.sum(dct(own, axis=0, norm="ortho") ** 2, axis=1), 64)
            counts += np.bincount(octave, minlength=64) * c.shape[1]
        used = counts > 0
        mean = squares[used] / counts[used]
        variance = np.maximum(mean, floor)
        price = np.count_nonzero(used) * math.log(len(c))
        return -0.5 * float(np.sum(counts[used] * (np.log(variance) + mean / variance)) + price)

    def nats(self, floor: float) -> float:
        s, r = self.Lambda.shape
        return (
            self.task_nats(floor)
            - 0.5 * self.cost_at_least(floor)
            - 0.5 * s * (r - s) * math.log(len(self.samples))
            + (0.0 if self.samples.mixing is None else len(self.samples) * np.linalg.slogdet(self.samples.mixing)[1])
        )


def conditional_pca(samples: Samples, beta: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "r r"]:
    """A closed-form start: directions of whitened feature space by how much the task moved along them, most first.

    g = (Phi Phi^T)^-1 Phi u = G pi(q) + Lambda^T c, so that what a regression of g on the posture leaves over lies in
    the row space of Lambda. Its covariance C is compared with that of isotropic noise: C x = e (sum G G^T) x, and the
    row space is spanned by (sum G G^T) x of the largest e.
    """
    r = samples.n_rows
    Phi = np.concatenate([block.Phi for block in samples.blocks()])
    gram = np.einsum("npv,nqv->npq", Phi, Phi, optimize=True)
    GG = np.linalg.pinv(gram, rcond=1e-10, hermitian=True)
    g = np.einsum("npq,nqv,nv->np", GG, Phi, samples.u, optimize=True)
    # near-singular postures count little
    weight = 1.0 / np.maximum(np.einsum("npp->n", GG), np.finfo(np.float64).tiny)
    root = np.sqrt(weight)[:, None]
    left = g * root - beta * root @ np.linalg.lstsq(beta * root, g * root, rcond=1e-12)[0]
    S = np.einsum("n,nij->ij", weight, GG, optimize=True)
    S += 1e-14 * np.trace(S) / r * np.eye(r)
    eigenvalues, vectors = eigh(left.T @ left, S)
    return (S @ vectors[:, ::-1]).T


def noise_in_time(samples: Samples) -> float:
    e = _differences(samples)
    return float(np.mean((np.median(np.abs(e), axis=0) / MEDIAN) ** 2)) if len(e) else 0.0


def _differences(samples: Samples) -> Float[np.ndarray, "k nv"]:
    inside = samples.trajectory[DIFFERENCES:] == samples.trajectory[:-DIFFERENCES]
    return np.diff(samples.u, DIFFERENCES, axis=0)[inside] / np.sqrt(math.comb(2 * DIFFERENCES, DIFFERENCES))


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


def shape_of_residual(fit: Posterior) -> Float[np.ndarray, "nv nv"]:
    """Least squares of e e^T = N Sigma N over all samples, drawn to the unit matrix where they say nothing."""
    N, e = fit.at.N, fit.at.project(fit.y) / math.sqrt(fit.noise)
    n, nv = e.shape
    M = np.einsum("nij,nkl->ikjl", N, N, optimize=True).reshape(nv * nv, nv * nv) / n
    right = (e.T @ e / n).reshape(-1) - M @ np.eye(nv).reshape(-1)
    deviation = np.linalg.solve(M + PRIOR * np.eye(nv * nv), right).reshape(nv, nv)
    values, vectors = np.linalg.eigh(np.eye(nv) + 0.5 * (deviation + deviation.T))
    Sigma = (vectors * np.clip(values, *NOISE_RANGE)) @ vectors.T
    return Sigma * nv / np.trace(Sigma)


def whitened(samples: Samples, Sigma: Float[np.ndarray, "nv nv"]) -> Samples:
    """The samples as L^-1 u and Phi L^-T, Sigma = L L^T: A u = 0 does not hold for these."""
    back = np.linalg.inv(np.linalg.cholesky(Sigma))
    mixing = back.T if samples.mixing is None else samples.mixing @ back.T
    return dataclasses.replace(samples, u=samples.u @ back.T, mixing=mixing)


@final
@dataclass(frozen=True, eq=False)
class Prior:
    """Grades of the policy with their names."""

    grades: tuple[tuple[str, Grade], ...]

    def regressors(self, samples: Samples) -> Regressors:
        return Regressors.of(samples, [grade for _, grade in self.grades])


@final
class Imposed:
    """The search on some samples."""

    def __init__(self, samples: Samples, prior: Prior, rng: np.random.Generator, floor: float):
        self.samples, self.regressors, self.rng = samples, prior.regressors(samples), rng
        self.floor = floor
        self.enough = ABOVE_NOISE * max(noise_in_time(samples), floor)
        x, beta = samples.x, self.regressors.values
        affine = np.concatenate([np.ones((len(x), 1)), x], axis=1)
        self.starts = [conditional_pca(samples, affine)]
        if len(samples) > 2 * beta.shape[1]:
            self.starts.append(conditional_pca(samples, beta))

    def fit(self, s: int, further: Iterable[np.ndarray] = (), n_random: int = RANDOM_STARTS) -> Posterior:
        """The most likely Lambda of s rows, from one start after the other until noise alone is left."""
        r, best = self.samples.n_rows, None
        random = (self.rng.standard_normal((s, r)) for _ in range(n_random))
        for start in itertools.chain((one[:s] for one in self.starts), further, random):
            here = self.descended(Posterior(self.samples, self.regressors, orthonormal_rows(start)), LOOK_STEPS)
            best = here if best is None or here.cost < best.cost else best
            if s in (0, r) or best.noise <= self.enough:
                break
        assert best is not None
        return self.descended(best, STEPS)

    @staticmethod
    def descended(here: Posterior, steps: int) -> Posterior:
        s, r = here.Lambda.shape
        if s in (0, r):
            return here
        return descend(here, Posterior.moved, steps, settled=lambda _, step, H: float(step @ H @ step) < SETTLED)

    def by_rows(self, asked: int | None) -> dict[int, Posterior]:
        """The best of each number of rows, up to the one that leaves noise alone."""
        found: dict[int, Posterior] = {}
        for s in range(min(self.samples.n_rows, self.samples.nv - 1) + 1):
            found[s] = self.fit(s)
            if found[s].noise <= self.enough and s >= (asked or 1):
                break
        return found


def general(samples: Samples) -> Prior:
    grades, n = [], 0
    for name in GENERAL:
        grade = monomials(NAMES.index(name)) if name in NAMES else waves(int(name[-1]))
        width = grade(samples.subset(np.arange(len(samples)) < 2)).shape[1]
        if (n + width) * samples.nv <= MOST_COLUMNS:
            grades.append((name, grade))
            n += width
    return Prior(tuple(grades))


def exact(posterior: Posterior, priors: Iterable[tuple[str, Prior]]) -> tuple[str, ExactPolicy]:
    """Least squares."""
    samples, best = posterior.samples, None
    for name, prior in priors:
        here = ExactPolicy(samples, prior.regressors(samples), posterior.Lambda)
        s, r = here.Lambda.shape
        if 0 < s < r:
            here = descend(here, ExactPolicy.moved, 30, tolerance=1e-13, gain=1e-9)
        if best is None or here.cost < 0.8 * best[1].cost:
            best = name, here
        if here.cost <= 1e-24 * posterior.energy:
            break
    return best


def estimate_imposed(samples, n_constraints, rng, policy_model="auto", unexplained=np.inf):
    few = samples.thinned(COMPARE_LIMIT)
    prior = general(few)
    floor = RESOLVED_SHARE**2 * samples.energy / samples.nv
    search = Imposed(few, prior, rng, floor)
    found = search.by_rows(n_constraints)
    best = max(found.values(), key=lambda one: one.nats(floor))
    first = found[n_constraints] if n_constraints else best
    S = shape_in_time(few)
    if S is not None and np.linalg.cond(S) >= UNEQUAL_NOISE and first.noise > EXACT * samples.energy:
        search = Imposed(whitened(few, S), prior, rng, floor)
        other = search.by_rows(n_constraints)
        second = other[n_constraints] if n_constraints else max(other.values(), key=lambda one: one.nats(floor))
        if second.nats(floor) > first.nats(floor):
            found, first = other, second
            samples = whitened(samples, S)
            best = max(found.values(), key=lambda one: one.nats(floor))
    s = len(first.Lambda)
    residuals = {k: math.sqrt(one.noise) for k, one in found.items()}
    table = dataclasses.replace(gaps_of_residuals(residuals, 1e-15 * math.sqrt(samples.energy), len(few)), best=len(best.Lambda))
    if s == 0:
        raise NotIdentifiableError("no task", code="no-task")
    name = "+".join(n for (n, _), d in zip(prior.grades, first.determined) if d >= 1)
    if first.noise <= EXACT * samples.energy:
        candidates = [Prior(tuple((NAMES[d], monomials(d)) for d in range(degree + 1))) for degree in (1, 2, 3, 4, 5)]
        priors = list(zip(NAMES[1:], candidates)) + [("harmonic1", Prior((*candidates[0].grades, ("w", waves(1)))))]
        priors = sorted(((n, p, p.regressors(few).values.shape[1]) for n, p in priors), key=lambda x: x[2])
        name, e = exact(first, [(n, p) for n, p, w in priors if w * samples.nv <= MOST_COLUMNS])
        first = Posterior(few, prior.regressors(few), e.Lambda)
    else:
        first = Imposed.descended(Posterior(samples, prior.regressors(samples), first.Lambda), STEPS)
        for _ in range(2):
            Sigma = shape_of_residual(first)
            if np.linalg.cond(Sigma) < UNEQUAL_NOISE:
                break
            w = whitened(samples, Sigma)
            other = Imposed.descended(Posterior(w, first.regressors, first.Lambda), STEPS)
            if other.nats(floor) <= first.nats(floor):
                break
            first, samples = other, w
    gradients, hessians = first.scores()
    precision = np.append(first.precision, np.zeros(hessians.shape[1] - len(first.precision)))
    held = first.held_out()
    energy = max(first.energy / len(first.samples), 1e-16 * samples.energy)
    return Estimate("joint", first.Lambda, table, first.residual / len(first.samples) / energy, held / energy, gradients, hessians, name, {name: held / energy}, held / (samples.nv - s), prior=PolicyPrior(precision, first.noise))
