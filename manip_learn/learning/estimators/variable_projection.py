"""Lambda and the null-space policy together, from raw (q, u): variable projection on the Grassmann manifold.

    min over Lambda, Theta of  sum_n | Z_n^T (u_n - Theta^T beta(q_n)) |^2,   Z_n the null basis of A_n = Lambda Phi_n

Neither a separation of u into task and null part nor knowledge of b is needed: Z^T removes the task part whatever it
was. pi(q) = Theta^T beta(q) is linear in its parameters, so Theta is eliminated (Golub and Pereyra, 1973, with
Kaufman's Jacobian, 1975), in two ways. Normal equations cost a tenth of a QR of all rows, and square the condition
number: they are used where the residual is noise, far above their rounding, and where their Cholesky
factor shows that they are well conditioned.

Or the policy's parameters are integrated out instead of fitted (`fit_marginal`): Lambda by marginal likelihood, with
Theta ~ N(0, T) with one variance tau_g^2 for all parameters of grade g (degree of the monomials), so that Z^T u is
normal with the covariance sigma^2 I + K T K^T, K = d (Z^T pi) / d Theta. With C = K^T K = sum beta beta^T (x) N,
P = sigma^2 T^-1, theta the posterior mean of Theta and c its length

    2 l(Lambda) = (n z - c) log sigma^2 + log |C + P| + log |T| + (|Z^T u|^2 - theta^T K^T u) / sigma^2

tau and sigma by maximum likelihood too (MacKay, 1992, Neural Computation 4(3), eq. (2.33) and following). No degree has
to be chosen: one that the data do not need has tau = 0, one of which they cannot tell widens the angle. Fitted without
a prior, combinations of parameters that the null spaces hardly show become large; they make the Gauss-Newton Hessian
of Lambda, which grows with pi, too large, and left-out trajectories badly predicted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import factorial, prod
from typing import final

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import qr, solve_triangular

from manip_learn.learning.descent import descend
from manip_learn.learning.estimators.estimate import JointFit, PolicyPrior, descend_rows
from manip_learn.learning.estimators.policy_equations import (
    CHUNK,
    OrthonormalRegressors,
    Projections,
    Solver,
    curvature,
    left_out,
    packed,
    products,
    pull,
    solve_policy,
    unpacked_curvature,
    upper,
)
from manip_learn.learning.estimators.policy_model import PolicyModel, PolynomialModel
from manip_learn.learning.samples import Samples, in_blocks
from manip_learn.linalg import batch_row_spaces, complement_rows, inverse_triangles, orthonormal_rows, turned

# degree up to which every policy is thought possible. Set by hand
MOST_LIKELY_DEGREE = 3

MAX_ITERATIONS = 30  # of Gauss-Newton, which ends by itself before
RANK_TOLERANCE = 1e-13  # of the largest diagonal element of R: rounding of some hundred columns
# directions of the policy that the data determine well enough to matter for the uncertainty
BASIS_TOLERANCE = 1e-10
# share of the energy below which the residual is no noise
NEARLY_EXACT = 1e-6
# square of the least pivot, the diagonal scaled to 1, below which normal equations are ill-conditioned
LEAST_PIVOT = 1e-8
# parameters of the policy beyond which normal equations take the place of a QR of all rows however they are conditioned
MANY_COLUMNS = 64
# more trajectories than this are taken in blocks: a Hessian of each, for Theta too, is kept
MAX_BLOCKS = 100
MARGINAL_ITERATIONS = 40  # of Newton; one that has not settled by then is taken as it is
# squared length of the last step in standard errors
SETTLED = 1e-6
# updates of the variances before the first step, and after each
FIRST_UPDATES, UPDATES = 4, 2
# variance of the parameters over the mean square of u: at the start, and least
START, LEAST = 4.0, 1e-14
# least number of parameters of a grade that count as determined
DETERMINED = 1e-6
# products of regressors that are kept from one pass to the next [numbers]
KEEP_LIMIT = 3_000_000


def fit_joint(
    samples: Samples,
    start: Float[np.ndarray, "s r"],
    model: PolicyModel,
    max_iterations: int = MAX_ITERATIONS,
    tolerance: float = 1e-13,
    gain: float = 1e-9,
) -> JointFit:
    """Variable projection from one start in whitened coordinates, at most so many Gauss-Newton steps.

    It stops after a step of length `tolerance`, or one that lowers the cost by a share of less than `gain`.
    """
    many = model.n_terms * samples.nv > MANY_COLUMNS
    fast = fit_projected(samples, start, model, max_iterations, tolerance, gain, 0.0 if many else LEAST_PIVOT)
    if fast is not None:
        if fast.cost > NEARLY_EXACT * fast.energy:
            return fast
        # normal equations lose half the digits: QR answers where there are digits, and goes on where it is expensive
        start = fast.whitened_selection if many else start
    here = descend_rows(
        _ByRows.at(samples, orthonormal_rows(start), model),
        lambda Lambda: _ByRows.at(samples, Lambda, model),
        *(max_iterations, tolerance, gain),
    )
    return JointFit(here.whitened_selection, here.theta, here.cost, here.energy, model)


def fit_projected(
    samples: Samples,
    start: Float[np.ndarray, "s r"],
    model: PolicyModel,
    max_iterations: int,
    tolerance: float,
    gain: float,
    least_pivot: float = LEAST_PIVOT,
) -> JointFit | None:
    """`fit_joint` by normal equations, see there; None where these are ill-conditioned by a positive least pivot."""
    regressors = OrthonormalRegressors.of(samples, model)
    if least_pivot > 0.0 and regressors.values.shape[1] < model.n_terms:
        return None
    here = descend_rows(
        _ByEquations.at(samples, orthonormal_rows(start), regressors),
        lambda Lambda: _ByEquations.at(samples, Lambda, regressors),
        *(max_iterations, tolerance, gain),
        stop=lambda state: (
            state.solver.least_pivot < least_pivot or (least_pivot > 0.0 and state.cost <= NEARLY_EXACT * state.energy)
        ),
    )
    if here.solver.least_pivot < least_pivot:
        return None
    return JointFit(here.whitened_selection, regressors.mixing @ here.theta, here.cost, here.energy, model)


@final
@dataclass(frozen=True, eq=False)
class _ByEquations:
    """The best policy for a Lambda, from normal equations."""

    samples: Samples
    whitened_selection: Float[np.ndarray, "s r"]
    regressors: OrthonormalRegressors
    projections: Projections
    solver: Solver
    theta: Float[np.ndarray, "j nv"]
    y: Float[np.ndarray, "n nv"]
    cost: float

    @staticmethod
    def at(samples: Samples, Lambda: Float[np.ndarray, "s r"], regressors: OrthonormalRegressors) -> _ByEquations:
        projections = Projections.of(samples, Lambda)
        solver = Solver(curvature(regressors.values, projections.N))
        theta, y = solve_policy(regressors.values, projections, samples.u, solver)
        cost = projections.energy(y) / len(samples)
        return _ByEquations(samples, Lambda, regressors, projections, solver, theta, y, cost)

    @property
    def energy(self) -> float:
        """Mean of |Z^T u|^2."""
        return self.projections.energy(self.samples.u) / len(self.samples)

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """See `descend_rows`."""
        return self.projections.equations(self.regressors.values, self.y, self.solver)


@final
@dataclass(frozen=True, eq=False)
class _ByRows:
    """The best policy for a Lambda, from a QR of all rows."""

    samples: Samples
    whitened_selection: Float[np.ndarray, "s r"]
    model: PolicyModel
    theta: Float[np.ndarray, "j nv"]
    cost: float
    energy: float

    @staticmethod
    def at(samples: Samples, Lambda: Float[np.ndarray, "s r"], model: PolicyModel) -> _ByRows:
        R = _triangle(_rows(samples, Lambda, model))
        theta = _solve(R[:, :-1], R[:, -1:])
        # the residual from the triangle, not from energy - explained: those two nearly cancel on clean data
        cost = float(np.sum((R[:, -1:] - R[:, :-1] @ theta) ** 2))
        n, energy = len(samples), float(np.sum(R[:, -1] ** 2))
        return _ByRows(samples, Lambda, model, theta.reshape(-1, samples.nv), cost / n, energy / n)

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """See `descend_rows`; Theta is projected off."""
        R = _triangle(_rows(self.samples, self.whitened_selection, self.model, self.theta))
        width = self.theta.size
        K, J, residual = R[:, :width], R[:, width:-1], R[:, -1]
        Jt = J - K @ _solve(K, J)
        return Jt.T @ Jt, Jt.T @ residual


def scores(samples: Samples, fit: JointFit) -> tuple[Float[np.ndarray, "g d"], Float[np.ndarray, "g d d"]]:
    """Gradient and Gauss-Newton Hessian of each block of trajectories at the optimum; d = k' + m, m = s (p'-s).

    The last m unknowns are those of Lambda, the first k' those of the policy, in an orthonormal basis of what the data
    determine: whoever leaves a trajectory out must let the policy move too. By QR, for directions that normal equations
    take for rounding widen the angle. Beyond MAX_BLOCKS trajectories several consecutive ones make a block.
    """
    s, r = fit.whitened_selection.shape
    m, z, width = s * (r - s), samples.nv - s, fit.theta.size
    R = _triangle(_rows(samples, fit.whitened_selection, fit.model, fit.theta))
    projection = _solve(R[:, :width], R[:, width:-1])
    _, T, pivots = qr(R[:, :width], mode="economic", pivoting=True, check_finite=False)
    diagonal = np.abs(np.diag(T))
    k = int(np.count_nonzero(diagonal > BASIS_TOLERANCE * diagonal[0])) if diagonal.size else 0
    n_blocks = min(samples.n_trajectories, MAX_BLOCKS)
    gradients, hessians = np.zeros((n_blocks, k + m)), np.zeros((n_blocks, k + m, k + m))
    for block, rows in zip(samples.blocks(), _rows(samples, fit.whitened_selection, fit.model, fit.theta), strict=True):
        K = solve_triangular(T[:k, :k], rows[:, pivots[:k]].T, trans="T", check_finite=False).T
        J = np.concatenate([K, rows[:, width:-1] - rows[:, :width] @ projection], axis=1)
        for i, part in in_blocks(block.trajectory, samples.n_trajectories, MAX_BLOCKS):
            own = slice(part.start * z, part.stop * z)
            gradients[i] += J[own].T @ rows[own, -1]
            hessians[i] += J[own].T @ J[own]
    return gradients, hessians


def held_out_costs(
    samples: Samples, Lambda: Float[np.ndarray, "s r"], model: PolicyModel, n_folds: int, *, by_sample: bool = False
) -> Float[np.ndarray, " f"]:
    """What each fold contributes to the mean of |Z^T (u - pi)|^2 on trajectories that pi was not fitted to.

    Lambda is kept: this is cross-validation of pi. A single infinity where there are fewer than two folds. `by_sample`
    leaves out every n-th sample instead, for models with parameters of each trajectory.
    """
    folds = (np.arange(len(samples)) if by_sample else samples.trajectory) % n_folds
    numbers, fold_of = np.unique(folds, return_inverse=True)
    if len(numbers) < 2:
        return np.array([np.inf])
    beta = OrthonormalRegressors.of(samples, model).values
    if len(samples) >= n_folds and beta.shape[1] == model.n_terms:
        projections = Projections.of(samples, Lambda)
        squares, _, least_pivot = left_out(beta, projections, samples.u, folds, LEAST_PIVOT)
        if least_pivot >= LEAST_PIVOT and squares.sum() > NEARLY_EXACT * projections.energy(samples.u):
            return np.bincount(fold_of, squares) / len(samples)
    # the equations are ill-conditioned, or what is left is no noise: by QR, each fold becomes a triangle once, and
    # leaving it out means solving with the others'
    triangles, before = dict[int, np.ndarray](), 0
    for rows in _rows(samples, Lambda, model):
        after = before + len(rows) // (samples.nv - len(Lambda))
        fold_of_row = np.repeat(fold_of[before:after], samples.nv - len(Lambda))
        for fold in np.unique(fold_of_row).tolist():
            own = rows[fold_of_row == fold]
            triangles[fold] = _triangle([triangles[fold], own] if fold in triangles else [own])
        before = after
    sums = np.zeros(len(triangles))
    for fold, held in triangles.items():
        rest = _triangle(R for other, R in sorted(triangles.items()) if other != fold)
        theta = _solve(rest[:, :-1], rest[:, -1:])
        sums[fold] = float(np.sum((held[:, -1:] - held[:, :-1] @ theta) ** 2))
    return sums / len(samples)


def _rows(
    samples: Samples, Lambda: np.ndarray, model: PolicyModel, theta: np.ndarray | None = None
) -> Iterator[np.ndarray]:
    """Rows [d residual / d Theta | d residual / d B | residual], block by block; the residual is Z^T (u - pi).

    Without theta, [Z^T d pi / d Theta | Z^T u]: the least squares problem for the best policy.
    """
    s, perp = len(Lambda), complement_rows(Lambda)
    for block in samples.blocks():
        Q, R = batch_row_spaces(np.einsum("sr,nrv->nsv", Lambda, block.Phi, optimize=True))
        Q1, Z = Q[:, :, :s], Q[:, :, s:]
        n, nv, z = Z.shape
        beta = model(block.x, block.trajectory)
        columns = [(beta[:, None, :, None] * Z.transpose(0, 2, 1)[:, :, None, :]).reshape(n * z, beta.shape[1] * nv)]
        y = block.u if theta is None else block.u - beta @ theta
        if theta is not None:
            a = np.einsum("nij,nvj,nv->ni", inverse_triangles(R), Q1, y, optimize=True)  # A^{+T} y
            F = np.einsum("nvz,kr,nrv->nzk", Z, perp, block.Phi, optimize=True)
            columns.append(-(a[:, None, :, None] * F[:, :, None, :]).reshape(n * z, -1))
        residual = np.einsum("nvz,nv->nz", Z, y, optimize=True).reshape(-1, 1)
        yield np.concatenate([*columns, residual], axis=1)


def _triangle(blocks: Iterable[np.ndarray]) -> Float[np.ndarray, "rows n"]:
    """Triangle of the QR of all rows, stacked block after block: memory does not grow with the samples."""
    R: np.ndarray | None = None
    for rows in blocks:
        together = rows if R is None else np.concatenate([R, rows])
        R = qr(together, mode="r", overwrite_a=True, check_finite=False)[0][: min(together.shape)]
    if R is None:
        raise ValueError("there are no samples")
    return R


def _solve(K: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Least squares by rank-revealing QR: no ridge, and directions without data stay zero."""
    Q, R, pivots = qr(K, mode="economic", pivoting=True, check_finite=False)
    diagonal = np.abs(np.diag(R))
    rank = int(np.count_nonzero(diagonal > RANK_TOLERANCE * diagonal[0])) if diagonal.size and diagonal[0] > 0 else 0
    out = np.zeros((K.shape[1], y.shape[1]))
    if rank:
        out[pivots[:rank]] = solve_triangular(R[:rank, :rank], Q[:, :rank].T @ y, check_finite=False)
    return out


@final
@dataclass(frozen=True, eq=False)
class GradedRegressors:
    """beta of each sample, and what shares a variance.

    Attributes:
        values: Shape (n, k).
        grades: Grade of each regressor, counted from 0, shape (k,).
    """

    values: Float[np.ndarray, "n k"]
    grades: Int[np.ndarray, " k"]
    _kept: list[np.ndarray] = field(default_factory=list, repr=False)

    def products(self) -> Iterator[tuple[slice, Float[np.ndarray, "g n"]]]:
        """Products of all pairs of regressors, some samples at a time; kept for the next pass where they are few."""
        n, k = self.values.shape
        keep = n * k * (k + 1) // 2 <= KEEP_LIMIT
        for i, start in enumerate(range(0, n, CHUNK)):
            part = slice(start, start + CHUNK)
            pairs = self._kept[i] if i < len(self._kept) else products(self.values[part])
            if keep and i == len(self._kept):
                self._kept.append(pairs)
            yield part, pairs

    @staticmethod
    def of(samples: Samples, model: PolicyModel, most_columns: int) -> GradedRegressors:
        """Polynomials by degree up to a number of parameters, and those of a model that is none as one more grade."""
        x, m = samples.x, samples.q.shape[1]
        own = np.zeros((len(x), 0)) if isinstance(model, PolynomialModel) else model(x, samples.trajectory)
        least = model.degree if isinstance(model, PolynomialModel) else 1
        polynomials = [PolynomialModel(degree, m) for degree in range(max(least, MOST_LIKELY_DEGREE) + 1)]
        fitting = [
            one
            for one in polynomials
            if one.degree <= least or (one.n_terms + own.shape[1]) * samples.nv <= most_columns
        ]
        largest = fitting[-1]
        degrees = np.array([0, *map(len, largest.terms)])
        # factors of the monomials that make sum beta_i(x) beta_i(y) = sum over the degrees of (x . y / m)^degree
        counts = [factorial(len(t)) / prod(factorial(t.count(i)) for i in set(t)) / m ** len(t) for t in largest.terms]
        values = np.concatenate([largest(x) * np.sqrt(np.array([1.0, *counts])), own], axis=1)
        return GradedRegressors(values, np.append(degrees, np.full(own.shape[1], largest.degree + 1)))


@final
@dataclass(frozen=True, eq=False)
class ScoredFit:
    """Lambda, and what its uncertainty needs.

    Attributes:
        whitened_selection: Lambda in whitened coordinates, orthonormal rows, shape (s, p').
        gradients: Of each block of trajectories; first the parameters of the policy, then those of Lambda.
        hessians: Gauss-Newton Hessians, likewise, without the prior.
        prior: Of the policy's parameters; None if they were fitted.
    """

    whitened_selection: Float[np.ndarray, "s r"]
    gradients: Float[np.ndarray, "g d"]
    hessians: Float[np.ndarray, "g d d"]
    prior: PolicyPrior | None = None


def fit_marginal(samples: Samples, fit: JointFit, most_columns: int) -> ScoredFit:
    """Gauss-Newton steps on the marginal likelihood from a fit with the selected policy model."""
    regressors = GradedRegressors.of(samples, fit.model, most_columns)
    here = _Posterior(samples, regressors, fit.whitened_selection)
    scale = float(np.mean(samples.u**2))
    n_grades = int(regressors.grades.max()) + 1
    noise = max(fit.cost / max(samples.nv - len(fit.whitened_selection), 1), LEAST * scale)
    here.settle(noise, np.full(n_grades, START * scale), FIRST_UPDATES)
    here = descend(
        here, _Posterior.moved, MARGINAL_ITERATIONS, settled=lambda _, step, H: float(step @ H @ step) < SETTLED
    )
    gradients, hessians = here.scores()
    precision = np.append(here.precision, np.zeros(hessians.shape[1] - len(here.precision)))
    return ScoredFit(here.Lambda, gradients, hessians, PolicyPrior(precision, here.noise))


@final
class _Posterior:
    """Theta given Lambda, in whitened coordinates, and the variances; `settle` comes first."""

    def __init__(self, samples: Samples, regressors: GradedRegressors, Lambda: Float[np.ndarray, "s r"]):
        self.samples, self.regressors, self.Lambda = samples, regressors, Lambda
        self._projections = Projections.of(samples, Lambda)
        entries = packed(self._projections.N)
        self._curvature = unpacked_curvature(np.sum([p @ entries[part] for part, p in regressors.products()], axis=0))
        null_part = self._projections.project(samples.u)
        self._pulled = pull(regressors.values, null_part[:, :, None])[:, 0]
        self._energy = float(np.sum(null_part**2))
        self._grades = np.repeat(regressors.grades, samples.nv)

    def settle(self, noise: float, variances: Float[np.ndarray, " g"], updates: int) -> None:
        """Solve with some variances, sigma^2 and tau^2 of each grade [(rad/s)^2], and change these towards the largest
        likelihood some times.
        """
        self._solve(noise, variances)
        for _ in range(updates):
            # MacKay's update: sums of squares over the numbers of parameters, and of residuals, that data determine
            n_grades, least = len(self.variances), LEAST * float(np.mean(self.samples.u**2))
            determined = 1.0 - self.precision * self._solver.inverse_diagonal()
            counts = np.maximum(np.bincount(self._grades, determined, n_grades), DETERMINED)
            parameters = np.maximum(np.bincount(self._grades, self._theta**2, n_grades) / counts, least)
            square = float(np.sum(self._projections.project(self._residual) ** 2))
            n_rows = len(self.samples) * (self.samples.nv - len(self.Lambda))
            self._solve(max(square / max(n_rows - counts.sum(), 1.0), least), parameters)

    def moved(self, step: Float[np.ndarray, " m"]) -> _Posterior:
        """After a step, settled from the variances here."""
        there = _Posterior(self.samples, self.regressors, turned(self.Lambda, step))
        there.settle(self.noise, self.variances, UPDATES)
        return there

    @property
    def cost(self) -> float:
        """2 l, see the module."""
        n_rows = len(self.samples) * (self.samples.nv - len(self.Lambda))
        fit = (self._energy - float(self._pulled @ self._theta)) / self.noise
        log_prior = float(np.sum(np.log(self.variances[self._grades])))
        return (n_rows - len(self._theta)) * np.log(self.noise) + self._solver.log_determinant + log_prior + fit

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient of l for B."""
        H, gradient = self._projections.equations(self.regressors.values, self._residual, self._solver)
        return H / self.noise, gradient / self.noise + self._spread_slopes(np.ones(len(self.samples)))[0]

    def scores(self) -> tuple[Float[np.ndarray, "g d"], Float[np.ndarray, "g d d"]]:
        """Gradient and Hessian of sigma^2 l of each block of trajectories, for (Theta, B), see `_without_noise`.

        With e = N y and dLambda = B Lambda_perp: d e / d Theta_kv = -beta_k N_v, d e / d B as in `Projections.slopes`.
        """
        n = self.samples.n_trajectories
        runs = in_blocks(self.samples.trajectory, n, MAX_BLOCKS)
        membership = np.zeros((min(n, MAX_BLOCKS), len(self.samples)))
        projections, beta, sums = self._projections, self.regressors.values, []
        J, e = projections.slopes(self._residual), projections.project(self._residual)
        for i, part in runs:
            membership[i, part] = 1.0
            flat, crossed = J[part].reshape(-1, J.shape[2]), -pull(beta[part], J[part])
            gradient = [-pull(beta[part], e[part][:, :, None])[:, 0], flat.T @ e[part].reshape(-1)]
            H = np.block([[curvature(beta[part], projections.N[part]), crossed], [crossed.T, flat.T @ flat]])
            sums.append((np.concatenate(gradient), H))
        gradients, hessians = map(np.array, zip(*sums, strict=True))
        gradients[:, len(self._theta) :] += self.noise * self._spread_slopes(membership)
        return gradients, self._without_noise(hessians, membership)

    def _without_noise(
        self, hessians: Float[np.ndarray, "g d d"], membership: Float[np.ndarray, "g n"]
    ) -> Float[np.ndarray, "g d d"]:
        """Gauss-Newton Hessians without what the noise of u adds to them in the mean.

        A^{+T} (u - pi) carries noise of covariance sigma^2 A^{+T} A^+, independent of the residual's; the curvature of
        l itself has no such part (errors in variables). Where noise is most of the Hessian in some direction, no more
        is taken off than leaves it positive (Fuller, 1987, section 2.5: the least root less one over the samples).
        """
        duals, free = self._projections.duals, self._projections.free
        C, F = duals @ duals.transpose(0, 2, 1), free.transpose(0, 2, 1) @ free
        each = np.einsum("gn,nst,nkl->gsktl", membership, C, F, optimize=True)
        c, m = len(self._theta), C.shape[1] * F.shape[1]
        added = self.noise * each.reshape(-1, m, m)
        total = hessians.sum(axis=0) + np.diag(np.append(self.precision, np.zeros(m)))
        own = total[c:, c:] - total[c:, :c] @ self._solver(total[:c, c:])
        least = 1.0 / float(np.max(np.linalg.eigvals(np.linalg.solve(own, added.sum(axis=0))).real, initial=1e-300))
        share = min(1.0, least * (1.0 - 1.0 / len(self.samples)))
        hessians[:, c:, c:] -= share * added
        return hessians

    def _solve(self, noise: float, variances: Float[np.ndarray, " g"]) -> None:
        self.noise, self.variances = noise, variances
        self.precision = noise / variances[self._grades]
        self._solver = Solver(self._curvature + np.diag(self.precision))
        self._theta = self._solver(self._pulled[:, None])[:, 0]
        self._residual = self.samples.u - self.regressors.values @ self._theta.reshape(-1, self.samples.nv)

    def _spread_slopes(self, weights: Float[np.ndarray, "*g n"]) -> Float[np.ndarray, "g m"]:
        """Half the derivative by B of log |C + P|, each sample's share weighted: that of the posterior spread of pi."""
        nv, k = self.samples.nv, self.regressors.values.shape[1]
        (i, j), (v, w) = upper(k), upper(nv)
        inverse = self._solver.inverse().reshape(k, nv, k, nv).transpose(0, 2, 1, 3)[i, j]  # (g, nv, nv)
        # each pair of regressors twice but those with themselves: both ways round together they are symmetric
        shares = (inverse[:, v, w] + inverse[:, w, v]) * np.where(i == j, 0.5, 1.0)[:, None]
        duals, free, slopes = self._projections.duals, self._projections.free, []
        for part, pairs in self.regressors.products():
            entries = pairs.T @ shares
            spread = np.empty((len(entries), nv, nv))  # posterior covariance of pi over sigma^2
            spread[:, v, w] = spread[:, w, v] = entries
            slopes.append(-np.einsum("nsv,nvw,nwk->nsk", duals[part], spread, free[part], optimize=True))
        return np.atleast_2d(weights) @ np.concatenate(slopes).reshape(len(self.samples), -1)
