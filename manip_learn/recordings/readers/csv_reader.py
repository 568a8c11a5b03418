"""Text tables: delimiter, decimal mark and header are found; columns by name; every row is checked."""

from __future__ import annotations

import csv
import itertools
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import advice
from manip_learn.recordings.readers.name_patterns import named_in
from manip_learn.recordings.readers.quantities import MESSAGES, table_columns
from manip_learn.recordings.readers.read_request import SECONDS_OF, ReadRequest, names_advice
from manip_learn.recordings.readers.recording import LONGEST_TEXT, Recording, check_columns, reason_of, refusal

COMMENT_MARKS = ("#", "%")
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.IGNORECASE)
TIME_OF_DAY = re.compile(r"(\d{1,3}):([0-5]?\d):([0-5]?\d(?:[.,]\d*)?)")
DELIMITER_WORDS = {",": "comma", ";": "semicolon", "\t": "tab", None: "white space"}


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of a text table."""
    dialect = sniff_dialect(path, request)
    check_columns(path, "its header", len(dialect.columns))
    first = _fields(next(_numbered_lines(path, dialect), (0, ""))[1], dialect.delimiter)
    with named_in(path, dialect.header_line):
        columns = table_columns(dialect.columns, first, request)
    clock, used, unit = columns.time, columns.used, columns.unit
    if clock is not None and clock < len(first) and seconds_of(first[clock]) is not None:
        unit = "s"
    else:
        clock = None
    table = _table(path, dialect, used, request, clock)
    notes = [f"the header was read from the comment in line {dialect.header_line}"] if dialect.commented_header else []
    notes += columns.notes
    with path.open("rb") as file:
        file.seek(-min(path.stat().st_size, LONGEST_TEXT), os.SEEK_END)
        last = file.read().replace(b"\r", b"\n").rpartition(b"\n")[2]
    if not _is_skipped(last.decode("ascii", errors="replace")):  # within a line of numbers, as a file that was cut off
        left_out = "the last line has no line end and was left out, for its last number may be cut off"
        if len(table) < 2:
            raise refusal(path, "too-short", f"{left_out}; {len(table)} row is left, at least 2 are needed")
        notes.append(left_out)
    if columns.time is None:
        time, unit = request.counted(len(table)), "s"
    else:
        time = table[:, used.index(columns.time)]
    in_seconds = unit is not None and request.time_unit is None  # by its name, unless the caller says another unit
    if unit is not None and in_seconds:
        time = time * SECONDS_OF[unit]
    parts = (columns.positions, columns.velocities, columns.efforts)
    q, u, effort = (table[:, [used.index(i) for i in part]] for part in parts)
    yield Recording(
        path=path,
        name=path.name,
        time=time,
        position_names=tuple(columns.positions.values()),
        positions=q,
        velocity_names=tuple(columns.velocities.values()),
        velocities=u,
        effort_names=tuple(columns.efforts.values()),
        efforts=effort,
        strict_columns=columns.strict,
        in_seconds=in_seconds,
        line_of=partial(_line_of, path, dialect),
        notes=tuple(notes),
    )


@final
@dataclass(frozen=True)
class CsvDialect:
    """How one file is written.

    Attributes:
        delimiter: Between fields; None for white space.
        columns: Names in the header, or the caller's for a table without one.
        header_line: Line of the header, counted from 1.
        commented_header: True if the header was found in a comment line.
    """

    delimiter: str | None
    columns: tuple[str, ...]
    header_line: int
    commented_header: bool = False


def _fields(line: str, delimiter: str | None) -> list[str]:
    """Fields of a line, without quotes and surrounding blanks."""
    line = line.strip("\r\n")
    if delimiter is None or '"' not in line:
        return [field.strip().strip('"').strip() for field in line.split(delimiter)]
    return [field.strip() for field in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]


def _delimiter(line: str) -> str | None:
    bare = re.sub('"[^"]*"', "", line.strip())
    return next((mark for mark in ("\t", ";", ",") if mark in bare), None)


def _unnamed(columns: list[str], rows: list[str], delimiter: str | None) -> tuple[str, ...]:
    """Names of columns, empty for one that only the rows have: a mark at each line's end, or R's names of the rows."""
    fields = [_fields(row, delimiter) for row in rows]
    if not fields or {len(f) for f in fields} != {len(columns) + 1}:
        return tuple(columns)
    if not any(f[-1] for f in fields):
        return (*columns, "")
    is_named = all(row.startswith('"') for row in rows) or [f[0] for f in fields] in (["1"], ["1", "2"])
    return ("", *columns) if is_named else tuple(columns)


def _is_skipped(line: str) -> bool:
    start = line.lstrip()
    return not start or start.startswith(COMMENT_MARKS)


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text file with their numbers, counted from 1.

    Raises:
        RecordingError: Bytes that are no text, or a line beyond a million characters.
    """
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(iter(partial(file.readline, LONGEST_TEXT), ""), 1):
                if len(line) >= LONGEST_TEXT:
                    said = f"this line has more than {LONGEST_TEXT:,} characters; a table with one sample per line is"
                    raise refusal(path, "line-too-long", f"{said} needed", line=number)
                yield number, line
    except UnicodeError as error:
        said = f"this is not UTF-8 text ({reason_of(error)}): save the table as plain UTF-8 text"
        raise refusal(path, "encoding", said) from error


def sniff_dialect(path: Path, request: ReadRequest | None = None) -> CsvDialect:
    """Dialect of a text table, from its header, or with the names of the request if it has none.

    Raises:
        RecordingError: No header, no text, or a header of numbers: joint names are mandatory.
    """
    comment = ""
    lines = text_lines(path)
    for number, line in lines:
        if not _is_skipped(line):
            rows = list(itertools.islice((row for _, row in lines if not _is_skipped(row)), 2))
            return _dialect(path, number, [line, *rows], comment, request)
        comment = line if line.strip() else comment
    needed = "a header with 'time' and the joint names, and rows of numbers are needed"
    raise refusal(path, "empty", f"the file is empty: {needed}")


def _dialect(path: Path, number: int, lines: list[str], comment: str, request: ReadRequest | None) -> CsvDialect:
    """The dialect by the first lines that are no comments, and the comment above them."""
    line, *rows = lines
    delimiter = _delimiter(line)
    fields = _fields(line, delimiter)
    if comment.startswith("%time,"):  # of `rostopic echo -p`, whose header begins like a comment
        raise refusal(path, "messages", MESSAGES, line=number - 1)
    if not all(_NUMBER.fullmatch(f) for f in fields):
        return CsvDialect(delimiter, _unnamed(fields, rows, delimiter), number)
    text = comment.strip().lstrip("".join(COMMENT_MARKS)).strip()
    commented = _fields(text, _delimiter(text)) if text else []
    if len(commented) == len(fields) and not all(_NUMBER.fullmatch(n) for n in commented):
        return CsvDialect(delimiter, tuple(commented), number - 1, commented_header=True)
    if request is None or request.joint_names is None:
        needed = "a header is needed: 'time' and one joint name per column, since columns are matched by name"
        how = ""
        if request is not None:
            first = [float(_fields(text, delimiter)[0].replace(",", ".")) for text in lines]
            rises = len(fields) > request.robot.nv and bool(np.all(np.diff(first) > 0))
            how = names_advice(len(fields), request.robot, stamps=rises)
        said = f"the first line holds numbers ({line.strip()[:60]!r}), {needed}; write it{how}"
        raise refusal(path, "no-header", said, line=number)
    names = request.joint_names
    if len(names) != len(fields):
        said = f"this row has {len(fields)} fields and {len(names)} column names were given ({', '.join(names)})"
        raise refusal(path, "shape", f"{said}: give one for each, '-' for one that is not read", line=number)
    request.uses.use("joint_names")
    return CsvDialect(delimiter, names, number - 1)


def _table(
    path: Path, dialect: CsvDialect, used: list[int], request: ReadRequest, clock: int | None
) -> Float[np.ndarray, "T n"]:
    """The used columns of all rows."""
    usecols = None if len(used) == len(dialect.columns) else used
    lines = _checked_lines(path, dialect, clock)
    try:
        first = next(lines, None)
        if first is None:
            raise refusal(path, "too-short", "there is a header but no row of numbers with a line end; 2 are needed")
        form = {"delimiter": dialect.delimiter, "comments": None, "quotechar": '"'}
        return np.loadtxt(itertools.chain([first], lines), usecols=usecols, ndmin=2, **form)
    except ValueError as error:
        for number, line in _numbered_lines(path, dialect):
            fields = _fields(line, dialect.delimiter)
            i = next((i for i in used if not _NUMBER.fullmatch(fields[i]) and seconds_of(fields[i]) is None), None)
            if i is None:
                continue
            what, name = repr(fields[i][:40]) if fields[i] else "an empty field", dialect.columns[i]
            leave = ""
            if name not in ("time", *request.robot.joint_names) and not request.columns:
                leave = advice("; if it is no joint's: {}", "columns='{joint}'", "--columns '{joint}'")
            text = f"{what} where a number is needed: correct the row or remove it{leave}"
            raise refusal(path, "not-a-number", text, line=number, column=name) from error
        raise refusal(path, "not-a-number", f"the numbers cannot be read: {reason_of(error)}") from error


def _numbered_lines(path: Path, dialect: CsvDialect) -> Iterator[tuple[int, str]]:
    """Data lines with their numbers; blank and comment lines are left out, and a last one without a line end."""
    for number, line in text_lines(path):
        if number > dialect.header_line and line.endswith("\n") and not _is_skipped(line):
            yield number, line


def seconds_of(stamp: str) -> float | None:
    """A date or a time of day (ISO 8601, hh:mm:ss) in seconds, since 1970 or since midnight; None for a number."""
    if day := TIME_OF_DAY.fullmatch(stamp):
        hours, minutes, seconds = (float(part.replace(",", ".")) for part in day.groups())
        return 3600.0 * hours + 60.0 * minutes + seconds
    try:
        date = None if _NUMBER.fullmatch(stamp) else datetime.fromisoformat(stamp)
    except ValueError:
        return None
    return None if date is None else (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def _checked_lines(path: Path, dialect: CsvDialect, clock: int | None) -> Iterator[str]:
    """Data lines for NumPy's parser, each with the right number of fields and decimal points, and seconds for the text
    of a clock in a column.
    """
    delimiter, width = dialect.delimiter, len(dialect.columns)
    comma = point = False  # decimal marks up to here
    for number, line in _numbered_lines(path, dialect):
        fields = len(line.split()) if delimiter is None else line.count(delimiter) + 1
        if fields != width and (fields := len(_fields(line, delimiter))) != width:  # some may stand in quotes
            said = f"this row has {fields} fields, the header has {width} ({DELIMITER_WORDS[delimiter]}-separated)"
            raise refusal(path, "ragged", f"{said}: {line.strip()[:60]!r}; correct the row or remove it", line=number)
        if delimiter != ",":
            comma, point = comma or "," in line, point or "." in line
            if comma and point:
                said = "both ',' and '.' are used in numbers up to here, so it is not known which is the decimal mark"
                how = "write all numbers with one mark and no thousands separator"
                raise refusal(path, "decimal-mark", f"{said}: {line.strip()[:60]!r}; {how}", line=number)
            line = line.replace(",", ".") if comma else line
        if clock is not None:
            parts = _fields(line, delimiter)
            seconds = seconds_of(parts[clock])
            parts[clock] = "?" if seconds is None else repr(seconds)
            line = (delimiter or " ").join(parts)
        yield line


def _line_of(path: Path, dialect: CsvDialect, sample: int) -> int:
    numbers = (number for number, _ in _numbered_lines(path, dialect))
    return next(itertools.islice(numbers, sample, None), dialect.header_line)
