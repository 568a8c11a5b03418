"""Loads descriptions in a process of its own; an alarm ends one that hangs, and the process with it.

`urdf_child.py corpus FIRST LAST FOLDER` prints one JSON line `{"case", "verdict", "megabytes"}` for each case of the
corpus; `urdf_child.py mutants FIRST LAST SECONDS` prints the seed of each mutant as a bare number before it is loaded,
so that the last number names the one that killed the process, and one JSON object at the end.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
from peak_memory import peak_megabytes
from urdf_corpus import Case, corpus
from urdf_mutants import mutant

from manip_learn.errors import ManipLearnError, RobotError, UnknownNameError
from manip_learn.robot.loading import load_robot, robot_from_text
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.meshes import find_mesh, mesh_roots, read_meshes
from manip_learn.robot.visuals.visual_shapes import MeshElement, visual_elements, visual_shapes

SECONDS = 30  # a hang, not a measurement: a neighbour may have the processor
FAULTS = (ManipLearnError, ArithmeticError, AttributeError, ValueError, TypeError, LookupError, OSError, RuntimeError)


def use(robot: Robot, rng: np.random.Generator) -> None:
    """Evaluate the last frame at a random posture, so that a robot that only looks loaded is found out."""
    q, frame = robot.random_configuration(rng), robot.frame(robot.frame_names[-1])
    numbers = [robot.pose(q, frame), robot.jacobian(q, frame), *robot.jacobian_and_derivative(q, frame)]
    if not all(np.isfinite(x).all() for x in numbers) or numbers[1].shape != (6, robot.nv):
        raise ArithmeticError(f"{robot.name} has numbers that are not finite, or a Jacobian of the wrong shape")


def verdict(case: Case, folder: Path) -> str:
    """What became of a case."""
    try:
        robot = load_robot(case.write(folder), **case.options)
    except UnknownNameError as error:
        return f"refuse:unknown-{error.kind}"
    except RobotError as error:
        return f"refuse:{error.code}" if str(error) and "\n" not in str(error) else f"no sentence: {error}"
    use(robot, np.random.default_rng(0))
    if not case.category.startswith("mesh"):
        return "warn" if robot.warnings else "accept"
    if not any(v.fault for v in visual_shapes(robot)):
        return "accept"
    element = visual_elements(robot.description or b"", robot.source or Path())[0]
    if not isinstance(element.geometry, MeshElement):
        return "stand-in:not-finite" if "finite" in element.fault else "stand-in:visual"
    try:
        path = find_mesh(element.geometry.uri, mesh_roots(robot.source or Path(), robot.package_dirs))
        result = read_meshes([path])[path]
    except RobotError as error:
        result = error
    return f"stand-in:{result.code}" if isinstance(result, RobotError) else "mesh read, but not drawn"


def run_corpus(first: int, last: int, root: str) -> None:
    """A slice of the corpus."""
    os.environ.pop("ROS_PACKAGE_PATH", None)
    os.environ.pop("AMENT_PREFIX_PATH", None)
    for index, case in enumerate(corpus()[first:last], start=first):
        folder = Path(root) / str(index)
        folder.mkdir()
        signal.alarm(SECONDS)
        try:
            answer = verdict(case, folder)
        except FAULTS as error:
            answer = f"{type(error).__name__}: {error}"
        signal.alarm(0)
        print(json.dumps({"case": index, "verdict": answer, "megabytes": peak_megabytes()}), flush=True)


def run_mutants(first: int, last: int, seconds: str) -> None:
    """Mutants until the time or the seeds are used up: each is `accept`, `warn` or the code of its refusal."""
    rng, end = np.random.default_rng(first), time.monotonic() + float(seconds)
    seen, faults = Counter[str](), []
    for seed in range(first, last):
        if time.monotonic() > end:
            break
        print(seed, flush=True)
        signal.alarm(SECONDS)
        try:
            try:
                robot = robot_from_text(mutant(seed), Path("mutant.urdf"))
            except RobotError as error:
                seen[error.code] += 1
            else:
                use(robot, rng)
                visual_shapes(robot)
                seen["warn" if robot.warnings else "accept"] += 1
        except FAULTS as error:
            faults.append(f"{seed}: {type(error).__name__}: {error}")
        signal.alarm(0)
    print(json.dumps({"seen": seen, "faults": faults, "megabytes": peak_megabytes()}))


def main(arguments: list[str]) -> None:
    """Run what is asked for."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    what, first, last, more = arguments
    (run_corpus if what == "corpus" else run_mutants)(int(first), int(last), more)


if __name__ == "__main__":
    main(sys.argv[1:])
