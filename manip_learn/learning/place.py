"""Mechanism of a Lambda with its place and uncertainty, read from rows in which it is constant."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows, PlaceRows
from manip_learn.constraint.mechanism import (
    KIND_BY_NAME,
    LEAST_PITCH,
    Mechanism,
    MechanismKind,
    Place,
    read_kind,
    rows_of,
)
from manip_learn.learning.fit import RowFit
from manip_learn.learning.table import View
from manip_learn.learning.uncertainty import Errors
from manip_learn.linalg import complement_rows
from manip_learn.recordings.trajectory import evenly

FEW = 200  # draws of an error for which a place is read again
STATED = 0.683  # share of draws within what is stated: one standard deviation
# [deg] and shares of the radius: a place is known badly (a handle would leave the hand), and widely
POOR_AXIS, POOR_PLACE, WIDE_PLACE = 5.0, 0.2, 0.02
FARTHEST = 3.0  # [m] beyond this an axis or a centre is not told from a line or a plane


@dataclass(frozen=True, eq=False)
class Placed:
    """Mechanism with its kind and its place."""

    mechanism: Mechanism
    kind: MechanismKind
    place: Place

    @staticmethod
    def of(
        kind: MechanismKind, place: Place, radius: tuple[float, float] | None, uncertainty: dict[str, float]
    ) -> Placed:
        """Return the mechanism of a kind at a place, with the radius [m] and the arc [rad] of the hand."""
        mechanism = Mechanism(
            kind.type,
            place.axis if "axis" in kind.unknowns else None,
            None if kind.type == "held-orientation" else place.point,
            None if radius is None else radius[0],
            place.pitch if "pitch" in kind.unknowns else None,
            "loose" if kind.orientation == "free" else "firm",
            kind.orientation,
            uncertainty,
            None if radius is None else radius[1],
            kind.name,
        )
        return Placed(mechanism, kind, place)

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
        features, selection = rows_of(self.kind, self.place, self.mechanism.radius, f.robot, f.frame.name)
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
    f, p = view.features, fit.motion.place
    if p is None or not isinstance(f, FrameJacobian | PlaceRows):
        return None
    read = read_kind(f, view.selection(fit.rows), view.immovable, p)
    if read is None:
        return None
    kind, place = read[0], read[1].as_told()
    if kind.type in ("line", "plane"):  # where the hand was, not where the axes of the rows begin
        place = replace(place, point=p.mean(axis=0))
    radius = arc_of(kind, place, p)
    if radius is not None and not kind.name.endswith("firm") and radius[0] > FARTHEST:
        return None
    uncertainty = {} if errors is None else _uncertainty(view, fit, errors, kind, place, p)
    # a single recording does not show its error: a millimetre along the axis does not count
    error = uncertainty.get("pitch", 1e-3 / radius[1] if radius is not None and errors is None else 0.0)
    if kind.name == "screw, firm" and abs(place.pitch) < max(LEAST_PITCH, 3.0 * error):
        kind = KIND_BY_NAME["hinge, firm"]
        uncertainty.pop("pitch", None)
    return Placed.of(kind, place, radius, uncertainty)


def is_named(fit: RowFit, view: View) -> bool:
    """Return True if the rows are those of a mechanism."""
    f, p = view.features, fit.motion.place
    return (
        p is not None
        and isinstance(f, FrameJacobian | PlaceRows)
        and read_kind(f, view.selection(fit.rows), view.immovable, p) is not None
    )


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


def _uncertainty(
    view: View, fit: RowFit, errors: Errors, kind: MechanismKind, place: Place, p: np.ndarray
) -> dict[str, float]:
    """Return the error that 68 % of draws do not exceed: axis [deg], point and radius [m], pitch [m/rad]."""
    perp, off = complement_rows(fit.rows), {"axis": [], "point": [], "radius": [], "pitch": []}
    for B in errors.both[:FEW]:
        rows = fit.rows + B.reshape(len(fit.rows), -1) @ perp
        other = read_kind(view.features, view.selection(np.linalg.qr(rows.T)[0].T), view.immovable, p)
        if other is None or other[0].type != kind.type:
            continue
        there = other[1].as_told()
        off["axis"].append(
            math.degrees(math.atan2(np.linalg.norm(np.cross(place.axis, there.axis)), abs(place.axis @ there.axis)))
        )
        d = there.point - place.point
        if "point-across" in kind.unknowns:
            d = d - (d @ place.axis) * place.axis
        off["point"].append(float(np.linalg.norm(d)))
        one, two = arc_of(kind, there, p), arc_of(kind, place, p)
        off["radius"].append(abs(one[0] - two[0]) if one and two else 0.0)
        off["pitch"].append(abs(there.pitch - place.pitch))
    known = {
        "axis": "axis" in kind.unknowns,
        "point": bool({"point", "point-across"} & set(kind.unknowns)),
        "pitch": "pitch" in kind.unknowns,
    }
    known["radius"] = known["point"]
    return {name: float(np.quantile(x, STATED)) for name, x in off.items() if known[name] and x}
