"""What the peers share: the arm and its postures, tasks and ways to follow, and how the answers are written.

Runs in the environment of each peer, so it needs NumPy and the standard library only. The first argument of a peer's
script says what to do:

- `step`: microseconds of a step at given postures of the Sawyer-like arm (`bench_control_step.py`)
- `control CASES ANSWER`: where its controller takes the arm in the tasks of `beside_peers.py`
- `timings`: processor time of its controller at the starts of tasks, whenever `beside_peers.py` asks for it

The arm takes commands as a real one would: joint by joint within its velocity limits, and no further than its position
limits.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
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
Motion = tuple[np.ndarray, int, np.ndarray]


class NoSuchRowsError(Exception):
    """A peer's task is not written for these rows."""


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


def sawyer() -> Arm:
    """The Sawyer-like arm of `step`, no name of whose fixed joints is a link's too."""
    tree = ET.parse(URDF)
    joints = tree.getroot().findall("joint")
    moving = [joint for joint in joints if joint.get("type") != "fixed"]
    for joint in joints:
        if joint not in moving:
            joint.set("name", f"{joint.get('name')} fixed")
    limits = [joint.find("limit") for joint in moving]
    values = (np.array([float(x.get(key)) for x in limits if x is not None]) for key in ("lower", "upper", "velocity"))
    path = Path(tempfile.mkdtemp()) / "sawyer.urdf"
    tree.write(path)
    return Arm(str(path), "base", TIP, [str(joint.get("name")) for joint in moving], *values, DT, 0.0, 1.0)


def order(indices: Any) -> slice | np.ndarray:
    """Where a peer keeps the joints; a slice where that is enough: indices cost a fast peer a tenth of its step."""
    found = np.asarray(indices)
    straight = slice(int(found[0]), int(found[0]) + len(found))
    return straight if np.array_equal(found, np.arange(straight.start, straight.stop)) else found


def beyond(arm: Arm, q: np.ndarray, u: np.ndarray) -> np.ndarray:
    """By what a velocity exceeds its limit, as a share of it, and a posture its own after the step [rad]; at most 0."""
    after = q + arm.dt * u
    return np.array([np.max(np.abs(u) / arm.velocity) - 1.0, np.max(np.maximum(after - arm.upper, arm.lower - after))])


def motion(arm: Arm, case: Case, step: Step) -> Motion:
    """Last posture, steps without an answer (the arm then stands still), and what the commands are `beyond`."""
    q, failed, excess = case.start.copy(), 0, np.zeros(2)
    last = q
    for _ in range(round(arm.duration / arm.dt) + 1):
        try:
            u = np.asarray(step(q), dtype=np.float64).reshape(-1)
        except Exception as error:  # noqa: BLE001 - every peer has its own way of giving up
            failed += 1
            if failed == 1:
                print(f"{type(error).__name__}: {error}"[:200], file=sys.stderr)
            u = np.zeros(len(q))
        if not np.all(np.isfinite(u)):
            failed, u = failed + 1, np.zeros(len(q))
        excess = np.maximum(excess, beyond(arm, q, u))
        u = np.clip(u, -arm.velocity, arm.velocity)
        last, q = q, np.clip(q + arm.dt * u, np.minimum(arm.lower, q), np.maximum(arm.upper, q))
    return last, failed, excess


def answer(package: str, methods: dict[str, Callable[[Arm, Case], Step]]) -> None:
    """Answer lines `[method, file of tasks]` with seconds a step and the number of starts without an answer.

    The parent asks one peer after the other. All tasks of a file are at one target along the same rows.
    """
    replies = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # solvers print
    known: dict[tuple[str, str], tuple[Step, list[np.ndarray], int]] = {}
    print(json.dumps([f"{package} {importlib.metadata.version(package)}", list(methods)]), file=replies, flush=True)
    for line in sys.stdin:
        method, path = json.loads(line)
        try:
            if (method, path) not in known:
                arm, tasks = read_tasks(path)
                step, starts = methods[method](arm, tasks[0]), [case.start for case in tasks]
                known[method, path] = step, starts, sum(not answers(step, q) for q in starts)
            step, starts, failed = known[method, path]
            reply: list[Any] = [seconds_of(step, starts), failed]
        except NoSuchRowsError as error:
            reply = [None, str(error)]
        print(json.dumps(reply), file=replies, flush=True)


def answers(step: Step, q: np.ndarray) -> bool:
    """Whether there is a velocity."""
    try:
        return bool(np.all(np.isfinite(step(q))))
    except Exception:  # noqa: BLE001 - every peer has its own way of giving up
        return False


def seconds_of(step: Step, starts: list[np.ndarray], least: float = 0.003) -> float:
    """Processor time of a step; all starts again and again for at least so long [s]."""
    steps, began, spent = 0, time.process_time(), 0.0
    while spent < least:
        for q in starts:
            try:
                step(q)
            except Exception:  # noqa: BLE001, S110 - what giving up takes counts
                pass
        steps, spent = steps + len(starts), time.process_time() - began
    return spent / steps


def drive(package: str, cases: str, answer: str, methods: dict[str, Callable[[Arm, Case], Step]]) -> None:
    """Every method on every task of a file, if it takes their rows."""
    (arm, tasks), runs = read_tasks(cases), {}
    for name, make in methods.items():
        with contextlib.suppress(NoSuchRowsError):
            runs[name] = [motion(arm, c, make(arm, c)) for c in tasks]
    write(package, answer, runs)


def write(package: str, answer: str, runs: dict[str, list[Motion]]) -> None:
    """The package's version, and the motions of each method."""
    out: dict[str, Any] = {"version": np.array(f"{package} {importlib.metadata.version(package)}")}
    for name, motions in runs.items():
        for key, values in zip(("q", "failed", "excess"), zip(*motions, strict=True), strict=True):
            out[f"{name}|{key}"] = np.array(values)
    np.savez(answer, **out)
