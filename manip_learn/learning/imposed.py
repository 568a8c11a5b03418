"""The constraint that the demonstrator imposes: Lambda and the null-space policy together, from raw (q, u), b unknown.

A Lambda of s rows accounts for all of u_n = Q_n c_n + Z_n w_n, Q_n and Z_n orthonormal bases of the rows and of the
null space of A_n = Lambda Phi(q_n). w_n is a policy of the posture and white noise of variance sigma^2; c_n is the
task's own motion, of which nothing is known but that it is a signal in time. [Q Z] is orthonormal, so that the
likelihoods of all Lambda, whatever their number of rows, are those of the same numbers: in nats

    l(Lambda) = - sum_k N_k / 2 (log S_k + 1) - d / 2 log n + log N(Z^T u; 0, sigma^2 I + K T K^T)

S_k is the mean square, per row, of Q c in octave k of the cosine transform of each trajectory, which has N_k entries;
d is the number of these octaves and of the entries of Lambda (Schwarz, 1978). A row too many takes a direction that the
policy predicts to the noise for one of which nothing is known: it costs log(S / sigma^2) / 2 a sample. Rows that are
held are judged by the same l, with Z w for the signal in time and c for the noise.

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
from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from statistics import NormalDist
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.fft import dct
from scipy.linalg import eigh
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtri
from scipy.spatial import cKDTree

from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.descent import descend
from manip_learn.learning.estimate import Estimate, GapTable, PolicyPrior
from manip_learn.learning.samples import CUBIC, Samples, in_blocks, rows_beside, runs
from manip_learn.linalg import complement_rows, inverse_triangles_beside, orthonormal_rows, row_bases, turned

# polynomials by their degree
POLYNOMIALS = ("constant", "affine", "quadratic", "cubic", "quartic", "quintic")
OWN = "affine-offset"  # affine, and a rest posture of each trajectory
# grades of the general prior, taken in this order while there is room. Set by hand
GENERAL = ("constant", "affine", "harmonic1", "quadratic", "cubic", "harmonic2")
RADIAL_CENTRES = 32  # of the radial policy. Set by hand
MOST_COLUMNS = 400  # parameters of the policy: the time of a step grows with their cube
# samples that the search looks at; more of them only sharpen what it found
COMPARE_LIMIT = 1_500
CHUNK, KEEP_LIMIT = 1024, 10_000_000  # samples whose products of regressors are made at a time; kept products [numbers]
PARTS = 10  # that are left out in turn, at most
# left-out motion over that of no policy up to which a policy predicts it: 1 where there is noise alone to predict
PREDICTS = 1.2
MAX_BLOCKS = 100  # more trajectories than this are taken in blocks: a Hessian of each, for Theta too, is kept

# share of the root mean square of u that is noise enough to tell hypotheses apart: what is resolved below it is how
# well features approximate the policy, and with more rows they come closer. Set by hand
RESOLVED_SHARE = 1e-3
# variance over that of the noise up to which a fit leaves noise alone: 22 % in amplitude. Set by hand
ABOVE_NOISE = 1.5
# variance over the mean square of u: of the noise, least, where normal equations end; of noise and parameters at first
LEAST, FIRST_NOISE, FIRST_SPREAD = 1e-12, 0.1, 4.0
# share of the motion below which a residual is no noise, and least squares answer; and that is rounding
NO_NOISE, ROUNDING = 1e-8, 1e-24
VANISHING = 1e-16  # share of the energy that is rounding where nothing moves in the null space
FIRST_UPDATES, UPDATES = 4, 2  # of the variances before the first step, and after each
# number of parameters of a grade below which it is dropped; and least that counts
SPENT, DETERMINED = 0.1, 1e-6
FLOOR = 1e-13  # share of each curvature added, so that directions without data stay where they are
RANK = 1e-13  # of the largest singular value: rounding of some hundred columns
SETTLED = 1e-6  # squared length of the last step in standard errors
LOOK_STEPS, STEPS = 6, 40  # of a first look at a start, and of a descent
RICHER = 0.5  # of what a smaller model leaves without noise, that a richer one may leave to be taken
EXACT_STEPS = 30  # of the descent by least squares, which ends by itself before
RANDOM_STARTS, SUBSPACES = 3, 4  # starts where no closed-form one leads to the noise; within the rows that were found
# a rest posture for each trajectory makes the cost bumpy: many starts on a few trajectories and samples
FEW, FEW_SAMPLES, MANY_STARTS = 16, 600, 40
OWN_SHARE = 1e-6  # of what is noise enough elsewhere

COVARIANCES = 2  # of the noise, each by the residual of a fit with the one before
# largest variance of a joint's noise over the least below which equal weights cost a few per cent at most
UNEQUAL_NOISE = 2.0
NOISE_RANGE = (1e-2, 1e2)  # variances of the joints' noise beside their mean. Set by hand
PRIOR = 1e-3  # weight of the isotropic covariance in samples per sample, for entries that the null spaces hardly show
RESIDUALS_PER_ENTRY, TYLER_STEPS = 20, 10  # differences for each joint, below which no shape is estimated; its steps
DIFFERENCES = CUBIC - 1  # of neighbouring samples: motion that is a parabola over four samples leaves nothing
MEDIAN = NormalDist().inv_cdf(0.75)  # of the absolute value of a standard normal variable
# root mean square distance from a path over its extent within which a motion repeats it: replays with 3 % of another
# motion in them have 0.05 to 0.14, generated reaches in threes and more 0.32 and above (12, 192 sets, seeds from 30000)
SAME_PATH = 0.15
MOST_POSTURES = 2_000  # between the samples of a path, against noise that makes it long

Grade = Callable[[Samples], Float[np.ndarray, "n k"]]
Part = slice | Int[np.ndarray, " k"]  # some samples


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
    """Normalised Gaussian radial basis functions with one shared width.

    Args:
        x: Postures among which k-means puts the centres.
        n_centres: Number of centres.
        rng: For k-means.
        width: In units of the mean distance between neighbouring centres; wide ones fit smooth policies best.
    """
    from scipy.cluster.vq import kmeans2

    few = x if len(x) <= 4000 else x[rng.choice(len(x), 4000, replace=False)]
    centres, _ = kmeans2(few, min(n_centres, len(np.unique(few, axis=0))), minit="++", seed=rng)
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    nearest = float(np.mean(np.min(gaps, axis=1))) if len(centres) > 1 else 1.0
    size = width * max(nearest, 1e-6)

    def beta(samples: Samples) -> Float[np.ndarray, "n k"]:
        d2 = np.sum((samples.x[:, None, :] - centres[None]) ** 2, axis=2) / (2.0 * size**2)
        d2 -= d2.min(axis=1, keepdims=True)  # the nearest centre always counts: no 0 / 0 far away
        phi = np.exp(-d2)
        return phi / phi.sum(axis=1, keepdims=True)

    return beta


GRADES: dict[str, Grade] = {
    **{name: monomials(degree) for degree, name in enumerate(POLYNOMIALS)},
    "harmonic1": waves(1),
    "harmonic2": waves(2),
    "offset": offsets,
}
# policy models that can be asked for, or that may describe a policy exactly
MODELS = {
    **{name: POLYNOMIALS[: degree + 1] for degree, name in enumerate(POLYNOMIALS)},
    "harmonic1": ("constant", "affine", "harmonic1"),
    "harmonic2": ("constant", "affine", "harmonic1", "harmonic2"),
    OWN: ("affine", "offset"),
}


def grades_of(samples: Samples, policy_model: str, rng: np.random.Generator) -> dict[str, Grade]:
    """The grades of a policy model; of the general prior those for whose parameters there is room.

    Raises:
        NotIdentifiableError: There is no model of that name.
    """
    if policy_model == "rbf":
        return {f"rbf{RADIAL_CENTRES}": radial(samples.x, RADIAL_CENTRES, rng)}
    if policy_model in (*POLYNOMIALS, OWN):
        return {name: GRADES[name] for name in MODELS[policy_model]}
    if policy_model != "auto":
        raise NotIdentifiableError(
            f"unknown policy model {policy_model!r}: use 'auto', 'rbf', {OWN!r} or one of {', '.join(POLYNOMIALS)}",
            code="policy-model",
        )
    out = dict[str, Grade]()
    for name in GENERAL:
        if n_columns(samples, [*out, name]) <= MOST_COLUMNS:
            out[name] = GRADES[name]
    return out


def n_columns(samples: Samples, names: Iterable[str]) -> int:
    """Parameters of a policy with some grades."""
    one = samples.subset(np.arange(len(samples)) == 0)
    return samples.nv * sum(GRADES[name](one).shape[1] for name in names)


@final
@dataclass(frozen=True, eq=False)
class Regressors:
    """beta of each sample.

    Attributes:
        values: Shape (n, k).
        grades: Grade of each regressor, which share a variance, counted from 0, shape (k,).
    """

    values: Float[np.ndarray, "n k"]
    grades: Int[np.ndarray, " k"]
    _kept: list[np.ndarray] = field(default_factory=list, repr=False)

    @staticmethod
    def of(samples: Samples, grades: Sequence[Grade]) -> Regressors:
        """Those of some grades."""
        parts = [grade(samples) for grade in grades]
        widths = [part.shape[1] for part in parts]
        return Regressors(np.concatenate(parts, axis=1), np.repeat(np.arange(len(parts)), widths))

    def only(self, kept: Bool[np.ndarray, " k"]) -> Regressors:
        """Those that are kept, with the numbers of their grades."""
        return Regressors(self.values[:, kept], self.grades[kept])

    def products(self) -> Iterator[tuple[slice, Float[np.ndarray, "g m"]]]:
        """Products of all pairs of regressors, some samples at a time; kept for the next pass where they are few."""
        n, k = self.values.shape
        keep, rows = n * k * (k + 1) // 2 <= KEEP_LIMIT, np.ascontiguousarray(self.values.T)
        for i, start in enumerate(range(0, n, CHUNK)):
            part = slice(start, start + CHUNK)
            if i < len(self._kept):
                yield part, self._kept[i]
                continue
            pairs = np.concatenate([row[part] * rows[a:, part] for a, row in enumerate(rows)])
            if keep:
                self._kept.append(pairs)
            yield part, pairs

    def curvature(self, N: Float[np.ndarray, "n nv nv"]) -> Float[np.ndarray, "c c"]:
        """sum beta beta^T (x) N, c = k nv: each pair of regressors and of joints once."""
        k, nv = self.values.shape[1], N.shape[1]
        (i, j), (v, w) = np.triu_indices(k), np.triu_indices(nv)
        entries, whole, out = N[:, v, w], np.empty((len(i), nv, nv)), np.empty((k, k, nv, nv))
        whole[:, v, w] = whole[:, w, v] = np.sum([pairs @ entries[part] for part, pairs in self.products()], axis=0)
        out[i, j] = out[j, i] = whole
        return out.transpose(0, 2, 1, 3).reshape(k * nv, k * nv)

    def part(self, samples: Part) -> Regressors:
        """Those of some samples."""
        return Regressors(self.values[samples], self.grades)


def parts_of(samples: Samples, most: int, own: bool = False) -> list[Part]:
    """Trajectories, or blocks of them; or samples dealt out in turn, where a trajectory has an offset of its own."""
    if own:
        return [np.arange(k, len(samples), most) for k in range(most)]
    return [part for _, part in in_blocks(samples.trajectory, samples.n_trajectories, most)]


def pull(beta: Float[np.ndarray, "n k"], values: Float[np.ndarray, "n nv m"]) -> Float[np.ndarray, "c m"]:
    """sum beta (x) values: the derivative by Theta, row by row, of what already lies in the null space."""
    n, nv, m = values.shape
    return (beta.T @ values.reshape(n, nv * m)).reshape(beta.shape[1] * nv, m)


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
    """

    N: Float[np.ndarray, "n nv nv"]
    duals: Float[np.ndarray, "n s nv"]
    free: Float[np.ndarray, "n nv k"]

    @staticmethod
    def of(samples: Samples, Lambda: Float[np.ndarray, "s r"]) -> Projections:
        """For a Lambda in whitened coordinates."""
        both, s, parts = np.concatenate([Lambda, complement_rows(Lambda)]), len(Lambda), []
        for block in samples.blocks():
            rows = rows_beside(both, block.Phi)
            Q, R = row_bases(rows[:s].transpose(1, 0, 2))
            N = np.eye(samples.nv)[None] - Q.transpose(2, 0, 1) @ Q.transpose(2, 1, 0)
            back = np.ascontiguousarray(inverse_triangles_beside(R).transpose(2, 0, 1))
            parts.append((N, back @ Q.transpose(2, 1, 0), N @ rows[s:].transpose(2, 1, 0)))
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
        self.y = samples.u - beta @ theta.reshape(-1, samples.nv)
        self._e = self._without_policy(self._without_policy(null_part))
        self.cost = self.residual = float(self._e @ self._e)
        self.energy = float(null_part @ null_part)

    def _without_policy(self, rows: np.ndarray) -> np.ndarray:
        return rows - self._basis @ (self._basis.T @ rows)

    def moved(self, step: Float[np.ndarray, " m"]) -> ExactPolicy:
        """After a step."""
        return ExactPolicy(self.samples, self.regressors, turned(self.Lambda, step))

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient of the cost's half for B."""
        J = self._slopes()
        return J.T @ J, J.T @ self._e

    def _slopes(self) -> Float[np.ndarray, "k m"]:
        J = self.at.slopes(self.y)
        return self._without_policy(J.reshape(len(self._e), J.shape[2]))

    def _blocks(self, parts: Iterable[Part]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        nv = self.samples.nv
        rows = np.arange(len(self._e)).reshape(-1, nv)
        return ((rows[part].reshape(-1), self._basis[rows[part].reshape(-1)]) for part in parts)

    def held_out(self, parts: Sequence[Part]) -> float:
        """Mean of |Z^T (u - pi)|^2 on the parts, each left out of the policy in its turn."""
        total = 0.0
        for rows, own in self._blocks(parts):
            rest = np.eye(own.shape[1]) - own.T @ own
            left = self._e[rows] + own @ np.linalg.lstsq(rest, own.T @ self._e[rows], rcond=RANK)[0]
            total += float(left @ left)
        return total / len(self.samples)

    def scores(self) -> tuple[Float[np.ndarray, "g d"], Float[np.ndarray, "g d d"]]:
        """As `Posterior.scores`, for the policy in its orthonormal basis, already eliminated from Lambda."""
        J, sums = self._slopes(), []
        for rows, own in self._blocks(parts_of(self.samples, MAX_BLOCKS)):
            both = np.concatenate([own, J[rows]], axis=1)
            sums.append((both.T @ self._e[rows], both.T @ both))
        gradients, hessians = map(np.array, zip(*sums, strict=True))
        return gradients, hessians


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
        self._curvature = regressors.curvature(self.at.N)
        null_part = self.at.project(samples.u)
        self.energy = float(np.sum(null_part**2))
        self._pulled = pull(regressors.values, null_part[:, :, None])[:, 0]
        self._grades = np.repeat(regressors.grades, samples.nv)
        self.n_residuals = len(samples) * (samples.nv - len(Lambda))
        scale = float(np.mean(samples.u**2))
        self._least = LEAST * scale
        if before is None:
            self._settle(
                FIRST_NOISE * scale, np.full(int(regressors.grades.max()) + 1, FIRST_SPREAD * scale), FIRST_UPDATES
            )
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
            self.n_residuals * math.log(noise)
            + self._solver.log_determinant
            - log_prior
            + (self.residual + penalty) / noise
        )

    def moved(self, step: Float[np.ndarray, " m"]) -> Posterior:
        """After a step, settled from the variances here."""
        enough = min(SPENT, float(self.determined.max()))  # the last grade stays, whatever little it explains
        kept = (self.determined >= enough)[self.regressors.grades]
        regressors = self.regressors if np.all(kept) else self.regressors.only(kept)
        return Posterior(self.samples, regressors, turned(self.Lambda, step), self)

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient of the cost's half for B."""
        J = self.at.slopes(self.y)
        KJ, rows = pull(self.regressors.values, J), J.reshape(self.y.size, J.shape[2])
        H, gradient = rows.T @ rows - KJ.T @ self._solver(KJ), rows.T @ self.y.reshape(-1)
        return H / self.noise, gradient / self.noise + self._spread_slopes(np.ones(len(self.y)))[0]

    def _spread_slopes(self, weights: Float[np.ndarray, "*g n"]) -> Float[np.ndarray, "g m"]:
        """Half the derivative by B of log |C + P|, each sample's share weighted: that of the posterior spread of pi."""
        beta, nv = self.regressors.values, self.samples.nv
        k = beta.shape[1]
        (i, j), (v, w) = np.triu_indices(k), np.triu_indices(nv)
        inverse = self._solver.inverse().reshape(k, nv, k, nv).transpose(0, 2, 1, 3)[i, j]
        shares = (inverse[:, v, w] + inverse[:, w, v]) * np.where(i == j, 0.5, 1.0)[:, None]
        slopes = []
        for part, pairs in self.regressors.products():
            entries = pairs.T @ shares
            spread = np.empty((len(entries), nv, nv))
            spread[:, v, w] = spread[:, w, v] = entries
            slopes.append(
                -np.einsum("nsv,nvw,nwk->nsk", self.at.duals[part], spread, self.at.free[part], optimize=True)
            )
        return np.atleast_2d(weights) @ np.concatenate(slopes).reshape(len(beta), -1)

    def held_out(self, parts: Sequence[Part]) -> float:
        """Mean of |Z^T (u - pi)|^2 on the parts, each left out of the policy in its turn."""
        beta, e, total = self.regressors.values, self.at.project(self.y), 0.0
        whole = self._curvature + np.diag(self.precision)
        for part in parts:
            without = Solver(whole - self.regressors.part(part).curvature(self.at.N[part]))
            change = without(-pull(beta[part], e[part][:, :, None]))[:, 0]
            left = self.y[part] - beta[part] @ change.reshape(-1, self.samples.nv)
            total += float(np.sum(np.einsum("nij,nj->ni", self.at.N[part], left) ** 2))
        return total / len(beta)

    def scores(self) -> tuple[Float[np.ndarray, "g d"], Float[np.ndarray, "g d d"]]:
        """Gradient and Hessian of sigma^2 l of each block of trajectories, for (Theta, B), see `_without_noise`.

        With e = N y and dLambda = B Lambda_perp: d e / d Theta_kv = -beta_k N_v, d e / d B as in `slopes`.
        """
        beta, parts, sums = self.regressors.values, parts_of(self.samples, MAX_BLOCKS), []
        membership = np.zeros((len(parts), len(beta)))
        J, e = self.at.slopes(self.y), self.at.project(self.y)
        for own, part in zip(membership, parts, strict=True):
            own[part] = 1.0
            flat, crossed = J[part].reshape(e[part].size, J.shape[2]), -pull(beta[part], J[part])
            gradient = [-pull(beta[part], e[part][:, :, None])[:, 0], flat.T @ e[part].reshape(-1)]
            H = np.block([[self.regressors.part(part).curvature(self.at.N[part]), crossed], [crossed.T, flat.T @ flat]])
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
        c, m = len(self.theta), C.shape[1] * F.shape[1]
        if m == 0:
            return hessians
        each = np.einsum("gn,nst,nkl->gsktl", membership, C, F, optimize=True)
        added = self.noise * each.reshape(-1, m, m)
        total = hessians.sum(axis=0)
        own = total[c:, c:] - total[c:, :c] @ self._solver(total[:c, c:])
        least = 1.0 / float(np.max(np.linalg.eigvals(np.linalg.solve(own, added.sum(axis=0))).real, initial=1e-300))
        share = min(1.0, least * (1.0 - 1.0 / len(self.samples)))
        hessians[:, c:, c:] -= share * added
        return hessians

    def nats(self, floor: float) -> float:
        """l, see the module, with a noise of at least this variance [(rad/s)^2]."""
        s, samples = len(self.Lambda), self.samples
        task = _signal_nats(samples, samples.u - self.at.project(samples.u), s, floor)
        volume = 0.0 if samples.mixing is None else float(np.linalg.slogdet(samples.mixing)[1])
        return task - 0.5 * self.cost_at_least(floor) + len(samples) * volume - _price(samples, s)


def _price(samples: Samples, s: int) -> float:
    """Of the entries of Lambda."""
    return 0.5 * s * (samples.n_rows - s) * math.log(len(samples))


def resolved(samples: Samples) -> float:
    """Variance that is noise enough [(rad/s)^2]."""
    return RESOLVED_SHARE**2 * samples.energy / samples.nv


def held_nats(samples: Samples, Lambda: Float[np.ndarray, "s r"]) -> float:
    """l of rows that are held: A u is noise, and what moves in the null space a signal in time."""
    s, floor = len(Lambda), resolved(samples)
    free = Projections.of(samples, Lambda).project(samples.u)
    square = float(np.sum((samples.u - free) ** 2)) / (len(samples) * s)
    noise = max(square, floor)
    held = -0.5 * len(samples) * s * (math.log(noise) + square / noise)
    return held + _signal_nats(samples, free, samples.nv - s, floor) - _price(samples, s)


def _signal_nats(samples: Samples, signal: Float[np.ndarray, "n nv"], size: int, floor: float) -> float:
    """Log-likelihood of a signal in time that fills so many directions of each sample, less the octaves' price."""
    if size == 0:
        return 0.0
    squares, counts = np.zeros(64), np.zeros(64)
    for own in (signal[part] for _, part in runs(samples.trajectory)):
        octave = np.frexp(np.arange(len(own)))[1]  # 0, then 1, 2-3, 4-7, ...
        squares += np.bincount(octave, np.sum(dct(own, axis=0, norm="ortho") ** 2, axis=1), 64)
        counts += size * np.bincount(octave, minlength=64)
    used = counts > 0
    mean = squares[used] / counts[used]
    variance = np.maximum(mean, floor)
    price = np.count_nonzero(used) * math.log(len(samples))
    return -0.5 * float(np.sum(counts[used] * (np.log(variance) + mean / variance)) + price)


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
    """Variance of what in u is no smooth motion, mean over the joints; bursts do not count [(rad/s)^2]."""
    e = _differences(samples)
    return float(np.mean((np.median(np.abs(e), axis=0) / MEDIAN) ** 2)) if len(e) else 0.0


def _differences(samples: Samples) -> Float[np.ndarray, "k nv"]:
    """Of neighbouring samples of a trajectory, with the variance of white noise."""
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
class Search:
    """Lambda of each number of rows, on some samples, with the grades of a prior.

    Args:
        samples: Few enough for many descents.
        grades: Of the prior.
        rng: For the random starts.
        own: Whether these are offsets of each trajectory, which make the cost bumpy, and follow nearly anything: what
            they leave of the true motion alone is rounding.
    """

    def __init__(self, samples: Samples, grades: Sequence[Grade], rng: np.random.Generator, own: bool):
        floor = OWN_SHARE * resolved(samples) if own else resolved(samples)
        self._samples, self._floor, self._left_out = samples, floor, dict[Posterior, float]()
        self._parts = parts_of(samples, PARTS, own)
        self._regressors = Regressors.of(samples, grades)
        self.enough = ABOVE_NOISE * (floor if own else max(noise_in_time(samples), floor))
        beta, affine = self._regressors.values, np.concatenate([np.ones((len(samples), 1)), samples.x], axis=1)
        starts = [conditional_pca(samples, one) for one in (affine, beta) if 2 * one.shape[1] < len(samples)]
        self.found = {s: self._look(one[:s] for one in starts) for s in range(min(samples.n_rows, samples.nv - 1) + 1)}
        if self.best.noise > self.enough:
            for s, before in self.found.items():
                random = (
                    rng.standard_normal((s, samples.n_rows)) for _ in range(MANY_STARTS if own else RANDOM_STARTS)
                )
                self.found[s] = self._look(random, before)
        # one row less, within the rows of the best: they hold the true ones where these are fewer
        while (s := len(self.best.Lambda)) > 1:
            rows, before = self.best.Lambda, self.found[s - 1]
            self.found[s - 1] = self._look((rng.standard_normal((s - 1, s)) @ rows for _ in range(SUBSPACES)), before)
            if len(self.best.Lambda) == s:
                break

    @property
    def best(self) -> Posterior:
        """The one with the most evidence, of those whose policy predicts recordings that it was not fitted to.

        Evidence alone believes in a rich policy that follows each of a few recordings.
        """
        n, nv = len(self._samples), self._samples.nv
        predicting = [
            s
            for s, one in self.found.items()
            if self.left_out(s) <= PREDICTS * max(one.energy / n, (nv - s) * resolved(self._samples))
        ]
        if not predicting:
            return self.found[min(self.found, key=self.left_out)]
        return max((self.found[s] for s in predicting), key=lambda one: one.nats(self._floor))

    def left_out(self, s: int) -> float:
        """Mean of |Z^T (u - pi)|^2 on recordings that the policy of s rows was not fitted to."""
        one = self.found[s]
        if one not in self._left_out:
            self._left_out[one] = one.held_out(self._parts)
        return self._left_out[one]

    def gaps(self) -> GapTable:
        """Ratio by which each row lowers what is left of left-out recordings [root mean square per direction].

        A ratio that is no chance, three standard deviations of the variances of so many samples, is weak evidence.
        """
        nv, n, least = self._samples.nv, len(self._samples), LEAST * self._samples.energy
        left = [math.sqrt(max(self.left_out(s), least) / (nv - s)) for s in sorted(self.found)]
        gaps = tuple(before / after for before, after in itertools.pairwise(left))
        weak_from = math.sqrt(1.0 + 6.0 * math.sqrt(2.0 / n))
        return GapTable(tuple(range(1, len(left))), gaps, weak_from, max(len(self.best.Lambda), 1))

    def _look(self, starts: Iterable[Float[np.ndarray, "s r"]], best: Posterior | None = None) -> Posterior:
        """The most likely after a few steps, from one start after the other until noise alone is left."""
        for start in starts:
            if best is not None and (best.noise <= self.enough or len(start) in (0, start.shape[1])):
                break
            here = descended(Posterior(self._samples, self._regressors, orthonormal_rows(start)), LOOK_STEPS)
            best = here if best is None or here.cost < best.cost else best
        if best is None:
            raise ValueError("there is no start")
        return best


def descended(here: Posterior, steps: int = STEPS) -> Posterior:
    """The most likely Lambda from here."""
    s, r = here.Lambda.shape
    steps = steps if 0 < s < r else 0
    return descend(here, Posterior.moved, steps, settled=lambda _, step, H: float(step @ H @ step) < SETTLED)


def estimate_imposed(
    samples: Samples,
    n_constraints: int | None,
    rng: np.random.Generator,
    policy_model: str = "auto",
    unexplained: float = math.inf,
) -> Estimate:
    """Number of rows by evidence on a choice of samples, then the most likely Lambda on all.

    Args:
        samples: What was recorded.
        n_constraints: Number of rows; found from the data by default.
        rng: For k-means and the random starts.
        policy_model: `"auto"` (the general prior), `"constant"`, `"affine"`, `"quadratic"`, `"cubic"`, `"quartic"`,
            `"quintic"` or `"rbf"`; or `"affine-offset"`: affine, with an offset per trajectory, where demonstrators
            rest in different postures.
        unexplained: Share of the energy of left-out recordings that a policy may leave.

    Raises:
        NotIdentifiableError: One trajectory or motion only, too few samples for an affine policy, no task in them, or
            no policy explains them.
    """
    refuse_what_cannot_show_it(samples, n_constraints)
    floor, own, given = resolved(samples), policy_model == OWN, samples
    few = _few(samples) if own else samples.thinned(COMPARE_LIMIT)
    grades = grades_of(few, policy_model, rng)

    def searched(some: Samples) -> tuple[Search, Posterior]:
        search = Search(some, list(grades.values()), rng, own)
        return search, descended(search.best if n_constraints is None else search.found[n_constraints])

    search, chosen = searched(few)
    is_noisy = chosen.noise > NO_NOISE * samples.energy
    S = shape_in_time(samples) if is_noisy else None
    if S is not None and np.linalg.cond(S) >= UNEQUAL_NOISE:
        other, weighted = searched(whitened(few, S))
        if weighted.nats(floor) > chosen.nats(floor):
            search, chosen, samples = other, weighted, whitened(samples, S)
    if len(chosen.Lambda) == 0:
        raise NotIdentifiableError(
            "a policy of the posture alone explains the motion: nothing in it is steered on purpose, or too few "
            "trajectories show what is; record more, from other starts to other targets",
            code="no-task",
        )
    if policy_model == "auto" and chosen.noise > search.enough and _rest_apart(samples, chosen.Lambda, grades):
        return estimate_imposed(given, n_constraints, rng, OWN, unexplained)
    regressors = Regressors.of(samples, list(grades.values()))
    if is_noisy:
        fit = _with_its_noise(descended(Posterior(samples, regressors, chosen.Lambda)), floor)
        # of the general prior, the largest degree of which the data determine a parameter, and the waves
        used = [name for name, number in zip(grades, fit.determined, strict=False) if number >= 1.0]
        said = [name for name in used if name in POLYNOMIALS][-1:] + [name for name in used if name not in POLYNOMIALS]
        nats, name = fit.nats(floor), "+".join(said) or next(iter(grades))
    else:
        models = [(next(iter(grades)), list(grades.values()))]
        if policy_model == "auto":  # those that may describe a policy exactly, fewest parameters first
            sizes = {name: n_columns(few, some) for name, some in MODELS.items() if name not in ("constant", OWN)}
            names = [name for name in sorted(sizes, key=lambda name: sizes[name]) if sizes[name] <= MOST_COLUMNS]
            models = [(name, [GRADES[one] for one in MODELS[name]]) for name in names]
        name, fit = without_noise(samples if own else few, chosen.Lambda, models)
        nats = Posterior(samples, regressors, fit.Lambda).nats(floor)
    name = name if policy_model in ("auto", "rbf") else policy_model
    gradients, hessians = fit.scores()
    prior = None
    if isinstance(fit, Posterior):
        prior = PolicyPrior(np.append(fit.precision, np.zeros(hessians.shape[1] - len(fit.precision))), fit.noise)
    energy = max(fit.energy / len(fit.samples), VANISHING * samples.energy)
    held_out = fit.held_out(parts_of(fit.samples, PARTS, own)) / energy
    if held_out > unexplained:
        raise NotIdentifiableError("no policy explains left-out recordings", code="unexplained")
    left = fit.residual / len(fit.samples) / energy
    residuals = {name: held_out}
    return Estimate(
        "joint", fit.Lambda, search.gaps(), left, held_out, gradients, hessians, name, residuals, nats, prior
    )


def _few(samples: Samples) -> Samples:
    return samples.subset(samples.trajectory < FEW).thinned(FEW_SAMPLES)


def _rest_apart(samples: Samples, Lambda: Float[np.ndarray, "s r"], grades: dict[str, Grade]) -> bool:
    """Whether offsets of each trajectory explain more than the general prior, where this leaves more than noise."""
    few, floor = _few(samples), OWN_SHARE * resolved(samples)
    own = [GRADES[name] for name in MODELS[OWN]]
    shared, apart = (Posterior(few, Regressors.of(few, one), Lambda) for one in (list(grades.values()), own))
    return apart.nats(floor) > shared.nats(floor)


def _with_its_noise(fit: Posterior, floor: float) -> Posterior:
    """The fit with the covariance of the noise that its residual shows, where that makes the motion more likely."""
    for _ in range(COVARIANCES):
        Sigma = shape_of_residual(fit)
        if np.linalg.cond(Sigma) < UNEQUAL_NOISE:
            break
        other = descended(Posterior(whitened(fit.samples, Sigma), fit.regressors, fit.Lambda))
        if other.nats(floor) <= fit.nats(floor):
            break
        fit = other
    return fit


def without_noise(
    samples: Samples, Lambda: Float[np.ndarray, "s r"], models: Iterable[tuple[str, Sequence[Grade]]]
) -> tuple[str, ExactPolicy]:
    """The first model that leaves rounding alone, or the one that leaves least, by least squares; with its name."""
    best: tuple[str, ExactPolicy] | None = None
    s, r = Lambda.shape
    for name, grades in models:
        here = ExactPolicy(samples, Regressors.of(samples, grades), Lambda)
        here = descend(here, ExactPolicy.moved, EXACT_STEPS if 0 < s < r else 0, tolerance=1e-13, gain=1e-9)
        best = (name, here) if best is None or here.cost < RICHER * best[1].cost else best
        if here.cost <= ROUNDING * len(samples) * samples.energy:
            break
    if best is None:
        raise ValueError("there is no model")
    return best


def refuse_what_cannot_show_it(samples: Samples, n_constraints: int | None) -> None:
    """Refuse recordings in which nothing tells the policy from the task.

    Raises:
        NotIdentifiableError: One trajectory or motion only, or too few samples for an affine policy.
    """
    if samples.n_trajectories < 2:
        raise NotIdentifiableError(
            "one trajectory does not identify a constraint whose task velocity is unknown: give several, from "
            "different starts to different targets",
            code="one-trajectory",
        )
    # whether all trajectories lie on the path of the longest one, whatever their time, direction and rate
    paths = [samples.q[part] for _, part in runs(samples.trajectory)]
    extents = [float(np.sum(np.var(path, axis=0))) ** 0.5 for path in paths]
    longest, most = paths[int(np.argmax(extents))], SAME_PATH * max(extents)
    # with postures added between its samples, until none are farther apart than that [rad]
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(longest, axis=0), axis=1)))
    n = min(int(along[-1] / most) + 1, MOST_POSTURES) if most > 0.0 else 0
    places = np.union1d(along, np.linspace(0.0, along[-1], n + 1))
    tree = cKDTree(np.column_stack([np.interp(places, along, column) for column in longest.T]))
    if all(float(np.mean(tree.query(path)[0] ** 2)) <= most**2 for path in paths):
        raise NotIdentifiableError(
            f"the {samples.n_trajectories} recordings repeat one motion: like a single one they cannot show which part "
            "of it is steered on purpose; record motions that differ, from other starts to other targets",
            code="repeated-motion",
        )
    if len(samples) * (samples.nv - (n_constraints or 1)) < 2 * samples.nv * (1 + samples.q.shape[1]):
        raise NotIdentifiableError(
            f"{len(samples)} samples are too few for the joint estimator on {samples.n_rows} rows and {samples.nv} "
            "joints: record more trajectories, or name fewer axes",
            code="too-few-samples",
        )
