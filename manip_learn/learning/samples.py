"""What the estimators see: postures, velocities and whitened features, block by block."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import NotIdentifiableError, RecordingError
from manip_learn.learning.data_summary import DataSummary
from manip_learn.learning.whitening import whitening
from manip_learn.recordings.demonstrations import Demonstrations

BLOCK = 4096
# Phi of more samples than this is computed anew at each pass instead of kept [numbers]
KEEP_LIMIT = 3e7
KEEP_WHITENED_LIMIT = 3e6  # numbers of whitened Phi that are kept from one pass to the next


@final
@dataclass(frozen=True, eq=False)
class Block:
    """Some samples.

    Attributes:
        Phi: Whitened features, shape (n, p', nv).
        u: Velocities, shape (n, nv).
        x: Postures shifted and scaled to about [-1, 1], shape (n, m): the regressors of policy models.
        trajectory: Trajectory of each sample, shape (n,).
    """

    Phi: Float[np.ndarray, "n p nv"]
    u: Float[np.ndarray, "n nv"]
    x: Float[np.ndarray, "n m"]
    trajectory: Int[np.ndarray, " n"]

    def rows_of(self, selection: Float[np.ndarray, "s p"]) -> Float[np.ndarray, "s nv n"]:
        """Lambda Phi, the samples side by side in the last axis, for arithmetic on all of them at once."""
        n, p, nv = self.Phi.shape
        return (selection @ self.Phi.transpose(1, 2, 0).reshape(p, nv * n)).reshape(-1, nv, n)

    def add_to(self, sums: Float[np.ndarray, "g ..."], values: Float[np.ndarray, "... n"]) -> None:
        """Add values of each sample, side by side, to the sum of its trajectory."""
        starts = np.flatnonzero(np.diff(self.trajectory, prepend=-1))
        sums[self.trajectory[starts]] += np.moveaxis(np.add.reduceat(values, starts, axis=-1), -1, 0)


@final
@dataclass(frozen=True, eq=False)
class Samples:
    """All samples of some demonstrations, with the features whitened: sum Phi' Phi'^T / n = I.

    Whitening makes every estimator indifferent to the units of the rows (m beside rad), and noise on u equally strong
    in every row. Combinations of rows that are (numerically) always zero are taken out here.

    Attributes:
        features: Phi.
        q: Postures, shape (n, nq).
        u: Velocities, shape (n, nv).
        trajectory: Trajectory of each sample, counted from 0, shape (n,).
        whitening: W, shape (p', p), with Phi' = W Phi.
        centre, spread: x = (q - centre) / spread.
        mixing: M, where Phi stands for Phi M, shape (nv, nv); None for the unit matrix.
    """

    features: FeatureMap
    q: Float[np.ndarray, "n nq"]
    u: Float[np.ndarray, "n nv"]
    trajectory: Int[np.ndarray, " n"]
    whitening: Float[np.ndarray, "r p"]
    centre: Float[np.ndarray, " nq"]
    spread: Float[np.ndarray, " nq"]
    mixing: Float[np.ndarray, "nv nv"] | None = None
    _kept: list[np.ndarray] = field(default_factory=list, repr=False)
    _whitened: list[np.ndarray] = field(default_factory=list, repr=False, init=False)

    @staticmethod
    def collect(features: FeatureMap, demonstrations: Demonstrations) -> Samples:
        """Samples of demonstrations with velocities.

        Raises:
            RecordingError: A trajectory lacks velocities, or acts on another number of joints.
            NotIdentifiableError: Every feature row is zero throughout.
        """
        return Samples.of(features, DataSummary.of(demonstrations))

    @staticmethod
    def of(features: FeatureMap, data: DataSummary) -> Samples:
        """Samples to learn from, all or chosen from more; scaled by the range of all postures.

        Raises:
            RecordingError: They act on another number of joints.
            NotIdentifiableError: Every feature row is zero throughout.
        """
        if data.u.shape[1] != features.nv:
            raise RecordingError(
                f"the demonstrations have {data.u.shape[1]} joint velocities, the features act on {features.nv}",
                code="shape",
            )
        # of some chosen samples no trajectory may be left: count those that are
        _, trajectory = np.unique(data.trajectory, return_inverse=True)
        centre, spread = 0.5 * (data.high + data.low), np.maximum(0.5 * (data.high - data.low), 1e-9)
        raw = Samples(features, data.q, data.u, trajectory, np.eye(features.n_rows), centre, spread)
        S = np.zeros((features.n_rows, features.n_rows))
        for block in raw.blocks():
            rows = block.Phi.transpose(1, 2, 0).reshape(features.n_rows, -1)
            S += rows @ rows.T
        W = whitening(S / len(raw), features.row_units)
        if not len(W):
            raise NotIdentifiableError(
                f"all rows of {features!r} are zero on these demonstrations: choose axes in which the frame can move",
                code="zero-features",
            )
        return Samples(features, data.q, data.u, trajectory, W, centre, spread, None, raw._kept)

    def __len__(self) -> int:
        return int(self.u.shape[0])

    @property
    def nv(self) -> int:
        """Number of velocities."""
        return int(self.u.shape[1])

    @property
    def n_rows(self) -> int:
        """Number of whitened rows p'."""
        return int(self.whitening.shape[0])

    @property
    def n_trajectories(self) -> int:
        """Number of trajectories."""
        return int(self.trajectory[-1]) + 1 if len(self) else 0

    def blocks(self) -> Iterator[Block]:
        """The samples in order, at most BLOCK at a time."""
        size = len(self) * self.features.n_rows * self.nv
        for i, start in enumerate(range(0, len(self), BLOCK)):
            part = slice(start, start + BLOCK)
            raw = self._kept[i] if i < len(self._kept) else self.features.batch(self.q[part])
            if i == len(self._kept) and size <= KEEP_LIMIT:
                self._kept.append(raw)
            Phi = self._whitened[i] if i < len(self._whitened) else self._whiten(raw)
            if i == len(self._whitened) and size <= KEEP_WHITENED_LIMIT:
                self._whitened.append(Phi)
            x = (self.q[part] - self.centre) / self.spread
            yield Block(Phi, self.u[part], x, self.trajectory[part])

    def _whiten(self, raw: Float[np.ndarray, "n p nv"]) -> Float[np.ndarray, "n r nv"]:
        n, p, nv = raw.shape
        columns = (self.whitening @ raw.transpose(1, 2, 0).reshape(p, nv * n)).reshape(-1, nv, n)
        if self.mixing is not None:
            columns = np.einsum("rvn,vw->rwn", columns, self.mixing, optimize=True)
        return columns.transpose(2, 0, 1)

    def subset(self, keep: np.ndarray) -> Samples:
        """The samples where the mask is true, in the same whitened coordinates."""
        _, trajectory = np.unique(self.trajectory[keep], return_inverse=True)
        scale = (self.whitening, self.centre, self.spread, self.mixing)
        return Samples(self.features, self.q[keep], self.u[keep], trajectory, *scale)

    def selection(self, whitened_selection: Float[np.ndarray, "s r"]) -> Float[np.ndarray, "s p"]:
        """Lambda in the basis of the features' own rows, orthonormal, from Lambda W^+ in whitened coordinates."""
        _, _, Vt = np.linalg.svd(whitened_selection @ self.whitening, full_matrices=False)
        return Vt

    @property
    def energy(self) -> float:
        """Mean of |u|^2."""
        return float(np.mean(np.einsum("ni,ni->n", self.u, self.u)))
