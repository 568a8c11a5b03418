"""Loading of a command's robot, with the locked joints of the files that it reads, and choice of the guided frame."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import manip_learn as ml
from manip_learn.commands.command_line import input_files
from manip_learn.commands.options import RobotOptions
from manip_learn.constraint.constraint import locks_in_words, read_constraint_file
from manip_learn.errors import DAMAGE, ConstraintMismatchError, UnknownNameError, named
from manip_learn.recordings.options import unmoved_joint_names
from manip_learn.recordings.saved_motion import file_header
from manip_learn.robot.identity import RobotIdentity
from manip_learn.robot.tips import distance_to_last_joint


def load_for_files(name: str, files: Sequence[str], loading: RobotOptions) -> ml.Robot:
    """Load a robot, and lock the joints that were locked when the files were written.

    Rollouts and exported recordings state their locked joints. Other files have no effect.

    Args:
        name: Name of the robot or its file.
        files: Arguments that name files or folders.
        loading: Options for loading.

    Returns:
        The robot.
    """
    paths = (path for text in files for path in islice(input_files(text), 2))  # a folder, and its first file
    header, file = next(((header, path) for path in paths if (header := file_header(path)) is not None), (None, Path()))
    if header is None or header.robot is None:
        return loading.load(name)
    made_with = header.robot
    robot = loading.load(name, objects=loading.objects or made_with.objects)
    names = {*robot.joint_names, *robot.locked, *unmoved_joint_names(robot)}
    as_made = names >= {*made_with.joint_names, *made_with.locked} and robot.objects == made_with.objects
    if as_made and made_with.locked.keys() >= set(loading.lock or ()):
        robot = loading.load(name, made_with.locked, made_with.objects)
    made_with.refuse_another(robot, file.name, file)
    return robot


def locked_joint_notes(robot: ml.Robot, loading: RobotOptions) -> list[str]:
    """Return a note on joints that are locked because the files state it; an empty list if there are none.

    Args:
        robot: The robot.
        loading: Options for loading.
    """
    locked = {name: position for name, position in robot.locked.items() if name not in (loading.lock or ())}
    return [f"as when it was made: {locks_in_words(locked)}"] if locked else []


def with_joints(robot: ml.Robot, joints: Sequence[str], name: str, loading: RobotOptions) -> ml.Robot:
    """Return a robot in which only the given joints move, and all others are locked.

    Args:
        robot: Loaded robot.
        joints: Names of the joints that move.
        name: Name of the robot or its file.
        loading: Options for loading.

    Raises:
        UnknownNameError: The robot lacks one of the joints.
    """
    moving = {robot.joint_index(joint) for joint in joints}
    others = [joint for i, joint in enumerate(robot.joint_names) if i not in moving]
    return loading.load(name, {**robot.locked, **dict.fromkeys(others)}, robot.objects) if others else robot


def robot_of_constraint(robot_name: str, constraint_file: str, loading: RobotOptions) -> ml.Robot:
    """Load a robot with the locked joints and the objects with which a constraint was learnt.

    Args:
        robot_name: Name of the robot or its file.
        constraint_file: Constraint file.
        loading: Options for loading.

    Returns:
        Robot with the joints of the constraint.

    Raises:
        ConstraintMismatchError: The constraint was learnt on another robot, or with other locked joints or objects than
            the options state.
    """
    try:
        made_with = RobotIdentity.from_dict(read_constraint_file(Path(constraint_file))["robot"])
    except (*DAMAGE, ConstraintMismatchError):
        # Constraint.load raises the error for this file
        return loading.load(robot_name)
    joints, saved, locks = made_with.joint_names, made_with.objects, loading.lock or ()
    wrong = [f"joint {joint!r} moving, --lock would hold it still" for joint in locks if joint in joints]
    if loading.objects and sorted(loading.objects) != sorted(saved):
        had, typed = (named("object", map(repr, names)) if names else "no object" for names in (saved, loading.objects))
        wrong.insert(0, f"{had}, --object names {typed}")
    if wrong:
        remedy_locks = "leave --object and --lock out, the file knows which objects it saw and which joints were locked"
        raise ConstraintMismatchError(f"{constraint_file} was learnt with {wrong[0]}: {remedy_locks}")
    try:
        return with_joints(loading.load(robot_name, made_with.locked, saved), joints, robot_name, loading)
    except UnknownNameError as error:
        if error.kind != "joint":
            raise
        origin = f"{constraint_file} was made for robot {made_with.name!r} with the joints {', '.join(joints)}"
        remedy = "name the robot that it was learnt on"
        raise ConstraintMismatchError(f"{origin}, {robot_name!r} lacks {error.name!r}: {remedy}") from error


def load_constraint(robot_name: str, constraint_file: str, loading: RobotOptions) -> tuple[ml.Constraint, ml.Robot]:
    """Load a constraint from a file, and its robot; errors as in `robot_of_constraint` and `Constraint.load`.

    Args:
        robot_name: Name of the robot or its file.
        constraint_file: Constraint file.
        loading: Options for loading.

    Returns:
        Constraint and robot.
    """
    robot = robot_of_constraint(robot_name, constraint_file, loading)
    return ml.Constraint.load(constraint_file, robot), robot


def choose_frame(robot: ml.Robot, frame: str | None) -> str:
    """Choose the frame that was guided by hand: the named one, or the only likely tip.

    Args:
        robot: The robot.
        frame: Name of the frame; None for the only likely tip.

    Returns:
        Name of the frame.

    Raises:
        UnknownNameError: There is no such frame.
        ManipLearnError: No frame is named and there is not exactly one candidate.
    """
    tips = ml.likely_tips(robot)
    if frame is None and len(tips) == 1:
        return tips[0]
    if frame in robot.frame_names:
        return robot.frame(frame).name
    candidates = [f"{tip} ({distance_to_last_joint(robot, tip):.3g} m from its last joint)" for tip in tips[:6]]
    likely = f"likely tips: {', '.join(candidates) or 'none'}; `manip-learn inspect` lists all frames"
    if frame is not None:
        raise UnknownNameError("frame", frame, robot.frame_names, f"robot {robot.name!r}", f"; {likely}")
    flag = f"--frame {tips[0] if tips else 'NAME'}"
    raise ml.ManipLearnError(f"which frame of {robot.name!r} was guided? Name it, e.g. {flag}; {likely}", code="frame")
