"""The robot for given files: joints that are not in the files are locked if the task does not depend on them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from manip_learn.errors import DAMAGE, ConstraintMismatchError, ManipLearnError, RecordingError, UnknownNameError
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.load_demonstrations import ReadOptions
from manip_learn.recordings.readers.recording_files import recording_files
from manip_learn.recordings.readers.saved_reader import file_header
from manip_learn.recordings.recording_source import RecordingSource
from manip_learn.recordings.saved_motion import FileHeader
from manip_learn.recordings.validation.joint_matching import unmoved_joint_names
from manip_learn.robot import Robot, load_robot
from manip_learn.robot.tips import likely_tips

Read = TypeVar("Read")


def choose_frame(robot: Robot, frame: str | None) -> str:
    """The frame that was named, checked; or the only likely tip.

    Raises:
        UnknownNameError: No such frame.
        ManipLearnError: None was named and there is more than one candidate.
    """
    if frame is not None:
        return robot.frame(frame).name
    tips = likely_tips(robot)
    if len(tips) == 1:
        return tips[0]
    raise ManipLearnError(
        f"which frame of {robot.name!r} was guided? Name it with --frame; likely ones: "
        f"{', '.join(tips) or 'none'} (`manip-learn inspect {robot.name}` lists all)"
    )


def load_for_recordings(
    name: str,
    recordings: Sequence[str],
    frame: str | None,
    locked: Sequence[str] = (),
    package_dirs: Sequence[str] = (),
    options: ReadOptions | None = None,
    objects: Sequence[str] = (),
    relative_to: str | None = None,
) -> tuple[Robot, Demonstrations, str, list[str]]:
    """Robot, demonstrations, frame, and notes on joints that were locked because nothing is recorded for them.

    A joint is locked automatically only if it does not move the frame: then it cannot matter to the constraint
    (the fingers of a gripper, the other arm).

    Raises:
        ManipLearnError: Any of the errors of loading robots and recordings.
    """

    def loaded(robot: Robot) -> Demonstrations:
        return load_demonstrations(recordings, robot, **(options or {}))

    return _locking(name, recordings, frame, locked, package_dirs, objects, relative_to, loaded)


def source_for_recordings(
    name: str,
    recordings: Sequence[str],
    frame: str | None,
    locked: Sequence[str] = (),
    package_dirs: Sequence[str] = (),
    options: ReadOptions | None = None,
    objects: Sequence[str] = (),
    relative_to: str | None = None,
) -> tuple[Robot, RecordingSource, str, list[str]]:
    """As `load_for_recordings`, for recordings larger than memory: the first is read, and joints locked by what it has.

    Raises:
        ManipLearnError: Any of the errors of loading robots and recordings.
    """

    def opened(robot: Robot) -> RecordingSource:
        source = RecordingSource(recordings, robot, **(options or {}))
        next(source.part(0))
        return source

    return _locking(name, recordings, frame, locked, package_dirs, objects, relative_to, opened)


def _locking(
    name: str,
    recordings: Sequence[str],
    frame: str | None,
    locked: Sequence[str],
    package_dirs: Sequence[str],
    objects: Sequence[str],
    relative_to: str | None,
    read: Callable[[Robot], Read],
) -> tuple[Robot, Read, str, list[str]]:
    """Robot, what was read for it, frame and notes, with the joints locked for which nothing is recorded."""
    robot = load_for_files(name, recordings, locked, package_dirs, objects)
    held: dict[str, float | None] = {**dict.fromkeys(locked), **robot.locked}
    chosen = choose_frame(robot, frame)
    frames = [chosen] if relative_to is None else [chosen, robot.frame(relative_to).name]
    notes: list[str] = []
    while True:
        try:
            return robot, read(robot), chosen, notes
        except RecordingError as error:
            joint = error.column
            if (
                error.code != "missing-joint"
                or joint not in robot.joint_names
                or any(robot.moves(joint, f) for f in frames)
            ):
                raise
            held[joint] = None
            robot = load_robot(name, package_dirs, held, objects=robot.objects)
            notes.append(
                f"joint {joint!r} is not recorded and does not move {' or '.join(map(repr, frames))}: it was locked"
            )


def load_for_files(
    name: str,
    files: Sequence[str],
    locked: Sequence[str] = (),
    package_dirs: Sequence[str] = (),
    objects: Sequence[str] = (),
) -> Robot:
    """The robot with the joints locked that were locked when the files were made, where they say so.

    Rollouts and exported recordings do; those of earlier versions name the joints that moved: the others are locked.

    Raises:
        RecordingError: A file of another robot, or other joints or objects than it says; or a damaged one.
        ManipLearnError: Anything that is wrong with the robot.
    """
    header, file = _first_header(files)
    if header is None:
        return load_robot(name, package_dirs, locked, objects=objects)
    made_with = header.robot
    if made_with is None:
        if header.kind == "rollout" and header.schema == 1:
            return load_for_joints(name, header.joint_names, locked, package_dirs, objects)
        return load_robot(name, package_dirs, locked, objects=objects)
    plain = load_robot(name, package_dirs, locked, objects=objects or made_with.objects)
    known = {*plain.joint_names, *plain.locked, *unmoved_joint_names(plain)}
    free = [j for j in locked if j not in made_with.locked]
    if free or not known >= {*made_with.joint_names, *made_with.locked} or plain.objects != made_with.objects:
        made_with.refuse_another(plain, file.name, file)
    robot = load_robot(name, package_dirs, made_with.locked, objects=made_with.objects)
    made_with.refuse_another(robot, file.name, file)
    return robot


def _first_header(files: Sequence[str]) -> tuple[FileHeader | None, Path]:
    """The first header that a file of the library has, of the paths given or the first file in each folder."""
    for file in files:
        path = Path(file)
        if path.is_dir() and file_header(path) is None:
            try:
                inner = recording_files(path)[0][0].path
            except RecordingError:  # reading says what is wrong with the folder
                continue
            path = inner
        header = file_header(path) if path.exists() else None
        if header is not None:
            return header, path
    return None, Path()


def load_for_joints(
    name: str,
    joints: Sequence[str],
    locked: Sequence[str] | Mapping[str, float | None] = (),
    package_dirs: Sequence[str] = (),
    objects: Sequence[str] = (),
) -> Robot:
    """The robot with just these joints moving; its other joints are locked.

    Raises:
        UnknownNameError: The robot lacks one of the joints.
    """
    robot = load_robot(name, package_dirs, locked, objects=objects)
    if tuple(robot.joint_names) == tuple(joints):
        return robot
    for joint in joints:
        if joint not in robot.joint_names:
            raise UnknownNameError("joint", joint, robot.joint_names, f"robot {robot.name!r}")
    others = [j for j in robot.joint_names if j not in joints]
    if isinstance(locked, Mapping):
        return load_robot(name, package_dirs, {**locked, **dict.fromkeys(others, None)}, objects=objects)
    return load_robot(name, package_dirs, [*locked, *others], objects=objects)


def robot_of_constraint(
    robot_name: str, constraint_file: str, package_dirs: list[str], objects: Sequence[str] | None = None
) -> Robot:
    """The robot with the joints locked that were locked when the constraint was learnt, and with the same objects.

    Raises:
        ConstraintMismatchError: The constraint was learnt on another robot.
    """
    try:
        described = json.loads(Path(constraint_file).read_bytes()).get("robot") or {}
        joints, locked = list(described["joint_names"]), dict(described.get("locked", {}))
        saved = [str(name) for name in described.get("objects", [])]
    except DAMAGE:
        # Constraint.load says what is wrong with the file
        return load_robot(robot_name, package_dirs, objects=objects or ())
    if objects and sorted(objects) != sorted(saved):
        raise ConstraintMismatchError(
            f"{constraint_file} was learnt with {_listed(saved)}, --object names {_listed(objects)}: leave "
            "--object out, the file knows"
        )
    try:
        return load_for_joints(robot_name, joints, locked, package_dirs, saved)
    except UnknownNameError as error:
        if error.kind != "joint":
            raise
        raise ConstraintMismatchError(
            f"{constraint_file} was made for robot {described.get('name')!r} with the joints "
            f"{', '.join(map(str, joints))}, {robot_name!r} lacks {error.name!r}: name the robot that it was learnt on"
        ) from error


def _listed(objects: Sequence[str]) -> str:
    return f"object(s) {', '.join(map(repr, objects))}" if objects else "no object"
