"""Paths that a caller gives -> files and folders of one kind of recording, by content, never by extension."""

from __future__ import annotations

import hashlib
import importlib
import importlib.resources
import os
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

from manip_learn.errors import RecordingError, counted
from manip_learn.recordings.format_words import MARK
from manip_learn.recordings.readers.csv_reader import sniff_dialect
from manip_learn.recordings.readers.lerobot_reader import episode_numbers
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import (
    Recording,
    check_regular,
    natural_order,
    refusal,
    refusing_damage,
)
from manip_learn.recordings.readers.saved_reader import JSON_LINES, file_header
from manip_learn.recordings.saved_motion import check_robot

READERS = "manip_learn.recordings.readers."


@final
@dataclass(frozen=True)
class FileFormat:
    """One kind of recording: its common name, and the module with `read(path, request)`, imported when needed."""

    title: str
    module: str


CSV = FileFormat("text tables (CSV)", READERS + "csv_reader")
NPZ = FileFormat("NumPy archives (.npz)", READERS + "npz_reader")
ROSBAG = FileFormat("ROS bags", READERS + "rosbag_reader")
LEROBOT = FileFormat("LeRobot data", READERS + "lerobot_reader")
MATLAB = FileFormat("MATLAB files", READERS + "array_reader")
ROBOMIMIC = FileFormat("HDF5 (robomimic)", READERS + "hdf5_reader")
SAVED = FileFormat("files of manip_learn", READERS + "saved_reader")
_FORMATS = (CSV, NPZ, ROSBAG, LEROBOT, ROBOMIMIC, MATLAB)

_SUFFIXES = (".csv", ".tsv", ".npz", ".bag", ".db3", ".mcap", ".parquet", ".hdf5", ".h5")  # of recordings
MAGIC: dict[tuple[bytes, ...], FileFormat] = {
    (b"#ROSBAG V2", b"SQLite format 3\x00", b"\x89MCAP0\r\n"): ROSBAG,
    (b"PAR1",): LEROBOT,
    (b"\x89HDF\r\n\x1a\n", b"MATLAB 7.3"): ROBOMIMIC,  # the latter is HDF5 too
    (b"\x93NUMPY",): NPZ,
    (b"MATLAB ",): MATLAB,
}
# content that people do hand in by mistake -> what to do
REFUSED_MAGIC: tuple[tuple[bytes | tuple[bytes, ...], str, str], ...] = (
    (
        (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"),
        "pickle",
        "is a Python pickle, which can run any code when it is opened: save the arrays with np.savez",
    ),
    (b"\x1f\x8b", "compressed", "is compressed with gzip: unpack it first"),
    (b"BZh", "compressed", "is compressed with bzip2: unpack it first"),
    (b"\xfd7zXZ", "compressed", "is compressed with xz: unpack it first"),
    (
        b"\x28\xb5\x2f\xfd",
        "compressed",
        "is compressed with zstd: give the bag's folder (with metadata.yaml), or unpack it first",
    ),
    (b"PK\x05\x06", "empty", "is an empty archive"),
    (b"#ROSBAG V1", "old-bag", "is a ROS bag of version 1: convert it with `rosbag fix`"),
    ((b"\x89PNG", b"\xff\xd8\xff"), "not-a-recording", "is an image"),
    (b"<", "not-a-recording", "looks like XML or HTML: a table with 'time' and joint names is needed"),
    (
        (b"{", b"["),
        "not-a-recording",
        "looks like JSON: a table with 'time' and joint names is needed; what `manip-learn learn` wrote "
        "is for `manip-learn replay` and `manip-learn export`",
    ),
)


def recognise(path: Path) -> FileFormat:
    """Format of a file, by its first bytes.

    Raises:
        RecordingError: Not a regular file, empty, or none of the known formats; says which it seems to be.
    """
    head = check_regular(path)
    if not head.strip():
        raise refusal(path, "empty", "the file is empty: copy it again, or record again")
    if head.startswith(b"PK\x03\x04"):
        with refusing_damage(path), zipfile.ZipFile(path) as archive:
            names = archive.namelist()
        if any(n.endswith(".npy") for n in names):
            return SAVED if "format.npy" in names and file_header(path) is not None else NPZ
        if any(n.startswith("xl/") for n in names):
            raise refusal(path, "excel", "this is an Excel workbook: save the sheet as CSV")
        there = ", ".join(names[:4])
        raise refusal(path, "compressed", f"this zip archive holds no NumPy arrays (it has {there}): unpack it first")
    if head.removeprefix(b"\xef\xbb\xbf").startswith((MARK.encode(), JSON_LINES.encode())) and file_header(path):
        return SAVED
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    for signs, known in MAGIC.items():
        if head.startswith(signs):
            return known
    for sign, code, sentence in REFUSED_MAGIC:
        if start.startswith(sign):
            raise refusal(path, code, f"this {sentence}")
    if b"\x00" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):  # UTF-16 is told by its reader
        kinds = ", ".join(f.title for f in _FORMATS)
        text = f"the content is binary and of no known kind (starts with {head[:8]!r}); known are {kinds}"
        raise refusal(path, "unknown-format", text)
    return CSV


def folder_format(path: Path) -> FileFormat | None:
    """Format of a folder that is one recording as a whole (a ROS 2 bag, a LeRobot data set), or None."""
    wholes = {"metadata.yaml": ROSBAG, "meta/info.json": LEROBOT}
    return next((known for name, known in wholes.items() if (path / name).is_file()), None)


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

    def recordings(self, request: ReadRequest) -> Iterator[Recording]:
        """The recordings in it, one after the other.

        Raises:
            RecordingError: It cannot be read, or a header of this library says that it is of another robot.
        """
        header = file_header(self.path) if self.path.is_dir() else None
        if header is not None:
            check_robot(self.path, header, request.robot)
        read = importlib.import_module(self.format.module).read(self.path, request)
        if not self.path.is_file():
            yield from read
            return
        with self.path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        for recording in read:
            yield replace(recording, sha256=digest)


def shipped_recordings() -> Path:
    """Folder of the recordings that come with this package, in an installed wheel or in a checkout."""
    installed = Path(str(importlib.resources.files("manip_learn"))) / "_recordings"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "examples" / "data"


def recording_path(name: str | os.PathLike[str]) -> Path:
    """A file or a folder; where there is none of that name, the recordings of that name that come with this package."""
    path, shipped = Path(name), shipped_recordings() / name
    return shipped if shipped.exists() and not path.exists() else path


def recording_files(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
) -> tuple[list[RecordingFile], list[str]]:
    """Files and folders to read, in order, and what was noticed.

    A folder that is one recording (a ROS 2 bag, a LeRobot data set) is read as a whole; another folder means the
    recordings in it, in natural order, if they are all of one format.

    Raises:
        RecordingError: No path, a path that is missing, or a folder without recordings of exactly one format.
    """
    given = [paths] if isinstance(paths, str | os.PathLike) or not isinstance(paths, Iterable) else list(paths)
    if not given:
        raise RecordingError("no recording was given: name at least one file or folder", code="empty")
    notes: list[str] = []
    files: list[RecordingFile] = []
    for name in given:
        if not isinstance(name, str | os.PathLike) or not os.fspath(name):
            raise RecordingError(f"recordings are given as paths, got {name!r}", code="option")
        path = recording_path(name)
        files += _in_folder(path, notes) if path.is_dir() else [RecordingFile(path, recognise(path))]
    unique: dict[str, RecordingFile] = {}
    for file in files:
        unique.setdefault(os.path.realpath(file.path), file)
    if len(unique) < len(files):
        notes.append(f"given more than once, read once: {counted(len(files) - len(unique), 'recording')}")
    return list(unique.values()), notes


def _in_folder(folder: Path, notes: list[str]) -> list[RecordingFile]:
    """The folder itself if it is one recording, else the recordings in it."""
    if (whole := folder_format(folder)) is not None:
        return [RecordingFile(folder, whole)]
    found: list[RecordingFile] = []
    ignored: list[str] = []
    why = ""
    with refusing_damage(folder):
        names = sorted((p.name for p in folder.iterdir() if not p.name.startswith(".")), key=natural_order)
    for path in (folder / name for name in names):
        try:
            known = folder_format(path) if path.is_dir() else recognise(path)
        except RecordingError as error:
            if path.suffix.lower() in _SUFFIXES:
                raise  # it is called like a recording: skipping it silently would hide a broken one
            known, why = None, why or f"; {error}"
        if known is not None and (known is not CSV or looks_like_table(path)):
            found.append(RecordingFile(path, known))
        elif not path.is_dir():
            ignored.append(path.name)
    kinds = list(dict.fromkeys(f.format.title for f in found))
    if not found:
        text = f"there is no recording in this folder{why}; name the recordings, or a folder that holds them"
        raise refusal(folder, "no-recordings", text, in_full=True)
    if len(kinds) > 1:
        text = f"the folder holds recordings of several kinds ({', '.join(kinds)}): name the files"
        raise refusal(folder, "mixed-folder", text, in_full=True)
    if ignored:
        more = ", ..." if len(ignored) > 6 else ""
        notes.append(f"{folder.name}: not recordings, not read: {', '.join(ignored[:6])}{more}")
    return found


def known_episodes(files: list[RecordingFile]) -> Sequence[int]:
    """Numbers of all episodes in some files, as `episodes` counts them.

    In a LeRobot data set the number of an episode is its `episode_index`; of other files it is the place among all
    files given, in natural order, counted from 0.
    """
    if all(f.format is not LEROBOT for f in files):
        return range(len(files))
    return sorted({number for f in files if f.format is LEROBOT for number in episode_numbers(f.path)})


def select_episodes(files: list[RecordingFile], request: ReadRequest) -> tuple[list[RecordingFile], ReadRequest, str]:
    """The files with the selected episodes, the request that selects them in data sets, and a note.

    Raises:
        RecordingError: Nothing is selected, or several data sets.
    """
    if request.episodes is None:
        return files, request, ""
    in_sets, n = [f.format is LEROBOT for f in files], len(files)
    if any(in_sets) and (not all(in_sets) or (n > 1 and any(f.path.is_dir() for f in files))):
        text = f"episodes are numbered within one LeRobot data set, {n} recordings are given: name one data set"
        raise RecordingError(text, code="option")
    folder = files[0].path.parent
    where = files[0].path.name if n == 1 else f"{n} files of LeRobot data"
    where = where if any(in_sets) else folder.name or str(folder)
    known = known_episodes(files)
    chosen = request.episodes.of_known(known, where)
    kept = [f for i, f in enumerate(files) if in_sets[i] or i in chosen]
    note = f"{where}: {len(chosen)} of {counted(len(known), 'episode' if any(in_sets) else 'file')} selected, as asked"
    return kept, replace(request, chosen=chosen), note
