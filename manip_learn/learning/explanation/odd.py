"""Recordings that do not agree: those that drift along rows that the others hold still, and those that slip."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.explanation.reason import reason, way_along
from manip_learn.learning.explanation.row_motion import RowMotion
from manip_learn.learning.explanation.stretch import Stretch, covered, pieces_of
from manip_learn.recordings.trajectory import Trajectory

# a stretch is odd if it drifts along the held rows more than this many times the usual distance, more than this many
# (robust) standard deviations of the logarithm above it, and by this share of its motion; in 50 sets of recordings that
# all agree the largest drift was 3 times the usual one
ODD_FACTOR = 2.5
ODD_SPREAD = 6.0
ODD_SHARE = 0.005
# and by more than white noise on its velocities takes a random walk: its range exceeds 4 standard deviations of its end
# in one of 10,000 trajectories
ODD_NOISE = 4.0
MEDIAN_SQUARE = 0.455  # of a standard normal variable
# longest interruption of a contact: who lets go for longer does so on purpose [s]
LONGEST = 1.5
# a slip goes this many times farther along the held rows than a whole contact, and at least this far [m or rad]
SLIP_FACTOR, LEAST_SLIP = 5.0, 2e-3
# share of the recordings that must show a constraint before one that does not is called odd
MOST = 0.6


def agreeing(motion: RowMotion, rows: Float[np.ndarray, "s r"], stretches: Sequence[Stretch]) -> Bool[np.ndarray, " m"]:
    """Which stretches stay as still along the rows as most of them do.

    Velocities are summed up before they are judged: what noise adds averages out, a wrong direction does not.
    """
    lengths, ways, noise = np.array([_drift(motion, rows, s) for s in stretches]).reshape(-1, 3).T
    drift = lengths / np.maximum(ways, 1e-12)
    agrees = np.ones(len(stretches), dtype=bool)
    for _ in range(3):
        # in length and as a share: a short stretch drifts as far as a long one
        ratios = np.minimum(lengths / np.median(lengths[agrees]), drift / np.median(drift[agrees]))
        excess = np.log(np.maximum(ratios, 1e-12))
        # below the usual only: above it the odd ones spread as well
        spread = max(0.0, -float(np.quantile(excess[agrees], 0.16)))
        agrees = (excess <= max(np.log(ODD_FACTOR), ODD_SPREAD * spread)) | (drift <= ODD_SHARE)
        agrees |= lengths <= ODD_NOISE * noise
        if not np.any(agrees):
            return np.ones(len(stretches), dtype=bool)
    return agrees


def _drift(motion: RowMotion, rows: Float[np.ndarray, "s r"], stretch: Stretch) -> tuple[float, float, float]:
    """How far a stretch gets along the rows, how far it gets at all, and how far white noise on its velocities alone
    would take it along the rows: one standard deviation at its end [rad of a typical joint].
    """
    inside = covered(motion, [stretch])
    steps = motion.rates[inside] * motion.weight[inside, None]
    way = np.cumsum(steps, axis=0)
    # of neighbours, for what is common to them is motion; of most of them, for a slip is none
    squares = np.diff(steps @ rows.T, axis=0) ** 2
    noise = (
        float(np.sqrt(0.5 * len(squares) * np.sum(np.median(squares, axis=0)) / MEDIAN_SQUARE)) if len(squares) else 0.0
    )
    return max(_extent(way @ rows.T), 1e-12), _extent(way), noise


def _extent(way: Float[np.ndarray, "n k"]) -> float:
    return float(np.linalg.norm(np.ptp(way, axis=0))) if len(way) else 0.0


def drifting(
    features: FeatureMap,
    trajectories: Sequence[Trajectory],
    selection: Float[np.ndarray, "s p"],
    stretches: Sequence[Stretch],
    agrees: Bool[np.ndarray, " m"],
) -> dict[int, str]:
    """Number of each trajectory with a stretch that does not agree, and why."""
    members = pieces_of(trajectories, [s for s, good in zip(stretches, agrees, strict=True) if good])[1]
    out = {}
    odd = pieces_of(trajectories, [s for s, good in zip(stretches, agrees, strict=True) if not good])
    for s, piece in zip(*odd, strict=True):
        why = reason(features, [*members, piece], selection, len(members), range(len(members)))
        out[s.trajectory] = f"{why}, fastest at {_fastest(features, piece, selection):.2f} s"
    return out


def _fastest(features: FeatureMap, trajectory: Trajectory, selection: Float[np.ndarray, "s p"]) -> float:
    """When it goes farthest along the rows within a tenth of a second [s]."""
    time, way = trajectory.time, way_along(features, trajectory, selection)
    later = np.minimum(np.searchsorted(time, time + 0.1), len(time) - 1)
    return float(time[np.argmax(np.linalg.norm(way[later] - way, axis=1))])


def missing(
    features: FeatureMap,
    trajectories: Sequence[Trajectory],
    selection: Float[np.ndarray, "s p"],
    stretches: Sequence[Stretch],
    number: int,
) -> dict[int, str]:
    """The trajectories in which a constraint is not seen although nearly all others show it, and why."""
    shown = {s.trajectory for s in stretches}
    if len(shown) < max(2.0, MOST * len(trajectories)):
        return {}
    usual = pieces_of(trajectories, stretches)[1]
    out = {}
    for i, t in enumerate(trajectories):
        if i not in shown:
            why = reason(features, [*usual, t], selection, len(usual), range(len(usual)))
            out[i] = f"constraint {number} is not seen in it, but in {len(shown)} of the others; {why}"
    return out


def slipping(
    motion: RowMotion,
    rows: Float[np.ndarray, "s r"],
    features: FeatureMap,
    trajectories: Sequence[Trajectory],
    selection: Float[np.ndarray, "s p"],
    stretches: Sequence[Stretch],
    others: Sequence[Stretch] = (),
) -> dict[int, str]:
    """Trajectories in which motion along the held rows interrupts a contact that most others show in one piece.

    Args:
        motion: Of the trajectories in the features.
        rows: The held rows, whitened.
        features: Phi.
        trajectories: Whole recordings with velocities.
        selection: Lambda.
        stretches: Where the constraint holds.
        others: Stretches of other constraints: what lies between two contacts is no slip if another holds there.

    Returns:
        Number of the trajectory -> what happens when, in words.
    """
    spans = {i: [s for s in stretches if s.trajectory == i] for i in sorted({s.trajectory for s in stretches})}
    usual = np.median([len(s) for s in spans.values()]) if spans else 0
    held = float(np.median([_drift(motion, rows, s)[0] for s in stretches])) if stretches else 0.0
    out = {}
    for i, parts in spans.items():
        for a, b in pairwise(parts if len(parts) > usual else ()):
            gap = Stretch(i, a.end, b.start)
            if gap.duration > LONGEST or any(gap.shared(s) > 0.0 for s in others):
                continue
            between = trajectories[i][a.end : b.start]
            whole = [trajectories[s.trajectory][s.start : s.end] for s in stretches]
            if _drift(motion, rows, gap)[0] > SLIP_FACTOR * held and _moved(features, between, selection) > LEAST_SLIP:
                why = reason(features, [*whole, between], selection, len(whole), range(len(whole)))
                out[i] = f"its contact is interrupted from {a.end:.2f} s to {b.start:.2f} s, as by a slip: {why}"
                break
    return out


def _moved(features: FeatureMap, trajectory: Trajectory, selection: Float[np.ndarray, "s p"]) -> float:
    return _extent(way_along(features, trajectory, selection))
