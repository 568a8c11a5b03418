"""Which of the files, and which episodes in a LeRobot data set, a caller asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from manip_learn.errors import RecordingError, counted
from manip_learn.recordings.readers.file_format import LEROBOT
from manip_learn.recordings.readers.lerobot_episodes import episode_numbers, episodes_of_task
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording_files import RecordingFile


def select_episodes(files: list[RecordingFile], request: ReadRequest) -> tuple[list[RecordingFile], ReadRequest, str]:
    """The files with the selected episodes, the request that selects them in data sets, and a note.

    In a LeRobot data set the number of an episode is its `episode_index`; of other files it is the place among all
    files given, in natural order, counted from 0.

    Raises:
        RecordingError: Nothing is selected, several data sets, or a task asked of files that name none.
        UnknownNameError: No episode shows the task; lists near matches.
    """
    if request.episodes is None and request.task is None:
        return files, request, ""
    if all(f.format is not LEROBOT for f in files):
        return _selected_files(files, request)
    if any(f.format is not LEROBOT for f in files) or (len(files) > 1 and any(f.path.is_dir() for f in files)):
        raise RecordingError(
            f"episodes are numbered within one LeRobot data set, {len(files)} recordings are given: name one data set",
            code="option",
        )
    where = files[0].path.name if len(files) == 1 else f"{len(files)} files of LeRobot data"
    known = sorted({n for f in files for n in episode_numbers(f.path)})
    chosen = frozenset(known) if request.episodes is None else request.episodes.of_known(known, where)
    if request.task is not None:
        shown = frozenset().union(*(episodes_of_task(f.path, request.task) for f in files))
        if not chosen & shown:
            raise RecordingError(
                f"{where}: none of the episodes {request.episodes} shows the task {request.task!r}; it is shown by "
                f"{_listed(sorted(shown & frozenset(known)))}",
                code="no-episode",
            )
        chosen &= shown
    note = f"{where}: {len(chosen)} of {counted(len(known), 'episode')} selected, as asked"
    return files, replace(request, chosen=chosen), note


def _selected_files(files: list[RecordingFile], request: ReadRequest) -> tuple[list[RecordingFile], ReadRequest, str]:
    folder = files[0].path.parent.name or str(files[0].path.parent)
    if request.task is not None:
        raise RecordingError(
            f"{folder}: tasks are named by LeRobot data sets only, these are {files[0].format.title}: leave the task "
            "out, or select files",
            code="no-tasks",
        )
    if request.episodes is None:
        return files, request, ""
    chosen = request.episodes.of_known(range(len(files)), folder)
    kept = [f for i, f in enumerate(files) if i in chosen]
    return kept, request, f"{folder}: {len(kept)} of {len(files)} files selected, as asked"


def _listed(numbers: Sequence[int]) -> str:
    more = f" and {len(numbers) - 12} more" if len(numbers) > 12 else ""
    return (", ".join(map(str, numbers[:12])) or "none") + more
