"""The library's own text files: a table (CSV) or lines of JSON, each after one line with the header."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np

from manip_learn.errors import DAMAGE, RecordingError
from manip_learn.recordings.readers.csv_reader import LONGEST_LINE, line_too_long
from manip_learn.recordings.readers.lerobot_dataset import DATASET_HEADER
from manip_learn.recordings.readers.npz_reader import NpzArchive
from manip_learn.recordings.readers.parser_process import parsed_recordings
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording, reason, refusal
from manip_learn.recordings.saved_motion import (
    PREFIX,
    FileHeader,
    SavedMotion,
    check_robot,
    checked_motion,
    joint_positions,
)
from manip_learn.recordings.writers.joint_state_messages import (
    CHANNEL,
    CHUNK,
    MAGIC,
    MESSAGE,
    METADATA,
    rollout_sample_values,
)
from manip_learn.recordings.writers.mcap_writer import HEADER_KEY, METADATA_NAME, ROLLOUT_TOPIC
from manip_learn.recordings.writers.write_motion import MARK, column_line, column_names

WORDS = {"inf": np.inf, "-inf": -np.inf}


def header_text(first_line: str) -> str | None:
    """The header in the first line of a file, or None if the file is not the library's own."""
    if first_line.startswith(MARK):
        return first_line.removeprefix(MARK)
    return first_line if first_line.startswith('{"format": "manip_learn.') else None


def first_line(path: Path) -> str:
    """The first line of a file; bytes that are no text become other characters."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        return file.readline(LONGEST_LINE)


def read_saved_csv(path: Path, header: FileHeader) -> SavedMotion:
    """The motion in a table.

    Raises:
        RecordingError: Columns that were changed, ragged rows, text for a number; names the line.
    """
    with path.open(encoding="utf-8-sig") as file:
        lines = _lines(file, path)
        next(lines)
        number, columns = next(lines, (2, ""))
        given = [(a, b) for a in (True, False) for b in (False, True) if columns == column_line(header, a, b)]
        if not given:
            raise refusal(
                path,
                "columns",
                f"the columns are {columns[:80]!r}, the header above them needs {column_line(header, True)[:200]!r}: "
                "write the file again, or remove the line of the header to have the table read as any other",
                line=number,
            )
        has_u, has_effort = given[0]
        names = column_names(header, has_u, has_effort)
        rows, status = _rows(path, lines, names, header.kind == "rollout")
    table = np.array(rows, dtype=np.float64).reshape(len(rows), -1 if rows else len(names) - bool(status))
    nq, nv = header.nq or len(header.joint_names), len(header.joint_names)
    start = 1 + nq + has_u * nv
    curves = table[:, start + has_effort * nv :]
    is_rollout = header.kind == "rollout"
    return SavedMotion(
        header,
        table[:, 0],
        table[:, 1 : 1 + nq],
        table[:, 1 + nq : start] if has_u else None,
        curves[:, 0] if is_rollout else None,
        curves[:, 1] if is_rollout else None,
        tuple(status),
        path.name,
        curves[:, 2] if is_rollout and header.follows else None,
        table[:, start : start + nv] if has_effort else None,
    )


def _rows(
    path: Path, lines: Iterator[tuple[int, str]], names: list[str], with_status: bool
) -> tuple[list[list[float]], list[str]]:
    rows: list[list[float]] = []
    status: list[str] = []
    for number, line in lines:
        fields = line.split(",")
        if len(fields) != len(names):
            raise refusal(
                path,
                "ragged",
                f"this row has {len(fields)} fields, {len(names)} are needed: {line[:60]!r}",
                line=number,
            )
        if with_status:
            status.append(fields.pop())
        try:
            rows.append([float(f) for f in fields])
        except ValueError as error:
            raise refusal(
                path, "not-a-number", f"a number is needed in every column but the status: {error}", line=number
            ) from error
    return rows, status


def read_saved_jsonl(path: Path, header: FileHeader) -> SavedMotion:
    """The motion in lines of JSON.

    Raises:
        RecordingError: A line that is no sample; names it.
    """
    arrays: dict[str, list] = {"time": [], "q": []}
    status: list[str] = []
    with path.open(encoding="utf-8-sig") as file:
        lines = _lines(file, path)
        next(lines)
        for i, (number, line) in enumerate(lines):
            try:
                sample = json.loads(line)
                if i == 0:
                    arrays |= {name: [] for name in CURVES if name in sample}
                for name, values in arrays.items():
                    values.append(_numbers(name, sample[name], header))
                if header.kind == "rollout":
                    status.append(_word(sample["status"]))
            except (KeyError, ValueError, TypeError, OverflowError, RecursionError) as error:
                said = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
                raise refusal(path, "not-a-number", f"this line is no sample: {said[:160]}", line=number) from error
    columns = {name: np.array(values, dtype=np.float64) for name, values in arrays.items()}
    if not columns["time"].size:
        raise refusal(path, "too-short", "there is a header but no sample")
    curves = {name: columns.get(name) for name in CURVES}
    return SavedMotion(header, columns["time"], columns["q"], **curves, status=tuple(status), name=path.name)


def _numbers(name: str, value: object, header: FileHeader) -> float | list[float]:
    nv = len(header.joint_names)
    width = {"q": header.nq or nv, "u": nv, "effort": nv}.get(name)
    if width is None:
        return _number(name, value)
    if not isinstance(value, list) or len(value) != width:
        raise ValueError(f"{name} must be a list of {width} numbers, it is {value!r:.60}")
    return [_number(f"{name}[{i}]", v) for i, v in enumerate(value)]


def _number(name: str, value: object) -> float:
    if value is None:
        return np.nan
    if isinstance(value, str) and value in WORDS:
        return WORDS[value]
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ValueError(f"{name} must be a number, it is {value!r:.60}")
    return float(value)


def _word(value: object) -> str:
    if not isinstance(value, str):
        raise ValueError(f"the status must be a word, it is {value!r:.40}")
    return value


def _lines(file: IO[str], path: Path) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, without line ends; blank ones are left out."""
    number = 0
    while line := file.readline(LONGEST_LINE):
        number += 1
        if len(line) >= LONGEST_LINE:
            raise line_too_long(path, number)
        if line.strip():
            yield number, line.rstrip("\r\n")


TEXT_READERS: dict[str, Callable[[Path, FileHeader], SavedMotion]] = {"#": read_saved_csv, "{": read_saved_jsonl}


LARGEST_METADATA = 10_000_000
MESSAGE_HEAD = 22  # channel, sequence, two stamps


def mcap_header(path: Path) -> str | None:
    """The library's header in an MCAP file, or None."""
    with path.open("rb") as file:
        for code, length in _records(file, path.stat().st_size):
            if code != METADATA or length > LARGEST_METADATA:
                continue
            content = file.read(length)
            name, at = _text(content, 0)
            if name != METADATA_NAME:
                continue
            end = at + 4 + struct.unpack_from("<I", content, at)[0]
            at += 4
            while at < min(end, len(content)):
                key, at = _text(content, at)
                value, at = _text(content, at)
                if key == HEADER_KEY:
                    return value
    return None


def read_saved_rollout(path: Path, header: FileHeader) -> SavedMotion:
    """The samples of a rollout.

    Raises:
        RecordingError: Blocks that another program has compressed, or samples that do not fit.
    """
    channels: set[int] = set()
    samples = []
    with path.open("rb") as file:
        size = path.stat().st_size
        for code, length in _records(file, size):
            if code != CHUNK:
                continue
            content = file.read(min(length, size))
            for inner, record in _chunk_records(path, content):
                if inner == CHANNEL:
                    (channel,), (topic, _) = struct.unpack_from("<H", record), _text(record, 4)
                    if topic == ROLLOUT_TOPIC:
                        channels.add(channel)
                elif inner == MESSAGE and struct.unpack_from("<H", record)[0] in channels:
                    samples.append(rollout_sample_values(record[MESSAGE_HEAD:]))
    if not samples:
        raise refusal(path, "too-short", f"the rollout has no samples on {ROLLOUT_TOPIC}")
    nq, nv = header.nq or len(header.joint_names), len(header.joint_names)
    for i, (_, q, u, _, _) in enumerate(samples):
        if len(q) != nq or len(u) != nv:
            raise refusal(
                path, "shape", f"sample {i} has {len(q)} columns of q and {len(u)} of u, {nq} and {nv} are needed"
            )
    numbers = np.array([s[0] for s in samples])
    q, u = np.array([s[1] for s in samples]), np.array([s[2] for s in samples])
    status = tuple(s[3] for s in samples)
    following = np.array([np.nan if s[4] is None else s[4] for s in samples]) if header.follows else None
    return SavedMotion(header, numbers[:, 0], q, u, numbers[:, 1], numbers[:, 2], status, path.name, following)


def _records(file: IO[bytes], size: int) -> Iterator[tuple[int, int]]:
    """Kind and length of the records at the top level; the file stands at their content."""
    file.seek(len(MAGIC))
    while file.tell() + 9 <= size:
        code, length = struct.unpack("<BQ", file.read(9))
        start = file.tell()
        yield code, length
        if start + length > size:
            return
        file.seek(start + length)


def _chunk_records(path: Path, chunk: bytes) -> Iterator[tuple[int, bytes]]:
    compression, at = _text(chunk, 28)
    if compression:
        raise refusal(
            path,
            "compressed",
            f"another program has packed its blocks with {compression[:20]}: unpack it (`mcap decompress`), or save "
            "the rollout again",
        )
    at += 8
    while at + 9 <= len(chunk):
        code, length = struct.unpack_from("<BQ", chunk, at)
        at += 9
        if at + length > len(chunk):
            raise ValueError(f"a record of {length:,} bytes ends after its block")
        yield code, chunk[at : at + length]
        at += length


def _text(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    text = content[at + 4 : at + 4 + length]
    if len(text) != length:
        raise ValueError("a text ends after its record")
    return text.decode(), at + 4 + length


LARGEST = 500_000_000  # bytes


def is_joint_trajectory(path: Path) -> bool:
    """Whether the line after the header is a comment too: in a table it would be the names of the columns."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        file.readline()
        return file.read(2) == "# "


def read_joint_trajectory(path: Path, header: FileHeader) -> SavedMotion:
    """The motion; times count from its first point.

    Raises:
        RecordingError: No JointTrajectory, or a point that lacks a number; names the point.
        ValueError: Not JSON; and whatever else a damaged file raises.
    """
    size = path.stat().st_size
    if size > LARGEST:
        raise refusal(path, "too-large", f"a JointTrajectory of {size:,} bytes, more than {LARGEST:,}: split it")
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    content = json.loads("\n".join("" if line.startswith("#") else line for line in lines))
    if tuple(content["joint_names"]) != header.joint_names:
        raise refusal(path, "joint-names", "its joint_names are not those of the first line: export it again")
    points = content["points"]
    nv = len(header.joint_names)
    has_u = bool(points) and "velocities" in points[0]
    for i, point in enumerate(points):
        for name in ("positions", "velocities") if has_u else ("positions",):
            values = point.get(name)
            if not isinstance(values, list) or len(values) != nv or not all(type(v) in (int, float) for v in values):
                raise refusal(path, "shape", f"point {i}: {name} must be {nv} numbers, they are {values!r:.60}")
    stamps = [p["time_from_start"]["sec"] * 1_000_000_000 + p["time_from_start"]["nanosec"] for p in points]
    time = np.array(stamps, dtype=np.int64) * 1e-9
    q = np.array([p["positions"] for p in points], dtype=np.float64).reshape(-1, nv)
    u = np.array([p["velocities"] for p in points], dtype=np.float64).reshape(-1, nv) if has_u else None
    return SavedMotion(header, time, q, u, name=path.name)


BAG_PARSER = "manip_learn.recordings.readers.rosbag_reader"
CURVES = ("u", "effort", "manipulability", "task_error", "following_error")
ARRAYS = ("time", "q", *CURVES)
TEXTS = ("format", "header", "status", "joint_names", "frame")


def file_header(path: Path) -> FileHeader | None:
    """What a file of the library, or a LeRobot data set that it wrote, says about itself; None for any other file.

    Raises:
        RecordingError: The header is damaged, or of a newer version.
    """
    with _refusing_damage(path):
        if path.is_dir():
            inner = path / DATASET_HEADER
            return FileHeader.from_json(inner.read_bytes()) if inner.is_file() else None
        if path.exists() and not path.is_file():
            raise refusal(path, "not-a-file", "this is not a regular file; give a rollout or a recording")
        with path.open("rb") as file:
            start = file.read(8)
        if start.startswith(b"PK"):
            return _npz_header(path)
        text = mcap_header(path) if start.startswith(b"\x89MCAP0") else header_text(first_line(path))
        return None if text is None else FileHeader.from_json(text)


def read_saved(path: Path) -> SavedMotion:
    """The motion in a file of the library: a rollout, or a recording that is not in MCAP.

    Raises:
        RecordingError: No such file, a damaged one, or one of another kind.
    """
    with _refusing_damage(path):
        header = file_header(path)
        if header is None:
            raise refusal(path, "not-a-rollout", "no rollout; `manip-learn control ... --out FILE.npz` writes one")
        with path.open("rb") as file:
            start = file.read(4).removeprefix(b"\xef\xbb\xbf")[:1].decode("latin-1")
        if start == "P":
            motion = _npz_motion(path, header)
        elif start == "#" and is_joint_trajectory(path):
            motion = read_joint_trajectory(path, header)
        elif start in TEXT_READERS:
            motion = TEXT_READERS[start](path, header)
        else:
            motion = read_saved_rollout(path, header)
        return checked_motion(path, motion)


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of a file.

    Raises:
        RecordingError: Made with another robot or other locked joints, or damaged.
    """
    header = file_header(path)
    notes = () if header is None else check_robot(path, header, request.robot)
    if header is not None and header.kind == "recording" and _is_mcap(path):
        for recording in parsed_recordings(BAG_PARSER, path, request):
            yield replace(recording, trusted=True)
        return
    motion = read_saved(path)
    names = tuple(request.renamed(n) for n in motion.header.joint_names)
    q = joint_positions(path, motion.q, names, request.robot)
    own = {"in_seconds": True, "trusted": True, "notes": notes}
    yield Recording.of(path, path.name, motion.time, names, q, motion.u, motion.effort, **own)


def _npz_header(path: Path) -> FileHeader | None:
    with zipfile.ZipFile(path) as zipped:
        names = zipped.namelist()
    if "format.npy" not in names:
        return None
    archive = NpzArchive(path, (), TEXTS)
    named = archive.text("format") if archive.shape("format") == () else ""
    if not named.startswith(PREFIX):
        return None
    if "header" in archive:
        return FileHeader.from_json(archive.text("header"))
    if named != PREFIX + "rollout":
        raise refusal(path, "not-a-rollout", f"its format is {named!r:.40}, which this version does not read")
    frame = archive.text("frame") if "frame" in archive else ""
    return FileHeader("rollout", archive.texts("joint_names"), None, frame, schema=1)


def _npz_motion(path: Path, header: FileHeader) -> SavedMotion:
    archive = NpzArchive(path, ARRAYS, TEXTS)
    if "joint_names" in archive and archive.texts("joint_names") != header.joint_names:
        raise refusal(path, "damaged", "its joint_names are not those of its header: save it again")
    for name in ("time", "q"):
        if len(archive.shape(name) if name in archive else ()) != (1 if name == "time" else 2):
            shape = archive.shape(name) if name in archive else "missing"
            raise refusal(path, "shape", f"time must have shape (T,) and q (T, n); {name} is {shape}")
    arrays = {name: archive.numbers(name) for name in ARRAYS if name in archive}
    nq = header.nq if header.schema > 1 else arrays["q"].shape[1]
    status = archive.texts("status") if "status" in archive else ()
    curves = {name: arrays.get(name) for name in CURVES}
    return SavedMotion(replace(header, nq=nq), arrays["time"], arrays["q"], **curves, status=status, name=path.name)


def _is_mcap(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(6) == b"\x89MCAP0"


@contextmanager
def _refusing_damage(path: Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise RecordingError(f"rollout file {path} does not exist", code="missing", path=path) from error
    except DAMAGE as error:
        raise refusal(path, "damaged", f"the file cannot be read ({reason(error)}): copy or save it again") from error
