"""Run a peer's controller on the tasks of `peer_controllers.py`: the part that all of them share.

Runs in the environment of each peer, so it needs NumPy and the standard library only. The arm takes the commands as a
real one would: joint by joint within its velocity limits, and no further than its position limits.
"""

from __future__ import annotations

import importlib.metadata
import json
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

Step = Callable[[np.ndarray], np.ndarray]


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


def read(path: str) -> tuple[Arm, list[Case]]:
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


def drive(package: str, methods: dict[str, Callable[[Arm, Case], Step]]) -> None:
    """Run every method on every case of the file named first; the answers go to the one named second."""
    arm, cases = read(sys.argv[1])
    out: dict[str, Any] = {"version": np.array(f"{package} {importlib.metadata.version(package)}")}
    for name, make in methods.items():
        runs = [motion(arm, case, make(arm, case)) for case in cases]
        save(out, name, runs)
    np.savez(sys.argv[2], **out)


def save(out: dict[str, Any], name: str, runs: list[tuple[np.ndarray, np.ndarray, float, int]]) -> None:
    """Add the motions of one method to what is written."""
    out[f"{name}|q"] = np.array([r[0] for r in runs])
    out[f"{name}|u"] = np.array([r[1] for r in runs])
    out[f"{name}|seconds"] = np.array([r[2] for r in runs])
    out[f"{name}|failed"] = np.array([r[3] for r in runs])
