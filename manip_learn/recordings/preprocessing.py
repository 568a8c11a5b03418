"""Preprocessing of demonstrations: trimming, resampling, subsampling. Each function returns new ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Int

from manip_learn.errors import RecordingError
from manip_learn.recordings.trajectory import Trajectory


def trim_standstill(trajectory: Trajectory, share: float = 0.02) -> Trajectory:
    """The part between the first and the last sample that moves faster than a share of the median speed.

    Raises:
        RecordingError: No velocities, or nothing moves.
    """
    if trajectory.u is None:
        raise RecordingError(f"{trajectory.name}: derive velocities before trimming", code="no-velocities")
    speed = np.linalg.norm(trajectory.u, axis=1)
    moving = np.flatnonzero(speed > share * np.median(speed[speed > 0.0])) if np.any(speed > 0.0) else np.array([])
    if moving.size == 0:
        raise RecordingError(f"{trajectory.name}: nothing moves", code="standstill")
    return trajectory.part(slice(int(moving[0]), int(moving[-1]) + 1))


def resample(trajectory: Trajectory, dt: float) -> Trajectory:
    """Linear interpolation of positions and of the arrays beside them on an even grid of dt [s].

    Raises:
        RecordingError: dt is not positive or longer than the trajectory.
    """
    if not 0.0 < dt <= trajectory.duration:
        raise RecordingError(
            f"{trajectory.name}: the step must be positive and at most {trajectory.duration:g} s, got {dt!r}", code="dt"
        )
    time = trajectory.time[0] + np.arange(int(trajectory.duration / dt + 1e-9) + 1) * dt
    time = np.minimum(time, trajectory.time[-1])

    def at(columns: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(time, trajectory.time, c) for c in columns.T])

    beside = {what: at(array) for what, array in trajectory.beside.items()}
    return replace(trajectory, time=time, q=at(trajectory.q), **beside)


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
