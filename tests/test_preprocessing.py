"""Preparation of demonstrations: what is kept."""

from __future__ import annotations

import numpy as np
import pytest

from manip_learn.errors import RecordingError
from manip_learn.recordings.preprocessing import resample, subsample, trim_standstill
from manip_learn.recordings.trajectory import Trajectory


def motion(rest: int = 20, moving: int = 60, dt: float = 0.01) -> Trajectory:
    """Standstill, a sine, standstill."""
    n = 2 * rest + moving
    u = np.zeros((n, 2))
    u[rest : rest + moving] = np.sin(np.pi * (np.arange(moving) + 0.5) / moving)[:, None] * [1.0, -0.5]
    return Trajectory(dt * np.arange(n), dt * np.cumsum(u, axis=0), u, ("a", "b"), "there and back")


def test_trim_standstill():
    """Rest at both ends goes; a stop in between stays."""
    t = motion()
    kept = trim_standstill(t)
    assert 58 <= len(kept) <= 60
    assert t.time[19] < kept.time[0] and kept.time[-1] < t.time[80]
    u = np.array(t.u)
    u[45:55] = 0.0
    stopped = trim_standstill(Trajectory(t.time, t.q, u, t.joint_names))
    assert len(stopped) == len(kept)


def test_trim_refuses_what_never_moves():
    """All zeros, or no velocities: refused."""
    t = motion()
    with pytest.raises(RecordingError, match="nothing moves"):
        trim_standstill(Trajectory(t.time, t.q, 0.0 * t.u, t.joint_names))
    with pytest.raises(RecordingError, match="derive velocities"):
        trim_standstill(Trajectory(t.time, t.q, None, t.joint_names))


def test_resample():
    """An even grid from the first sample to within a step of the last; straight lines stay straight."""
    time = np.cumsum(np.linspace(0.01, 0.05, 20))
    t = Trajectory(time, np.outer(time, [1.0, 2.0]), np.tile([1.0, 2.0], (20, 1)), ("a", "b"))
    even = resample(t, 0.02)
    np.testing.assert_allclose(np.diff(even.time), 0.02, atol=1e-12)
    np.testing.assert_allclose(even.q, np.outer(even.time, [1.0, 2.0]), atol=1e-12)
    np.testing.assert_allclose(even.u, np.tile([1.0, 2.0], (len(even), 1)))
    assert even.time[0] == t.time[0] and t.time[-1] - even.time[-1] < 0.02
    assert resample(Trajectory(time, t.q, None, t.joint_names), 0.02).u is None
    for dt in (0.0, -1.0, 100.0, np.nan):
        with pytest.raises(RecordingError, match="step"):
            resample(t, dt)


def test_thin():
    """At most as many samples as asked for, both ends among them; fewer stay as they are."""
    t = motion()
    few = subsample(t, 10)
    assert len(few) == 10 and few.time[0] == t.time[0] and few.time[-1] == t.time[-1]
    assert subsample(t, 1000) is t
    assert len(subsample(t, 1)) == 1
    with pytest.raises(RecordingError, match="positive"):
        subsample(t, 0)


def test_resample_with_one_step_keeps_both_ends():
    """A step as long as the trajectory gives its first and its last sample; the least bit longer is refused."""
    trajectory = Trajectory([1.0, 1.5, 3.0], [[0.0], [5.0], [1.0]], [[1.0], [2.0], [3.0]], ("a",), "t")
    ends = resample(trajectory, 2.0)
    np.testing.assert_allclose(ends.time, [1.0, 3.0])
    np.testing.assert_allclose(ends.q, [[0.0], [1.0]])
    np.testing.assert_allclose(ends.u, [[1.0], [3.0]])
    with pytest.raises(RecordingError, match="at most 2 s"):
        resample(trajectory, 2.0 + 1e-9)
