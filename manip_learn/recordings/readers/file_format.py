"""What kind of file a path is: by its content, never by its extension."""

from __future__ import annotations

import importlib
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from manip_learn.errors import RecordingError
from manip_learn.recordings.readers.csv_dialect import CsvDialect, sniff_dialect
from manip_learn.recordings.readers.json_file import check_regular
from manip_learn.recordings.readers.recording import Recording, reason
from manip_learn.recordings.readers.saved_reader import file_header
from manip_learn.recordings.writers.csv_writer import MARK

Read = Callable[[Path, Any], Iterator[Recording]]


@final
@dataclass(frozen=True)
class FileFormat:
    """One kind of recording.

    Attributes:
        name: Short name.
        title: Common name.
        module: Module with `read(path, request) -> Iterator[Recording]`; imported when it is first needed.
        is_foreign: True if another library parses it, which is done in a process of its own.
    """

    name: str
    title: str
    module: str
    is_foreign: bool = False

    def reader(self) -> Read:
        """The function that reads it.

        Raises:
            MissingExtraError: The library that this format needs is not installed.
        """
        return importlib.import_module(self.module).read


CSV = FileFormat("csv", "text tables (CSV)", "manip_learn.recordings.readers.csv_reader")
NPZ = FileFormat("npz", "NumPy archives (.npz)", "manip_learn.recordings.readers.npz_reader")
ROSBAG = FileFormat("rosbag", "ROS bags", "manip_learn.recordings.readers.rosbag_reader", is_foreign=True)
LEROBOT = FileFormat("lerobot", "LeRobot data", "manip_learn.recordings.readers.lerobot_reader", is_foreign=True)
ROBOMIMIC = FileFormat(
    "robomimic", "robomimic HDF5", "manip_learn.recordings.readers.robomimic_reader", is_foreign=True
)
SAVED = FileFormat("saved", "files of manip_learn", "manip_learn.recordings.readers.saved_reader")
FORMATS = (CSV, NPZ, ROSBAG, LEROBOT, ROBOMIMIC)

MAGIC: tuple[tuple[bytes, FileFormat], ...] = (
    (b"#ROSBAG V2", ROSBAG),
    (b"SQLite format 3\x00", ROSBAG),
    (b"\x89MCAP0\r\n", ROSBAG),
    (b"PAR1", LEROBOT),
    (b"\x89HDF\r\n\x1a\n", ROBOMIMIC),
)
# content that people do hand in by mistake -> what to do
REFUSED_MAGIC: tuple[tuple[bytes, str, str], ...] = (
    (b"\x80\x02", "pickle", "a Python pickle, which can run any code when it is opened: save the arrays with np.savez"),
    (b"\x80\x03", "pickle", "a Python pickle, which can run any code when it is opened: save the arrays with np.savez"),
    (b"\x80\x04", "pickle", "a Python pickle, which can run any code when it is opened: save the arrays with np.savez"),
    (b"\x80\x05", "pickle", "a Python pickle, which can run any code when it is opened: save the arrays with np.savez"),
    (b"\x93NUMPY", "bare-array", "a bare NumPy array without names: save time, q, u and joint_names with np.savez"),
    (b"\x1f\x8b", "compressed", "compressed with gzip: unpack it first"),
    (b"BZh", "compressed", "compressed with bzip2: unpack it first"),
    (b"\xfd7zXZ", "compressed", "compressed with xz: unpack it first"),
    (
        b"\x28\xb5\x2f\xfd",
        "compressed",
        "compressed with zstd: give the bag's folder (with metadata.yaml), or unpack it first",
    ),
    (b"PK\x05\x06", "empty", "an empty archive"),
    (b"Rar!", "compressed", "a RAR archive: unpack it first"),
    (b"#ROSBAG V1", "old-bag", "a ROS bag of version 1: convert it with `rosbag fix`"),
    (b"MATLAB ", "matlab", "a MATLAB file: export the table as CSV"),
    (b"version https://git-lfs", "git-lfs", "a Git LFS pointer, not the recording itself: run `git lfs pull`"),
    (b"%PDF", "not-a-recording", "a PDF document"),
    (b"\x7fELF", "not-a-recording", "a program"),
    (b"\x89PNG", "not-a-recording", "an image"),
    (b"\xff\xd8\xff", "not-a-recording", "an image"),
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
        raise RecordingError(f"{path.name}: the file is empty", code="empty", path=path)
    if head.startswith(b"PK\x03\x04"):
        return _archive(path)
    if head.startswith((b"\x89MCAP0\r\n", MARK.encode())) or b'{"format": "manip_learn.' in head[:64]:
        if file_header(path) is not None:
            return SAVED
    for magic, known in MAGIC:
        if head.startswith(magic):
            return known
    for magic, code, sentence in REFUSED_MAGIC:
        if head.startswith(magic):
            raise RecordingError(f"{path.name}: this is {sentence}", code=code, path=path)
    return _text(path, head)


def _archive(path: Path) -> FileFormat:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise RecordingError(
            f"{path.name}: the archive is damaged ({reason(error)}): copy or save it again", code="damaged", path=path
        ) from error
    if any(n.endswith(".npy") for n in names):
        return SAVED if "format.npy" in names and file_header(path) is not None else NPZ
    if any(n.startswith("xl/") for n in names):
        raise RecordingError(f"{path.name}: this is an Excel workbook: save the sheet as CSV", code="excel", path=path)
    raise RecordingError(
        f"{path.name}: this zip archive holds no NumPy arrays (it has {', '.join(names[:4])}): unpack it first",
        code="compressed",
        path=path,
    )


def _text(path: Path, head: bytes) -> FileFormat:
    is_utf16 = head.startswith((b"\xff\xfe", b"\xfe\xff"))
    if b"\x00" in head and not is_utf16:
        kinds = ", ".join(f.title for f in FORMATS)
        raise RecordingError(
            f"{path.name}: the content is binary and of no known kind (starts with {head[:8]!r}); known are {kinds}",
            code="unknown-format",
            path=path,
        )
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith((b"<", b"{", b"[")):
        kind = "XML or HTML" if start.startswith(b"<") else "JSON"
        raise RecordingError(
            f"{path.name}: this looks like {kind}, not like a recording: a table with 'time' and joint names is needed",
            code="not-a-recording",
            path=path,
        )
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
        dialect: CsvDialect = sniff_dialect(path)
    except RecordingError:
        return False
    return "time" in dialect.columns and len(dialect.columns) > 1
