"""The place of a mechanism by maximum likelihood for errors of the joints, and what its own error may be.

Each held quantity z_n(place) is a constant c along a trajectory, for each its own or, where shared, one for all. An
error dq_n of the joints moves it by D_n J_n dq_n, with J the Jacobian of the frame and D the slope of the quantity
along the frame's twist. The same error sigma in all joints gives, to first order (W. A. Fuller, Measurement Error
Models, 1987, section 3.2),

    l(place, c) = - 1/2 sum_n (z_n - c)^T W_n (z_n - c) / sigma^2,     W_n = (D_n J_n J_n^T D_n^T)^-1

Constants of single trajectories are linear and are projected off (R. Frisch and F. V. Waugh, 1933). With r_n what is
left of W_n^(1/2) (z_n - c), M_n its slopes by the unknowns, the place and the shared constants, and H = sum M_n^T M_n,
an error e_n of r_n moves what is stated by sum G_n^T e_n; for the unknowns G_n = -M_n H^-1. The covariance is

    C = f sigma^2 sum_n,k rho_k G_n^T G_n+k

rho is the autocorrelation of the residuals: smoothed positions share their noise. f >= 1 is what the trajectories
scatter beyond that, by their influences corrected for leverage (Bell and McCaffrey, 2002).

A constant error delta of the joints' zeros leaves the pattern K_n delta, K_n = W_n^(1/2) D_n J_n, which moves what is
stated by sum G_n^T K_n delta. The rest tells how large the offsets are, by the likelihood of `JointOffsets`; what a
mechanism has in common with the whole arm, such as a turn of the base, shows nowhere and is as large as the others, or
as was thought of the arm beforehand. Errors of the links move the frame by twists of their own, in place of J_n delta.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.mechanism import MechanismKind
from manip_learn.learning.arm_errors import AS_DESCRIBED, ArmErrors
from manip_learn.learning.descent import descend
from manip_learn.learning.mechanisms.quantities import QUANTITIES, Place, TipPaths
from manip_learn.learning.samples import STANDARD_ERRORS
from manip_learn.learning.uncertainty import JointOffsets, influences

# standard errors by which the scatter over trajectories must exceed its expectation to count. Set by hand
SCATTER_ERRORS = 1.5
# share of the mean variance of a quantity that every sample has besides: hardware does not hold to nothing
VARIANCE_FLOOR = 0.05
# share of the cases in which the truth lies within what is stated of a mechanism's place: one standard deviation of a
# normal error
STATED_SHARE_OF_PLACES = 0.683
# residuals below these are no difference: rails, tables and encoders are no better. Set by hand
LEAST_RESIDUAL = {"m": 2e-5, "rad": 4e-5}

ITERATIONS, _ROUNDS = 25, 2  # weights are those of the place where a round of steps begins
_SETTLED = 1e-6  # squared length of the last step in standard errors
ASTRAY = 10.0  # [m] a centre that far away is not coming back
UNDETERMINED = 1e-12  # curvatures below this share of the largest are none
_LEVERAGE_FLOOR = 1e-6
LONGEST = 100  # samples over which neighbours may share their noise
_DRAWS = 1000


@final
@dataclass(frozen=True, eq=False)
class Weights:
    """How residuals are weighted.

    Attributes:
        root: W_n^(1/2).
        back: W_n^(-1/2).
        twist: W_n^(1/2) D_n, the weighted residuals by the twist of the frame.
        noise: K_n = W_n^(1/2) D_n J_n, the same by the joints.
        n_residuals: How many residuals vary.
    """

    root: Float[np.ndarray, "N d d"]
    back: Float[np.ndarray, "N d d"]
    twist: Float[np.ndarray, "N d 6"]
    noise: Float[np.ndarray, "N d nv"]
    n_residuals: float

    @staticmethod
    def of(paths: TipPaths, kind: MechanismKind, place: Place) -> Weights:
        """From the slopes of the held quantities; in no direction does a sample vary by nothing."""
        held = [QUANTITIES[name] for name in kind.holds]
        D = [one.by_twist(paths, place, one.evaluate(paths, place)[1]) for one in held]
        by_twist = np.concatenate(D, axis=1)
        noise = by_twist @ paths.J
        S = noise @ noise.transpose(0, 2, 1)
        floor, column = np.zeros(S.shape[1]), 0
        for one in held:
            own = slice(column, column + one.width)
            floor[own] = VARIANCE_FLOOR * float(np.mean(np.einsum("nii->n", S[:, own, own]))) / one.rank
            column = own.stop
        # what no joint moves is exact, at any weight: the third coordinate of a planar arm
        values, vectors = np.linalg.eigh(S + np.diag(np.where(floor > UNDETERMINED * floor.max(), floor, 1.0)))
        root, back = ((vectors * scale[:, None]) @ vectors.transpose(0, 2, 1) for scale in (values**-0.5, values**0.5))
        return Weights(root, back, root @ by_twist, root @ noise, float(np.sum((root @ S) * root)))


@final
@dataclass(frozen=True, eq=False)
class PlaceFit:
    """A mechanism at a place, the constants that it holds at their best; what is stated of it, with its error.

    Attributes:
        paths: Of the hand.
        kind: What is fitted.
        place: Where.
        shared: Quantities that are the same for all trajectories, not only along each.
        weights: Of the residuals.
        slopes: M_n, for the numbers of the place and for the shared constants, shape (N, d, u).
        residuals: r_n, shape (N, d).
        constants: c of each trajectory, shape (n, d).
        leaning: Derivatives of the constants by the unknowns, shape (n, d, u).
    """

    paths: TipPaths
    kind: MechanismKind
    place: Place
    shared: tuple[str, ...]
    weights: Weights
    slopes: Float[np.ndarray, "N d u"]
    residuals: Float[np.ndarray, "N d"]
    constants: Float[np.ndarray, "n d"]
    leaning: Float[np.ndarray, "n d u"]

    @staticmethod
    def at(
        paths: TipPaths, kind: MechanismKind, place: Place, shared: tuple[str, ...], weights: Weights | None = None
    ) -> PlaceFit:
        """A place as it is; with its own weights by default."""
        weights, T = weights or Weights.of(paths, kind, place), tangents(kind, place)
        values, J = zip(*(QUANTITIES[name].evaluate(paths, place) for name in kind.holds), strict=True)
        tied, m = _is_shared(kind, shared), T.shape[1]
        n, k, d = len(paths.p), int(np.count_nonzero(tied)), len(tied)
        ones = np.broadcast_to(-np.eye(d)[:, tied], (n, d, k))
        columns = [np.concatenate(J, axis=1) @ T, ones, np.concatenate(values, axis=1)[:, :, None]]
        left, own = without_constants(paths, weights.root[:, :, ~tied], weights.root @ np.concatenate(columns, axis=2))
        slopes, residuals = left[:, :, :-1], left[:, :, -1]
        S = slopes[:, :, m:].reshape(n * d, k)
        common = -np.linalg.solve(S.T @ S, S.T @ residuals.reshape(-1))
        leaning = np.zeros((len(paths.starts), d, m + k))
        leaning[:, tied, m:], leaning[:, ~tied] = np.eye(k), own[:, :, :-1]
        constants = leaning[:, :, m:] @ common
        constants[:, ~tied] += own[:, :, -1]
        return PlaceFit(
            paths, kind, place, shared, weights, slopes, residuals + slopes[:, :, m:] @ common, constants, leaning
        )

    def moved(self, step: Float[np.ndarray, " u"]) -> PlaceFit:
        """After a step of the unknowns, with the same weights."""
        place = self.place.moved(tangents(self.kind, self.place) @ step[: self.m])
        return PlaceFit.at(self.paths, self.kind, place, self.shared, self.weights)

    def equations(self) -> tuple[Float[np.ndarray, "u u"], Float[np.ndarray, " u"]]:
        """Gauss-Newton Hessian and gradient of half the cost."""
        gradients, hessians = self.scores
        return hessians.sum(axis=0), gradients.sum(axis=0)

    @property
    def m(self) -> int:
        """Numbers of the place that are fitted."""
        return self.slopes.shape[2] - int(np.count_nonzero(_is_shared(self.kind, self.shared)))

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(np.sum(self.residuals**2))

    @property
    def variance(self) -> float:
        """sigma^2 [rad^2]."""
        n_shared, (n, d) = self.slopes.shape[2] - self.m, self.constants.shape
        n_unknowns = self.m + n_shared + n * (d - n_shared)
        return self.cost / max(self.weights.n_residuals - n_unknowns, 1.0)

    @cached_property
    def clusters(self) -> list[slice]:
        """Samples of each trajectory; of quarters of them where there are fewer than three."""
        parts = self.paths.parts
        if len(parts) >= 3:
            return parts
        edges = [np.unique(np.linspace(p.start, p.stop, 5).round().astype(int)).tolist() for p in parts]
        return [slice(a, b) for cuts in edges for a, b in zip(cuts[:-1], cuts[1:], strict=True)]

    @cached_property
    def scores(self) -> tuple[Float[np.ndarray, "g u"], Float[np.ndarray, "g u u"]]:
        """Gradient and Gauss-Newton Hessian of half the cost, of each cluster."""
        r = [self.residuals[part].reshape(-1) for part in self.clusters]
        M = [self.slopes[part].reshape(len(e), -1) for part, e in zip(self.clusters, r, strict=True)]
        return np.array([a.T @ b for a, b in zip(M, r, strict=True)]), np.array([a.T @ a for a in M])

    @cached_property
    def held_out(self) -> dict[str, Float[np.ndarray, " rank"]]:
        """Standard deviation of each held row, by quantity [m or rad], on clusters that are left out of the fit: after
        one Gauss-Newton step without each of them in turn.
        """
        gradients, H = self.scores
        total, u = H.sum(axis=0), self.slopes.shape[2]
        size = np.maximum(np.sqrt(np.diag(total)), 1e-150)  # an unknown that the data do not move stays where it is
        rest = (total - H) / np.outer(size, size) + _LEVERAGE_FLOOR * np.eye(u)
        steps = np.linalg.solve(rest, (gradients / size)[:, :, None])[:, :, 0] / size
        left = [self.residuals[c] + self.slopes[c] @ step for c, step in zip(self.clusters, steps, strict=True)]
        out, held, column = (self.weights.back @ np.concatenate(left)[:, :, None])[:, :, 0], {}, 0
        for name in self.kind.holds:
            block = out[:, column : column + QUANTITIES[name].width]
            column += block.shape[1]
            squares = np.linalg.eigvalsh(block.T @ block / len(block))[::-1][: QUANTITIES[name].rank]
            held[name] = np.sqrt(squares.clip(0.0))
        return held

    @cached_property
    def radius(self) -> Radius | None:
        """Distance from the axis or the centre; None where there is none."""
        unknowns = self.kind.unknowns
        name = "distance" if "point" in unknowns else "radius" if "point-across" in unknowns else None
        if name is None:
            return None
        own, slope = np.zeros(self.residuals.shape), np.zeros(self.slopes.shape[2])
        if name not in self.kind.holds:
            values, J = QUANTITIES[name].evaluate(self.paths, self.place)
            slope[: self.m] = J.mean(axis=(0, 1)) @ tangents(self.kind, self.place)
            return Radius(float(values.mean()), 0.0, slope, own)
        # that of the middle one of the trajectories, for a grip that slips is elsewhere
        j = names_of(self.kind).index(name)
        each, tied = self.constants[:, j], _is_shared(self.kind, self.shared)
        middle = int(np.argsort(each)[len(each) // 2])
        if not tied[j]:
            part, k = self.paths.part(middle), int(np.count_nonzero(~tied[:j]))
            root = self.weights.root[part][:, :, ~tied]
            own[part] = root @ np.linalg.inv(np.sum(root.transpose(0, 2, 1) @ root, axis=0))[:, k]
        spread = float(np.quantile(np.abs(each - each[middle]), STATED_SHARE_OF_PLACES))
        return Radius(float(each[middle]), spread, self.leaning[middle, j], own)

    @cached_property
    def influence(self) -> Float[np.ndarray, "N d w"]:
        """G_n: of the unknowns and, last, of the radius if there is one."""
        G = -self.slopes @ scaled_inverse(self.scores[1].sum(axis=0))
        if self.radius is None:
            return G
        return np.concatenate([G, (G @ self.radius.slope + self.radius.own)[:, :, None]], axis=2)

    @cached_property
    def noise(self) -> tuple[Float[np.ndarray, "w w"], float, float]:
        """C, its degrees of freedom, and by how much neighbours that are alike make a variance larger."""
        correlation = correlations(self.residuals, self.clusters)
        G = self.influence
        total = np.tensordot(G, G, axes=([0, 1], [0, 1]))
        for k, share in enumerate(correlation, start=1):
            for part in (p for p in self.clusters if p.stop - p.start > k):
                products = share * np.tensordot(G[part][:-k], G[part][k:], axes=([0, 1], [0, 1]))
                total += products + products.T
        C = self.variance * total
        # the variance of the place by the scatter over clusters over what is expected, and its degrees of freedom
        n, factor, freedom = len(self.clusters), 1.0, np.inf
        if self.m * (n - 1.0) > 0.0:
            moves = influences(*self.scores)[:, : self.m] * np.sqrt((n - 1.0) / n)
            ratio = float(np.trace(scaled_inverse(C[: self.m, : self.m]) @ moves.T @ moves)) / self.m
            seen = ratio / (1.0 + SCATTER_ERRORS * np.sqrt(2.0 / (self.m * (n - 1.0))))
            factor, freedom = (seen, self.m * (n - 1.0)) if seen > 1.0 else (1.0, np.inf)
        return factor * C, freedom, 1.0 + 2.0 * sum(correlation)

    @property
    def size(self) -> tuple[float, float] | None:
        """What bends a path, the pitch [m/rad] or the radius [m], with its standard deviation; None where nothing does.

        What offsets of the joints may have bent counts as noise, and what the clusters scatter is the least of it.
        """
        moves = [np.einsum("ndw,nd->w", self.influence[c], self.residuals[c]) for c in self.clusters]
        variances = np.maximum(np.diag(self.noise[0]), len(moves) * np.var(moves, axis=0, ddof=1))
        if "pitch" in self.kind.unknowns:
            return abs(self.place.pitch), float(np.sqrt(variances[self.m - 1]))
        return None if self.radius is None else (self.radius.value, float(np.sqrt(variances[-1])))

    def errors(
        self,
        rng: np.random.Generator,
        arm: ArmErrors = AS_DESCRIBED,
        on: PlaceFit | None = None,
        links: Float[np.ndarray, "l N 6 6"] | None = None,
    ) -> PlaceErrors:
        """Errors by noise and by the arm.

        Args:
            rng: For the draws.
            arm: What is thought of its errors beforehand.
            on: The same fit at postures that are on the mechanism, where the patterns of these errors are taken.
            links: Twists of the frame there by errors of the links, see `batch_kinematics.link_twists`.
        """
        at, tied, e = on or self, _is_shared(self.kind, self.shared), self.residuals.reshape(-1)
        by_links = [] if links is None else [arm.ratio * at.weights.twist @ twist for twist in links]
        K = np.concatenate([at.weights.noise, *by_links], axis=2)
        left, _ = without_constants(at.paths, at.weights.root[:, :, ~tied], K)
        G = at.influence[:, :, : at.slopes.shape[2]]
        left = left + G @ np.tensordot(at.slopes, left, axes=([0, 1], [0, 1]))
        response = np.tensordot(at.influence, K, axes=([0, 1], [0, 1]))
        offsets, patterns = JointOffsets.of_residual(e, left.reshape(len(e), -1), response, float(np.sum(K * K)))
        # the residuals without the pattern that offsets of the joints explain
        residuals = (e - patterns @ (patterns.T @ e)).reshape(self.residuals.shape)
        alone = dataclasses.replace(self, residuals=residuals)
        covariance, freedom, alike = alone.noise
        values, vectors = np.linalg.eigh(covariance)
        drawn = rng.standard_normal((_DRAWS, len(values))) @ (vectors * np.sqrt(values.clip(0.0))) @ vectors.T
        if np.isfinite(freedom):
            drawn /= np.sqrt(rng.chisquare(freedom, _DRAWS) / freedom)[:, None]
        offsets = dataclasses.replace(offsets, variance=alike * alone.variance, expected=arm.zeros)
        by_the_arm = offsets.draws(_DRAWS, rng)
        drawn += by_the_arm @ offsets.response.T
        numbers = drawn[:, : self.m] @ tangents(self.kind, self.place).T
        numbers[:, :3] *= np.sign(self.place.as_told().axis @ self.place.axis)
        return PlaceErrors(numbers, drawn[:, self.slopes.shape[2] :], by_the_arm)

    def stated(self, errors: PlaceErrors) -> dict[str, float]:
        """What the error of each parameter stays below in 68 % of cases: of the axis [rad], the point [m], the radius
        [m] and the pitch [m/rad], where they are fitted.
        """
        known, columns = set(self.kind.unknowns), {}
        if "axis" in known:
            columns["axis"] = errors.numbers[:, :3]
        if known & {"point", "point-across"}:
            columns["point"] = errors.numbers[:, 3:6]
        if self.radius is not None:
            columns["radius"] = errors.radius
        if "pitch" in known:
            columns["pitch"] = errors.numbers[:, 6:]
        lengths = {name: np.linalg.norm(error, axis=1) for name, error in columns.items()}
        stated = {name: float(np.quantile(length, STATED_SHARE_OF_PLACES)) for name, length in lengths.items()}
        if self.radius is not None:
            # where each trajectory has its own radius, what they differ by belongs to its error
            stated["radius"] = float(np.hypot(stated["radius"], self.radius.spread))
        return stated


@final
@dataclass(frozen=True, eq=False)
class PlaceErrors:
    """Draws of what a place is off by.

    Attributes:
        numbers: Axis, in the sense in which it is told, point and pitch, shape (k, 7).
        radius: shape (k, 1) [m]; (k, 0) where there is none.
        arm: Errors of the arm that belong to each, as those of `JointOffsets`, shape (k, e).
    """

    numbers: Float[np.ndarray, "k 7"]
    radius: Float[np.ndarray, "k r"]
    arm: Float[np.ndarray, "k e"]


@final
@dataclass(frozen=True, eq=False)
class Radius:
    """A radius, and what moves it.

    Attributes:
        value: [m].
        spread: What those of the trajectories differ by in 68 % of cases [m].
        slope: Its derivative by the unknowns, shape (u,).
        own: Its derivative by the residuals at fixed unknowns, shape (N, d).
    """

    value: float
    spread: float
    slope: Float[np.ndarray, " u"]
    own: Float[np.ndarray, "N d"]


def fit_place(
    paths: TipPaths, kind: MechanismKind, start: Place, shared: tuple[str, ...] = (), weights: Weights | None = None
) -> PlaceFit:
    """The mechanism at its most likely place: Levenberg-Marquardt, the point of an axis beside the hand.

    `shared` quantities are the same for all trajectories. The weights are those of a place near enough; by default they
    are found along with the place.
    """
    middle, place = paths.p.mean(axis=0), start
    for _ in range(_ROUNDS if weights is None else 1):
        if "point" not in kind.unknowns:
            place = Place(place.axis, place.point + ((middle - place.point) @ place.axis) * place.axis, place.pitch)
        here = descend(
            PlaceFit.at(paths, kind, place, shared, weights),
            PlaceFit.moved,
            ITERATIONS if kind.unknowns else 0,
            settled=lambda fit, step, H: bool(step @ H @ step <= _SETTLED * fit.variance),
            stop=lambda fit: bool(np.linalg.norm(fit.place.point - middle) > ASTRAY),
        )
        place = here.place
    return here


def correlations(residuals: Float[np.ndarray, "N d"], parts: Sequence[slice]) -> list[float]:
    """Of neighbours within each part, of next neighbours, and so on, up to the first that chance explains."""
    out, square = list[float](), float(np.sum(residuals**2))
    for k in range(1, LONGEST + 1):
        pairs = [(residuals[p][k:], residuals[p][:-k]) for p in parts]
        n = sum(len(a) for a, _ in pairs)
        if n < 2 * k or square <= 0.0:
            break
        share = sum(float(np.sum(a * b)) for a, b in pairs) / n * len(residuals) / square
        if share < STANDARD_ERRORS / np.sqrt(n):
            break
        out.append(share)
    return out


def alike(residuals: Float[np.ndarray, "N d"], parts: Sequence[slice]) -> float:
    """By how much neighbours that are alike make a variance larger: so many samples tell as much as one would alone."""
    return 1.0 + 2.0 * sum(correlations(residuals, parts))


def tangents(kind: MechanismKind, place: Place) -> Float[np.ndarray, "7 m"]:
    """Directions in which the seven numbers of a place may move."""
    across, whole = place.across.T, np.eye(7)
    directions = {
        "axis": whole[:, :3] @ across,
        "point-across": whole[:, 3:6] @ across,
        "point": whole[:, 3:6],
        "pitch": whole[:, 6:],
    }
    return np.concatenate([np.zeros((7, 0)), *(directions[name] for name in kind.unknowns)], axis=1)


def names_of(kind: MechanismKind) -> list[str]:
    """The quantity of each held value."""
    return [name for name in kind.holds for _ in range(QUANTITIES[name].width)]


def _is_shared(kind: MechanismKind, shared: tuple[str, ...]) -> np.ndarray:
    return np.array([name in shared for name in names_of(kind)])


def without_constants(
    paths: TipPaths, own: Float[np.ndarray, "N d o"], columns: Float[np.ndarray, "N d w"]
) -> tuple[Float[np.ndarray, "N d w"], Float[np.ndarray, "n o w"]]:
    """Columns less their best combination of those of each trajectory's own constants, and that combination."""
    sums = (np.add.reduceat(own.transpose(0, 2, 1) @ one, paths.starts, axis=0) for one in (own, columns))
    best = np.linalg.solve(*sums)
    return columns - own @ np.repeat(best, paths.counts, axis=0), best


def scaled_inverse(H: Float[np.ndarray, "w w"]) -> Float[np.ndarray, "w w"]:
    """H^+, each unknown scaled to its own."""
    size = np.sqrt(np.maximum(np.diag(H), np.finfo(np.float64).tiny))
    return np.linalg.pinv(H / np.outer(size, size), rcond=UNDETERMINED, hermitian=True) / np.outer(size, size)
