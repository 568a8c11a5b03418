"""Some columns of a Parquet file, row by row."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.readers.recording import reason


def parquet_rows(file: Path, columns: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Some columns of a Parquet file, row by row; a column that is missing is left out.

    Raises:
        RecordingError: Damaged.
        MissingExtraError: The extra `lerobot` is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise MissingExtraError("reading LeRobot data", "lerobot") from error
    try:
        with pq.ParquetFile(file) as parquet:
            there = [c for c in columns if c in parquet.schema_arrow.names]
            if columns[0] not in there:
                yield {columns[0]: 0}  # a file without episode numbers is one episode
                return
            for batch in parquet.iter_batches(columns=there):
                yield from batch.to_pylist()
    except (pa.ArrowException, OSError, ValueError, KeyError, NotImplementedError, RuntimeError) as error:
        raise RecordingError(
            f"{file.name}: the Parquet file cannot be read ({reason(error)}): download or write it again",
            code="damaged",
            path=file,
        ) from error
