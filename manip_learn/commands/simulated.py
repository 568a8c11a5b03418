"""Start, surroundings and files of a simulated motion."""

from __future__ import annotations

import numpy as np

import manip_learn as ml
from manip_learn.commands.options import ControlOptions, RepeatOptions, vector
from manip_learn.commands.output import Answer
from manip_learn.control.limits import check_inside
from manip_learn.planning.plan import Around


def start_posture(robot: ml.Robot, constraint: ml.Constraint, start: str | None, moves: bool) -> tuple[np.ndarray, str]:
    """Return the start posture; if none was typed, the first that was shown for a motion, and a sentence about it."""
    shown, typed = constraint.provenance.get("postures"), vector("--start", start)
    q0, whence = robot.neutral(), "the robot's neutral posture"
    if typed is not None:
        q0, whence = robot.checked_posture(typed), ""
    elif moves and shown:
        q0, whence = robot.checked_posture(shown[0]), "the first posture in which the task was shown"
    check_inside(robot, robot.positions(q0))
    return q0, f"start: {whence} (another: --start)" if whence else ""


def scene_of(given: str | None, robot: ml.Robot) -> Around:
    """Return what `--scene` names.

    Raises:
        SceneError: The file is none of a scene.
    """
    return "assumed" if given is None else None if given == "none" else ml.Scene.load(given, robot)


def with_rollout(
    answer: Answer, rollout: ml.Rollout, robot: ml.Robot, name: str, options: ControlOptions | RepeatOptions
) -> Answer:
    """Write the rollout and its replay where the options say so, and name the files in the answer."""
    page = None
    if options.html is not None:
        doubts = [*answer.warnings, *answer.notes]
        page = ml.replay(robot, {name: rollout}, options.html, open_browser=False, notes=doubts)
    return answer.with_files(None if options.out is None else rollout.save(options.out), page)
