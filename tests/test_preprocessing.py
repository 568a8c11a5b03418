"""Preparation of demonstrations: what is kept."""

from __future__ import annotations

import numpy as np
import pytest

from manip_learn.errors import RecordingError
from manip_learn.recordings.trajectory import Trajectory, subsample


def motion(rest: int = 20, moving: int = 60, dt: float = 0.01) -> Trajectory:
    """Standstill, a sine, standstill."""
    n = 2 * rest + moving
    u = np.zeros((n, 2))
    u[rest : rest + moving] = np.sin(np.pi * (np.arange(moving) + 0.5) / moving)[:, None] * [1.0, -0.5]
    return Trajectory(dt * np.arange(n), dt * np.cumsum(u, axis=0), u, ("a", "b"), "there and back")


def test_thin():
    """At most as many samples as asked for, both ends among them; fewer stay as they are."""
    t = motion()
    few = subsample(t, 10)
    assert len(few) == 10 and few.time[0] == t.time[0] and few.time[-1] == t.time[-1]
    assert subsample(t, 1000) is t
    assert len(subsample(t, 1)) == 1
    with pytest.raises(RecordingError, match="positive"):
        subsample(t, 0)
