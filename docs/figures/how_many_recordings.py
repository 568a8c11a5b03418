"""Learn the shipped drawer from fewer and worse recordings: `python docs/figures/how_many_recordings.py`.

Writes how_many_recordings.csv beside it, in half a minute. The drawer moves along (cos 25, sin 25, 0) degrees.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import manip_learn as ml

TRUE = np.array([np.cos(np.deg2rad(25.0)), np.sin(np.deg2rad(25.0)), 0.0])
HEADER = ("recordings", "gap", "unexplained", "stated [deg]", "error [deg]", "warnings")


def cases(demos: list[ml.Trajectory]) -> Iterator[tuple[str, list[ml.Trajectory]]]:
    """What is learnt from, in words and as recordings."""
    rng, eight = np.random.default_rng(0), demos[:8]

    def changed(t: ml.Trajectory, every: int = 1, noise: float = 0.0) -> ml.Trajectory:
        q = t.q[::every] + noise * rng.normal(size=t.q[::every].shape)
        return ml.Trajectory(t.time[::every], q, None, t.joint_names, t.name)

    yield from ((str(n), demos[:n]) for n in (1, 2, 3, 5, 8, 50))
    for rate, every in ((50, 2), (20, 5), (10, 10), (5, 20)):
        yield f"8, at {rate} Hz" + " in place of 100" * (rate == 50), [changed(t, every) for t in eight]
    for noise in (1e-3, 1e-2):
        yield f"8, {noise:.0e} rad of noise added to each position", [changed(t, noise=noise) for t in eight]
    for seconds in (1.0, 0.5, 0.3):
        yield f"8, the first {seconds:g} s of each", [t[t.time[0] : t.time[0] + seconds] for t in eight]


def main() -> None:
    """Write the table."""
    robot = ml.load_robot("sawyer")
    features = ml.FrameJacobian(robot, frame="right_gripper_tip")
    with Path(__file__).with_suffix(".csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(HEADER)
        for name, demos in cases(list(ml.load_demonstrations("sawyer_drawer", robot))):
            try:
                learner = ml.ConstraintLearner(features).fit(demos)
            except ml.ManipLearnError:
                table.writerow([name, *["refused"] * 5])
                continue
            report, free = learner.report_, np.linalg.svd(learner.constraint_.selection)[2][-1]
            stated = report.uncertainty_deg
            error = np.rad2deg(np.arcsin(np.linalg.norm(np.cross(free, TRUE))))
            left = 100.0 * report.held_out_residual
            unexplained = f"{left:.2g} %" if np.isfinite(left) else ""
            words = [f"{report.gap:.3g}", unexplained, "" if stated is None else f"{stated:.2g}", f"{error:.2g}"]
            table.writerow([name, *words, len(report.warnings)])


if __name__ == "__main__":
    main()
