"""Who makes the passes over the samples: this process, or (`distributed`) many."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, final

import numpy as np

from manip_learn.learning.streaming.accumulator import Chunk, Tally, tallied, tree_total
from manip_learn.learning.streaming.sample_stream import Reading

# (what is being done, share of it that is done)
Progress = Callable[[str, float], None]


class Passes(ABC):
    """Makes passes over all samples of a source."""

    @abstractmethod
    def total(self, tally: Tally, first_groups: dict[int, int], title: str) -> Any:
        """What a pass gathers over all parts, joined in an order that depends on the number of parts only.

        Args:
            tally: The pass.
            first_groups: Part -> number of trajectories before it; a part that is not named starts at 0.
            title: For the progress.
        """


@final
class LocalPasses(Passes):
    """Part after part in this process, each read anew in each pass: memory does not grow with the samples.

    Args:
        reading: What to read.
        progress: Told how far a pass is.
    """

    def __init__(self, reading: Reading, progress: Progress | None = None):
        self._reading = reading
        self._progress = progress

    def total(self, tally: Tally, first_groups: dict[int, int], title: str) -> Any:
        """One pass."""
        return tree_total(tally, self._parts(tally, first_groups, title))

    def _parts(self, tally: Tally, first_groups: dict[int, int], title: str) -> Iterator[Any]:
        n = self._reading.source.n_parts
        for part in range(n):
            notes: list[str] = []
            read = self._reading.chunks(part, notes)
            yield tallied_part(tally, read, first_groups.get(part, 0), notes)
            if self._progress is not None:
                self._progress(title, (part + 1) / n)


def tallied_part(tally: Tally, samples: Iterator[Chunk] | list[Chunk], first_group: int, notes: list[str]) -> Any:
    """Total of a part whose trajectories are counted on from `first_group`."""
    return tallied(tally, (_counted_on(chunk, first_group) for chunk in samples), notes)


def _counted_on(chunk: Chunk, first_group: int) -> Chunk:
    return dataclasses.replace(chunk, group=chunk.group + np.int64(first_group)) if first_group else chunk
