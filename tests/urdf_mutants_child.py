"""Loads mutants in a process of its own until the time or the seeds are used up.

`python tests/urdf_mutants_child.py FIRST LAST SECONDS` prints one JSON object at the end. Before each mutant its seed
is written to stdout as a bare number, so that the last number names the mutant that killed the process.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
from peak_memory import peak_megabytes
from urdf_mutants import mutant

from manip_learn.errors import ManipLearnError, RobotError
from manip_learn.robot.loading import robot_from_text
from manip_learn.robot.visuals.visual_shapes import visual_shapes

SECONDS_EACH = 30  # a hang, not a measurement: a neighbour may have the processor


def outcome(content: bytes, rng: np.random.Generator) -> str:
    """`accept`, `warn` or the code of the refusal."""
    try:
        robot = robot_from_text(content, Path("mutant.urdf"))
    except RobotError as error:
        return error.code
    q = robot.random_configuration(rng)
    frame = robot.frame(robot.frame_names[-1])
    numbers = [robot.pose(q, frame), robot.jacobian(q, frame), *robot.jacobian_and_derivative(q, frame)]
    if not all(np.isfinite(x).all() for x in numbers):
        raise ArithmeticError("a loaded robot gives numbers that are not finite")
    visual_shapes(robot, meshes=False)
    return "warn" if robot.warnings else "accept"


def main() -> None:
    """Run the seeds."""
    first, last, seconds = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    rng, end = np.random.default_rng(first), time.monotonic() + seconds
    seen: Counter[str] = Counter()
    faults: list[str] = []
    for seed in range(first, last):
        if time.monotonic() > end:
            break
        sys.stdout.write(f"{seed}\n")
        sys.stdout.flush()
        signal.alarm(SECONDS_EACH)
        try:
            seen[outcome(mutant(seed), rng)] += 1
        except ManipLearnError as error:
            faults.append(f"{seed}: {type(error).__name__} after loading: {error}")
        except (ArithmeticError, ValueError, TypeError, KeyError, IndexError, AttributeError, RuntimeError) as error:
            faults.append(f"{seed}: {type(error).__name__}: {error}")
        signal.alarm(0)
    megabytes = peak_megabytes()
    print(json.dumps({"seen": seen, "faults": faults, "megabytes": megabytes}))


if __name__ == "__main__":
    main()
