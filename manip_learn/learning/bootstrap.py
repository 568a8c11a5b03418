"""Uncertainty of a row space by bootstrap over trajectories."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.learning.samples import Samples
from manip_learn.linalg import complement_rows, row_space_angles

SHARE = 0.68  # of the cases in which the truth lies within a stated angle: one standard deviation of a normal one
# least share of the residual that is left where a trajectory alone determines a direction, so that its influence on
# that direction is bounded
LEVERAGE_FLOOR = 1e-3
# curvature over the largest, each unknown scaled to its own, below which a direction is rounding
UNDETERMINED = 1e-12
# steps of Lanczos' method after which all eigenvectors cost no more, and what is rounding in them
MOST_STEPS, SPENT = 64, 1e-14


@final
@dataclass(frozen=True, eq=False)
class PolicyPrior:
    """Gaussian prior of the policy's parameters, independent of each other.

    Attributes:
        precision: Noise variance over the variance of each unknown, 0 for those of Lambda, shape (d,).
        noise: Noise variance [(rad/s)^2].
    """

    precision: Float[np.ndarray, " d"]
    noise: float

    def errors(
        self, hessians: Float[np.ndarray, "g d d"], m: int, repetitions: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "k m"]:
        """Errors of the last m unknowns since the parameters are drawn towards zero, as often as asked for.

        With M = sum H_i + P the estimate is off by M^-1 P times the parameters, whose covariance is sigma^2 P^-1.
        """
        total = hessians.sum(axis=0) + np.diag(self.precision)
        own = np.linalg.solve(total, np.eye(len(total))[:, len(total) - m :])
        factor = own * np.sqrt(self.precision * self.noise)[:, None]
        return rng.standard_normal((repetitions, len(factor))) @ factor


def bootstrap_angle_deg(
    samples: Samples,
    whitened_selection: Float[np.ndarray, "s r"],
    gradients: Float[np.ndarray, "g d"],
    hessians: Float[np.ndarray, "g d d"],
    rng: np.random.Generator,
    repetitions: int = 200,
    quantile: float = SHARE,
    prior: PolicyPrior | None = None,
) -> float | None:
    """Angle [deg] within which a share of the repetitions keeps the row space of Lambda.

    Each repetition draws trajectories with replacement, because samples of one trajectory are not independent, and
    moves Lambda by the sum of their influences. The influence of a trajectory is its share of the Gauss-Newton step,
    corrected for its leverage: its residual in the fit to all data is too small, the more so the fewer trajectories
    there are and the more freedom the policy model has.

    Args:
        samples: What was recorded.
        whitened_selection: Lambda at the optimum, in whitened coordinates.
        gradients: Of each trajectory (or block of them) at the optimum; the last s (p'-s) unknowns are those of Lambda,
            others before them are eliminated.
        hessians: Gauss-Newton Hessians, likewise.
        rng: For the draws.
        repetitions: How many.
        quantile: Share of the repetitions.
        prior: Of the policy's parameters, which the Hessians leave out.

    Returns:
        The angle; None with fewer than two trajectories or no freedom.
    """
    s, r = whitened_selection.shape
    n, m = gradients.shape[0], s * (r - s)
    if n < 2 or m == 0:
        return None
    influence = influences(gradients, hessians, prior)[:, -m:]
    weights = rng.multinomial(n, np.full(n, 1.0 / n), size=repetitions) - 1.0
    # where few trajectories carry most of the influence their spread is itself uncertain: Student's distribution
    energy = np.sum((influence @ _whitener(influence)) ** 2, axis=1)
    freedom = max(float(energy.sum() ** 2 / np.sum(energy**2)), 2.0)
    spread = np.sqrt(rng.chisquare(freedom, size=repetitions) / freedom)
    steps = (-weights @ influence) / spread[:, None]
    return angle_within_deg(samples, whitened_selection, steps, quantile)


def angle_within_deg(
    samples: Samples,
    whitened_selection: Float[np.ndarray, "s r"],
    steps: Float[np.ndarray, "k m"],
    quantile: float = SHARE,
) -> float:
    """Angle [deg] within which a share of the errors B of Lambda + B Lambda_perp leaves its row space."""
    s, r = whitened_selection.shape
    turns = steps.reshape(len(steps), s, r - s) @ complement_rows(whitened_selection)
    angles = row_space_angles((whitened_selection + turns) @ samples.whitening, samples.selection(whitened_selection))
    return float(np.degrees(np.quantile(angles, quantile)))


def influences(
    gradients: Float[np.ndarray, "g d"], hessians: Float[np.ndarray, "g d d"], prior: PolicyPrior | None = None
) -> Float[np.ndarray, "g d"]:
    """Contribution of each trajectory to the error, centred, its residual corrected for the leverage on the fit.

    In coordinates where the sum of the Hessians is I, the gradient of a trajectory at the optimum has the covariance
    sigma^2 H_i (I - H_i), since the fit follows its own data; (I - H_i)^(-1/2) restores sigma^2 H_i (bias-reduced
    linearisation, Bell and McCaffrey, 2002; HC2 where a trajectory has one sample). A prior adds to the sum.
    """
    n, d = gradients.shape
    total = hessians.sum(axis=0) if prior is None else hessians.sum(axis=0) + np.diag(prior.precision)
    size = np.sqrt(np.maximum(np.diag(total), np.finfo(np.float64).tiny))
    values, vectors = np.linalg.eigh(total / np.outer(size, size))
    kept = values > UNDETERMINED * values[-1]
    back = vectors[:, kept] / np.sqrt(values[kept]) / size[:, None]
    steps = np.empty((n, d))
    for i in range(n):
        steps[i] = back @ _without_leverage(hessians[i], back, back.T @ gradients[i])
    return np.sqrt(n / (n - 1.0)) * (steps - steps.mean(axis=0))


def _without_leverage(
    hessian: Float[np.ndarray, "d d"], back: Float[np.ndarray, "d k"], gradient: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """(I - back^T H back)^(-1/2) times a vector, by Lanczos' method where a few of its steps suffice.

    One trajectory determines few directions of many, so that its share of the Hessian has few eigenvalues that count;
    the Krylov space of the gradient holds what these do to it (Golub and Van Loan, 2013, section 10.1).
    """
    k, size = len(gradient), float(np.linalg.norm(gradient))
    most = min(MOST_STEPS, k // 4)
    if size == 0.0 or most < 2:
        return _by_eigenvectors(back.T @ hessian @ back, gradient)
    basis, T = np.empty((most, k)), np.zeros((most, most))
    basis[0] = gradient / size
    before = np.zeros(most)
    for j in range(most):
        next_one = back.T @ (hessian @ (back @ basis[j]))
        T[j, j] = basis[j] @ next_one
        for _ in range(2):  # once more, against the loss of orthogonality
            next_one -= (basis[: j + 1] @ next_one) @ basis[: j + 1]
        length = float(np.linalg.norm(next_one))
        if length <= SPENT or j % 4 == 3:
            now = np.zeros(most)
            now[: j + 1] = _by_eigenvectors(T[: j + 1, : j + 1], np.eye(j + 1)[0])
            if length <= SPENT or np.linalg.norm(now - before) <= SPENT * np.linalg.norm(now):
                return size * (now[: j + 1] @ basis[: j + 1])
            before = now
        if j + 1 < most:
            basis[j + 1] = next_one / length
            T[j, j + 1] = T[j + 1, j] = length
    return _by_eigenvectors(back.T @ hessian @ back, gradient)


def _by_eigenvectors(share: Float[np.ndarray, "k k"], vector: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """(I - S)^(-1/2) times a vector, eigenvalues of I - S no smaller than LEVERAGE_FLOOR."""
    values, axes = np.linalg.eigh(share)
    return axes @ ((axes.T @ vector) / np.sqrt(np.maximum(1.0 - values, LEVERAGE_FLOOR)))


def _whitener(influence: Float[np.ndarray, "g m"]) -> Float[np.ndarray, "m m"]:
    """Makes all directions of the influences equally strong."""
    values, vectors = np.linalg.eigh(influence.T @ influence)
    keep = values > 1e-12 * values[-1]
    return vectors * np.where(keep, 1.0 / np.sqrt(np.where(keep, values, 1.0)), 0.0)


@final
@dataclass(frozen=True)
class TrajectoryBlocks:
    """TrajectoryBlocks of neighbouring trajectories; each its own if there are no more than `most`.

    Attributes:
        n_trajectories: Number of trajectories.
        most: Largest number of blocks.
    """

    n_trajectories: int
    most: int

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return min(self.n_trajectories, self.most)

    def runs(self, trajectory: Int[np.ndarray, " n"]) -> list[tuple[int, slice]]:
        """TrajectoryBlocks of some samples whose trajectories never decrease, and which samples belong to each."""
        block = trajectory if self.n_trajectories <= self.most else trajectory * self.most // self.n_trajectories
        starts = np.flatnonzero(np.diff(block, prepend=-1)).tolist()
        return [(int(block[a]), slice(a, b)) for a, b in zip(starts, [*starts[1:], len(block)], strict=True)]

    def sums(self, values: Float[np.ndarray, "m n"], trajectory: Int[np.ndarray, " n"]) -> Float[np.ndarray, "g m"]:
        """Sum over the samples of each block."""
        runs = self.runs(trajectory)
        out = np.zeros((self.n_blocks, len(values)))
        out[[block for block, _ in runs]] = np.add.reduceat(values, [part.start for _, part in runs], axis=1).T
        return out
