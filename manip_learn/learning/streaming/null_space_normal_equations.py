"""Equation (10) and its derivatives over all samples: one Gauss-Newton pass for motion that obeys A(q) u = 0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.streaming.accumulator import Chunk, Sums
from manip_learn.learning.streaming.row_spaces import row_spaces
from manip_learn.learning.streaming.trajectory_pools import Pools


@final
@dataclass(frozen=True, eq=False)
class NullSpaceTally(Sums):
    """sum w^T A^+ A w with its gradient and Gauss-Newton Hessian for dLambda = B Lambda_perp, pool by pool.

    Gathers the cost, the energy sum |w|^2, and for each pool of trajectories the gradient (m) and the Hessian (m, m),
    m = s (p' - s), B row by row.

    Attributes:
        features: Phi.
        mixing: Lambda above Lambda_perp, in the features' own units, shape (p', p).
        n_rows: Number of rows s of Lambda.
        pools: Pool of each trajectory.
    """

    features: FeatureMap
    mixing: Float[np.ndarray, "r p"]
    n_rows: int
    pools: Pools

    def of(self, chunk: Chunk) -> tuple[Any, ...]:
        """Cost, energy, gradients and Hessians of a chunk."""
        s = self.n_rows
        Phi, w = chunk.features(self.features, self.mixing)
        spaces = row_spaces(Phi[:s])
        along = spaces.along(w)
        a, null = spaces.dual(along), spaces.away(w, along)  # A^{+T} w and N w
        g = np.einsum("kvn,vn->kn", Phi[s:], null)
        k, n = g.shape
        slopes = (a[:, None] * g[None]).reshape(s * k, n)
        inverse = spaces.inverse_gram()
        m = s * k
        H = np.empty((m, m, n))
        for i in range(s):
            for j in range(s):
                H[i * k : (i + 1) * k, j * k : (j + 1) * k] = inverse[i, j] * g[:, None] * g[None]
        return (
            np.einsum("sn,sn->", along, along),
            np.einsum("vn,vn->", w, w),
            self.pools.sums(slopes, chunk.group),
            self.pools.sums(H.reshape(m * m, n), chunk.group).reshape(-1, m, m),
        )
