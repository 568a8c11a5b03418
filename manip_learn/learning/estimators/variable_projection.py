"""Lambda and the null-space policy together, from raw (q, u): variable projection on the Grassmann manifold.

    min over Lambda, Theta of  sum_n | Z_n^T (u_n - Theta^T beta(q_n)) |^2,   Z_n the null basis of A_n = Lambda Phi_n

Neither a separation of u into task and null part nor knowledge of b is needed: Z^T removes the task part whatever it
was. pi(q) = Theta^T beta(q) is linear in its parameters, so Theta is eliminated (Golub and Pereyra, 1973, with
Kaufman's Jacobian, 1975).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.linalg import qr, solve_triangular

from manip_learn.learning.bootstrap import TrajectoryBlocks
from manip_learn.learning.estimators.descent import descend
from manip_learn.learning.estimators.joint_fit import JointFit
from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.estimators.projected_equations import (
    LEAST_PIVOT,
    NEARLY_EXACT,
    fit_projected,
    held_out_by_fold,
)
from manip_learn.learning.samples import Block, Samples
from manip_learn.linalg import batch_row_spaces, complement_rows, inverse_triangles, orthonormal_rows

MAX_ITERATIONS = 30
RANK_TOLERANCE = 1e-13
# directions of the policy that the data determine well enough to matter for the uncertainty
BASIS_TOLERANCE = 1e-10
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
    here, iterations = descend(
        _State.at(samples, orthonormal_rows(start), model),
        lambda Lambda: _State.at(samples, Lambda, model),
        *(max_iterations, tolerance, gain),
    )
    return JointFit(here.Lambda, here.theta, here.cost, here.energy, iterations, model)


@final
@dataclass(frozen=True, eq=False)
class _State:
    """The best policy for a Lambda, from a QR of all rows."""

    samples: Samples
    model: PolicyModel
    Lambda: Float[np.ndarray, "s r"]
    theta: Float[np.ndarray, "j nv"]
    cost: float
    energy: float

    @staticmethod
    def at(samples: Samples, Lambda: Float[np.ndarray, "s r"], model: PolicyModel) -> _State:
        return _State(samples, model, Lambda, *_policy(samples, Lambda, model))

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """See `descend`."""
        return _normal_equations(self.samples, self.Lambda, self.theta, self.model)


def scores(samples: Samples, fit: JointFit) -> tuple[Float[np.ndarray, "g d"], Float[np.ndarray, "g d d"]]:
    """Gradient and Gauss-Newton Hessian of each block of trajectories at the optimum; d = k' + m, m = s (p'-s).

    The last m unknowns are those of Lambda, the first k' those of the policy, in an orthonormal basis of what the data
    determine: whoever leaves a trajectory out must let the policy move too. Beyond MAX_BLOCKS trajectories several
    consecutive ones make a block.
    """
    s, r = fit.whitened_selection.shape
    m, z = s * (r - s), samples.nv - s
    R = _triangle(_joint_rows(samples, fit.whitened_selection, fit.theta, fit.model))
    width = R.shape[1] - m - 1
    projection = _solve(R[:, :width], R[:, width : width + m])
    _, T, pivots = qr(R[:, :width], mode="economic", pivoting=True, check_finite=False)
    diagonal = np.abs(np.diag(T))
    k = int(np.count_nonzero(diagonal > BASIS_TOLERANCE * diagonal[0])) if diagonal.size else 0
    blocks = TrajectoryBlocks(samples.n_trajectories, MAX_BLOCKS)
    gradients = np.zeros((blocks.n_blocks, k + m))
    hessians = np.zeros((blocks.n_blocks, k + m, k + m))
    for block, rows in zip(
        samples.blocks(), _joint_rows(samples, fit.whitened_selection, fit.theta, fit.model), strict=True
    ):
        K = solve_triangular(T[:k, :k], rows[:, pivots[:k]].T, trans="T", check_finite=False).T
        J = np.concatenate([K, rows[:, width : width + m] - rows[:, :width] @ projection], axis=1)
        for i, part in blocks.runs(block.trajectory):
            own = slice(part.start * z, part.stop * z)
            gradients[i] += J[own].T @ rows[own, -1]
            hessians[i] += J[own].T @ J[own]
    return gradients, hessians


def held_out_cost(
    samples: Samples, Lambda: Float[np.ndarray, "s r"], model: PolicyModel, n_folds: int, *, by_sample: bool = False
) -> float:
    """Mean of |Z^T (u - pi)|^2 on trajectories that pi was not fitted to, Lambda kept: cross-validation of pi."""
    return float(held_out_costs(samples, Lambda, model, n_folds, by_sample=by_sample).sum())


def held_out_costs(
    samples: Samples, Lambda: Float[np.ndarray, "s r"], model: PolicyModel, n_folds: int, *, by_sample: bool = False
) -> Float[np.ndarray, " f"]:
    """What each fold contributes to `held_out_cost`; a single infinity where there are fewer than two folds.

    `by_sample` leaves out every n-th sample instead, for models with parameters of each trajectory. Each fold is boiled
    down to a triangle once; leaving it out means solving with the others'.
    """
    fold = np.arange(len(samples)) if by_sample else samples.trajectory
    sums = held_out_by_fold(samples, Lambda, model, fold % n_folds) if len(samples) >= n_folds > 1 else None
    if sums is not None:
        return sums / len(samples) if len(sums) > 1 else np.array([np.inf])
    triangles: list[np.ndarray | None] = [None] * n_folds
    for block in samples.blocks():
        Z, _, _ = _bases(block, Lambda)
        target = np.einsum("nvz,nv->nz", Z, block.u, optimize=True)
        rows = np.concatenate([_policy_columns(Z, model(block.x, block.trajectory)), target.reshape(-1, 1)], axis=1)
        folds = np.arange(len(block.u)) if by_sample else block.trajectory
        fold_of_row = np.repeat(folds % n_folds, Z.shape[2])
        for fold in np.unique(fold_of_row):
            before = triangles[fold]
            new = rows[fold_of_row == fold]
            triangles[fold] = _triangle(iter([new] if before is None else [before, new]))
    present = [R for R in triangles if R is not None]
    if len(present) < 2:
        return np.array([np.inf])
    total = np.zeros(len(present))
    for i, held in enumerate(present):
        rest = _triangle(iter([R for j, R in enumerate(present) if j != i]))
        theta = _solve(rest[:, :-1], rest[:, -1:])
        total[i] = float(np.sum((held[:, -1:] - held[:, :-1] @ theta) ** 2))
    return total / len(samples)


def _bases(block: Block, Lambda: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    s = Lambda.shape[0]
    A = np.einsum("sr,nrv->nsv", Lambda, block.Phi, optimize=True)
    Q, R = batch_row_spaces(A)
    return Q[:, :, s:], Q[:, :, :s], R


def _policy(samples: Samples, Lambda: np.ndarray, model: PolicyModel) -> tuple[np.ndarray, float, float]:
    """Best Theta for a Lambda by accumulated QR, with cost and energy."""
    energy = 0.0

    def rows() -> Iterator[np.ndarray]:
        nonlocal energy
        for block in samples.blocks():
            Z, _, _ = _bases(block, Lambda)
            target = np.einsum("nvz,nv->nz", Z, block.u, optimize=True)
            energy += float(np.sum(target**2))
            yield np.concatenate([_policy_columns(Z, model(block.x, block.trajectory)), target.reshape(-1, 1)], axis=1)

    R = _triangle(rows())
    nv = samples.nv
    theta = _solve(R[:, :-1], R[:, -1:])
    # the residual from the triangle, not from energy - explained: those two nearly cancel on clean data
    cost = float(np.sum((R[:, -1:] - R[:, :-1] @ theta) ** 2))
    n = len(samples)
    return theta.reshape(-1, nv), cost / n, energy / n


def _policy_columns(Z: np.ndarray, beta: np.ndarray) -> Float[np.ndarray, "rows c"]:
    n, nv, z = Z.shape
    columns = beta[:, None, :, None] * Z.transpose(0, 2, 1)[:, :, None, :]
    return columns.reshape(n * z, beta.shape[1] * nv)


def _joint_rows(samples: Samples, Lambda: np.ndarray, theta: np.ndarray, model: PolicyModel) -> Iterator[np.ndarray]:
    """Rows [d residual / d Theta | d residual / d B | residual], block by block; the residual is Z^T (u - pi)."""
    perp = complement_rows(Lambda)
    for block in samples.blocks():
        Z, Q1, R = _bases(block, Lambda)
        beta = model(block.x, block.trajectory)
        y = block.u - beta @ theta
        n, _, z = Z.shape
        a = np.einsum("nij,nvj,nv->ni", inverse_triangles(R), Q1, y, optimize=True)  # A^{+T} y
        F = np.einsum("nvz,kr,nrv->nzk", Z, perp, block.Phi, optimize=True)
        J = -(a[:, None, :, None] * F[:, :, None, :]).reshape(n * z, -1)
        residual = np.einsum("nvz,nv->nz", Z, y, optimize=True).reshape(-1, 1)
        yield np.concatenate([_policy_columns(Z, beta), J, residual], axis=1)


def _normal_equations(
    samples: Samples, Lambda: np.ndarray, theta: np.ndarray, model: PolicyModel
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
    """Gauss-Newton Hessian and gradient for B, with Theta projected off."""
    s, r = Lambda.shape
    m = s * (r - s)
    R = _triangle(_joint_rows(samples, Lambda, theta, model))
    width = R.shape[1] - m - 1
    K, J, residual = R[:, :width], R[:, width : width + m], R[:, -1]
    Jt = J - K @ _solve(K, J)
    return Jt.T @ Jt, Jt.T @ residual


def _triangle(blocks: Iterator[np.ndarray]) -> Float[np.ndarray, "rows n"]:
    """Triangle of the QR of all rows, stacked block after block: memory does not grow with the samples."""
    R: np.ndarray | None = None
    for rows in blocks:
        stacked = rows if R is None else np.concatenate([R, rows])
        R = qr(stacked, mode="r", overwrite_a=True, check_finite=False)[0][: min(stacked.shape)]
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
