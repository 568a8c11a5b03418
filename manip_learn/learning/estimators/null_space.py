"""Lambda from null-space motion: the recorded motion obeys A(q) u = 0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.learning.estimators.estimate import Estimate, descend_rows, gaps_of_levels
from manip_learn.learning.samples import Samples, rows_beside
from manip_learn.linalg import complement_rows, inverse_triangles_beside, orthonormal_rows, row_bases

MAX_ITERATIONS = 50  # of Gauss-Newton, which ends by itself before
MAX_FOLDS = 10  # parts that are left out in turn
SAME_COST = 1e-13  # a relative rise of the cost below this is rounding: the step counts as no gain
# length of the last step [rad on the Grassmann manifold], and the relative gain that is none: both are rounding
SHORTEST, GAIN = 1e-14, 1e-12


@final
@dataclass(frozen=True, eq=False)
class NullSpaceFit:
    """Result of the null-space estimator.

    Attributes:
        whitened_selection: Lambda in whitened coordinates, orthonormal rows, shape (s, p').
        cost: Mean of w^T A^+ A w, equation (10).
        energy: Mean of |w|^2; cost / energy is the share of the motion that breaks the constraint.
        scores: shape (groups, s, p'-s), gradient of each trajectory: sum (A^{+T} w)(Lambda_perp Phi N w)^T.
        curvatures: shape (groups, m, m), Gauss-Newton Hessian of each trajectory, m = s (p'-s).
    """

    whitened_selection: Float[np.ndarray, "s r"]
    cost: float
    energy: float
    scores: Float[np.ndarray, "g s k"]
    curvatures: Float[np.ndarray, "g m m"]

    @property
    def unexplained(self) -> float:
        """Share of the energy that breaks A u = 0."""
        return self.cost / self.energy if self.energy > 0.0 else 0.0

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient of all trajectories."""
        return self.curvatures.sum(axis=0), self.scores.sum(axis=0).reshape(-1)


def split(
    A: Float[np.ndarray, "s nv n"], w: Float[np.ndarray, "nv n"]
) -> tuple[Float[np.ndarray, "s n"], Float[np.ndarray, "nv n"], Float[np.ndarray, "s s n"]]:
    """Q^T w, N w and R^-1 of A^T = Q R, the samples side by side in the last axis."""
    Q, R = row_bases(A.transpose(1, 0, 2))
    along = np.einsum("vsn,vn->sn", Q, w)
    return along, w - np.einsum("vsn,sn->vn", Q, along), inverse_triangles_beside(R)


def levels(
    samples: Samples, moments: Float[np.ndarray, "g r r"] | None = None
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r r"]]:
    """How much the motion uses each whitened direction, least first, and the directions as rows.

    A level is the root mean square of the motion's velocity along a direction, relative to a motion that is equally
    strong in all joints: about 1 along a free direction, about the noise along a constrained one. In whitened
    coordinates this is the generalised eigenproblem sum Phi w w^T Phi^T x = e sum Phi Phi^T x.
    The samples' `trajectory_moments` are taken from the caller where they are known.
    """
    moment = (trajectory_moments(samples) if moments is None else moments).sum(axis=0)
    eigenvalues, vectors = np.linalg.eigh(moment / len(samples))
    scale = samples.nv / max(samples.energy, np.finfo(np.float64).tiny)
    return np.sqrt(np.maximum(eigenvalues, 0.0) * scale), vectors.T


def trajectory_moments(samples: Samples) -> Float[np.ndarray, "g r r"]:
    """sum Phi u u^T Phi^T of each trajectory: enough for the closed-form start on any choice of trajectories."""
    moments = np.zeros((samples.n_trajectories, samples.n_rows, samples.n_rows))
    for block in samples.blocks():
        r = np.einsum("pvn,vn->pn", block.Phi.transpose(1, 2, 0), np.ascontiguousarray(block.u.T))
        block.add_to(moments, r[:, None] * r)
    return moments


def fit_null_space(
    samples: Samples, start: Float[np.ndarray, "s r"], max_iterations: int = MAX_ITERATIONS
) -> NullSpaceFit:
    """Gauss-Newton on the Grassmann manifold for equation (10), E = sum w^T A^+ A w, from a start.

    With dLambda = B Lambda_perp the gradient is 2 sum (A^{+T} w)(Lambda_perp Phi N w)^T; its steps: `descend`.
    The samples hold w in place of u: the motion itself, or the null-space part that a separation found. The start is in
    whitened coordinates; no iterations judge it as it is.
    """
    here = _fit_at(samples, orthonormal_rows(start))
    return descend_rows(here, lambda Lambda: _fit_at(samples, Lambda), max_iterations, SHORTEST, GAIN, rise=SAME_COST)


def _fit_at(samples: Samples, Lambda: np.ndarray) -> NullSpaceFit:
    """Lambda as it is, with what a Gauss-Newton step needs."""
    s, k = len(Lambda), samples.n_rows - len(Lambda)
    both = np.concatenate([Lambda, complement_rows(Lambda)])
    scores = np.zeros((samples.n_trajectories, s, k))
    curvatures = np.zeros((samples.n_trajectories, s * k, s * k))
    cost = energy = 0.0
    for block in samples.blocks():
        rows, w = rows_beside(both, block.Phi), np.ascontiguousarray(block.u.T)
        along, null, R_inverse = split(rows[:s], w)
        a = np.einsum("ijn,jn->in", R_inverse, along)  # A^{+T} w
        g = np.einsum("kvn,vn->kn", rows[s:], null)
        inverse_gram = np.einsum("iln,jln->ijn", R_inverse, R_inverse)  # (A A^T)^-1
        H = inverse_gram[:, None, :, None] * (g[:, None] * g)[None, :, None]
        cost, energy = cost + float(np.sum(along**2)), energy + float(np.sum(w**2))
        block.add_to(scores, a[:, None] * g)
        block.add_to(curvatures, H.reshape(s * k, s * k, w.shape[1]))
    n = len(samples)
    return NullSpaceFit(Lambda, cost / n, energy / n, scores, curvatures)


def estimate_null_space(samples: Samples, n_constraints: int | None = None) -> Estimate:
    """Closed-form start, number of rows from the gap of the levels by default, Gauss-Newton, and the residual of
    trajectories that are left out.
    """
    moments = trajectory_moments(samples)
    sizes, directions = levels(samples, moments)
    table = gaps_of_levels(sizes, samples.nv)
    s = n_constraints or table.best
    fit = fit_null_space(samples, directions[:s])
    return Estimate(
        "null-space",
        fit.whitened_selection,
        table,
        fit.unexplained,
        held_out_share(samples, s, moments),
        fit.scores.reshape(samples.n_trajectories, s * (samples.n_rows - s)),
        fit.curvatures,
        levels=sizes,
    )


def held_out_share(samples: Samples, s: int, moments: Float[np.ndarray, "g r r"]) -> float:
    """Share of the energy that breaks a constraint of s rows learnt, in closed form, from the other trajectories."""
    n_folds = min(MAX_FOLDS, samples.n_trajectories)
    if n_folds < 2:
        return float("nan")
    fold_of_trajectory = np.arange(samples.n_trajectories) % n_folds
    total = moments.sum(axis=0)
    others = np.stack([total - moments[fold_of_trajectory == fold].sum(axis=0) for fold in range(n_folds)])
    selections = np.linalg.eigh(others)[1][:, :, :s].transpose(2, 1, 0)
    broken = energy = 0.0
    for block in samples.blocks():
        Lambda = selections[:, :, fold_of_trajectory[block.trajectory]]
        Q, _ = row_bases(np.einsum("srn,rvn->vsn", Lambda, block.Phi.transpose(1, 2, 0)))
        broken += float(np.sum(np.einsum("vsn,vn->sn", Q, np.ascontiguousarray(block.u.T)) ** 2))
        energy += float(np.sum(block.u**2))
    return broken / energy if energy > 0.0 else float("nan")
