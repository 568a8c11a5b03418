"""One mechanism fitted to paths of the hand: Gauss-Newton from a closed-form start, held-out residuals, uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.mechanism_kinds import MechanismKind
from manip_learn.learning.deciding import SMALLEST_RESIDUAL
from manip_learn.learning.mechanisms.residuals import QUANTITIES, Place
from manip_learn.learning.mechanisms.tip_paths import TipPaths

ITERATIONS = 25
FIRST_ITERATIONS = 4  # of each start, before the best goes on
TOLERANCE = 1e-6  # relative change of the cost
ASTRAY = 10.0  # [m] a centre that far away is not coming back
LEVERAGE_FLOOR = 1e-6


@final
@dataclass(frozen=True, eq=False)
class Fit:
    """A candidate at its best place.

    Attributes:
        candidate: What was fitted.
        place: Where.
        shared: Quantities that are the same for all trajectories, not only along each.
        held_out: Standard deviation of each held row on trajectories left out of the fit, by quantity [m or rad].
        steps: shape (g, m), how the unknowns move when each trajectory is left out.
        covariance: shape (m, m), of the unknowns.
        tangents: shape (7, m), the unknowns in axis, point and pitch.
    """

    candidate: MechanismKind
    place: Place
    shared: tuple[str, ...]
    held_out: dict[str, Float[np.ndarray, " rank"]]
    cost: float
    covariance: Float[np.ndarray, "m m"]
    tangents: Float[np.ndarray, "7 m"]


def tangents(candidate: MechanismKind, place: Place) -> Float[np.ndarray, "7 m"]:
    """Directions in which the seven numbers of a place may move."""
    columns, base = [], place.across
    for name in candidate.unknowns:
        block = np.zeros((7, {"axis": 2, "point-across": 2, "point": 3, "pitch": 1}[name]))
        if name == "axis":
            block[:3] = base.T
        elif name == "point-across":
            block[3:6] = base.T
        elif name == "point":
            block[3:6] = np.eye(3)
        else:
            block[6] = 1.0
        columns.append(block)
    return np.concatenate(columns, axis=1) if columns else np.zeros((7, 0))


def _stacked(
    paths: TipPaths, candidate: MechanismKind, place: Place, shared: tuple[str, ...], scale: dict[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted residuals (N, d) and derivatives (N, d, m)."""
    T, values, slopes = tangents(candidate, place), [], []
    for name in candidate.holds:
        value, J = QUANTITIES[name].evaluate(paths, place)
        d = value.shape[1]
        J = (J.reshape(-1, 7) @ T).reshape(len(J), -1)
        both = paths.centred(np.concatenate([value, J], axis=1), name in shared) / scale[name]
        values.append(both[:, :d])
        slopes.append(both[:, d:].reshape(len(J), d, T.shape[1]))
    return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)


def _gauss_newton(
    paths: TipPaths,
    candidate: MechanismKind,
    place: Place,
    shared: tuple[str, ...],
    scale: dict[str, float],
    iterations: int = ITERATIONS,
) -> tuple[Place, float]:
    """Levenberg-Marquardt on the weighted residuals; the place is moved so that the point stays next to the hand."""
    damping, cost = 1e-6, np.inf
    place = _next_to_hand(paths, candidate, place)
    r, J = _stacked(paths, candidate, place, shared, scale)
    cost = float(np.sum(r * r))
    if not candidate.unknowns:
        return place, cost
    middle = paths.p.mean(axis=0)
    for _ in range(iterations):
        flat = J.reshape(-1, J.shape[2])
        H, g = flat.T @ flat, flat.T @ r.reshape(-1)
        better = False
        while damping < 1e8 and not better:
            step = -np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-12 * np.trace(H) + 1e-300), g)
            there = place.moved(tangents(candidate, place) @ step)
            r_new, J_new = _stacked(paths, candidate, there, shared, scale)
            cost_new = float(np.sum(r_new * r_new))
            better = cost_new <= cost
            damping = damping * 0.1 if better else max(damping, 1e-9) * 10.0
        if not better:
            break
        gained = cost - cost_new
        place, r, J, cost = there, r_new, J_new, cost_new
        if gained <= TOLERANCE * cost or np.linalg.norm(place.point - middle) > ASTRAY:
            break
    return _next_to_hand(paths, candidate, place), cost


def _next_to_hand(paths: TipPaths, candidate: MechanismKind, place: Place) -> Place:
    if "point" in candidate.unknowns:
        return place
    along = float((paths.p.mean(axis=0) - place.point) @ place.axis)
    return Place(place.axis, place.point + along * place.axis, place.pitch)


def fit_candidate(paths: TipPaths, candidate: MechanismKind, starts: list[Place], shared: tuple[str, ...] = ()) -> Fit:
    """The candidate at its best place; weights of metres against radians are found from the residuals themselves."""
    scale = {name: 1e-3 if QUANTITIES[name].unit == "m" else 2e-3 for name in candidate.holds}
    tried = [_gauss_newton(paths, candidate, start, shared, scale, FIRST_ITERATIONS) for start in starts]
    place, cost = min(tried, key=lambda t: t[1])
    if len({QUANTITIES[name].unit for name in candidate.holds}) > 1:
        scale = _weights(paths, candidate, place, shared)
    place, cost = _gauss_newton(paths, candidate, place, shared, scale)
    return _judged(paths, candidate, place, shared, scale, cost)


def _weights(paths: TipPaths, candidate: MechanismKind, place: Place, shared: tuple[str, ...]) -> dict[str, float]:
    """Size of the residuals by unit: one for all in metres (one each would reward a tilt that hides noise in one)."""
    squares: dict[str, list[float]] = {}
    for name in candidate.holds:
        value = paths.centred(QUANTITIES[name].evaluate(paths, place)[0], name in shared)
        squares.setdefault(QUANTITIES[name].unit, []).append(float(np.sum(value**2) / value.size))
    return {
        name: float(np.sqrt(np.mean(squares[QUANTITIES[name].unit]) + SMALLEST_RESIDUAL[QUANTITIES[name].unit] ** 2))
        for name in candidate.holds
    }


def _judged(
    paths: TipPaths,
    candidate: MechanismKind,
    place: Place,
    shared: tuple[str, ...],
    scale: dict[str, float],
    cost: float,
) -> Fit:
    """Held-out residuals and the covariance, from one Gauss-Newton step without each trajectory in turn."""
    r, J = _stacked(paths, candidate, place, shared, scale)
    m, n = J.shape[2], len(paths.starts)
    groups = clusters(paths)
    edges = [g.start for g in groups]
    H = np.add.reduceat(np.einsum("ndi,ndj->nij", J, J), edges, axis=0)
    g = np.add.reduceat(np.einsum("ndi,nd->ni", J, r), edges, axis=0)
    total = H.sum(axis=0)
    size = np.maximum(np.sqrt(np.diag(total)), 1e-150)  # an unknown that the data do not move stays where it is
    rest = (total - H) / np.outer(size, size) + LEVERAGE_FLOOR * np.eye(m)
    steps = np.linalg.solve(rest, (g / size)[:, :, None])[:, :, 0] / size if m else np.zeros((len(groups), 0))
    out = np.array(r)
    for part, step in zip(groups, steps, strict=True):
        out[part] += J[part] @ step
    held, column = {}, 0
    for name in candidate.holds:
        d = QUANTITIES[name].width
        block = out[:, column : column + d] * scale[name]
        column += d
        held[name] = np.sqrt(np.linalg.eigvalsh(block.T @ block / len(block))[::-1][: QUANTITIES[name].rank].clip(0.0))
    free = max(r.size - m - n * r.shape[1], 1)
    white = np.linalg.pinv(total, hermitian=True) * cost / free if m else np.zeros((0, 0))
    k = len(groups)
    spread = steps - steps.mean(axis=0)
    jackknife = (k - 1.0) / k * spread.T @ spread
    ratio = np.sqrt(np.maximum(np.diag(jackknife) / np.maximum(np.diag(white), 1e-300), 1.0)) if m else np.ones(0)
    return Fit(candidate, place, shared, held, cost, white * np.outer(ratio, ratio), tangents(candidate, place))


def clusters(paths: TipPaths) -> list[slice]:
    """Trajectories; quarters of them where there are fewer than three."""
    parts = [paths.part(i) for i in range(len(paths.starts))]
    if len(parts) >= 3:
        return parts
    cut = []
    for p in parts:
        edges = np.unique(np.linspace(p.start, p.stop, 5).round().astype(int))
        cut += [slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    return cut
