"""Shapes without constant rows, fitted to positions of the hand: the side of a cylinder, a helix, a bent rail."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_lsq_spline
from scipy.optimize import least_squares

from manip_learn.constraint.features.curve_rows import Curve, CurveRows
from manip_learn.constraint.features.mechanism_rows import Place
from manip_learn.constraint.mechanism import KIND_BY_NAME, MechanismKind
from manip_learn.errors import FeatureError
from manip_learn.learning.fit import LEAST_RAD, RowFit, autocorrelation, slices
from manip_learn.learning.place import Placed, arc_of
from manip_learn.learning.search import LEAST_GAIN
from manip_learn.recordings.trajectory import evenly

FEW = 1500  # places of the hand
BENT = 1e-3  # [m] by which a hand leaves a line or a circle that may be a rail of another shape
PIECES = (2, 4, 8, 16, 32)  # of a spline; as many as foretell the other recordings best
KNOWN = {"axis": slice(0, 3), "point": slice(3, 6), "point-across": slice(3, 6), "pitch": slice(6, 7)}
Places = Float[np.ndarray, "n 3"]


def reshaped(fit: RowFit, known: Placed | None, arm_deg: float) -> Placed | CurveRows | None:
    """Return the shape that explains the positions of the hand far better than these rows; None if there is none.

    Args:
        fit: Fit of rows that constrain the position of the hand.
        known: Mechanism of these rows, or None.
        arm_deg: Angle by which errors of the arm may turn the shape [deg].
    """
    p, parts = fit.motion.place, fit.motion.parts
    if p is None or fit.rows.shape[0] > 2:
        return None
    chosen = [part.start + evenly(part.stop - part.start, max(2, FEW // len(parts))) for part in parts]
    p, parts = p[np.concatenate(chosen)], slices([len(c) for c in chosen])
    if (plain := known) is None:  # rows that are none: those of a plane or of a line
        first, *_, last = np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2]
        kind, axis = ("plane", last) if len(fit.rows) == 1 else ("line", first)
        plain = Placed.of(KIND_BY_NAME[kind], Place(axis, p.mean(axis=0)), None, {})
    before = float(np.mean(_nearest(plain.kind, plain.place, p, parts)[1] ** 2)) + LEAST_RAD**2

    def gain(left: np.ndarray, unknowns: int) -> float:
        """Return the gain of a shape over the rows, net of the price of its unknowns [nats]."""
        n = left.size / autocorrelation(left, parts)
        return 0.5 * n * math.log(before / (float(np.mean(left**2)) + LEAST_RAD**2)) - 0.5 * unknowns * math.log(n)

    best, most = None, LEAST_GAIN
    for kind, start in _starts(fit, known, p):
        place, left, C = _nearest(kind, start, p, parts)
        known_to = 3.0 * math.sqrt(C[6, 6])
        if (nats := gain(left, len(kind.unknowns))) > most and (kind.type != "screw" or abs(place.pitch) > known_to):
            best, most = _placed(kind, place, p, C, arm_deg), nats
    if (
        best is None
        and len(fit.rows) == 2
        and before > BENT**2
        and (found := _curve(p, parts)) is not None
        and gain(found[1], 12) > most
    ):
        f: Any = fit.motion.features
        return CurveRows(f.robot, f.frame.name, found[0], ("across-1", "across-2"))
    return best


def _nearest(
    kind: MechanismKind, start: Place, p: Places, parts: list[slice]
) -> tuple[Place, Float[np.ndarray, "n k"], Float[np.ndarray, "7 7"]]:
    """Return the best place, its residual [m], and the covariance of its axis, point and pitch."""
    free = np.unique(np.concatenate([np.arange(7)[KNOWN[name]] for name in kind.unknowns]))

    def moved(x: np.ndarray) -> Place:
        step = np.zeros(7)
        step[free] = x
        return start.moved(step)

    found = least_squares(lambda x: _left(kind, moved(x), p, parts).ravel(), np.zeros(len(free)))
    left, C = _left(kind, moved(found.x), p, parts), np.zeros((7, 7))
    variance = float(np.mean(left**2)) * autocorrelation(left, parts)
    C[np.ix_(free, free)] = variance * np.linalg.pinv(found.jac.T @ found.jac, rcond=1e-10, hermitian=True)
    return moved(found.x), left, C


def _starts(fit: RowFit, known: Placed | None, p: Places) -> Iterator[tuple[MechanismKind, Place]]:
    """Yield shapes that the rows may approximate, with places at which to start."""
    if len(fit.rows) == 2 and known is not None and known.kind.name in ("hinge", "screw"):
        yield KIND_BY_NAME["screw"], known.place
    if len(fit.rows) == 1 and (known is None or known.kind.type in ("plane", "ball")):
        middle = p.mean(axis=0)
        first, second, normal = np.linalg.svd(p - middle, full_matrices=False)[2]
        for angle, side in ((k * math.pi / 8.0, side) for k in range(8) for side in (-1.0, 1.0)):
            yield (
                KIND_BY_NAME["cylinder"],
                Place(math.cos(angle) * first + math.sin(angle) * second, middle + side * normal),
            )


def _left(kind: MechanismKind, place: Place, p: Places, parts: list[slice]) -> Float[np.ndarray, "n k"]:
    """Return the quantities of the position that a mechanism keeps, less their means in each stretch [m]."""
    d = p - place.point
    z = d @ place.axis
    rho = np.linalg.norm(d - np.outer(z, place.axis), axis=1)
    if kind.type == "screw":
        angle = np.arctan2(*(d @ place.across.T).T[::-1])
        z = z - place.pitch * np.concatenate([np.unwrap(angle[part]) for part in parts])
    kept = {"line": (d @ place.across.T).T, "plane": [z], "ball": [np.linalg.norm(d, axis=1)], "other": [rho]}
    out = np.stack(kept.get(kind.type, [rho, z]), axis=1)
    return np.concatenate([out[part] - out[part].mean(axis=0) for part in parts])


def _placed(kind: MechanismKind, place: Place, p: Places, C: np.ndarray, arm_deg: float) -> Placed:
    """Return the mechanism with the uncertainty of its place."""
    place = replace(place, point=place.point + ((p.mean(axis=0) - place.point) @ place.axis) * place.axis).as_told()
    around = arc_of(kind, place, p) or (0.0, 0.0)
    spread = {name: math.sqrt(float(np.trace(C[part, part]))) for name, part in KNOWN.items()}
    point = math.hypot(spread["point"], math.radians(arm_deg) * around[0])
    uncertainty = {"axis": math.hypot(math.degrees(spread["axis"]), arm_deg), "point": point, "radius": point}
    if "pitch" in kind.unknowns:
        uncertainty["pitch"] = spread["pitch"]
    return Placed.of(kind, place, around, uncertainty)


def _curve(p: Places, parts: list[slice]) -> tuple[Curve, Places] | None:
    """Return the curve through the positions, and their distances from the curve of the other recordings [m]."""
    if len(parts) < 3:
        return None
    best: tuple[Curve, np.ndarray] | None = None
    try:
        longest = p[max(parts, key=lambda part: float(np.ptp(p[part], axis=0).sum()))]
        # from its beginning to its farthest place, without what it goes back meanwhile
        away = np.linalg.norm(longest - longest[0], axis=1)
        onward = np.unique(np.maximum.accumulate(away[: int(np.argmax(away)) + 1]), return_index=True)[1]
        curve = Curve(longest[onward][evenly(len(onward), 8)])
        for pieces in PIECES:
            for _ in range(5):
                curve = _through(curve, p, pieces)
            off = np.empty_like(p)
            for part in parts:
                others = _through(curve, np.delete(p, np.arange(part.start, part.stop), axis=0), pieces)
                away = p[part] - others.at(others.nearest(p[part]))
                off[part] = math.sqrt(1.5) * away  # in two directions of three
            if best is None or np.mean(off**2) < np.mean(best[1] ** 2):
                best = curve, off
    except (FeatureError, ValueError):  # more pieces than samples can tell, or a hand that stands still
        return best
    return best


def _through(curve: Curve, p: Places, pieces: int) -> Curve:
    """Return the spline of a number of pieces through positions, at the lengths of their nearest points on a curve."""
    s = curve.nearest(p)
    order = np.argsort(s)
    s, p = s[order], p[order]
    inside = np.quantile(s, np.arange(1, pieces) / pieces)
    knots = np.concatenate([np.full(4, s[0]), inside, np.full(4, s[-1])])
    return Curve(make_lsq_spline(s, p, knots, 3)(np.linspace(s[0], s[-1], 4 * pieces + 1)))
