"""The paper's own route: first the null-space part of the motion, then Lambda from it."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.estimators.estimate import Estimate
from manip_learn.learning.estimators.null_space import fit_null_space, levels
from manip_learn.learning.estimators.null_space_estimator import held_out_share, share
from manip_learn.learning.estimators.policy_model import RadialModel
from manip_learn.learning.estimators.rank import gaps_of_levels
from manip_learn.learning.estimators.row_by_row import fit_row_by_row
from manip_learn.learning.estimators.separation import Separation, separate
from manip_learn.learning.samples import Samples

N_CENTRES = 96
SAMPLES_PER_CENTRE = 10
MIN_CENTRES = 4
# the descent is dense in samples times parameters; more samples than this only say the same again
SEPARATION_LIMIT = 4_000
# the consistency cost is worth nothing if w~ has all but vanished
VANISHED = 1e-6

Learner = Literal["gauss-newton", "row-by-row"]


def estimate_separate(
    samples: Samples, n_constraints: int | None, rng: np.random.Generator, learner: Learner = "gauss-newton"
) -> Estimate:
    """Separate u into task and null-space part, then learn Lambda from A w~ = 0.

    Args:
        samples: What was recorded.
        n_constraints: Number of rows; from the gap of the levels of w~ by default.
        rng: For k-means.
        learner: How Lambda is learnt from w~: ours, or the reference after Lin, Howard and Vijayakumar.

    Raises:
        NotIdentifiableError: Too few samples, or no null-space motion to be found.
    """
    separation, w = separated(samples, rng)
    if float(np.mean(w**2)) * samples.nv < VANISHED * samples.energy:
        raise NotIdentifiableError(
            "the separation finds no null-space motion: what is left of the motion after the task is nothing to learn "
            "from; use estimator='joint'",
            code="no-null-motion",
        )
    null_motion = dataclasses.replace(samples, u=w)
    sizes, directions = levels(null_motion)
    table = gaps_of_levels(sizes, samples.nv)
    s = n_constraints or table.best
    if learner == "row-by-row":
        fit = fit_null_space(null_motion, fit_row_by_row(null_motion, s), max_iterations=0)
    else:
        fit = fit_null_space(null_motion, directions[:s])
    return Estimate(
        "separate",
        fit.selection,
        table,
        share(fit),
        held_out_share(null_motion, s),
        fit.scores.reshape(samples.n_groups, -1),
        fit.curvatures,
        separation.model.name,
        {separation.model.name: separation.cost / samples.energy},
    )


def separated(samples: Samples, rng: np.random.Generator) -> tuple[Separation, np.ndarray]:
    """The separation and w~ at every sample, shape (n, nv).

    Raises:
        NotIdentifiableError: Too few samples for even the smallest model.
    """
    x = np.concatenate([block.x for block in samples.blocks()])
    n_centres = min(N_CENTRES, len(samples) // SAMPLES_PER_CENTRE)
    if n_centres < MIN_CENTRES:
        raise NotIdentifiableError(
            f"{len(samples)} samples are too few to separate task and null-space part: at least "
            f"{MIN_CENTRES * SAMPLES_PER_CENTRE} are needed, and many more are better",
            code="too-few-samples",
        )
    every = -(-len(samples) // SEPARATION_LIMIT)
    separation = separate(x[::every], samples.u[::every], RadialModel(x, n_centres, rng))
    return separation, separation(x)
