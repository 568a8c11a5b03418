"""Recordings that do not agree: those that drift along rows that the others hold still, and those that slip."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from statistics import NormalDist

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.constraint.features.feature_map import FeatureMap, sum_in_words
from manip_learn.learning.deciding import (
    FAR_FROM_HELD,
    LEAST_SLIP,
    LONGEST_SLIP_SECONDS,
    ODD_SHARE,
    ODD_SPREAD,
    OVER_NOISE,
    SHOWN_BY_SHARE,
    SLIP_FACTOR,
)
from manip_learn.learning.explanation.row_motion import RowMotion
from manip_learn.learning.explanation.stretch import Stretch, covered, pieces_of
from manip_learn.recordings.trajectory import Trajectory

MEDIAN_SQUARE = NormalDist().inv_cdf(0.75) ** 2  # of a standard normal variable


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
        agrees = (excess <= max(np.log(FAR_FROM_HELD), ODD_SPREAD * spread)) | (drift <= ODD_SHARE)
        agrees |= lengths <= OVER_NOISE * noise
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
        why = reason(features, piece, members, selection)
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
    if len(shown) < max(2.0, SHOWN_BY_SHARE * len(trajectories)):
        return {}
    usual = pieces_of(trajectories, stretches)[1]
    out = {}
    for i, t in enumerate(trajectories):
        if i not in shown:
            why = reason(features, t, usual, selection)
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
            if gap.duration > LONGEST_SLIP_SECONDS or any(gap.shared(s) > 0.0 for s in others):
                continue
            between = trajectories[i][a.end : b.start]
            whole = [trajectories[s.trajectory][s.start : s.end] for s in stretches]
            if (
                _drift(motion, rows, gap)[0] > SLIP_FACTOR * held
                and _extent(way_along(features, between, selection)) > LEAST_SLIP
            ):
                why = reason(features, between, whole, selection)
                out[i] = f"its contact is interrupted from {a.end:.2f} s to {b.start:.2f} s, as by a slip: {why}"
                break
    return out


def reason(
    features: FeatureMap, t: Trajectory, members: Sequence[Trajectory], selection: Float[np.ndarray, "s p"]
) -> str:
    """One sentence: how far it moves along the direction that the others hold still, and how far they do."""
    way = way_along(features, t, selection)
    centred = way - way.mean(axis=0)
    worst = np.linalg.svd(centred, full_matrices=False)[2][0]
    row = worst @ selection
    moved = float(np.ptp(way @ worst))
    usual = float(np.median([np.ptp(way_along(features, other, selection) @ worst) for other in members]))
    turns = np.array([unit.startswith("rad") for unit in features.row_units])
    rotation = float(np.sum(row[turns] ** 2)) > 0.5
    others = f"the other {len(members)} hold" if len(members) > 1 else "the other one holds"
    how = "turns {:.2g} deg about" if rotation else "moves {:.3g} mm along"
    factor = np.degrees(1.0) if rotation else 1e3
    return (
        f"{t.name} {how.format(factor * moved)} a direction ({_words(features, row)}) that {others} still "
        f"(median {factor * usual:.2g} {'deg' if rotation else 'mm'})"
    )


def way_along(features: FeatureMap, t: Trajectory, selection: Float[np.ndarray, "s p"]) -> Float[np.ndarray, "T s"]:
    """Way along each row [m or rad], trapezoid rule."""
    rates = np.matmul(features.batch(t.q), np.asarray(t.u)[:, :, None])[:, :, 0] @ selection.T
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(t.time)[:, None]
    return np.concatenate([np.zeros((1, len(selection))), np.cumsum(steps, axis=0)])


def _words(features: FeatureMap, row: Float[np.ndarray, " p"]) -> str:
    row = row if row[np.argmax(np.abs(row))] > 0.0 else -row
    return sum_in_words(row, features.row_names, "+.2f", 0.05)
