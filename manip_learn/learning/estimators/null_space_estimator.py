"""The estimator for motion-constrained demonstrations, A(q) u = 0."""

from __future__ import annotations

import numpy as np

from manip_learn.learning.estimators.estimate import Estimate
from manip_learn.learning.estimators.null_space import NullSpaceFit, fit_null_space, group_moments, levels
from manip_learn.learning.estimators.rank import gaps_of_levels
from manip_learn.learning.samples import Samples
from manip_learn.linalg import batch_row_spaces

MAX_FOLDS = 10


def estimate_null_space(samples: Samples, n_constraints: int | None = None) -> Estimate:
    """Closed-form start, number of rows from the gap of the levels, Gauss-Newton, leave-trajectories-out residual.

    Args:
        samples: What was recorded.
        n_constraints: Number of rows; found from the data by default.
    """
    sizes, directions = levels(samples)
    table = gaps_of_levels(sizes, samples.nv)
    s = n_constraints or table.best
    fit = fit_null_space(samples, directions[:s])
    m = s * (samples.n_rows - s)
    return Estimate(
        "null-space",
        fit.selection,
        table,
        share(fit),
        held_out_share(samples, s),
        fit.scores.reshape(samples.n_groups, m),
        fit.curvatures,
    )


def share(fit: NullSpaceFit) -> float:
    """Share of the energy that breaks A u = 0."""
    return fit.cost / fit.energy if fit.energy > 0.0 else 0.0


def held_out_share(samples: Samples, s: int) -> float:
    """Share of the energy that breaks a constraint learnt, in closed form, from the other trajectories."""
    moments = group_moments(samples)
    n_folds = min(MAX_FOLDS, samples.n_groups)
    if n_folds < 2:
        return float("nan")
    fold_of_group = np.arange(samples.n_groups) % n_folds
    total = moments.sum(axis=0)
    selections = []
    for fold in range(n_folds):
        _, vectors = np.linalg.eigh(total - moments[fold_of_group == fold].sum(axis=0))
        selections.append(vectors[:, :s].T)
    broken = energy = 0.0
    stacked = np.array(selections)
    for block in samples.blocks():
        Lambda = stacked[fold_of_group[block.group]]
        Q, _ = batch_row_spaces(Lambda @ block.Phi)
        broken += float(np.sum(np.einsum("nvs,nv->ns", Q[:, :, :s], block.u, optimize=True) ** 2))
        energy += float(np.sum(block.u**2))
    return broken / energy if energy > 0.0 else float("nan")
