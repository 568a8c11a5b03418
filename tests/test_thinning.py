"""An even choice while recordings are read: exact where all fit, in bounded memory where they do not."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from recording_formats import frames, lerobot, motion, pa
from scale_motions import TWO, motions
from task_sets import generated, true_rows

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.table import EvenChoice, read_evenly
from manip_learn.linalg import row_space_angle
from manip_learn.recordings import load as trajectory_source
from manip_learn.recordings.velocities import with_velocities

HELD = {"velocities": "recorded", "n_constraints": 2, "estimator": "null-space"}


@pytest.fixture(scope="module")
def held(features) -> ml.Demonstrations:
    return motions(features, TWO, np.random.default_rng(1), 60, noise=0.02, held=True)


def chosen(recordings, each: int, robot, most: int) -> EvenChoice:
    """The choice from recordings that are read so many at a time."""
    parts = [partial(lambda k, _notes: iter(recordings[k : k + each]), k) for k in range(0, len(recordings), each)]
    return read_evenly(partial(EvenChoice, most, partial(with_velocities, robot=robot)), parts, None, None)


# ---- more than fit ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("most", "rate", "lengths", "steps", "left"),
    [
        (1000, 100.0, [100] * 8, {1}, 8),  # all fit
        (1000, 100.0, [100] * 160, {4}, 40),  # then recordings
        (1000, 25.0, [40] * 100, {1}, 25),  # slow ones at once
        (1000, 100.0, [4000] * 6, {32}, 6),  # but never so many that few recordings are left
        (300, 30.0, [*range(1, 200)], {1, 4, 8, 16}, 28),
    ],
)
def test_what_is_left_out(most, rate, lengths, steps, left):
    """Neighbours, then recordings, evenly and in order; the same however the recordings are divided into parts."""
    q = np.repeat(np.arange(4000)[:, None] / 1e5, 2, axis=1)
    recordings = [ml.Trajectory(np.arange(n) / rate, q[:n] + i, np.ones((n, 2))) for i, n in enumerate(lengths)]
    first = chosen(recordings, len(lengths), None, most)
    demos, all_fit = first.demonstrations, left == len(lengths) and steps == {1}
    assert ({kept.step for kept in first.kept}, len(demos)) == (steps, left)
    assert 0.7 * most < demos.n_samples <= most
    assert len([note for note in demos.notes if "chosen evenly" in note]) == (not all_fit)
    for kept, t in zip(first.kept, demos, strict=True):
        np.testing.assert_array_equal(t.q, recordings[kept.number].q[:: kept.step])
    for each in (8, 1):
        other = chosen(recordings, each, None, most).demonstrations
        assert other.notes == demos.notes
        for a, b in zip(other, demos, strict=True):
            np.testing.assert_array_equal(np.column_stack([a.time, a.q]), np.column_stack([b.time, b.q]))


def test_velocities_are_derived_before_samples_are_left_out():
    """Velocities of the choice are those of the full rate, to the last bit."""
    robot = ml.load_robot("sawyer")
    given = [ml.Trajectory(t.time, t.q, None, robot.joint_names) for t in generated("drawer", "sawyer", 3, 8)[1]]
    choice = chosen(given, 3, robot, 1500)
    assert len(choice.kept) == 8
    for recording, kept in zip(given, choice.kept, strict=True):
        full = ml.derive_velocities(recording, robot)
        assert kept.step > 1
        np.testing.assert_array_equal(kept.motion.u, full.u[:: kept.step])
        np.testing.assert_array_equal(kept.motion.time, full.time[:: kept.step])


def test_phases_are_found_in_a_choice():
    """Whole recordings with approach and retreat, half of their samples: the same constraint, the same stretches; at a
    price of a change that no evidence pays no recording falls into phases.
    """
    truth, given = generated("drawer", "sawyer", 5, 8)
    features = ml.FrameJacobian(ml.load_robot("sawyer"), truth["tip"], "xyz")
    whole = ml.ConstraintLearner(features).fit(given)
    chosen = ml.ConstraintLearner(features, most_samples=sum(map(len, given)) // 2).fit(given)
    assert np.degrees(row_space_angle(true_rows(truth), chosen.constraint_.selection)) < 0.2
    held = [[p for p in learner.report_.phases if p.constraint == 0] for learner in (whole, chosen)]
    assert len(held[0]) == len(held[1]) == 8
    for a, b in zip(*held, strict=True):
        assert a.trajectory == b.trajectory and abs(a.start - b.start) < 0.15 and abs(a.end - b.end) < 0.15
    assert chosen.report_.mechanism is not None and chosen.report_.mechanism.type == "line"
    with pytest.raises(NotIdentifiableError):
        ml.ConstraintLearner(features, switch=1e6).fit(given)


# ---- files -----------------------------------------------------------------------------------------------------------
def test_streams_and_files_are_learnt_from_as_if_in_memory(features, held, tmp_path, monkeypatch):
    """What fits, from a stream that is read once or a folder that is read part by part: bit for bit the answer of one
    list.
    """
    recordings = [ml.Trajectory(t.time, t.q, None, t.joint_names, f"demo_{i:02d}.npz") for i, t in enumerate(held[:24])]
    for t in recordings:
        np.savez(tmp_path / t.name, time=t.time, q=t.q, joint_names=np.array(t.joint_names))
    monkeypatch.setattr(trajectory_source, "PART_BYTES", 50_000)
    stream, source = iter(recordings), ml.RecordingSource(tmp_path, features.robot)
    whole, *others = (ml.ConstraintLearner(features, **HELD).fit(given) for given in (recordings, stream, source))
    assert 2 < source.n_parts < 20
    for other in others:
        np.testing.assert_array_equal(other.constraint_.selection, whole.constraint_.selection)
        for name in ("uncertainty_deg", "notes", "n_samples", "n_trajectories"):
            assert getattr(other.report_, name) == getattr(whole.report_, name)


@pytest.mark.parametrize(("shared", "parts"), [(False, 4), (True, 1)])
def test_lerobot_episodes_are_parts(shared: bool, parts: int, planar3, tmp_path, monkeypatch):
    """LeRobot data is read file by file, or as a whole if an episode spans two files or episodes are selected."""
    monkeypatch.setattr(trajectory_source, "PART_BYTES", 1)
    tables = [frames({i: motion(i, 30)}) for i in range(4)]
    if shared:
        tables[:2] = tables[0][:10], pa.concat_tables([tables[0][10:], tables[1]])
    root = lerobot(*tables)(tmp_path)
    source = ml.RecordingSource(root, planar3, units="radians")
    assert source.n_parts == parts
    assert ml.RecordingSource(root, planar3, units="radians", episodes="0:2").n_parts == 1
    for a, b in zip(source, ml.load_demonstrations(root, planar3, units="radians"), strict=True):
        np.testing.assert_array_equal(a.q, b.q)
