"""The table of all samples, built once for a fit, and what each feature map makes of it: whitened features."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import NotIdentifiableError, RecordingError
from manip_learn.linalg import whitener
from manip_learn.recordings.trajectory import Trajectory

# directions, or samples, that a smooth motion fills of a window: a cubic has four parameters
CUBIC = 4
# share of the motion's energy below which something counts as still: a thousandth of the velocity. Set by hand
STILL_ENERGY = 1e-6
# standard errors of a difference, an autocorrelation or a curvature that are more than chance: 95 %
STANDARD_ERRORS = 2.0
# the same beyond doubt: of a radius or a pitch, and of the chi-square that tells unequal noise; one in 3 million
BEYOND_CHANCE = 5.0
# [s] the largest step of time that counts in full: a gap in a recording is no evidence. Set by hand
LONGEST_STEP_SECONDS = 0.2
# [s] lengths of the windows that propose rows; from the shortest the noise of the velocities is told, too. Set by hand
SHORT_WINDOWS_SECONDS = (0.6, 1.2)

BLOCK = 4096  # samples: a block of features of a 7-joint arm fits a second-level cache
KEEP_WHITENED_LIMIT = 3e6  # numbers of whitened Phi that are kept from one pass to the next
# rows of Phi below this share of the largest (after scaling each to its own size) are linear copies or identically
# zero: rounding leaves 1e-15 of a row, a real arm moves the least of its independent rows by 1e-3 or more
PRUNE_RATIO = 1e-6


def runs(numbers: Int[np.ndarray, " n"]) -> list[tuple[int, slice]]:
    """Each number of a sequence that never decreases, and where it stands."""
    starts = np.flatnonzero(np.diff(numbers, prepend=-1)).tolist()
    return [(int(numbers[a]), slice(a, b)) for a, b in zip(starts, [*starts[1:], len(numbers)], strict=True)]


def rows_beside(selection: Float[np.ndarray, "s p"], Phi: Float[np.ndarray, "n p nv"]) -> Float[np.ndarray, "s nv n"]:
    """Lambda Phi, the samples side by side in the last axis, for arithmetic on all of them at once."""
    n, p, nv = Phi.shape
    return (selection @ Phi.transpose(1, 2, 0).reshape(p, nv * n)).reshape(-1, nv, n)


def in_blocks(trajectory: Int[np.ndarray, " n"], n_trajectories: int, most: int) -> list[tuple[int, slice]]:
    """Blocks of neighbouring trajectories, each its own if there are no more than `most`; which samples are of each."""
    return runs(trajectory if n_trajectories <= most else trajectory * most // n_trajectories)


@final
@dataclass(frozen=True, eq=False)
class Table:
    """The samples of some recordings with velocities, one below the other.

    Attributes:
        recordings: Where they are from.
        time: Of each sample, on its recording's own clock [s], shape (n,).
        q, u: Postures and velocities, shape (n, nq) and (n, nv).
        trajectory: Number of the recording, counted from 0, shape (n,).
        first: First sample of each recording, and n at the end, shape (g + 1,).
    """

    recordings: tuple[Trajectory, ...]
    time: Float[np.ndarray, " n"]
    q: Float[np.ndarray, "n nq"]
    u: Float[np.ndarray, "n nv"]
    trajectory: Int[np.ndarray, " n"]
    first: Int[np.ndarray, " m"]
    _noise: Float[np.ndarray, " g"] | None = field(default=None, repr=False)
    _larger: tuple[Table, Int[np.ndarray, " n"]] | None = field(default=None, repr=False)
    _Phi: dict[FeatureMap, np.ndarray] = field(default_factory=dict, repr=False, init=False)
    _samples: dict[FeatureMap, Samples] = field(default_factory=dict, repr=False, init=False)

    @staticmethod
    def of(recordings: Table | Sequence[Trajectory]) -> Table:
        """The table of recordings; a table is one already.

        Raises:
            RecordingError: A recording lacks velocities, or has postures of another size.
        """
        if isinstance(recordings, Table):
            return recordings
        for t in recordings:
            if t.u is None:
                raise RecordingError(f"{t.name} has no velocities: derive them first", code="no-velocities")
        widths = sorted({t.q.shape[1] for t in recordings})
        if len(widths) > 1:
            raise RecordingError(f"postures must all have the same number of values, got {widths}", code="shape")
        lengths = [len(t) for t in recordings]
        time, q, u = (np.concatenate([getattr(t, what) for t in recordings]) for what in ("time", "q", "u"))
        first = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])
        return Table(tuple(recordings), time, q, u, np.repeat(np.arange(len(lengths)), lengths), first)

    def pieces(self, spans: Sequence[tuple[int, slice]]) -> Table:
        """Parts of the recordings, by their numbers and samples; itself if these are all of it, in order."""
        parts = [np.arange(self.first[i], self.first[i + 1])[span] for i, span in spans]
        rows, lengths = np.concatenate([np.zeros(0, dtype=np.int64), *parts]), [len(part) for part in parts]
        if np.array_equal(rows, np.arange(len(self.time))) and np.array_equal(lengths, np.diff(self.first)):
            return self
        first = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])
        recordings = tuple(self.recordings[i].part(span) for i, span in spans)
        number = np.repeat(np.arange(len(spans)), lengths)
        own = (self.time[rows], self.q[rows], self.u[rows], number, first)
        return Table(recordings, *own, _larger=(self, rows))

    @property
    def whole(self) -> Table:
        """The table that this one is a part of; itself of all recordings."""
        return self if self._larger is None else self._larger[0].whole

    @cached_property
    def weight(self) -> Float[np.ndarray, " n"]:
        """Time that each sample stands for [s]."""
        parts = []
        for a, b in pairwise(self.first):
            steps = np.minimum(np.diff(self.time[a:b]), LONGEST_STEP_SECONDS) if b - a > 1 else np.array([0.01])
            parts.append(0.5 * (np.append(steps, steps[-1]) + np.insert(steps, 0, steps[0]))[: b - a])
        return np.concatenate(parts)

    @cached_property
    def noise(self) -> Float[np.ndarray, " g"]:
        """Variance of one joint velocity's noise in each recording [(rad/s)^2]."""
        return np.array([velocity_noise(t) for t in self.recordings]) if self._noise is None else self._noise

    def Phi(self, features: FeatureMap) -> Float[np.ndarray, "n p nv"]:
        """The features at each sample, evaluated once, here or in the table that this one is a part of."""
        if features not in self._Phi:
            larger, rows = self._larger or (self, None)
            known = larger._Phi.get(features)
            self._Phi[features] = features.batch(self.q) if known is None else known[rows]
        return self._Phi[features]


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

    def add_to(self, sums: Float[np.ndarray, "g ..."], values: Float[np.ndarray, "... n"]) -> None:
        """Add values of each sample, side by side, to the sum of its trajectory."""
        starts = np.flatnonzero(np.diff(self.trajectory, prepend=-1))
        sums[self.trajectory[starts]] += np.moveaxis(np.add.reduceat(values, starts, axis=-1), -1, 0)


@final
@dataclass(frozen=True, eq=False)
class Samples:
    """All samples of a table, with the features whitened: sum Phi' Phi'^T / n = I.

    Whitening makes every estimator indifferent to the units of the rows (m beside rad), and noise on u equally strong
    in every row. Combinations of rows that are (numerically) always zero are taken out here.

    Attributes:
        features: Phi.
        Phi: The features at each sample, shape (n, p, nv).
        q: Postures, shape (n, nq).
        u: Velocities, shape (n, nv).
        trajectory: Trajectory of each sample, counted from 0, shape (n,).
        whitening: W, shape (p', p), with Phi' = W Phi.
        centre, spread: x = (q - centre) / spread.
        mixing: M, where Phi stands for Phi M, shape (nv, nv); None for the unit matrix.
    """

    features: FeatureMap
    Phi: Float[np.ndarray, "n p nv"]
    q: Float[np.ndarray, "n nq"]
    u: Float[np.ndarray, "n nv"]
    trajectory: Int[np.ndarray, " n"]
    whitening: Float[np.ndarray, "r p"]
    centre: Float[np.ndarray, " nq"]
    spread: Float[np.ndarray, " nq"]
    mixing: Float[np.ndarray, "nv nv"] | None = None
    _whitened: list[np.ndarray] = field(default_factory=list, repr=False, init=False)

    @staticmethod
    def collect(features: FeatureMap, recordings: Table | Sequence[Trajectory]) -> Samples:
        """Samples of recordings with velocities; of a table always the same ones.

        Raises:
            RecordingError: A trajectory lacks velocities, or acts on another number of joints.
            NotIdentifiableError: Every feature row is zero throughout.
        """
        table = Table.of(recordings)
        if features in table._samples:
            return table._samples[features]
        if table.u.shape[1] != features.nv:
            raise RecordingError(
                f"the demonstrations have {table.u.shape[1]} joint velocities, the features act on {features.nv}",
                code="shape",
            )
        Phi, q = table.Phi(features), table.q
        S = np.zeros((features.n_rows, features.n_rows))
        for start in range(0, len(Phi), BLOCK):
            rows = Phi[start : start + BLOCK].transpose(1, 2, 0).reshape(features.n_rows, -1)
            S += rows @ rows.T
        W = whitening(S / len(Phi), features.row_units)
        if not len(W):
            raise NotIdentifiableError(
                f"all rows of {features!r} are zero on these demonstrations: choose axes in which the frame can move",
                code="zero-features",
            )
        low, high = q.min(axis=0), q.max(axis=0)
        spread = np.maximum(0.5 * (high - low), 1e-9)
        found = Samples(features, Phi, q, table.u, table.trajectory, W, 0.5 * (high + low), spread)
        table._samples[features] = found
        return found

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

    @property
    def x(self) -> Float[np.ndarray, "n nq"]:
        """Postures shifted and scaled to about [-1, 1]: the regressors of policy models."""
        return (self.q - self.centre) / self.spread

    @property
    def energy(self) -> float:
        """Mean of |u|^2."""
        return float(np.mean(np.einsum("ni,ni->n", self.u, self.u)))

    def blocks(self) -> Iterator[Block]:
        """The samples in order, at most BLOCK at a time."""
        for i, start in enumerate(range(0, len(self), BLOCK)):
            part = slice(start, start + BLOCK)
            if i < len(self._whitened):
                Phi = self._whitened[i]
            else:
                columns = rows_beside(self.whitening, self.Phi[part])
                if self.mixing is not None:
                    columns = np.einsum("rvn,vw->rwn", columns, self.mixing, optimize=True)
                Phi = columns.transpose(2, 0, 1)
                if self.Phi.size <= KEEP_WHITENED_LIMIT:
                    self._whitened.append(Phi)
            yield Block(Phi, self.u[part], (self.q[part] - self.centre) / self.spread, self.trajectory[part])

    def subset(self, keep: np.ndarray) -> Samples:
        """The samples where the mask is true, in the same whitened coordinates."""
        _, trajectory = np.unique(self.trajectory[keep], return_inverse=True)
        own = {"Phi": self.Phi[keep], "q": self.q[keep], "u": self.u[keep], "trajectory": trajectory}
        return dataclasses.replace(self, **own)

    def thinned(self, most: int) -> Samples:
        """Every k-th sample of all trajectories, with the least k that leaves no more than `most`; itself if k is 1."""
        every = -(-len(self) // most)
        return self.subset(np.arange(len(self)) % every == 0) if every > 1 else self

    def selection(self, whitened_selection: Float[np.ndarray, "s r"]) -> Float[np.ndarray, "s p"]:
        """Lambda in the basis of the features' own rows, orthonormal, from Lambda W^+ in whitened coordinates."""
        return np.linalg.svd(whitened_selection @ self.whitening, full_matrices=False)[2]


def whitening(S: Float[np.ndarray, "p p"], units: Sequence[str]) -> Float[np.ndarray, "r p"]:
    """W with W S W^T = I, without the combinations of rows that are zero throughout; no rows if all are.

    S is the mean of Phi Phi^T. Rows of one unit are compared with each other before they are scaled.
    """
    size, of_unit = np.sqrt(np.diag(S)), np.array(units)
    moves = np.array([size[i] > PRUNE_RATIO * np.max(size[of_unit == unit]) for i, unit in enumerate(units)])
    return whitener(S * np.outer(moves, moves), PRUNE_RATIO**2)


def velocity_noise(trajectory: Trajectory) -> float:
    """Variance of a joint velocity's noise: the rest that a smooth motion leaves in short windows.

    A motion as smooth as a cubic fills four directions of a window, of its samples as of the joints: the rest in
    the others is noise. Where there are no more joints than that, the samples alone tell.
    """
    u, time = np.asarray(trajectory.u), trajectory.time
    nv, T = u.shape[1], len(u)
    length = min(T, max(2 * nv, int(np.searchsorted(time, time[0] + SHORT_WINDOWS_SECONDS[0]))))
    starts = np.arange(0, T - length + 1, max(1, length // 2))
    windows = np.stack([u[a : a + length] for a in starts])
    left = []
    if nv > CUBIC:
        values = np.linalg.eigvalsh(np.einsum("wti,wtj->wij", windows, windows) / length)
        left.append(np.mean(values[:, : nv - CUBIC], axis=1))
    if length > CUBIC:
        cubic = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, length), CUBIC))[0]
        rest = windows - cubic @ (cubic.T @ windows)
        left.append(np.sum(rest**2, axis=(1, 2)) / ((length - CUBIC) * nv))
    least = min((float(np.median(x)) for x in left), default=0.0)
    return max(least, 1e-10 * float(np.mean(u**2)), 1e-24)
