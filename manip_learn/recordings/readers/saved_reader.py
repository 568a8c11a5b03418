"""The library's own files: each says in a header what it is and which robot it is of, and comes back bit for bit."""

from __future__ import annotations

import io
import itertools
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from manip_learn.recordings.format_words import DATASET_HEADER, MARK
from manip_learn.recordings.readers.csv_reader import text_lines
from manip_learn.recordings.readers.npz_reader import stored_arrays, texts_of
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import LONGEST_TEXT, Recording, float_array, refusal, refusing_damage
from manip_learn.recordings.saved_motion import (
    PREFIX,
    ROLLOUT_CURVES,
    FileHeader,
    SavedMotion,
    check_robot,
    checked_motion,
    column_groups,
    column_line,
    joint_positions,
)
from manip_learn.recordings.trajectory import BESIDE_POSITIONS
from manip_learn.robot.description.text import open_regular_file, read_regular_file

_ARRAYS = ("time", "q", *ROLLOUT_CURVES)
TEXTS = ("format", "header", "status", "joint_names")
# [rad or m] by which positions may always be off their velocities: by the integration of a simulation, by encoders
LAGS = {"rollout": 1e-3, "recording": 1e-2}
JSON_LINES = '{"format": "manip_learn.'  # how they began


def file_header(path: Path) -> FileHeader | None:
    """What a file of the library, or a LeRobot data set that it wrote, says about itself; None for any other file.

    Raises:
        RecordingError: The header is damaged, or of a newer version.
    """
    with refusing_damage(path):
        if path.is_dir():
            inner = path / DATASET_HEADER
            return FileHeader.from_json(read_regular_file(inner, LONGEST_TEXT)) if inner.is_file() else None
        with io.TextIOWrapper(
            open_regular_file(path), "utf-8-sig", "replace"
        ) as file:  # bytes that are no text: other characters
            start = file.read(len(JSON_LINES))
            if start.startswith("PK"):
                with zipfile.ZipFile(path) as zipped:
                    if "format.npy" not in zipped.namelist():
                        return None
                arrays, _ = stored_arrays(path, (), TEXTS)
                named = texts_of(path, "format", arrays["format"], 0)[0] if arrays["format"].shape == () else ""
                if not named.startswith(PREFIX):
                    return None
                if "header" not in arrays:
                    said = "an early version wrote this file without its robot, which is not read any more: "
                    raise refusal(path, "not-a-rollout", said + "simulate it again")
                return FileHeader.from_json(texts_of(path, "header", arrays["header"], 0)[0])
            if start.startswith(JSON_LINES):
                raise refusal(path, "not-a-rollout", "JSON lines are not read any more; .npz and .csv are, bit for bit")
            is_ours = start.startswith(MARK)
            return FileHeader.from_json((start + file.readline(LONGEST_TEXT)).removeprefix(MARK)) if is_ours else None


def read_saved(path: Path) -> SavedMotion:
    """The motion in a file of the library: a rollout, or a recording.

    Raises:
        RecordingError: No such file, a damaged one, or one of another kind.
    """
    with refusing_damage(path):
        header = file_header(path)
        if header is None:
            said = "no rollout; `manip-learn control ... --out FILE.npz` writes one (.npz and .csv are read back)"
            raise refusal(path, "not-a-rollout", said)
        arrays = _of_archive(path, header) if zipfile.is_zipfile(path) else _of_table(path, header)
        return checked_motion(path, SavedMotion(header, arrays, path.name))


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of a file."""
    motion = read_saved(path)
    notes = check_robot(path, motion.header, request.robot)
    names = request.renamed(*motion.header.joint_names)
    q = joint_positions(path, motion.arrays["q"], names, request.robot)
    beside = (motion.arrays.get(name) for name in BESIDE_POSITIONS)
    lag = float(np.nanmax(np.append(motion.arrays.get("following_error", 0.0), LAGS[motion.header.kind])))
    own = {"in_seconds": True, "trusted": True, "notes": notes, "lag": lag}
    yield Recording.of(path, path.name, motion.arrays["time"], names, q, *beside, **own)


def _of_archive(path: Path, header: FileHeader) -> dict[str, np.ndarray]:
    stored, _ = stored_arrays(path, _ARRAYS, TEXTS)
    if "joint_names" in stored and texts_of(path, "joint_names", stored["joint_names"]) != header.joint_names:
        raise refusal(path, "damaged", "its joint_names are not those of its header: save it again")
    words = {"status": np.array(texts_of(path, "status", stored["status"]))} if "status" in stored else {}
    return {name: float_array(stored[name]) for name in _ARRAYS if name in stored} | words


def _of_table(path: Path, header: FileHeader) -> dict[str, np.ndarray]:
    """The arrays of a table; errors name the line."""
    lines = ((number, line.rstrip("\r\n")) for number, line in text_lines(path) if line.strip())
    next(lines)
    number, columns = next(lines, (2, ""))
    if columns.startswith("# "):  # in a table, these would be the names of the columns
        raise refusal(path, "not-a-rollout", "a JointTrajectory is written for controllers only: read .npz or .csv")
    choices = (c for n in (1, 0, 2) for c in itertools.combinations(BESIDE_POSITIONS, n))
    possible = [column_groups(header, beside) for beside in choices]
    groups = next((g for g in possible if column_line(g) == columns), None)
    if groups is None:
        text = (
            f"the columns are {columns[:80]!r}, the header above them needs {column_line(possible[0])[:200]!r}: "
            "write the file again, or remove the line of the header to have the table read as any other"
        )
        raise refusal(path, "columns", text, line=number)
    ends = np.cumsum([len(names) for names in groups.values()])
    n = ends[-1] - ("status" in groups)
    rows: list[list[float]] = []
    status: list[str] = []
    for number, line in lines:
        fields = line.split(",")
        try:
            if len(fields) != ends[-1]:
                raise ValueError(f"it has {len(fields)} fields, {ends[-1]} are needed")
            rows.append([float(f) for f in fields[:n]])
        except ValueError as error:
            text = f"each row needs a number in every column but the status: {error}, in {line[:60]!r}"
            raise refusal(path, "not-a-number", text, line=number) from error
        status += fields[n:]
    parts = np.split(np.reshape(rows, (len(rows), n)), ends[:-1], axis=1)
    arrays = {k: x if k in ("q", *BESIDE_POSITIONS) else x.ravel() for k, x in zip(groups, parts, strict=True)}
    return arrays | ({"status": np.array(status, dtype=str)} if "status" in groups else {})
