"""Two publishers on one topic, seen from the samples alone: found in any order of arrival, never where there is one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from case import case
from jaxtyping import Float

from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.readers.csv_reader import sniff_dialect
from manip_learn.recordings.validation.motion_checks import alternation
from manip_learn.robot import Robot

RECORDINGS = sorted(Path(__file__).parents[1].glob("examples/data/**/*.csv"))
TURNS = ("strict", "phase", "rate", "random")


def motion(rng: np.random.Generator, n_samples: int, nv: int, dt: float, speed: float) -> Float[np.ndarray, "T nv"]:
    """A smooth motion of some joints; the others stand still."""
    time = np.arange(n_samples)[:, None] * dt
    parts = [
        rng.uniform(0, speed, nv) * np.sin(2 * np.pi * rng.uniform(0.05, 0.5, nv) * time + rng.uniform(0, 6.3, nv))
        for _ in range(3)
    ]
    return sum(parts) * (rng.random(nv) < 0.8)


def turns(rng: np.random.Generator, n_samples: int, kind: str) -> np.ndarray:
    """Who sent each sample, 0 or 1."""
    if kind == "strict":
        return np.arange(n_samples) % 2
    if kind == "random":
        return (rng.random(n_samples) < rng.uniform(0.2, 0.8)).astype(int)
    ratio = rng.uniform(0.2, 1.0) if kind == "rate" else rng.uniform(0.95, 1.05)
    one = np.arange(n_samples) + 0.05 * rng.standard_normal(n_samples)
    two = (np.arange(int(n_samples * ratio)) + rng.random()) / ratio
    order = np.argsort(np.concatenate([one, two]), kind="stable")
    return np.repeat([0, 1], [len(one), len(two)])[order][:n_samples]


def test_interleaved_motions_are_found(rng: np.random.Generator) -> None:
    """A moving robot and a GUI that stands elsewhere: at least 19 of 20 are found, however they take turns."""
    for kind in TURNS:
        found = 0
        for _ in range(40):
            n, nv, dt = int(rng.integers(60, 1200)), int(rng.integers(2, 8)), float(rng.choice([0.002, 0.01, 0.02]))
            robot = motion(rng, n, nv, dt, 0.5) + 1e-4 * rng.standard_normal((n, nv))
            gui = np.broadcast_to(rng.choice([-1, 1], nv) * rng.uniform(0.6, 1.5, nv), (n, nv))
            found += alternation(np.where(turns(rng, n, kind)[:, None] == 1, gui, robot))[0].size > 0
        assert found >= 38, kind
    q = motion(rng, 2_000, 4, 0.01, 0.5)
    q[800:1000:2] += 0.8  # in a part of a recording
    assert 795 <= alternation(q)[0][0] <= 805


def test_noise_and_coarse_encoders_are_no_second_publisher(rng: np.random.Generator) -> None:
    """White and heavy-tailed noise up to 0.03 rad, quanta up to 0.02 rad that flicker, at rest and in motion: none."""
    for _ in range(120):
        n, nv, dt = int(rng.integers(40, 1200)), int(rng.integers(1, 8)), float(rng.choice([0.001, 0.01, 0.05]))
        q = motion(rng, n, nv, dt, float(rng.choice([0.0, 0.01, 0.3, 1.0])))
        size = 10 ** rng.uniform(-6, -1.7)
        noisy = (
            q + 1.5 * size * rng.standard_normal(q.shape),
            q + size * rng.standard_t(2, q.shape),
            np.round(q / size) * size,
            np.round((q + 0.3 * size * rng.standard_normal(q.shape)) / size) * size,
            np.round((q + size * (np.arange(n) % 2)[:, None]) / size) * size,
        )
        assert not any(alternation(x)[0].size for x in noisy)


def test_no_recording_of_the_examples_is_suspected(rng: np.random.Generator) -> None:
    """Neither as recorded, nor with noise of 3e-3 rad, nor thinned to every fifth sample."""
    for path in RECORDINGS[::4]:
        dialect = sniff_dialect(path)
        table = np.loadtxt(path, delimiter=dialect.delimiter, skiprows=dialect.header_line, comments="#", ndmin=2)
        q = table[:, [i for i, n in enumerate(dialect.columns) if n != "time" and not n.endswith("_velocity")]]
        assert not any(alternation(x)[0].size for x in (q, q + 3e-3 * rng.standard_normal(q.shape), q[::5])), path


def test_failed_reads_are_left_out(planar3: Robot, rng: np.random.Generator) -> None:
    """A driver that could not read its motors publishes one posture now and then: said, and the rest is the motion; one
    that is held for long, or is no jump, is a motion.
    """
    for n in (2, 12, 40):
        with case(f"{n} failed reads"):
            q = motion(rng, 1000, 3, 0.01, 0.3) + [0.4, 0.5, 0.6]
            failed = np.sort(rng.choice(998, n, replace=False)) + 1
            told = load_demonstrations(table(q, failed, -1.5), planar3)
            assert (
                told.n_samples == 1000 - n
                and f"{n} failed reads left out (first: line {failed[0] + 2}; " in told.notes[0]
            )
    rested = np.concatenate([q[:300], np.repeat(q[300:301], 200, axis=0), q[301:801]])
    kept = load_demonstrations(table(rested, np.empty(0, dtype=int), 0.0), planar3)
    assert kept.n_samples == 1000 and kept.notes == ()


def table(q: np.ndarray, at: np.ndarray, posture: float | np.ndarray) -> pd.DataFrame:
    """Positions of three joints, of which some samples show a posture."""
    shown = q.copy()
    shown[at] = posture
    columns = {f"joint{j + 1}": shown[:, j] for j in range(3)}
    return pd.DataFrame({"time": 0.01 * np.arange(len(q)), **columns})
