"""Text tables: `time` [s], a column per joint, where recorded `<joint>_velocity`, `<joint>_effort`. Strictly read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, NoReturn

import numpy as np
from jaxtyping import Float

from manip_learn.errors import RecordingError, advice
from manip_learn.recordings.readers.column_patterns import effort_joint
from manip_learn.recordings.readers.csv_columns import columns_of
from manip_learn.recordings.readers.csv_dialect import (
    DELIMITER_WORDS,
    LONGEST_LINE,
    NUMBER,
    CsvDialect,
    is_cut_off,
    is_skipped,
    line_too_long,
    not_text,
    sniff_dialect,
)
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording, reason
from manip_learn.recordings.validation.unmoved_joints import unmoved_joint_names
from manip_learn.recordings.writers.csv_writer import VELOCITY_SUFFIX

# columns that belong to a joint but are not needed here
SURPLUS_SUFFIXES = ("_effort", "_torque", "_acceleration")


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of a text table.

    Raises:
        RecordingError: Names file, line and column, the value seen and the value expected.
    """
    dialect = sniff_dialect(path, request.joint_names)
    if dialect.named_by_caller:
        request.uses.use("joint_names")
    columns = columns_of(path, dialect, request)
    names = columns.names
    used = [i for i, name in enumerate(names) if name is not None]
    cut = is_cut_off(path, dialect) and request.last_line == "drop"
    dialect = replace(dialect, without_cut_line=cut)
    table = _table(path, dialect, used, request)
    kept = [str(names[i]) for i in used]
    notes = [f"the header was read from the comment in line {dialect.header_line}"] if dialect.commented_header else []
    notes += columns.notes
    if cut and len(table) < 2:
        raise RecordingError(
            f"{path.name}: there is {len(table)} row of numbers beside the last line, which has no line end and may be "
            "cut off; at least 2 are needed" + advice("; {} reads it", "last_line='keep'", "--last-line keep"),
            code="too-short",
            path=path,
        )
    if cut:
        notes.append(
            "the last line has no line end and was left out, for its last number may be cut off"
            + advice("; if the file is whole, pass {}", "last_line='keep'", "--last-line keep")
        )
    own = request.robot.joint_names
    effort = {n: effort_joint(n, (*own, *unmoved_joint_names(request.robot))) for n in kept}
    surplus = [n for n in kept if not effort[n] and _base_name(n, SURPLUS_SUFFIXES, own)]
    if surplus:
        notes.append(f"not needed and not used: {', '.join(surplus)}")
    velocity = {n: _base_name(n, (VELOCITY_SUFFIX,), own) for n in kept}
    v = [i for i, n in enumerate(kept) if velocity[n] and n not in surplus]
    e = [i for i, n in enumerate(kept) if effort[n] and n not in surplus]
    beside = {*v, *e, *(i for i, n in enumerate(kept) if n in surplus or used[i] in columns.time)}
    p = [i for i in range(len(kept)) if i not in beside]
    yield Recording(
        path=path,
        name=path.name,
        time=columns.stamps(table, used, request),
        position_names=tuple(kept[i] for i in p),
        positions=table[:, p],
        velocity_names=tuple(str(velocity[kept[i]]) for i in v),
        velocities=table[:, v] if v else None,
        effort_names=tuple(str(effort[kept[i]]) for i in e),
        efforts=table[:, e] if e else None,
        strict_columns=columns.strict,
        in_seconds=columns.in_seconds(request),
        line_of=partial(_line_of, path, dialect),
        notes=tuple(notes),
    )


def _base_name(name: str, suffixes: tuple[str, ...], own_names: tuple[str, ...]) -> str | None:
    """`joint1` for `joint1_velocity`, unless the robot has a joint that is really called so."""
    if name in own_names:
        return None
    return next((name.removesuffix(s) for s in suffixes if name.endswith(s) and name != s), None)


def _table(path: Path, dialect: CsvDialect, used: list[int], request: ReadRequest) -> Float[np.ndarray, "T n"]:
    """The used columns of all rows.

    Raises:
        RecordingError: Text in a number, ragged rows, mixed decimal marks, no rows.
    """
    usecols = None if len(used) == len(dialect.columns) else used
    try:
        with path.open(encoding=dialect.encoding) as file:
            lines = _checked_lines(file, path, dialect)
            first = next(lines, None)
            if first is None:
                cut = " with a line end" if dialect.without_cut_line else ""
                cut += advice(" ({} reads one without)", "last_line='keep'", "--last-line keep") if cut else ""
                raise RecordingError(
                    f"{path.name}: there is a header but no row of numbers{cut}", code="too-short", path=path
                )
            return np.loadtxt(
                _chained(first, lines),
                delimiter=dialect.delimiter,
                comments=None,
                quotechar='"',
                usecols=usecols,
                ndmin=2,
            )
    except UnicodeError as error:
        raise not_text(path, error) from error
    except ValueError as error:
        _explain(path, dialect, used, request, error)


def _chained(first: str, rest: Iterator[str]) -> Iterator[str]:
    yield first
    yield from rest


def _numbered_lines(file: IO[str], path: Path, dialect: CsvDialect) -> Iterator[tuple[int, str]]:
    """Data lines with their numbers; blank and comment lines are left out."""
    number = 0
    while line := file.readline(LONGEST_LINE):
        number += 1
        if len(line) >= LONGEST_LINE:
            raise line_too_long(path, number)
        if dialect.without_cut_line and not line.endswith("\n"):
            return
        if number > dialect.header_line and not is_skipped(line):
            yield number, line


def _checked_lines(file: IO[str], path: Path, dialect: CsvDialect) -> Iterator[str]:
    """Data lines for NumPy's parser, each with the right number of fields and decimal points."""
    delimiter, width = dialect.delimiter, len(dialect.columns)
    comma_possible = delimiter != ","
    mark_line: dict[str, int] = {}
    for number, line in _numbered_lines(file, path, dialect):
        fields = len(line.split()) if delimiter is None else line.count(delimiter) + 1
        if fields != width:
            raise RecordingError(
                f"{path.name}:{number}: this row has {fields} fields, the header has {width} "
                f"({DELIMITER_WORDS[delimiter]}-separated): {line.strip()[:60]!r}",
                code="ragged",
                path=path,
                line=number,
            )
        if comma_possible and "," in line:
            mark_line.setdefault(",", number)
            if "." in line or "." in mark_line:
                raise _mixed_marks(path, number, line)
            line = line.replace(",", ".")
        elif comma_possible and "." in line:
            mark_line.setdefault(".", number)
            if "," in mark_line:
                raise _mixed_marks(path, number, line)
        yield line


def _mixed_marks(path: Path, number: int, line: str) -> RecordingError:
    return RecordingError(
        f"{path.name}:{number}: both ',' and '.' are used in numbers up to here, so it is not known which one is the "
        f"decimal mark: {line.strip()[:60]!r}; write all numbers with one mark and no thousands separator",
        code="decimal-mark",
        path=path,
        line=number,
    )


def _explain(path: Path, dialect: CsvDialect, used: list[int], request: ReadRequest, cause: ValueError) -> NoReturn:
    """Raise the error that names the field which NumPy's parser refused."""
    wanted = set(used)
    with path.open(encoding=dialect.encoding) as file:
        for number, line in _numbered_lines(file, path, dialect):
            for i, field in enumerate(dialect.split(line)):
                if i in wanted and not NUMBER.fullmatch(field):
                    what = "an empty field" if not field else repr(field[:40])
                    name = dialect.columns[i]
                    other = name not in ("time", *request.robot.joint_names) and not request.columns
                    leave = advice("; if it is no joint's: {}", "columns='{joint}'", "--columns '{joint}'")
                    raise RecordingError(
                        f"{path.name}:{number}, column {name!r}: {what} where a number is needed: "
                        f"correct the row or remove it{leave if other else ''}",
                        code="not-a-number",
                        path=path,
                        line=number,
                        column=name,
                    ) from cause
    raise RecordingError(
        f"{path.name}: the numbers cannot be read: {reason(cause)}", code="not-a-number", path=path
    ) from cause


def _line_of(path: Path, dialect: CsvDialect, sample: int) -> int:
    with path.open(encoding=dialect.encoding) as file:
        for i, (number, _) in enumerate(_numbered_lines(file, path, dialect)):
            if i == sample:
                return number
    return dialect.header_line
