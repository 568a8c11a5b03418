"""Fleets of short episodes, from disk to Lambda, over the plainest way to read the same files.

The plain way is a loop of `np.load` over the arrays of 1,000 NPZ files with 100 samples each. Everything else is
stated in it: the same files streamed, in memory and audited; a LeRobot data set of as many episodes. Processor time.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest
from scale_motions import motions
from scipy.interpolate import make_interp_spline
from timing import Ratio, keep

from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.learning import ConstraintLearner
from manip_learn.learning.audit import audit_episodes
from manip_learn.learning.table import MOST_SAMPLES, dask_client
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.load import RecordingSource
from manip_learn.robot import load_robot

pytestmark = [pytest.mark.bench, pytest.mark.timeout(1800)]
EPISODES, SAMPLES = 1_000, 100


def fleet(folder: Path, features: FrameJacobian) -> tuple[Path, Path]:
    """Episodes of two held rows with noise of their own, as NPZ files and as a LeRobot data set."""
    pa = pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")
    import pyarrow.parquet as pq

    rng, names = np.random.default_rng(1), list(features.robot.joint_names)
    demos = motions(features, np.linalg.qr(rng.standard_normal((3, 2)))[0].T, rng, EPISODES, SAMPLES, 0.02, held=True)
    plain = folder / "npz"
    plain.mkdir()
    for i, t in enumerate(demos):
        np.savez(plain / f"episode_{i:05d}.npz", time=t.time, q=t.q, u=t.u, joint_names=np.array(names))
    (folder / "set" / "meta").mkdir(parents=True)
    (folder / "set" / "data").mkdir()
    vector = {"dtype": "float32", "shape": [len(names)], "names": names}
    told = {"codebase_version": "v3.0", "fps": 50, "features": {"observation.state": vector}}
    (folder / "set" / "meta" / "info.json").write_text(json.dumps(told), encoding="utf-8")
    for k, start in enumerate(range(0, EPISODES, 250)):
        some = [demos[i] for i in range(start, start + 250)]
        flat = pa.array(np.concatenate([t.q for t in some]).astype(np.float32).ravel())
        table = {"observation.state": pa.FixedSizeListArray.from_arrays(flat, len(names))}
        table["timestamp"] = pa.array(np.concatenate([t.time for t in some]).astype(np.float32))
        table["frame_index"] = pa.array(np.tile(np.arange(SAMPLES), len(some)))
        table["episode_index"] = pa.array(np.repeat(np.arange(start, start + len(some)), SAMPLES))
        pq.write_table(pa.table(table), folder / "set" / "data" / f"file-{k:03d}.parquet")
    return plain, folder / "set"


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
    plain, lerobot = fleet(tmp_path, features)

    def learn(folder: Path, **options: str) -> ConstraintLearner:
        return ConstraintLearner(features, 2, "null-space").fit(RecordingSource(folder, robot, **options))

    learnt = learn(plain)
    assert 0.5 * MOST_SAMPLES < learnt.report_.n_samples <= MOST_SAMPLES
    candidates: dict[str, Callable[[], object]] = {
        "plain": lambda: read_plainly(plain),
        "1,000 NPZ episodes read": lambda: load_demonstrations(plain, robot),
        "1,000 NPZ episodes streamed to Lambda": lambda: learn(plain),
        "1,000 NPZ episodes audited": lambda: audit_episodes(learnt.constraint_, RecordingSource(plain, robot)),
        "1,000 LeRobot episodes streamed to Lambda": lambda: learn(lerobot, units="radians"),
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


def test_workers_share_what_memory_does_not_hold(tmp_path: Path) -> None:
    """1.2 GB of long recordings by one and two dask workers, in turns: seconds on the wall, peak memory of each."""
    features, time = FrameJacobian(load_robot("sawyer"), "right_gripper_tip", "xyz"), np.arange(100_000) / 100.0
    names = np.array(features.robot.joint_names)
    for i, t in enumerate(motions(features, np.eye(3)[:2], np.random.default_rng(2), 200, SAMPLES, 0.0, held=True)):
        to_and_fro = 0.5 * (1.0 - np.cos(0.1 * np.pi * time)) * t.time[-1]
        q = make_interp_spline(t.time, t.q)(to_and_fro)
        np.savez(tmp_path / f"{i}.npz", time=time, q=q, joint_names=names)
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for workers in [1, 2] * int(os.environ.get("BENCH_ROUNDS", "3")):
        with dask_client("local", workers) as client:
            begin, source = perf_counter(), RecordingSource(tmp_path, features.robot)
            ConstraintLearner(features, 2, "null-space").fit(source, client=client)
            seconds[workers].append(perf_counter() - begin)
            peak = max(client.run(lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss).values()) / 1024
        print(f"\n  {workers}: {seconds[workers][-1]:.1f} s, {peak:.0f} MB in a worker, load {os.getloadavg()[0]:.1f}")
    print(f"  two workers {min(seconds[1]) / min(seconds[2]):.2f} times as fast as one")
