"""Passes over all samples of a source, in an order of sums that depends on the data alone, whoever makes them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar, final

import numpy as np

from manip_learn.learning.streaming.sample_stream import Chunk, SampleStream, chunks
from manip_learn.recordings.trajectory_source import Progress

# of postures and velocities that are kept from one pass to the next: a million samples of a 7-joint arm
KEPT_BYTES = 128_000_000
Total = TypeVar("Total")


class Accumulator(ABC):
    """What a pass gathers: the total of a chunk, and how totals are merged. Picklable."""

    @abstractmethod
    def of(self, chunk: Chunk) -> Any:
        """The total of one chunk."""

    @abstractmethod
    def merge(self, before: Any, after: Any) -> Any:
        """The total of two consecutive runs of chunks, of the same part or of different ones."""


class Executor(ABC):
    """Makes passes over all samples of a source."""

    @abstractmethod
    def total(self, accumulator: Accumulator, title: str, first_trajectories: dict[int, int] | None = None) -> Any:
        """What a pass gathers over all parts, and the notes of their readers.

        Args:
            accumulator: What the pass gathers.
            title: What is being done, for the progress.
            first_trajectories: Part -> number of trajectories before it; a part that is not named starts at 0.
        """


def accumulate(
    accumulator: Accumulator, samples: Iterable[Chunk], notes: list[str], first_trajectory: int = 0
) -> tuple[Any, tuple[str, ...]] | None:
    """Total and notes of a part; None of a part without samples.

    Args:
        accumulator: What the pass gathers.
        samples: Of the part.
        notes: May fill while the samples are read.
        first_trajectory: Number of trajectories before the part, from which its own are counted on.
    """
    total = None
    for chunk in samples:
        own = accumulator.of(replace(chunk, trajectory=chunk.trajectory + np.int64(first_trajectory)))
        total = own if total is None else accumulator.merge(total, own)
    return None if total is None else (total, tuple(notes))


def merge_parts(accumulator: Accumulator, before: Any, after: Any) -> Any:
    """Total and notes of two runs of parts; a part without samples (None) adds nothing."""
    if before is None or after is None:
        return after if before is None else before
    return accumulator.merge(before[0], after[0]), before[1] + after[1]


def merge_tree(merge: Callable[[Total, Total], Total], parts: Iterable[Total]) -> Total:
    """Total of all parts, merged in pairs, pairs of pairs and so on; only a few totals are in memory at a time.

    The order depends on the number of parts only, so the sum is reproducible to the last bit.
    """
    waiting: list[tuple[int, Total]] = []  # (level, total), levels falling
    for part in parts:
        level = 0
        while waiting and waiting[-1][0] == level:
            part = merge(waiting.pop()[1], part)
            level += 1
        waiting.append((level, part))
    _, total = waiting.pop()
    for _, part in reversed(waiting):
        total = merge(part, total)
    return total


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

    def total(self, accumulator: Accumulator, title: str, first_trajectories: dict[int, int] | None = None) -> Any:
        """One pass."""
        first, n = first_trajectories or {}, self._stream.source.n_parts

        def parts() -> Iterator[Any]:
            for part in range(n):
                notes: list[str] = []
                samples, notes = self._kept.get(part) or (self._read(part, notes), notes)
                yield accumulate(accumulator, samples, notes, first.get(part, 0))
                if self._progress is not None:
                    self._progress(title, (part + 1) / n)

        return merge_tree(partial(merge_parts, accumulator), parts())

    def _read(self, part: int, notes: list[str]) -> Iterator[Chunk]:
        """The samples of a part, which is kept as a whole if there is room for it."""
        held: list[Chunk] = []
        for chunk in chunks(self._stream.trajectories(part, notes), part):
            if self._room > 0:
                held.append(chunk)
                self._room -= chunk.q.nbytes + chunk.u.nbytes + chunk.trajectory.nbytes
                if self._room <= 0:
                    held = []
            yield chunk
        if self._room > 0:
            self._kept[part] = held, notes
