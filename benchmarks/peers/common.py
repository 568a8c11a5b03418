"""What all candidates share: the arm, its postures, the target, and how the answer is printed.

Runs in the environment of each peer, so it needs NumPy and the standard library only.
"""

from __future__ import annotations

import importlib.metadata
import json
import sys
from collections.abc import Callable
from itertools import cycle
from pathlib import Path

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
