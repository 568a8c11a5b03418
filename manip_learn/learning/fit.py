"""Fit of rows to displacements along the recorded positions, from which the evidence and the uncertainty follow.

With y the rates of the rows integrated along the recorded positions (dy = Phi dq), constrained rows keep Lambda y
constant along each stretch. White noise sigma of the encoders gives Lambda y the covariance sigma^2 Lambda Phi Phi^T
Lambda^T, so that

    E(Lambda) = sum_n | W_n Lambda (y_n - c_stretch) |^2,     W_n = (Lambda Phi Phi^T Lambda^T)^(-1/2)

is maximum likelihood: equation (10) with displacements instead of velocities. Joint offsets and errors of the links
change y by K_n delta, K = int dPhi[delta] dq. With the columns J (by B of Lambda + B Lambda_perp), K and the residual
r, less their best constants, the rest is algebra on the sums X^T X of each recording, X = [J K r]: the Gauss-Newton
step, the noise, groups of recordings that share a place, the effect of errors of the arm, and the angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import PoseRows
from manip_learn.constraint.features.mechanism_rows import WeighedVelocity
from manip_learn.learning.search import least_used
from manip_learn.learning.table import ArmErrors, Settings, Stretch, View, displacements, steps_along
from manip_learn.linalg import complement_rows, turned
from manip_learn.recordings.trajectory import evenly
from manip_learn.recordings.velocities import positions_along
from manip_learn.robot.batch.batch_kinematics import link_twists

MOST, LEAST = 4000, 60  # samples of all stretches, and of each
LEAST_RAD = 4e-5  # less is no difference: rails, tables and encoders are no better
FLOOR = 0.05  # share of the mean variance that every sample has besides


@dataclass(frozen=True, eq=False)
class Motion:
    """Samples of some stretches in one feature map, in whitened rows.

    Attributes:
        features: Feature map Phi.
        W: shape (r, p), whitening matrix.
        arm: Prior of the errors of the arm.
        x: shape (n, nv), recorded positions [rad or m].
        y: shape (n, r), displacements along the rows.
        Phi: shape (n, r, nv), whitened features.
        place: shape (n, 3), position of the hand [m]; None without a frame.
        way: shape (n, nv), recorded velocities times a duration, as large as displacements; None if positions are
            used. What is held is then zero in each sample, not constant in each stretch.
        parts: Samples of each stretch.
        recs: Recording of each stretch.
    """

    features: FeatureMap
    W: np.ndarray
    arm: ArmErrors
    x: np.ndarray
    y: np.ndarray
    Phi: np.ndarray
    place: np.ndarray | None
    way: np.ndarray | None
    hand: Any  # all six rows of the frame, where mechanisms are constant (`PoseRows`); None for other features
    parts: list[slice]
    recs: list[int]

    @staticmethod
    def of(view: View, stretches: Sequence[Stretch], settings: Settings) -> Motion:
        """Return evenly spaced samples of the stretches of a table."""
        features, table, out = view.features, view.table, []
        robot, twist = getattr(features, "robot", None), features.twist
        for t in map(table.piece, stretches):
            x = t.q if robot is None else positions_along(t, robot)
            x = t.q if x is None else x
            way = np.asarray(t.u) * (t.time[-1] - t.time[0]) / np.sqrt(12.0)  # the spread of a steady motion
            y = displacements(features, x, way if settings.by_rates else None)
            k = evenly(len(x), max(LEAST, MOST // len(stretches)))
            out.append((y[k], x[k], way[k]))
        ends = np.cumsum([0, *(len(z) for z, *_ in out)])
        y, x, way = (np.concatenate(z) for z in zip(*out, strict=True))
        y, Phi, way = y @ view.W.T, view.W @ features.batch(x), way if settings.by_rates else None
        place = None if twist is None else twist.poses(x)[:, :3, 3]
        parts, recs = [slice(*edges) for edges in pairwise(ends)], [s.recording for s in stretches]
        return Motion(features, view.W, settings.arm, x, y, Phi, place, way, twist, parts, recs)

    def by_the_arm(self, x: np.ndarray) -> np.ndarray:
        """Return the change of y along postures by unit joint offsets and, in proportion, errors of links (n, r, e)."""
        way = self.way
        middle, step = (0.5 * (x[1:] + x[:-1]), steps_along(self.features, x)) if way is None else (x, way)
        change = np.einsum("npvk,nv->npk", self.features.batch_with_derivative(middle)[1], step, optimize=True)
        if self.arm.links and self.arm.zeros > 0.0:
            links = self.arm.links / self.arm.zeros * changes_by_links(self.features, middle, step)
            change = np.concatenate([change, links], axis=2)
        if way is None:
            change = np.concatenate([np.zeros((1, *change.shape[1:])), np.cumsum(change, axis=0)])
        return self.W @ change

    def seen_as(self, features: FeatureMap, W: np.ndarray) -> Motion:
        """Return the same motion in another feature map."""
        y = [displacements(features, self.x[p], None if self.way is None else self.way[p]) for p in self.parts]
        return replace(self, features=features, W=W, y=np.concatenate(y) @ W.T, Phi=W @ features.batch(self.x))

    @cached_property
    def turned_by_joints(self) -> float:
        """RMS rotation of the hand by independent motions of the joints that are as large as these [deg]."""
        middles = np.array([self.x[(p.start + p.stop) // 2] for p in self.parts])
        turns = np.sum(self.hand.batch(middles)[:, 3:] ** 2, axis=1)
        spread = np.array([np.var(self.x[p], axis=0) for p in self.parts])
        return float(np.degrees(np.median(np.sqrt(np.sum(turns * spread, axis=1)))))

    @cached_property
    def least(self) -> tuple[np.ndarray, np.ndarray]:
        """RMS displacement along each direction, smallest first, over that of equally strong joints [1]; directions."""
        y, x = self.y, self.x if self.way is None else self.way
        if self.way is None:
            y, x = (np.concatenate([z[p] - z[p].mean(axis=0) for p in self.parts]) for z in (y, x))
        return relative_levels(y.T @ y, np.einsum("npv,nqv->pq", self.Phi, self.Phi), x)


def changes_by_links(
    features: FeatureMap, q: Float[np.ndarray, "n nv"], u: Float[np.ndarray, "n nv"]
) -> Float[np.ndarray, "n p e"]:
    """Return the change of Phi(q) u by unit errors of e links, at n postures.

    A link that is not as described displaces all that comes after it, as a joint would that has a rigid motion there.
    With the twist (v, w) that one such error makes of the frame, seen at its origin, the joints behind it turn with w,
    and the origin moves with v away from those before it. So a motion with the twist V = V_before + V_behind becomes

        dV = (w_before x v + w x v_behind,  w x w_behind)

    as for the derivative by the position of a joint. The rates W V of rows then change by W dV + dW V. Where the first
    joint stands is where the base stands, which no recording can show: it is left out. There are none (e = 0) if the
    features are not of one frame in the base.
    """
    none = np.zeros((len(q), features.n_rows, 0))
    if not isinstance(features, WeighedVelocity | PoseRows) or features.relative_to is not None:
        return none
    robot, frame, J, poses = features.robot, features.frame, features.twist.batch(q), features.twist.poses(q)
    behind = {j: number for number, j in enumerate(robot.pinocchio_model.supports[frame.parent_joint], -1)}
    # the number of the chain's joint that each velocity moves, -1 if none: those from 1 on are behind the first link
    place = np.full(robot.nv, -1)
    for block in robot.blocks:
        place[block.v] = behind.get(block.index, -1)
    V, W, out = np.einsum("nij,nj->ni", J, u), features.weights_at(poses), [none]
    dW = features.place_weights.at(poses[:, :3, 3])[1] if isinstance(features, WeighedVelocity) else None
    twists = link_twists(robot, frame, q)
    for link, E in enumerate(() if twists is None else twists):
        own = place > link
        moved = np.einsum("nij,nj->ni", J[:, :, own], u[:, own])
        v, w = E[:, :3].transpose(0, 2, 1), E[:, 3:].transpose(0, 2, 1)
        before, later = (V - moved)[:, None, 3:], moved[:, None]
        if isinstance(features, PoseRows) and features.own_axes:  # which turn with the frame
            later = later - V[:, None]
        dV = np.concatenate([np.cross(before, v) + np.cross(w, later[..., :3]), np.cross(w, later[..., 3:])], axis=2)
        out.append(np.einsum("npi,nei->npe", W, dV))
        if dW is not None:
            out[-1] += np.einsum("npix,nxe,ni->npe", dW, E[:, :3], V, optimize=True)
    return np.concatenate(out, axis=2)


class RowFit:
    """Fit of a Lambda (whitened, orthonormal rows) to a motion, with its residual and derivatives.

    Attributes:
        motion: Samples.
        rows, perp: shape (s, r) and (r - s, r), rows of Lambda and their orthonormal complement.
        r: shape (n, s), weighted residual [rad].
        cost: Sum of squares of the residual.
        m: Number of parameters B of Lambda + B Lambda_perp.
        dof: Degrees of freedom of the residual.
        variance: Variance of the residual, of at least `LEAST_RAD` squared [rad^2].
    """

    def __init__(self, motion: Motion, rows: np.ndarray):
        self.motion, self.rows, self.perp = motion, rows, complement_rows(rows)
        self.m, self._A = len(rows) * len(self.perp), rows @ motion.Phi
        S = self._A @ self._A.transpose(0, 2, 1)
        S = S + FLOOR * np.mean(np.einsum("nii->ni", S), axis=0).max() * np.eye(len(rows))
        self.root = np.linalg.inv(np.linalg.cholesky(S))
        J = np.einsum("nai,nj->naij", self.root, motion.y @ self.perp.T).reshape(*S.shape[:2], self.m)
        r = self.root @ (motion.y @ rows.T)[:, :, None]
        self._JR = self.without_constants(np.concatenate([J, r], axis=2))
        self.r = self._JR[:, :, -1]
        self.cost = float(np.sum(self.r**2))
        constants = len(rows) * len(motion.parts) if motion.way is None else 0
        self.dof = max(self.r.size - constants - self.m, 1)
        self.variance = self.cost / self.dof + LEAST_RAD**2

    def without_constants(self, columns: np.ndarray) -> np.ndarray:
        """Return columns (n, s, c) less their best constants of each stretch."""
        out = columns.copy()
        for p in self.motion.parts if self.motion.way is None else ():
            own = self.root[p]
            out[p] -= own @ np.linalg.solve(np.einsum("nai,naj->ij", own, own), np.einsum("nai,nac->ic", own, out[p]))
        return out

    def sums(self, X: np.ndarray) -> dict[int, np.ndarray]:
        """Return X^T X of each recording, by its number."""
        out = dict.fromkeys(self.motion.recs, np.zeros((X.shape[2], X.shape[2])))
        for p, i in zip(self.motion.parts, self.motion.recs, strict=True):
            out[i] = out[i] + np.tensordot(X[p], X[p], axes=([0, 1], [0, 1]))
        return out

    def shortest_way_back(self) -> np.ndarray:
        """Return the smallest change of each posture that cancels its residual, shape (n, nv) [rad or m]."""
        off = np.linalg.solve(self.root, self.r[:, :, None])  # along the rows
        gram = self._A @ self._A.transpose(0, 2, 1)
        gram += 1e-9 * np.trace(gram, axis1=1, axis2=2).mean() * np.eye(gram.shape[1])
        return (self._A.transpose(0, 2, 1) @ np.linalg.solve(gram, off))[:, :, 0]

    @cached_property
    def X(self) -> np.ndarray:
        """Columns [J K r], shape (n, s, m + e + 1).

        The pattern K of errors of the arm is evaluated at the nearest postures on the mechanism: at the recorded ones
        it would contain the residual itself (errors in variables).
        """
        dq = self.shortest_way_back()
        y = self.motion.y - np.einsum("nrv,nv->nr", self.motion.Phi, dq)
        J = np.einsum("nai,nj->naij", self.root, y @ self.perp.T).reshape(*self.r.shape, self.m)
        K = self.root @ (self.rows @ self.motion.by_the_arm(self.motion.x - dq))
        return np.concatenate([self.without_constants(np.concatenate([J, K], axis=2)), self._JR[:, :, -1:]], axis=2)

    @cached_property
    def G(self) -> dict[int, np.ndarray]:
        """Sums X^T X of each recording, by its number."""
        return self.sums(self.X)

    def best(self) -> RowFit:
        """Return the fit with the least cost, by Levenberg-Marquardt on the Grassmann manifold."""
        here, damping = self, 0.0
        for _ in range(25 if self.m else 0):
            total = np.tensordot(here._JR, here._JR, axes=([0, 1], [0, 1]))
            H, g = total[: self.m, : self.m], total[: self.m, -1]
            B = -solve(H + damping * np.diag(np.diag(H)), g)
            if B @ H @ B <= 1e-6 * here.cost / here.dof:
                break
            there = RowFit(self.motion, turned(here.rows, B))
            gain = here.cost - there.cost
            here, damping = (there, 0.1 * damping) if gain > 0.0 else (here, max(10.0 * damping, 1e-4))
            if 0.0 < gain < 1e-9 * here.cost or damping > 1e6:
                break
        return here

    @cached_property
    def alike(self) -> float:
        """Factor by which correlated neighbours increase a variance."""
        return autocorrelation(self.r, self.motion.parts)

    def nats(self, other: RowFit) -> float:
        """Return the gain over another fit of as many rows, net of the price of parameters [nats]."""
        n, floor = self.dof / self.alike, self.dof * LEAST_RAD**2
        gain = n * float(np.log((other.cost + floor) / (self.cost + floor)))
        return 0.5 * (gain - (self.m - other.m) * float(np.log(max(n, 2.0))))


def solve(H: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return H^+ g, with each unknown scaled by its own curvature."""
    size = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    inverse = np.linalg.pinv(H * np.outer(size, size), rcond=1e-12, hermitian=True)
    return (size * (inverse @ (size * g.T).T).T).T  # of a vector, or of each column


def autocorrelation(r: np.ndarray, parts: Sequence[slice]) -> float:
    """Return the factor by which correlated neighbours in each part increase a variance, at least 1."""
    total, square = 1.0, max(float(np.sum(r**2)) / len(r), 1e-300)
    for k in range(1, 101):
        products = np.concatenate([np.sum(r[p][k:] * r[p][:-k], axis=1) for p in parts])
        n = len(products)
        if n < 2 * k or (share := float(products.mean()) / square) < 2.0 / np.sqrt(n):
            break
        total += 2.0 * share
    return total


def relative_levels(M: np.ndarray, S: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how much motion uses each direction, smallest first, and the directions as rows (r, r).

    Args:
        M: shape (r, r), sum of r r^T of the rates, or displacements, r = Phi x.
        S: shape (r, r), sum of Phi Phi^T.
        x: shape (n, nv), motion of the joints; levels are relative to one that is equally strong in all of them [1].
    """
    sizes, directions = least_used(M[None], S[None], np.zeros(1))
    return sizes[0] * np.sqrt(x.size / max(float(np.sum(x**2)), 1e-300)), directions[0]


def levels_on(view: View, stretches: Sequence[Stretch]) -> tuple[np.ndarray, np.ndarray]:
    """Return how much the velocities use each direction, smallest first, and the directions as whitened rows (r, r).

    Levels are relative to a motion that is equally strong in all joints [1], shape (r,).
    """
    inside = view.table.inside([view.table.learnt_from(s) for s in stretches])
    rates = view.all.rates[inside]
    return relative_levels(rates.T @ rates, view.all.gram[inside].sum(axis=0), view.table.u[inside])


def gaps_of(levels: np.ndarray, nv: int) -> dict[int, float]:
    """Return the gap of each number of rows below nv: the ratio of the next level to its largest level."""
    padded = np.maximum(np.append(levels, 1.0), 3e-8 * max(float(levels[-1]), 1.0))
    return {s: float(padded[s] / padded[s - 1]) for s in range(1, len(levels) + 1) if s < nv}
