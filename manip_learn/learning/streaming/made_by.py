"""Passes made by this process, or by a cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from manip_learn.learning.streaming.executor import LocalPasses, Passes, Progress
from manip_learn.learning.streaming.sample_stream import Reading


@contextmanager
def made_by(client: Any, reading: Reading, progress: Progress | None = None) -> Iterator[Passes]:
    """Passes made by the workers of a dask client, or by this process without one.

    Raises:
        MissingExtraError: A client is given, and dask is not installed.
    """
    if client is None:
        yield LocalPasses(reading, progress)
        return
    from manip_learn.learning.streaming.dask_executor import dask_passes

    with dask_passes(client, reading, progress) as passes:
        yield passes
