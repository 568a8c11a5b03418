"""Whole recordings are divided where a contact begins and ends, those that disagree are told apart, and free motion
explains itself.
"""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from task_sets import learnt, true_rows
from task_sets import moving as recordings

import manip_learn as ml
from manip_learn.constraint.features import FrameJacobian
from manip_learn.learning.table import Stretch, Table, View
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.velocities import derive_velocities


def found(features: FrameJacobian, trajectories: list[Trajectory]) -> ml.ConstraintLearner:
    return ml.ConstraintLearner(features).fit(trajectories)


def shown(learner: ml.ConstraintLearner, constraint: int) -> list[str]:
    """Recordings that show a constraint."""
    return sorted({p.trajectory for p in learner.report_.phases if p.constraint == constraint})


def test_a_cut_recording_is_one_stretch():
    """Recordings that hold nothing but the contact: one constraint, every recording as a whole, none of them odd."""
    features, made, _ = recordings("door", "xarm7", 2021, 8, whole=False)
    learner = found(features, made)
    assert len(learner.constraints_) == 1 and not learner.report_.odd_trajectories
    spans = [(p.trajectory, p.start, p.end, p.constraint) for p in learner.report_.phases]
    assert spans == [(t.name, t.time[0], t.time[-1], 0) for t in made]


@pytest.mark.parametrize(("kind", "seed"), [("drawer_other_direction", 2021), ("drawer_slip", 2022)])
def test_odd_ones_are_named_with_numbers_and_units(kind: str, seed: int):
    """Another drawer, or a grip that slips: exactly these recordings, with the reason, and both rows are kept."""
    features, made, truth = recordings(kind, "panda", seed, 8, whole=False)
    learner = found(features, made)
    others = {p.trajectory for p in learner.report_.phases if p.constraint not in (0, None)}
    told = {odd.trajectory for odd in learner.report_.odd_trajectories} | others
    assert told == {made[i].name for i in truth["contaminated"]}
    for name, reason in learner.report_.odd_trajectories:
        assert name in reason
        assert " mm along " in reason
    assert np.degrees(row_space_angle(learner.constraint_.selection, true_rows(truth, 0))) < 0.2


@pytest.mark.parametrize(("kind", "degrees"), [("table", 2.0), ("drawer", 20.0)])
def test_two_that_nearly_coincide_are_told_apart(kind: str, degrees: float):
    """Four recordings of one table or drawer and four of another, some degrees apart: each has its own rows."""
    features, first, truth = recordings(kind, "panda", 2023, 8, whole=False)
    _, second, other = recordings(kind, "panda", 2023, 8, whole=False, tilt=degrees)
    given = [*first[:4], *second[4:]]
    learner, halves = found(features, given), [[t.name for t in given[:4]], [t.name for t in given[4:]]]
    members = [shown(learner, k) for k in range(len(learner.constraints_))]
    assert sorted(members) == halves
    for constraint, names in zip(learner.constraints_, members, strict=True):
        true = true_rows(truth if names == halves[0] else other, 0)
        assert np.degrees(row_space_angle(constraint.selection, true)) < 0.1


def test_one_is_not_divided():
    """Sixteen recordings of one table with bad encoders are one constraint."""
    features, trajectories, _ = recordings("table", "ur5", 2024, 16, whole=False)
    rng = np.random.default_rng(1)
    noisy = [
        derive_velocities(
            Trajectory(t.time, t.q + rng.normal(0.0, 3e-3, t.q.shape), None, t.joint_names), features.robot
        )
        for t in trajectories
    ]
    assert len(found(features, noisy).constraints_) == 1


@pytest.mark.slow
def test_memory_grows_with_the_samples_alone():
    """Three times as many whole recordings need at most three times as much: 4.7 times where each contact that one
    recording alone may show is weighed on the samples of all.
    """
    features, trajectories, _ = recordings("drawer", "panda", 2021, 24)
    peaks = []
    for n in (8, 24):
        tracemalloc.start()
        found(features, trajectories[:n])
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 3.0 * peaks[0], peaks


def test_a_tether_is_learnt_from_whole_recordings():
    """Type, centre and radius within 0.5 mm, one row; the sphere is so large that parts of it pass for a soft plane."""
    _, made, truth = recordings("tether", "xarm7", 3005, 8)
    learner = learnt("xarm7", truth["tip"], made)
    report, true = learner.report_, truth["mechanisms"][0]
    assert report.mechanism is not None
    assert report.mechanism.type == "ball"
    assert report.mechanism.point == pytest.approx(np.array(true["point"]), abs=5e-4)
    assert report.mechanism.radius == pytest.approx(true["radius"], abs=5e-4)
    assert learner.constraint_.n_constraints == 1


def test_an_orientation_that_is_held_softly_is_learnt_with_its_axis():
    """A glass that sways by a degree: its two rows, about the vertical within three stated standard deviations."""
    features, made, truth = recordings("glass", "sawyer", 33003, 6, whole=False)
    arm = features.robot
    learner = learnt("sawyer", truth["tip"], made, axes="rotation")
    mechanism = learner.report_.mechanism
    assert mechanism is not None
    assert mechanism.type == "held-orientation"
    assert mechanism.axis is not None
    tilt = np.degrees(np.arccos(min(1.0, abs(mechanism.axis[2]))))
    assert tilt < min(3.0 * mechanism.uncertainty["axis"], 6.0)
    A = learner.constraint_(made[0].q[100])
    assert A.shape == (2, arm.nv)
    turning = np.linalg.pinv(FrameJacobian(arm, truth["tip"], "rotation")(made[0].q[100])) @ mechanism.axis
    np.testing.assert_allclose(A @ turning, 0.0, atol=1e-9)


def test_ends_that_have_left_the_rows_are_cut_off():
    """A hand that leaves a surface at a flat angle: the contact ends where the way does, not at a recording's end."""
    time = np.arange(0.0, 4.005, 0.01)

    def moved(height: np.ndarray) -> Trajectory:
        u = np.column_stack([np.ones(len(time)), np.gradient(1e-4 * np.sin(9.0 * time) + 0.05 * height, time)])
        return Trajectory(time, np.cumsum(0.01 * u, axis=0), u)

    heights = [np.maximum(time - at, 0.0) for at in (2.85, 3.85)]
    heights += [np.maximum(1.15 - time, 0.0), np.maximum(time - 1.85, 0.0)]
    view = View(ml.CustomFeatures(lambda q: np.eye(2), ("x", "y"), 2), Table([moved(h) for h in heights]))
    row = np.linalg.qr(np.linalg.solve(view.W.T, [[0.0], [1.0]]))[0].T
    given = [Stretch(0, 1.0, 3.0), Stretch(1, 1.0, 4.0), Stretch(2, 1.0, 3.0), Stretch(3, 1.0, 2.0)]
    cut = [view.sharpened(row, stretch) for stretch in given]
    assert cut[0].start == 1.0 and 2.83 < cut[0].end < 2.89
    assert cut[1] == given[1] and cut[3] == given[3]  # a recording's end; too short to tell
    assert 1.11 < cut[2].start < 1.17 and cut[2].end == 3.0
