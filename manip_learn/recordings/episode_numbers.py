"""The numbers under which `episodes=...` selects recordings."""

from __future__ import annotations

from typing import Unpack

from manip_learn.recordings.load_demonstrations import Paths, ReadOptions, open_recordings
from manip_learn.recordings.readers.file_format import LEROBOT
from manip_learn.recordings.readers.lerobot_episodes import episode_numbers
from manip_learn.recordings.readers.recording_files import recording_files
from manip_learn.robot.robot import Robot


def numbers_read(paths: Paths, robot: Robot, **options: Unpack[ReadOptions]) -> tuple[int, ...]:
    """Numbers of the recordings that `load_demonstrations` reads, in its order, counted as `episodes` counts them.

    Of a LeRobot data set they are numbers of episodes; else places among all files. Files that hold several recordings
    have one number for all.

    Args:
        paths: As for `load_demonstrations`.
        robot: As for `load_demonstrations`.
        **options: As for `load_demonstrations`.

    Raises:
        RecordingError: An option or a path that is wrong, or episodes that do not exist.
        UnknownNameError: No episode shows the task.
    """
    files, request, _ = open_recordings(paths, robot, options)
    if any(f.format is LEROBOT for f in files):
        known = sorted({n for f in files for n in episode_numbers(f.path)})
        return tuple(known if request.chosen is None else sorted(request.chosen))
    chosen = {f.path for f in files}
    return tuple(i for i, f in enumerate(recording_files(paths)[0]) if f.path in chosen)
