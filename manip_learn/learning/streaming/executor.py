"""Passes over all samples of a source, made by this process or by the workers of a dask client."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, final

from manip_learn.learning.streaming.accumulator import Accumulator, Executor, accumulate_part, merge_tree
from manip_learn.learning.streaming.sample_stream import SampleStream
from manip_learn.recordings.trajectory_source import Progress


@final
class LocalExecutor(Executor):
    """Part after part in this process, each read anew in each pass: memory does not grow with the samples.

    Args:
        stream: The samples.
        progress: Told how far a pass is.
    """

    def __init__(self, stream: SampleStream, progress: Progress | None = None):
        self._stream = stream
        self._progress = progress

    def total(self, accumulator: Accumulator, first_trajectories: dict[int, int], title: str) -> Any:
        """One pass."""
        return merge_tree(accumulator, self._parts(accumulator, first_trajectories, title))

    def _parts(self, accumulator: Accumulator, first_trajectories: dict[int, int], title: str) -> Iterator[Any]:
        n = self._stream.source.n_parts
        for part in range(n):
            notes: list[str] = []
            read = self._stream.chunks(part, notes)
            yield accumulate_part(accumulator, read, first_trajectories.get(part, 0), notes)
            if self._progress is not None:
                self._progress(title, (part + 1) / n)


@contextmanager
def open_executor(client: Any, stream: SampleStream, progress: Progress | None = None) -> Iterator[Executor]:
    """The executor for one fit: the workers of a dask client, or this process without one.

    Raises:
        MissingExtraError: A client is given, and dask is not installed.
    """
    if client is None:
        yield LocalExecutor(stream, progress)
        return
    from manip_learn.learning.streaming.dask_executor import connected_executor

    with connected_executor(client, stream, progress) as executor:
        yield executor
