"""Mechanism of a Lambda with its place and uncertainty: from rows in which it is constant, or a shape without any."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_lsq_spline
from scipy.optimize import least_squares

from manip_learn.constraint.features.curve_rows import Curve, CurveRows
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import PoseRows
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.mechanism import (
    KIND_BY_NAME,
    LEAST_PITCH,
    Mechanism,
    MechanismKind,
    Place,
    Read,
    mechanism_of,
    read_kind,
    rows_of,
)
from manip_learn.errors import FeatureError
from manip_learn.learning.fit import LEAST_RAD, RowFit, autocorrelation, slices
from manip_learn.learning.search import LEAST_GAIN
from manip_learn.learning.table import View
from manip_learn.learning.uncertainty import Errors
from manip_learn.linalg import complement_rows
from manip_learn.recordings.trajectory import evenly

FEW = 200  # draws of an error for which a place is read again
STATED = 0.683  # share of draws within what is stated: one standard deviation
# [deg] and shares of the radius: a place is known badly (a handle would leave the hand), and widely
POOR_AXIS, POOR_PLACE, WIDE_PLACE = 5.0, 0.2, 0.02
MOST_PLACES = 1500  # places of the hand
BENT = 1e-3  # [m] by which a hand leaves a line or a circle that may be a rail of another shape
PIECES = (2, 4, 8, 16, 32)  # of a spline; as many as foretell the other recordings best
KNOWN = {"axis": slice(0, 3), "point": slice(3, 6), "point-across": slice(3, 6), "pitch": slice(6, 7)}
Places = Float[np.ndarray, "n 3"]
FARTHEST = 3.0  # [m] beyond this an axis or a centre is not told from a line or a plane


@dataclass(frozen=True, eq=False)
class Placed:
    """Mechanism with its kind and its place."""

    mechanism: Mechanism
    kind: MechanismKind
    place: Place

    @staticmethod
    def of(
        kind: MechanismKind,
        place: Place,
        radius: tuple[float, float] | None,
        uncertainty: dict[str, float],
        relative_to: str | None = None,
    ) -> Placed:
        """Return the mechanism of a kind at a place, with the radius [m] and the arc [rad] of the hand."""
        away, arc = radius or (None, None)
        grip = "loose" if kind.orientation == "free" else "firm"
        known = {"grip": grip, "uncertainty": uncertainty, "arc": arc, "relative_to": relative_to}
        return Placed(mechanism_of(kind, place, away, **known), kind, place)

    @property
    def doubt(self) -> str:
        """Warning about a poorly known place; empty for others."""
        m = self.mechanism
        if m.radius is None or m.arc is None:
            return ""
        axis, point, arc = m.uncertainty.get("axis", 0.0), m.uncertainty.get("point", 0.0), math.degrees(m.arc)
        worst = max(axis / POOR_AXIS, point / (POOR_PLACE * max(m.radius, 0.02)))
        if worst <= 1.0 and (point <= WIDE_PLACE * m.radius or self.kind.orientation != "free"):
            return ""
        needed = min(arc * math.sqrt(max(4.0 * worst, 3.0 * point / (WIDE_PLACE * max(m.radius, 1e-3)))), 90.0)
        how = f"move it by at least {needed:.0f} degrees, not {arc:.0f}" if arc < needed else "record it more often"
        what = f"it looks like {m.sentence}, but its place is known badly" if worst > 1.0 else "its place"
        return f"{how}: {what}" + ("" if worst > 1.0 else f" is known to {1e3 * point:.0f} mm only")

    def rows(self, view: View) -> tuple[FeatureMap, np.ndarray]:
        """Return Phi and Lambda of the mechanism, without rows that this arm cannot move."""
        f: Any = view.features
        features, selection = rows_of(self.kind, self.place, self.mechanism.radius, f.twist)
        if isinstance(features, MechanismRows):
            features = movable(features, view.table.q)
            selection = np.eye(features.n_rows)
        return features, selection

    def of_kind(self, kind: MechanismKind) -> Placed:
        """Return the same place for another kind of mechanism of its type."""
        m = replace(self.mechanism, orientation=kind.orientation, name=kind.name)
        return replace(self, mechanism=m, kind=kind)


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
    uncertainty = {} if errors is None else _uncertainty(view, fit, errors, kind, place)
    # a single recording does not show its error: a millimetre along the axis does not count
    error = uncertainty.get("pitch", 1e-3 / radius[1] if radius is not None and errors is None else 0.0)
    if kind.name == "screw, firm" and abs(place.pitch) < max(LEAST_PITCH, 3.0 * error):
        kind = KIND_BY_NAME["hinge, firm"]
        uncertainty.pop("pitch", None)
    return Placed.of(kind, place, radius, uncertainty, **fit.motion.hand.seen_from)


def kind_of(fit: RowFit, view: View, rows: np.ndarray | None = None) -> Read | None:
    """Return the mechanism of fitted rows, or of others near to them, and its place; None if it is none."""
    p, chosen = fit.motion.place, fit.rows if rows is None else rows
    return None if p is None else read_kind(view.features, view.selection(chosen), view.immovable, p)


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
    size = float(np.linalg.norm(mean))
    arc = 2.0 * float(np.arccos(np.clip(unit @ mean / max(size, 1e-12), -1.0, 1.0)).max())
    return float(away.mean()), arc


def _uncertainty(view: View, fit: RowFit, errors: Errors, kind: MechanismKind, place: Place) -> dict[str, float]:
    """Return the error that 68 % of draws do not exceed: axis [deg], point and radius [m], pitch [m/rad]."""
    p, perp, off = np.asarray(fit.motion.place), complement_rows(fit.rows), []
    told, radius = {name.removesuffix("-across") for name in kind.unknowns}, arc_of(kind, place, p)
    for B in errors.both[:FEW]:
        rows = fit.rows + B.reshape(len(fit.rows), -1) @ perp
        other = kind_of(fit, view, np.linalg.qr(rows.T)[0].T)
        if other is None or other[0].type != kind.type:
            continue
        there = other[1].as_told()
        d, turned = there.point - place.point, np.linalg.norm(np.cross(place.axis, there.axis))
        if "point-across" in kind.unknowns:
            d = d - (d @ place.axis) * place.axis
        away = arc_of(kind, there, p)
        off.append(
            {
                "axis": math.degrees(math.atan2(turned, abs(place.axis @ there.axis))),
                "point": float(np.linalg.norm(d)),
                "radius": abs(away[0] - radius[0]) if away and radius else 0.0,
                "pitch": abs(there.pitch - place.pitch),
            }
        )
    known = [n for n in ("axis", "point", "radius", "pitch") if off and (n in told or (n == "radius" and radius))]
    return {name: float(np.quantile([x[name] for x in off], STATED)) for name in known}


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
    chosen = [part.start + evenly(part.stop - part.start, max(2, MOST_PLACES // len(parts))) for part in parts]
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
            best, most = _placed(kind, place, p, C, arm_deg, fit.motion.hand), nats
    if (
        best is None
        and len(fit.rows) == 2
        and before > BENT**2
        and (found := _curve(p, parts)) is not None
        and gain(found[1], 12) > most
    ):
        hand = fit.motion.hand
        return CurveRows(hand.robot, hand.frame.name, found[0], ("across-1", "across-2"), **hand.seen_from)
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


def _placed(kind: MechanismKind, place: Place, p: Places, C: np.ndarray, arm_deg: float, hand: PoseRows) -> Placed:
    """Return the mechanism with the uncertainty of its place."""
    place = replace(place, point=place.point + ((p.mean(axis=0) - place.point) @ place.axis) * place.axis).as_told()
    around = arc_of(kind, place, p) or (0.0, 0.0)
    spread = {name: math.sqrt(float(np.trace(C[part, part]))) for name, part in KNOWN.items()}
    point = math.hypot(spread["point"], math.radians(arm_deg) * around[0])
    uncertainty = {"axis": math.hypot(math.degrees(spread["axis"]), arm_deg), "point": point, "radius": point}
    if "pitch" in kind.unknowns:
        uncertainty["pitch"] = spread["pitch"]
    return Placed.of(kind, place, around, uncertainty, **hand.seen_from)


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
