"""Files of recordings as a source for the learner: read part by part, here or elsewhere."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Unpack, final

from manip_learn.recordings.format_words import DATASET_HEADER
from manip_learn.recordings.load_demonstrations import Paths, ReadOptions, open_recordings, read_recordings
from manip_learn.recordings.readers.lerobot_dataset import episode_number, open_dataset, separate_files
from manip_learn.recordings.readers.recording import size_on_disk
from manip_learn.recordings.readers.recording_files import LEROBOT, FileFormat, RecordingFile
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.trajectory_source import TrajectorySource
from manip_learn.robot import Robot

PART_BYTES = 1_000_000  # of files that make a part: small ones share a task, and workers get even shares


@final
class RecordingSource(TrajectorySource):
    """The demonstrations in some files, never all in memory.

    Args:
        paths: As for `load_demonstrations`. Workers on other machines must see the same files under the same names.
        robot: As for `load_demonstrations`.
        **options: See `ReadOptions`.

    Raises:
        RecordingError: No path, one that is missing, a folder without recordings of exactly one format, or episodes
            that do not exist.
        UnknownNameError: No episode shows the task; lists near matches.
    """

    def __init__(self, paths: Paths, robot: Robot, **options: Unpack[ReadOptions]):
        files, self._request, notes = open_recordings(paths, robot, options)
        self._notes = tuple(notes)
        chosen = self._request.chosen
        self._parts = _in_parts([piece for file in files for piece in _pieces(file, chosen)])

    @property
    def n_parts(self) -> int:
        """Runs of files of about `PART_BYTES`; a single large file is one part."""
        return len(self._parts)

    def part(self, index: int, notes: list[str] | None = None) -> Iterator[Trajectory]:
        """The demonstrations in the files of a part, one after the other.

        Raises:
            RecordingError: A recording that cannot be trusted.
            MissingExtraError: The format needs a library that is not installed.
        """
        yield from read_recordings(self._parts[index], self._request, notes)
        if notes is not None and index == 0:
            notes += self._notes


def _pieces(file: RecordingFile, chosen: frozenset[int] | None) -> list[RecordingFile]:
    """Files that can be read one by one: those of a LeRobot data set, if no episode goes on in the next one.

    Version 2 has one file per episode; those that are not chosen are left out.
    """
    if file.format is not LEROBOT or not file.path.is_dir():
        return [_named_alike_everywhere(file.path, file.format)]
    dataset = open_dataset(file.path)
    numbers = [episode_number(path) for path in dataset.files]
    if None not in numbers:
        if chosen is None:
            dataset.refuse_lost("episodes", len(numbers))
        return [
            _named_alike_everywhere(path, LEROBOT)
            for path, number in zip(dataset.files, numbers, strict=True)
            if chosen is None or number in chosen
        ]
    is_ours = (file.path / DATASET_HEADER).is_file()  # its header speaks for the folder, not for a file in it
    runs = [] if chosen is not None or is_ours else separate_files(file.path)
    if len(runs) > 1 and all(len(run) == 1 for run in runs):
        return [_named_alike_everywhere(path, LEROBOT) for (path,) in runs]
    return [_named_alike_everywhere(file.path, file.format)]  # an episode goes on in the next file


def _named_alike_everywhere(path: Path, kind: FileFormat) -> RecordingFile:
    """The file for workers too, whose working folder is another."""
    return RecordingFile(Path(os.path.abspath(path)), kind)


def _in_parts(files: list[RecordingFile]) -> list[list[RecordingFile]]:
    parts: list[list[RecordingFile]] = [[]]
    size = 0
    for file in files:
        if parts[-1] and size >= PART_BYTES:
            parts.append([])
            size = 0
        parts[-1].append(file)
        size += size_on_disk(file.path)
    return parts
