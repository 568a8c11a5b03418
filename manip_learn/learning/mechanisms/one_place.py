"""Which trajectories share the place of a mechanism: all, unless several places explain them much better.

With n independent samples the gain of more places is n / 2 log(cost of the fewer / cost of the more), less log(n) / 2
for each number more (G. Schwarz, 1978), in nats. In both, errors of the joints' zeros that are the same in all
trajectories explain what they can: an arm that is not quite its description sees one drawer run in other directions
from other postures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, combinations_with_replacement
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.mechanism import MechanismKind
from manip_learn.learning.explanation.explain import LEAST_GAIN_NATS
from manip_learn.learning.mechanisms.place_fit import (
    LEAST_RESIDUAL,
    PlaceFit,
    alike,
    fit_place,
    names_of,
    scaled_inverse,
    without_constants,
)
from manip_learn.learning.mechanisms.quantities import QUANTITIES, Place, TipPaths

# [rad] standard deviation of the zeros that may explain a difference: that of arms of hobby servos, the worst there are
WORST_ZEROS = np.radians(1.0)
_LEAST = LEAST_RESIDUAL["rad"]  # of the joints: less is no difference between places


@final
@dataclass(frozen=True, eq=False)
class Group:
    """Trajectories that share a place; their numbers, and the fit of the place to them."""

    members: tuple[int, ...]
    fit: PlaceFit

    @cached_property
    def reduced(self) -> tuple[Float[np.ndarray, "N d"], Float[np.ndarray, "m nv"]]:
        """Residuals, and what the joints' zeros do to them, without what another place and constants could take up."""
        r = self.fit.residuals.reshape(-1)
        K = without_constants(self.fit.paths, self.fit.weights.root, self.fit.weights.noise)[0].reshape(len(r), -1)
        Q = np.linalg.svd(self.fit.slopes.reshape(len(r), -1), full_matrices=False)[0]
        return (r - Q @ (Q.T @ r)).reshape(self.fit.residuals.shape), K - Q @ (Q.T @ K)

    @cached_property
    def sums(self) -> tuple[Float[np.ndarray, "nv nv"], Float[np.ndarray, " nv"], float]:
        """K^T K, K^T r and r^T r."""
        r, K = self.reduced
        return K.T @ K, K.T @ r.reshape(-1), float(np.sum(r**2))


def zeros_of(groups: Sequence[Group], variance: float) -> tuple[Float[np.ndarray, " nv"], float]:
    """The most likely errors of the joints' zeros [rad], and what they and the places leave: the cost [rad^2]."""
    KK, Kr = np.sum([g.sums[0] for g in groups], axis=0), np.sum([g.sums[1] for g in groups], axis=0)
    zeros = -np.linalg.solve(KK + variance / WORST_ZEROS**2 * np.eye(len(KK)), Kr)
    return zeros, max(sum(g.sums[2] for g in groups) + float(Kr @ zeros), 0.0)


def misfit(fit: PlaceFit) -> tuple[float, float]:
    """What a mechanism leaves of the hand's place in the same way in all trajectories, as one of another shape would.

    Returns:
        Gain of polynomials of third degree in the place, fitted to the other trajectories each time, beside errors of
        the joints' zeros, over these alone [nats]; and the share of the squared residuals that the zeros leave.
    """
    group, paths = Group((), fit), fit.paths
    scale, (r, K) = Scale.of([group]), group.reduced
    zeros, left = zeros_of([group], scale.variance)
    e, parts = (r.reshape(-1) + K @ zeros).reshape(r.shape), paths.parts
    # on the mechanism, for places as they are contain the residual that they shall foretell
    off = np.einsum("nij,nj->ni", fit.weights.back, fit.residuals)
    x = paths.p - np.einsum("nij,nj->ni", np.linalg.pinv((fit.weights.back @ fit.weights.twist)[:, :, :3], 1e-6), off)
    x -= x.mean(axis=0)
    x /= np.abs(x).max()
    powers = [np.prod(x[:, list(axes)], axis=1) for n in (2, 3) for axes in combinations_with_replacement(range(3), n)]
    held = [k for k, name in enumerate(names_of(fit.kind)) if QUANTITIES[name].unit == "m"]
    if not held:
        return 0.0, 1.0
    X = np.stack(powers, axis=1)[:, None, None, :] * fit.weights.root[:, :, held, None]
    X = without_constants(paths, fit.weights.root, X.reshape(*X.shape[:2], -1))[0]
    X = np.concatenate([X, fit.slopes, K.reshape(*r.shape, -1)], axis=2)
    products = np.stack([np.tensordot(X[p], X[p], axes=([0, 1], [0, 1])) for p in parts])
    along = np.stack([np.tensordot(X[p], e[p], axes=([0, 1], [0, 1])) for p in parts])
    foretold = np.concatenate(
        [
            e[p] - X[p] @ scaled_inverse(products.sum(axis=0) - own) @ (along.sum(axis=0) - mine)
            for p, own, mine in zip(parts, products, along, strict=True)
        ]
    )
    n, floor = scale.samples / alike(foretold, parts), scale.samples * _LEAST**2
    gain = 0.5 * n * np.log((left + floor) / (float(np.sum(foretold**2)) + floor))
    return float(gain), left / max(fit.cost, np.finfo(np.float64).tiny)


def likelier(one: PlaceFit, other: PlaceFit) -> float:
    """Gain of one kind of mechanism over another that holds as many directions [nats]."""
    scale = Scale.of([Group((), one)])
    return scale.gain([Group((), other)], [Group((), one)])


def groups_of(paths: TipPaths, kind: MechanismKind, place: Place) -> list[Group]:
    """The groups of trajectories that share a place, largest first; only one, if one place explains all as well.

    Args:
        paths: Of the hand, along all trajectories.
        kind: The mechanism.
        place: Where it is, if it is the same for all.
    """
    numbers = range(len(paths.starts))
    whole = Group(tuple(numbers), fit_place(paths, kind, place))
    if len(numbers) < 2 or not whole.fit.m:
        return [whole]
    groups = [Group((i,), PlaceFit.at(paths.chosen([i]), kind, whole.fit.place, ())) for i in numbers]
    if Scale.of(groups).gain([whole], groups) < LEAST_GAIN_NATS:  # to first order
        return [whole]
    groups = [Group(g.members, fit_place(g.fit.paths, kind, whole.fit.place)) for g in groups]
    scale, joined = Scale.of(groups), dict[tuple[int, ...], Group]()
    while len(groups) > 1:  # what falls: the number of groups
        losses = list[tuple[float, list[Group]]]()
        for one, other in combinations(groups, 2):
            members = tuple(sorted(one.members + other.members))
            if members not in joined:
                start = max(one, other, key=lambda g: len(g.members)).fit.place
                joined[members] = Group(members, fit_place(paths.chosen(members), kind, start))
            fewer = [*(g for g in groups if g not in (one, other)), joined[members]]
            losses.append((scale.gain(fewer, groups), fewer))
        loss, fewer = min(losses, key=lambda x: x[0])
        if loss >= LEAST_GAIN_NATS:
            break
        groups = fewer
    return sorted(groups, key=lambda g: -len(g.members))


@final
@dataclass(frozen=True)
class Scale:
    """By what differences of cost count: independent samples, and the variance of a residual [rad^2]."""

    independent: float
    samples: float
    variance: float

    @staticmethod
    def of(each: Sequence[Group]) -> Scale:
        """As it is beside a place of their own."""
        samples = sum(g.fit.weights.n_residuals - g.fit.constants.size for g in each)
        variance = sum(g.sums[2] for g in each) / samples + _LEAST**2
        zeros, cost = zeros_of(each, variance)
        left, parts, start = [], [], 0
        for g in each:
            r, K = g.reduced
            left.append(r + (K @ zeros).reshape(r.shape))
            parts.append(slice(start, start := start + len(r)))
        return Scale(samples / alike(np.concatenate(left), parts), samples, cost / samples + _LEAST**2)

    def gain(self, fewer: Sequence[Group], more: Sequence[Group]) -> float:
        """Of more places over fewer [nats]."""
        costs = [zeros_of(groups, self.variance)[1] + self.samples * _LEAST**2 for groups in (fewer, more)]
        numbers = sum(g.fit.m for g in more) - sum(g.fit.m for g in fewer)
        return 0.5 * self.independent * np.log(costs[0] / costs[1]) - 0.5 * numbers * np.log(max(self.independent, 2.0))


def at_one_place(one: PlaceFit | None, other: PlaceFit | None) -> bool:
    """Whether one place of a mechanism explains the trajectories of two as well; not where there is no fit."""
    if one is None or other is None or one.kind is not other.kind or not one.m:
        return False
    paths = one.paths.beside(other.paths)
    n, numbers = len(one.paths.starts), tuple(range(len(paths.starts)))
    groups = [Group(numbers[:n], fit_place(one.paths, one.kind, one.place))]
    groups.append(Group(numbers[n:], fit_place(other.paths, one.kind, other.place)))
    joined = Group(numbers, fit_place(paths, one.kind, one.place))
    return Scale.of(groups).gain([joined], groups) < LEAST_GAIN_NATS


def how_far_apart(groups: Sequence[Group]) -> str:
    """By how much the places of groups differ at most, in words."""
    places, unknowns, said = [g.fit.place for g in groups], groups[0].fit.kind.unknowns, []
    pairs = list(combinations(places, 2))
    if "axis" in unknowns:
        turned = max(np.arctan2(np.linalg.norm(np.cross(a.axis, b.axis)), abs(a.axis @ b.axis)) for a, b in pairs)
        said.append(f"{np.degrees(turned):.1f} deg")
    if "point" in unknowns or "point-across" in unknowns:
        away = [(a.point - b.point, a.axis if "axis" in unknowns else np.zeros(3)) for a, b in pairs]
        said.append(f"{1e3 * max(np.linalg.norm(d - (d @ axis) * axis) for d, axis in away):.0f} mm")
    return " and ".join(said)
