"""What the peers share: the arm and its postures, tasks and ways to follow, and how the answers are written.

Runs in the environment of each peer, so it needs NumPy and the standard library only. The first argument of a peer's
script says what to do:

- `step`: microseconds of a step at given postures of the Sawyer-like arm (`bench_control_step.py`)
- `control CASES ANSWER`: its controller on the tasks of `peer_controllers.py`
- `way CASES ANSWER`: its controller along the ways of `when_it_helps.py`: poses in time, the same for all peers

The arm takes commands as a real one would: joint by joint within its velocity limits, and no further than its position
limits.
"""

from __future__ import annotations

import importlib.metadata
import json
import sys
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

from timing import rounds_of, summary  # noqa: E402

URDF = str(ROOT / "robots" / "sawyer.urdf")
TIP = "right_l6"  # the last link that moves: MuJoCo merges what is fixed to it, others stumble over equal names
TARGET = np.array([0.75, 0.2, 0.35])
DT = 0.01
CENTRE = np.array([0.1, -0.6, 0.2, 1.3, -0.2, 0.7, 0.4])  # elbow bent, far from limits and singularities
POSTURES = CENTRE + np.random.default_rng(0).uniform(-0.3, 0.3, (64, 7))
Step = Callable[[np.ndarray], np.ndarray]
Stepper = Callable[[np.ndarray, np.ndarray], np.ndarray]  # posture, pose wanted at the end of the step -> velocity


def main(**jobs: Callable[..., None]) -> None:
    """Do what the first argument names."""
    jobs[sys.argv[1]](*sys.argv[2:])


def over_postures(step: Callable[[np.ndarray], object]) -> Callable[[], object]:
    """A call without arguments that takes the next posture each time: no candidate may live on a cached one."""
    following = cycle([np.array(q) for q in POSTURES])
    return lambda: step(next(following))


def report(package: str, steps: dict[str, Callable[[np.ndarray], object]], calls: int = 200, rounds: int = 15) -> None:
    """Measure the steps and print one JSON document: microseconds a step."""
    seconds = rounds_of({name: over_postures(step) for name, step in steps.items()}, calls, rounds)
    versions = {name: importlib.metadata.version(name) for name in (package, "numpy")}
    document = {"versions": versions, "us": {name: summary(s)._asdict() for name, s in seconds.items()}}
    for timing in document["us"].values():
        for key in timing:
            timing[key] *= 1e6
    print(json.dumps(document))


class Arm(NamedTuple):
    """One robot and the clock: a URDF without shapes whose joints are exactly those of `names`."""

    urdf: str
    base: str
    tip: str
    names: list[str]
    lower: np.ndarray
    upper: np.ndarray
    velocity: np.ndarray
    dt: float
    duration: float
    task_gain: float


class Case(NamedTuple):
    """One task: rows of the tip's xyz (s, 3), start, target, and the gain of whatever climbs the manipulability."""

    rows: np.ndarray
    start: np.ndarray
    target: np.ndarray
    gain: float


def read_tasks(path: str) -> tuple[Arm, list[Case]]:
    """The arm and its cases."""
    with open(path, encoding="utf-8") as stream:
        content = json.load(stream)
    arm = content["arm"]
    for key in ("lower", "upper", "velocity"):
        arm[key] = np.array(arm[key])
    cases = [
        Case(np.array(c["rows"]), np.array(c["start"]), np.array(c["target"]), c["gain"]) for c in content["cases"]
    ]
    return Arm(**arm), cases


def motion(arm: Arm, case: Case, step: Step) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Postures, velocities, seconds a step, and the number of steps without an answer (the arm then stands still)."""
    steps, n = round(arm.duration / arm.dt), len(arm.names)
    q, Q, U = case.start.copy(), np.empty((steps + 1, n)), np.zeros((steps + 1, n))
    seconds, failed = 0.0, 0
    for i in range(steps + 1):
        began = time.perf_counter()
        try:
            u = np.asarray(step(q), dtype=np.float64).reshape(-1)
        except Exception as error:  # noqa: BLE001 - every peer has its own way of giving up
            failed += 1
            if failed == 1:
                print(f"{type(error).__name__}: {error}"[:200], file=sys.stderr)
            u = np.zeros(n)
        seconds += time.perf_counter() - began
        if not np.all(np.isfinite(u)):
            failed, u = failed + 1, np.zeros(n)
        u = np.clip(u, -arm.velocity, arm.velocity)
        Q[i], U[i] = q, u
        q = np.clip(q + arm.dt * u, np.minimum(arm.lower, q), np.maximum(arm.upper, q))
    return Q, U, seconds / (steps + 1), failed


class WayCase(NamedTuple):
    """Rows (s, 6), start (nv,), poses (T, 4, 4), share of the error that a step takes back, whether mu has 6 rows."""

    rows: np.ndarray
    start: np.ndarray
    poses: np.ndarray
    gain: float
    whole: bool


def read_ways(path: str) -> tuple[Arm, list[WayCase]]:
    """The arm and its ways."""
    with np.load(path) as f:
        names, dt = f["names"].tolist(), float(f["dt"])
        limits = f["lower"], f["upper"], f["velocity"]
        arm = Arm(str(f["urdf"]), "", str(f["tip"]), names, *limits, dt, dt * (len(f["poses0"]) - 1), 0.0)
        return arm, [
            WayCase(f[f"rows{i}"], f[f"start{i}"], f[f"poses{i}"], float(f["gain"]), bool(f["whole"]))
            for i in range(int(f["number"]))
        ]


def pose_error(R: np.ndarray, p: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(p* - p, log(R* R^T)) along the axes of the base [m, rad]."""
    Q = pose[:3, :3] @ R.T
    axis = 0.5 * np.array([Q[2, 1] - Q[1, 2], Q[0, 2] - Q[2, 0], Q[1, 0] - Q[0, 1]])
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, 0.5 * (np.trace(Q) - 1.0))
    return np.concatenate([pose[:3, 3] - p, axis * (angle / sine if sine > 1e-9 else 1.0)])


def clocked(step: Stepper, poses: np.ndarray) -> Step:
    """The same as a function of the posture alone, called once a step."""
    following = iter([*poses[1:], poses[-1]])
    return lambda q: step(q, next(following))


def drive(package: str, cases: str, answer: str, methods: dict[str, Callable[[Arm, Case], Step]]) -> None:
    """Every method on every task of a file."""
    arm, tasks = read_tasks(cases)
    write(package, answer, {name: [motion(arm, c, make(arm, c)) for c in tasks] for name, make in methods.items()})


def drive_ways(package: str, cases: str, answer: str, methods: dict[str, Callable[[Arm, WayCase], Stepper]]) -> None:
    """Every method along every way of a file."""
    arm, ways = read_ways(cases)
    runs = {name: [motion(arm, c, clocked(make(arm, c), c.poses)) for c in ways] for name, make in methods.items()}
    write(package, answer, runs)


def write(package: str, answer: str, runs: dict[str, list[tuple[np.ndarray, np.ndarray, float, int]]]) -> None:
    """The package's version, and the motions of each method."""
    out: dict[str, Any] = {"version": np.array(f"{package} {importlib.metadata.version(package)}")}
    for name, motions in runs.items():
        for key, values in zip(("q", "u", "seconds", "failed"), zip(*motions, strict=True), strict=True):
            out[f"{name}|{key}"] = np.array(values)
    np.savez(answer, **out)


def on_the_way(case: Case) -> WayCase:
    """A task as a way that stays at one pose: rows of the place among those of the pose."""
    pose = np.eye(4)
    pose[:3, 3] = case.target
    return WayCase(np.hstack([case.rows, np.zeros_like(case.rows)]), case.start, pose[None], 0.0, False)
