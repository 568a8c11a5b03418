"""Fewer samples of a demonstration."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from manip_learn.errors import RecordingError
from manip_learn.recordings.trajectory import Trajectory


def subsample(trajectory: Trajectory, n_samples: int) -> Trajectory:
    """At most n_samples samples, evenly spread.

    Raises:
        RecordingError: n_samples is not positive.
    """
    if n_samples < 1:
        raise RecordingError(f"the number of samples must be positive, got {n_samples}", code="samples")
    if len(trajectory) <= n_samples:
        return trajectory
    return trajectory.part(evenly(len(trajectory), n_samples))


def evenly(n: int, most: int) -> Int[np.ndarray, " k"]:
    """At most so many of n places in order, evenly spread, the first and the last among them; none of none."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))
