"""An open Parquet file, whose damage is told in one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from manip_learn.errors import DAMAGE, MissingExtraError, RecordingError
from manip_learn.recordings.readers.recording import reason


@contextmanager
def opened_parquet(file: Path) -> Iterator[Any]:
    """A `pyarrow.parquet.ParquetFile`, closed at the end.

    Raises:
        RecordingError: Damaged, found when it is opened or while it is read.
        MissingExtraError: The extra `lerobot` is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise MissingExtraError("reading LeRobot data", "lerobot") from error
    try:
        with pq.ParquetFile(file) as parquet:
            yield parquet
    except (pa.ArrowException, *DAMAGE) as error:
        raise RecordingError(
            f"{file.name}: the Parquet file cannot be read ({reason(error)}): download or write it again",
            code="damaged",
            path=file,
        ) from error
