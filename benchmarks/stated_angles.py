"""How often the true rows lie within the stated 68 % angle: by recordings, sampling rate and encoder noise.

    python benchmarks/stated_angles.py --first-seed 52000 --sets 40

Contacts only (`make_recordings`, exact), brought to each rate by a cubic spline, noise added after; velocities are
derived from the positions by the library. Rows of x, y, z in base axes, their number given: both rows of a drawer, the
row along a door's axis. Set i has the seed first + i, and the robots take turns. In each cell: the share of sets in
which the true angle is inside the stated one; medians of the true and the stated angle [deg]; sets that are too wide.
"""

from __future__ import annotations

import argparse
import functools
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from make_recordings import kinematic_sets
from make_recordings.arms import ROBOTS, load_arm

import manip_learn as ml
from manip_learn.learning.report import NOISE
from manip_learn.recordings.trajectory import Demonstrations, Trajectory

ROWS = {"drawer": 2, "table": 1, "door": 1}
NUMBERS = (5, 10, 30)
NOISES = (1e-4, 1e-3)  # [rad]
RATES = (50.0, 100.0, 250.0, 500.0)  # [Hz]
WIDE = 3.0  # times the angle of the noise: too wide where there is nothing but noise


@functools.lru_cache(maxsize=4)
def made(kind: str, robot: str, seed: int) -> tuple[list[Any], dict[str, Any]]:
    """Exact contacts of one set and their truth."""
    return kinematic_sets.make_set(kind, robot, seed, max(NUMBERS), 0.0, False)


def recorded(kind: str, seed: int, rate: float, noise: float, n: int) -> tuple[Any, Demonstrations, np.ndarray]:
    """Features, recordings at a rate [Hz] with noise [rad], and the true rows."""
    robot = ROBOTS[seed % len(ROBOTS)]
    arm, (motions, truth) = load_arm(robot), made(kind, robot, seed)
    rng, out = np.random.default_rng([seed, round(rate), round(noise * 1e6)]), []
    for i, (t, q) in enumerate(motions[:n]):
        time = np.arange(t[0], t[-1] + 1e-9, 1.0 / rate)
        x = CubicSpline(t, q)(time)
        out.append(Trajectory(time, x + rng.normal(0.0, noise, x.shape), None, arm.robot.joint_names, f"demo_{i}"))
    features = ml.FrameJacobian(arm.robot, arm.tip, "xyz", "world")
    rows = np.array(truth["mechanisms"][0]["rows"])[:, :3]
    return features, Demonstrations(out), rows


def angles(kind: str, seed: int, rate: float, noise: float, n: int) -> tuple[float, float, float]:
    """True and stated angle of one set, and the part of the noise in it [deg]."""
    features, demos, true = recorded(kind, seed, rate, noise, n)
    learner = ml.ConstraintLearner(features, ROWS[kind], "null-space", phases="off", joint_offset_std=0.0, seed=seed)
    report = learner.fit(demos).report_
    learnt = learner.constraint_.selection.T
    sine = np.linalg.norm(learnt - true.T @ (true @ learnt), 2)
    stated, scatter = report.uncertainty_deg or 0.0, report.uncertainty[NOISE] or 0.0
    return float(np.degrees(np.arcsin(min(sine, 1.0)))), stated, scatter


def cell(found: np.ndarray) -> str:
    """Share inside, sets stated too wide, and medians of what is true and stated [deg]."""
    error, stated, scatter = found.T
    wide = int(np.count_nonzero(stated > WIDE * scatter))
    text = f"{100.0 * np.mean(error <= stated):.0f} % ({np.median(error):.2g}, {np.median(stated):.2g})"
    return text + (f", {wide} wide" if wide else "")


def main(arguments: list[str] | None = None) -> None:
    """Measure, and write one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=40)
    parser.add_argument("--first-seed", type=int, default=52000)
    parser.add_argument("--kinds", nargs="+", choices=ROWS, default=["drawer", "door"])
    parser.add_argument("--rates", nargs="+", type=float, default=RATES)
    parser.add_argument("--noises", nargs="+", type=float, default=NOISES)
    parser.add_argument("--numbers", nargs="+", type=int, default=NUMBERS)
    given = parser.parse_args(arguments)
    print("| kind | noise rad | rate Hz | " + " | ".join(f"{n} recordings" for n in given.numbers) + " |")
    print("|---" * (3 + len(given.numbers)) + "|", flush=True)
    for kind in given.kinds:
        for noise in given.noises:
            for rate in given.rates:
                seeds = range(given.first_seed, given.first_seed + given.sets)
                found = [np.array([angles(kind, s, rate, noise, n) for s in seeds]) for n in given.numbers]
                print(f"| {kind} | {noise:g} | {rate:g} | " + " | ".join(map(cell, found)) + " |", flush=True)


if __name__ == "__main__":
    main()
