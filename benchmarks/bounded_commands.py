"""The two solvers of the bounded command side by side: reach, deviation from the line, and time.

    python benchmarks/bounded_commands.py [--tasks 12] [--out FILE.md]

Both run the same tasks; their times are CPU times of the same quadratic programs (of the steps at
limits), taken in turn.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import numpy as np
from controller_cases import ROBOTS, inside

import manip_learn as ml
from manip_learn.control.bounded_velocity import project_by_active_set, project_by_daqp

PERIOD, DURATION = 0.005, 6.0  # [s]
ROUNDS = 3


def deviation(path: np.ndarray, target: np.ndarray) -> float:
    """Largest distance of a path (T, s) from the straight line between its start and the target [m]."""
    along = (target - path[0]) / np.linalg.norm(target - path[0])
    away = path - path[0]
    return float(np.max(np.linalg.norm(away - np.outer(away @ along, along), axis=1)))


def compare(name: str, tasks: int) -> list[str]:
    """One line of the table: both solvers on the tasks of a robot."""
    tip, locked = ROBOTS[name]
    robot = ml.load_robot(name, locked=locked)
    features, rng = ml.FrameJacobian(robot, tip), np.random.default_rng([23, sorted(ROBOTS).index(name)])
    reached, deviations = {"active-set": 0, "qp": 0}, {"active-set": [], "qp": []}
    difference, problems = 0.0, []
    for _ in range(tasks):
        rows = np.linalg.qr(rng.normal(size=(3, 3)))[0][: int(rng.integers(1, 4))]
        constraint = ml.Constraint(rows, features)
        start, goal = inside(robot, rng), features.coordinates(inside(robot, rng))
        paths = []
        for solver in ("active-set", "qp"):
            law = ml.ResolvedRateController(
                constraint, ml.PointAttractor(goal, 2.0), ml.ManipulabilityAscent(constraint), solver=solver
            )
            if solver == "active-set":
                law._project = lambda *problem: problems.append(problem) or project_by_active_set(*problem)
            rollout = ml.simulate(robot, law, start, DURATION, PERIOD)
            reached[solver] += rollout.task_error[-1] < 0.01
            points = np.array([features.coordinates(q) for q in rollout.q[::5]]) @ rows.T
            deviations[solver].append(1e3 * deviation(points, rows @ goal))
            paths.append(rollout.q)
        difference = max(difference, float(np.max(np.abs(paths[0] - paths[1]))))
    ratios = []
    for _ in range(ROUNDS):
        spent = []
        for solve in (project_by_active_set, project_by_daqp):
            began = time.process_time()
            for problem in problems:
                solve(*problem)
            spent.append(time.process_time() - began)
        ratios.append(spent[1] / spent[0])
    return [
        name,
        f"{reached['active-set']} / {reached['qp']} of {tasks}",
        f"{statistics.median(deviations['active-set']):.2f} / {statistics.median(deviations['qp']):.2f}",
        f"{difference:.1e}",
        f"{len(problems)}",
        f"{statistics.median(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f})",
    ]


def main() -> None:
    """Print the table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", type=int, default=12, help="per robot")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    head = ["robot", "reached, active set / DAQP", "median deviation [mm]", "largest difference of postures [rad]"]
    head += ["programs", "time of DAQP / active set"]
    lines = [head, ["---"] * len(head), *(compare(name, arguments.tasks) for name in ROBOTS)]
    text = "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + "\n"
    print(text)
    if arguments.out is not None:
        arguments.out.write_text(text)


if __name__ == "__main__":
    main()
