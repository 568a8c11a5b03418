"""Motions in memory: arrays are learnt from like files, and refused for what a file would be refused for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from case import case

import manip_learn as ml
from manip_learn.errors import RecordingError
from manip_learn.recordings.given import recordings_given
from manip_learn.recordings.velocities import derive_velocities

DRAWER = Path(__file__).resolve().parents[1] / "examples" / "data" / "sawyer_drawer"


@pytest.fixture(scope="module")
def features() -> ml.FrameJacobian:
    return ml.FrameJacobian(ml.load_robot("sawyer"), "right_gripper_tip", "xyz")


@pytest.fixture(scope="module")
def demos(features: ml.FrameJacobian) -> ml.Demonstrations:
    return ml.load_demonstrations([DRAWER / f"demo_0{k}.csv" for k in range(1, 7)], features.robot)


def test_arrays_are_read_like_files(demos: ml.Demonstrations, features: ml.FrameJacobian):
    """Pairs of arrays, nested lists, an iterator and unnamed trajectories are the same recordings, bit for bit."""
    given: list[Any] = [
        [(t.time, t.q) for t in demos],
        tuple([t.time, t.q] for t in demos),
        [(t.time.tolist(), t.q.tolist()) for t in demos],
        [ml.Trajectory(t.time, t.q) for t in demos],
    ]
    for motions in given:
        read = recordings_given(motions, features.robot, 7)
        assert isinstance(read, ml.Demonstrations)
        for one, other in zip(read, demos, strict=True):
            np.testing.assert_array_equal(one.time, other.time)
            np.testing.assert_array_equal(one.q, other.q)
    selection = ml.ConstraintLearner(features).fit(demos).constraint_.selection
    arriving = ml.ConstraintLearner(features).fit((t.time, t.q) for t in demos)
    np.testing.assert_array_equal(arriving.constraint_.selection, selection)


def test_one_motion_needs_no_list(demos: ml.Demonstrations, features: ml.FrameJacobian):
    """A trajectory, a pair or a triple of arrays is one motion, with the velocities that were given."""
    sawyer = features.robot
    t = derive_velocities(demos[0], sawyer)
    u = t.u
    for given in (t, (t.time, t.q), [t.time, t.q], (t.time, t.q, u), (list(t.time), t.q)):
        held = recordings_given(given, sawyer, 7, "recorded")
        assert isinstance(held, ml.Demonstrations)
        assert len(held) == 1
        np.testing.assert_array_equal(held[0].q, t.q)
        assert held[0].joint_names == sawyer.joint_names
        assert (held[0].u is not None) == (given is t or (isinstance(given, tuple) and len(given) == 3))


def test_refusals(demos: ml.Demonstrations, features: ml.FrameJacobian):
    """What is wrong with the arrays, and which motion it is."""
    for spoil, code, words in [
        (lambda t: t.q, "type", "times are not known"),
        (lambda t: [t.q], "type", "motion 1 must be a Trajectory"),
        (lambda t: (t.time, t.q[:, :6]), "shape", "q has 6 columns, robot 'sawyer' has 7 joints"),
        (lambda t: (t.time, np.degrees(t.q)), "degrees", "look like degrees"),
        (lambda t: (t.time[:-1], t.q), "shape", "q must have shape"),
        (lambda t: (t.time[::-1], t.q), "time-order", "time goes back in 338 of 338 steps"),
        (lambda t: [(t.time, t.q), (t.time, np.full_like(t.q, np.nan))], "not-finite", "motion 2"),
        (lambda t: "demo.csv", "type", "load_demonstrations"),
        (lambda t: [5], "type", "got int"),
        (lambda t: 5, "type", "got int"),
    ]:
        with case(spoil, code, words):
            with pytest.raises(RecordingError, match=words) as caught:
                ml.ConstraintLearner(features).fit(spoil(demos[0]))
            assert caught.value.code == code


def test_system_without_robot():
    """Arrays of a system that is no robot are taken as they are, with velocities of their own."""
    features = ml.CustomFeatures(lambda q: np.eye(2), row_names=("a", "b"), nv=2)
    time, rng = np.linspace(0, 1, 200), np.random.default_rng(0)
    motions = []
    for phase in rng.uniform(0, 6, size=5):
        along = np.array([1.0, 2.0])
        motions.append((time, np.outer(np.sin(3 * time + phase), along), np.outer(3 * np.cos(3 * time + phase), along)))
    learnt = ml.ConstraintLearner(features, 1).fit(motions).constraint_.selection
    np.testing.assert_allclose(learnt @ [1.0, 2.0], 0.0, atol=1e-9)
