"""Trajectories and demonstrations reject invalid data and are immutable."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest
from case import case

import manip_learn as ml
from manip_learn.errors import RecordingError
from manip_learn.recordings.trajectory import Demonstrations, Trajectory

NAMES = ("a", "b")


def trajectory(T: int = 5, name: str = "demo", **changes) -> Trajectory:
    fields = {
        "time": np.arange(T) * 0.1,
        "q": np.arange(2.0 * T).reshape(T, 2),
        "u": np.ones((T, 2)),
        "joint_names": NAMES,
        "name": name,
        **changes,
    }
    return Trajectory(**fields)


def test_frozen_through_and_through():
    """No field and no entry can be changed, and the caller's own arrays stay his."""
    q = np.zeros((5, 2))
    t = trajectory(q=q)
    q[0, 0] = 7.0
    assert t.q[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        t.q[0, 0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        t.time[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        t.q = q  # type: ignore[misc]


def test_any_numbers_become_float64_in_native_order():
    """Lists, integers, float32 and big-endian numbers are taken as what they mean."""
    q = np.arange(10).reshape(5, 2)
    for numbers in (q.tolist(), q, q.astype(np.float32), q.astype(">f8"), np.asfortranarray(q)):
        t = trajectory(q=numbers)
        assert t.q.dtype == np.float64
        assert t.q.dtype.isnative
        np.testing.assert_array_equal(t.q, q)


def test_refuses():
    """What cannot be used is refused by name: the trajectory, the sample, the joint and the value."""
    for changes, code, words in [
        ({"time": []}, "empty", "no samples"),
        ({"time": [0, 1, 2]}, "shape", "got"),
        ({"time": [[0, 1, 2, 3, 4]]}, "shape", "1 dimension"),
        ({"q": np.zeros(5)}, "shape", "2 dimension"),
        ({"q": np.zeros((5, 1))}, "shape", "q must have shape"),
        ({"u": np.zeros((5, 3))}, "shape", "u must have shape"),
        ({"u": np.zeros((4, 2))}, "shape", "u must have shape"),
        ({"q": [["x", "y"]] * 5}, "not-a-number", "must be numbers"),
        ({"q": [[1.0, 2.0], [3.0]]}, "not-a-number", "must be numbers"),
        ({"q": None}, None, "demo"),
        ({"time": [0, 1, 1, 2, 3]}, "time-order", "sample 2 is at 1"),
        ({"time": [0, 1, 0.5, 2, 3]}, "time-order", "time must increase"),
        ({"time": [0, 1, np.nan, 2, 3]}, "not-finite", "sample 2"),
        ({"q": [[0, 0], [0, np.nan], [0, 0], [0, 0], [0, 0]]}, "not-finite", "sample 1, joint 'b' is nan"),
        ({"joint_names": ("a", "a")}, "duplicate-joint", "must differ"),
    ]:
        with case(changes, code, words):
            if "time" in changes and len(changes["time"]) == 0:
                changes = {"time": [], "q": np.zeros((0, 2)), "u": np.zeros((0, 2))}
            with pytest.raises(RecordingError) as caught:
                trajectory(**changes)
            assert words in str(caught.value)
            assert str(caught.value).startswith("demo: ")
            if code is not None:
                assert caught.value.code == code


def test_parts():
    """A slice and an index array pick the same samples of time, q and u; the name follows."""
    t = trajectory(T=6)
    for samples in (slice(1, 6, 2), np.array([1, 3, 5])):
        part = t.part(samples)
        np.testing.assert_array_equal(part.time, t.time[1::2])
        np.testing.assert_array_equal(part.q, t.q[1::2])
        assert part.u is not None
        np.testing.assert_array_equal(part.u, np.ones((3, 2)))
        assert part.name == "demo"
    assert trajectory(u=None).part(slice(1, 3)).u is None
    assert not Demonstrations([trajectory(), trajectory(u=None)]).has_velocities
    assert t.part(slice(0, 2), "start").name == "start"
    assert len(t) == 6
    assert t.duration == pytest.approx(0.5)
    with pytest.raises(RecordingError, match="no samples"):
        t.part(slice(3, 3))


def test_demonstrations_are_a_sequence():
    """Length, order, iteration and slices are those of the trajectories; notes stay with slices."""
    one, two, three = trajectory(3, "one"), trajectory(4, "two"), trajectory(5, "three")
    demos = Demonstrations(iter([one, two, three]), ["trimmed"])
    assert len(demos) == 3
    assert demos[1] is two
    assert list(demos) == [one, two, three]
    assert isinstance(demos[1:], Demonstrations)
    assert demos[1:].trajectories == (two, three)
    assert demos[1:].notes == ("trimmed",)
    assert demos.joint_names == NAMES
    assert demos.n_samples == 12
    assert two in demos


def test_demonstrations_refuse():
    """None at all, another type, or other joints (in another order too) are refused with the reason."""
    for content, words in [
        ([], "at least one"),
        ([trajectory(), "text"], "got str"),
        ([trajectory(), trajectory(name="other", joint_names=("b", "a"))], "other has the joints"),
        ([trajectory(), trajectory(name="other", joint_names=("a", "c"))], "same joints in the same order"),
    ]:
        with case(content, words):
            with pytest.raises(RecordingError, match=words):
                Demonstrations(content)


def test_demonstrations_travel():
    """Pickling (workers) keeps everything, and what arrives is just as frozen."""
    copy = pickle.loads(pickle.dumps(Demonstrations([trajectory()], ["note"])))
    np.testing.assert_array_equal(copy[0].q, trajectory().q)
    assert copy.notes == ("note",)
    with pytest.raises(ValueError, match="read-only"):
        copy[0].q[0, 0] = 1.0


def test_a_trajectory_is_cut_by_time():
    """`trajectory[a:b]` keeps the samples from a to b on the recording's own clock; an empty span is refused."""
    t = Trajectory(np.arange(100) * 0.1 + 5.0, np.zeros((100, 2)), None, ("a", "b"), "demo")
    part = t[6.0:7.0]
    assert part.time[0] == pytest.approx(6.0) and part.time[-1] == pytest.approx(7.0) and part.name == "demo"
    assert len(t[:6.0]) == 11 and len(t[14.0:]) == 10
    with pytest.raises(RecordingError, match=r"no sample lies between 100 s .* runs from 5 s to 14.9 s"):
        t[100.0:]
    with pytest.raises(RecordingError, match="span of time"):
        t[3]  # type: ignore[index]


def test_joint_names_are_those_of_the_robot_where_none_are_given():
    """Positions alone make a trajectory; a learner takes its columns to be the robot's joints, in order."""
    robot = ml.load_robot("planar3")
    rng = np.random.default_rng(3)
    time = np.arange(60) * 0.05
    swing = rng.standard_normal((3, 3))
    motions = [np.sin(np.outer(time, [0.7, 1.1, 1.3]) + 0.3 * i) @ swing * 0.3 + 0.5 for i in range(6)]
    unnamed = [ml.Trajectory(time, q) for q in motions]
    named = [ml.Trajectory(time, q, None, robot.joint_names) for q in motions]
    features = ml.FrameJacobian(robot, "tip", "x y rz")
    answers = [
        ml.ConstraintLearner(features, 1, "null-space").fit(demos).constraint_.selection for demos in (unnamed, named)
    ]
    np.testing.assert_array_equal(*answers)
