"""Recordings in which the contact is interrupted although it is not in the others: the hand has slipped."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.agreement.reason import reason, way_along
from manip_learn.learning.phases.result import PhaseConstraint, Stretch
from manip_learn.recordings.trajectory import Trajectory

# longest interruption: who lets go for longer does so on purpose [s]
LONGEST = 1.5
# a slip goes this many times farther along the held rows than a whole contact, and at least this far [m or rad]
FACTOR, LEAST = 5.0, 2e-3


def interruptions(
    features: FeatureMap,
    trajectories: Sequence[Trajectory],
    constraint: PhaseConstraint,
    others: Sequence[Stretch] = (),
) -> dict[int, str]:
    """Trajectories in which motion along the held rows interrupts a contact that most others show in one piece.

    Args:
        features: Phi of the constraint.
        trajectories: Whole recordings with velocities.
        constraint: With the stretches in which it holds.
        others: Stretches of other constraints: what lies between two contacts is no slip if another holds there.

    Returns:
        Number of the trajectory -> what happens when, in words.
    """
    spans = {i: [s for s in constraint.stretches if s.trajectory == i] for i in constraint.trajectories}
    usual = np.median([len(s) for s in spans.values()])
    whole = [trajectories[s.trajectory][s.start : s.end] for s in constraint.stretches]
    held = np.median([_extent(features, t, constraint) for t in whole])
    out = {}
    for i, parts in spans.items():
        for a, b in pairwise(parts if len(parts) > usual else ()):
            else_held = any(s.trajectory == i and s.start < b.start and s.end > a.end for s in others)
            near = b.start - a.end <= LONGEST and not else_held
            between = trajectories[i][a.end : b.start] if near else None
            if between is not None and _extent(features, between, constraint) > max(FACTOR * held, LEAST):
                why = reason(features, [*whole, between], constraint.selection, len(whole), range(len(whole)))
                out[i] = f"its contact is interrupted from {a.end:.2f} s to {b.start:.2f} s, as by a slip: {why}"
                break
    return out


def _extent(features: FeatureMap, trajectory: Trajectory, constraint: PhaseConstraint) -> float:
    return float(np.linalg.norm(np.ptp(way_along(features, trajectory, constraint.selection), axis=0)))
