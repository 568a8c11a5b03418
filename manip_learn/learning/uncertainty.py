"""Uncertainty of a fit: groups of recordings that share a place, misfit, and errors of the rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement

import numpy as np

from manip_learn.learning.fit import LEAST_RAD, RowFit, autocorrelation, solve
from manip_learn.learning.table import LEAST_GAIN, LEAST_MOTION, ArmErrors
from manip_learn.linalg import complement_rows, row_space_angles
from manip_learn.recordings.trajectory import evenly

DRAWS = 1000  # of an error: a quantile of 68 % to 3 %
STATED = 0.68  # share of cases within what is stated
TAU = np.append(0.0, np.geomspace(1e-6, 3e-2, 60))  # [rad] zeros to be thought of beyond what is thought beforehand
NONE_TO_SOME = 20.0  # odds of no such zeros


# --------------------------------------------------------------------------------- which recordings share a place


def groups_of(fit: RowFit) -> list[set[int]]:
    """Return the groups of recordings that share Lambda, largest first: one unless several explain much more.

    Joint offsets explain what they can in both cases: with them one drawer seems to run in other directions from other
    postures. To first order in B.
    """
    m, recs = fit.m, sorted(set(fit.motion.recs))
    away = [np.sqrt(np.mean(np.sum(fit.r[p] ** 2, axis=1))) for p in fit.motion.parts]
    if len(recs) < 2 or not m or max(away) < 0.5 * LEAST_MOTION:
        return [set(recs)]
    few = [recs[i] for i in evenly(len(recs), 16)]
    ridge = 1e-9 * np.diag(np.diag(np.sum([*fit.G.values()], axis=0)[:m, :m]))

    def reduced(members: Sequence[int]) -> np.ndarray:
        """Return [K r]^T [K r] with B eliminated."""
        total = np.sum([fit.G[i] for i in members], axis=0)
        return total[m:, m:] - total[m:, :m] @ np.linalg.solve(total[:m, :m] + ridge, total[:m, m:])

    groups: dict[tuple[int, ...], np.ndarray] = {(i,): reduced([i]) for i in few}
    dof = max(fit.dof * len(few) / len(recs) - m * (len(few) - 1), 1.0)
    variance = sum(x[-1, -1] for x in groups.values()) / dof + LEAST_RAD**2
    r = fit.r.copy()  # with B of its own for each of the few
    for p, i in zip(fit.motion.parts, fit.motion.recs, strict=True):
        if i in few:
            r[p] -= fit.X[p][:, :, :m] @ solve(fit.G[i][:m, :m], fit.G[i][:m, -1])
    n = dof / autocorrelation(r, fit.motion.parts)

    def nats(groups: dict[tuple[int, ...], np.ndarray]) -> float:
        """Return the evidence of groups with joint offsets eliminated, net of their price [nats]."""
        S = np.sum([*groups.values()], axis=0)
        K = S[:-1, :-1] + variance / TAU[-1] ** 2 * np.eye(len(S) - 1)
        cost = max(float(S[-1, -1] - S[-1, :-1] @ np.linalg.solve(K, S[:-1, -1])), 0.0) + dof * LEAST_RAD**2
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
    for i in set(recs) - set(few):  # the others join the group that they fit best
        losses = [reduced([*g, i])[-1, -1] - reduced(list(g))[-1, -1] for g in out]
        out[int(np.argmin(losses))].add(i)
    return out


def misfit(fit: RowFit) -> tuple[float, float]:
    """Return the evidence for another shape, and the RMS residual along the rows [m or rad].

    The evidence is the gain of cubics in the position of the hand that are fitted to the other recordings, over joint
    offsets alone [nats]: a residual that repeats in all recordings.
    """
    motion, off = fit.motion, np.linalg.solve(fit.root, fit.r[:, :, None])
    left = float(np.sqrt(np.mean(np.sum(off**2, axis=(1, 2)))))
    if motion.place is None or len(set(motion.recs)) < 3 or not fit.m:
        return 0.0, left
    x = motion.place - motion.place.mean(axis=0)
    factors = [[*axes] for n in (2, 3) for axes in combinations_with_replacement(range(3), n)]
    powers = np.stack([np.prod(x[:, axes], axis=1) for axes in factors], axis=1)
    P = np.einsum("nai,nc->naic", fit.root, powers).reshape(*fit.r.shape, -1)
    X = np.concatenate([fit.X[:, :, :-1], fit.without_constants(P), fit.X[:, :, -1:]], axis=2)
    G, plain = fit.sums(X), fit.X.shape[2] - 1
    total, prior, costs = np.sum([*G.values()], axis=0), np.zeros(X.shape[2] - 1), np.full(2, fit.dof * LEAST_RAD**2)
    prior[fit.m : plain] = fit.variance / TAU[-1] ** 2
    for mine in G.values():
        rest = total - mine
        for i, d in enumerate((plain, len(prior))):
            b = np.append(-solve(rest[:d, :d] + np.diag(prior[:d]), rest[:d, -1]), 1.0)
            columns = [*range(d), -1]
            costs[i] += b @ mine[np.ix_(columns, columns)] @ b
    return 0.5 * fit.dof / fit.alike * float(np.log(costs[0] / costs[1])), left


# ------------------------------------------------------------------------------------------------------ uncertainty


@dataclass(frozen=True, eq=False)
class Errors:
    """Draws of the error of B.

    Attributes:
        noise, arm: shape (k, m), parts caused by noise and by errors of the arm.
        delta: shape (k, e), errors of the arm of each draw.
    """

    noise: np.ndarray
    arm: np.ndarray
    delta: np.ndarray
    beyond: float = 0.0  # [rad] of the joints' zeros that explain far more than what was thought of the arm


def errors_of(fit: RowFit, arm: ArmErrors, rng: np.random.Generator) -> Errors | None:
    """Draw errors of the rows of a fit; None with a single recording, or if only one row space is possible."""
    m, n = fit.m, len(set(fit.motion.recs))
    if not m or n < 2:
        return None
    total, variance = np.sum([*fit.G.values()], axis=0), fit.cost / fit.dof * fit.alike + 1e-30
    H = total[:m, :m]
    C = variance * solve(H, np.eye(m))
    # what the recordings scatter beyond that: their influences, corrected for the leverage of each
    white = np.linalg.cholesky(np.linalg.inv(0.5 * (C + C.T) + (1e-14 * np.trace(C) / m + 1e-300) * np.eye(m)))
    moves = [white.T @ solve(1.001 * H - own[:m, :m], own[:m, -1]) for own in fit.G.values()]
    ratio, freedom = (1.0 - 1.0 / n) * float(np.sum(np.square(moves))) / m, max(m * (n - 1.0), 2.0)
    values, vectors = np.linalg.eigh(C)
    noise = rng.standard_normal((DRAWS, m)) @ ((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
    if ratio > 1.0 + 1.5 * np.sqrt(2.0 / freedom):
        noise *= np.sqrt(ratio * freedom / rng.chisquare(freedom, DRAWS))[:, None]
    # the arm: delta ~ N(0, (z^2 + tau^2)), its pattern and the residual less what B takes up
    variance += LEAST_RAD**2
    response = -solve(H, total[:m, m:])
    S = total[m:, m:] + total[m:, :m] @ response
    lam, V = np.linalg.eigh(S[:-1, :-1])
    lam, hv = np.maximum(lam, 0.0), V.T @ S[:-1, -1]
    seen = lam > 1e-8 * max(lam.max(), 1e-300)
    sizes = arm.zeros**2 + TAU**2
    # log-likelihood of each size of joint offsets beyond their prior, none first
    v = lam[seen] * (variance + lam[seen] * sizes[:, None]) + 1e-300
    likelihood = -0.5 * np.sum(np.log(v) + hv[seen] ** 2 / v, axis=1)
    weight = np.exp(likelihood - likelihood.max())
    weight[0] *= NONE_TO_SOME * (len(TAU) - 1)
    prior = sizes[rng.choice(len(TAU), DRAWS, p=weight / weight.sum()), None]
    posterior = np.divide(1.0, lam / variance + 1.0 / np.maximum(prior, 1e-300))
    mean = -posterior * np.where(seen, hv / variance, 0.0)
    delta = (mean + np.sqrt(posterior) * (rng.standard_normal(posterior.shape) @ V)) @ V.T
    likeliest = int(np.argmax(likelihood))
    far = TAU[likeliest] > 3.0 * arm.zeros and likelihood[likeliest] - likelihood[0] > LEAST_GAIN
    return Errors(noise, delta @ response[:, :-1].T, delta, float(TAU[likeliest]) if far else 0.0)


def angles(rows: np.ndarray, W: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the angle of each of Lambda + B Lambda_perp to Lambda, in the rows of the features [rad]."""
    return row_space_angles((rows + B.reshape(len(B), len(rows), -1) @ complement_rows(rows)) @ W, rows @ W)
