"""Identify the mechanism behind learnt rows: kind, axis, point and uncertainty, grip, and the rows in selected axes.

The mechanism is identified from features in which its constraint has one Lambda at every configuration (`PlaceRows`),
or its shape is fitted to positions. The search uses the position of the hand only. A mechanism may also rotate the
hand, keep its orientation, or leave it free; the recorded orientations decide. If the hand does not move about an axis
(a knob, a peg), rows of the whole twist are fitted to displacements instead. Rotations are never compared with
translations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_lsq_spline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import AXES, PoseRows
from manip_learn.constraint.features.mechanism_rows import CurveRows, MechanismRows, PlaceForm, PlaceRows, rows_of
from manip_learn.constraint.mechanism import (
    KIND_BY_NAME,
    KINDS,
    LEAST_PITCH,
    MECHANISM_KINDS,
    MIXED,
    ON_THE_AXIS,
    Mechanism,
    MechanismKind,
    mechanism_of,
)
from manip_learn.constraint.place import Curve, Place, across
from manip_learn.errors import FeatureError
from manip_learn.learning.fit import ACCURACY, LEVEL, Errors, Motion, RowFit, autocorrelation
from manip_learn.learning.gate import Gate
from manip_learn.learning.table import (
    CLEAR_GAP,
    LEAST_GAIN,
    LEAST_MOTION,
    MAX_RANGE,
    OVER_NOISE,
    WEAK_GAP,
    Settings,
    Stretch,
    View,
)
from manip_learn.linalg import null_basis, orthonormal_rows, pivoted_rows
from manip_learn.recordings.trajectory import evenly

SLICES = {"axis": slice(0, 3), "point": slice(3, 6), "point-across": slice(3, 6), "pitch": slice(6, 7)}
Places = Float[np.ndarray, "n 3"]
# [deg] RMS rotation of a firmly held hand relative to the mechanism: simulated welds give way by 0.03 to 1.5, hands
# kept straight by habit by 1.6 to 5
GRIP_PLAY = 1.5
LOOSE = OVER_NOISE * GRIP_PLAY  # [deg] largest rotation of a hand that is not free to turn: loose grips reach 5.9 to 30


@dataclass(frozen=True, eq=False)
class Placement:
    """Identified mechanism, with the error of its direction at the hand.

    Attributes:
        mechanism: Mechanism with its uncertainty.
        kind: Kind of the mechanism.
        place: Axis, point and pitch.
        off_deg: Error of the direction in which the hand moves or is held (see `headings`) that is not exceeded in 68 %
            of cases [deg]; None if it is not known.
    """

    mechanism: Mechanism
    kind: MechanismKind
    place: Place
    off_deg: float | None = None

    @property
    def doubt(self) -> str:
        """Warning in words if axis or centre are poorly determined, with a remedy; empty otherwise."""
        # [deg] largest error of the direction, or of the place as seen from the hand, without a warning
        largest = 1.0
        m = self.mechanism
        if m.radius is None or m.arc is None:
            return ""
        arc, point = math.degrees(m.arc), m.uncertainty.get("point", 0.0)
        worst = max(self.off_deg or 0.0, math.degrees(point / max(m.radius, 0.3))) / largest  # within 30 cm to 5 mm
        if worst <= 1.0:
            return ""
        needed = min(2.0 * arc * math.sqrt(worst), 90.0)  # half of it is left then
        how = f"move it by at least {needed:.0f} degrees, not {arc:.0f}" if arc < needed else "record it more often"
        return f"{how}: it looks like {m.sentence}, but its place is known badly, to {1e3 * point:.2g} mm"

    def rows(self, view: View) -> tuple[FeatureMap, np.ndarray]:
        """Return Phi and Lambda of the mechanism's constraint, without rows along which this arm cannot move.

        Args:
            view: View with features of the hand.

        Returns:
            Feature map with p rows, and Lambda (s, p).
        """
        features, selection = rows_of(self.kind, self.place, self.mechanism.radius, view.features.twist)
        if not isinstance(features, MechanismRows):
            return features, selection
        features = movable_rows(features, view.table.q)
        return features, np.eye(features.n_rows)


def movable_rows(features: MechanismRows, q: np.ndarray) -> MechanismRows:
    """Return the features without the rows along which the arm cannot move at any of the given configurations.

    Args:
        features: Rows of a mechanism.
        q: Configurations (n, nq) [rad or m].

    Returns:
        Features with the remaining rows.
    """
    sizes = np.linalg.norm(features.batch(q[evenly(len(q), 100)]), axis=2).max(axis=0)
    return features.with_rows([n for n, x in zip(features.row_names, sizes, strict=True) if x > 1e-6], features.radius)


def locate(fit: RowFit, errors: Errors | None) -> Placement | None:
    """Identify the mechanism of fitted rows, with the uncertainty of its axis and point.

    Args:
        fit: Fit of the rows.
        errors: Random draws of the error of the fit; None to compute no uncertainty.

    Returns:
        The mechanism; None if no known mechanism has these rows, or if it is too far from the hand.
    """
    n_draws = 200  # number of draws of the error for which the place is evaluated
    if (best := kind_of(fit)) is None:
        return None
    kind, place, p = best[0], best[1].canonical(), fit.motion.poses[:, :3, 3]
    if kind.type in ("line", "plane"):  # the mean position of the hand, not the origin of the axes of the rows
        place = replace(place, point=p.mean(axis=0))
    radius = hand_arc(kind, place, p)
    if radius is not None and not kind.name.endswith("firm") and radius[0] > MAX_RANGE:
        return None
    off, few = [], p[evenly(len(p), n_draws)]
    ahead = headings(kind, place, few)
    for B in (errors.noise + errors.arm)[:n_draws] if errors is not None else ():
        rows = fit.rows + B.reshape(len(fit.rows), -1) @ fit.perp
        other = kind_of(fit, np.linalg.qr(rows.T)[0].T)
        if other is None or other[0].type != kind.type:
            continue
        there = other[1].canonical()
        d, turned = there.point - place.point, np.linalg.norm(np.cross(place.axis, there.axis))
        if "point-across" in kind.unknowns:
            d = d - (d @ place.axis) * place.axis
        away = hand_arc(kind, there, p)
        wider = abs(away[0] - radius[0]) if away and radius else 0.0
        axis = math.degrees(math.atan2(turned, abs(place.axis @ there.axis)))
        aside = np.degrees(np.arccos(np.clip(np.abs(np.sum(ahead * headings(kind, there, few), axis=1)), 0.0, 1.0)))
        off.append((axis, float(np.linalg.norm(d)), wider, abs(there.pitch - place.pitch), float(np.median(aside))))
    quantities = {name.removesuffix("-across") for name in kind.unknowns} | ({"radius"} if radius else set())
    # axis [deg], point and radius [m], pitch [m/rad], direction [deg]
    sizes: list[float] = np.quantile(off, LEVEL, axis=0).tolist() if off else []
    stated = zip(("axis", "point", "radius", "pitch"), sizes, strict=False)
    uncertainty = {name: size for name, size in stated if name in quantities}
    # a single recording has no known error: a millimetre along the axis does not count
    error = uncertainty.get("pitch", 1e-3 / radius[1] if radius is not None and errors is None else 0.0)
    if kind.name == "screw, firm" and abs(place.pitch) < max(LEAST_PITCH, 3.0 * error):
        kind = KIND_BY_NAME["hinge, firm"]
        uncertainty.pop("pitch", None)
    return _placement(kind, place, p, uncertainty, fit, max(sizes[-1], uncertainty.get("axis", 0.0)) if off else None)


def headings(kind: MechanismKind, place: Place, p: Places) -> Places:
    """Return the direction of a mechanism at each position of the hand, by which errors of direction are measured.

    It is the direction of motion for a line, a hinge and a screw, the normal for a plane, a ball and the side of a
    cylinder, and the axis for a hand on the axis.

    Args:
        kind: Kind of the mechanism.
        place: Axis, point and pitch of the mechanism.
        p: Positions (n, 3) of the hand [m].

    Returns:
        Unit vectors (n, 3).
    """
    d = p - place.point
    across, along = d - np.outer(d @ place.axis, place.axis), np.broadcast_to(place.axis, p.shape)
    helix = np.cross(place.axis, d) + place.pitch * place.axis
    field = {"ball": d, "other": across, "hinge": helix, "screw": helix}.get(kind.type, along)
    near = (np.linalg.norm(across, axis=1) < ON_THE_AXIS) & (kind.type != "ball")
    field = np.where(near[:, None], along, field)
    return field / np.maximum(np.linalg.norm(field, axis=1, keepdims=True), 1e-12)


def _placement(
    kind: MechanismKind, place: Place, p: Places, uncertainty: dict[str, float], fit: RowFit, off: float | None = None
) -> Placement:
    """Return the mechanism of a kind at a place, with the radius [m] and the arc [rad] of the hand."""
    (away, arc), grip = hand_arc(kind, place, p) or (None, None), "loose" if kind.orientation == "free" else "firm"
    facts = {"grip": grip, "uncertainty": uncertainty, "arc": arc, **fit.view.features.twist.seen_from}
    return Placement(mechanism_of(kind, place, away, **facts), kind, place, off)


def kind_of(fit: RowFit, rows: np.ndarray | None = None) -> tuple[MechanismKind, Place] | None:
    """Identify the kind of mechanism of fitted rows, and its axis and point.

    Args:
        fit: Fit of the rows.
        rows: Whitened rows (s, r) to use instead of the fitted ones; None for the fitted rows.

    Returns:
        Kind and place; None if no known mechanism has these rows.
    """
    view, poses = fit.view, fit.motion.poses
    if poses is None:
        return None
    selection = view.selection(fit.rows if rows is None else rows)
    return view.features.kind_of(selection, null_basis(view.W).T, poses[:, :3, 3])


def hand_arc(kind: MechanismKind, place: Place, p: np.ndarray) -> tuple[float, float] | None:
    """Return the mean distance of the hand from the axis or the centre, and the angle of its arc about it.

    Args:
        kind: Kind of the mechanism.
        place: Axis and point of the mechanism.
        p: Positions (n, 3) of the hand [m].

    Returns:
        Distance [m] and angle [rad]; None for kinds without a fitted axis or centre.
    """
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


def fit_shape(fit: RowFit, known: Placement | None, arm_deg: float) -> Placement | CurveRows | None:
    """Look for a shape (cylinder, helix or curve) that explains the positions of the hand far better than these rows.

    Args:
        fit: Fit of rows that constrain the position of the hand.
        known: Mechanism of these rows; None if it is not known.
        arm_deg: Angle by which errors of the arm may tilt the shape [deg].

    Returns:
        The mechanism, or the rows across a curve; None if no shape is far better.
    """
    parts, hand = fit.motion.parts, fit.view.features.twist
    if hand is None or fit.rows.shape[0] > 2:
        return None
    samples = [part.start + evenly(part.stop - part.start, max(2, 1500 // len(parts))) for part in parts]
    p, ends = fit.motion.poses[np.concatenate(samples), :3, 3], np.cumsum([0, *map(len, samples)])
    parts = [slice(*edges) for edges in pairwise(ends)]
    middle = p.mean(axis=0)
    first, second, normal = np.linalg.svd(p - middle, full_matrices=False)[2]
    # rows without a mechanism count as a plane or a line
    name, axis = ("plane", normal) if len(fit.rows) == 1 else ("line", first)
    kind, place = (KIND_BY_NAME[name], Place(axis, middle)) if known is None else (known.kind, known.place)
    before = float(np.mean(_fit_place(kind, place, p, parts)[1] ** 2)) + ACCURACY**2

    def gain(residual: np.ndarray, unknowns: int) -> float:
        """Return the gain of a shape over the rows, net of the price of its unknowns [nats].

        Args:
            residual: Array (n, k) of residuals of the shape [m].
            unknowns: Number of its parameters.
        """
        n = residual.size / autocorrelation(residual, parts)
        return 0.5 * n * math.log(before / (float(np.mean(residual**2)) + ACCURACY**2)) - 0.5 * unknowns * math.log(n)

    starts: list[Place] = []
    if len(fit.rows) == 2 and kind.name in ("hinge", "screw"):
        kind, starts = KIND_BY_NAME["screw"], [place]
    elif len(fit.rows) == 1 and kind.type in ("plane", "ball"):
        kind = KIND_BY_NAME["cylinder"]
        for angle, side in product(np.arange(8) * math.pi / 8.0, (-1.0, 1.0)):
            starts.append(Place(math.cos(angle) * first + math.sin(angle) * second, middle + side * normal))
    n = len(kind.unknowns)
    best = max((_fit_place(kind, x, p, parts) for x in starts), key=lambda found: gain(found[1], n), default=None)
    if best is not None and gain(best[1], n) > LEAST_GAIN and abs(best[0].pitch) >= 3.0 * math.sqrt(best[2][6, 6]):
        place, _, C = best
        place = replace(place, point=place.point + ((middle - place.point) @ place.axis) * place.axis).canonical()
        axis, point, pitch = (math.sqrt(np.trace(C[SLICES[n], SLICES[n]])) for n in ("axis", "point", "pitch"))
        point = math.hypot(point, math.radians(arm_deg) * (hand_arc(kind, place, p) or (0.0,))[0])
        uncertainty = {"axis": math.hypot(math.degrees(axis), arm_deg), "point": point, "radius": point}
        uncertainty |= {"pitch": pitch} if "pitch" in kind.unknowns else {}
        return _placement(kind, place, p, uncertainty, fit)
    curve = _curve(p, parts) if len(fit.rows) == 2 and len(parts) > 2 and before > LEAST_MOTION**2 else None
    if curve is None or gain(curve[1], 12) <= LEAST_GAIN:
        return None
    return CurveRows(hand.robot, hand.frame.name, curve[0], ("across-1", "across-2"), **hand.seen_from)


def _fit_place(
    kind: MechanismKind, start: Place, p: Places, parts: list[slice]
) -> tuple[Place, Float[np.ndarray, "n k"], Float[np.ndarray, "7 7"]]:
    """Return the best place, its residual [m], and the covariance of its axis, point and pitch."""
    steps = np.concatenate([np.eye(7)[SLICES[name]] for name in kind.unknowns])
    solution = least_squares(lambda x: _residual(kind, start.moved(x @ steps), p, parts).ravel(), np.zeros(len(steps)))
    place = start.moved(solution.x @ steps)
    residual = _residual(kind, place, p, parts)
    variance = float(np.mean(residual**2)) * autocorrelation(residual, parts)
    return place, residual, variance * steps.T @ np.linalg.pinv(solution.jac.T @ solution.jac, 1e-10, True) @ steps


def _residual(kind: MechanismKind, place: Place, p: Places, parts: list[slice]) -> Float[np.ndarray, "n k"]:
    """Return the quantities of the position that a mechanism keeps constant, less their means in each stretch [m]."""
    d, sides = p - place.point, across(place.axis)
    z = d @ place.axis
    rho = np.linalg.norm(d - np.outer(z, place.axis), axis=1)
    if kind.type == "screw":
        angle = np.arctan2(*(d @ sides.T).T[::-1])
        z = z - place.pitch * np.concatenate([np.unwrap(angle[part]) for part in parts])
    constants = {"line": (d @ sides.T).T, "plane": [z], "ball": [np.linalg.norm(d, axis=1)], "other": [rho]}
    out = np.stack(constants.get(kind.type, [rho, z]), axis=1)
    return np.concatenate([out[part] - out[part].mean(axis=0) for part in parts])


def _curve(p: Places, parts: list[slice]) -> tuple[Curve, Places] | None:
    """Return the curve through the positions, and their distances from the curve without their own recording [m]."""
    # candidate numbers of pieces of a spline; the one that predicts the other recordings best wins
    numbers = (2, 4, 8, 16, 32)
    best: tuple[Curve, np.ndarray] | None = None
    with suppress(FeatureError, ValueError):  # too many pieces for the samples, or a hand at rest
        longest = p[max(parts, key=lambda part: float(np.ptp(p[part], axis=0).sum()))]
        # from its beginning to its farthest position, without backward motion
        away = np.linalg.norm(longest - longest[0], axis=1)
        onward = np.unique(np.maximum.accumulate(away[: int(np.argmax(away)) + 1]), return_index=True)[1]
        curve = Curve(longest[onward][evenly(len(onward), 8)])
        for pieces in numbers:
            for _ in range(5):
                curve = _fit_spline(curve, p, pieces)
            off = np.empty_like(p)
            for part in parts:
                others = _fit_spline(curve, np.delete(p, np.arange(part.start, part.stop), axis=0), pieces)
                # the distance is in two directions of three
                off[part] = math.sqrt(1.5) * (p[part] - others.at(others.nearest(p[part])))
            if best is None or np.mean(off**2) < np.mean(best[1] ** 2):
                best = curve, off
    return best


def _fit_spline(curve: Curve, p: Places, pieces: int) -> Curve:
    """Return the spline of a number of pieces through positions, at the lengths of their nearest points on a curve."""
    s = curve.nearest(p)
    order = np.argsort(s)
    s, p = s[order], p[order]
    knots = np.concatenate([np.full(4, s[0]), np.quantile(s, np.arange(1, pieces) / pieces), np.full(4, s[-1])])
    return Curve(make_lsq_spline(s, p, knots, 3)(np.linspace(s[0], s[-1], 4 * pieces + 1)))


# ---- the whole hand: its grip, and the rows in selected axes


def fit_whole(
    views: Sequence[View], place: RowFit, spans: Sequence[Stretch], settings: Settings, gate: Gate
) -> RowFit | None:
    """Fit rows of the hand's whole twist, which constrain its orientation in addition to its position (a firm grip).

    Accepted rows belong to a known mechanism, or are clear and pass the gate. They constrain the orientation as tightly
    as a grip does, and the position with at least as many rows as `place`. Among these, the rows with the largest gap
    between the displacements along them and along free directions are returned.

    Args:
        views: Views of the whole twist.
        place: Fit of the rows that constrain the position of the hand.
        spans: Stretches in which these rows are constrained.
        settings: Settings of the fit.
        gate: Test that accepts or rejects rows by their evidence.

    Returns:
        Fit of the rows of the whole twist; None if the grip is loose.
    """
    best, largest, apart = None, (False, WEAK_GAP), independent_rotation(place.motion)
    J, few, has_name = place.motion.J, evenly(len(place.motion.x), 50), kind_of(place) is not None
    for view in views:
        motion = Motion.of(view, spans, settings)
        levels = np.append(motion.levels.sizes, 1.0)
        for s in range(view.largest, len(place.rows), -1):
            gap = float(levels[s] / max(levels[s - 1], 1e-12))
            if gap <= WEAK_GAP or (True, gap) <= largest:
                continue
            fit = RowFit(motion, orthonormal_rows(motion.levels.directions[:s])).best()
            turned = np.sum(np.einsum("nij,nj->ni", J[:, 3:], fit.correction()) ** 2, axis=1)
            away = np.degrees(np.median([np.sqrt(np.mean(turned[p])) for p in motion.parts]))
            free = (x @ null_basis(A) for x, A in zip(J[few, :3], fit.rows @ motion.Phi[few], strict=True))
            moves = [np.count_nonzero(np.linalg.svd(x, compute_uv=False) > ON_THE_AXIS) for x in free]
            # where the gap is clear, rotation by independent joints alone counts
            most = min(GRIP_PLAY if gap < CLEAR_GAP else np.inf, apart / CLEAR_GAP)
            # rows of the position that explain as much are preferred: a compliant grip turns more than it slides, and
            # a hand that is free to turn may turn alike each time
            n_constrained, is_kind = 3 - int(np.median(moves)), kind_of(fit) is not None
            as_well = fit.variance <= OVER_NOISE * place.variance and is_kind >= has_name
            if away > most or n_constrained < len(place.rows) + (not as_well):
                continue
            if (is_kind, gap) <= largest or not (is_kind or gap > CLEAR_GAP):
                continue
            if is_kind or gate.evidence(view, spans).verdict(s) == "clear":
                best, largest = fit, (is_kind, gap)
    return best


def grip_kind(known: Placement, motion: Motion) -> tuple[MechanismKind, float, float]:
    """Determine how a mechanism constrains the orientation of the hand, from the recorded orientations.

    Args:
        known: Mechanism that constrains the position of the hand.
        motion: Samples of the contacts.

    Returns:
        Three values. The kind of mechanism with the most rows from which the orientation deviates no more than a grip
        gives way; `known.kind` if there is none. The RMS deviation of the orientation from being fixed or from turning
        with the mechanism, whichever is smaller [deg]. The RMS rotation of `independent_rotation` [deg]. Deviations are
        medians over the contacts.
    """
    place, apart, deviations = known.place, independent_rotation(motion), list[dict[str, float]]()
    for T in (motion.poses[p] for p in motion.parts):  # RMS rotation from each orientation that may be constrained
        rotation, away = Rotation.from_matrix(T[:, :3, :3]), T[:, :3, 3] - place.point
        turns, directions = {"fixed": rotation}, dict[str, np.ndarray]()
        if known.kind.type == "ball":
            directions["carried"] = rotation.inv().apply(-away)
        elif known.kind.type != "line":
            directions["about-axis"] = rotation.inv().apply(place.axis)
        if known.kind.type in ("hinge", "screw", "other"):
            sides = across(place.axis)
            angle = np.unwrap(np.arctan2(away @ sides[1], away @ sides[0]))
            turns["carried"] = Rotation.from_rotvec(-angle[:, None] * place.axis) * rotation
        off = {name: (turn * turn.mean().inv()).magnitude() for name, turn in turns.items()}
        for name, vectors in directions.items():
            units = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
            mean = units.mean(axis=0)
            off[name] = np.arccos(np.clip(units @ mean / np.linalg.norm(mean), -1.0, 1.0))
        deviations.append({name: float(np.degrees(np.sqrt(np.mean(angles**2)))) for name, angles in off.items()})
    rms = {name: float(np.median([x[name] for x in deviations])) for name in deviations[0]}
    smallest, most = min(rms["fixed"], rms.get("carried", np.inf)), min(GRIP_PLAY, apart / CLEAR_GAP)
    kinds = [k for k in MECHANISM_KINDS if k.type == known.kind.type and len(k.rows) > len(known.kind.rows)]
    firm = [k for k in kinds if rms.get(k.orientation, np.inf) <= most]
    firm = [k for k in firm if k.orientation != "about-axis" or smallest > LOOSE]
    return max(firm, key=lambda k: (len(k.rows), -rms[k.orientation]), default=known.kind), smallest, apart


def independent_rotation(motion: Motion) -> float:
    """Return the RMS rotation that the hand would make if each joint moved as much as recorded, but independently.

    Args:
        motion: Samples of the contacts.

    Returns:
        Median over the contacts [deg].
    """
    turns = np.array([np.sum(motion.J[(p.start + p.stop) // 2, 3:] ** 2, axis=0) for p in motion.parts])
    spread = np.array([np.var(motion.x[p], axis=0) for p in motion.parts])
    return float(np.degrees(np.median(np.sqrt(np.sum(turns * spread, axis=1)))))


def select_rows(
    features: FeatureMap, selection: np.ndarray, known: Placement | None, asked: Sequence[FeatureMap], q: np.ndarray
) -> tuple[FeatureMap, Float[np.ndarray, "k r"]]:
    """Select the constraint rows that lie in the requested axes.

    They are combinations of the rows of Lambda without a component along other axes. If there are none, or if the axes
    cannot be separated, all rows are returned.

    Args:
        features: Feature map Phi of all rows that constrain the hand.
        selection: Their Lambda (s, p).
        known: Mechanism of these rows; None if it is not known.
        asked: Requested feature maps.
        q: Recorded configurations (n, nq) [rad or m].

    Returns:
        Feature map with r rows, and Lambda (k, r) for it.
    """
    poses, names = [f for f in asked if isinstance(f, PoseRows)], {n for f in asked for n in f.row_names}
    if isinstance(features, MechanismRows) and known is not None and names == set(AXES[:3]):
        mine, radius = KINDS[known.kind.kind, "free"].rows, known.mechanism.radius
        if len(poses) == len(asked) and (radius is None or radius >= ON_THE_AXIS):
            features = movable_rows(features.with_rows(mine, None if known.kind.type == "screw" else radius), q)
            return features, np.eye(features.n_rows)
    if len(poses) < len(asked) or not isinstance(features, PoseRows | PlaceRows):
        return features, selection
    columns, own_axes = features.row_names, isinstance(features, PoseRows) and features.own_axes
    options = list[FeatureMap](f for f in poses if f.own_axes == own_axes)[:1]
    if isinstance(features, PlaceRows) and features.form != "twist":
        form: PlaceForm = "point" if names <= set(AXES[:3]) else "point and rotation"
        hand = features.robot, features.frame.name
        wide = PlaceRows(*hand, form, features.middle, **features.twist.seen_from)
        options.append(features if form == features.form else wide)
    best, rows = features, selection[:0]
    for option in options:
        mine = np.array([n in option.row_names for n in columns])
        _, sigma, Vt = np.linalg.svd(selection[:, ~mine].T)
        inside = Vt[np.append(sigma, np.zeros(len(selection) - len(sigma))) < MIXED] @ (selection * mine)
        best, rows = (option, inside) if len(inside) > len(rows) else (best, rows)
    if best is features:
        return features, selection
    return best, pivoted_rows(rows) @ np.array([[column == n for n in best.row_names] for column in columns])
