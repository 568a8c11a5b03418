"""Weighted residuals of what a mechanism holds, and their derivatives by its place and by the constants held."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.constraint.mechanism_kinds import MechanismKind
from manip_learn.learning.deciding import VARIANCE_FLOOR
from manip_learn.learning.mechanisms.fits import Fit, clusters, tangents
from manip_learn.learning.mechanisms.joint_slopes import SLOPES
from manip_learn.learning.mechanisms.residuals import QUANTITIES, Place
from manip_learn.learning.mechanisms.tip_paths import TipPaths

UNDETERMINED = 1e-12


@final
@dataclass(frozen=True, eq=False)
class Weights:
    """How residuals are weighted.

    Attributes:
        root: W_n^(1/2).
        noise: K_n = W_n^(1/2) D_n J_n, the weighted residuals by the joints.
        n_residuals: How many residuals vary.
    """

    root: Float[np.ndarray, "N d d"]
    noise: Float[np.ndarray, "N d nv"]
    n_residuals: float

    @staticmethod
    def of(paths: TipPaths, J: Float[np.ndarray, "N 6 nv"], candidate: MechanismKind, place: Place) -> Weights:
        """From the slopes of what is held; in no direction does a sample vary by nothing."""
        noise = np.concatenate([SLOPES[name](paths, place) for name in candidate.holds], axis=1) @ J
        S = noise @ noise.transpose(0, 2, 1)
        floor, column = np.zeros(S.shape[1]), 0
        for name in candidate.holds:
            own = slice(column, column + QUANTITIES[name].width)
            floor[own] = VARIANCE_FLOOR * float(np.mean(np.einsum("nii->n", S[:, own, own]))) / QUANTITIES[name].rank
            column = own.stop
        # what no joint moves is exact, at any weight: the third coordinate of a planar arm
        values, vectors = np.linalg.eigh(S + np.diag(np.where(floor > UNDETERMINED * floor.max(), floor, 1.0)))
        root = np.einsum("nik,nk,njk->nij", vectors, 1.0 / np.sqrt(values), vectors, optimize=True)
        return Weights(root, root @ noise, float(np.einsum("nij,njk,nki->", root, S, root, optimize=True)))


@final
@dataclass(frozen=True, eq=False)
class Unknowns:
    """The place (m numbers), constants that all trajectories share, constants of each.

    Attributes:
        m: Numbers of the place.
        size: Number of all.
        columns: Which of them concern each trajectory: the place, then one constant for each held value.
        parts: Samples of each cluster: a trajectory, or a part of one.
        owner: The trajectory of each cluster.
    """

    m: int
    size: int
    columns: list[Int[np.ndarray, " m+d"]]
    parts: list[slice]
    owner: list[int]

    @staticmethod
    def of(paths: TipPaths, m: int, is_shared: Bool[np.ndarray, " d"]) -> Unknowns:
        """Numbered one after the other."""
        n_shared, n_own = int(np.count_nonzero(is_shared)), int(np.count_nonzero(~is_shared))
        shared, own = m + np.cumsum(is_shared) - 1, m + n_shared + np.cumsum(~is_shared) - 1
        columns = [
            np.append(np.arange(m), np.where(is_shared, shared, own + i * n_own)) for i in range(len(paths.starts))
        ]
        parts = clusters(paths)
        owner = [int(np.searchsorted(paths.starts, p.start, side="right")) - 1 for p in parts]
        return Unknowns(m, m + n_shared + n_own * len(paths.starts), columns, parts, owner)

    def clusters(self) -> Iterator[tuple[int, slice, Int[np.ndarray, " k"]]]:
        """Number, samples and unknowns of each cluster."""
        for i, (part, number) in enumerate(zip(self.parts, self.owner, strict=True)):
            yield i, part, self.columns[number]


@final
@dataclass(frozen=True, eq=False)
class Linearised:
    """Weighted residuals at a place, the constants at their best, with their derivatives.

    Attributes:
        place: Where.
        unknowns: What is fitted.
        slopes: M_n, for the place and for the constants of its trajectory, shape (N, d, m + d).
        residuals: Shape (N, d).
        constants: c.
        gradients, hessians: Of half the cost, of each cluster, for all unknowns.
        weights: Of the residuals.
        radius: Which unknown is the radius of each trajectory; none if it is not held.
        tangents: The unknowns of the place in axis, point and pitch.
    """

    place: Place
    unknowns: Unknowns
    slopes: Float[np.ndarray, "N d k"]
    residuals: Float[np.ndarray, "N d"]
    constants: Float[np.ndarray, " c"]
    gradients: Float[np.ndarray, "g w"]
    hessians: Float[np.ndarray, "g w w"]
    weights: Weights
    radius: Int[np.ndarray, " n"]
    tangents: Float[np.ndarray, "7 m"]

    @staticmethod
    def at(paths: TipPaths, fit: Fit, place: Place, weights: Weights) -> Linearised:
        """The constants are linear: they are solved for."""
        T, names = tangents(fit.candidate, place), [n for n in fit.candidate.holds for _ in range(QUANTITIES[n].width)]
        values, J = zip(*(QUANTITIES[name].evaluate(paths, place) for name in fit.candidate.holds), strict=True)
        root, m = weights.root, T.shape[1]
        unknowns = Unknowns.of(paths, m, np.array([name in fit.shared for name in names]))
        slopes = np.concatenate([root @ np.concatenate([one @ T for one in J], axis=1), -root], axis=2)
        residuals = np.einsum("nij,nj->ni", root, np.concatenate(values, axis=1))
        w = unknowns.size
        hessians, gradients = np.zeros((len(unknowns.parts), w, w)), np.zeros((len(unknowns.parts), w))
        for i, part, own in unknowns.clusters():
            rows = slopes[part].reshape(-1, slopes.shape[2])
            hessians[i][np.ix_(own, own)] = rows.T @ rows
            gradients[i, own] = rows.T @ residuals[part].reshape(-1)
        H = hessians.sum(axis=0)[m:, m:]
        constants = np.append(np.zeros(m), -scaled_inverse(H) @ gradients.sum(axis=0)[m:])
        for i, part, own in unknowns.clusters():
            residuals[part] += slopes[part] @ constants[own]
            gradients[i, own] = np.einsum("nij,ni->j", slopes[part], residuals[part])
        held = [m + j for j, name in enumerate(names) if name in ("radius", "distance")]
        radius = np.array([own[j] for own in unknowns.columns for j in held], dtype=np.int64)
        return Linearised(place, unknowns, slopes, residuals, constants, gradients, hessians, weights, radius, T)

    @property
    def m(self) -> int:
        """Numbers of the place that are fitted."""
        return self.unknowns.m

    @property
    def H(self) -> Float[np.ndarray, "w w"]:
        """Gauss-Newton Hessian."""
        return self.hessians.sum(axis=0)

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(np.sum(self.residuals**2))

    @property
    def variance(self) -> float:
        """sigma^2 [rad^2]."""
        return self.cost / max(self.weights.n_residuals - self.unknowns.size, 1.0)

    def step(self) -> Float[np.ndarray, " w"]:
        """Gauss-Newton step of all unknowns."""
        return -scaled_inverse(self.H) @ self.gradients.sum(axis=0)


def scaled_inverse(H: Float[np.ndarray, "w w"]) -> Float[np.ndarray, "w w"]:
    """H^+, each unknown scaled to its own."""
    size = np.sqrt(np.maximum(np.diag(H), np.finfo(np.float64).tiny))
    return np.linalg.pinv(H / np.outer(size, size), rcond=UNDETERMINED, hermitian=True) / np.outer(size, size)
