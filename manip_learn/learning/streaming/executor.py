"""Passes over all samples of a source, made by this process or by the workers of a dask client."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, final

from manip_learn.learning.streaming.accumulator import Accumulator, Chunk, Executor, accumulate_part, merge_tree
from manip_learn.learning.streaming.sample_stream import SampleStream
from manip_learn.recordings.trajectory_source import Progress

# of postures and velocities that are kept from one pass to the next: a million samples of a 7-joint arm
KEPT_BYTES = 128_000_000


@final
class LocalExecutor(Executor):
    """Part after part in this process: the first ones are kept in memory, the others are read anew in each pass.

    Memory does not grow with the samples beyond KEPT_BYTES; what is kept is what reading again would yield.

    Args:
        stream: The samples.
        progress: Told how far a pass is.
    """

    def __init__(self, stream: SampleStream, progress: Progress | None = None):
        self._stream = stream
        self._progress = progress
        self._kept: dict[int, tuple[list[Chunk], list[str]]] = {}
        self._room = KEPT_BYTES

    def total(self, accumulator: Accumulator, first_trajectories: dict[int, int], title: str) -> Any:
        """One pass."""
        return merge_tree(accumulator, self._parts(accumulator, first_trajectories, title))

    def _parts(self, accumulator: Accumulator, first_trajectories: dict[int, int], title: str) -> Iterator[Any]:
        n = self._stream.source.n_parts
        for part in range(n):
            samples, notes = self._samples(part)
            yield accumulate_part(accumulator, samples, first_trajectories.get(part, 0), notes)
            if self._progress is not None:
                self._progress(title, (part + 1) / n)

    def _samples(self, part: int) -> tuple[Iterable[Chunk], list[str]]:
        """The samples of a part, and a list that holds the notes of its reader when all samples have been taken."""
        if part in self._kept:
            return self._kept[part]
        notes: list[str] = []
        samples = self._stream.chunks(part, notes)
        return (samples if self._room <= 0 else self._keeping(part, samples, notes)), notes

    def _keeping(self, part: int, samples: Iterator[Chunk], notes: list[str]) -> Iterator[Chunk]:
        """The samples, and the whole part kept if there is room for it."""
        held: list[Chunk] = []
        for chunk in samples:
            if self._room > 0:
                held.append(chunk)
                self._room -= chunk.q.nbytes + chunk.u.nbytes + chunk.trajectory.nbytes
                if self._room <= 0:
                    held = []
            yield chunk
        if self._room > 0:
            self._kept[part] = held, notes


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
