"""Mechanism of a Lambda with its place and uncertainty: from rows in which it is constant, or a shape without any."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_lsq_spline
from scipy.optimize import least_squares

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.mechanism_rows import CurveRows, MechanismRows, rows_of
from manip_learn.constraint.mechanism import (
    KIND_BY_NAME,
    LEAST_PITCH,
    ON_THE_AXIS,
    Mechanism,
    MechanismKind,
    mechanism_of,
)
from manip_learn.constraint.place import Curve, Place, across
from manip_learn.errors import FeatureError
from manip_learn.learning.fit import LEAST_RAD, RowFit, autocorrelation
from manip_learn.learning.table import LEAST_GAIN, LEAST_MOTION, View
from manip_learn.learning.uncertainty import STATED, Errors
from manip_learn.linalg import null_basis
from manip_learn.recordings.trajectory import evenly

FEW = 200  # draws of an error for which a place is read again
POOR = 1.0  # [deg] error of the direction, or of the place as seen from the hand, above which it is known badly
PIECES = (2, 4, 8, 16, 32)  # of a spline; as many as foretell the other recordings best
KNOWN = {"axis": slice(0, 3), "point": slice(3, 6), "point-across": slice(3, 6), "pitch": slice(6, 7)}
Places = Float[np.ndarray, "n 3"]
FARTHEST = 3.0  # [m] beyond this an axis or a centre is not told from a line or a plane


@dataclass(frozen=True, eq=False)
class Placed:
    """Mechanism with its kind, its place, and the error of the direction in which the hand moves or is held [deg]."""

    mechanism: Mechanism
    kind: MechanismKind
    place: Place
    off_deg: float | None = None

    @property
    def doubt(self) -> str:
        """Warning about a poorly known place; empty for others."""
        m = self.mechanism
        if m.radius is None or m.arc is None:
            return ""
        arc, point = math.degrees(m.arc), m.uncertainty.get("point", 0.0)
        worst = max(self.off_deg or 0.0, math.degrees(point / max(m.radius, 0.3))) / POOR  # within 30 cm to 5 mm
        if worst <= 1.0:
            return ""
        needed = min(2.0 * arc * math.sqrt(worst), 90.0)  # half of it is left then
        how = f"move it by at least {needed:.0f} degrees, not {arc:.0f}" if arc < needed else "record it more often"
        return f"{how}: it looks like {m.sentence}, but its place is known badly, to {1e3 * point:.2g} mm"

    def rows(self, view: View) -> tuple[FeatureMap, np.ndarray]:
        """Return Phi and Lambda of the mechanism, without rows that this arm cannot move."""
        hand: Any = view.features.twist
        features, selection = rows_of(self.kind, self.place, self.mechanism.radius, hand)
        if not isinstance(features, MechanismRows):
            return features, selection
        features = movable(features, view.table.q)
        return features, np.eye(features.n_rows)


def movable(features: MechanismRows, q: np.ndarray) -> MechanismRows:
    """Return the rows of a mechanism that the arm can move at postures q (n, nq)."""
    sizes = np.linalg.norm(features.batch(q[evenly(len(q), 100)]), axis=2).max(axis=0)
    return features.with_rows([n for n, x in zip(features.row_names, sizes, strict=True) if x > 1e-6], features.radius)


def placed(view: View, fit: RowFit, errors: Errors | None) -> Placed | None:
    """Return the mechanism of fitted rows, with the uncertainty of its place; None if there is none.

    Args:
        view: View of the rows.
        fit: Fit of the rows.
        errors: Draws of their errors; None for no uncertainty.
    """
    if (read := kind_of(fit, view)) is None:
        return None
    kind, place, p = read[0], read[1].as_told(), np.asarray(fit.motion.place)
    if kind.type in ("line", "plane"):  # where the hand was, not where the axes of the rows begin
        place = replace(place, point=p.mean(axis=0))
    radius = arc_of(kind, place, p)
    if radius is not None and not kind.name.endswith("firm") and radius[0] > FARTHEST:
        return None
    off, few = [], p[evenly(len(p), FEW)]
    ahead = headings(kind, place, few)
    for B in (errors.noise + errors.arm)[:FEW] if errors is not None else ():
        rows = fit.rows + B.reshape(len(fit.rows), -1) @ fit.perp
        other = kind_of(fit, view, np.linalg.qr(rows.T)[0].T)
        if other is None or other[0].type != kind.type:
            continue
        there = other[1].as_told()
        d, turned = there.point - place.point, np.linalg.norm(np.cross(place.axis, there.axis))
        if "point-across" in kind.unknowns:
            d = d - (d @ place.axis) * place.axis
        away = arc_of(kind, there, p)
        wider = abs(away[0] - radius[0]) if away and radius else 0.0
        axis = math.degrees(math.atan2(turned, abs(place.axis @ there.axis)))
        aside = np.degrees(np.arccos(np.clip(np.abs(np.sum(ahead * headings(kind, there, few), axis=1)), 0.0, 1.0)))
        off.append((axis, float(np.linalg.norm(d)), wider, abs(there.pitch - place.pitch), float(np.median(aside))))
    told = {name.removesuffix("-across") for name in kind.unknowns} | ({"radius"} if radius else set())
    # axis [deg], point and radius [m], pitch [m/rad], direction [deg]
    sizes: list[float] = np.quantile(off, STATED, axis=0).tolist() if off else []
    stated = zip(("axis", "point", "radius", "pitch"), sizes, strict=False)
    uncertainty = {name: size for name, size in stated if name in told}
    # a single recording does not show its error: a millimetre along the axis does not count
    error = uncertainty.get("pitch", 1e-3 / radius[1] if radius is not None and errors is None else 0.0)
    if kind.name == "screw, firm" and abs(place.pitch) < max(LEAST_PITCH, 3.0 * error):
        kind = KIND_BY_NAME["hinge, firm"]
        uncertainty.pop("pitch", None)
    return _placed(kind, place, p, uncertainty, fit, max(sizes[-1], uncertainty.get("axis", 0.0)) if off else None)


def headings(kind: MechanismKind, place: Place, p: Places) -> Places:
    """Return the unit vectors in which a mechanism moves hands at places p, or holds them where they move in a surface.

    Of a hand on the axis it is the axis.
    """
    d = p - place.point
    across, along = d - np.outer(d @ place.axis, place.axis), np.broadcast_to(place.axis, p.shape)
    helix = np.cross(place.axis, d) + place.pitch * place.axis
    field = {"ball": d, "other": across, "hinge": helix, "screw": helix}.get(kind.type, along)
    near = (np.linalg.norm(across, axis=1) < ON_THE_AXIS) & (kind.type != "ball")
    field = np.where(near[:, None], along, field)
    return field / np.maximum(np.linalg.norm(field, axis=1, keepdims=True), 1e-12)


def _placed(
    kind: MechanismKind, place: Place, p: Places, uncertainty: dict[str, float], fit: RowFit, off: float | None = None
) -> Placed:
    """Return the mechanism of a kind at a place, with the radius [m] and the arc [rad] of the hand."""
    (away, arc), grip = arc_of(kind, place, p) or (None, None), "loose" if kind.orientation == "free" else "firm"
    known = {"grip": grip, "uncertainty": uncertainty, "arc": arc, **fit.motion.hand.seen_from}
    return Placed(mechanism_of(kind, place, away, **known), kind, place, off)


def kind_of(fit: RowFit, view: View, rows: np.ndarray | None = None) -> tuple[MechanismKind, Place] | None:
    """Return the mechanism of fitted rows, or of others near to them, and its place; None if it is none."""
    p, selection = fit.motion.place, view.selection(fit.rows if rows is None else rows)
    return None if p is None else view.features.kind_of(selection, null_basis(view.W).T, p)


def arc_of(kind: MechanismKind, place: Place, p: np.ndarray) -> tuple[float, float] | None:
    """Return the mean distance of the hand from the axis or the centre [m], and its arc [rad]; None without either."""
    if not {"point", "point-across"} & set(kind.unknowns):
        return None
    d = p - place.point
    if "point-across" in kind.unknowns:
        d = d - np.outer(d @ place.axis, place.axis)
    away = np.linalg.norm(d, axis=1)
    unit = d / np.maximum(away, 1e-12)[:, None]
    mean = unit.mean(axis=0)
    half = np.arccos(np.clip(unit @ mean / max(float(np.linalg.norm(mean)), 1e-12), -1.0, 1.0))
    return float(away.mean()), 2.0 * float(half.max())


# ---- shapes without constant rows, fitted to positions of the hand: the side of a cylinder, a helix, a bent rail


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
    chosen = [part.start + evenly(part.stop - part.start, max(2, 1500 // len(parts))) for part in parts]
    p, ends = p[np.concatenate(chosen)], np.cumsum([0, *map(len, chosen)])
    parts = [slice(*edges) for edges in pairwise(ends)]
    middle = p.mean(axis=0)
    first, second, normal = np.linalg.svd(p - middle, full_matrices=False)[2]
    # rows that are none are those of a plane or of a line
    name, axis = ("plane", normal) if len(fit.rows) == 1 else ("line", first)
    kind, place = (KIND_BY_NAME[name], Place(axis, middle)) if known is None else (known.kind, known.place)
    before = float(np.mean(_nearest(kind, place, p, parts)[1] ** 2)) + LEAST_RAD**2

    def gain(left: np.ndarray, unknowns: int) -> float:
        """Return the gain of a shape over the rows, net of the price of its unknowns [nats]."""
        n = left.size / autocorrelation(left, parts)
        return 0.5 * n * math.log(before / (float(np.mean(left**2)) + LEAST_RAD**2)) - 0.5 * unknowns * math.log(n)

    starts: list[Place] = []
    if len(fit.rows) == 2 and kind.name in ("hinge", "screw"):
        kind, starts = KIND_BY_NAME["screw"], [place]
    elif len(fit.rows) == 1 and kind.type in ("plane", "ball"):
        kind = KIND_BY_NAME["cylinder"]
        for angle, side in product(np.arange(8) * math.pi / 8.0, (-1.0, 1.0)):
            starts.append(Place(math.cos(angle) * first + math.sin(angle) * second, middle + side * normal))
    n = len(kind.unknowns)
    best = max((_nearest(kind, x, p, parts) for x in starts), key=lambda found: gain(found[1], n), default=None)
    if best is not None and gain(best[1], n) > LEAST_GAIN and abs(best[0].pitch) >= 3.0 * math.sqrt(best[2][6, 6]):
        place, _, C = best
        place = replace(place, point=place.point + ((middle - place.point) @ place.axis) * place.axis).as_told()
        axis, point, pitch = (math.sqrt(np.trace(C[KNOWN[n], KNOWN[n]])) for n in ("axis", "point", "pitch"))
        point = math.hypot(point, math.radians(arm_deg) * (arc_of(kind, place, p) or (0.0,))[0])
        uncertainty = {"axis": math.hypot(math.degrees(axis), arm_deg), "point": point, "radius": point}
        uncertainty |= {"pitch": pitch} if "pitch" in kind.unknowns else {}
        return _placed(kind, place, p, uncertainty, fit)
    curve = _curve(p, parts) if len(fit.rows) == 2 and len(parts) > 2 and before > LEAST_MOTION**2 else None
    if curve is None or gain(curve[1], 12) <= LEAST_GAIN:
        return None
    hand = fit.motion.hand
    return CurveRows(hand.robot, hand.frame.name, curve[0], ("across-1", "across-2"), **hand.seen_from)


def _nearest(
    kind: MechanismKind, start: Place, p: Places, parts: list[slice]
) -> tuple[Place, Float[np.ndarray, "n k"], Float[np.ndarray, "7 7"]]:
    """Return the best place, its residual [m], and the covariance of its axis, point and pitch."""
    steps = np.concatenate([np.eye(7)[KNOWN[name]] for name in kind.unknowns])
    found = least_squares(lambda x: _left(kind, start.moved(x @ steps), p, parts).ravel(), np.zeros(len(steps)))
    place = start.moved(found.x @ steps)
    left = _left(kind, place, p, parts)
    variance = float(np.mean(left**2)) * autocorrelation(left, parts)
    return place, left, variance * steps.T @ np.linalg.pinv(found.jac.T @ found.jac, 1e-10, True) @ steps


def _left(kind: MechanismKind, place: Place, p: Places, parts: list[slice]) -> Float[np.ndarray, "n k"]:
    """Return the quantities of the position that a mechanism keeps, less their means in each stretch [m]."""
    d, sides = p - place.point, across(place.axis)
    z = d @ place.axis
    rho = np.linalg.norm(d - np.outer(z, place.axis), axis=1)
    if kind.type == "screw":
        angle = np.arctan2(*(d @ sides.T).T[::-1])
        z = z - place.pitch * np.concatenate([np.unwrap(angle[part]) for part in parts])
    kept = {"line": (d @ sides.T).T, "plane": [z], "ball": [np.linalg.norm(d, axis=1)], "other": [rho]}
    out = np.stack(kept.get(kind.type, [rho, z]), axis=1)
    return np.concatenate([out[part] - out[part].mean(axis=0) for part in parts])


def _curve(p: Places, parts: list[slice]) -> tuple[Curve, Places] | None:
    """Return the curve through the positions, and their distances from the curve of the other recordings [m]."""
    best: tuple[Curve, np.ndarray] | None = None
    with suppress(FeatureError, ValueError):  # more pieces than samples can tell, or a hand that stands still
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
                # in two directions of three
                off[part] = math.sqrt(1.5) * (p[part] - others.at(others.nearest(p[part])))
            if best is None or np.mean(off**2) < np.mean(best[1] ** 2):
                best = curve, off
    return best


def _through(curve: Curve, p: Places, pieces: int) -> Curve:
    """Return the spline of a number of pieces through positions, at the lengths of their nearest points on a curve."""
    s = curve.nearest(p)
    order = np.argsort(s)
    s, p = s[order], p[order]
    knots = np.concatenate([np.full(4, s[0]), np.quantile(s, np.arange(1, pieces) / pieces), np.full(4, s[-1])])
    return Curve(make_lsq_spline(s, p, knots, 3)(np.linspace(s[0], s[-1], 4 * pieces + 1)))
