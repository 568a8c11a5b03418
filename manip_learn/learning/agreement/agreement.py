"""Agreement: which trajectories obey one constraint together, and which do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.agreement.clusters import Cluster, best_cluster, clusters_of, drifts
from manip_learn.learning.agreement.reason import reason
from manip_learn.learning.phases.motion import PhaseMotion
from manip_learn.learning.phases.search import refit, scale_of
from manip_learn.recordings.trajectory import Trajectory

REFITS = 3
# several clusters must explain this many times the evidence of a single one
SPLIT_GAIN = 1.4
# a trajectory is odd if it drifts along the held rows more than this many times the usual distance, more than this many
# (robust) standard deviations of the logarithm above it, and by this share of its motion; in 50 sets of recordings that
# all agree the largest drift was 3 times the usual one
ODD_FACTOR = 2.5
ODD_SPREAD = 6.0
ODD_SHARE = 0.005
# and by more than white noise on its velocities takes a random walk: its range exceeds 4 standard deviations of its end
# in one of 10,000 trajectories
ODD_NOISE = 4.0


@final
@dataclass(frozen=True, eq=False)
class Agreement:
    """Which trajectories obey one constraint.

    Attributes:
        selection: Lambda of those that agree, in the features' own basis, orthonormal rows, shape (s, p).
        members: The trajectories that agree on it, counted from 0.
        odd: Those that do not, with the reason.
        drift: How far each trajectory moves along the held rows, as a share of how far it moves at all, shape (g,).
        usual_drift: The same for a typical one that agrees.
        others: Further constraints on which two or more of the odd ones agree: rows and trajectories.
    """

    selection: Float[np.ndarray, "s p"]
    members: tuple[int, ...]
    odd: tuple[tuple[int, str], ...]
    drift: Float[np.ndarray, " g"]
    usual_drift: float
    others: tuple[tuple[Float[np.ndarray, "k p"], tuple[int, ...]], ...] = ()

    @property
    def unanimous(self) -> bool:
        """Whether all trajectories agree."""
        return not self.odd


def judge_agreement(features: FeatureMap, trajectories: Sequence[Trajectory], n_rows: int | None = None) -> Agreement:
    """Find the constraint on which most trajectories agree, and those that do not obey it.

    A fit to all trajectories keeps only the rows that all of them share, and calls the others free. So the rows that
    each trajectory obeys are compared: constraints are fitted to single trajectories, to pairs and to all, refitted to
    those that obey them, and the one that explains most without its best supporter wins. Several constraints, one after
    the other, win over a single one if they explain 1.4 times as much.

    Args:
        features: Phi.
        trajectories: With velocities, each one stretch in which something may be held.
        n_rows: Number of rows; found from the data by default.

    Raises:
        RecordingError: A trajectory lacks velocities.
        NotIdentifiableError: Every row of Phi is zero throughout.
    """
    whole = PhaseMotion.collect(features, trajectories)
    motion = whole.thinned()
    largest = min(motion.rates.shape[1], features.nv) - 1
    counts = range(1, largest + 1) if n_rows is None else [n_rows]
    everything = tuple(range(motion.n_trajectories))
    single = best_cluster(motion, everything, counts)
    if single is None:
        drift = np.full(len(everything), np.nan)
        return Agreement(np.zeros((0, features.n_rows)), everything, (), drift, float("nan"))
    clusters = clusters_of(motion, everything, counts, single)
    if sum(c.evidence for c in clusters) < SPLIT_GAIN * single.evidence:
        clusters = [single]
    return _agreement(whole, trajectories, features, clusters)


def _agreement(
    motion: PhaseMotion, trajectories: Sequence[Trajectory], features: FeatureMap, clusters: Sequence[Cluster]
) -> Agreement:
    rows, scale, members = clusters[0].rows, clusters[0].scale, np.array(clusters[0].members)
    usual, drift = float("nan"), np.full(motion.n_trajectories, np.nan)
    for _ in range(REFITS):
        held = np.isin(motion.trajectory, members)
        rows = refit(motion, held, len(rows), scale)
        scale = scale_of(motion, rows, held)
        lengths, ways, noise = drifts(motion, rows)
        drift = lengths / np.maximum(ways, 1e-12)
        usual = float(np.median(drift[members]))
        agrees = _agrees(lengths, drift, members) | (lengths <= ODD_NOISE * noise)
        if not np.any(agrees):
            break
        members = np.flatnonzero(agrees)
    selection = motion.selection(rows)
    odd = tuple(
        (i, reason(features, trajectories, selection, i, members.tolist()))
        for i in range(motion.n_trajectories)
        if i not in members
    )
    names = {i for i, _ in odd}
    others = [(motion.selection(c.rows), tuple(i for i in c.members if i in names)) for c in clusters[1:]]
    return Agreement(
        selection,
        tuple(int(i) for i in members),
        odd,
        drift,
        usual,
        tuple(o for o in others if len(o[1]) > 1),
    )


def _agrees(
    lengths: Float[np.ndarray, " g"], drift: Float[np.ndarray, " g"], members: Int[np.ndarray, " k"]
) -> Bool[np.ndarray, " g"]:
    """Which trajectories drift no more than is usual among the members."""
    # in length and as a share: a short stretch drifts as far as a long one
    ratios = np.minimum(lengths / np.median(lengths[members]), drift / np.median(drift[members]))
    excess = np.log(np.maximum(ratios, 1e-12))
    # below the usual only: above it the odd ones spread as well
    spread = max(0.0, -float(np.quantile(excess[members], 0.16)))
    return (excess <= max(np.log(ODD_FACTOR), ODD_SPREAD * spread)) | (drift <= ODD_SHARE)
