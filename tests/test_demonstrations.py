"""Trajectories and demonstrations reject invalid data and are immutable; arrays and frames are read like files."""

from __future__ import annotations

import dataclasses
import json
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest
from case import case, rows_in
from task_sets import sawyer_drawer

import manip_learn as ml
from manip_learn.errors import RecordingError
from manip_learn.recordings.given import recordings_given
from manip_learn.recordings.trajectory import Demonstrations, Trajectory, distinct_names, subsample

NAMES = ("a", "b")


def trajectory(T: int = 5, name: str = "demo", **changes: Any) -> Trajectory:
    q = np.arange(2.0 * T).reshape(T, 2)
    fields = {"time": np.arange(T) * 0.1, "q": q, "u": np.ones((T, 2)), "effort": 7.0 * q, "joint_names": NAMES}
    return Trajectory(name=name, **{**fields, **changes})


def test_frozen_through_and_through():
    """No field and no entry can be changed, and the caller's own arrays stay his; a pickle is just as frozen."""
    q = np.zeros((5, 2))
    t = trajectory(q=q)
    q[0, 0] = 7.0
    assert t.q[0, 0] == 0.0
    copy = pickle.loads(pickle.dumps(Demonstrations([t], ["note"])))
    assert copy.notes == ("note",) and copy[0].name == "demo"
    for name in ("time", "q", "u", "effort"):
        np.testing.assert_array_equal(getattr(t, name), getattr(copy[0], name))
        for frozen in (t, copy[0]):
            with pytest.raises(ValueError, match="read-only"):
                getattr(frozen, name)[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        t.q = q  # type: ignore[misc]


@pytest.mark.parametrize(("code", "words", "entries"), rows_in("wrong_trajectories.txt"))
def test_what_cannot_be_used_is_refused_by_name(code: str, words: str, entries: str):
    """The trajectory, the sample, the joint and the value."""
    with pytest.raises(RecordingError) as caught:
        trajectory(**json.loads(entries))
    assert words in str(caught.value) and str(caught.value).startswith("demo: ") and caught.value.code == code


def test_parts():
    """Slices, index arrays and spans of time pick the same samples of time, q, u and efforts; the name follows."""
    t, bare = trajectory(T=6), trajectory(u=None, effort=None)
    for samples in (slice(1, 6, 2), np.array([1, 3, 5])):
        for name in ("time", "q", "u", "effort"):
            np.testing.assert_array_equal(getattr(t.part(samples), name), getattr(t, name)[1::2])
    assert bare.part(slice(1, 3)).u is None
    np.testing.assert_array_equal(t.with_joint_names(("c", "d")).effort, t.effort)
    assert not Demonstrations([trajectory(), bare]).has_velocities
    assert t.part(slice(0, 2), "start").name == "start" and t.duration == pytest.approx(0.5)
    with pytest.raises(RecordingError, match="demo: .*no samples") as caught:
        t.part(slice(3, 3))
    assert caught.value.code == "empty"
    long = trajectory(T=100, time=np.arange(100) * 0.1 + 5.0)
    np.testing.assert_array_equal(long[6.0:7.0].effort, long.effort[10:21])
    assert len(long[:6.0]) == 11 and len(long[14.0:]) == 10
    with pytest.raises(RecordingError, match=r"no sample lies between 100 s .* runs from 5 s to 14.9 s"):
        long[100.0:]
    with pytest.raises(RecordingError, match="span of time"):
        long[3]  # type: ignore[index]


def test_an_even_choice_keeps_both_ends(planar3: ml.Robot):
    """And all samples where they are few; derived velocities leave the efforts as they are."""
    time = 0.01 * np.arange(80)
    q = np.column_stack([np.sin(time), np.cos(time), 0.3 * time])
    t = Trajectory(time, q, np.gradient(q, time, axis=0), planar3.joint_names, "demo", effort=7.0 * q)
    few = subsample(t, 9)
    assert (len(few), few.time[0], few.time[-1]) == (9, time[0], time[-1])
    assert subsample(t, 1000) is t and len(subsample(t, 1)) == 1
    with pytest.raises(RecordingError, match="positive"):
        subsample(t, 0)
    np.testing.assert_array_equal(few.effort, 7.0 * q[np.searchsorted(time, few.time - 1e-6)])
    np.testing.assert_array_equal(ml.derive_velocities(t, planar3).effort, t.effort)


def test_demonstrations_are_a_sequence():
    """Length, order, iteration and slices are those of the trajectories; notes stay with slices."""
    one, two = trajectory(3, "one"), trajectory(4, "two")
    demos = Demonstrations(iter([one, two]), ["trimmed"])
    assert list(demos) == [one, two] and demos.joint_names == NAMES and demos.n_samples == 7
    assert all(words in repr(demos) for words in ("7 samples", "'one': 3 samples over 0.2 s, 2 joints"))
    assert isinstance(demos[1:], Demonstrations) and demos[1:].trajectories == (two,)
    assert demos[1:].notes == ("trimmed",)
    other = trajectory(name="other", joint_names=("b", "a"))
    for content, words in [([], "at least one"), ([one, "text"], "got str"), ([one, other], "other has the joints")]:
        with case(words), pytest.raises(RecordingError, match=words):
            Demonstrations(content)


# ---- motions in memory
@pytest.fixture(scope="module")
def demos() -> Demonstrations:
    return sawyer_drawer()[1]


def test_arrays_are_read_like_files(demos: Demonstrations, features: ml.FrameJacobian):
    """Pairs of arrays, nested lists and unnamed trajectories are the same recordings, bit for bit; the columns of
    unnamed ones are the robot's joints, in order.
    """
    pairs, lists = [(t.time, t.q) for t in demos], tuple([t.time.tolist(), t.q.tolist()] for t in demos)
    for motions in (pairs, lists, [Trajectory(t.time, t.q) for t in demos]):
        read = recordings_given(motions, features.robot, 7)
        assert isinstance(read, Demonstrations)
        for one, other in zip(read, demos, strict=True):
            assert one.joint_names == features.robot.joint_names
            np.testing.assert_array_equal(one.time, other.time)
            np.testing.assert_array_equal(one.q, other.q)


@pytest.mark.parametrize(
    ("spoil", "code", "words"),
    [
        (lambda t: t.q, "type", "has no times"),
        (lambda t: (["early"] * len(t), t.q), "not-a-number", "could not convert"),
        (lambda t: [(t.time[None], t.q)], "shape", "time"),
        (lambda t: [pd.DataFrame()], "empty", "it is empty"),
        (lambda t: [Demonstrations([t]).to_frame().assign(time="early")], "not-a-number", "numbers are needed"),
        (lambda t: (t.time, t.q[:, :6]), "shape", "q has 6 columns, robot 'sawyer' has 7 joints"),
        (lambda t: (t.time, np.degrees(t.q)), "degrees", "look like degrees"),
        (lambda t: (t.time[::-1], t.q), "time-order", "time goes back in 338 of 338 steps"),
        (lambda t: [(t.time, t.q), (t.time, np.full_like(t.q, np.nan))], "not-finite", "motion 2"),
        (lambda t: "demo.csv", "type", "load_demonstrations"),
        (lambda t: 5, "type", "got int"),
        (lambda t: iter([t, 5]), "type", "motion 2 must be a Trajectory"),
        (lambda t: iter([t, t.with_joint_names(tuple("abcdefg"))]), "joint-names", "sorts by name"),
        (lambda t: iter([]), "empty", "no demonstrations"),
    ],
)
def test_what_is_no_motion_is_refused(spoil: Callable, code: str, words: str, demos, features: ml.FrameJacobian):
    """What is wrong with the arrays, and which motion it is."""
    with pytest.raises(RecordingError, match=words) as caught:
        ml.ConstraintLearner(features).fit(spoil(demos[0]))
    assert caught.value.code == code


# ---- data frames


def test_frames_come_back(demos: Demonstrations, features: ml.FrameJacobian):
    """Names, order, positions, velocities and efforts, of all, of some or of no trajectories; one frame of all, or one
    a motion.
    """
    robot = features.robot
    moving = [dataclasses.replace(t, u=np.gradient(t.q, t.time, axis=0), effort=7.0 * t.q) for t in demos]
    original = Demonstrations([*moving[:2], *list(demos)[2:]])
    back = ml.load_demonstrations(original.to_frame(), robot, velocities="recorded")
    single = recordings_given([Demonstrations([t]).to_frame().drop(columns="trajectory") for t in demos], robot, 7)
    for t, s, alone in zip(original, back, single, strict=True):
        assert t.name == s.name
        for name in ("q", "u", "effort"):
            np.testing.assert_array_equal(getattr(t, name), getattr(s, name))
        np.testing.assert_allclose(t.time, s.time, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(t.q, alone.q)
        np.testing.assert_allclose(t.time, alone.time, rtol=0, atol=1e-12)


@pytest.mark.parametrize("start", [None, pd.Timedelta(0), pd.Timestamp("2026-01-01")])
def test_frames_of_others(start: Any, demos: Demonstrations, features: ml.FrameJacobian):
    """The index of a frame may hold the times in seconds, as durations or as dates."""
    t = demos[0]
    frame = Demonstrations([t]).to_frame().drop(columns="trajectory").set_index("time")
    if start is not None:
        frame.index = start + pd.to_timedelta(frame.index.to_numpy(), unit="s")
    back = ml.load_demonstrations(frame, features.robot)
    np.testing.assert_array_equal(back[0].q, t.q)
    np.testing.assert_allclose(back[0].time - back[0].time[0], t.time - t.time[0], rtol=0, atol=2e-9)


def test_names_that_are_told_apart_stay_apart():
    """A number that tells two of a name apart makes no other's name."""
    given = [ml.Trajectory(np.arange(3.0), np.zeros((3, 1)), None, ("a",), name) for name in ("a 2", "a", "a", "b")]
    names = distinct_names(given)
    assert len(set(names)) == 4 and names[3] == "b"
