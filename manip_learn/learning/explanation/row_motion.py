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
from manip_learn.errors import NotIdentifiableError, RecordingError
from manip_learn.learning.samples import BLOCK, CUBIC, whitening
from manip_learn.linalg import null_basis
from manip_learn.recordings.trajectory import Trajectory, subsample
from manip_learn.robot.batch.batch_kinematics import batch_kinematics

# [s] the largest step of time that counts in full: a gap in a recording is no evidence. Set by hand
LONGEST_STEP_SECONDS = 0.2
# [standard deviations of the noise] beyond which it is motion: the range of a random walk exceeds 4 in one of 10,000
# trajectories, and so does a sample in one of 15,000
OVER_NOISE = 4.0
# [s] lengths of the windows that propose rows; from the shortest the noise of the velocities is told, too. Set by hand
SHORT_WINDOWS_SECONDS = (0.6, 1.2)

# samples a second that are enough to judge a hypothesis; boundaries are found on all samples
SCAN_RATE = 25.0
# eigenvalues of Phi Phi^T at one posture below this are none: rows that depend on the others there
RANK = 1e-8
# attributes of `RowMotion` with a value for each sample
OF_SAMPLES = ("time", "weight", "trajectory", "rates", "gram", "free", "noise")
# postures of each recording whose mean place becomes the middle of the rows: it conditions the numbers only
FEW = 50


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
    def collect(
        features: FeatureMap, trajectories: Sequence[Trajectory], noise: Sequence[float] | None = None
    ) -> RowMotion:
        """The motion of trajectories with velocities.

        `noise` is the `velocity_noise` of each trajectory, where it is known already.

        Raises:
            RecordingError: A trajectory lacks velocities.
            NotIdentifiableError: Every row of Phi is zero throughout.
        """
        for t in trajectories:
            if t.u is None:
                raise RecordingError(f"{t.name} has no velocities: derive them first", code="no-velocities")
        u = np.concatenate([t.u for t in trajectories])  # type: ignore[misc]
        Phi = features.batch(np.concatenate([t.q for t in trajectories]))
        W = whitening(np.tensordot(Phi, Phi, axes=([0, 2], [0, 2])) / len(Phi), features.row_units)
        if not len(W):
            raise NotIdentifiableError(f"all rows of {features!r} are zero on these recordings", code="zero-features")
        n, r = len(u), len(W)
        rates, gram, free = np.empty((n, r)), np.empty((n, r, r)), np.empty(n)
        for part in (slice(start, start + BLOCK) for start in range(0, n, BLOCK)):
            white = W @ Phi[part]
            rates[part] = np.matmul(white, u[part, :, None])[:, :, 0]
            gram[part] = own = np.matmul(white, white.transpose(0, 2, 1))
            regular = own + 1e-9 * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(r)
            used = np.einsum("npv,npv->nv", white, np.linalg.solve(regular, white))
            free[part] = np.sum(used * u[part] ** 2, axis=1)
        rank = int(np.median(np.linalg.matrix_rank(gram[:: max(1, n // 50)], RANK, hermitian=True)))
        lengths, weights = [len(t) for t in trajectories], []
        for t in trajectories:
            steps = np.minimum(np.diff(t.time), LONGEST_STEP_SECONDS) if len(t) > 1 else np.array([0.01])
            halves = 0.5 * (np.append(steps, steps[-1]) + np.insert(steps, 0, steps[0]))
            weights.append(halves[: len(t)])
        first = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        each = [velocity_noise(t) for t in trajectories] if noise is None else noise
        return RowMotion(
            np.concatenate([t.time for t in trajectories]),
            np.concatenate(weights),
            np.repeat(np.arange(len(trajectories)), lengths),
            first,
            rates,
            gram,
            free / rank,
            np.repeat(each, lengths),
            W,
            rank,
            np.array([[t.time[0], t.time[-1]] for t in trajectories]),
        )

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
    feature_maps: Sequence[FeatureMap], trajectories: Sequence[Trajectory], *, scan_only: bool = False
) -> list[View]:
    """The recordings in each feature map.

    `scan_only`: the samples on which hypotheses are scored are all that is wanted.

    Raises:
        RecordingError: A trajectory lacks velocities.
        NotIdentifiableError: Every row of a map is zero throughout.
    """
    noise = [velocity_noise(t) for t in trajectories]
    if scan_only:
        trajectories = [subsample(t, max(2, round(t.duration * SCAN_RATE))) for t in trajectories]
    motions = [(f, RowMotion.collect(f, trajectories, noise)) for f in feature_maps]
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
    few = np.concatenate([t.q[:: max(1, len(t) // FEW)] for t in trajectories])
    middle = batch_kinematics(robot, frame).pose(few)[:, :3, 3].mean(axis=0)
    whole = set(frames[0].row_names) == set(AXES)
    forms: tuple[PlaceForm, ...] = ("point and rotation", "twist") if whole else ("point",)
    return [PlaceRows(robot, frame.name, form, middle) for form in forms]
