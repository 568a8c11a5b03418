"""Closed-form guesses of where a mechanism is: eigenvectors and linear least squares, trajectory means taken out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.place_fields import across
from manip_learn.learning.mechanisms.residuals import Place, turn_about
from manip_learn.learning.mechanisms.tip_paths import TipPaths

TRIED = 4  # directions that are refined
ROWS_A_TRAJECTORY = 24  # that the search over directions looks at
Starts = Callable[[TipPaths], list[Place]]


def directions(n: int = 80) -> Float[np.ndarray, "n 3"]:
    """Unit vectors evenly over a hemisphere (Fibonacci's spiral)."""
    k = np.arange(n) + 0.5
    z, turn = k / n, np.pi * (1.0 + np.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def spread(paths: TipPaths, shared: bool = False) -> Float[np.ndarray, "3 3"]:
    """Eigenvectors of the covariance of the positions, as rows, the direction of least motion first."""
    x = paths.centred(paths.p, shared)
    return np.linalg.eigh(x.T @ x)[1].T


def line_starts(paths: TipPaths) -> list[Place]:
    """The direction of most motion."""
    return [Place(spread(paths)[2], paths.p.mean(axis=0))]


def plane_starts(paths: TipPaths) -> list[Place]:
    """The direction of least motion, within trajectories and over all."""
    return [Place(spread(paths, shared)[0], paths.p.mean(axis=0)) for shared in (False, True)]


def axis_in_hand(paths: TipPaths) -> Float[np.ndarray, " 3"]:
    """The direction whose image in the hand changes least: least eigenvector of sum (R - mean R) (R - mean R)^T."""
    flat = paths.centred(paths.R.reshape(-1, 9)).reshape(-1, 3, 3)
    return np.linalg.eigh(np.einsum("nij,nkj->ik", flat, flat))[1][:, 0]


def direction_starts(paths: TipPaths) -> list[Place]:
    """The axis that the hand turns about."""
    return [Place(axis_in_hand(paths), paths.p.mean(axis=0))]


def circles(
    paths: TipPaths, axes: Float[np.ndarray, "k 3"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Centres of the circles seen along each axis, and how badly they fit.

    |y|^2 - 2 c.y is constant along a circle: a linear problem (I. Kasa, 1976) once trajectory means are taken out.
    The misfit is that of the radius [m].
    """
    middle = paths.p.mean(axis=0)
    bases = np.stack([across(a) for a in axes])
    y = np.einsum("kbi,ni->nkb", bases, paths.p - middle)
    n = len(y)
    s = paths.centred(np.einsum("nkb,nkb->nk", y, y))
    flat = paths.centred(y.reshape(n, -1)).reshape(y.shape)
    G = np.einsum("nkb,nkc->kbc", flat, flat)
    ridge = 1e-9 * np.trace(G, axis1=1, axis2=2)[:, None, None] * np.eye(2)
    c = 0.5 * np.linalg.solve(G + ridge, np.einsum("nkb,nk->kb", flat, s)[:, :, None])[:, :, 0]
    rho = np.linalg.norm(y - c, axis=2)
    return middle + np.einsum("kb,kbi->ki", c, bases), np.sqrt(np.mean(paths.centred(rho) ** 2, axis=0))


def _thinned(paths: TipPaths) -> TipPaths:
    rows = [
        np.unique(np.linspace(p.start, p.stop - 1, ROWS_A_TRAJECTORY).round().astype(int))
        for p in (paths.part(i) for i in range(len(paths.starts)))
    ]
    starts = np.cumsum([0, *(len(r) for r in rows[:-1])])
    chosen = np.concatenate(rows)
    return TipPaths(paths.p[chosen], paths.R[chosen], starts)


def circle_starts(paths: TipPaths) -> list[Place]:
    """Normal of the plane of motion, within trajectories and over all, and the circle seen along it."""
    axes = np.stack([spread(paths, False)[0], spread(paths, True)[0], spread(paths)[1]])
    centres, _ = circles(paths, axes)
    return [Place(a, c) for a, c in zip(axes, centres, strict=True)]


def cylinder_starts(paths: TipPaths) -> list[Place]:
    """The best of many directions by the circles seen along them, and those of the spread of positions."""
    few = _thinned(paths)
    axes = np.concatenate([directions(), spread(paths)])
    centres, misfit = circles(few, axes)
    return [Place(axes[i], centres[i]) for i in np.argsort(misfit)[:TRIED]]


def screw_starts(paths: TipPaths) -> list[Place]:
    """The best of many directions by the circles seen along them together with the thread."""
    few = _thinned(paths)
    axes = np.concatenate([directions(), spread(paths), spread(paths, True)])
    centres, misfit = circles(few, axes)
    bases = np.stack([across(a) for a in axes])
    # one column for each direction
    y = np.einsum("kbi,nki->nkb", bases, few.p[:, None] - centres)
    phi = few.centred(few.unwrapped(np.arctan2(y[:, :, 1], y[:, :, 0])))
    z = few.centred(few.p @ axes.T)
    pitch = np.sum(phi * z, axis=0) / np.maximum(np.sum(phi * phi, axis=0), 1e-12)
    cost = misfit**2 + np.mean((z - pitch * phi) ** 2, axis=0)
    return [Place(axes[i], centres[i], float(pitch[i])) for i in np.argsort(cost)[:TRIED]]


def ball_starts(paths: TipPaths) -> list[Place]:
    """|p|^2 - 2 c.p is constant on a sphere: a linear problem, with one radius a trajectory or one for all."""
    middle = paths.p.mean(axis=0)
    places = []
    for shared in (False, True):
        x = paths.p - middle
        s = paths.centred(np.einsum("ni,ni->n", x, x)[:, None], shared)[:, 0]
        c = 0.5 * np.linalg.lstsq(paths.centred(x, shared), s, rcond=1e-9)[0]
        places.append(Place(np.array([0.0, 0.0, 1.0]), middle + c))
    return places


def carried_starts(paths: TipPaths, axis: Float[np.ndarray, " 3"] | None = None, pitched: bool = False) -> list[Place]:
    """The point of the axis that keeps its place in the hand, and the pitch: linear least squares.

    R^T (c + h psi a - p) is constant, psi the angle that the hand has turned about a (G. Chasles: every displacement
    is a screw).
    """
    middle = paths.p.mean(axis=0)
    R_T = paths.R.transpose(0, 2, 1)
    unknown = R_T
    if axis is not None:
        unknown = R_T @ across(axis).T
        if pitched:
            along = turn_about(paths, axis)[:, None, None] * (R_T @ axis)[:, :, None]
            unknown = np.concatenate([unknown, along], axis=2)
    n, _, k = unknown.shape
    matrix = paths.centred(unknown.reshape(n, -1)).reshape(-1, k)
    right = paths.centred(np.einsum("nij,nj->ni", R_T, paths.p - middle)).reshape(-1)
    x = np.linalg.lstsq(matrix, right, rcond=1e-9)[0]
    if axis is None:
        return [Place(np.array([0.0, 0.0, 1.0]), middle + x)]
    return [Place(axis, middle + x[:2] @ across(axis), float(x[2]) if pitched else 0.0)]


def ball_in_hand_starts(paths: TipPaths) -> list[Place]:
    """The point that keeps its place in the hand."""
    return carried_starts(paths)


def hinge_in_hand_starts(paths: TipPaths) -> list[Place]:
    """The axis that the hand turns about."""
    return carried_starts(paths, axis_in_hand(paths))


def screw_in_hand_starts(paths: TipPaths) -> list[Place]:
    """The axis that the hand turns about and moves along."""
    return carried_starts(paths, axis_in_hand(paths), pitched=True)


def sleeve_starts(paths: TipPaths) -> list[Place]:
    """The axis that the hand turns about, through the point that keeps its place across it."""
    a, middle = axis_in_hand(paths), paths.p.mean(axis=0)
    base = across(a)
    P = base.T @ base
    R_T = paths.R.transpose(0, 2, 1)
    n = len(R_T)
    matrix = paths.centred((R_T @ base.T).reshape(n, -1)).reshape(-1, 2)
    right = paths.centred(np.einsum("nij,nj->ni", R_T @ P, paths.p - middle)).reshape(-1)
    return [Place(a, middle + np.linalg.lstsq(matrix, right, rcond=1e-9)[0] @ base)]


STARTS: dict[str, Starts] = {
    "height": plane_starts,
    "across-line": line_starts,
    "radius height": circle_starts,
    "radius": cylinder_starts,
    "radius thread": screw_starts,
    "distance": ball_starts,
    "point-in-hand": ball_in_hand_starts,
    "axis-in-hand point-in-hand": hinge_in_hand_starts,
    "axis-in-hand screw-in-hand": screw_in_hand_starts,
    "axis-in-hand axis-line-in-hand": sleeve_starts,
    "axis-in-hand": direction_starts,
    "orientation": line_starts,
}
