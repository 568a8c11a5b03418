"""One fit in a process of its own, for `bench_learning.py`: arguments in, a JSON line with time and memory out."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "robots"))

import numpy as np
from make_planar3 import planar_arm_urdf
from peak_memory import peak_megabytes
from scale_motions import motions

from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.learning import ConstraintLearner
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.robot import load_robot

BASE = 500  # trajectories of 100 samples that are made; more are the same with other noise
NOISE = 0.02


class Repeated:
    """The base trajectories again and again, each time with noise of its own; none is kept.

    Args:
        base: Without noise.
        n: Number of trajectories.
    """

    def __init__(self, base: Demonstrations, n: int):
        self.base, self.n, self.passes = base, n, 0
        self.size = NOISE * float(np.sqrt(np.mean([np.mean(t.u**2) for t in base])))

    def __iter__(self) -> Iterator[Trajectory]:
        self.passes += 1
        for i in range(self.n):
            t = self.base[i % len(self.base)]
            noise = self.size * np.random.default_rng(i).standard_normal(t.u.shape)
            yield Trajectory(t.time, t.q, t.u + noise, t.joint_names, t.name, exact=True)


def features_of(joints: int, axes: str, folder: Path) -> FrameJacobian:
    """Rows of a 7-joint arm's tip, or of a planar arm's with another number of joints."""
    if joints == 7:
        return FrameJacobian(load_robot("sawyer"), "right_gripper_tip", axes)
    path = folder / f"planar{joints}.urdf"
    path.write_text(planar_arm_urdf([1.0] * joints), encoding="utf-8")
    return FrameJacobian(load_robot(path), "tip", "planar")


def pinv_seconds(calls: int = 1000) -> float:
    """Processor time of one `np.linalg.pinv` of a 3 x 7 matrix: what costs are stated in."""
    A = np.random.default_rng(0).standard_normal((3, 7))
    clock = time.process_time()
    for _ in range(calls):
        np.linalg.pinv(A)
    return (time.process_time() - clock) / calls


def fixed_cost(job: dict) -> dict:
    """Fits to the same few samples again and again: processor time of each over that of a pinv beside it."""
    features = features_of(7, "xyz", Path(job["folder"]))
    rng, held = np.random.default_rng(1), job["kind"] == "held"
    selection = np.linalg.qr(rng.standard_normal((features.n_rows, 2)))[0].T
    demos = list(Repeated(motions(features, selection, rng, 10, held=held), job["samples"] // 100))
    ratios = []
    for _ in range(job["rounds"] + 1):
        unit, clock = pinv_seconds(), time.process_time()
        ConstraintLearner(features, **job["settings"]).fit(demos)
        seconds = time.process_time() - clock
        ratios.append(seconds / min(unit, pinv_seconds()))
    return {"ratios": ratios[1:]}  # the first fit loads what it needs


def run(job: dict) -> dict:
    """Time of the fit [s of one core], peak memory [MB], and how far the answer is off [degrees]."""
    features = features_of(job["joints"], job["axes"], Path(job["folder"]))
    s, held = job["constraints"], job["kind"] == "held"
    rng = np.random.default_rng(1)
    selection = np.linalg.qr(rng.standard_normal((features.n_rows, s)))[0].T
    stream = Repeated(motions(features, selection, rng, BASE, held=held), job["samples"] // 100)
    source = stream if job["how"] == "stream" else list(stream)
    model = {} if held else {"policy_model": "affine"}
    model |= {"most_samples": 10**9} if job["how"] == "at once" else {}
    fit = ConstraintLearner(features, s, "null-space" if held else "joint", **model)
    before, unit = peak_megabytes(), pinv_seconds()
    started, wall = time.process_time(), time.perf_counter()
    fit.fit(source)
    wall = time.perf_counter() - wall
    cpu, passes = time.process_time() - started, stream.passes
    unit = min(unit, pinv_seconds())
    if job["how"] == "stream":
        clock = time.process_time()
        for _ in stream:  # what making the samples costs is not the learner's
            pass
        cpu -= passes * (time.process_time() - clock)
    return {
        "pinvs": cpu / unit,
        "cpu": cpu,
        "wall": wall,
        "before": before,
        "peak": peak_megabytes(),
        "angle": float(np.degrees(row_space_angle(selection, fit.constraint_.selection))),
    }


if __name__ == "__main__":
    asked = json.loads(sys.argv[1])
    print(json.dumps(fixed_cost(asked) if "rounds" in asked else run(asked)))
