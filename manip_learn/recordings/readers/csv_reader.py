"""Text tables: delimiter, decimal mark and header are found; columns by name; every row is checked."""

from __future__ import annotations

import csv
import itertools
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import NoReturn, final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import RecordingError, advice, closest_names
from manip_learn.recordings.format_words import VELOCITY_SUFFIX, effort_joint
from manip_learn.recordings.readers.column_patterns import (
    Found,
    another_robot,
    by_joint_names,
    by_patterns,
    find_time,
    names_joints,
    numbered_advice,
)
from manip_learn.recordings.readers.limits import LONGEST_TEXT, check_columns
from manip_learn.recordings.readers.name_patterns import PatternError
from manip_learn.recordings.readers.read_request import SECONDS, ReadRequest, names_advice, unmoved_joint_names
from manip_learn.recordings.readers.recording import Recording, reason, refusal
from manip_learn.robot import Robot

COMMENT_MARKS = ("#", "%")
NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.IGNORECASE)
TIME_OF_DAY = re.compile(r"(\d{1,3}):([0-5]?\d):([0-5]?\d(?:[.,]\d*)?)")
DELIMITER_WORDS = {",": "comma", ";": "semicolon", "\t": "tab", None: "white space"}
# what belongs to a message or a data frame, not to the motion
BOOKKEEPING = re.compile(r"(.*[./])?(header[./](seq|frame_id)|seq|frame_id)|unnamed: 0", re.IGNORECASE)
SURPLUS_SUFFIXES = ("_effort", "_torque", "_acceleration")  # of columns that belong to a joint but are not needed
SHOWN = 6  # names in a sentence


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of a text table."""
    dialect = sniff_dialect(path, request)
    if dialect.named_by_caller:
        request.uses.use("joint_names")
    columns = columns_of(path, dialect, request)
    dialect = replace(dialect, without_cut_line=_is_cut_off(path, dialect))
    first, at = dialect.split(next(_numbered_lines(path, dialect), (0, ""))[1]), columns.time
    if at is not None and seconds_of(first[at : at + 1]):
        columns = replace(columns, unit="s", as_clock=True)
    table = _table(path, dialect, columns, request)
    notes = [f"the header was read from the comment in line {dialect.header_line}"] if dialect.commented_header else []
    notes += columns.notes
    if dialect.without_cut_line:
        left_out = "the last line has no line end and was left out, for its last number may be cut off"
        if len(table) < 2:
            raise refusal(path, "too-short", f"{left_out}; {len(table)} row is left, at least 2 are needed")
        notes.append(left_out)
    yield _recording(path, dialect, request, columns, table, notes)


@final
@dataclass(frozen=True)
class CsvDialect:
    """How one file is written.

    Attributes:
        delimiter: Between fields; None for white space.
        columns: Names in the header.
        header_line: Line of the header, counted from 1.
        commented_header: True if the header was found in a comment line.
        without_cut_line: True if a last line without a line end is not read.
        named_by_caller: True if there is no header, and the names are the caller's.
    """

    delimiter: str | None
    columns: tuple[str, ...]
    header_line: int
    commented_header: bool = False
    without_cut_line: bool = False
    named_by_caller: bool = False

    def split(self, line: str) -> list[str]:
        """Fields of a line, without quotes and surrounding blanks."""
        return _fields(line, self.delimiter)


def _fields(line: str, delimiter: str | None) -> list[str]:
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
    """True for blank lines and comment lines."""
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
        said = f"this is not UTF-8 text ({reason(error)}): save the table as plain UTF-8 text"
        raise refusal(path, "encoding", said) from error


def _is_cut_off(path: Path, dialect: CsvDialect) -> bool:
    """True if the file ends within a line of numbers, as one that was cut off."""
    with path.open("rb") as file:
        file.seek(-min(path.stat().st_size, LONGEST_TEXT), os.SEEK_END)
        end = file.read()
    last = end.replace(b"\r", b"\n").rpartition(b"\n")[2]
    return not _is_skipped(last.decode("ascii", errors="replace"))


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
    above = partial(CsvDialect, delimiter, header_line=number - 1)
    if comment.startswith("%time,"):  # of `rostopic echo -p`, whose header begins like a comment
        raise _of_messages(path, number - 1)
    if not all(NUMBER.fullmatch(f) for f in fields):
        return CsvDialect(delimiter, _unnamed(fields, rows, delimiter), number)
    text = comment.strip().lstrip("".join(COMMENT_MARKS)).strip()
    commented = _fields(text, _delimiter(text)) if text else []
    if len(commented) == len(fields) and not all(NUMBER.fullmatch(n) for n in commented):
        return above(tuple(commented), commented_header=True)
    names = None if request is None else request.joint_names
    if names is None:
        needed = "a header is needed: 'time' and one joint name per column, since columns are matched by name"
        said = f"the first line holds numbers ({line.strip()[:60]!r}), {needed}"
        how = ""
        if request is not None:
            first = [float(_fields(text, delimiter)[0].replace(",", ".")) for text in lines]
            rises = len(fields) > request.robot.nv and bool(np.all(np.diff(first) > 0))
            how = names_advice(len(fields), request.robot, stamps=rises)
        raise refusal(path, "no-header", f"{said}; write it{how}", line=number)
    if len(names) != len(fields):
        said = f"this row has {len(fields)} fields and {len(names)} column names were given ({', '.join(names)})"
        raise refusal(path, "shape", f"{said}: give one for each, '-' for one that is not read", line=number)
    return above(names, named_by_caller=True)


@final
@dataclass(frozen=True)
class Columns:
    """Columns of a table.

    Attributes:
        time: Column of the stamps; None where they are counted at the rate that the caller gives.
        unit: Unit of the stamps where their name says it.
        joints: Columns of the joints.
        strict: Whether a name that is no joint's is a mistake.
        notes: What the caller should know.
        as_clock: True where stamps are dates or times of day, which become seconds.
    """

    time: int | None
    unit: str | None
    joints: Found
    strict: bool
    notes: tuple[str, ...]
    as_clock: bool = False

    @property
    def used(self) -> list[int]:
        """Columns that are read."""
        stamps = () if self.time is None else (self.time,)
        return sorted({*stamps, *self.joints.positions, *self.joints.velocities, *self.joints.efforts})


def columns_of(path: Path, dialect: CsvDialect, request: ReadRequest) -> Columns:
    """The columns of a table."""
    check_columns(path, "its header", len(dialect.columns))
    names: list[str | None] = []
    for raw, name in zip(dialect.columns, request.renamed(*dialect.columns), strict=True):
        is_unread = not name and dialect.named_by_caller
        names.append(None if is_unread or request.ignores(raw, *([name] if name else [])) else name)
    time = find_time(names)
    if time.column is not None:
        names[time.column] = "time"
    elif request.rate is None:
        raise _no_time(path, dialect, names, time.choices)
    left_out = [i for i in time.others if request.columns or names[i] not in request.robot.joint_names]
    left_out += [i for i, n in enumerate(names) if n is not None and BOOKKEEPING.fullmatch(n)]
    left_out += [i for i, n in enumerate(names) if n == ""]
    found = _joint_columns(path, dialect, names, request)
    if found is not None:
        kept = {*found.positions, *found.velocities, *found.efforts, time.column}
        left_out = [i for i, n in enumerate(names) if n is not None and i not in kept]
    notes = [time.note, "" if found is None else found.note]
    if left_out:
        words = [dialect.columns[i] or f"column {i + 1} (without a name)" for i in sorted(set(left_out))]
        more = f" and {len(words) - SHOWN} more" if len(words) > SHOWN else ""
        notes.append(f"columns not used: {', '.join(words[:SHOWN])}{more}")
    meant = {i: n for i, n in enumerate(names) if n is not None and i not in {*left_out, time.column}}
    for i, name in meant.items():
        if name == "time" or name in [meant[k] for k in meant if k < i]:
            raise _header_error(path, dialect, "duplicate-column", f"two columns are called {name!r}: keep one")
    joints, surplus = _called_as_joints(meant, request.robot) if found is None else (found, [])
    notes += [f"not needed and not used: {', '.join(surplus)}"] if surplus else []
    return Columns(time.column, time.unit, joints, found is None, tuple(filter(None, notes)))


def _called_as_joints(names: dict[int, str], robot: Robot) -> tuple[Found, list[str]]:
    """Columns by their names, `joint1`, `joint1_velocity` or `joint1_effort`; and names that are not needed."""
    own, surplus = robot.joint_names, list[str]()
    q, u, effort = dict[int, str](), dict[int, str](), dict[int, str]()
    for i, name in names.items():
        if joint := effort_joint(name, (*own, *unmoved_joint_names(robot))):
            effort[i] = joint
        elif _base_name(name, SURPLUS_SUFFIXES, own):
            surplus.append(name)
        elif joint := _base_name(name, (VELOCITY_SUFFIX,), own):
            u[i] = joint
        else:
            q[i] = name
    return Found(q, u, "", effort), surplus


def _joint_columns(path: Path, dialect: CsvDialect, names: list[str | None], request: ReadRequest) -> Found | None:
    """Columns of the joints, by the caller's patterns or by the header; None where they are called as the joints."""
    robot = request.robot
    moving, still = robot.joint_names, unmoved_joint_names(robot)
    is_called_so = any(n in moving for n in names)
    if not is_called_so and names_joints(names, next(_rows(path, dialect), [""] * len(names)), (*moving, *still)):
        raise _of_messages(path, dialect.header_line)
    try:
        if request.columns:
            request.uses.use("columns")
            return by_patterns(request.columns, names, moving, still)
        if is_called_so or robot.objects:
            return None
        found = by_joint_names(names, moving, still)
    except PatternError as error:
        raise _header_error(path, dialect, "columns", str(error)) from error
    if found is not None:
        return found
    what = numbered_advice(names, moving)
    if what:
        text = f"{another_robot(names, robot)}; if it is this one, {what}"
        raise _header_error(path, dialect, "numbered-columns", text)
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
    hint += advice("; without time stamps, pass {}", "rate=<samples per second>", "--rate <samples per second>")
    shown = ", ".join(map(repr, dialect.columns[:8])) + (" ..." if len(dialect.columns) > 8 else "")
    text = f"there is no column 'time'; the {DELIMITER_WORDS[dialect.delimiter]}-separated header has {shown}{hint}"
    return _header_error(path, dialect, "no-time", text)


def _of_messages(path: Path, line: int) -> RecordingError:
    """The refusal of what `rostopic echo -p` and bagpy write."""
    said = "this is a table of the messages in a ROS bag (rostopic echo -p, bagpy): give the bag itself, it is read"
    return refusal(path, "messages", said, line=line)


def _header_error(path: Path, dialect: CsvDialect, code: str, text: str) -> RecordingError:
    return refusal(path, code, text, line=dialect.header_line)


def _recording(
    path: Path, dialect: CsvDialect, request: ReadRequest, columns: Columns, table: np.ndarray, notes: list[str]
) -> Recording:
    """The used columns, each as what its name says."""
    place = {column: k for k, column in enumerate(columns.used)}
    q, u, effort = (
        (tuple(part.values()), table[:, [place[i] for i in part]])
        for part in (columns.joints.positions, columns.joints.velocities, columns.joints.efforts)
    )
    unit = columns.unit
    if columns.time is None:
        time, unit = request.counted(len(table)), "s"
    else:
        time = table[:, place[columns.time]]
    in_seconds = unit is not None and request.time_unit is None  # by its name, unless the caller says another unit
    if unit is not None and in_seconds:
        time = time * SECONDS[unit]
    return Recording(
        path=path,
        name=path.name,
        time=time,
        position_names=q[0],
        positions=q[1],
        velocity_names=u[0],
        velocities=u[1] if u[0] else None,
        effort_names=effort[0],
        efforts=effort[1] if effort[0] else None,
        strict_columns=columns.strict,
        in_seconds=in_seconds,
        line_of=partial(_line_of, path, dialect),
        notes=tuple(notes),
    )


def _base_name(name: str, suffixes: tuple[str, ...], own_names: tuple[str, ...]) -> str | None:
    """`joint1` for `joint1_velocity`, unless the robot has a joint that is really called so."""
    if name in own_names:
        return None
    return next((name.removesuffix(s) for s in suffixes if name.endswith(s) and name != s), None)


def _table(path: Path, dialect: CsvDialect, columns: Columns, request: ReadRequest) -> Float[np.ndarray, "T n"]:
    """The used columns of all rows."""
    used = columns.used
    usecols = None if len(used) == len(dialect.columns) else used
    lines = _checked_lines(path, dialect, columns.time if columns.as_clock else None)
    try:
        first = next(lines, None)
        if first is None:
            cut = " with a line end" if dialect.without_cut_line else ""
            raise refusal(path, "too-short", f"there is a header but no row of numbers{cut}; 2 are needed")
        form = {"delimiter": dialect.delimiter, "comments": None, "quotechar": '"'}
        return np.loadtxt(itertools.chain([first], lines), usecols=usecols, ndmin=2, **form)
    except ValueError as error:
        _explain(path, dialect, used, request, error)


def _numbered_lines(path: Path, dialect: CsvDialect) -> Iterator[tuple[int, str]]:
    """Data lines with their numbers; blank and comment lines are left out."""
    for number, line in text_lines(path):
        if dialect.without_cut_line and not line.endswith("\n"):
            return
        if number > dialect.header_line and not _is_skipped(line):
            yield number, line


def _rows(path: Path, dialect: CsvDialect) -> Iterator[list[str]]:
    """Fields of the data lines, at least as many as there are columns."""
    for _, line in _numbered_lines(path, dialect):
        fields = dialect.split(line)
        yield [*fields, *[""] * (len(dialect.columns) - len(fields))]


def seconds_of(stamp: list[str]) -> list[str]:
    """A date or a time of day (ISO 8601, hh:mm:ss) as seconds, since 1970 or since midnight; nothing of a number."""
    text = stamp[0] if stamp else ""
    if day := TIME_OF_DAY.fullmatch(text):
        hours, minutes, seconds = (float(part.replace(",", ".")) for part in day.groups())
        return [repr(3600.0 * hours + 60.0 * minutes + seconds)]
    try:
        date = datetime.fromisoformat(text) if not NUMBER.fullmatch(text) else None
    except ValueError:
        date = None
    if date is None:
        return []
    return [repr((date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp())]


def _checked_lines(path: Path, dialect: CsvDialect, clock: int | None) -> Iterator[str]:
    """Data lines for NumPy's parser, each with the right number of fields and decimal points, and seconds for the text
    of a clock in a column.
    """
    delimiter, width = dialect.delimiter, len(dialect.columns)
    comma = point = False  # decimal marks up to here
    for number, line in _numbered_lines(path, dialect):
        fields = len(line.split()) if delimiter is None else line.count(delimiter) + 1
        if fields != width and (fields := len(dialect.split(line))) != width:  # some may stand in quotes
            said = f"this row has {fields} fields, the header has {width} ({DELIMITER_WORDS[delimiter]}-separated)"
            raise refusal(path, "ragged", f"{said}: {line.strip()[:60]!r}; correct the row or remove it", line=number)
        if delimiter != ",":
            comma, point = comma or "," in line, point or "." in line
            if comma and point:
                text = (
                    "both ',' and '.' are used in numbers up to here, so it is not known which one is the decimal "
                    f"mark: {line.strip()[:60]!r}; write all numbers with one mark and no thousands separator"
                )
                raise refusal(path, "decimal-mark", text, line=number)
            line = line.replace(",", ".") if comma else line
        if clock is not None:
            parts = dialect.split(line)
            line = (delimiter or " ").join(
                [*parts[:clock], *(seconds_of(parts[clock : clock + 1]) or ["?"]), *parts[clock + 1 :]]
            )
        yield line


def _explain(path: Path, dialect: CsvDialect, used: list[int], request: ReadRequest, cause: ValueError) -> NoReturn:
    """Raise the error that names the field which NumPy's parser refused."""
    for number, line in _numbered_lines(path, dialect):
        fields = dialect.split(line)
        i = next((i for i in used if not NUMBER.fullmatch(fields[i]) and not seconds_of(fields[i : i + 1])), None)
        if i is None:
            continue
        what, name = repr(fields[i][:40]) if fields[i] else "an empty field", dialect.columns[i]
        leave = ""
        if name not in ("time", *request.robot.joint_names) and not request.columns:
            leave = advice("; if it is no joint's: {}", "columns='{joint}'", "--columns '{joint}'")
        text = (
            f"{path.name}:{number}, column {name!r}: {what} where a number is needed: correct the row or remove it"
            f"{leave}"
        )
        raise RecordingError(text, code="not-a-number", path=path, line=number, column=name) from cause
    raise refusal(path, "not-a-number", f"the numbers cannot be read: {reason(cause)}") from cause


def _line_of(path: Path, dialect: CsvDialect, sample: int) -> int:
    numbers = (number for number, _ in _numbered_lines(path, dialect))
    return next(itertools.islice(numbers, sample, None), dialect.header_line)
