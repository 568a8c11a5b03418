"""Lambda and the null-space policy together, from raw (q, u): variable projection on the Grassmann manifold.

    min over Lambda, Theta of  sum_n | Z_n^T (u_n - Theta^T beta(q_n)) |^2,   Z_n the null basis of A_n = Lambda Phi_n

Neither a separation of u into task and null part nor knowledge of b is needed: Z^T removes the task part whatever it
was. pi(q) = Theta^T beta(q) is linear in its parameters, so Theta is eliminated (Golub and Pereyra, 1973, with
Kaufman's Jacobian, 1975), in two ways. Normal equations cost a tenth of a QR of all rows, and square the condition
number: they are used where what is left of the motion is noise, far above their rounding, and where their Cholesky
factor shows that they are well conditioned.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import qr, solve_triangular

from manip_learn.learning.estimators.estimate import JointFit, descend_rows
from manip_learn.learning.estimators.policy_equations import (
    OrthonormalRegressors,
    Projections,
    Solver,
    curvature,
    left_out,
    solve_policy,
)
from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.samples import Samples, TrajectoryBlocks
from manip_learn.linalg import batch_row_spaces, complement_rows, inverse_triangles, orthonormal_rows

MAX_ITERATIONS = 30
RANK_TOLERANCE = 1e-13
# directions of the policy that the data determine well enough to matter for the uncertainty
BASIS_TOLERANCE = 1e-10
# share of the energy below which what is left is no noise
NEARLY_EXACT = 1e-6
# square of the least pivot, the diagonal scaled to 1, below which normal equations are ill-conditioned
LEAST_PIVOT = 1e-8
# parameters of the policy beyond which normal equations take the place of a QR of all rows however they are conditioned
MANY_COLUMNS = 64
# trajectories beyond so many are taken in blocks: a Hessian of each, for Theta too, is kept
MAX_BLOCKS = 100


def fit_joint(
    samples: Samples,
    start: Float[np.ndarray, "s r"],
    model: PolicyModel,
    max_iterations: int = MAX_ITERATIONS,
    tolerance: float = 1e-13,
    gain: float = 1e-9,
) -> JointFit:
    """Variable projection from one start.

    Args:
        samples: What was recorded.
        start: Lambda in whitened coordinates.
        model: beta(q).
        max_iterations: Largest number of Gauss-Newton steps.
        tolerance: Step length at which to stop.
        gain: Relative decrease of the cost below which to stop.
    """
    many = model.n_terms * samples.nv > MANY_COLUMNS
    fast = fit_projected(samples, start, model, max_iterations, tolerance, gain, 0.0 if many else LEAST_PIVOT)
    if fast is not None:
        if fast.cost > NEARLY_EXACT * fast.energy:
            return fast
        # normal equations lose half the digits: QR answers where there are digits, and goes on where it is expensive
        start = fast.whitened_selection if many else start
    here, iterations = descend_rows(
        _ByRows.at(samples, orthonormal_rows(start), model),
        lambda Lambda: _ByRows.at(samples, Lambda, model),
        *(max_iterations, tolerance, gain),
    )
    return JointFit(here.whitened_selection, here.theta, here.cost, here.energy, iterations, model)


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
    here, iterations = descend_rows(
        _ByEquations.at(samples, orthonormal_rows(start), regressors),
        lambda Lambda: _ByEquations.at(samples, Lambda, regressors),
        *(max_iterations, tolerance, gain),
        stop=lambda state: (
            state.solver.least_pivot < least_pivot or (least_pivot > 0.0 and state.cost <= NEARLY_EXACT * state.energy)
        ),
    )
    if here.solver.least_pivot < least_pivot:
        return None
    theta = regressors.mixing @ here.theta
    return JointFit(here.whitened_selection, theta, here.cost, here.energy, iterations, model)


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
    blocks = TrajectoryBlocks(samples.n_trajectories, MAX_BLOCKS)
    gradients = np.zeros((blocks.n_blocks, k + m))
    hessians = np.zeros((blocks.n_blocks, k + m, k + m))
    for block, rows in zip(samples.blocks(), _rows(samples, fit.whitened_selection, fit.model, fit.theta), strict=True):
        K = solve_triangular(T[:k, :k], rows[:, pivots[:k]].T, trans="T", check_finite=False).T
        J = np.concatenate([K, rows[:, width:-1] - rows[:, :width] @ projection], axis=1)
        for i, part in blocks.runs(block.trajectory):
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
    if len(np.unique(folds)) < 2:
        return np.array([np.inf])
    sums = held_out_by_fold(samples, Lambda, model, folds) if len(samples) >= n_folds else None
    if sums is None:
        sums = _held_out_by_rows(samples, Lambda, model, folds)
    return sums / len(samples)


def held_out_by_fold(
    samples: Samples, Lambda: Float[np.ndarray, "s r"], model: PolicyModel, folds: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " f"] | None:
    """Sum of |Z^T (u - pi)|^2 over each fold, pi fitted to the others.

    Args:
        samples: What was recorded.
        Lambda: In whitened coordinates.
        model: beta(q).
        folds: Fold of each sample.

    Returns:
        One sum for each fold that has samples, in their order; None where the equations are ill-conditioned, or what
        is left is no noise.
    """
    beta, projections = OrthonormalRegressors.of(samples, model).values, Projections.of(samples, Lambda)
    if beta.shape[1] < model.n_terms:
        return None
    squares, _, least_pivot = left_out(beta, projections, samples.u, folds, LEAST_PIVOT)
    if least_pivot < LEAST_PIVOT or squares.sum() <= NEARLY_EXACT * projections.energy(samples.u):
        return None
    return np.bincount(np.unique(folds, return_inverse=True)[1], squares)


def _held_out_by_rows(
    samples: Samples, Lambda: np.ndarray, model: PolicyModel, folds: np.ndarray
) -> Float[np.ndarray, " f"]:
    """The same by QR: each fold is boiled down to a triangle once, leaving it out means solving with the others'."""
    triangles, before = dict[int, np.ndarray](), 0
    for rows in _rows(samples, Lambda, model):
        after = before + len(rows) // (samples.nv - len(Lambda))
        fold_of_row = np.repeat(folds[before:after], samples.nv - len(Lambda))
        for fold in np.unique(fold_of_row).tolist():
            own = rows[fold_of_row == fold]
            triangles[fold] = _triangle([triangles[fold], own] if fold in triangles else [own])
        before = after
    sums = np.zeros(len(triangles))
    for i, (fold, held) in enumerate(sorted(triangles.items())):
        rest = _triangle(R for other, R in sorted(triangles.items()) if other != fold)
        theta = _solve(rest[:, :-1], rest[:, -1:])
        sums[i] = float(np.sum((held[:, -1:] - held[:, :-1] @ theta) ** 2))
    return sums


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
