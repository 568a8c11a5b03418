"""The library's own text files: a table (CSV) or lines of JSON, each after one line with the header."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from manip_learn.recordings.readers.csv_dialect import LONGEST_LINE, line_too_long
from manip_learn.recordings.saved_motion import FileHeader, SavedMotion, refusal
from manip_learn.recordings.writers.csv_writer import MARK, column_line, column_names

WORDS = {"inf": np.inf, "-inf": -np.inf}
CURVES = ("manipulability", "task_error", "following_error")


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
                    arrays |= {name: [] for name in ("u", "effort", *CURVES) if name in sample}
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
    curves = {name: columns.get(name) for name in ("u", "effort", *CURVES)}
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
