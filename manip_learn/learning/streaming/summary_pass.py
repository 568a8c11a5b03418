"""The first pass: how many samples, how far they reach, and an even choice of few of them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int, UInt

from manip_learn.learning.streaming.accumulator import Chunk, Tally

# up to this many samples are learnt from directly; of more, this many are, and all of them improve on that
FEW = 16_384
# multiples of the golden ratio (Fibonacci hashing): the smallest of any number of them are spread evenly over the
# samples, and no rhythm of the recording is met, which every k-th sample might
GOLDEN = np.uint64(11_400_714_819_323_198_485)


@final
@dataclass(frozen=True, eq=False)
class Extent:
    """What the samples of a part, or of all, are like.

    Attributes:
        groups: Part -> number of its trajectories.
        n_samples: Number of samples.
        low, high: Smallest and largest posture, entry by entry, shape (m,).
        squares: sum u^2 of each joint, shape (nv,).
        fastest: The velocity with the largest norm, shape (nv,).
        fastest_at: Sample and trajectory of it, counted from 0.
        q, u, group: The chosen samples, in order, and their trajectories, counted from 0.
        order: Their multiples of the golden ratio, shape (k,).
        notes: What the reader noticed.
    """

    groups: dict[int, int]
    n_samples: int
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    squares: Float[np.ndarray, " nv"]
    fastest: Float[np.ndarray, " nv"]
    fastest_at: tuple[int, int]
    q: Float[np.ndarray, "k m"]
    u: Float[np.ndarray, "k nv"]
    group: Int[np.ndarray, " k"]
    order: UInt[np.ndarray, " k"]
    notes: tuple[str, ...] = ()

    @property
    def n_groups(self) -> int:
        """Number of trajectories."""
        return sum(self.groups.values())

    @property
    def first_groups(self) -> dict[int, int]:
        """Part -> number of trajectories in the parts before it."""
        first, count = {}, 0
        for part in sorted(self.groups):
            first[part] = count
            count += self.groups[part]
        return first


@final
@dataclass(frozen=True)
class Survey(Tally):
    """Gathers the extent of the samples.

    Attributes:
        few: Number of samples to choose.
    """

    few: int = FEW

    def of(self, chunk: Chunk) -> Extent:
        """The extent of a chunk; its samples and trajectories are counted in the part."""
        speed2 = np.einsum("nv,nv->n", chunk.u, chunk.u)
        i = int(np.argmax(speed2))
        return Extent(
            {chunk.part: int(chunk.group[-1]) + 1},
            len(chunk),
            chunk.q.min(axis=0),
            chunk.q.max(axis=0),
            np.einsum("nv,nv->v", chunk.u, chunk.u),
            chunk.u[i],
            (chunk.first + i, int(chunk.group[i])),
            chunk.q,
            chunk.u,
            chunk.group,
            np.arange(chunk.first, chunk.first + len(chunk), dtype=np.uint64) * GOLDEN,
        )

    def joined(self, before: Extent, after: Extent) -> Extent:
        """Two runs of the same part."""
        return self._both(before, after, {**before.groups, **after.groups}, 0, 0)

    def joined_parts(self, before: Extent, after: Extent) -> Extent:
        """Runs of different parts: those of the later one are counted on."""
        groups = {**before.groups, **after.groups}
        return self._both(before, after, groups, before.n_samples, before.n_groups)

    def finished(self, total: Extent, notes: tuple[str, ...]) -> Extent:
        """The total with what the reader noticed."""
        return dataclasses.replace(total, notes=notes)

    def _both(self, a: Extent, b: Extent, groups: dict[int, int], samples: int, shift: int) -> Extent:
        faster = float(b.fastest @ b.fastest) > float(a.fastest @ a.fastest)
        sample, group = b.fastest_at
        q, u, chosen_group, order = self._chosen(a, b, shift)
        return Extent(
            groups,
            a.n_samples + b.n_samples,
            np.minimum(a.low, b.low),
            np.maximum(a.high, b.high),
            a.squares + b.squares,
            b.fastest if faster else a.fastest,
            (sample + samples, group + shift) if faster else a.fastest_at,
            q,
            u,
            chosen_group,
            order,
            (*a.notes, *b.notes),
        )

    def _chosen(self, a: Extent, b: Extent, shift: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        # once enough are chosen, few of a new chunk come into question
        new = b.order < a.order.max() if len(a.order) == self.few else np.ones(len(b.order), dtype=bool)
        q, u = np.concatenate([a.q, b.q[new]]), np.concatenate([a.u, b.u[new]])
        group, order = np.concatenate([a.group, b.group[new] + shift]), np.concatenate([a.order, b.order[new]])
        if len(order) > self.few:
            kept = np.sort(np.argsort(order, kind="stable")[: self.few])
            q, u, group, order = q[kept], u[kept], group[kept], order[kept]
        return q, u, group, order
