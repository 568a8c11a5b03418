"""What one pass over all samples accumulates, chunk by chunk, in an order of sums that depends on the data alone."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import RecordingError
from manip_learn.recordings.trajectory import Trajectory

CHUNK = 4096


@final
@dataclass(frozen=True, eq=False)
class Chunk:
    """Consecutive samples, as recorded.

    Attributes:
        q: Postures, shape (n, m).
        u: Velocities, shape (n, nv).
        trajectory: Trajectory of each sample, counted from 0 in its part, never decreasing, shape (n,).
        part: Which part of the source it belongs to.
        first: Number of samples before it in the part.
    """

    q: Float[np.ndarray, "n m"]
    u: Float[np.ndarray, "n nv"]
    trajectory: Int[np.ndarray, " n"]
    part: int = 0
    first: int = 0

    def __len__(self) -> int:
        return len(self.u)

    def features(
        self, features: FeatureMap, mixing: Float[np.ndarray, "r p"]
    ) -> tuple[Float[np.ndarray, "r nv n"], Float[np.ndarray, "nv n"]]:
        """Linear combinations of the rows of Phi, and u, with the samples along the last axis."""
        Phi = features.batch(self.q).transpose(1, 2, 0)
        p, nv, n = Phi.shape
        return (mixing @ np.ascontiguousarray(Phi).reshape(p, nv * n)).reshape(-1, nv, n), np.ascontiguousarray(
            self.u.T
        )


class Accumulator(ABC):
    """One pass over the samples: the total of a chunk, and how totals are merged. Picklable."""

    @abstractmethod
    def of(self, chunk: Chunk) -> Any:
        """The total of one chunk."""

    @abstractmethod
    def merge(self, before: Any, after: Any) -> Any:
        """The total of two consecutive runs of samples of the same part."""

    @abstractmethod
    def merge_parts(self, before: Any, after: Any) -> Any:
        """The total of two consecutive runs of parts."""

    @abstractmethod
    def finish(self, total: Any, notes: tuple[str, ...]) -> Any:
        """The total of a part, with the notes of its reader."""


class SumAccumulator(Accumulator):
    """A pass whose totals are tuples of arrays that are added."""

    @final
    def merge(self, before: Any, after: Any) -> Any:
        """Sums, entry by entry."""
        return tuple(a + b for a, b in zip(before, after, strict=True))

    @final
    def merge_parts(self, before: Any, after: Any) -> Any:
        """Sums, entry by entry."""
        return self.merge(before, after)

    @final
    def finish(self, total: Any, notes: tuple[str, ...]) -> Any:
        """Unchanged."""
        return total


class Executor(ABC):
    """Makes passes over all samples of a source."""

    @abstractmethod
    def total(self, accumulator: Accumulator, first_trajectories: dict[int, int], title: str) -> Any:
        """What a pass gathers over all parts, merged in an order that depends on the number of parts only.

        Args:
            accumulator: What the pass gathers.
            first_trajectories: Part -> number of trajectories before it; a part that is not named starts at 0.
            title: What is being done, for the progress.
        """


def chunks(trajectories: Iterable[Trajectory], part: int = 0) -> Iterator[Chunk]:
    """The samples of trajectories with velocities, CHUNK at a time, however long each trajectory is.

    Raises:
        RecordingError: Postures of different sizes.
    """
    held: list[tuple[np.ndarray, np.ndarray, int]] = []
    first = count = 0
    for number, trajectory in enumerate(trajectories):
        start = 0
        while start < len(trajectory):
            stop = min(len(trajectory), start + CHUNK - count)
            held.append((trajectory.q[start:stop], trajectory.u[start:stop], number))  # type: ignore[index]
            count += stop - start
            start = stop
            if count == CHUNK:
                yield _chunk(held, part, first)
                held, count, first = [], 0, first + CHUNK
    if held:
        yield _chunk(held, part, first)


def _chunk(held: list[tuple[np.ndarray, np.ndarray, int]], part: int, first: int) -> Chunk:
    widths = sorted({q.shape[1] for q, _, _ in held})
    if len(widths) > 1:
        raise RecordingError(f"postures must all have the same number of values, got {widths}", code="shape")
    trajectory = np.repeat([number for _, _, number in held], [len(q) for q, _, _ in held])
    return Chunk(
        np.concatenate([q for q, _, _ in held]), np.concatenate([u for _, u, _ in held]), trajectory, part, first
    )


def accumulate(accumulator: Accumulator, samples: Iterable[Chunk], notes: Sequence[str] = ()) -> Any:
    """Total of a part; None of a part without samples. `notes` may fill while the samples are read."""
    total = None
    for chunk in samples:
        contribution = accumulator.of(chunk)
        total = contribution if total is None else accumulator.merge(total, contribution)
    return None if total is None else accumulator.finish(total, tuple(notes))


def accumulate_part(accumulator: Accumulator, samples: Iterable[Chunk], first_trajectory: int, notes: list[str]) -> Any:
    """Total of a part whose trajectories are counted on from `first_trajectory`."""
    return accumulate(accumulator, (_counted_on(chunk, first_trajectory) for chunk in samples), notes)


def _counted_on(chunk: Chunk, first_trajectory: int) -> Chunk:
    return (
        dataclasses.replace(chunk, trajectory=chunk.trajectory + np.int64(first_trajectory))
        if first_trajectory
        else chunk
    )


def merge_optional(accumulator: Accumulator, before: Any, after: Any) -> Any:
    """The total of two runs of parts; a part without samples (None) adds nothing."""
    if before is None or after is None:
        return after if before is None else before
    return accumulator.merge_parts(before, after)


def merge_tree(accumulator: Accumulator, parts: Iterable[Any]) -> Any:
    """Total of all parts, merged in pairs, pairs of pairs and so on; only a few totals are in memory at a time.

    The order depends on the number of parts only, so the sum is reproducible to the last bit.
    """
    waiting: list[tuple[int, Any]] = []  # (level, total), levels falling
    for part in parts:
        level = 0
        while waiting and waiting[-1][0] == level:
            part = merge_optional(accumulator, waiting.pop()[1], part)
            level += 1
        waiting.append((level, part))
    total = None
    for _, part in reversed(waiting):
        total = merge_optional(accumulator, part, total)
    return total
