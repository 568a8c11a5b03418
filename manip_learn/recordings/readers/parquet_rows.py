"""Some columns of a Parquet file, row by row."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from manip_learn.recordings.readers.parquet_file import opened_parquet


def parquet_rows(file: Path, columns: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Some columns of a Parquet file, row by row; a column that is missing is left out.

    Raises:
        RecordingError: Damaged.
        MissingExtraError: The extra `lerobot` is not installed.
    """
    with opened_parquet(file) as parquet:
        there = [c for c in columns if c in parquet.schema_arrow.names]
        if columns[0] not in there:
            yield {columns[0]: 0}  # a file without episode numbers is one episode
            return
        for batch in parquet.iter_batches(columns=there):
            yield from batch.to_pylist()
