"""Uncertainty of a fit: groups of recordings that share a place, misfit, and errors of the rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement

import numpy as np

from manip_learn.learning.fit import LEAST_RAD, RowFit, autocorrelation, solve
from manip_learn.learning.search import LEAST_GAIN
from manip_learn.learning.table import ArmErrors
from manip_learn.linalg import complement_rows, row_space_angles
from manip_learn.recordings.trajectory import evenly

ONE_PLACE = 4.5e-4  # [rad] RMS by which recordings of one place differ: half a millimetre
WORST_ZEROS = np.radians(1.0)  # [rad] of arms of hobby servos: what may explain a difference between recordings
DRAWS = 1000  # of an error: a quantile of 68 % to 3 %
STATED = 0.68  # share of cases within what is stated
TAU = np.geomspace(1e-6, 3e-2, 60)  # [rad] zeros to be thought of beyond what is thought beforehand
NONE_TO_SOME = 20.0  # odds of no such zeros


# --------------------------------------------------------------------------------- which recordings share a place


def groups_of(fit: RowFit) -> list[set[int]]:
    """Return the groups of recordings that share Lambda, largest first: one unless several explain much more.

    Joint offsets explain what they can in both cases: with them one drawer seems to run in other directions from other
    postures. To first order in B.
    """
    m, e, recs = fit.m, fit.e, sorted(set(fit.motion.recs))
    away = [np.sqrt(np.mean(np.sum(fit.r[p] ** 2, axis=1))) for p in fit.motion.parts]
    if len(recs) < 2 or not m or max(away) < ONE_PLACE:
        return [set(recs)]
    own = fit.G
    few = recs if len(recs) <= 16 else [recs[i] for i in evenly(len(recs), 16)]
    ridge = 1e-9 * np.diag(np.diag(np.sum([*own.values()], axis=0)[:m, :m]))

    def reduced(members: Sequence[int]) -> np.ndarray:
        """Return [K r]^T [K r] with B eliminated."""
        total = np.sum([own[i] for i in members], axis=0)
        J = total[:m, :m] + ridge
        return total[m:, m:] - total[m:, :m] @ np.linalg.solve(J, total[:m, m:])

    def cost(parts: Sequence[np.ndarray], variance: float) -> float:
        """Return the sum of squares of groups, with joint offsets eliminated."""
        S = np.sum(parts, axis=0)
        prior = np.full(e, variance / WORST_ZEROS**2)
        return max(float(S[-1, -1] - S[-1, :-1] @ np.linalg.solve(S[:-1, :-1] + np.diag(prior), S[:-1, -1])), 0.0)

    each = {(i,): reduced([i]) for i in few}
    dof = max(fit.dof * len(few) / len(recs) - m * (len(few) - 1), 1.0)
    variance = sum(x[-1, -1] for x in each.values()) / dof + LEAST_RAD**2
    floor, n = dof * LEAST_RAD**2, dof / local_alike(fit, few)

    def gain(fewer: dict, more: dict) -> float:
        """Return the gain of more groups, net of their price [nats]."""
        a, b = cost(list(fewer.values()), variance) + floor, cost(list(more.values()), variance) + floor
        return 0.5 * n * float(np.log(a / b)) - 0.5 * m * (len(more) - len(fewer)) * float(np.log(max(n, 2.0)))

    whole = {tuple(few): reduced(few)}
    if gain(whole, each) < LEAST_GAIN:
        return [set(recs)]
    groups = dict(each)
    while len(groups) > 1:
        options = []
        for a, b in combinations(groups, 2):
            fewer = {k: v for k, v in groups.items() if k not in (a, b)} | {tuple(sorted(a + b)): reduced(a + b)}
            options.append((gain(fewer, groups), fewer))
        loss, fewer = min(options, key=lambda x: x[0])
        if loss >= LEAST_GAIN:
            break
        groups = fewer
    out = sorted((set(g) for g in groups), key=len, reverse=True)
    for i in set(recs) - set(few):  # the others join the group that they fit best
        losses = [reduced([*g, i])[-1, -1] - reduced(list(g))[-1, -1] for g in out]
        out[int(np.argmin(losses))].add(i)
    return out


def local_alike(fit: RowFit, few: Sequence[int]) -> float:
    """Return the autocorrelation of the residual with B of its own for each of a few recordings."""
    r, m = fit.r.copy(), fit.m
    for p, i in zip(fit.motion.parts, fit.motion.recs, strict=True):
        if i in few:
            G = fit.G[i]
            r[p] = r[p] - fit.X[p][:, :, :m] @ solve(G[:m, :m], G[:m, -1])
    return autocorrelation(r, fit.motion.parts)


def misfit(fit: RowFit) -> tuple[float, float]:
    """Return the evidence for another shape, and the RMS residual along the rows [m or rad].

    The evidence is the gain of cubics in the position of the hand that are fitted to the other recordings, over joint
    offsets alone [nats]: a residual that repeats in all recordings.
    """
    motion = fit.motion
    back = np.linalg.inv(fit.root)
    left = float(np.sqrt(np.mean(np.sum(np.einsum("nij,nj->ni", back, fit.r) ** 2, axis=1))))
    if motion.place is None or len(set(motion.recs)) < 3 or not fit.m:
        return 0.0, left
    x = motion.place - motion.place.mean(axis=0)
    x = x / np.abs(x).max()
    powers = np.stack(
        [np.prod(x[:, list(a)], axis=1) for n in (2, 3) for a in combinations_with_replacement(range(3), n)], axis=1
    )
    P = np.einsum("nai,nc->naic", fit.root, powers).reshape(*fit.r.shape, -1)
    X = np.concatenate([fit.X[:, :, :-1], fit.without_constants(P), fit.X[:, :, -1:]], axis=2)
    G, d = fit.sums(X), fit.m + fit.e
    total, prior = np.sum([*G.values()], axis=0), np.zeros(X.shape[2] - 1)
    prior[fit.m : d] = fit.variance / WORST_ZEROS**2
    plain = foretold = 0.0
    for mine in G.values():
        rest = total - mine
        for columns in (slice(0, d), slice(0, None)):
            own = np.arange(X.shape[2] - 1)[columns]
            b = -solve(rest[np.ix_(own, own)] + np.diag(prior[own]), rest[own, -1])
            c = float(mine[-1, -1] + 2.0 * b @ mine[own, -1] + b @ mine[np.ix_(own, own)] @ b)
            plain, foretold = (plain + c, foretold) if columns.stop == d else (plain, foretold + c)
    floor = fit.dof * LEAST_RAD**2
    return 0.5 * fit.dof / fit.alike * float(np.log((plain + floor) / (foretold + floor))), left


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

    @property
    def both(self) -> np.ndarray:
        """Sum of both parts, shape (k, m)."""
        return self.noise + self.arm


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
    moves = []
    for own in fit.G.values():
        rest = H - own[:m, :m] + 1e-3 * H
        moves.append(white.T @ solve(rest, own[:m, -1]) * np.sqrt(1.0 - 1.0 / n))
    ratio, freedom = float(np.sum(np.square(moves))) / m, max(m * (n - 1.0), 2.0)
    factor, freedom = (ratio, freedom) if ratio > 1.0 + 1.5 * np.sqrt(2.0 / freedom) else (1.0, np.inf)
    values, vectors = np.linalg.eigh(factor * C)
    noise = rng.standard_normal((DRAWS, m)) @ ((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
    if np.isfinite(freedom):
        noise /= np.sqrt(rng.chisquare(freedom, DRAWS) / freedom)[:, None]
    # the arm: delta ~ N(0, (z^2 + tau^2)), its pattern in the residual less what B takes up, S and h
    variance += LEAST_RAD**2
    response = -solve(H, total[:m, m:-1])
    S = total[m:-1, m:-1] + total[m:-1, :m] @ response
    h = total[m:-1, -1] - total[m:-1, :m] @ solve(H, total[:m, -1])
    lam, V = np.linalg.eigh(S)
    lam, hv = np.maximum(lam, 0.0), V.T @ h
    seen = lam > 1e-8 * max(lam.max(), 1e-300)
    z2 = arm.zeros**2

    def log_likelihood(tau: float) -> float:
        """Return the log-likelihood of joint offsets beyond their prior [rad]."""
        v = lam[seen] * variance + lam[seen] ** 2 * (z2 + tau**2) + 1e-300
        return -0.5 * float(np.sum(np.log(v) + hv[seen] ** 2 / v))

    base = np.array([log_likelihood(t) for t in (0.0, *TAU)])
    weight = np.exp(base - base.max())
    weight[0] *= NONE_TO_SOME * len(TAU)
    tau = np.array([0.0, *TAU])[rng.choice(len(weight), DRAWS, p=weight / weight.sum())]
    prior = z2 + tau[:, None] ** 2
    posterior = np.divide(1.0, lam / variance + 1.0 / np.maximum(prior, 1e-300))
    mean = -posterior * np.where(seen, hv / variance, 0.0)
    delta = (mean + np.sqrt(posterior) * (rng.standard_normal(posterior.shape) @ V)) @ V.T
    likeliest = int(np.argmax(base))
    far = likeliest > 0 and TAU[likeliest - 1] > 3.0 * arm.zeros and base[likeliest] - base[0] > LEAST_GAIN
    return Errors(noise, delta @ response.T, delta, float(TAU[likeliest - 1]) if far else 0.0)


def angles(rows: np.ndarray, W: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the angle of each of Lambda + B Lambda_perp to Lambda, in the rows of the features [rad]."""
    perp = complement_rows(rows)
    return row_space_angles((rows + B.reshape(len(B), len(rows), -1) @ perp) @ W, rows @ W)
