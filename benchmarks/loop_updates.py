"""How long one `ServoLoop.update` takes: targets, ways, limits of the hand, irregular time. Processor time of one core.

    python benchmarks/loop_updates.py [--calls 3000] [--out FILE.md]

Every case has its turn in each of five rounds; the figures are the medians over the rounds of the median and of the
slowest hundredth of a round. The measured posture is the commanded one.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import manip_learn as ml

ROUNDS, DT = 5, 0.001
FRAME = "right_gripper_tip"
Case = tuple[Callable[[], ml.ServoLoop], Callable[[], float]]


def cases(robot: ml.Robot, start: np.ndarray) -> dict[str, Case]:
    """Name -> (makes a loop, time from one call to the next [s])."""
    rng = np.random.default_rng(0)
    held = ml.Constraint(np.eye(3), ml.FrameJacobian(robot, FRAME, "x y z"))
    across = ml.Constraint(np.array([[-0.42, 0.91, 0.0], [0.0, 0.0, 1.0]]), ml.FrameJacobian(robot, FRAME, "x y z"))
    place = held.features.coordinates(start)
    box = [[-2.0, -2.0, -2.0], [2.0, 2.0, 2.0]]
    wall = [[-2.0, -2.0, -2.0], [float(place[0]) + 0.05, 2.0, 2.0]]

    def loop(task: Callable[[], ml.Task], **limits: object) -> ml.ServoLoop:
        made, bounds = task(), ml.Limits(robot, **limits)  # type: ignore[arg-type]
        rows = made.constraint if isinstance(made, ml.FreeDirection) else held
        return ml.ServoLoop(ml.ResolvedRateController(rows, made, ml.ManipulabilityAscent(rows), limits=bounds), DT)

    def target() -> ml.Task:
        return ml.PointAttractor(place + [0.15, 0.1, -0.1])

    return {
        "point target": (lambda: loop(target), lambda: DT),
        "moving target (`Track`)": (
            lambda: loop(lambda: ml.Track(lambda t: place + 0.05 * np.sin([t, 2.0 * t, 3.0 * t]))),
            lambda: DT,
        ),
        "way along a drawer": (lambda: loop(lambda: ml.motion(across, distance=0.2)), lambda: DT),
        "hand in a box, not reached": (lambda: loop(target, tip_box=box), lambda: DT),
        "hand at a wall": (lambda: loop(target, tip_box=wall), lambda: DT),
        "hand at its speed limit": (lambda: loop(target, tip_speed=0.02), lambda: DT),
        "calls 1 to 3 ms apart": (lambda: loop(target), lambda: float(rng.uniform(DT, 3.0 * DT))),
        "calls 0.2 to 100 ms apart": (lambda: loop(target), lambda: float(10.0 ** rng.uniform(-3.7, -1.0))),
    }


def measured(case: Case, start: np.ndarray, calls: int) -> tuple[float, float]:
    """Median and slowest hundredth of the calls after the first tenth [us]."""
    make, step = case
    loop, q, now, times = make(), start, 0.0, []
    for _ in range(calls):
        now += step()
        before = time.thread_time()
        loop.update(q, now)
        times.append(time.thread_time() - before)
        q = start if loop.position is None else loop.position
    late = 1e6 * np.array(times[calls // 10 :])
    return float(np.median(late)), float(np.percentile(late, 99))


def main() -> None:
    """Measure, and write one table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--calls", type=int, default=3000)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    logging.getLogger("manip_learn").setLevel(logging.ERROR)  # irregular periods are announced
    robot = ml.load_robot("sawyer")
    start = np.array([0.3, -0.6, 0.1, 1.4, 0.2, 0.8, 0.4])
    every = cases(robot, start)
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in every}
    for _ in range(ROUNDS):
        for name, case in every.items():
            found[name].append(measured(case, start, given.calls))
    lines = ["| Sawyer, position servo, 1 ms | median [us] | slowest hundredth [us] |", "| --- | --- | --- |"]
    for name, rounds in found.items():
        median, late = np.median(rounds, axis=0)
        lines.append(f"| {name} | {median:.0f} | {late:.0f} |")
    print("\n".join(lines))
    if given.out:
        given.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
