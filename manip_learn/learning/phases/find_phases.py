"""Phases: the stretches of whole recordings in which a constraint holds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.phases.confirmation import Confirm, confirmed_by_recombination
from manip_learn.learning.phases.discovery import PhaseDiscovery
from manip_learn.learning.phases.hypotheses import fitted_rows
from manip_learn.learning.phases.merging import merged
from manip_learn.learning.phases.motion import PhaseMotion, broken_energy, sparse, velocity_noise
from manip_learn.learning.phases.result import PhaseResult
from manip_learn.learning.phases.unsupported import contacts_of_one
from manip_learn.recordings.trajectory import Trajectory

# a recording shorter than this has no phases to be told apart [s]
SHORTEST_RECORDING = 1.5
# one constraint fits if its levels are 10 times below the others, and at most 2 % of the moving samples move along its
# rows with more than 0.2 of the free speed
CLEAR_GAP, FEW, BROKEN = 10.0, 0.02, 0.2
NOISY = 3.0  # standard deviations of the velocities' noise, which break no row


def too_short(trajectories: Sequence[Trajectory]) -> bool:
    """Whether no recording is long enough to have phases that could be told apart."""
    return all(t.u is None or t.duration < SHORTEST_RECORDING for t in trajectories)


def one_constraint_fits(features: FeatureMap, trajectories: Sequence[Trajectory]) -> bool:
    """Whether rows of these features hold in nearly all samples that move, clearly more than all other rows."""
    return bool(maps_that_fit([features], trajectories))


def maps_that_fit(feature_maps: Sequence[FeatureMap], trajectories: Sequence[Trajectory]) -> tuple[FeatureMap, ...]:
    """Those of which one constraint fits."""
    few = sparse(trajectories)
    noise = [velocity_noise(t) for t in few if t.u is not None]
    return tuple(f for f in feature_maps if _one_fits(PhaseMotion.collect(f, few, noise), f.nv))


def _one_fits(motion: PhaseMotion, nv: int) -> bool:
    moving = motion.moving
    for s in range(1, min(motion.rates.shape[1], nv)):
        rows, levels = fitted_rows(motion, motion.weight, s)
        if levels[s] < CLEAR_GAP * levels[s - 1]:
            continue
        allowed = s * (BROKEN**2 * motion.free + NOISY**2 * motion.noise)
        broken = broken_energy(motion, rows[None])[:, 0] > allowed
        if np.count_nonzero(broken & moving) <= FEW * np.count_nonzero(moving):
            return True
    return False


def find_phases(
    features: FeatureMap | Sequence[FeatureMap],
    trajectories: Sequence[Trajectory],
    rng: np.random.Generator,
    confirm: Confirm = confirmed_by_recombination,
) -> PhaseResult:
    """Divide whole recordings into stretches in which a constraint holds, free motion and standstill.

    Constraints are found one after the other. Rows fitted in short windows are scored on all recordings, leaving out
    the best supporter; the best are refitted to what they explain. One is accepted if its evidence exceeds what the
    same search finds where recordings agree by chance only, and if `confirm` agrees. Then all constraints and free
    motion compete for every sample. Contacts that one recording alone shows are named and not learnt.

    Args:
        features: Phi; or several candidates, each searched on its own: where two explain the same stretches the one
            with more support counts.
        trajectories: Whole recordings with velocities.
        rng: For the comparison with chance.
        confirm: A second opinion on (features, stretches, number of rows, rng).

    Raises:
        RecordingError: A trajectory lacks velocities.
        NotIdentifiableError: Every row of Phi is zero throughout.
    """
    maps = [features] if isinstance(features, FeatureMap) else features
    searches = [PhaseDiscovery(f, trajectories, rng, confirm, i) for i, f in enumerate(maps)]
    results = [search.run() for search in searches]
    taken = [s for c in merged(searches[0].motion, results).constraints for s in c.stretches]
    alone = [contacts_of_one(f, trajectories, s.motion, taken, rng) for f, s in zip(maps, searches, strict=True)]
    return merged(searches[0].motion, results, [contact for contacts in alone for contact in contacts])
