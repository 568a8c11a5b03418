"""Data frames: what was written comes back bit for bit, and frames of others are read like CSV files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from case import case

import manip_learn as ml
from manip_learn.errors import RecordingError
from manip_learn.recordings.given import recordings_given

DRAWER = Path(__file__).resolve().parents[1] / "examples" / "data" / "sawyer_drawer"


@pytest.fixture(scope="module")
def sawyer() -> ml.Robot:
    return ml.load_robot("sawyer")


@pytest.fixture(scope="module")
def demos(sawyer: ml.Robot) -> ml.Demonstrations:
    return ml.load_demonstrations([DRAWER / f"demo_0{k}.csv" for k in range(1, 4)], sawyer)


def same(a: ml.Demonstrations, b: ml.Demonstrations) -> None:
    assert len(a) == len(b)
    for t, s in zip(a, b, strict=True):
        np.testing.assert_array_equal(t.q, s.q)
        np.testing.assert_allclose(t.time, s.time, rtol=0, atol=1e-12)
        assert (t.u is None) == (s.u is None)
        if t.u is not None and s.u is not None:
            np.testing.assert_array_equal(t.u, s.u)


def test_frames_come_back(demos: ml.Demonstrations, sawyer: ml.Robot):
    """Names, order, positions and velocities, with and without velocities, and of some trajectories only; one frame of
    all, or one a motion.
    """
    moving = [ml.Trajectory(t.time, t.q, np.gradient(t.q, t.time, axis=0), t.joint_names, t.name) for t in demos]
    for trajectories in (list(demos), moving, [*moving[:2], *list(demos)[2:]]):
        original = ml.Demonstrations(trajectories)
        frame = original.to_frame()
        assert len(frame) == original.n_samples
        back = ml.load_demonstrations(frame, sawyer, velocities="recorded")
        same(original, back)
        assert [t.name for t in back] == [t.name for t in original]
    single = [ml.Demonstrations([t]).to_frame().drop(columns="trajectory") for t in demos]
    for given in (demos.to_frame(), single):  # as a learner takes them
        same(demos, recordings_given(given, sawyer, sawyer.nv))


def test_frames_of_others(demos: ml.Demonstrations, sawyer: ml.Robot):
    """Times as a column or an index, columns in any order, and columns that are not needed."""
    for kind in ["column", "named index", "durations", "dates", "shuffled", "foreign columns"]:
        with case(kind):
            t = demos[0]
            frame = ml.Demonstrations([t]).to_frame().drop(columns="trajectory")
            joints = frame.drop(columns="time")
            made = {
                "column": frame,
                "named index": frame.set_index("time"),
                "durations": joints.set_index(pd.to_timedelta(t.time, unit="s")),
                "dates": joints.set_index(pd.Timestamp("2026-01-01") + pd.to_timedelta(t.time, unit="s")),
                "shuffled": frame[list(reversed(frame.columns))],
                "foreign columns": frame.assign(seq=range(len(frame)), frame_id="base"),
            }[kind]
            back = ml.load_demonstrations(made, sawyer)
            np.testing.assert_array_equal(back[0].q, t.q)
            np.testing.assert_allclose(back[0].time - back[0].time[0], t.time - t.time[0], rtol=0, atol=2e-9)


def test_refusals(demos: ml.Demonstrations, sawyer: ml.Robot):
    """As for files: named by trajectory, with the value; and a frame that is empty."""
    frame = demos.to_frame()
    frame.loc[700, "right_j3"] = np.nan
    with pytest.raises(RecordingError, match=r"demo_03\.csv.*right_j3"):
        ml.load_demonstrations(frame, sawyer)
    with pytest.raises(RecordingError, match="look like degrees"):
        degrees = demos.to_frame()
        degrees[list(sawyer.joint_names)] = np.degrees(degrees[list(sawyer.joint_names)])
        ml.load_demonstrations(degrees, sawyer)
    with pytest.raises(RecordingError, match="nothing in it"):
        ml.load_demonstrations(frame.iloc[:0], sawyer)
