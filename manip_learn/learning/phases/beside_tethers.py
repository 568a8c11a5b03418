"""Contacts seen in a single recording, next to a tether or a door taken for one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.agreement.edges import is_chance
from manip_learn.learning.phases.merging import merged
from manip_learn.learning.phases.motion import PhaseMotion
from manip_learn.learning.phases.result import PhaseConstraint, PhaseResult, Stretch
from manip_learn.learning.phases.unsupported import contacts_of_one
from manip_learn.recordings.trajectory import Trajectory

# share of a stretch of the soft rows that the tether explains, from which nothing else is looked for in it
EXPLAINED_SHARE = 0.5


def with_contacts_beside(
    features: Sequence[FeatureMap],
    trajectories: Sequence[Trajectory],
    tethers: PhaseResult,
    soft: PhaseResult,
    rng: np.random.Generator,
) -> PhaseResult:
    """What was found with tethers, and the contacts that one recording alone shows besides.

    Soft rows that stand for a part of the sphere take in such a contact; with the tether in their place it is looked
    for again. Where a short stretch of the tether lies in it, that stretch was chance.

    Args:
        features: Those that the soft rows were found in.
        trajectories: Whole recordings with velocities.
        tethers: What explains more.
        soft: What the features themselves explain.
        rng: For the comparison with chance.
    """
    every = [s for c in tethers.constraints for s in c.stretches]
    short = [s for c in tethers.constraints for s in c.stretches if is_chance(s, c.stretches)]
    open_ones = [s for c in soft.constraints for s in c.stretches if _shared(s, every) < EXPLAINED_SHARE * s.duration]
    if open_ones:
        taken = [s for s in every if s not in short]
        searched = [(f, PhaseMotion.collect(f, trajectories)) for f in features]
        alone = [x for f, motion in searched for x in contacts_of_one(f, trajectories, motion, taken, rng)]
    else:
        alone = [(s.duration, s) for s in soft.unsupported]
    if not alone:
        return tethers
    left = [s for s in short if _shared(s, [lone for _, lone in alone]) > 0.0]
    constraints = tuple(_without(c, left) for c in tethers.constraints)
    found = dataclasses.replace(tethers, constraints=constraints)
    return merged(PhaseMotion.collect(features[0], trajectories), [found], alone)


def _without(constraint: PhaseConstraint, left: Sequence[Stretch]) -> PhaseConstraint:
    return dataclasses.replace(constraint, stretches=tuple(s for s in constraint.stretches if s not in left))


def _shared(stretch: Stretch, others: Sequence[Stretch]) -> float:
    """Time of a stretch that others of the same recording share [s]."""
    same = (s for s in others if s.trajectory == stretch.trajectory)
    return sum(max(0.0, min(stretch.end, s.end) - max(stretch.start, s.start)) for s in same)
