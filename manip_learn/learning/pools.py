"""Trajectories pooled for the bootstrap, so that what is kept of each does not grow with their number."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

MOST = 512


@final
@dataclass(frozen=True)
class Pools:
    """At most `MOST` pools of neighbouring trajectories; each its own if there are no more than that.

    Attributes:
        n_groups: Number of trajectories.
    """

    n_groups: int

    @property
    def n_pools(self) -> int:
        """Number of pools."""
        return min(self.n_groups, MOST)

    def sums(self, values: Float[np.ndarray, "m n"], group: Int[np.ndarray, " n"]) -> Float[np.ndarray, "g m"]:
        """Sum over the samples of each pool; the trajectories of the samples never decrease."""
        pool = group if self.n_groups <= MOST else group * MOST // self.n_groups
        starts = np.flatnonzero(np.diff(pool, prepend=-1))
        out = np.zeros((self.n_pools, len(values)))
        out[pool[starts]] = np.add.reduceat(values, starts, axis=1).T
        return out
