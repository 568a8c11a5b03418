"""Paths that a caller gives -> files and folders of one kind of recording, by content, never by extension."""

from __future__ import annotations

import importlib
import os
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from manip_learn.errors import RecordingError, counted
from manip_learn.recordings.format_words import MARK
from manip_learn.recordings.readers.csv_reader import sniff_dialect
from manip_learn.recordings.readers.lerobot_dataset import episode_numbers
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording, check_regular, natural_order, reason, refusal
from manip_learn.recordings.readers.saved_reader import JSON_LINES, file_header

Read = Callable[[Path, Any], Iterator[Recording]]


@final
@dataclass(frozen=True)
class FileFormat:
    """One kind of recording: its common name, and the module with `read(path, request)`, imported when needed."""

    title: str
    module: str

    def reader(self) -> Read:
        """The function that reads it."""
        return importlib.import_module(self.module).read


CSV = FileFormat("text tables (CSV)", "manip_learn.recordings.readers.csv_reader")
NPZ = FileFormat("NumPy archives (.npz)", "manip_learn.recordings.readers.npz_reader")
ROSBAG = FileFormat("ROS bags", "manip_learn.recordings.readers.rosbag_reader")
LEROBOT = FileFormat("LeRobot data", "manip_learn.recordings.readers.lerobot_reader")
MATLAB = FileFormat("MATLAB files", "manip_learn.recordings.readers.array_reader")
ROBOMIMIC = FileFormat("HDF5 (robomimic)", "manip_learn.recordings.readers.hdf5_reader")
SAVED = FileFormat("files of manip_learn", "manip_learn.recordings.readers.saved_reader")
FORMATS = (CSV, NPZ, ROSBAG, LEROBOT, ROBOMIMIC, MATLAB)

MAGIC: tuple[tuple[bytes, FileFormat], ...] = (
    (b"#ROSBAG V2", ROSBAG),
    (b"SQLite format 3\x00", ROSBAG),
    (b"\x89MCAP0\r\n", ROSBAG),
    (b"PAR1", LEROBOT),
    (b"\x89HDF\r\n\x1a\n", ROBOMIMIC),
    (b"\x93NUMPY", NPZ),
    (b"MATLAB 7.3", ROBOMIMIC),  # which is HDF5
    (b"MATLAB ", MATLAB),
)
# content that people do hand in by mistake -> what to do
REFUSED_MAGIC: tuple[tuple[bytes | tuple[bytes, ...], str, str], ...] = (
    (
        (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"),
        "pickle",
        "a Python pickle, which can run any code when it is opened: save the arrays with np.savez",
    ),
    (b"\x1f\x8b", "compressed", "compressed with gzip: unpack it first"),
    (b"BZh", "compressed", "compressed with bzip2: unpack it first"),
    (b"\xfd7zXZ", "compressed", "compressed with xz: unpack it first"),
    (
        b"\x28\xb5\x2f\xfd",
        "compressed",
        "compressed with zstd: give the bag's folder (with metadata.yaml), or unpack it first",
    ),
    (b"PK\x05\x06", "empty", "an empty archive"),
    (b"#ROSBAG V1", "old-bag", "a ROS bag of version 1: convert it with `rosbag fix`"),
    ((b"\x89PNG", b"\xff\xd8\xff"), "not-a-recording", "an image"),
)


def recognise(path: Path) -> FileFormat:
    """Format of a file, by its first bytes.

    Raises:
        RecordingError: Not a regular file, empty, or none of the known formats; says which it seems to be.
    """
    check_regular(path)
    with path.open("rb") as file:
        head = file.read(4096)
    if not head.strip():
        raise refusal(path, "empty", "the file is empty: copy it again, or record again")
    if head.startswith(b"PK\x03\x04"):
        return _archive(path)
    if head.removeprefix(b"\xef\xbb\xbf").startswith((MARK.encode(), JSON_LINES.encode())) and file_header(path):
        return SAVED
    for magic, known in MAGIC:
        if head.startswith(magic):
            return known
    for magic, code, sentence in REFUSED_MAGIC:
        if head.startswith(magic):
            raise refusal(path, code, f"this is {sentence}")
    return _text(path, head)


def _archive(path: Path) -> FileFormat:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise refusal(path, "damaged", f"the archive is damaged ({reason(error)}): copy or save it again") from error
    if any(n.endswith(".npy") for n in names):
        return SAVED if "format.npy" in names and file_header(path) is not None else NPZ
    if any(n.startswith("xl/") for n in names):
        raise refusal(path, "excel", "this is an Excel workbook: save the sheet as CSV")
    raise refusal(
        path, "compressed", f"this zip archive holds no NumPy arrays (it has {', '.join(names[:4])}): unpack it first"
    )


def _text(path: Path, head: bytes) -> FileFormat:
    is_utf16 = head.startswith((b"\xff\xfe", b"\xfe\xff"))
    if b"\x00" in head and not is_utf16:
        kinds = ", ".join(f.title for f in FORMATS)
        text = f"the content is binary and of no known kind (starts with {head[:8]!r}); known are {kinds}"
        raise refusal(path, "unknown-format", text)
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith((b"<", b"{", b"[")):
        kind = "XML or HTML" if start.startswith(b"<") else "JSON"
        text = f"this looks like {kind}, not like a recording: a table with 'time' and joint names is needed"
        raise refusal(path, "not-a-recording", text)
    return CSV


def folder_format(path: Path) -> FileFormat | None:
    """Format of a folder that is one recording as a whole (a ROS 2 bag, a LeRobot data set), or None."""
    if (path / "metadata.yaml").is_file():
        return ROSBAG
    if (path / "meta" / "info.json").is_file():
        return LEROBOT
    return None


def looks_like_table(path: Path) -> bool:
    """True if a text file in a folder of recordings is a recording: a `.csv`, or one with `time`."""
    if path.suffix.lower() in (".csv", ".tsv"):
        return True
    try:
        columns = sniff_dialect(path).columns
    except RecordingError:
        return False
    return "time" in columns and len(columns) > 1


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
    files: list[RecordingFile] = []
    notes: list[str] = []
    given = [paths] if isinstance(paths, str | os.PathLike) or not isinstance(paths, Iterable) else list(paths)
    if not given:
        raise RecordingError("no recording was given: name at least one file or folder", code="empty")
    for name in given:
        if not isinstance(name, str | os.PathLike) or not os.fspath(name):
            raise RecordingError(f"recordings are given as paths, got {name!r}", code="option")
        path = Path(name)
        if path.is_dir():
            files += _in_folder(path, notes)
        else:
            files.append(RecordingFile(path, recognise(path)))
    unique: dict[str, RecordingFile] = {}
    for file in files:
        unique.setdefault(os.path.realpath(file.path), file)
    if len(unique) < len(files):
        notes.append(f"given more than once, read once: {counted(len(files) - len(unique), 'recording')}")
    return list(unique.values()), notes


def _in_folder(folder: Path, notes: list[str]) -> Iterator[RecordingFile]:
    whole = folder_format(folder)
    if whole is not None:
        yield RecordingFile(folder, whole)
        return
    found: list[RecordingFile] = []
    ignored: list[str] = []
    why = ""
    try:
        names = sorted((p.name for p in folder.iterdir() if not p.name.startswith(".")), key=natural_order)
    except OSError as error:
        raise refusal(folder, "unreadable", f"cannot be listed: {reason(error)}", in_full=True) from error
    for path in (folder / name for name in names):
        if path.is_dir():
            whole = folder_format(path)
            found += [RecordingFile(path, whole)] if whole is not None else []
            continue
        known = None
        try:
            known = recognise(path)
        except RecordingError as error:
            if path.suffix.lower() in (".csv", ".tsv", ".npz", ".bag", ".db3", ".mcap", ".parquet", ".hdf5", ".h5"):
                raise  # its suffix is that of a recording: skipping it silently would hide a broken one
            why = why or f"; {error}"
        if known is None or (known is CSV and not looks_like_table(path)):
            ignored.append(path.name)
        else:
            found.append(RecordingFile(path, known))
    kinds = list(dict.fromkeys(f.format.title for f in found))
    if not found:
        text = f"there is no recording in this folder{why}; name the recordings, or a folder that holds them"
        raise refusal(folder, "no-recordings", text, in_full=True)
    if len(kinds) > 1:
        text = f"the folder holds recordings of several kinds ({', '.join(kinds)}): name the files"
        raise refusal(folder, "mixed-folder", text, in_full=True)
    if ignored:
        notes.append(
            f"{folder.name}: not recordings, not read: {', '.join(ignored[:6])}{', ...' if len(ignored) > 6 else ''}"
        )
    yield from found


def select_episodes(files: list[RecordingFile], request: ReadRequest) -> tuple[list[RecordingFile], ReadRequest, str]:
    """The files with the selected episodes, the request that selects them in data sets, and a note.

    In a LeRobot data set the number of an episode is its `episode_index`; of other files it is the place among all
    files given, in natural order, counted from 0.

    Raises:
        RecordingError: Nothing is selected, or several data sets.
    """
    if request.episodes is None:
        return files, request, ""
    if all(f.format is not LEROBOT for f in files):
        folder = files[0].path.parent.name or str(files[0].path.parent)
        chosen = request.episodes.of_known(range(len(files)), folder)
        kept = [f for i, f in enumerate(files) if i in chosen]
        return kept, request, f"{folder}: {len(kept)} of {len(files)} files selected, as asked"
    if any(f.format is not LEROBOT for f in files) or (len(files) > 1 and any(f.path.is_dir() for f in files)):
        raise RecordingError(
            f"episodes are numbered within one LeRobot data set, {len(files)} recordings are given: name one data set",
            code="option",
        )
    where = files[0].path.name if len(files) == 1 else f"{len(files)} files of LeRobot data"
    known = sorted({n for f in files for n in episode_numbers(f.path)})
    chosen = request.episodes.of_known(known, where)
    note = f"{where}: {len(chosen)} of {counted(len(known), 'episode')} selected, as asked"
    return files, replace(request, chosen=chosen), note
