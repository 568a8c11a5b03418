"""The samples of the demonstrations, their whitened features, and checks of them: whether the arm moved enough, and at
the recorded velocities.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import NotIdentifiableError, RecordingError, counted, named
from manip_learn.linalg import whitener
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.earned_velocities import FEWEST, position_noise
from manip_learn.recordings.trajectory import Trajectory

# directions, or samples, that a smooth motion fills of a window: a cubic has four parameters
CUBIC = 4
# ratio to the usual speed, or distance from the middle, beyond which a sample is a fault of the recording. Set by hand
OUTLIER_FACTOR = 1e4
# share of the motion's energy below which something counts as still: a thousandth of the velocity. Set by hand
STILL_ENERGY = 1e-6
# [joints] fewer than this that move at a time, in the mean, is how a hand-guided arm with stiction moves. Set by hand
FEW_JOINTS_AT_ONCE = 1.6
# [rad/s or m/s] of the fastest joint, below which it is at rest: encoder noise of 1e-4 rad at 100 Hz looks like 0.014
REST_SPEED = 0.02
# standard deviations between the least and the largest of a million numbers by chance, and some more
BEYOND_NOISE = 12.0
# standard errors of a difference, an autocorrelation or a curvature that are more than chance: 95 %
STANDARD_ERRORS = 2.0
# the same beyond doubt: of a radius or a pitch, and of the chi-square that tells unequal noise; one in 3 million
BEYOND_CHANCE = 5.0

BLOCK = 4096  # samples: a block of features of a 7-joint arm fits a second-level cache
# Phi of more samples than this is computed anew at each pass instead of kept [numbers]
KEEP_LIMIT = 3e7
KEEP_WHITENED_LIMIT = 3e6  # numbers of whitened Phi that are kept from one pass to the next
# rows of Phi below this share of the largest (after scaling each to its own size) are linear copies or identically
# zero: rounding leaves 1e-15 of a row, a real arm moves the least of its independent rows by 1e-3 or more
PRUNE_RATIO = 1e-6
# postures closer together than this share of their size are one and the same
SAME = 1e-9


def runs(numbers: Int[np.ndarray, " n"]) -> list[tuple[int, slice]]:
    """Each number of a sequence that never decreases, and where it stands."""
    starts = np.flatnonzero(np.diff(numbers, prepend=-1)).tolist()
    return [(int(numbers[a]), slice(a, b)) for a, b in zip(starts, [*starts[1:], len(numbers)], strict=True)]


def rows_beside(selection: Float[np.ndarray, "s p"], Phi: Float[np.ndarray, "n p nv"]) -> Float[np.ndarray, "s nv n"]:
    """Lambda Phi, the samples side by side in the last axis, for arithmetic on all of them at once."""
    n, p, nv = Phi.shape
    return (selection @ Phi.transpose(1, 2, 0).reshape(p, nv * n)).reshape(-1, nv, n)


def stacked(trajectories: Sequence[Trajectory]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Postures, velocities, and the trajectory of each sample, counted from 0.

    Raises:
        RecordingError: A trajectory lacks velocities, or has postures of another size.
    """
    for t in trajectories:
        if t.u is None:
            raise RecordingError(f"{t.name} has no velocities: derive them first", code="no-velocities")
    widths = sorted({t.q.shape[1] for t in trajectories})
    if len(widths) > 1:
        raise RecordingError(f"postures must all have the same number of values, got {widths}", code="shape")
    number = np.repeat(np.arange(len(trajectories)), [len(t) for t in trajectories])
    return np.concatenate([t.q for t in trajectories]), np.concatenate([np.asarray(t.u) for t in trajectories]), number


def in_blocks(trajectory: Int[np.ndarray, " n"], n_trajectories: int, most: int) -> list[tuple[int, slice]]:
    """Blocks of neighbouring trajectories, each its own if there are no more than `most`; which samples are of each."""
    return runs(trajectory if n_trajectories <= most else trajectory * most // n_trajectories)


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
        q, u, trajectory = stacked(demonstrations)
        if u.shape[1] != features.nv:
            raise RecordingError(
                f"the demonstrations have {u.shape[1]} joint velocities, the features act on {features.nv}",
                code="shape",
            )
        low, high = q.min(axis=0), q.max(axis=0)
        centre, spread = 0.5 * (high + low), np.maximum(0.5 * (high - low), 1e-9)
        raw = Samples(features, q, u, trajectory, np.eye(features.n_rows), centre, spread)
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
        return Samples(features, q, u, trajectory, W, centre, spread, None, raw._kept)

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
        size = len(self) * self.features.n_rows * self.nv
        for i, start in enumerate(range(0, len(self), BLOCK)):
            part = slice(start, start + BLOCK)
            raw = self._kept[i] if i < len(self._kept) else self.features.batch(self.q[part])
            if i == len(self._kept) and size <= KEEP_LIMIT:
                self._kept.append(raw)
            if i < len(self._whitened):
                Phi = self._whitened[i]
            else:
                columns = rows_beside(self.whitening, raw)
                if self.mixing is not None:
                    columns = np.einsum("rvn,vw->rwn", columns, self.mixing, optimize=True)
                Phi = columns.transpose(2, 0, 1)
                if size <= KEEP_WHITENED_LIMIT:
                    self._whitened.append(Phi)
            x = (self.q[part] - self.centre) / self.spread
            yield Block(Phi, self.u[part], x, self.trajectory[part])

    def subset(self, keep: np.ndarray) -> Samples:
        """The samples where the mask is true, in the same whitened coordinates."""
        _, trajectory = np.unique(self.trajectory[keep], return_inverse=True)
        scale = (self.whitening, self.centre, self.spread, self.mixing)
        return Samples(self.features, self.q[keep], self.u[keep], trajectory, *scale)

    def thinned(self, most: int) -> Samples:
        """Every k-th sample of all trajectories, with the least k that leaves no more than `most`; itself if k is 1."""
        every = -(-len(self) // most)
        return self.subset(np.arange(len(self)) % every == 0) if every > 1 else self

    def selection(self, whitened_selection: Float[np.ndarray, "s r"]) -> Float[np.ndarray, "s p"]:
        """Lambda in the basis of the features' own rows, orthonormal, from Lambda W^+ in whitened coordinates."""
        _, _, Vt = np.linalg.svd(whitened_selection @ self.whitening, full_matrices=False)
        return Vt


def whitening(S: Float[np.ndarray, "p p"], units: Sequence[str]) -> Float[np.ndarray, "r p"]:
    """W with W S W^T = I, without the combinations of rows that are zero throughout; no rows if all are.

    S is the mean of Phi Phi^T. Rows of one unit are compared with each other before they are scaled.
    """
    size, of_unit = np.sqrt(np.diag(S)), np.array(units)
    moves = np.array([size[i] > PRUNE_RATIO * np.max(size[of_unit == unit]) for i, unit in enumerate(units)])
    return whitener(S * np.outer(moves, moves), PRUNE_RATIO**2)


def energy_shares(energy: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    """Share of each joint in the sum; sums to 1."""
    return energy / max(float(energy.sum()), np.finfo(np.float64).tiny)


def check_fastest(demonstrations: Demonstrations) -> None:
    """Refuse a velocity that is far out of line with all others.

    Raises:
        RecordingError: There is one.
    """
    _, u, trajectory = stacked(demonstrations)
    speed = np.linalg.norm(u, axis=1)
    if not np.any(speed > 0.0):
        return
    sample = int(np.argmax(np.einsum("nv,nv->n", u, u)))
    ratio = float(speed[sample]) / float(np.median(speed[speed > 0.0]))
    if ratio > OUTLIER_FACTOR:
        joint = int(np.argmax(np.abs(u[sample])))
        raise RecordingError(
            f"sample {sample} (trajectory {trajectory[sample]}) moves at {u[sample, joint]:.3g} in joint "
            f"{demonstrations.joint_names[joint]!r}, {ratio:.1e} times the median speed: remove the outlier",
            code="outlier",
        )


def refuse_noise(recorded: Demonstrations) -> None:
    """Refuse recordings in which no joint moves farther than its encoder's noise does.

    Raises:
        NotIdentifiableError: In none of them.
    """
    found = []
    for t in recorded:
        if len(t) < FEWEST:
            return
        moved, noise = np.ptp(t.q, axis=0), np.sqrt(position_noise(t.time, t.q))
        j = int(np.argmax(moved / noise))
        if moved[j] >= BEYOND_NOISE * noise[j]:
            return
        joint = t.joint_names[j] if t.joint_names else str(j)
        found.append((moved[j] / noise[j], joint, t.name, moved[j], noise[j]))
    _, joint, name, moved, noise = max(found)
    raise NotIdentifiableError(
        f"no joint moves farther than the noise of its positions does: the farthest is {joint} in {name}, by "
        f"{moved:.2g} where its noise is {noise:.2g} (standard deviation): record a motion",
        code="no-motion",
    )


def check_samples(samples: Samples, joint_names: Sequence[str], n_constraints: int | None) -> list[str]:
    """Refuse what no estimator can learn from; warnings for what is doubtful.

    Raises:
        NotIdentifiableError: Nothing moves, the posture never changes, or too few different samples.
        RecordingError: A posture is far out of line with all others.
    """
    speed = np.linalg.norm(samples.u, axis=1)
    if not np.any(speed > 0.0):
        raise NotIdentifiableError("nothing moves in these demonstrations: all velocities are zero", code="no-motion")
    check_postures(samples)
    median = float(np.median(speed[speed > 0.0]))
    r = samples.n_rows
    s = n_constraints or 1
    needed = max(r + 2, s * (r - s) + 2, 5)
    moving = np.concatenate([samples.q, samples.u], axis=1)[speed > 1e-9 * median]
    # an even choice is soon counted
    few = moving[:: max(1, len(moving) // (10 * needed))]
    if len(np.unique(few, axis=0)) < needed and (different := len(np.unique(moving, axis=0))) < needed:
        raise NotIdentifiableError(
            f"record more: {counted(different, 'different moving sample')} cannot determine a constraint on "
            f"{counted(r, 'row')}, {needed} can and many more are better",
            code="too-few-samples",
        )
    warnings = []
    squares = samples.u**2
    shares = energy_shares(squares.mean(axis=0))
    still = [name for name, part in zip(joint_names, shares, strict=True) if part < STILL_ENERGY]
    if still and len(still) < samples.nv:
        warnings.append(
            f"{named('joint', still)} hardly moved: what the arm did not try cannot be told from what it could not do"
        )
    norm = squares.sum(axis=1)
    moving = norm > 1e-4 * np.mean(norm)
    # participation number: 1 if a single joint moves, nv if all move equally
    together = float(np.mean(norm[moving] ** 2 / np.sum(squares[moving] ** 2, axis=1)))
    if samples.nv > 3 and together < FEW_JOINTS_AT_ONCE:
        warnings.append(
            f"only {together:.1f} joints move at a time on average: friction of a hand-guided arm looks like a "
            "constraint; move all joints together"
        )
    return warnings


def check_postures(samples: Samples) -> None:
    """Refuse recordings whose postures cannot belong to their velocities.

    Raises:
        NotIdentifiableError: The posture never changes, or there is a single joint.
        RecordingError: A posture is far out of line with all others.
    """
    if samples.nv < 2:
        raise NotIdentifiableError("a constraint leaves no null space for a single joint", code="no-freedom")
    middle = np.median(samples.q, axis=0)
    distance = np.linalg.norm(samples.q - middle, axis=1)
    farthest = int(np.argmax(distance))
    if distance[farthest] <= SAME * (1.0 + float(np.linalg.norm(middle))):
        raise NotIdentifiableError(
            "the posture never changes although the velocities are not zero: give each sample the posture that it was "
            "recorded at",
            code="constant-posture",
        )
    # standing still at the median posture for long is no reason to call all motion far out
    usual = float(np.quantile(distance, 0.9)) or float(np.mean(np.delete(distance, farthest)))
    if 0.0 < usual * OUTLIER_FACTOR < distance[farthest]:
        raise RecordingError(
            f"the posture of sample {farthest} (trajectory {samples.trajectory[farthest]}) is "
            f"{distance[farthest] / usual:.1e} times farther out than nearly all others: remove the outlier",
            code="outlier",
        )
