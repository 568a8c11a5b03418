"""Loads cases in a process of its own: one JSON line `{"case", "verdict", "megabytes"}` each.

`python tests/urdf_corpus_child.py FOLDER FIRST LAST` takes cases FIRST ... LAST - 1 of the corpus. An alarm ends a case
that hangs, and the process with it.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import numpy as np
from peak_memory import peak_megabytes
from urdf_corpus import corpus
from urdf_corpus_case import Case

from manip_learn.errors import ManipLearnError, RobotError, UnknownNameError
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.meshes import find_mesh, mesh_roots, read_meshes
from manip_learn.robot.visuals.visual_shapes import MeshElement, visual_elements, visual_shapes

SECONDS = 30  # a hang, not a measurement: a neighbour may have the processor


def verdict(case: Case, folder: Path) -> str:
    """What became of a case; its answers are used, so that a robot that only looks loaded is found out."""
    try:
        robot = load_robot(case.write(folder), **case.options)
    except UnknownNameError as error:
        return f"refuse:unknown-{error.kind}"
    except RobotError as error:
        return f"refuse:{error.code}" if str(error) and "\n" not in str(error) else f"no sentence: {error}"
    use(robot)
    if case.category.startswith("mesh"):
        return mesh_verdict(robot)
    return "warn" if robot.warnings else "accept"


def use(robot: Robot) -> None:
    """Evaluate the last frame at a random posture."""
    q = robot.random_configuration(np.random.default_rng(0))
    frame = robot.frame(robot.frame_names[-1])
    if not np.isfinite(robot.pose(q, frame)).all() or not np.isfinite(robot.jacobian(q, frame)).all():
        raise ArithmeticError(f"{robot.name} has poses that are not finite")
    if robot.jacobian(q, frame).shape != (6, robot.nv):
        raise ArithmeticError(f"{robot.name} has a Jacobian of the wrong shape")


def mesh_verdict(robot: Robot) -> str:
    """Whether its mesh is drawn, or the code that says why not."""
    stand_ins = [v.stand_in for v in visual_shapes(robot) if v.stand_in]
    if not stand_ins:
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


def main() -> None:
    """Run a slice of the corpus."""
    root, first, last = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    os.environ.pop("ROS_PACKAGE_PATH", None)
    os.environ.pop("AMENT_PREFIX_PATH", None)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    for index, case in enumerate(corpus()[first:last], start=first):
        folder = root / str(index)
        folder.mkdir()
        signal.alarm(SECONDS)
        try:
            answer = verdict(case, folder)
        except (ManipLearnError, ArithmeticError, ValueError, TypeError, KeyError, OSError, RuntimeError) as error:
            answer = f"{type(error).__name__}: {error}"
        signal.alarm(0)
        megabytes = peak_megabytes()
        print(json.dumps({"case": index, "verdict": answer, "megabytes": megabytes}), flush=True)


if __name__ == "__main__":
    main()
