"""The library's own files: each says in a header what it is and which robot it is of, and comes back bit for bit."""

from __future__ import annotations

import itertools
import json
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from manip_learn.errors import DAMAGE, RecordingError
from manip_learn.recordings.readers.csv_reader import LONGEST_LINE, text_lines
from manip_learn.recordings.readers.lerobot_dataset import DATASET_HEADER
from manip_learn.recordings.readers.mcap_records import mcap_header, messages_of
from manip_learn.recordings.readers.npz_reader import NpzArchive
from manip_learn.recordings.readers.parser_process import parsed_recordings
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording, reason, refusal
from manip_learn.recordings.saved_motion import (
    CURVES,
    PREFIX,
    FileHeader,
    SavedMotion,
    check_robot,
    checked_motion,
    joint_positions,
    refuse_lost_samples,
)
from manip_learn.recordings.trajectory import BESIDE
from manip_learn.recordings.writers.mcap_writer import ROLLOUT_TOPIC, rollout_sample_values
from manip_learn.recordings.writers.write_motion import MARK, column_groups, column_line

BAG_PARSER = "manip_learn.recordings.readers.rosbag_reader"
MCAP = b"\x89MCAP0"
ARRAYS = ("time", "q", *CURVES)
TEXTS = ("format", "header", "status", "joint_names", "frame")
LARGEST = 500_000_000  # bytes of a JointTrajectory, which is read at once


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
        start = _first_bytes(path)
        if start.startswith(b"PK"):
            return _npz_header(path)
        text = mcap_header(path) if start == MCAP else _text_header(path)
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
        start = _first_bytes(path).removeprefix(b"\xef\xbb\xbf")
        if start.startswith(b"PK"):
            motion = _read_npz(path, header)
        elif start.startswith(b"{"):
            motion = _read_jsonl(path, header)
        elif start.startswith(b"#"):
            motion = (_read_joint_trajectory if _is_joint_trajectory(path) else _read_csv)(path, header)
        else:
            motion = _read_mcap(path, header)
        return checked_motion(path, replace(motion, name=path.name))


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of a file.

    Raises:
        RecordingError: Made with another robot or other locked joints, or damaged.
    """
    header = file_header(path)
    notes = () if header is None else check_robot(path, header, request.robot)
    if header is not None and header.kind == "recording" and _first_bytes(path) == MCAP:
        for recording in parsed_recordings(BAG_PARSER, path, request):
            refuse_lost_samples(path, header, len(recording.time))
            yield replace(recording, trusted=True)
        return
    motion = read_saved(path)
    names = tuple(request.renamed(n) for n in motion.header.joint_names)
    q = joint_positions(path, motion.q, names, request.robot)
    own = {"in_seconds": True, "trusted": True, "notes": notes}
    yield Recording.of(path, path.name, motion.time, names, q, motion.u, motion.effort, wrench=motion.wrench, **own)


@contextmanager
def _refusing_damage(path: Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise RecordingError(f"rollout file {path} does not exist", code="missing", path=path) from error
    except DAMAGE as error:
        raise refusal(path, "damaged", f"the file cannot be read ({reason(error)}): copy or save it again") from error


def _first_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(len(MCAP))


def _text_header(path: Path) -> str | None:
    """The header in the first line of a file; bytes that are no text become other characters."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        line = file.readline(LONGEST_LINE)
    if line.startswith(MARK):
        return line.removeprefix(MARK)
    return line if line.startswith('{"format": "manip_learn.') else None


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


def _read_npz(path: Path, header: FileHeader) -> SavedMotion:
    archive = NpzArchive(path, ARRAYS, TEXTS)
    if "joint_names" in archive and archive.texts("joint_names") != header.joint_names:
        raise refusal(path, "damaged", "its joint_names are not those of its header: save it again")
    for name, ndim in (("time", 1), ("q", 2)):
        shape = archive.shape(name) if name in archive else "missing"
        if len(shape) != ndim or shape == "missing":
            raise refusal(path, "shape", f"time must have shape (T,) and q (T, n); {name} is {shape}")
    arrays = {name: archive.numbers(name) for name in ARRAYS if name in archive}
    nq = header.nq if header.schema > 1 else arrays["q"].shape[1]
    status = archive.texts("status") if "status" in archive else ()
    return _motion(replace(header, nq=nq), arrays, status)


def _motion(header: FileHeader, arrays: dict[str, np.ndarray], status: tuple[str, ...] = ()) -> SavedMotion:
    curves: dict[str, Any] = {name: arrays.get(name) for name in CURVES}
    return SavedMotion(header, arrays["time"], arrays["q"], **curves, status=status)


def _read_csv(path: Path, header: FileHeader) -> SavedMotion:
    """The motion in a table; errors name the line."""
    lines = _lines(path)
    next(lines)
    number, columns = next(lines, (2, ""))
    choices = (c for n in (1, 0, 2, 3) for c in itertools.combinations(BESIDE, n))
    possible = [column_groups(header, beside) for beside in choices]
    groups = next((g for g in possible if column_line(g) == columns), None)
    if groups is None:
        raise refusal(
            path,
            "columns",
            f"the columns are {columns[:80]!r}, the header above them needs {column_line(possible[0])[:200]!r}: "
            "write the file again, or remove the line of the header to have the table read as any other",
            line=number,
        )
    width = sum(map(len, groups.values()))
    rows: list[list[float]] = []
    status: list[str] = []
    for number, line in lines:
        fields = line.split(",")
        if len(fields) != width:
            said = f"this row has {len(fields)} fields, {width} are needed: {line[:60]!r}"
            raise refusal(path, "ragged", said, line=number)
        status += [fields.pop()] if "status" in groups else []
        try:
            rows.append([float(f) for f in fields])
        except ValueError as error:
            said = f"a number is needed in every column but the status: {error}"
            raise refusal(path, "not-a-number", said, line=number) from error
    table = np.array(rows, dtype=np.float64).reshape(len(rows), width - ("status" in groups))
    arrays, at = {}, 0
    for name, names in groups.items():
        arrays[name] = table[:, at : at + len(names)] if name in ("q", *BESIDE) else table[:, at : at + 1].ravel()
        at += len(names)
    return _motion(header, arrays, tuple(status))


def _read_jsonl(path: Path, header: FileHeader) -> SavedMotion:
    """The motion in lines of JSON; errors name the line."""
    arrays: dict[str, list] = {"time": [], "q": []}
    status: list[str] = []
    nv = len(header.joint_names)
    widths = {"q": header.nq or nv, "u": nv, "effort": nv, "wrench": 6}
    lines = _lines(path)
    next(lines)
    for number, line in lines:
        try:
            sample = json.loads(line)
            if not arrays["time"]:
                arrays |= {name: [] for name in CURVES if name in sample}
            for name, values in arrays.items():
                values.append(_numbers(name, sample[name], widths.get(name)))
            if header.kind == "rollout":
                status.append(sample["status"])
                if not isinstance(status[-1], str):
                    raise ValueError(f"the status must be a word, it is {status[-1]!r:.40}")
        except (KeyError, ValueError, TypeError, OverflowError, RecursionError) as error:
            said = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
            raise refusal(path, "not-a-number", f"this line is no sample: {said[:160]}", line=number) from error
    if not arrays["time"]:
        raise refusal(path, "too-short", "there is a header but no sample")
    return _motion(header, {name: np.array(values, dtype=np.float64) for name, values in arrays.items()}, tuple(status))


def _numbers(name: str, value: object, width: int | None) -> float | list[float]:
    """A number, or a list of so many of them; null is NaN, and infinity is a word."""
    if width is not None:
        if not isinstance(value, list) or len(value) != width:
            raise ValueError(f"{name} must be a list of {width} numbers, it is {value!r:.60}")
        return [_number(f"{name}[{i}]", v) for i, v in enumerate(value)]
    return _number(name, value)


def _number(name: str, value: object) -> float:
    if value is None:
        return np.nan
    if value in ("inf", "-inf") or (isinstance(value, int | float) and not isinstance(value, bool)):
        return float(value)  # type: ignore[arg-type]
    raise ValueError(f"{name} must be a number, it is {value!r:.60}")


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, without line ends; blank ones are left out."""
    return ((number, line.rstrip("\r\n")) for number, line in text_lines(path) if line.strip())


def _read_mcap(path: Path, header: FileHeader) -> SavedMotion:
    """The samples of a rollout."""
    samples = [rollout_sample_values(message) for message in messages_of(path, ROLLOUT_TOPIC)]
    if not samples:
        raise refusal(path, "too-short", f"the rollout has no samples on {ROLLOUT_TOPIC}")
    numbers, q, u, status, following = zip(*samples, strict=True)
    time, manipulability, task_error = np.array(numbers).T
    arrays = {"time": time, "q": np.array(q), "u": np.array(u)}
    arrays |= {"manipulability": manipulability, "task_error": task_error}
    if header.follows:
        arrays["following_error"] = np.array(following, dtype=np.float64)  # None is NaN
    return _motion(header, arrays, status)


def _is_joint_trajectory(path: Path) -> bool:
    """Whether the line after the header is a comment too: in a table it would be the names of the columns."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        file.readline()
        return file.read(2) == "# "


def _read_joint_trajectory(path: Path, header: FileHeader) -> SavedMotion:
    """The motion; times count from its first point."""
    size = path.stat().st_size
    if size > LARGEST:
        raise refusal(path, "too-large", f"a JointTrajectory of {size:,} bytes, more than {LARGEST:,}: split it")
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    content = json.loads("\n".join("" if line.startswith("#") else line for line in lines))
    if tuple(content["joint_names"]) != header.joint_names:
        raise refusal(path, "joint-names", "its joint_names are not those of the first line: export it again")
    points, nv = content["points"], len(header.joint_names)
    names = {"q": "positions"} | ({"u": "velocities"} if points and "velocities" in points[0] else {})
    for i, point in enumerate(points):
        for name in names.values():
            values = point.get(name)
            if not isinstance(values, list) or len(values) != nv or not all(type(v) in (int, float) for v in values):
                raise refusal(path, "shape", f"point {i}: {name} must be {nv} numbers, they are {values!r:.60}")
    stamps = [p["time_from_start"]["sec"] * 1_000_000_000 + p["time_from_start"]["nanosec"] for p in points]
    arrays = {a: np.array([p[n] for p in points], dtype=np.float64).reshape(-1, nv) for a, n in names.items()}
    return _motion(header, arrays | {"time": np.array(stamps, dtype=np.int64) * 1e-9})
