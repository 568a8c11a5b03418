"""Fleets of short episodes, from disk to Lambda, over the plainest way to read the same files.

The plain way is a loop of `np.load` over the arrays of 1,000 NPZ files with 100 samples each. Everything else is
stated in it: the same files streamed, in memory and audited; a LeRobot data set of as many episodes with and without
velocities. Processor time.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scale_motions import motions
from timing import Ratio, keep

from manip_learn.constraint.features import FrameJacobian
from manip_learn.learning import ConstraintLearner
from manip_learn.learning.audit import audit_episodes
from manip_learn.learning.cluster import dask_client
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.load import RecordingSource
from manip_learn.robot import load_robot

pytestmark = [pytest.mark.bench, pytest.mark.timeout(1800)]
EPISODES, SAMPLES = 1_000, 100


def fleet(folder: Path, features: FrameJacobian) -> list[Path]:
    """Episodes of two held rows with noise of their own, as NPZ files and as two LeRobot data sets."""
    pa = pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")
    import pyarrow.parquet as pq

    rng, names = np.random.default_rng(1), list(features.robot.joint_names)
    demos = motions(features, np.linalg.qr(rng.standard_normal((3, 2)))[0].T, rng, EPISODES, SAMPLES, 0.02, held=True)
    plain = folder / "npz"
    plain.mkdir()
    for i, t in enumerate(demos):
        np.savez(plain / f"episode_{i:05d}.npz", time=t.time, q=t.q, u=t.u, joint_names=np.array(names))
    sets = {"velocities": ("observation.state", "observation.velocity"), "positions": ("observation.state",)}
    for kind, columns in sets.items():
        root = folder / kind
        (root / "meta").mkdir(parents=True)
        (root / "data").mkdir()
        vector = {"dtype": "float32", "shape": [len(names)], "names": names}
        told = {"codebase_version": "v3.0", "fps": 50, "features": dict.fromkeys(columns, vector)}
        (root / "meta" / "info.json").write_text(json.dumps(told), encoding="utf-8")
        for k, start in enumerate(range(0, EPISODES, 250)):
            some = [demos[i] for i in range(start, start + 250)]
            values = {c: np.concatenate([t.u if "velocity" in c else t.q for t in some]) for c in columns}
            flat = {c: pa.array(v.astype(np.float32).ravel()) for c, v in values.items()}
            table = {c: pa.FixedSizeListArray.from_arrays(v, len(names)) for c, v in flat.items()}
            table["timestamp"] = pa.array(np.concatenate([t.time for t in some]).astype(np.float32))
            table["frame_index"] = pa.array(np.tile(np.arange(SAMPLES), len(some)))
            table["episode_index"] = pa.array(np.repeat(np.arange(start, start + len(some)), SAMPLES))
            pq.write_table(pa.table(table), root / "data" / f"file-{k:03d}.parquet")
    return [plain, folder / "velocities", folder / "positions"]


def processor_time() -> float:
    """Of this process and of those that it has ended [s]."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(used.ru_utime + used.ru_stime for used in both)


def read_plainly(folder: Path) -> int:
    """All arrays, and nothing else."""
    count = 0
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as content:
            count += len(content["time"]) + 0 * len(content["q"]) + 0 * len(content["u"])
            count += 0 * len(content["joint_names"])
    return count


def test_fleet_from_disk_to_selection(tmp_path: Path) -> None:
    """Reading with all checks, learning and auditing, each over reading without any."""
    features = FrameJacobian(load_robot("sawyer"), "right_gripper_tip", "xyz")
    robot = features.robot
    plain, moving, still = fleet(tmp_path, features)

    def learn(folder: Path, **options: str) -> ConstraintLearner:
        return ConstraintLearner(features, 2, "null-space").fit(RecordingSource(folder, robot, **options))

    learnt = learn(plain)
    assert learnt.report_.n_samples == EPISODES * SAMPLES
    candidates: dict[str, Callable[[], object]] = {
        "plain": lambda: read_plainly(plain),
        "1,000 NPZ episodes read": lambda: load_demonstrations(plain, robot),
        "1,000 NPZ episodes streamed to Lambda": lambda: learn(plain),
        "1,000 NPZ episodes audited": lambda: audit_episodes(learnt.constraint_, RecordingSource(plain, robot)),
        "1,000 LeRobot episodes streamed to Lambda": lambda: learn(moving, units="radians"),
        "1,000 LeRobot episodes without velocities": lambda: learn(still, units="radians"),
    }
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(int(os.environ.get("BENCH_ROUNDS", "3"))):
        for name, call in candidates.items():
            begin = processor_time()
            call()
            seconds[name].append(processor_time() - begin)
    found = {}
    for name in [n for n in seconds if n != "plain"]:
        rounds = [a / b for a, b in zip(seconds[name], seconds["plain"], strict=True)]
        lower, _, upper = statistics.quantiles(rounds, n=4)
        found[name] = Ratio(min(seconds[name]) / min(seconds["plain"]), lower, upper)
        print(f"  {name:44s} {found[name].value:6.1f} of np.load's time ({lower:.1f} .. {upper:.1f})")
    keep("fleet", found)


def test_workers_share_a_fleet(tmp_path: Path) -> None:
    """One and two dask workers on the LeRobot episodes, on the wall: no promise on a machine that others use."""
    features = FrameJacobian(load_robot("sawyer"), "right_gripper_tip", "xyz")
    moving = fleet(tmp_path, features)[1]
    seconds = {}
    for workers in (1, 2):
        with dask_client("local", workers) as client:
            source = RecordingSource(moving, features.robot, units="radians")
            learner = ConstraintLearner(features, 2, "null-space").fit(source, client=client)  # loads what is needed
            begin = time.perf_counter()
            learner.fit(source, client=client)
            seconds[workers] = time.perf_counter() - begin
    print(f"\n  two workers {seconds[1] / seconds[2]:.2f} times as fast as one, {source.n_parts} parts")
