"""The policy of an imposed constraint for a given Lambda: its grades, its posterior, and what they make of the motion.

Formulas and letters are those of `imposed`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.fft import dct
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtri

from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.samples import Samples, in_blocks, rows_beside, runs
from manip_learn.linalg import complement_rows, inverse_triangles_beside, row_bases, turned

# polynomials by their degree
POLYNOMIALS = ("constant", "affine", "quadratic", "cubic", "quartic", "quintic")
OWN = "affine-offset"  # affine, and a rest posture of each trajectory
# grades of the general prior, taken in this order while there is room. Set by hand
GENERAL = ("constant", "affine", "harmonic1", "quadratic", "cubic", "harmonic2")
RADIAL_CENTRES = 32  # of the radial policy. Set by hand
MOST_COLUMNS = 400  # parameters of the policy: the time of a step grows with their cube
# samples whose products of regressors are made at a time; products that are kept [numbers]
_CHUNK, KEEP_LIMIT = 1024, 10_000_000
MAX_BLOCKS = 100  # more trajectories than this are taken in blocks: a Hessian of each, for Theta too, is kept
# share of the root mean square of u that is noise enough to tell hypotheses apart: what is resolved below it is how
# well features approximate the policy, and with more rows they come closer. Set by hand
RESOLVED_SHARE = 1e-3
# variance over the mean square of u: of the noise, least, where normal equations end; of noise and parameters at first
LEAST, FIRST_NOISE, FIRST_SPREAD = 1e-12, 0.1, 4.0
FIRST_UPDATES, UPDATES = 4, 2  # of the variances before the first step, and after each
# number of parameters of a grade below which it is dropped; and least that counts
_SPENT, DETERMINED = 0.1, 1e-6
_FLOOR = 1e-13  # share of each curvature added, so that directions without data stay where they are
_RANK = 1e-13  # of the largest singular value: rounding of some hundred columns

Grade = Callable[[Samples], Float[np.ndarray, "n k"]]
SomeSamples = slice | Int[np.ndarray, " k"]  # some samples


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
        for i, start in enumerate(range(0, n, _CHUNK)):
            part = slice(start, start + _CHUNK)
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

    def part(self, samples: SomeSamples) -> Regressors:
        """Those of some samples."""
        return Regressors(self.values[samples], self.grades)


def parts_of(samples: Samples, most: int, own: bool = False) -> list[SomeSamples]:
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
        for floor in (_FLOOR, 1e3 * _FLOOR, 1e6 * _FLOOR):
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
        kept = sigma > _RANK * sigma[0]
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

    def _blocks(self, parts: Iterable[SomeSamples]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        nv = self.samples.nv
        rows = np.arange(len(self._e)).reshape(-1, nv)
        return ((rows[part].reshape(-1), self._basis[rows[part].reshape(-1)]) for part in parts)

    def held_out(self, parts: Sequence[SomeSamples]) -> float:
        """Mean of |Z^T (u - pi)|^2 on the parts, each left out of the policy in its turn."""
        total = 0.0
        for rows, own in self._blocks(parts):
            rest = np.eye(own.shape[1]) - own.T @ own
            left = self._e[rows] + own @ np.linalg.lstsq(rest, own.T @ self._e[rows], rcond=_RANK)[0]
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
        enough = min(_SPENT, float(self.determined.max()))  # the last grade stays, whatever little it explains
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

    def held_out(self, parts: Sequence[SomeSamples]) -> float:
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
