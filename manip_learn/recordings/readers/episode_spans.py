"""First and last episode of a Parquet file of LeRobot data, without its other columns; for the parsing process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from manip_learn.recordings.readers.parquet_file import opened_parquet

FIRST, LAST = "first", "last"


def parquet_rows(file: Path, columns: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """One row: the first and the last value of the column, or nothing if it is not there or has no values.

    Raises:
        RecordingError: Damaged.
        MissingExtraError: The extra `lerobot` is not installed.
    """
    with opened_parquet(file) as parquet:
        if columns[0] not in parquet.schema_arrow.names:
            return
        column = parquet.read(columns=[columns[0]]).column(0)
        if len(column) and not column.null_count:
            yield {FIRST: int(column[0].as_py()), LAST: int(column[len(column) - 1].as_py())}
