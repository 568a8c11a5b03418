"""Tracks as the page's program reads them: few enough numbers, every minimum and maximum among them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from manip_learn.playback.extremes import extremes
from manip_learn.playback.packing import packed
from manip_learn.playback.tracks import Curve, Track

MOST_POINTS = 100_000  # of all curves of a page, 8 bytes each
MOST_OF_A_CURVE, LEAST_OF_A_CURVE = 2000, 60


def points_per_curve(tracks: Sequence[Sequence[Track]]) -> int:
    """How many points each curve of a page may have.

    Args:
        tracks: Those of each motion.
    """
    n = sum(len(track.curves) for some in tracks for track in some)
    return int(np.clip(MOST_POINTS // max(n, 1), LEAST_OF_A_CURVE, MOST_OF_A_CURVE))


def track_data(tracks: Sequence[Track], most: int) -> dict[str, Any]:
    """The tracks of one motion.

    Curves that keep all of their samples share their times, in float64; those that do not have times of their own,
    as their extremes are at different samples. Values are float32.

    Args:
        tracks: Of one motion.
        most: See `points_per_curve`.
    """
    clocks: list[np.ndarray] = []
    described = [
        {
            "kind": t.kind,
            "unit": t.unit,
            "without": list(t.without),
            "curves": [_curve(c, most, clocks) for c in t.curves],
        }
        for t in tracks
    ]
    return {"clocks": [packed(clock, "<f8") for clock in clocks], "tracks": described}


def _curve(curve: Curve, most: int, clocks: list[np.ndarray]) -> dict[str, Any]:
    kept = extremes(curve.values, most)
    described: dict[str, Any] = {"name": curve.name, "values": packed(curve.values[kept], "<f4")}
    if kept.size < curve.values.size:
        return described | {"times": packed(curve.times[kept], "<f4")}
    number = next((i for i, clock in enumerate(clocks) if clock is curve.times), len(clocks))
    if number == len(clocks):
        clocks.append(curve.times)
    return described | {"clock": number}
