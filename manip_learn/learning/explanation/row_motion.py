"""The motion of recordings in the features' rows, sample by sample."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian
from manip_learn.constraint.features.mechanism_rows import PlaceForm, PlaceRows
from manip_learn.learning.samples import BLOCK, Samples, Table
from manip_learn.linalg import null_basis
from manip_learn.recordings.trajectory import Trajectory, subsample
from manip_learn.robot.batch.batch_kinematics import batch_kinematics

# [standard deviations of the noise] beyond which it is motion: the range of a random walk exceeds 4 in one of 10,000
# trajectories, and so does a sample in one of 15,000
OVER_NOISE = 4.0
# samples a second that are enough to judge a hypothesis; boundaries are found on all samples
SCAN_RATE = 25.0
# eigenvalues of Phi Phi^T at one posture below this are none: rows that depend on the others there
_RANK = 1e-8
# attributes of `RowMotion` with a value for each sample
OF_SAMPLES = ("time", "weight", "trajectory", "rates", "gram", "free", "noise")
# postures of each recording whose mean place becomes the middle of the rows: it conditions the numbers only
_FEW = 50


@final
@dataclass(frozen=True, eq=False)
class RowMotion:
    """All samples of all recordings in whitened rows, sum Phi Phi^T / n = I.

    Attributes:
        time: Time of each sample on its recording's own clock [s], shape (n,).
        weight: Time that each sample stands for [s], shape (n,).
        trajectory: Trajectory of each sample, counted from 0, shape (n,).
        first: First sample of each trajectory, and n at the end, shape (g + 1,).
        rates: r = Phi u, shape (n, p').
        gram: Phi Phi^T, shape (n, p', p').
        free: Energy of u in one row if the joints moved independently of each other, sum_j P_jj u_j^2 / rank with
            P = Phi^+ Phi: the mean over all signs of the u_j [(rad/s)^2], shape (n,).
        noise: Variance of one joint velocity's noise [(rad/s)^2], shape (n,), constant within a trajectory.
        whitening: W, shape (p', p), with Phi' = W Phi.
        rank: Of Phi at a typical sample.
        ends: First and last time of each recording, shape (g, 2) [s].
    """

    time: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    trajectory: Int[np.ndarray, " n"]
    first: Int[np.ndarray, " m"]
    rates: Float[np.ndarray, "n r"]
    gram: Float[np.ndarray, "n r r"]
    free: Float[np.ndarray, " n"]
    noise: Float[np.ndarray, " n"]
    whitening: Float[np.ndarray, "r p"]
    rank: int
    ends: Float[np.ndarray, "g 2"]

    @staticmethod
    def collect(features: FeatureMap, recordings: Table | Sequence[Trajectory]) -> RowMotion:
        """The motion of recordings with velocities.

        Raises:
            RecordingError: A trajectory lacks velocities, or acts on another number of joints.
            NotIdentifiableError: Every row of Phi is zero throughout.
        """
        table = Table.of(recordings)
        samples = Samples.collect(features, table)
        n, r = len(samples), samples.n_rows
        rates, gram, free = np.empty((n, r)), np.empty((n, r, r)), np.empty(n)
        for part in (slice(start, start + BLOCK) for start in range(0, n, BLOCK)):
            white, u = samples.whitening @ samples.Phi[part], samples.u[part]
            rates[part] = np.matmul(white, u[:, :, None])[:, :, 0]
            gram[part] = own = np.matmul(white, white.transpose(0, 2, 1))
            regular = own + 1e-9 * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(r)
            used = np.einsum("npv,npv->nv", white, np.linalg.solve(regular, white))
            free[part] = np.sum(used * u**2, axis=1)
        rank = int(np.median(np.linalg.matrix_rank(gram[:: max(1, n // 50)], _RANK, hermitian=True)))
        ends = np.stack([table.time[table.first[:-1]], table.time[table.first[1:] - 1]], axis=1)
        noise, of_table = table.noise[table.trajectory], (table.time, table.weight, table.trajectory, table.first)
        return RowMotion(*of_table, rates, gram, free / rank, noise, samples.whitening, rank, ends)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def n_trajectories(self) -> int:
        """Number of trajectories g."""
        return len(self.first) - 1

    @property
    def moving(self) -> Bool[np.ndarray, " n"]:
        """Where the rows move clearly more than the noise: elsewhere nothing can be known."""
        return self.free > OVER_NOISE**2 * self.noise

    def thinned(self) -> RowMotion:
        """Evenly chosen samples, about SCAN_RATE a second, each standing for the time of those left out."""
        step = max(1, round(len(self) / max(float(self.weight.sum()), 1e-9) / SCAN_RATE))
        if step == 1:
            return self
        # of the shortest recording at least one
        spans = zip(self.first[:-1], self.first[1:], strict=True)
        parts = [np.arange(a + min(step, b - a) // 2, b, step) for a, b in spans]
        keep = np.zeros(len(self), dtype=bool)
        keep[np.concatenate(parts)] = True
        return self.chosen(keep, float(step))

    def chosen(self, keep: Bool[np.ndarray, " n"], times: float = 1.0) -> RowMotion:
        """Some of the samples, each standing for `times` its own time."""
        first = np.concatenate([[0], np.cumsum(keep)])[self.first].astype(np.int64)
        kept = {name: getattr(self, name)[keep] for name in OF_SAMPLES}
        return dataclasses.replace(self, first=first, **kept | {"weight": kept["weight"] * times})

    def of_recordings(self, start: int, end: int) -> RowMotion:
        """The recordings from `start` until before `end`, counted from 0 again."""
        own = slice(int(self.first[start]), int(self.first[end]))
        kept = {name: getattr(self, name)[own] for name in OF_SAMPLES}
        first, kept["trajectory"] = self.first[start : end + 1] - own.start, kept["trajectory"] - start
        return dataclasses.replace(self, first=first, ends=self.ends[start:end], **kept)

    def selection(self, rows: Float[np.ndarray, "s r"]) -> Float[np.ndarray, "s p"]:
        """Lambda in the features' own basis, with orthonormal rows, from whitened rows."""
        return np.linalg.svd(rows @ self.whitening, full_matrices=False)[2]


def broken_energy(motion: RowMotion, rows: Float[np.ndarray, "h s r"]) -> Float[np.ndarray, "n h"]:
    """Energy of u that breaks each hypothesis, e = u^T A^+ A u = (Lambda r)^T (Lambda G Lambda^T)^-1 Lambda r.

    For many samples and hypotheses at once: products of matrices, and Cholesky's recursion written out over the rows.
    """
    h, s, r = rows.shape
    n = len(motion)
    flat = motion.gram.reshape(n, r * r)
    y = [motion.rates @ rows[:, i].T for i in range(s)]
    L: list[list[np.ndarray]] = [[] for _ in range(s)]
    total = np.zeros((n, h))
    for i in range(s):
        z = y[i]
        for j in range(i + 1):
            entry = flat @ (rows[:, i, :, None] * rows[:, j, None, :]).reshape(h, r * r).T
            for k in range(j):
                entry -= L[i][k] * L[j][k]
            L[i].append(np.sqrt(np.maximum(entry, 1e-15)) if i == j else entry / L[j][j])
        for k in range(i):
            z = z - L[i][k] * y[k]
        y[i] = z / L[i][i]
        total += y[i] ** 2
    return total


def joints_at_once(u: Float[np.ndarray, "n nv"], noise: float) -> float:
    """How many joints move at the same time, (sum u^2)^2 / sum u^4 of a typical sample that moves: 1 for one alone.

    `noise` is the variance of the noise of each velocity.
    """
    squares = u[np.sum(u**2, axis=1) > OVER_NOISE**2 * noise * u.shape[1]] ** 2
    if not len(squares):
        return 0.0
    return float(np.median(np.sum(squares, axis=1) ** 2 / np.sum(squares**2, axis=1)))


@final
@dataclass(frozen=True, eq=False)
class View:
    """The recordings in one feature map.

    Attributes:
        features: Phi.
        motion: All samples.
        thin: Evenly chosen ones, on which hypotheses are scored.
        largest: Largest number of rows that leave the features something free.
    """

    features: FeatureMap
    motion: RowMotion
    thin: RowMotion
    largest: int

    def of_recordings(self, start: int, end: int) -> View:
        """The recordings from `start` until before `end`, counted from 0 again."""
        motion, thin = (m.of_recordings(start, end) for m in (self.motion, self.thin))
        return dataclasses.replace(self, motion=motion, thin=thin)

    @property
    def immovable(self) -> Float[np.ndarray, "k p"]:
        """Rows of the features that the arm cannot move, orthonormal."""
        return null_basis(np.linalg.svd(self.motion.whitening, full_matrices=False)[2]).T


def views_of(
    feature_maps: Sequence[FeatureMap], recordings: Table | Sequence[Trajectory], *, scan_only: bool = False
) -> list[View]:
    """The recordings in each feature map whose rows move, with something left free.

    `scan_only`: the samples on which hypotheses are scored are all that is wanted.

    Raises:
        RecordingError: A trajectory lacks velocities, or acts on another number of joints.
    """
    table = Table.of(recordings)
    if scan_only:
        few = [subsample(t, max(2, round(t.duration * SCAN_RATE))) for t in table.recordings]
        table = dataclasses.replace(Table.of(few), _noise=table.noise)
    motions = [(f, RowMotion.collect(f, table)) for f in feature_maps if np.any(table.Phi(f))]
    views = [View(f, motion, motion.thinned(), min(motion.rank, f.nv) - 1) for f, motion in motions]
    return [v for v in views if v.largest > 0]


def kinds_tried(views: Sequence[View]) -> int:
    """Feature maps and numbers of rows that are tried."""
    return sum(v.largest for v in views)


def mechanism_features(feature_maps: Sequence[FeatureMap], trajectories: Sequence[Trajectory]) -> list[PlaceRows]:
    """The rows in which mechanisms that hold the frame asked for are constant; none where its velocity is not whole."""
    frames = [f for f in feature_maps if isinstance(f, FrameJacobian) and set(f.row_names) >= set(AXES[:3])]
    if not frames:
        return []
    robot, frame = frames[0].robot, frames[0].frame
    few = np.concatenate([t.q[:: max(1, len(t) // _FEW)] for t in trajectories])
    middle = batch_kinematics(robot, frame).pose(few)[:, :3, 3].mean(axis=0)
    whole = set(frames[0].row_names) == set(AXES)
    forms: tuple[PlaceForm, ...] = ("point and rotation", "twist") if whole else ("point",)
    return [PlaceRows(robot, frame.name, form, middle) for form in forms]
