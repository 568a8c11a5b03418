"""How a text table is written: encoding, delimiter, decimal mark and header."""

from __future__ import annotations

import codecs
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO, final

from manip_learn.errors import RecordingError, advice
from manip_learn.recordings.readers.recording import reason

LONGEST_LINE = 1_000_000
COMMENT_MARKS = ("#", "%")
STAMPED = "%time,"  # `rostopic echo -p` begins its header like a comment
NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.IGNORECASE)
DELIMITER_WORDS = {",": "comma", ";": "semicolon", "\t": "tab", None: "white space"}


@final
@dataclass(frozen=True)
class CsvDialect:
    """How one file is written.

    Attributes:
        encoding: Of the text.
        delimiter: Between fields; None for white space.
        columns: Names in the header.
        header_line: Line of the header, counted from 1.
        commented_header: True if the header was found in a comment line.
        without_cut_line: True if a last line without a line end is not read.
        named_by_caller: True if there is no header, and the names are the caller's.
    """

    encoding: str
    delimiter: str | None
    columns: tuple[str, ...]
    header_line: int
    commented_header: bool = False
    without_cut_line: bool = False
    named_by_caller: bool = False

    def split(self, line: str) -> list[str]:
        """Fields of a line, without quotes and surrounding blanks."""
        return [field.strip().strip('"').strip() for field in line.strip("\r\n").split(self.delimiter)]


def is_skipped(line: str) -> bool:
    """True for blank lines and comment lines."""
    start = line.lstrip()
    return not start or start.startswith(COMMENT_MARKS)


def encoding_of(path: Path) -> str:
    """Encoding by the byte order mark; UTF-8 without one."""
    with path.open("rb") as file:
        head = file.read(4)
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    return "utf-8-sig"


def is_cut_off(path: Path, dialect: CsvDialect) -> bool:
    """True if the file ends within a line of numbers, as one that was cut off."""
    with path.open("rb") as file:
        file.seek(-min(path.stat().st_size, LONGEST_LINE), os.SEEK_END)
        end = file.read()
    if dialect.encoding == "utf-16":
        end = end.replace(b"\x00", b"")  # line ends, blanks and comment marks are ASCII
    last = end.replace(b"\r", b"\n").rpartition(b"\n")[2]
    return not is_skipped(last.decode("ascii", errors="replace"))


def sniff_dialect(path: Path, names: tuple[str, ...] | None = None) -> CsvDialect:
    """Dialect of a text table, from its header; `names` are those of its columns if it has none.

    Raises:
        RecordingError: No header, no text, or a header of numbers: joint names are mandatory.
    """
    encoding = encoding_of(path)
    try:
        with path.open(encoding=encoding) as file:
            number, line, comment = _first_line(file, path)
    except UnicodeError as error:
        raise not_text(path, error) from error
    dialect = CsvDialect(encoding, _delimiter(line), (), number)
    fields = dialect.split(line)
    if comment.startswith(STAMPED) and len(echoed := CsvDialect("", ",", (), 0).split(comment)) == len(fields):
        return CsvDialect(encoding, dialect.delimiter, tuple(echoed), number - 1, commented_header=True)
    if fields and all(NUMBER.fullmatch(f) for f in fields):
        commented = _split_comment(comment)
        if len(commented) == len(fields) and not all(NUMBER.fullmatch(n) for n in commented):
            return CsvDialect(encoding, dialect.delimiter, tuple(commented), number - 1, commented_header=True)
        if names is None:
            raise RecordingError(
                f"{path.name}:{number}: the first line holds numbers ({line.strip()[:60]!r}), a header is needed: "
                "'time' and one joint name per column, since columns are matched by name"
                + advice("; write it, or pass {}", "joint_names=['time', ...]", "--joint-names time,NAME,..."),
                code="no-header",
                path=path,
                line=number,
            )
        if len(names) != len(fields):
            raise RecordingError(
                f"{path.name}:{number}: this row has {len(fields)} fields and {len(names)} column names were given "
                f"({', '.join(names)}): give one for each, 'time' among them",
                code="shape",
                path=path,
                line=number,
            )
        return CsvDialect(encoding, dialect.delimiter, names, number - 1, named_by_caller=True)
    return CsvDialect(encoding, dialect.delimiter, tuple(fields), number)


def _first_line(file: IO[str], path: Path) -> tuple[int, str, str]:
    """Number and text of the first line that is no comment, and the last comment before it."""
    comment = ""
    number = 0
    while line := file.readline(LONGEST_LINE):
        number += 1
        if len(line) >= LONGEST_LINE:
            raise line_too_long(path, number)
        if not is_skipped(line):
            return number, line, comment
        comment = line if line.strip() else comment
    raise RecordingError(
        f"{path.name}: the file is empty: a header with 'time' and the joint names, and rows of numbers are needed",
        code="empty",
        path=path,
    )


def _delimiter(line: str) -> str | None:
    for mark in ("\t", ";", ","):
        if mark in line.strip():
            return mark
    return None


def _split_comment(comment: str) -> list[str]:
    text = comment.strip().lstrip("".join(COMMENT_MARKS)).strip()
    return CsvDialect("", _delimiter(text), (), 0).split(text) if text else []


def line_too_long(path: Path, line: int) -> RecordingError:
    """The refusal of a line beyond a million characters."""
    return RecordingError(
        f"{path.name}:{line}: this line has more than {LONGEST_LINE:,} characters; a table with one sample per line "
        "is needed",
        code="line-too-long",
        path=path,
        line=line,
    )


def not_text(path: Path, error: UnicodeError) -> RecordingError:
    """The refusal of bytes that are no text."""
    return RecordingError(
        f"{path.name}: this is not UTF-8 text ({reason(error)}): save the table as plain UTF-8 text",
        code="encoding",
        path=path,
    )
