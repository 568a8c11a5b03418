"""Start posture, scene and output files of a simulated motion."""

from __future__ import annotations

import numpy as np

import manip_learn as ml
from manip_learn.commands.options import ControlOptions, RepeatOptions, vector
from manip_learn.commands.output import Answer
from manip_learn.control.limits import check_inside
from manip_learn.planning.plan import Around


def start_posture(robot: ml.Robot, constraint: ml.Constraint, start: str | None, moves: bool) -> tuple[np.ndarray, str]:
    """Return the start configuration, and a sentence about it.

    Args:
        robot: The robot.
        constraint: Constraint with the demonstrated postures.
        start: Posture as the user typed it, numbers with commas or spaces between them; None for the first demonstrated
            one.
        moves: False to use the neutral posture instead of the demonstrated one.

    Returns:
        Configuration (nq,), or joint positions (nv,) if the user typed them [rad or m]; and a sentence, empty if the
        user typed the posture.
    """
    demonstrated, typed = constraint.provenance.get("postures"), vector("--start", start)
    q0, whence = robot.neutral(), "the robot's neutral posture"
    if typed is not None:
        q0, whence = robot.checked_posture(typed), ""
    elif moves and demonstrated:
        q0, whence = robot.checked_posture(demonstrated[0]), "the first demonstrated configuration"
    check_inside(robot, robot.positions(q0))
    return q0, f"start: {whence} (another: --start)" if whence else ""


def load_scene(given: str | None, robot: ml.Robot) -> Around:
    """Return the scene that `--scene` names.

    Args:
        given: File of a scene; `"none"` for no obstacles; None to assume a floor.
        robot: The robot.

    Raises:
        SceneError: The file does not contain a scene.
    """
    return "assumed" if given is None else None if given == "none" else ml.Scene.load(given, robot)


def write_rollout(
    answer: Answer, rollout: ml.Rollout, robot: ml.Robot, name: str, options: ControlOptions | RepeatOptions
) -> Answer:
    """Write the rollout and its replay if the options name files, and return the answer with their names.

    Args:
        answer: Answer to extend.
        rollout: The motion.
        robot: The robot.
        name: Name of the motion in the replay.
        options: Options with the names of the files.

    Returns:
        Answer with the names of the files.
    """
    page = None
    if options.html is not None:
        doubts = [*answer.warnings, *answer.notes]
        page = ml.replay(robot, {name: rollout}, options.html, open_browser=False, notes=doubts)
    return answer.with_files(None if options.out is None else rollout.save(options.out), page)
