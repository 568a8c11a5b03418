"""Paths that a caller gives -> files and folders that each hold one kind of recording."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import final

from manip_learn.errors import RecordingError, counted
from manip_learn.recordings.readers.file_format import CSV, FileFormat, folder_format, looks_like_table, recognise
from manip_learn.recordings.readers.natural_order import natural_order
from manip_learn.recordings.readers.recording import reason


@final
@dataclass(frozen=True)
class RecordingFile:
    """A file or folder, and how to read it."""

    path: Path
    format: FileFormat


def recording_files(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
) -> tuple[list[RecordingFile], list[str]]:
    """Files and folders to read, in order, and what was noticed.

    A folder that is one recording (a ROS 2 bag, a LeRobot data set) is read as a whole; another folder means the
    recordings in it, in natural order, if they are all of one format.

    Raises:
        RecordingError: No path, a path that is missing, or a folder without recordings of exactly one format.
    """
    given = _as_paths(paths)
    files: list[RecordingFile] = []
    notes: list[str] = []
    for path in given:
        if path.is_dir():
            files += _in_folder(path, notes)
        else:
            files.append(RecordingFile(path, recognise(path)))
    unique = {os.path.realpath(f.path): f for f in reversed(files)}
    if len(unique) < len(files):
        notes.append(f"given more than once, read once: {counted(len(files) - len(unique), 'recording')}")
        files = [f for i, f in enumerate(files) if all(f.path.resolve() != g.path.resolve() for g in files[:i])]
    return files, notes


def _as_paths(paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[Path]:
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    if not isinstance(paths, Iterable):
        raise RecordingError(f"recordings are given as paths, got {type(paths).__name__}", code="option")
    given: list[Path] = []
    for path in paths:
        if not isinstance(path, str | os.PathLike) or not os.fspath(path):
            raise RecordingError(f"recordings are given as paths, got {path!r}", code="option")
        given.append(Path(path))
    if not given:
        raise RecordingError("no recording was given: name at least one file or folder", code="empty")
    return given


def _in_folder(folder: Path, notes: list[str]) -> Iterator[RecordingFile]:
    whole = folder_format(folder)
    if whole is not None:
        yield RecordingFile(folder, whole)
        return
    found, ignored, damaged = _members(folder)
    kinds = list(dict.fromkeys(f.format.title for f in found))
    if not found:
        why = f"; {damaged[0]}" if damaged else ""
        raise RecordingError(
            f"{folder}: there is no recording in this folder{why}; name the recordings, or a folder that holds them",
            code="no-recordings",
            path=folder,
        )
    if len(kinds) > 1:
        raise RecordingError(
            f"{folder}: the folder holds recordings of several kinds ({', '.join(kinds)}): name the files",
            code="mixed-folder",
            path=folder,
        )
    if ignored:
        notes.append(
            f"{folder.name}: not recordings, not read: {', '.join(ignored[:6])}{', ...' if len(ignored) > 6 else ''}"
        )
    yield from found


def _members(folder: Path) -> tuple[list[RecordingFile], list[str], list[str]]:
    """Recordings in a folder, names of other files, and why they are none."""
    found: list[RecordingFile] = []
    ignored: list[str] = []
    reasons: list[str] = []
    try:
        names = sorted((p.name for p in folder.iterdir()), key=natural_order)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be listed: {reason(error)}", code="unreadable", path=folder) from error
    for name in names:
        path = folder / name
        if name.startswith("."):
            continue
        if path.is_dir():
            whole = folder_format(path)
            if whole is not None:
                found.append(RecordingFile(path, whole))
            continue
        try:
            known = recognise(path)
        except RecordingError as error:
            if path.suffix.lower() in (".csv", ".tsv", ".npz", ".bag", ".db3", ".mcap", ".parquet", ".hdf5", ".h5"):
                raise  # its suffix is that of a recording: skipping it silently would hide a broken one
            ignored.append(name)
            reasons.append(str(error))
            continue
        if known is CSV and not looks_like_table(path):
            ignored.append(name)
            continue
        found.append(RecordingFile(path, known))
    return found, ignored, reasons
