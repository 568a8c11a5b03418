"""Models of the null-space policy that are linear in their parameters: pi(q) = Theta^T beta(q)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import combinations_with_replacement
from typing import final

import numpy as np
from jaxtyping import Float, Int

Postures = Float[np.ndarray, "n m"]
Trajectories = Int[np.ndarray, " n"] | None


class PolicyModel(ABC):
    """Regressors beta(x) of shifted and scaled postures x.

    Attributes:
        name: For reports.
        n_terms: Number of regressors k.
    """

    name: str
    n_terms: int

    @abstractmethod
    def __call__(self, x: Postures, trajectory: Trajectories = None) -> Float[np.ndarray, "n k"]:
        """beta(x), one row per posture; `trajectory` is the one that each belongs to."""


@final
class PolynomialModel(PolicyModel):
    """All monomials up to a degree: 0 constant, 1 affine, 2 quadratic, 3 cubic, 4 quartic, 5 quintic.

    Attributes:
        degree: The largest.
        terms: Indices of the factors of each monomial but the constant.
    """

    NAMES = ("constant", "affine", "quadratic", "cubic", "quartic", "quintic")

    def __init__(self, degree: int, m: int):
        self.degree = degree
        self.name = self.NAMES[degree] if degree < len(self.NAMES) else f"degree {degree}"
        self.terms = [c for d in range(1, degree + 1) for c in combinations_with_replacement(range(m), d)]
        self.n_terms = 1 + len(self.terms)

    def __call__(self, x: Postures, trajectory: Trajectories = None) -> Float[np.ndarray, "n k"]:
        """1, x_i, x_i x_j, ..."""
        out = np.empty((x.shape[0], self.n_terms))
        out[:, 0] = 1.0
        for column, term in enumerate(self.terms, start=1):
            out[:, column] = np.prod(x[:, term], axis=1)
        return out


@final
class RadialModel(PolicyModel):
    """Normalised Gaussian radial basis functions with one shared width.

    Args:
        x: Postures among which k-means puts the centres.
        n_centres: Number of centres.
        rng: For k-means.
        width: Width in units of the mean distance between neighbouring centres; wide ones fit smooth policies best.
    """

    def __init__(self, x: Float[np.ndarray, "n m"], n_centres: int, rng: np.random.Generator, width: float = 8.0):
        from scipy.cluster.vq import kmeans2

        self.name = f"rbf{n_centres}"
        few = x if len(x) <= 4000 else x[rng.choice(len(x), 4000, replace=False)]
        self.centres, _ = kmeans2(few, min(n_centres, len(np.unique(few, axis=0))), minit="++", seed=rng)
        gaps = np.linalg.norm(self.centres[:, None] - self.centres[None], axis=2)
        np.fill_diagonal(gaps, np.inf)
        nearest = float(np.mean(np.min(gaps, axis=1))) if len(self.centres) > 1 else 1.0
        self.width = width * max(nearest, 1e-6)
        self.n_terms = int(self.centres.shape[0])

    def __call__(self, x: Postures, trajectory: Trajectories = None) -> Float[np.ndarray, "n k"]:
        """Shares of the centres, each row summing to 1."""
        d2 = np.sum((x[:, None, :] - self.centres[None]) ** 2, axis=2) / (2.0 * self.width**2)
        d2 -= d2.min(axis=1, keepdims=True)  # the nearest centre always counts: no 0 / 0 far away
        phi = np.exp(-d2)
        return phi / phi.sum(axis=1, keepdims=True)


@final
class HarmonicModel(PolicyModel):
    """1, x_i, and sines and cosines of each joint's angle and of its multiples: policies that are periodic in a joint.

    Args:
        spread: Range of each joint that x is scaled by [rad].
        n_harmonics: Largest multiple.
    """

    def __init__(self, spread: Float[np.ndarray, " m"], n_harmonics: int):
        self.spread = np.array(spread)
        self.n_harmonics = n_harmonics
        self.name = f"harmonic{n_harmonics}"
        self.n_terms = 1 + len(self.spread) * (1 + 2 * n_harmonics)

    def __call__(self, x: Postures, trajectory: Trajectories = None) -> Float[np.ndarray, "n k"]:
        """1, x, sin(q - centre), cos(q - centre), sin 2 (q - centre), ..."""
        angle = x * self.spread
        waves = [f(k * angle) for k in range(1, self.n_harmonics + 1) for f in (np.sin, np.cos)]
        return np.concatenate([np.ones((len(x), 1)), x, *waves], axis=1)


@final
class TrajectoryOffsetModel(PolicyModel):
    """Another model plus an offset per trajectory: demonstrators who rest in different postures.

    Args:
        shared: What all trajectories have in common.
        n_trajectories: Number of trajectories.
    """

    def __init__(self, shared: PolicyModel, n_trajectories: int):
        self.shared = shared
        self.n_trajectories = n_trajectories
        self.name = f"{shared.name}-offset"
        self.n_terms = shared.n_terms + n_trajectories

    def __call__(self, x: Postures, trajectory: Trajectories = None) -> Float[np.ndarray, "n k"]:
        """The shared regressors, then one indicator per trajectory; without `trajectory` the offsets are left out.

        The shared constant and the indicators are dependent; least squares by rank-revealing QR takes care of that.
        """
        offsets = np.zeros((len(x), self.n_trajectories))
        if trajectory is not None:
            offsets[np.arange(len(x)), trajectory] = 1.0
        return np.concatenate([self.shared(x, trajectory), offsets], axis=1)
