"""What the columns of a text table are: stamps, positions and velocities of joints, and what is not read."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import RecordingError, advice, closest_names
from manip_learn.recordings.readers.column_patterns import (
    Found,
    PatternError,
    another_robot,
    by_joint_names,
    by_patterns,
    by_recorded_names,
    numbered_advice,
)
from manip_learn.recordings.readers.csv_dialect import DELIMITER_WORDS, LONGEST_LINE, CsvDialect, is_skipped, not_text
from manip_learn.recordings.readers.read_request import SECONDS, ReadRequest
from manip_learn.recordings.readers.time_columns import find_time
from manip_learn.recordings.validation.unmoved_joints import unmoved_joint_names
from manip_learn.recordings.writers.csv_writer import EFFORT_SUFFIX, VELOCITY_SUFFIX

# what belongs to a message or a data frame, not to the motion
BOOKKEEPING = re.compile(r"(.*[./])?(header[./](seq|frame_id)|seq|frame_id)|unnamed: 0", re.IGNORECASE)
SHOWN = 6


@final
@dataclass(frozen=True)
class Columns:
    """Columns of a table.

    Attributes:
        names: Name of each, `time` for stamps; None where it is not read.
        time: Column of the stamps; or two, whole seconds and nanoseconds.
        unit: Unit of the stamps where their name says it.
        strict: Whether a name that is no joint's is a mistake.
        notes: What the caller should know.
    """

    names: tuple[str | None, ...]
    time: tuple[int, ...]
    unit: str | None
    strict: bool
    notes: tuple[str, ...]

    def stamps(self, table: Float[np.ndarray, "T n"], used: list[int], request: ReadRequest) -> Float[np.ndarray, " T"]:
        """Stamps, in seconds where `in_seconds`; else in the unit of the file."""
        first, *rest = (table[:, used.index(i)] for i in self.time)
        if rest:
            return first + 1e-9 * rest[0]
        return first * SECONDS[str(self.unit)] if self.in_seconds(request) else first

    def in_seconds(self, request: ReadRequest) -> bool:
        """Whether the unit is known by the name, and the caller did not say another one."""
        return len(self.time) > 1 or (self.unit is not None and request.time_unit is None)


def columns_of(path: Path, dialect: CsvDialect, request: ReadRequest) -> Columns:
    """The columns of a table.

    Raises:
        RecordingError: No stamps, columns without a name or with the same one, or a choice that the caller must make.
    """
    notes: list[str] = []
    names: list[str | None] = [request.renamed(n) for n in dialect.columns]
    for i, raw in enumerate(dialect.columns):
        if request.ignores(raw, *([names[i] or ""] if names[i] else [])):
            names[i] = None
    time = find_time(names)
    if not time.columns:
        raise _no_time(path, dialect, names, time.choices)
    notes += [time.note] if time.note else []
    for i in time.columns:
        names[i] = "time"
    left_out = [i for i in time.others if request.columns or names[i] not in request.robot.joint_names]
    left_out += [i for i, n in enumerate(names) if n is not None and BOOKKEEPING.fullmatch(n)]
    left_out += _row_numbers(path, dialect, names)
    found = _joint_columns(path, dialect, names, request)
    if found is not None:
        for i, joint in found.positions.items():
            names[i] = joint
        for i, joint in found.velocities.items():
            names[i] = joint + VELOCITY_SUFFIX
        for i, joint in found.efforts.items():
            names[i] = joint + EFFORT_SUFFIX
        kept = {*found.positions, *found.velocities, *found.efforts, *time.columns}
        left_out = [i for i, n in enumerate(names) if n is not None and i not in kept]
        notes += [found.note] if found.note else []
    for i in set(left_out):
        names[i] = None
    if left_out:
        words = [dialect.columns[i] or f"column {i + 1} (row numbers)" for i in sorted(set(left_out))]
        more = f" and {len(words) - SHOWN} more" if len(words) > SHOWN else ""
        notes.append(f"columns not used: {', '.join(words[:SHOWN])}{more}")
    _refuse_repeated(path, dialect, names, time.columns)
    return Columns(tuple(names), time.columns, time.unit, found is None, tuple(notes))


def _joint_columns(path: Path, dialect: CsvDialect, names: list[str | None], request: ReadRequest) -> Found | None:
    """Columns of the joints, by the caller's patterns or by the header; None where they are called as the joints."""
    robot = request.robot
    moving, still = robot.joint_names, unmoved_joint_names(robot)
    try:
        if request.columns:
            request.uses.use("columns")
            return by_patterns(request.columns, names, moving, still)
        if any(n in moving for n in names) or robot.objects:
            return None
        found = by_joint_names(names, moving, still)
    except PatternError as error:
        raise _header_error(path, dialect, "columns", str(error)) from error
    if found is not None:
        return found
    recorded = by_recorded_names(names, _row(path, dialect, 0), (*moving, *still))
    if recorded is not None:
        _refuse_changing_names(path, dialect, recorded[1])
        return recorded[0]
    what = numbered_advice(names, moving)
    if what:
        raise _header_error(
            path, dialect, "numbered-columns", f"{another_robot(names, robot)}; if it is this one, {what}"
        )
    return None


def _no_time(path: Path, dialect: CsvDialect, names: list[str | None], choices: tuple[str, ...]) -> RecordingError:
    near = choices or tuple(closest_names("time", [n for n in names if n])[:1])
    if not near and names and names[0] == "":
        near = ("",)
    flags = [advice("{}", f"rename={{{n!r}: 'time'}}", f"--rename {n}=time") for n in near]
    hint = ""
    if choices and all(flags):
        hint = f"; several could be it, choose one: {' or '.join(flags)}"
    elif near and all(flags):
        hint = f"; if {near[0] or 'the first column, which has no name,'!r} is meant, pass {flags[0]} or rename it"
    shown = ", ".join(map(repr, dialect.columns[:8])) + (" ..." if len(dialect.columns) > 8 else "")
    text = f"there is no column 'time'; the {DELIMITER_WORDS[dialect.delimiter]}-separated header has {shown}{hint}"
    return _header_error(path, dialect, "no-time", text)


def _row_numbers(path: Path, dialect: CsvDialect, names: list[str | None]) -> list[int]:
    """A first column without a name that counts the rows, as pandas writes it."""
    if not names or names[0] != "":
        return []
    counted = [_row(path, dialect, k)[:1] for k in range(3)]
    return [0] if counted[:2] == [["0"], ["1"]] and counted[2] in ([], ["2"]) else []


def _row(path: Path, dialect: CsvDialect, k: int) -> list[str]:
    """Fields of the k-th row of numbers; empty where there are fewer."""
    return next(itertools.islice(_rows(path, dialect), k, None), [])


def _rows(path: Path, dialect: CsvDialect) -> Iterator[list[str]]:
    try:
        with path.open(encoding=dialect.encoding) as file:
            for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), ""), start=1):
                if number > dialect.header_line and not is_skipped(line):
                    fields = dialect.split(line)
                    yield [*fields, *[""] * (len(dialect.columns) - len(fields))]
    except UnicodeError as error:
        raise not_text(path, error) from error


def _refuse_changing_names(path: Path, dialect: CsvDialect, columns: list[int]) -> None:
    """Refuse a table in which the columns of names do not name the same joints in every row."""
    first: list[str] | None = None
    for row in _rows(path, dialect):
        joints = [row[i] for i in columns]
        if first is not None and joints != first:
            raise RecordingError(
                f"{path.name}: the joints that the rows name change ({', '.join(first[:3])} ..., then "
                f"{', '.join(joints[:3])} ...): export one publisher's messages only",
                code="unsteady-names",
                path=path,
            )
        first = joints


def _refuse_repeated(path: Path, dialect: CsvDialect, names: list[str | None], time: tuple[int, ...]) -> None:
    seen: set[str] = set()
    for i, name in enumerate(names):
        if name is None or i in time[1:]:
            continue
        if not name:
            raise _header_error(path, dialect, "unnamed-column", f"column {i + 1} of {len(names)} has no name")
        if name in seen:
            raise _header_error(path, dialect, "duplicate-column", f"two columns are called {name!r}: keep one")
        seen.add(name)


def _header_error(path: Path, dialect: CsvDialect, code: str, text: str) -> RecordingError:
    return RecordingError(f"{path.name}:{dialect.header_line}: {text}", code=code, path=path, line=dialect.header_line)
