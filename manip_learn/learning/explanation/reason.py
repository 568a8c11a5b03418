"""Why a trajectory does not agree, in numbers and units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.recordings.trajectory import Trajectory


def reason(
    features: FeatureMap,
    trajectories: Sequence[Trajectory],
    selection: Float[np.ndarray, "s p"],
    odd: int,
    members: Sequence[int],
) -> str:
    """One sentence: how far it moves along the direction that the others hold still, and how far they do."""
    t = trajectories[odd]
    way = way_along(features, t, selection)
    centred = way - way.mean(axis=0)
    worst = np.linalg.svd(centred, full_matrices=False)[2][0]
    row = worst @ selection
    moved = float(np.ptp(way @ worst))
    usual = float(np.median([np.ptp(way_along(features, trajectories[i], selection) @ worst) for i in members]))
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
    used = [(name, x) for name, x in zip(features.row_names, row, strict=True) if abs(x) > 0.05]
    return " ".join(f"{x:+.2f} {name}" for name, x in used)
