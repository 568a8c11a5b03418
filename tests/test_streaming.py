"""Learning from more samples than fit into memory: the same answer as from all at once, in bounded memory."""

from __future__ import annotations

import gc
import json
import tracemalloc
from functools import partial

import numpy as np
import pytest
from scale_motions import Stream, motions

from manip_learn.constraint.features import FrameJacobian
from manip_learn.errors import NotIdentifiableError, RecordingError
from manip_learn.learning import ConstraintLearner, learner
from manip_learn.learning.estimators.null_space import fit_null_space
from manip_learn.learning.estimators.policy_model import PolynomialModel
from manip_learn.learning.estimators.variable_projection import _ByRows, fit_joint
from manip_learn.learning.samples import Samples, TrajectoryBlocks
from manip_learn.learning.streaming.refinement import Iterate, PassSummary, Policy, SummaryAccumulator
from manip_learn.learning.streaming.sample_stream import (
    Accumulator,
    TrajectoryBuffer,
    accumulate,
    chunks,
    merge_parts,
    merge_tree,
)
from manip_learn.linalg import orthonormal_rows, row_space_angle, row_space_angles
from manip_learn.recordings import RecordingSource, load_demonstrations, trajectory_source
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.trajectory_source import IteratedTrajectories, ListedTrajectories, source_of
from manip_learn.robot.loading import load_robot

ONE = orthonormal_rows(np.array([[0.5, 1.0, -0.4]]))
TWO = orthonormal_rows(np.array([[1.0, 0.2, 0.3], [-0.3, 0.9, 0.2]]))
HELD = {"n_constraints": 2, "estimator": "null-space"}
JOINT = {"n_constraints": 1, "estimator": "joint", "policy_model": "affine"}


@pytest.fixture(scope="module")
def features() -> FrameJacobian:
    return FrameJacobian(load_robot("sawyer"), "right_gripper_tip", "xyz")


@pytest.fixture(scope="module")
def held(features) -> Demonstrations:
    return motions(features, TWO, np.random.default_rng(1), 60, noise=0.02, held=True)


@pytest.fixture(scope="module")
def moved(features) -> Demonstrations:
    return motions(features, ONE, np.random.default_rng(2), 60, noise=0.02)


def from_few(monkeypatch, few: int) -> None:
    """The number of samples that the learner starts from."""
    monkeypatch.setattr(learner, "IN_MEMORY_SAMPLES", few)


# ---- one pass --------------------------------------------------------------------------------------------------------


def test_null_space_pass(features, held):
    """Cost, gradients and Hessians of each trajectory are those of the estimator in memory."""
    samples = Samples.collect(features, held)
    Lambda = orthonormal_rows(np.random.default_rng(0).standard_normal((2, 3)))
    here = Iterate(features, samples.whitening, TrajectoryBlocks(len(held), 512), Lambda, None)
    (cost, energy, parts), _ = accumulate(here, chunks(held), [])
    direct = fit_null_space(samples, Lambda, max_iterations=0)
    assert cost / len(samples) == pytest.approx(direct.cost, rel=1e-12)
    assert energy / len(samples) == pytest.approx(direct.energy, rel=1e-12)
    gradients, hessians = (np.array([parts[i][j] for i in range(len(held))]) for j in (0, 1))
    np.testing.assert_allclose(gradients, direct.scores.reshape(len(held), -1), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(hessians, direct.curvatures, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("s", [1, 2])
def test_joint_pass(features, moved, s):
    """Normal equations for Theta and Lambda, Theta eliminated, are those of the accumulated QR."""
    samples = Samples.collect(features, moved)
    fit = fit_joint(samples, np.random.default_rng(0).standard_normal((s, 3)), PolynomialModel(1, 7), max_iterations=1)
    blocks = TrajectoryBlocks(len(moved), 7)
    here = Iterate(features, samples.whitening, blocks, fit.whitened_selection, Policy.of(fit, samples))
    (cost, energy, parts), _ = accumulate(here, chunks(moved), [])
    assert cost / len(samples) == pytest.approx(fit.cost, rel=1e-10)
    assert energy / len(samples) == pytest.approx(fit.energy, rel=1e-10)
    assert sorted(parts) == list(range(7))
    g, H = (sum(part[i] for part in parts.values()) for i in (0, 1))
    m = s * (3 - s)
    K, C = H[:-m, :-m], H[:-m, -m:]
    expected_H, expected_g = _ByRows.at(samples, fit.whitened_selection, fit.model).equations()
    np.testing.assert_allclose(H[-m:, -m:] - C.T @ np.linalg.lstsq(K, C, rcond=1e-12)[0], expected_H, rtol=1e-7)
    reduced = g[-m:] - C.T @ np.linalg.lstsq(K, g[:-m], rcond=1e-12)[0]
    np.testing.assert_allclose(reduced, expected_g, rtol=1e-6, atol=1e-7 * np.abs(H).max() ** 0.5)


@pytest.mark.parametrize(("s", "p", "size"), [(1, 3, 1e-4), (2, 3, 0.1), (3, 6, 5.0), (5, 6, 1e-3)])
def test_angles_of_many_row_spaces(s, p, size, rng):
    """The bootstrap's angles are those of one row space at a time."""
    M = orthonormal_rows(rng.standard_normal((s, p)))
    stack = M + size * rng.standard_normal((20, s, p))
    np.testing.assert_allclose(row_space_angles(stack, M), [row_space_angle(x, M) for x in stack], rtol=1e-8)


# ---- the order of sums, the choice of few ----------------------------------------------------------------------------


class Sums(Accumulator):
    """Adds numbers."""

    def of(self, chunk):
        return chunk

    def merge(self, before, after):
        return before + after


def level_by_level(parts: list[str]) -> str:
    while len(parts) > 1:
        parts = ["(" + "".join(parts[i : i + 2]) + ")" if len(parts[i : i + 2]) == 2 else parts[i]
                 for i in range(0, len(parts), 2)]  # fmt: skip
    return parts[0]


def test_sums_are_taken_in_one_order():
    """A tree over the parts, the same one as a cluster builds level by level, with only a few totals waiting."""
    for n in range(1, 23):
        parts = [chr(97 + i) for i in range(n)]
        assert merge_tree(lambda before, after: f"({before}{after})", parts) == level_by_level(parts), n


def test_parts_without_samples_add_nothing():
    """A file without demonstrations does not change the sum; notes of the readers are kept in order."""
    parts = [None, (1, ("a",)), None, (2, ("b",)), None]
    assert merge_tree(partial(merge_parts, Sums()), parts) == (3, ("a", "b"))
    assert merge_tree(partial(merge_parts, Sums()), [None, None]) is None


def test_chunks_keep_every_sample(features):
    """Long trajectories are cut, short ones merge; order, trajectory and place in the part are kept."""
    rng = np.random.default_rng(0)
    names = features.robot.joint_names
    lengths = [1, 9000, 3, 4096, 1, 1, 5000]
    trajectories = [Trajectory(np.arange(n), rng.standard_normal((n, 7)), np.zeros((n, 7)), names) for n in lengths]
    cut = list(chunks(trajectories, part=3))
    assert [len(c) for c in cut] == [4096, 4096, 4096, 4096, sum(lengths) - 4 * 4096]
    assert [c.first for c in cut] == [0, 4096, 8192, 12288, 16384]
    assert {c.part for c in cut} == {3}
    np.testing.assert_array_equal(np.concatenate([c.q for c in cut]), np.concatenate([t.q for t in trajectories]))
    np.testing.assert_array_equal(np.concatenate([c.trajectory for c in cut]), np.repeat(np.arange(7), lengths))


def summary_of(accumulator: SummaryAccumulator, *parts) -> PassSummary:
    """The first pass over some parts."""
    totals = [accumulate(accumulator, chunks(part, i), []) for i, part in enumerate(parts)]
    return merge_tree(partial(merge_parts, accumulator), totals)[0]


def test_few_are_spread_evenly(features):
    """The chosen samples cover time and trajectories evenly, are the same at every run, and all are taken if few."""
    names = features.robot.joint_names
    count = np.arange(256)[:, None] * np.ones(7)
    trajectories = [Trajectory(np.arange(256), count + 1000 * i, count + 1, names) for i in range(90)]
    source = ListedTrajectories(trajectories)
    summary = summary_of(SummaryAccumulator(1000), source.part(0))
    assert summary.data.n_samples == 90 * 256 and summary.data.n_trajectories == 90
    assert len(summary.data.q) == 1000 == len(np.unique(summary.data.q[:, 0]))
    # no rhythm of the recording is met: each eighth of the trajectories' time holds an eighth of the choice
    phase = np.histogram(summary.data.q[:, 0] % 1000, bins=8, range=(0, 256))[0]
    assert phase.min() > 115 and phase.max() < 135
    per_trajectory = np.bincount(summary.data.trajectory, minlength=90)
    assert per_trajectory.min() >= 8 and per_trajectory.max() <= 14
    assert summary.data.low[0] == 0 and summary.data.high[0] == 89_255
    assert summary.data.fastest_at == (255, 0)
    everything = summary_of(SummaryAccumulator(10**6), trajectories)
    np.testing.assert_array_equal(everything.data.q, np.concatenate([t.q for t in trajectories]))


def test_summary_counts_trajectories_on_over_parts(features, held, monkeypatch):
    """Cut into parts, the summary names the same trajectories."""
    whole = summary_of(SummaryAccumulator(10**6), held)
    monkeypatch.setattr(trajectory_source, "PART", 700)
    source = ListedTrajectories(held)
    assert source.n_parts > 5
    total = summary_of(SummaryAccumulator(10**6), *(source.part(i) for i in range(source.n_parts)))
    np.testing.assert_array_equal(total.data.trajectory, whole.data.trajectory)
    assert total.data.n_trajectories == len(held) and total.data.fastest_at == whole.data.fastest_at
    assert list(total.first_trajectories.values())[:2] == [0, 7]


# ---- the answer ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "settings"), [("held", HELD), ("moved", JOINT)])
def test_all_samples_count(request, features, monkeypatch, kind, settings):
    """Started from a sixth of the samples and refined with all, the answer is that of all at once, to 1e-10; so is its
    uncertainty, to a few per cent.
    """
    demos = request.getfixturevalue(kind)
    direct = ConstraintLearner(features, **settings).fit(demos)
    from_few(monkeypatch, 1000)
    refine = ConstraintLearner(features, **settings).fit(demos)
    assert row_space_angle(direct.constraint_.selection, refine.constraint_.selection) < 1e-10
    assert refine.report_.n_samples == direct.report_.n_samples == 6000
    assert refine.report_.n_trajectories == 60
    assert refine.report_.energy_fraction == pytest.approx(direct.report_.energy_fraction, rel=1e-6)
    assert refine.report_.uncertainty_deg == pytest.approx(direct.report_.uncertainty_deg, rel=0.25)


@pytest.mark.parametrize(("held", "selection", "settings"), [(True, TWO, HELD), (False, ONE, JOINT)])
def test_clean_data_lose_nothing(features, monkeypatch, held, selection, settings):
    """Without noise the answer is exact to rounding, through normal equations as well as through QR."""
    demos = motions(features, selection, np.random.default_rng(3), 60, held=held)
    from_few(monkeypatch, 1000)
    learnt = ConstraintLearner(features, **settings).fit(demos).constraint_
    assert row_space_angle(learnt.selection, selection) < 1e-13


def test_every_estimator_takes_many_samples(features, moved, monkeypatch):
    """Those that do not go through all samples say so in the notes."""
    from_few(monkeypatch, 600)
    report = ConstraintLearner(features, 1, "separate").fit(moved).report_
    assert any("600 samples, chosen evenly out of 6000" in note for note in report.notes)
    assert ConstraintLearner(features, 1, "joint", policy_model="affine").fit(moved).report_.notes == ()


def test_an_outlier_among_many_is_found(features, held, monkeypatch):
    """The fastest sample of all is judged, not only that of the few, and named by its place among all."""
    u = held[41].u.copy()
    u[17, 3] = 1e7
    bad = [*held[:41], Trajectory(held[41].time, held[41].q, u, held[41].joint_names), *held[42:]]
    from_few(monkeypatch, 500)
    with pytest.raises(RecordingError, match=r"sample 4117 \(trajectory 41\).*right_j3"):
        ConstraintLearner(features, **HELD).fit(bad)


# ---- streams ---------------------------------------------------------------------------------------------------------


def test_a_stream_is_learnt_from(features, monkeypatch):
    """An object that yields the trajectories in each pass gives the same answer as a list of them."""
    from_few(monkeypatch, 1000)
    stream = Stream(features, TWO, 60, 10, held=True)
    learnt = ConstraintLearner(features, **HELD).fit(stream)
    # the joints of the first trajectory, some recordings that say what holds, all samples once: these are kept
    assert stream.passes == 3
    monkeypatch.setattr("manip_learn.learning.streaming.sample_stream.KEPT_BYTES", 100_000)
    again = ConstraintLearner(features, **HELD).fit(stream)
    assert stream.passes >= 3 + 5  # too many to be kept: read in each pass
    listed = ConstraintLearner(features, **HELD).fit(list(stream))
    for other in (again, listed):
        np.testing.assert_array_equal(learnt.constraint_.selection, other.constraint_.selection)


@pytest.mark.parametrize("arriving", [False, True])
def test_a_recording_that_repeats_another_counts_once(features, held, monkeypatch, arriving):
    """Among the recordings that stand for all it is named, and passed over in every pass."""
    copy = Trajectory(held[0].time, held[0].q, held[0].u, held[0].joint_names, "the copy")
    from_few(monkeypatch, 1000)

    def learnt(*recordings):
        stream, learning = Yielded(recordings), ConstraintLearner(features, **HELD)
        return learning.partial_fit(stream) if arriving else learning.fit(stream)

    once, twice = learnt(*held[:11]), learnt(*held[:11], copy)
    assert any("the copy repeats motion 0" in warning for warning in twice.report_.warnings)
    assert twice.report_.n_trajectories == 11
    np.testing.assert_array_equal(twice.constraint_.selection, once.constraint_.selection)
    assert twice.report_.uncertainty_deg == once.report_.uncertainty_deg


class Yielded:
    """An object that yields trajectories anew each time, several times over if asked for."""

    def __init__(self, trajectories, times: int = 1):
        self.trajectories, self.times = trajectories, times

    def __iter__(self):
        for i in range(self.times):
            for t in self.trajectories:
                yield Trajectory(t.time, t.q + 1e-3 * i, t.u, t.joint_names, t.name)


def test_memory_does_not_grow(features, held, monkeypatch):
    """Five times as many samples need no more memory."""
    monkeypatch.setattr("manip_learn.learning.streaming.sample_stream.KEPT_BYTES", 100_000)
    from_few(monkeypatch, 2000)

    def peak(times: int) -> int:
        gc.collect()
        tracemalloc.start()
        ConstraintLearner(features, **HELD).fit(Yielded(held, times))
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    peak(1)  # what is loaded at first use
    small, large = peak(1), peak(5)
    assert large < small + 500_000  # the difference in data is 2.7 MB


def test_iterators_are_read_into_a_list(features, held):
    """What can be read only once is kept in memory, or refused where that was not asked for."""
    listed = ConstraintLearner(features, **HELD).fit(held).constraint_.selection
    np.testing.assert_array_equal(ConstraintLearner(features, **HELD).fit(iter(held)).constraint_.selection, listed)
    with pytest.raises(RecordingError, match="only once"):
        IteratedTrajectories(iter(held))
    with pytest.raises(RecordingError, match="must be trajectories"):
        source_of(3)  # type: ignore[arg-type]


def test_streams_are_checked(features, held):
    """Joints of another robot, missing velocities and emptiness are refused in streams, too."""
    t = held[0]
    renamed = Trajectory(t.time, t.q, t.u, tuple(f"other_{n}" for n in t.joint_names))
    with pytest.raises(RecordingError, match="sorts by name"):
        ConstraintLearner(features).fit(Yielded([*held, renamed]))
    with pytest.raises(RecordingError, match="no demonstrations"):
        ConstraintLearner(features).fit(Yielded([]))
    positions = Yielded([Trajectory(t.time, t.q, None, t.joint_names) for t in held])
    report = ConstraintLearner(features, **HELD).fit(positions).report_
    assert report.notes == ("velocities were derived from the positions",)


# ---- one demonstration after the other -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "settings", "few"), [("held", HELD, 1000), ("moved", JOINT, 1000), ("held", HELD, 10**6)]
)
def test_partial_fit_is_one_fit(request, features, monkeypatch, kind, settings, few):
    """Demonstrations that arrive in three batches give the same Lambda and evidence as all at once, bit for bit."""
    demos = request.getfixturevalue(kind)
    from_few(monkeypatch, few)
    monkeypatch.setattr(trajectory_source, "PART", 900)
    whole = ConstraintLearner(features, **settings).fit(demos)
    arriving = ConstraintLearner(features, **settings)
    for batch in (demos[:10], iter(demos[10:35]), list(demos[35:])):
        arriving.partial_fit(batch)
    np.testing.assert_array_equal(arriving.constraint_.selection, whole.constraint_.selection)
    assert arriving.report_.uncertainty_deg == whole.report_.uncertainty_deg
    assert arriving.report_.n_samples == 6000


def test_partial_fit_spills_to_a_file(features, held):
    """Beyond the limit, trajectories lie in a file and come back as they were."""
    kept = TrajectoryBuffer(in_memory=40_000)
    kept.add(source_of(held), [features], "auto")
    assert kept._file._rolled  # type: ignore[attr-defined]
    back = [t for i in range(kept.n_parts) for t in kept.part(i)]
    assert len(back) == len(held)
    for a, b in zip(back, held, strict=True):
        for one, other in ((a.q, b.q), (a.u, b.u), (a.time, b.time)):
            np.testing.assert_array_equal(one, other)
        assert (a.name, a.joint_names) == (b.name, b.joint_names)


def test_partial_fit_keeps_what_is_usable(features, held):
    """Too few samples are refused but kept; a batch with an invalid recording is not kept; fit discards all."""
    learning = ConstraintLearner(features, 2)
    with pytest.raises(NotIdentifiableError):
        learning.partial_fit([held[0].part(slice(0, 4))])
    bad = Trajectory(held[1].time, held[1].q, held[1].u, tuple(f"x{n}" for n in held[1].joint_names))

    with pytest.raises(RecordingError, match="sorts by name"):
        learning.partial_fit(Yielded([held[1], held[2], bad]))
    with pytest.raises(RecordingError):
        learning.partial_fit(lambda: None)  # type: ignore[arg-type]
    # of the first four samples nothing can be told, so that they are kept and not learnt from
    assert learning.partial_fit(held[1:]).report_.n_samples == 5900
    assert learning.fit(held[:20]).partial_fit(held[20:30]).report_.n_trajectories == 10


# ---- files -----------------------------------------------------------------------------------------------------------


def test_files_are_a_source(features, held, tmp_path, monkeypatch):
    """A folder of files, read part by part at each pass, gives the answer of the same files loaded at once."""
    from manip_learn.recordings import recording_source

    robot = features.robot
    for i, t in enumerate(held):
        np.savez(tmp_path / f"demo_{i:02d}.npz", time=t.time, q=t.q, u=t.u, joint_names=np.array(t.joint_names))
    monkeypatch.setattr(recording_source, "PART_BYTES", 50_000)
    source = RecordingSource(tmp_path, robot)
    assert 5 < source.n_parts < 40
    loaded = load_demonstrations(tmp_path, robot)
    whole = ConstraintLearner(features, **HELD).fit(loaded)
    read = ConstraintLearner(features, **HELD).fit(source)
    np.testing.assert_array_equal(read.constraint_.selection, whole.constraint_.selection)
    assert read.report_.n_trajectories == 60


def test_lerobot_episodes_are_parts(tmp_path, monkeypatch):
    """LeRobot data is read file by file, as a whole where an episode goes on in the next file or some are chosen."""
    pa = pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")
    import pyarrow.parquet as pq

    from manip_learn.recordings import recording_source

    monkeypatch.setattr(recording_source, "PART_BYTES", 1)
    robot = load_robot("planar3")
    for version, parts, first in (("v2.1", 4, 0), ("v3.0", 4, 0), ("v3.0", 1, 1)):
        root = tmp_path / f"{version} {first}"
        (root / "meta").mkdir(parents=True)
        (root / "data").mkdir()
        state = {"dtype": "float32", "shape": [3], "names": list(robot.joint_names)}
        description = {"codebase_version": version, "fps": 50, "features": {"observation.state": state}}
        (root / "meta" / "info.json").write_text(json.dumps(description))
        for episode in range(4):
            t = np.arange(30) / 50
            q = np.column_stack([np.sin(t) + 0.1 * episode, 0.5 * np.cos(t), 0.3 * t])
            columns = {
                "observation.state": pa.array(q.tolist(), type=pa.list_(pa.float64())),
                "timestamp": pa.array(t),
                "frame_index": pa.array(np.arange(30)),
                "episode_index": pa.array(np.full(30, episode)),
            }
            table, name = pa.table(columns), f"episode_{episode}.parquet"
            if first == 1 and episode == 0:  # all but its first samples are at the beginning of the next file
                pq.write_table(table[:10], root / "data" / "file-000.parquet")
                before = table[10:]
                continue
            if first == 1 and episode == 1:
                table = pa.concat_tables([before, table])
            pq.write_table(table, root / "data" / (name if version == "v2.1" else f"file-{episode:03d}.parquet"))
        source = RecordingSource(root, robot, units="radians")
        assert source.n_parts == parts
        assert version == "v2.1" or RecordingSource(root, robot, units="radians", episodes="0:2").n_parts == 1
        read = [t for i in range(parts) for t in source.part(i)]
        loaded = load_demonstrations(root, robot, units="radians")
        assert len(read) == len(loaded) == 4
        for a, b in zip(read, loaded, strict=True):
            np.testing.assert_array_equal(a.q, b.q)
