"""Trajectories pooled for the bootstrap, so that what is kept of each does not grow with their number."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int


@final
@dataclass(frozen=True)
class Pools:
    """Pools of neighbouring trajectories; each its own if there are no more than `most`.

    Attributes:
        n_groups: Number of trajectories.
        most: Largest number of pools.
    """

    n_groups: int
    most: int

    @property
    def n_pools(self) -> int:
        """Number of pools."""
        return min(self.n_groups, self.most)

    def runs(self, group: Int[np.ndarray, " n"]) -> list[tuple[int, slice]]:
        """Pools of some samples whose trajectories never decrease, and which samples belong to each."""
        pool = group if self.n_groups <= self.most else group * self.most // self.n_groups
        starts = np.flatnonzero(np.diff(pool, prepend=-1)).tolist()
        return [(int(pool[a]), slice(a, b)) for a, b in zip(starts, [*starts[1:], len(pool)], strict=True)]

    def sums(self, values: Float[np.ndarray, "m n"], group: Int[np.ndarray, " n"]) -> Float[np.ndarray, "g m"]:
        """Sum over the samples of each pool."""
        runs = self.runs(group)
        out = np.zeros((self.n_pools, len(values)))
        out[[pool for pool, _ in runs]] = np.add.reduceat(values, [part.start for _, part in runs], axis=1).T
        return out
