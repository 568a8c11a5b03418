"""Files -> rollouts and recordings by their names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

from manip_learn.control.rollout import Rollout
from manip_learn.errors import RecordingError
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.load_demonstrations import ReadOptions
from manip_learn.recordings.readers.read_request import flag_of
from manip_learn.recordings.readers.saved_reader import file_header
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Robot


@final
@dataclass(frozen=True)
class NamedMotions:
    """What files hold, read.

    Attributes:
        motions: Name -> rollout or recording, rollouts first.
        rollouts: Files that are rollouts.
        recordings: The others, files or folders.
        notes: What was noticed while reading.
    """

    motions: dict[str, Rollout | Trajectory]
    rollouts: list[str]
    recordings: list[str]
    notes: list[str]


def named_motions(files: list[str], robot: Robot, options: ReadOptions | None) -> NamedMotions:
    """Read rollouts and recordings, folders of recordings too.

    Args:
        files: Their paths.
        robot: Their robot.
        options: Keywords of `load_demonstrations`, for recordings.

    Raises:
        RecordingError: A file that is missing, that is neither, or of another robot; options that no file can use.
    """
    rollouts = [file for file in files if _is_rollout(Path(file))]
    recordings = [file for file in files if file not in rollouts]
    if options and not recordings:
        asked = ", ".join(flag_of(name) for name in options)
        raise RecordingError(f"rollouts are read as they were written, so {asked} has no use: leave it out")
    named: dict[str, Rollout | Trajectory] = {}
    notes: list[str] = []
    for file in rollouts:
        rollout, said = Rollout.load_with_notes(file, robot)
        named[_unique(Path(file).stem, named)] = rollout
        notes += [f"{Path(file).name}: {note}" for note in said]
    # together, since an option may be meant for one of them
    for trajectory in load_demonstrations(recordings, robot, **(options or {})) if recordings else ():
        named[_unique(trajectory.name, named)] = trajectory
    return NamedMotions(named, rollouts, recordings, notes)


def _unique(name: str, taken: dict[str, Rollout | Trajectory]) -> str:
    candidate, n = name, 2
    while candidate in taken:
        candidate, n = f"{name} ({n})", n + 1
    return candidate


def _is_rollout(path: Path) -> bool:
    if not path.exists():
        raise RecordingError(f"{path}: there is no such file: check the path", code="missing", path=path)
    if not path.is_file():
        return False
    header = file_header(path)
    return header is not None and header.kind == "rollout"
