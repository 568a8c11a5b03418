"""Lambda from null-space motion: the recorded motion obeys A(q) u = 0."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.learning.estimators.descent import descend
from manip_learn.learning.estimators.estimate import Estimate, gaps_of_levels
from manip_learn.learning.samples import Block, Samples
from manip_learn.linalg import complement_rows, inverse_triangles_beside, orthonormal_rows, row_bases

MAX_ITERATIONS = 50
MAX_FOLDS = 10
SAME_COST = 1e-13  # a relative rise of the cost below this is rounding: the step counts as no gain
# a velocity to be explained, block by block: u itself, or the null-space part that a separation found
Velocity = Callable[[Block], np.ndarray]


@final
@dataclass(frozen=True, eq=False)
class NullSpaceFit:
    """Result of the null-space estimator.

    Attributes:
        whitened_selection: Lambda in whitened coordinates, orthonormal rows, shape (s, p').
        cost: Mean of w^T A^+ A w, equation (10).
        energy: Mean of |w|^2; cost / energy is the share of the motion that breaks the constraint.
        iterations: Gauss-Newton steps.
        scores: shape (groups, s, p'-s), gradient of each trajectory: sum (A^{+T} w)(Lambda_perp Phi N w)^T.
        curvatures: shape (groups, m, m), Gauss-Newton Hessian of each trajectory, m = s (p'-s).
    """

    whitened_selection: Float[np.ndarray, "s r"]
    cost: float
    energy: float
    iterations: int
    scores: Float[np.ndarray, "g s k"]
    curvatures: Float[np.ndarray, "g m m"]

    @property
    def Lambda(self) -> Float[np.ndarray, "s r"]:
        """The same rows, as `descend` names them."""
        return self.whitened_selection

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient of all trajectories."""
        return self.curvatures.sum(axis=0), self.scores.sum(axis=0).reshape(-1)


def levels(samples: Samples) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r r"]]:
    """How much the motion uses each whitened direction, least first, and the directions as rows.

    A level is the root mean square of the motion's velocity along a direction, relative to a motion that is equally
    strong in all joints: about 1 along a free direction, about the noise along a constrained one. In whitened
    coordinates this is the generalised eigenproblem sum Phi w w^T Phi^T x = e sum Phi Phi^T x.
    """
    return _levels(samples, trajectory_moments(samples).sum(axis=0))


def _levels(
    samples: Samples, moment: Float[np.ndarray, "r r"]
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r r"]]:
    """The same from the sum of `trajectory_moments`."""
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
    samples: Samples,
    start: Float[np.ndarray, "s r"],
    velocity: Velocity | None = None,
    tolerance: float = 1e-14,
    max_iterations: int = MAX_ITERATIONS,
) -> NullSpaceFit:
    """Gauss-Newton on the Grassmann manifold for equation (10), E = sum w^T A^+ A w, from a start.

    With dLambda = B Lambda_perp the gradient is 2 sum (A^{+T} w)(Lambda_perp Phi N w)^T; see `descend` for the steps.

    Args:
        samples: What was recorded.
        start: Lambda in whitened coordinates.
        velocity: The null-space part w of a block; the recorded u by default.
        tolerance: Step length at which to stop.
        max_iterations: Largest number of steps; 0 judges the start as it is.
    """
    here, iterations = descend(
        _moments(samples, orthonormal_rows(start), velocity),
        lambda Lambda: _moments(samples, Lambda, velocity),
        *(max_iterations, tolerance, 1e-12),
        rise=SAME_COST,
    )
    return replace(here, iterations=iterations)


def _moments(samples: Samples, Lambda: np.ndarray, velocity: Velocity | None) -> NullSpaceFit:
    """What a Gauss-Newton step needs; the samples lie side by side in the last axis."""
    s, r = Lambda.shape
    perp, k = complement_rows(Lambda), r - s
    scores = np.zeros((samples.n_trajectories, s, k))
    curvatures = np.zeros((samples.n_trajectories, s * k, s * k))
    cost = energy = 0.0
    for block in samples.blocks():
        w = np.ascontiguousarray((block.u if velocity is None else velocity(block)).T)
        Q, R = row_bases(block.rows_of(Lambda).transpose(1, 0, 2))
        along = np.einsum("vsn,vn->sn", Q, w)
        null = w - np.einsum("vsn,sn->vn", Q, along)
        cost += float(np.sum(along**2))
        energy += float(np.sum(w**2))
        if k == 0:
            continue
        R_inverse = inverse_triangles_beside(R)
        a = np.einsum("ijn,jn->in", R_inverse, along)  # A^{+T} w
        g = np.einsum("kvn,vn->kn", block.rows_of(perp), null)
        block.add_to(scores, a[:, None] * g)
        inverse_gram = np.einsum("iln,jln->ijn", R_inverse, R_inverse)  # (A A^T)^-1
        H = inverse_gram[:, None, :, None] * (g[:, None] * g)[None, :, None]
        block.add_to(curvatures, H.reshape(s * k, s * k, -1))
    n = len(samples)
    return NullSpaceFit(Lambda, cost / n, energy / n, 0, scores, curvatures)


def estimate_null_space(samples: Samples, n_constraints: int | None = None) -> Estimate:
    """Closed-form start, number of rows from the gap of the levels, Gauss-Newton, leave-trajectories-out residual.

    Args:
        samples: What was recorded.
        n_constraints: Number of rows; found from the data by default.
    """
    moments = trajectory_moments(samples)
    sizes, directions = _levels(samples, moments.sum(axis=0))
    table = gaps_of_levels(sizes, samples.nv)
    s = n_constraints or table.best
    fit = fit_null_space(samples, directions[:s])
    m = s * (samples.n_rows - s)
    return Estimate(
        "null-space",
        fit.whitened_selection,
        table,
        energy_share(fit),
        _held_out_share(samples, s, moments),
        fit.scores.reshape(samples.n_trajectories, m),
        fit.curvatures,
        levels=sizes,
    )


def null_space_gap(samples: Samples, n_constraints: int | None = None) -> float:
    """The gap that `estimate_null_space` will find: it depends on the levels alone."""
    table = gaps_of_levels(levels(samples)[0], samples.nv)
    return table.gap(n_constraints or table.best)


def energy_share(fit: NullSpaceFit) -> float:
    """Share of the energy that breaks A u = 0."""
    return fit.cost / fit.energy if fit.energy > 0.0 else 0.0


def held_out_share(samples: Samples, s: int) -> float:
    """Share of the energy that breaks a constraint learnt, in closed form, from the other trajectories."""
    return _held_out_share(samples, s, trajectory_moments(samples))


def _held_out_share(samples: Samples, s: int, moments: Float[np.ndarray, "g r r"]) -> float:
    """The same from `trajectory_moments`."""
    n_folds = min(MAX_FOLDS, samples.n_trajectories)
    if n_folds < 2:
        return float("nan")
    fold_of_trajectory = np.arange(samples.n_trajectories) % n_folds
    total = moments.sum(axis=0)
    selections = []
    for fold in range(n_folds):
        _, vectors = np.linalg.eigh(total - moments[fold_of_trajectory == fold].sum(axis=0))
        selections.append(vectors[:, :s].T)
    broken = energy = 0.0
    stacked = np.stack(selections, axis=2)
    for block in samples.blocks():
        Lambda = stacked[:, :, fold_of_trajectory[block.trajectory]]
        Q, _ = row_bases(np.einsum("srn,rvn->vsn", Lambda, block.Phi.transpose(1, 2, 0)))
        broken += float(np.sum(np.einsum("vsn,vn->sn", Q, np.ascontiguousarray(block.u.T)) ** 2))
        energy += float(np.sum(block.u**2))
    return broken / energy if energy > 0.0 else float("nan")
