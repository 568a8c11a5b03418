"""Robot, frame and recordings for learning: joints that are not recorded are locked if the task does not need them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from manip_learn.commands.robot_loading import PLAIN, load_for_files
from manip_learn.commands.robot_options import RobotOptions
from manip_learn.errors import ManipLearnError, RecordingError, UnknownNameError
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.load_demonstrations import ReadOptions
from manip_learn.recordings.recording_source import RecordingSource
from manip_learn.robot import Robot
from manip_learn.robot.tips import distance_to_last_joint, likely_tips

Read = TypeVar("Read")
SHOWN = 6  # likely tips


def choose_frame(robot: Robot, frame: str | None) -> str:
    """The frame that was named, checked; or the only likely tip.

    Raises:
        UnknownNameError: No such frame.
        ManipLearnError: None was named and there is more than one candidate.
    """
    tips = likely_tips(robot)
    if frame is None and len(tips) == 1:
        return tips[0]
    if frame in robot.frame_names:
        return robot.frame(frame).name
    shown = ", ".join(f"{tip} ({distance_to_last_joint(robot, tip):.3g} m from its last joint)" for tip in tips[:SHOWN])
    shown = f"likely tips: {shown or 'none'}; `manip-learn inspect` lists all frames"
    if frame is not None:
        raise UnknownNameError("frame", frame, robot.frame_names, f"robot {robot.name!r}", f"; {shown}")
    raise ManipLearnError(
        f"which frame of {robot.name!r} was guided? Name it, e.g. --frame {tips[0] if tips else 'NAME'}; {shown}",
        code="frame",
    )


def load_for_recordings(
    name: str,
    recordings: Sequence[str],
    frame: str | None,
    robot_options: RobotOptions = PLAIN,
    options: ReadOptions | None = None,
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

    return _locking(name, recordings, frame, robot_options, relative_to, loaded)


def source_for_recordings(
    name: str,
    recordings: Sequence[str],
    frame: str | None,
    robot_options: RobotOptions = PLAIN,
    options: ReadOptions | None = None,
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

    return _locking(name, recordings, frame, robot_options, relative_to, opened)


def _locking(
    name: str,
    recordings: Sequence[str],
    frame: str | None,
    robot_options: RobotOptions,
    relative_to: str | None,
    read: Callable[[Robot], Read],
) -> tuple[Robot, Read, str, list[str]]:
    """Robot, what was read for it, frame and notes, with the joints locked for which nothing is recorded."""
    robot = load_for_files(name, recordings, robot_options)
    held: dict[str, float | None] = {**dict.fromkeys(robot_options.locked), **robot.locked}
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
            robot = robot_options.load(name, held, robot.objects)
            notes.append(
                f"joint {joint!r} is not recorded and does not move {' or '.join(map(repr, frames))}: it was locked"
            )
