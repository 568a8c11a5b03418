"""Stretches whose ends have left what the others hold still: the contact began later, or ended before."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.agreement.reason import way_along
from manip_learn.learning.phases.result import Stretch
from manip_learn.recordings.trajectory import Trajectory

# a stretch has left the held rows where it is this many times farther out than the members usually get at most
FAR = 5.0
# least share of the time in which they are held: a grip that slips halfway leaves less on either side
CORE = 0.7
# of two stretches in a recording, the shorter one is chance if the other lasts this many times longer
LONGER = 2.0


def held_part(
    features: FeatureMap,
    odd: Trajectory,
    members: Sequence[Trajectory],
    selection: Float[np.ndarray, "s p"],
) -> tuple[float, float] | None:
    """Start and end [s] of the one part of an odd stretch in which it holds the rows as still as its members do.

    None if that part is not nearly all of it.

    Args:
        features: Phi.
        odd: A stretch that does not hold the rows throughout, with velocities.
        members: Stretches that do.
        selection: Lambda of the rows.
    """
    usual = float(np.median([np.max(_away(features, t, selection)) for t in members]))
    outside = np.flatnonzero(_away(features, odd, selection) > FAR * usual)
    edges = np.concatenate([[-1], outside, [len(odd)]])
    longest = int(np.argmax(np.diff(edges)))
    first, last = int(edges[longest]) + 1, int(edges[longest + 1]) - 1
    if last < first:
        return None  # of a slip halfway, the median lies between the two grips
    start, end = float(odd.time[first]), float(odd.time[last])
    return (start, end) if end - start >= CORE * odd.duration else None


def is_chance(stretch: Stretch, members: Sequence[Stretch]) -> bool:
    """Whether the same recording shows the contact elsewhere, and longer."""
    return any(s.trajectory == stretch.trajectory and s.duration >= LONGER * stretch.duration for s in members)


def _away(features: FeatureMap, t: Trajectory, selection: Float[np.ndarray, "s p"]) -> Float[np.ndarray, " T"]:
    """Distance along the held rows from where most of the stretch is [m or rad]."""
    way = way_along(features, t, selection)
    return np.linalg.norm(way - np.median(way, axis=0), axis=1)
