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
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, combinations_with_replacement, pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import PoseRows
from manip_learn.constraint.features.mechanism_rows import WeighedVelocity
from manip_learn.learning.search import least_used
from manip_learn.learning.table import LEAST_GAIN, LEAST_MOTION, ArmErrors, Settings, Stretch, View, tangents
from manip_learn.linalg import null_basis, orthonormal_rows, row_space_angles
from manip_learn.recordings.trajectory import evenly

ACCURACY = 4e-5  # [rad] accuracy of rails, tables and encoders: smaller residuals are equal
LEVEL = 0.68  # confidence level of all uncertainties
TAU = np.append(0.0, np.geomspace(1e-6, 3e-2, 60))  # [rad] candidate joint offsets beyond their prior


class Levels(NamedTuple):
    """Size of the motion along each direction.

    Attributes:
        sizes: RMS motion along each direction, smallest first, relative to a motion that is equally strong in all
            joints, shape (r,).
        directions: The directions, as whitened rows (r, r).
        gaps: Number of rows s -> gap, the ratio of size s + 1 to size s. Only for s that leave a joint free.
    """

    sizes: np.ndarray
    directions: np.ndarray
    gaps: dict[int, float]


def levels_from_moments(M: np.ndarray, S: np.ndarray, x: np.ndarray) -> Levels:
    """Compute the size of the motion along each direction from second moments.

    Args:
        M: Sum of y y^T (r, r) over all samples, with the velocities or displacements y = Phi x along the rows.
        S: Sum of Phi Phi^T (r, r) over all samples.
        x: Motion of the joints (n, nv): velocities or displacements.
    """
    (sizes,), (directions,) = least_used(M[None], S[None], np.zeros(1))
    sizes = sizes * np.sqrt(x.size / max(float(np.sum(x**2)), 1e-300))
    padded = np.maximum(np.append(sizes, 1.0), 3e-8 * max(float(sizes[-1]), 1.0))
    rows = range(1, min(len(sizes) + 1, x.shape[1]))
    return Levels(sizes, directions, {s: float(padded[s] / padded[s - 1]) for s in rows})


def view_levels(view: View, stretches: Sequence[Stretch]) -> Levels:
    """Compute the size of the velocities along each direction of a view.

    Args:
        view: View (samples in whitened features).
        stretches: Parts of recordings whose samples are used.
    """
    inside = view.table.inside(stretches, learnt_from=True)
    rates = view.all.rates[inside]
    return levels_from_moments(rates.T @ rates, view.all.gram[inside].sum(axis=0), view.table.u[inside])


@dataclass(frozen=True, eq=False)
class Motion:
    """Evenly spaced samples of some stretches in one view.

    Attributes:
        view: View (samples in whitened features).
        arm: Prior standard deviations of the errors of the arm.
        x: Recorded joint positions (n, nv) [rad or m].
        y: Displacements (n, r) along the whitened rows.
        Phi: Whitened features (n, r, nv).
        poses, J: Poses (n, 4, 4) of the hand, and its Jacobians (n, 6, nv); None without a frame.
        way: If recorded velocities are used: velocities (n, nv) times a duration, which makes them as large as
            displacements; held rows are then zero in each sample. None if positions are used; held rows are then
            constant in each stretch.
        parts: Slice of the n samples that belongs to each stretch.
        recs: Index of the recording of each stretch.
    """

    view: View
    arm: ArmErrors
    x: np.ndarray
    y: np.ndarray
    Phi: np.ndarray
    poses: Any
    J: Any
    way: np.ndarray | None
    parts: list[slice]
    recs: list[int]

    @staticmethod
    def of(view: View, stretches: Sequence[Stretch], settings: Settings) -> Motion:
        """Collect samples of some stretches, thinned out evenly to about 4000.

        Args:
            view: View (samples in whitened features).
            stretches: Parts of recordings.
            settings: Settings of the fit: prior of the arm's errors (`arm`), and use of velocities instead of positions
                (`by_rates`).

        Returns:
            The samples.
        """
        # number of samples of all stretches together, and least number of each stretch
        most_samples, least_samples = 4000, 60
        table, hand, most = view.table, view.hand, max(least_samples, most_samples // len(stretches))
        numbers = [table.samples(s) for s in stretches]
        selected = [k[evenly(len(k), most)] for k in numbers]
        ends, k, way = np.cumsum([0, *map(len, selected)]), np.concatenate(selected), None
        if settings.by_rates:  # the spread of a steady motion
            spread = [np.ptp(table.time[i]) / np.sqrt(12.0) for i in numbers]
            way = table.u[k] * np.repeat(spread, np.diff(ends))[:, None]
        first = np.repeat([i[0] for i in numbers], np.diff(ends))
        y = view.y[k] - view.y[first] if way is None else np.einsum("nrv,nv->nr", view.Phi[k], way)
        poses, J = (None, None) if hand.of is None else (hand.poses[k], hand.J[k])
        parts, recs = [slice(*edges) for edges in pairwise(ends)], [s.recording for s in stretches]
        return Motion(view, settings.arm, hand.x[k], y, view.Phi[k], poses, J, way, parts, recs)

    @cached_property
    def levels(self) -> Levels:
        """RMS displacement along each direction of the whitened feature rows, as `Levels`."""
        y, x = self.y, self.x if self.way is None else self.way
        if self.way is None:
            y, x = (np.concatenate([z[p] - z[p].mean(axis=0) for p in self.parts]) for z in (y, x))
        return levels_from_moments(y.T @ y, np.einsum("npv,nqv->pq", self.Phi, self.Phi), x)


def link_error_changes(
    features: FeatureMap, q: Float[np.ndarray, "n nv"], u: Float[np.ndarray, "n nv"]
) -> Float[np.ndarray, "n p e"]:
    """Return the change of Phi(q) u by a unit error of each link's geometry.

    An error of a link displaces everything behind it, like an additional joint at that position. Let (v, w) be the
    twist of the frame caused by one such error, at the frame's origin: the joints behind it turn with w, and the origin
    moves by v relative to the joints before it. The twist V = V_before + V_behind of a motion then changes by

        dV = (w_before x v + w x v_behind,  w x w_behind)

    as for the derivative with respect to a joint position. The velocities W V of the rows change by W dV + dW V. Errors
    of the first joint's pose are left out, because they move the base and no recording shows them.

    Args:
        features: Feature map Phi.
        q: Configurations (n, nv) [rad or m].
        u: Joint velocities, or displacements (n, nv).

    Returns:
        Changes (n, p, e) for e errors (position and orientation of each link). e = 0 if the features are not of one
        frame relative to the base.
    """
    none = np.zeros((len(q), features.n_rows, 0))
    if not isinstance(features, WeighedVelocity | PoseRows) or features.relative_to is not None:
        return none
    robot, frame, J, poses = features.robot, features.frame, features.twist.batch(q), features.twist.poses(q)
    behind = {j: number for number, j in enumerate(robot.pinocchio_model.supports[frame.parent_joint], -1)}
    # number of the joint in the chain that each velocity moves, -1 if none; numbers from 1 on are behind the first link
    place = np.full(robot.nv, -1)
    for block in robot.blocks:
        place[block.v] = behind.get(block.index, -1)
    V, W, out = np.einsum("nij,nj->ni", J, u), features.weights_at(poses), [none]
    dW = features.place_weights.at(poses[:, :3, 3])[1] if isinstance(features, WeighedVelocity) else None
    twists = robot.frame_kinematics(frame).link_twists(q)
    for link, E in enumerate(() if twists is None else twists):
        behind_link = place > link
        moved = np.einsum("nij,nj->ni", J[:, :, behind_link], u[:, behind_link])
        v, w = E[:, :3].transpose(0, 2, 1), E[:, 3:].transpose(0, 2, 1)
        before, later = (V - moved)[:, None, 3:], moved[:, None]
        if isinstance(features, PoseRows) and features.own_axes:  # these rows turn with the frame
            later = later - V[:, None]
        dV = np.concatenate([np.cross(before, v) + np.cross(w, later[..., :3]), np.cross(w, later[..., 3:])], axis=2)
        out.append(np.einsum("npi,nei->npe", W, dV))
        if dW is not None:
            out[-1] += np.einsum("npix,nxe,ni->npe", dW, E[:, :3], V, optimize=True)
    return np.concatenate(out, axis=2)


class RowFit:
    """Fit of constrained rows Lambda to displacements, with its residual and derivatives.

    Lambda has whitened orthonormal rows; it changes to Lambda + B Lambda_perp with the parameters B.

    Attributes:
        motion, view: Samples, and their view.
        rows, perp: Rows of Lambda (s, r), and their orthonormal complement (r - s, r).
        r: Weighted residuals (n, s) [rad].
        cost: Sum of squares of the residuals.
        m: Number of parameters, the size of B.
        dof: Degrees of freedom of the residual.
        variance: Variance of the residual, at least `ACCURACY` squared [rad^2].
    """

    def __init__(self, motion: Motion, rows: np.ndarray):
        floor = 0.05  # share of the mean variance that is added to the variance of each sample
        self.motion, self.view, self.rows, self.perp = motion, motion.view, rows, null_basis(rows).T
        self.m, self._A = len(rows) * len(self.perp), rows @ motion.Phi
        S = self._A @ self._A.transpose(0, 2, 1)
        S = S + floor * np.mean(np.einsum("nii->ni", S), axis=0).max() * np.eye(len(rows))
        self.root = np.linalg.inv(np.linalg.cholesky(S))
        J = np.einsum("nai,nj->naij", self.root, motion.y @ self.perp.T).reshape(*S.shape[:2], self.m)
        r = self.root @ (motion.y @ rows.T)[:, :, None]
        self._JR = self.centre(np.concatenate([J, r], axis=2))
        self.r = self._JR[:, :, -1]
        self.cost = float(np.sum(self.r**2))
        constants = len(rows) * len(motion.parts) if motion.way is None else 0
        self.dof = max(self.r.size - constants - self.m, 1)
        self.variance = self.cost / self.dof + ACCURACY**2

    def centre(self, columns: np.ndarray) -> np.ndarray:
        """Subtract from each column its best-fitting constant in each stretch; do nothing if velocities are used.

        Args:
            columns: Array (n, s, c) of c columns.

        Returns:
            Array (n, s, c).
        """
        out = columns.copy()
        for p in self.motion.parts if self.motion.way is None else ():
            W = self.root[p]
            out[p] -= W @ np.linalg.solve(np.einsum("nai,naj->ij", W, W), np.einsum("nai,nac->ic", W, out[p]))
        return out

    def sums(self, X: np.ndarray) -> dict[int, np.ndarray]:
        """Return X^T X of each recording.

        Args:
            X: Array (n, s, c) of c columns.

        Returns:
            Dictionary from the index of a recording to its matrix (c, c).
        """
        out = dict.fromkeys(self.motion.recs, np.zeros((X.shape[2], X.shape[2])))
        for p, i in zip(self.motion.parts, self.motion.recs, strict=True):
            out[i] = out[i] + np.tensordot(X[p], X[p], axes=([0, 1], [0, 1]))
        return out

    def correction(self) -> np.ndarray:
        """Return the smallest change of each configuration after which its residual is zero.

        Returns:
            Changes (n, nv) [rad or m].
        """
        off = np.linalg.solve(self.root, self.r[:, :, None])  # along the rows
        gram = self._A @ self._A.transpose(0, 2, 1)
        gram += 1e-9 * np.trace(gram, axis1=1, axis2=2).mean() * np.eye(gram.shape[1])
        return (self._A.transpose(0, 2, 1) @ np.linalg.solve(gram, off))[:, :, 0]

    @cached_property
    def X(self) -> np.ndarray:
        """Columns [J K r] of the least-squares problem, shape (n, s, m + e + 1).

        J is the derivative of the residual r with respect to B. K is its change by unit joint offsets and, in
        proportion, errors of links. K is evaluated at the nearest configurations on the mechanism, because at the
        recorded ones it would contain the residual (errors in variables).
        """
        motion, features, arm = self.motion, self.view.features, self.motion.arm
        dq = self.correction()
        y, x, way = motion.y - np.einsum("nrv,nv->nr", motion.Phi, dq), motion.x - dq, motion.way
        middle, step = (0.5 * (x[1:] + x[:-1]), tangents(features.robot, x)) if way is None else (x, way)
        change = np.einsum("npvk,nv->npk", features.batch_with_derivative(middle)[1], step, optimize=True)
        if arm.links and arm.zeros > 0.0:
            links = arm.links / arm.zeros * link_error_changes(features, middle, step)
            change = np.concatenate([change, links], axis=2)
        if way is None:
            change = np.concatenate([np.zeros((1, *change.shape[1:])), np.cumsum(change, axis=0)])
        J = np.einsum("nai,nj->naij", self.root, y @ self.perp.T).reshape(*self.r.shape, self.m)
        K = self.root @ (self.rows @ (self.view.W @ change))
        return np.concatenate([self.centre(np.concatenate([J, K], axis=2)), self._JR[:, :, -1:]], axis=2)

    @cached_property
    def G(self) -> dict[int, np.ndarray]:
        """Matrix X^T X of each recording, by the index of the recording."""
        return self.sums(self.X)

    def best(self) -> RowFit:
        """Return the fit with the smallest cost, by Levenberg-Marquardt steps on the Grassmann manifold."""
        here, damping = self, 0.0
        for _ in range(25 if self.m else 0):
            total = np.tensordot(here._JR, here._JR, axes=([0, 1], [0, 1]))
            H, g = total[: self.m, : self.m], total[: self.m, -1]
            B = -solve(H + damping * np.diag(np.diag(H)), g)
            if B @ H @ B <= 1e-6 * here.cost / here.dof:
                break
            turned = here.rows + B.reshape(len(here.rows), -1) @ here.perp
            there = RowFit(self.motion, orthonormal_rows(turned))
            gain = here.cost - there.cost
            here, damping = (there, 0.1 * damping) if gain > 0.0 else (here, max(10.0 * damping, 1e-4))
            if 0.0 < gain < 1e-9 * here.cost or damping > 1e6:
                break
        return here

    @cached_property
    def inflation(self) -> float:
        """Factor by which correlation of neighbouring samples increases a variance, at least 1."""
        return autocorrelation(self.r, self.motion.parts)

    def nats(self, other: RowFit) -> float:
        """Return the log-likelihood ratio to another fit with as many rows, with a penalty for parameters [nats].

        The penalty is from the information criterion of Schwarz (1978).

        Args:
            other: Fit to the same motion, e.g. in other features.

        Returns:
            Positive if this fit is better [nats].
        """
        n, floor = self.dof / self.inflation, self.dof * ACCURACY**2
        gain = n * float(np.log((other.cost + floor) / (self.cost + floor)))
        return 0.5 * (gain - (self.m - other.m) * float(np.log(max(n, 2.0))))


def solve(H: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Solve H x = g in the least-squares sense, with each unknown scaled by its own curvature.

    Args:
        H: Symmetric matrix (m, m).
        g: Right-hand side (m,), or several as columns (m, k).

    Returns:
        Solution with the shape of `g`.
    """
    size = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    inverse = np.linalg.pinv(H * np.outer(size, size), rcond=1e-12, hermitian=True)
    return (size * (inverse @ (size * g.T).T).T).T  # of a vector, or of each column


def autocorrelation(r: np.ndarray, parts: Sequence[slice]) -> float:
    """Return the factor by which correlation of neighbouring samples increases a variance, at least 1.

    Args:
        r: Residuals (n, k).
        parts: Slices of consecutive samples; samples of different slices are no neighbours.
    """
    total, square = 1.0, max(float(np.sum(r**2)) / len(r), 1e-300)
    for k in range(1, 101):
        products = np.concatenate([np.sum(r[p][k:] * r[p][:-k], axis=1) for p in parts])
        n = len(products)
        if n < 2 * k or (share := float(products.mean()) / square) < 2.0 / np.sqrt(n):
            break
        total += 2.0 * share
    return total


# --------------------------------------------------------------------------------- which recordings share a place


def group_fit(fit: RowFit) -> list[set[int]]:
    """Divide the recordings into groups that share one Lambda, if several groups explain them much better than one.

    Joint offsets are eliminated in both cases, because they make one drawer seem to run in different directions from
    different configurations. The comparison is of first order in the change of Lambda.

    Args:
        fit: Fit of one Lambda to all recordings.

    Returns:
        Indices of the recordings of each group, largest group first.
    """
    m, recs = fit.m, sorted(set(fit.motion.recs))
    away = [np.sqrt(np.mean(np.sum(fit.r[p] ** 2, axis=1))) for p in fit.motion.parts]
    if len(recs) < 2 or not m or max(away) < 0.5 * LEAST_MOTION:
        return [set(recs)]
    few = [recs[i] for i in evenly(len(recs), 16)]
    ridge = 1e-9 * np.diag(np.diag(np.sum([*fit.G.values()], axis=0)[:m, :m]))

    def reduced(members: Sequence[int]) -> np.ndarray:
        """Return [K r]^T [K r] with B eliminated.

        Args:
            members: Numbers of recordings.
        """
        total = np.sum([fit.G[i] for i in members], axis=0)
        return total[m:, m:] - total[m:, :m] @ np.linalg.solve(total[:m, :m] + ridge, total[:m, m:])

    groups: dict[tuple[int, ...], np.ndarray] = {(i,): reduced([i]) for i in few}
    dof = max(fit.dof * len(few) / len(recs) - m * (len(few) - 1), 1.0)
    variance = sum(x[-1, -1] for x in groups.values()) / dof + ACCURACY**2
    r = fit.r.copy()  # with a separate B for each of the few
    for p, i in zip(fit.motion.parts, fit.motion.recs, strict=True):
        if i in few:
            r[p] -= fit.X[p][:, :, :m] @ solve(fit.G[i][:m, :m], fit.G[i][:m, -1])
    n = dof / autocorrelation(r, fit.motion.parts)

    def nats(groups: dict[tuple[int, ...], np.ndarray]) -> float:
        """Return the evidence of groups with joint offsets eliminated, net of their price [nats].

        Args:
            groups: Numbers of the recordings of a group -> its matrix [K r]^T [K r].
        """
        S = np.sum([*groups.values()], axis=0)
        K = S[:-1, :-1] + variance / TAU[-1] ** 2 * np.eye(len(S) - 1)
        cost = max(float(S[-1, -1] - S[-1, :-1] @ np.linalg.solve(K, S[:-1, -1])), 0.0) + dof * ACCURACY**2
        return -0.5 * n * float(np.log(cost)) - 0.5 * m * len(groups) * float(np.log(max(n, 2.0)))

    if nats(groups) - nats({tuple(few): reduced(few)}) < LEAST_GAIN:
        return [set(recs)]
    while len(groups) > 1:
        options = []
        for a, b in combinations(groups, 2):
            others = {k: v for k, v in groups.items() if k not in (a, b)}
            options.append(others | {tuple(sorted(a + b)): reduced(a + b)})
        fewer = max(options, key=nats)
        if nats(groups) - nats(fewer) >= LEAST_GAIN:
            break
        groups = fewer
    out = sorted((set(g) for g in groups), key=len, reverse=True)
    for i in set(recs) - set(few):  # the others join the group with the smallest loss
        losses = [reduced([*g, i])[-1, -1] - reduced(list(g))[-1, -1] for g in out]
        out[int(np.argmin(losses))].add(i)
    return out


def misfit(fit: RowFit) -> tuple[float, float]:
    """Measure if the rows have the wrong shape, e.g. straight rows for a bent rail.

    A wrong shape leaves a residual that depends on the hand's position in the same way in every recording.

    Args:
        fit: Fit of the rows.

    Returns:
        Log-likelihood gain on held-out recordings of a cubic in the hand's position over joint offsets alone [nats],
        positive for a wrong shape, 0 with fewer than three recordings, without poses or if no parameter was fitted; and
        RMS motion along the constrained rows that `fit` leaves [m or rad].
    """
    motion, off = fit.motion, np.linalg.solve(fit.root, fit.r[:, :, None])
    rms = float(np.sqrt(np.mean(np.sum(off**2, axis=(1, 2)))))
    if motion.poses is None or len(set(motion.recs)) < 3 or not fit.m:
        return 0.0, rms
    x = motion.poses[:, :3, 3] - motion.poses[:, :3, 3].mean(axis=0)
    factors = [[*axes] for n in (2, 3) for axes in combinations_with_replacement(range(3), n)]
    powers = np.stack([np.prod(x[:, axes], axis=1) for axes in factors], axis=1)
    P = np.einsum("nai,nc->naic", fit.root, powers).reshape(*fit.r.shape, -1)
    X = np.concatenate([fit.X[:, :, :-1], fit.centre(P), fit.X[:, :, -1:]], axis=2)
    G, plain = fit.sums(X), fit.X.shape[2] - 1
    total, prior, costs = np.sum([*G.values()], axis=0), np.zeros(X.shape[2] - 1), np.full(2, fit.dof * ACCURACY**2)
    prior[fit.m : plain] = fit.variance / TAU[-1] ** 2
    for mine in G.values():
        rest = total - mine
        for i, d in enumerate((plain, len(prior))):
            b = np.append(-solve(rest[:d, :d] + np.diag(prior[:d]), rest[:d, -1]), 1.0)
            columns = [*range(d), -1]
            costs[i] += b @ mine[np.ix_(columns, columns)] @ b
    return 0.5 * fit.dof / fit.inflation * float(np.log(costs[0] / costs[1])), rms


# ------------------------------------------------------------------------------------------------------ uncertainty


@dataclass(frozen=True, eq=False)
class Errors:
    """Random draws of the error of a fit's m parameters.

    Attributes:
        noise, arm: Errors of the parameters caused by noise, and by errors of the arm, shape (k, m) each for k draws.
        delta: Errors of the arm in each draw (joint offsets, link errors), shape (k, e).
        beyond: Size of the joint offsets [rad] if offsets larger than their prior explain the residual far better; 0 if
            the prior suffices.
    """

    noise: np.ndarray
    arm: np.ndarray
    delta: np.ndarray
    beyond: float = 0.0


def draw_errors(fit: RowFit, arm: ArmErrors, rng: np.random.Generator) -> Errors | None:
    """Draw random errors of the parameters of a fit.

    Args:
        fit: Fit of the rows.
        arm: Prior standard deviations of the errors of the arm.
        rng: Source of random numbers.

    Returns:
        The draws; None with a single recording, or if only one row space is possible.
    """
    # number of draws: the 68 % quantile is accurate to 3 %; odds that joint offsets do not exceed their prior
    n_draws, odds = 1000, 20.0
    m, n = fit.m, len(set(fit.motion.recs))
    if not m or n < 2:
        return None
    total, variance = np.sum([*fit.G.values()], axis=0), fit.cost / fit.dof * fit.inflation + 1e-30
    H = total[:m, :m]
    C = variance * solve(H, np.eye(m))
    # scatter of the recordings beyond that: their influences, corrected for the leverage of each
    white = np.linalg.cholesky(np.linalg.inv(0.5 * (C + C.T) + (1e-14 * np.trace(C) / m + 1e-300) * np.eye(m)))
    moves = [white.T @ solve(1.001 * H - sums[:m, :m], sums[:m, -1]) for sums in fit.G.values()]
    ratio, freedom = (1.0 - 1.0 / n) * float(np.sum(np.square(moves))) / m, max(m * (n - 1.0), 2.0)
    values, vectors = np.linalg.eigh(C)
    noise = rng.standard_normal((n_draws, m)) @ ((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
    if ratio > 1.0 + 1.5 * np.sqrt(2.0 / freedom):
        noise *= np.sqrt(ratio * freedom / rng.chisquare(freedom, n_draws))[:, None]
    # errors of the arm, delta ~ N(0, (z^2 + tau^2)), from their pattern and the residual with B eliminated
    variance += ACCURACY**2
    response = -solve(H, total[:m, m:])
    S = total[m:, m:] + total[m:, :m] @ response
    lam, V = np.linalg.eigh(S[:-1, :-1])
    lam, hv = np.maximum(lam, 0.0), V.T @ S[:-1, -1]
    observable = lam > 1e-8 * max(lam.max(), 1e-300)
    sizes = arm.zeros**2 + TAU**2
    # log-likelihood of each size of joint offsets beyond their prior, none first
    v = lam[observable] * (variance + lam[observable] * sizes[:, None]) + 1e-300
    likelihood = -0.5 * np.sum(np.log(v) + hv[observable] ** 2 / v, axis=1)
    weight = np.exp(likelihood - likelihood.max())
    weight[0] *= odds * (len(TAU) - 1)
    prior = sizes[rng.choice(len(TAU), n_draws, p=weight / weight.sum()), None]
    posterior = np.divide(1.0, lam / variance + 1.0 / np.maximum(prior, 1e-300))
    mean = -posterior * np.where(observable, hv / variance, 0.0)
    delta = (mean + np.sqrt(posterior) * (rng.standard_normal(posterior.shape) @ V)) @ V.T
    likeliest = int(np.argmax(likelihood))
    is_beyond = TAU[likeliest] > 3.0 * arm.zeros and likelihood[likeliest] - likelihood[0] > LEAST_GAIN
    return Errors(noise, delta @ response[:, :-1].T, delta, float(TAU[likeliest]) if is_beyond else 0.0)


def angles(rows: np.ndarray, W: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the angle between the row space of Lambda and each changed row space, Lambda + B Lambda_perp.

    Args:
        rows: Whitened rows (s, r) of Lambda.
        W: Whitening matrix (r, p), with which the angles are computed in the rows of the features.
        B: Parameters of k changes, shape (k, s (r - s)).

    Returns:
        Angles (k,) [rad].
    """
    return row_space_angles((rows + B.reshape(len(B), len(rows), -1) @ null_basis(rows).T) @ W, rows @ W)
