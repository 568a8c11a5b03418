"""Recordings of several tasks: the trajectories of each."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.agreement.agreement import ODD_SHARE, SPLIT_GAIN, Agreement
from manip_learn.learning.agreement.clusters import MOST_ALONE, drifts
from manip_learn.learning.phases.hypotheses import fitted_rows
from manip_learn.learning.phases.motion import PhaseMotion, broken_energy
from manip_learn.learning.phases.search import FIRST_SCALE, refit, scale_of
from manip_learn.learning.phases.segmentation import evidence
from manip_learn.recordings.trajectory import Trajectory


def members_of_each(
    features: FeatureMap, trajectories: Sequence[Trajectory], agreement: Agreement
) -> list[tuple[int, ...]]:
    """The trajectories that agree, and those left out that agree among themselves, one tuple for each task.

    Two surfaces some degrees apart share a soft row, on which all their trajectories seem to agree beside a third task.
    They are told apart if rows of their own explain so much more of them.

    Args:
        features: Phi.
        trajectories: With velocities.
        agreement: Of these trajectories.
    """
    out = [agreement.members]
    for selection, members in agreement.others:
        motion = PhaseMotion.collect(features, [trajectories[i] for i in members]).thinned()
        out += [tuple(members[i] for i in part) for part in _told_apart(motion, len(selection))]
    return out


def _told_apart(motion: PhaseMotion, s: int) -> list[tuple[int, ...]]:
    """All trajectories, or those that hold s rows of their own firmly if these explain much more than rows of all."""
    everything = tuple(range(motion.n_trajectories))
    left, parts = everything, list[tuple[int, ...]]()
    while len(left) > 1:
        found = max((_holding(motion, pair, left, s) for pair in combinations(left[:MOST_ALONE], 2)), key=len)
        if len(found) < 2:
            break
        parts.append(found)
        left = tuple(i for i in left if i not in found)
    alone = sum(_evidence(motion, part, s) for part in parts)
    return parts if len(parts) > 1 and alone > SPLIT_GAIN * _evidence(motion, everything, s) else [everything]


def _holding(motion: PhaseMotion, pair: tuple[int, int], among: Sequence[int], s: int) -> tuple[int, ...]:
    """The trajectories that do not leave the rows of two of them."""
    rows = fitted_rows(motion, np.where(np.isin(motion.trajectory, pair), motion.weight, 0.0), s)[0]
    lengths, ways, _ = drifts(motion, rows)
    return tuple(i for i in among if lengths[i] <= ODD_SHARE * ways[i])


def _evidence(motion: PhaseMotion, members: Sequence[int], s: int) -> float:
    """For s rows held by these trajectories throughout [nats]."""
    held = np.isin(motion.trajectory, members)
    rows = refit(motion, held, s, FIRST_SCALE)
    part = motion.chosen(held)
    return float(evidence(part, broken_energy(part, rows[None]), s, [scale_of(motion, rows, held)]).sum())
