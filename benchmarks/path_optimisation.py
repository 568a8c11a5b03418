"""What a whole path gains over the greedy law: random oblique tasks, a table with every losing case.

    python benchmarks/path_optimisation.py [--robots sawyer panda] [--tasks 20] [--out FILE.md]

The greedy law is `ManipulabilityAscent` with gain 3. Ratios are of the mean and of the least manipulability over the
horizon, path over greedy. A trapped case is one that the greedy law ends with less than half of the path's mu.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

import manip_learn as ml

ROBOTS = {"sawyer": ("right_hand", ()), "panda": ("panda_hand_tcp", ("panda_finger_joint1",)), "ur5": ("tool0", ())}
DURATION, DT, GAIN = 4.0, 0.01, 3.0


class Case(NamedTuple):
    """One task: how many rows, path over greedy, and what it cost."""

    number: int
    rows: int
    mean: float
    least: float
    last: float
    errors: tuple[float, float]
    seconds: float
    excess: float


def excess_over_limits(robot: ml.Robot, rollout: ml.Rollout) -> float:
    """How far a rollout leaves the position or velocity limits; 0 inside."""
    positions = np.array([robot.positions(q) for q in rollout.q])
    worst = max(
        np.max(positions - robot.position_upper),
        np.max(robot.position_lower - positions),
        np.max(np.abs(rollout.u) - robot.velocity_limit),
    )
    return max(float(worst), 0.0)


def run_case(robot: ml.Robot, tip: str, number: int, rng: np.random.Generator) -> Case:
    """A random start and a random reachable target, in 1 to 3 oblique directions of the tip."""
    rows = 1 + number % 3
    features = ml.FrameJacobian(robot, tip, "xyz")
    constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(3, rows)))[0].T, features)
    start, end = (robot.positions(robot.random_configuration(rng)) for _ in range(2))
    task = ml.PointAttractor(robot.position(end, tip))
    law = ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint, GAIN), dt=DT)
    greedy = ml.simulate(robot, law, start, DURATION, DT)
    began = time.perf_counter()
    path = ml.optimise_path(constraint, task, start, DURATION, DT, gain=GAIN)
    seconds = time.perf_counter() - began
    ours, theirs = path.manipulability, greedy.manipulability
    errors = (float(greedy.task_error[-1]), float(path.task_error[-1]))
    ratios = (ours.mean() / theirs.mean(), ours.min() / max(theirs.min(), 1e-12), ours[-1] / max(theirs[-1], 1e-12))
    return Case(number, rows, *map(float, ratios), errors, seconds, excess_over_limits(robot, path))


def table(results: dict[str, list[Case]]) -> str:
    """Medians with quartiles per robot, then the cases in which the path loses in one of the two ratios."""
    lines = [
        "| robot | cases | mean μ, path over greedy | least μ | gains > 1 % | trapped | median there | seconds |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, cases in results.items():
        trapped = [c for c in cases if c.last > 2.0]
        there = f"{np.median([c.mean for c in trapped]):.2f}" if trapped else "-"
        cells = [spread([c.mean for c in cases]), spread([c.least for c in cases])]
        gains = sum(c.mean > 1.01 for c in cases)
        seconds = spread([c.seconds for c in cases])
        lines.append(
            f"| {name} | {len(cases)} | {' | '.join(cells)} | {gains} | {len(trapped)} | {there} | {seconds} |"
        )
    lines += ["", "Cases with a smaller least or mean μ than the greedy law:", ""]
    lines += [
        "| robot | case | rows | mean μ | least μ | final error, greedy and path [m] |",
        "|---|---|---|---|---|---|",
    ]
    for name, cases in results.items():
        for c in cases:
            if min(c.mean, c.least) < 0.999:
                errors = f"{c.errors[0]:.4f}, {c.errors[1]:.4f}"
                lines.append(f"| {name} | {c.number} | {c.rows} | {c.mean:.2f} | {c.least:.2f} | {errors} |")
    worst = max(c.excess for cases in results.values() for c in cases)
    lines += ["", f"Largest excess over a position or velocity limit: {worst:.1e}."]
    return "\n".join(lines)


def spread(values: list[float]) -> str:
    """Median (smallest, quartiles, largest)."""
    low, q1, middle, q3, high = np.quantile(values, [0.0, 0.25, 0.5, 0.75, 1.0])
    return f"{middle:.2f} ({low:.2f}, {q1:.2f} .. {q3:.2f}, {high:.2f})"


def main() -> None:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", nargs="+", default=["sawyer", "panda"], choices=sorted(ROBOTS))
    parser.add_argument("--tasks", type=int, default=20)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    results: dict[str, list[Case]] = {}
    for name in options.robots:
        tip, locked = ROBOTS[name]
        robot = ml.load_robot(name, locked=locked)
        generators = [np.random.default_rng([7, i]) for i in range(options.tasks)]
        results[name] = [run_case(robot, tip, i, rng) for i, rng in enumerate(generators)]
    text = table(results)
    print(text)
    if options.out is not None:
        options.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
