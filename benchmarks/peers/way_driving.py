"""Run a peer's controller along the ways of `when_it_helps.py`: poses in time, the same for all peers.

Runs in the environment of each peer, so it needs NumPy and the standard library only. Rows (s, 6) say which part of the
pose is asked for: place and orientation along the axes of the base.
"""

from __future__ import annotations

import importlib.metadata
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from driving import Arm, Step, motion, save

Stepper = Callable[[np.ndarray, np.ndarray], np.ndarray]  # posture, pose wanted at the end of the step -> velocity


class WayCase(NamedTuple):
    """Rows (s, 6), start (nv,), poses (T, 4, 4), share of the error that a step takes back, whether mu has 6 rows."""

    rows: np.ndarray
    start: np.ndarray
    poses: np.ndarray
    gain: float
    whole: bool


def read(path: str) -> tuple[Arm, list[WayCase]]:
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


def drive(package: str, methods: dict[str, Callable[[Arm, WayCase], Stepper]]) -> None:
    """Run every method on every way of the file named first; the answers go to the one named second."""
    arm, cases = read(sys.argv[1])
    out: dict[str, Any] = {"version": np.array(f"{package} {importlib.metadata.version(package)}")}
    for name, make in methods.items():
        save(out, name, [motion(arm, case, clocked(make(arm, case), case.poses)) for case in cases])
    np.savez(sys.argv[2], **out)
