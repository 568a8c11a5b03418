"""A second opinion on a constraint that was found in stretches of recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.agreement.agreement import judge_agreement
from manip_learn.learning.evidence.recombination import recombination_test
from manip_learn.recordings.trajectory import Trajectory

RECOMBINATIONS = 99
# least share of the stretches that must agree before a constraint is confirmed without the others
MOST = 0.6

# (features, the stretches, number of rows, rng) -> accepted or not, strength, p-value
Confirm = Callable[[FeatureMap, Sequence[Trajectory], int, np.random.Generator], tuple[bool, float, float]]


def confirmed_by_recombination(
    features: FeatureMap, stretches: Sequence[Trajectory], n_rows: int, rng: np.random.Generator
) -> tuple[bool, float, float]:
    """Whether exchanging joints between the stretches breaks so many rows: accepted or not, strength and p-value of
    the last row.
    """
    evidence = recombination_test(features, stretches, rng, RECOMBINATIONS)
    if len(evidence.strengths) < n_rows:
        return False, float("nan"), float("nan")
    return evidence.n_rows >= n_rows, evidence.strengths[n_rows - 1], evidence.p_values[n_rows - 1]


def without_odd(features: FeatureMap, stretches: Sequence[Trajectory], n_rows: int) -> list[Trajectory]:
    """The stretches that hold the same rows throughout, if they are most of them; else none.

    A slip of some millimetres is no more than a few samples to the phases, but as large as all that recombined joints
    break of a short contact.
    """
    agreement = judge_agreement(features, stretches, n_rows)
    few = len(agreement.members) < max(2.0, MOST * len(stretches))
    return [] if agreement.unanimous or few else [stretches[i] for i in agreement.members]
