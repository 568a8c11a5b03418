"""The joint estimator's number of rows, no larger than the trajectories can tell."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from manip_learn.learning.estimators.estimate import CLEAR_GAP, GapTable

# share of left-out motion that no model explains from which a weak gap may be the policy's
POOR = 0.03
# chance of one row too many by luck
CHANCE = 0.02


def drop_doubtful_rows(
    table: GapTable, residuals: dict[int, Float[np.ndarray, " f"]], unexplained: dict[int, float], floor: float
) -> tuple[GapTable, tuple[str, ...]]:
    """Fewer rows where the last of them is not told from chance, or from what no policy model explains.

    Samples of one trajectory are not independent, so that few trajectories can make a row look commanded: the residual
    per degree of freedom must fall in the folds of trajectories by a factor whose logarithm is beyond what Student's
    distribution lets expect. Where the motion is poorly explained anyway, a weak gap may be the policy's.

    Args:
        table: Evidence of the pooled residuals.
        residuals: Number of rows -> held-out residual energy a degree of freedom of each fold [(rad/s)^2].
        unexplained: Number of rows -> share of the energy of left-out trajectories.
        floor: Residual energy that is rounding.

    Returns:
        The table with its best number of rows, and a warning where that is another.
    """
    best = table.best
    while best > 1 and best - 1 in residuals and table.gap(best - 1) >= table.weak_from:
        more, fewer = (np.maximum(residuals[k], floor) for k in (best, best - 1))
        doubtful = unexplained[best] > POOR and table.gap(best) < CLEAR_GAP
        if _is_gain(np.log(fewer / more)) and not doubtful:
            break
        best -= 1
    if best == table.best:
        return table, ()
    warning = (
        f"{table.best} rows fit better than {best}, but not beyond what few trajectories or an imperfect policy model "
        f"can make up: {best} are answered; record more trajectories, or give n_constraints if you know it"
    )
    return dataclasses.replace(table, best=best), (warning,)


def _is_gain(differences: Float[np.ndarray, " f"]) -> bool:
    """Whether the mean of some differences is above zero beyond chance (one-sided, Student)."""
    n, spread = len(differences), float(np.std(differences, ddof=1)) if len(differences) > 1 else 0.0
    if n < 2 or spread == 0.0:
        return bool(np.mean(differences) > 0.0)
    return bool(np.mean(differences) * np.sqrt(n) / spread > stdtrit(n - 1, 1.0 - CHANCE))
