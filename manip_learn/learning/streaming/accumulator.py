"""What one pass over all samples gathers: contributions of chunks, added up in an order that the data alone decide."""

from __future__ import annotations

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
    """Some samples in their order, as recorded.

    Attributes:
        q: Postures, shape (n, m).
        u: Velocities, shape (n, nv).
        group: Trajectory of each sample, counted from 0 in its part, never decreasing, shape (n,).
        part: Which part of the source it belongs to.
        first: Number of samples before it in the part.
    """

    q: Float[np.ndarray, "n m"]
    u: Float[np.ndarray, "n nv"]
    group: Int[np.ndarray, " n"]
    part: int = 0
    first: int = 0

    def __len__(self) -> int:
        return len(self.u)

    def features(
        self, features: FeatureMap, mixing: Float[np.ndarray, "r p"]
    ) -> tuple[Float[np.ndarray, "r nv n"], Float[np.ndarray, "nv n"]]:
        """Combinations of the rows of Phi, and u, with the samples along the last axis."""
        Phi = features.batch(self.q).transpose(1, 2, 0)
        p, nv, n = Phi.shape
        return (mixing @ np.ascontiguousarray(Phi).reshape(p, nv * n)).reshape(-1, nv, n), np.ascontiguousarray(
            self.u.T
        )


class Tally(ABC):
    """One pass: chunk -> contribution, and how two contributions are joined. Picklable."""

    @abstractmethod
    def of(self, chunk: Chunk) -> Any:
        """What a chunk contributes."""

    @abstractmethod
    def joined(self, before: Any, after: Any) -> Any:
        """Two contributions of a part in one, in the order of the samples."""

    @abstractmethod
    def joined_parts(self, before: Any, after: Any) -> Any:
        """Totals of parts in one."""

    @abstractmethod
    def finished(self, total: Any, notes: tuple[str, ...]) -> Any:
        """The total of a part, with what its reader noticed."""


class Sums(Tally):
    """A pass whose contributions are tuples of arrays that are added."""

    @final
    def joined(self, before: Any, after: Any) -> Any:
        """Entry by entry."""
        return tuple(a + b for a, b in zip(before, after, strict=True))

    @final
    def joined_parts(self, before: Any, after: Any) -> Any:
        """Entry by entry."""
        return self.joined(before, after)

    @final
    def finished(self, total: Any, notes: tuple[str, ...]) -> Any:
        """As it is."""
        return total


def chunks(trajectories: Iterable[Trajectory], part: int = 0) -> Iterator[Chunk]:
    """The samples of trajectories with velocities, CHUNK at a time, however long each trajectory is.

    Raises:
        RecordingError: Postures of different sizes.
    """
    held: list[tuple[np.ndarray, np.ndarray, int]] = []
    first = count = 0
    for group, trajectory in enumerate(trajectories):
        start = 0
        while start < len(trajectory):
            stop = min(len(trajectory), start + CHUNK - count)
            held.append((trajectory.q[start:stop], trajectory.u[start:stop], group))  # type: ignore[index]
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
    group = np.repeat([g for _, _, g in held], [len(q) for q, _, _ in held])
    return Chunk(np.concatenate([q for q, _, _ in held]), np.concatenate([u for _, u, _ in held]), group, part, first)


def tallied(tally: Tally, samples: Iterable[Chunk], notes: Sequence[str] = ()) -> Any:
    """Total of a part; None of a part without samples. `notes` may fill while the samples are read."""
    total = None
    for chunk in samples:
        contribution = tally.of(chunk)
        total = contribution if total is None else tally.joined(total, contribution)
    return None if total is None else tally.finished(total, tuple(notes))


def both(tally: Tally, before: Any, after: Any) -> Any:
    """Totals of parts in one; a part without samples adds nothing."""
    if before is None or after is None:
        return after if before is None else before
    return tally.joined_parts(before, after)


def tree_total(tally: Tally, parts: Iterable[Any]) -> Any:
    """Parts joined in pairs, pairs of pairs and so on; a few at a time are in memory.

    The order depends on the number of parts only, so that the last bit of the sum does, too.
    """
    waiting: list[tuple[int, Any]] = []  # (level, total), levels falling
    for part in parts:
        level = 0
        while waiting and waiting[-1][0] == level:
            part = both(tally, waiting.pop()[1], part)
            level += 1
        waiting.append((level, part))
    total = None
    for _, part in reversed(waiting):
        total = both(tally, part, total)
    return total
