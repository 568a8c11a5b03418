"""The first pass over all samples: their number and range, and an even choice of few of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import UInt

from manip_learn.learning.data_summary import IN_MEMORY_SAMPLES, DataSummary
from manip_learn.learning.streaming.accumulator import Accumulator, Chunk
from manip_learn.recordings.readers.option_uses import refuse_unmatched

# multiples of the golden ratio (Fibonacci hashing): the smallest of any number of them are spread evenly over the
# samples, and no rhythm of the recording is met, which every k-th sample might
GOLDEN = np.uint64(11_400_714_819_323_198_485)


@final
@dataclass(frozen=True, eq=False)
class PassSummary:
    """Summary of the samples of a part, or of all.

    Attributes:
        counts: Part -> number of its trajectories.
        data: Numbers of the samples, and those chosen.
        order: Multiple of the golden ratio of each chosen sample, shape (k,).
    """

    counts: dict[int, int]
    data: DataSummary
    order: UInt[np.ndarray, " k"]

    @property
    def first_trajectories(self) -> dict[int, int]:
        """Part -> number of trajectories in the parts before it."""
        first, count = {}, 0
        for part in sorted(self.counts):
            first[part] = count
            count += self.counts[part]
        return first

    def checked(self, n_parts: int) -> PassSummary:
        """The same, once all parts are in it.

        Raises:
            RecordingError: A reading option that matched nothing in any part.
        """
        return self.with_notes(refuse_unmatched(self.data.notes, n_parts))

    def with_notes(self, notes: Sequence[str]) -> PassSummary:
        """The same with these notes of the reader."""
        return dataclasses.replace(self, data=dataclasses.replace(self.data, notes=tuple(notes)))


@final
@dataclass(frozen=True)
class SummaryAccumulator(Accumulator):
    """Accumulates the summary of the samples.

    Attributes:
        n_chosen: Number of samples to choose.
    """

    n_chosen: int = IN_MEMORY_SAMPLES

    def of(self, chunk: Chunk) -> PassSummary:
        """The summary of a chunk; its samples and trajectories are counted from the start of the part."""
        speed2 = np.einsum("nv,nv->n", chunk.u, chunk.u)
        i, n_trajectories = int(np.argmax(speed2)), int(chunk.trajectory[-1]) + 1
        data = DataSummary(
            len(chunk),
            n_trajectories,
            chunk.q.min(axis=0),
            chunk.q.max(axis=0),
            np.einsum("nv,nv->v", chunk.u, chunk.u),
            chunk.u[i],
            (chunk.first + i, int(chunk.trajectory[i])),
            chunk.q,
            chunk.u,
            chunk.trajectory,
        )
        order = np.arange(chunk.first, chunk.first + len(chunk), dtype=np.uint64) * GOLDEN
        return PassSummary({chunk.part: n_trajectories}, data, order)

    def merge(self, before: PassSummary, after: PassSummary) -> PassSummary:
        """Two consecutive runs of samples of the same part, which are counted in the part already."""
        return self._merge(before, after, 0, 0)

    def merge_parts(self, before: PassSummary, after: PassSummary) -> PassSummary:
        """Runs of different parts: samples and trajectories of the later one are counted on."""
        return self._merge(before, after, before.data.n_samples, before.data.n_trajectories)

    def finish(self, total: PassSummary, notes: tuple[str, ...]) -> PassSummary:
        """The total with the notes of the reader."""
        return total.with_notes(notes)

    def _merge(self, before: PassSummary, after: PassSummary, samples: int, trajectories: int) -> PassSummary:
        a, b = before.data, after.data
        counts = {**before.counts, **after.counts}
        faster = float(b.fastest @ b.fastest) > float(a.fastest @ a.fastest)
        sample, trajectory = b.fastest_at
        q, u, chosen_trajectory, order = self._choose(before, after, trajectories)
        data = DataSummary(
            a.n_samples + b.n_samples,
            sum(counts.values()),
            np.minimum(a.low, b.low),
            np.maximum(a.high, b.high),
            a.squares + b.squares,
            b.fastest if faster else a.fastest,
            (sample + samples, trajectory + trajectories) if faster else a.fastest_at,
            q,
            u,
            chosen_trajectory,
            (*a.notes, *b.notes),
        )
        return PassSummary(counts, data, order)

    def _choose(
        self, before: PassSummary, after: PassSummary, shift: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        a, b = before.data, after.data
        # once enough are chosen, few of a new chunk can be among the smallest
        full = len(before.order) == self.n_chosen
        new = after.order < before.order.max() if full else np.ones(len(after.order), dtype=bool)
        q, u = np.concatenate([a.q, b.q[new]]), np.concatenate([a.u, b.u[new]])
        trajectory = np.concatenate([a.trajectory, b.trajectory[new] + shift])
        order = np.concatenate([before.order, after.order[new]])
        if len(order) > self.n_chosen:
            kept = np.sort(np.argsort(order, kind="stable")[: self.n_chosen])
            q, u, trajectory, order = q[kept], u[kept], trajectory[kept], order[kept]
        return q, u, trajectory, order
