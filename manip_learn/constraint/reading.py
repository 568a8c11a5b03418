"""What Lambda says of a mechanism: the motions that one leaves free are a constant space of twists.

The lower pairs of a machine are the subgroups of SE(3); the kind, the axis and the pitch of a mechanism are therefore
read from Lambda itself.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.curve_rows import CurveRows
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import AXES, PoseRows
from manip_learn.constraint.features.mechanism_rows import MechanismRows, PlaceRows
from manip_learn.constraint.mechanism import (
    CLEAR_SHARE,
    CURVE,
    KIND_BY_NAME,
    MECHANISM_KINDS,
    Mechanism,
    MechanismKind,
    Z,
    mechanism_of,
)
from manip_learn.constraint.place import AT_A_DISTANCE, Place, mechanism_weights
from manip_learn.linalg import null_basis
from manip_learn.robot.rotations import skew

# rows of translation and of rotation stand apart where each is of one kind to this share: a row of a learnt Lambda
# leaks by its uncertainty, 1e-2 at 0.6 degrees, and a row that mixes the two for good does so by 0.3 and more
MIXED = 0.2
# [m] an axis or a centre farther away is read as this far: the fit to positions decides how far it is
FARTHEST_START = 5.0
# [m/rad] a travel below this is that of a hinge: a tenth of the flattest thread in use (M6, 1 mm a turn, 0.16 mm/rad)
LEAST_PITCH = 1.6e-5
# the axis that the learner fitted belongs to these rows if it is nearer to theirs than this: 1 degree
SAME_AXIS = 0.9998

Read = tuple[MechanismKind, Place]


def read_kind(
    features: FeatureMap,
    selection: Float[np.ndarray, "s p"],
    immovable: Float[np.ndarray, "k p"],
    p: Float[np.ndarray, "N 3"],
) -> Read | None:
    """The mechanism that leaves these rows zero, and where it is; None if it is none that a machine has.

    Args:
        features: Rows of a frame's twist, along axes that rest with what holds it, or `PlaceRows`.
        selection: Lambda, orthonormal rows.
        immovable: Rows that this arm cannot move, orthonormal.
        p: Places of the hand [m].
    """
    if isinstance(features, PlaceRows):
        if features.form == "twist":
            return of_twists(null_basis(np.concatenate([selection, immovable])).T, features.middle)
        if features.form == "surface":
            return _of_surface(selection, features.middle, p)
        return of_point_rows(selection, immovable, features.middle)
    if not isinstance(features, PoseRows) or features.own_axes:
        return None
    held, blind = (on_twist(features.row_names, rows, distance=True) for rows in (selection, immovable))
    return of_point_rows(held, blind, p.mean(axis=0))


def on_twist(
    names: Sequence[str], rows: Float[np.ndarray, "s p"], *, distance: bool = False
) -> Float[np.ndarray, "s k"]:
    """Rows of some of (v, w) as rows of all six, or of [v; (p - m).v; w] with no share of the distance."""
    out = np.zeros((len(rows), len(AXES) + distance))
    for name, column in zip(names, rows.T, strict=True):
        out[:, AXES.index(name) + (distance and AXES.index(name) > 2)] = column
    return out


def rows_of(
    kind: MechanismKind, place: Place, radius: float | None, twist: PoseRows
) -> tuple[FeatureMap, Float[np.ndarray, "s p"]]:
    """Phi and Lambda of a mechanism: constant rows of a twist where they do, rows about an axis or a centre else.

    Of a helix no radius is said: its row is that of one radius only, and grips differ.
    """
    if not kind.constant:
        of_one = set(kind.rows) & set(AT_A_DISTANCE) and kind.type != "screw"
        options: dict[str, Any] = {"axis": place.axis, "point": place.point, "pitch": place.pitch, **twist.seen_from}
        options["radius"] = radius if of_one else None
        return MechanismRows(twist.robot, twist.frame.name, kind.rows, **options), np.eye(kind.n_rows)
    # the point of the hand that is held is its own origin, wherever that is
    rows = mechanism_weights(kind.rows, Place(place.axis, np.zeros(3)), None).at(np.zeros((1, 3)))[0][0]
    used = [part for part in (slice(0, 3), slice(3, 6)) if np.any(rows[:, part])]
    axes = [name for part in used for name in AXES[part]]
    return twist.with_axes(axes), np.concatenate([rows[:, part] for part in used], axis=1)


def of_point_rows(
    selection: Float[np.ndarray, "s k"],
    immovable: Float[np.ndarray, "m k"],
    middle: Float[np.ndarray, " 3"],
    *,
    aligned: bool = True,
) -> Read | None:
    """From rows of [v; (p - m).v; w]: what holds the point, and how the hand may turn besides.

    Rows that the arm cannot move hold the point as well as any; of how the hand is held they say nothing.
    """
    position, turning = np.concatenate([selection, immovable])[:, :4], selection[:, 4:]
    held, turns = _rank(position), _rank(turning) if turning.size else 0
    if held is None or turns is None or turns == 1 or held > 2:
        return None
    axis = np.linalg.svd(turning)[2][2] if turns == 2 else None
    rows = np.linalg.svd(position)[2][:held]
    normals, distances = rows[:, :3], rows[:, 3]
    far = float(np.linalg.norm(distances)) * FARTHEST_START < 1.0
    if held == 0:
        name, place = "", Place(Z if axis is None else axis, middle)
    elif held == 1:
        centre = middle - normals[0] * distances[0] / max(distances[0] ** 2, FARTHEST_START**-2)
        name, place = "plane" if far else "ball", Place(_unit(normals[0]), middle if far else centre)
    elif far:
        name, place = "line", Place(_unit(np.cross(*normals)), middle)
    else:
        along = distances[1] * normals[0] - distances[0] * normals[1]
        name, place = "hinge", Place(_unit(along), middle - distances @ normals / float(distances @ distances))
    found = KIND_BY_NAME.get({0: name, 2: f"{name}, turning", 3: f"{name}, not turning"}[turns])
    if held == 0:
        found = {2: KIND_BY_NAME["direction"], 3: KIND_BY_NAME["orientation"]}.get(turns)
    turned = aligned and axis is not None and held and abs(float(axis @ place.axis)) < 1.0 - MIXED
    return None if found is None or turned else (found, place)


def _rank(block: Float[np.ndarray, "s k"]) -> int | None:
    """Number of rows that lie in these columns; None if some lie in them in part."""
    sizes = np.linalg.svd(block, compute_uv=False)
    if np.any((sizes > MIXED) & (sizes < np.sqrt(1.0 - MIXED**2))):
        return None
    return int(np.count_nonzero(sizes > 0.5))


def of_twists(free: Float[np.ndarray, "k 6"], middle: Float[np.ndarray, " 3"]) -> Read | None:
    """From the twists (v, w) about m that are left free; every displacement is a screw (G. Chasles)."""
    U, turning, axes = np.linalg.svd(free[:, 3:])
    turns, axis = int(np.count_nonzero(turning > MIXED)), axes[0]
    spun, slides = U.T[:turns] @ free, (U.T[turns:] @ free)[:, :3]
    match turns, len(free):
        case 0, 1:
            return KIND_BY_NAME["line, not turning"], Place(_unit(free[0, :3]), middle)
        case 0, 2:
            return KIND_BY_NAME["plane, not turning"], Place(_unit(np.cross(*slides)), middle)
        case 0, 3:
            return KIND_BY_NAME["orientation"], Place(Z, middle)
        case 1, (1 | 2):
            across = spun[0, :3] / (spun[0, 3:] @ axis)
            foot = middle + np.cross(axis, across)
            if len(slides) == 0:
                return KIND_BY_NAME["screw, firm"], Place(axis, foot, float(across @ axis))
            if np.linalg.norm(np.cross(slides[0], axis)) < MIXED * np.linalg.norm(slides[0]):
                return KIND_BY_NAME["sleeve, firm"], Place(axis, foot)
        case 1, 3 if np.max(np.abs(slides @ axis)) < MIXED:
            return KIND_BY_NAME["plane, turning"], Place(axis, middle)
        case 1, 4:
            return KIND_BY_NAME["direction"], Place(axis, middle)
        case 3, 3:  # v_i = w_i x (m - c) for all three
            away = np.linalg.lstsq(np.concatenate([skew(x) for x in spun[:, 3:]]), spun[:, :3].reshape(-1), rcond=None)[
                0
            ]
            return KIND_BY_NAME["ball, firm"], Place(Z, middle - away)
    return None


def _of_surface(
    selection: Float[np.ndarray, "s 12"], middle: Float[np.ndarray, " 3"], p: Float[np.ndarray, "N 3"]
) -> Read | None:
    """From rows n.v + sum B_ij (p - m)_i v_j: a cylinder's side, B = I - a a^T; a helix has another row, B = [a]."""
    n, B = selection[:, :3], selection[:, 3:].reshape(-1, 3, 3)
    odd = 0.5 * (B - B.transpose(0, 2, 1)).reshape(len(B), -1)
    U, sizes, _ = np.linalg.svd(odd)
    side = U[:, -1]
    C, foot = np.tensordot(side, B, axes=1), side @ n
    values, vectors = np.linalg.eigh(0.5 * (C + C.T))
    order = np.argsort(np.abs(values))
    along, one, other = values[order]
    if abs(along) > MIXED * abs(one) or abs(one - other) > MIXED * abs(other):
        return None
    axis, size = vectors[:, order[0]], 0.5 * float(one + other)
    point = middle - (foot - (foot @ axis) * axis) / size
    if len(selection) == 1:
        return KIND_BY_NAME["cylinder"], Place(axis, point)
    if len(selection) != 2 or sizes[0] < MIXED:
        return None
    # the other row is that of rho^2 a - h a x (p - c)
    T = np.tensordot(U[:, 0], B, axes=1)
    turn = 0.5 * np.array([T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]])
    square = float(np.mean(np.sum(np.cross(p - point, axis) ** 2, axis=1)))
    return KIND_BY_NAME["screw"], Place(axis, point, square * float(turn @ axis) / float(U[:, 0] @ n @ axis))


def _unit(x: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    return x / np.linalg.norm(x)


def read_mechanism(
    selection: Float[np.ndarray, "s p"], features: FeatureMap, learnt: Mapping[str, Any]
) -> Mechanism | None:
    """The mechanism whose motions Lambda leaves free; None if it is none that a machine has, or features of no frame.

    Args:
        selection: Lambda, with orthonormal rows.
        features: Phi.
        learnt: What is known of how Lambda was learnt, empty if it was not: the mechanism fitted to positions adds the
            place, the radius and the uncertainty, if it is the mechanism of these rows.
    """
    read, fitted, angle = None, learnt.get("mechanism"), learnt.get("uncertainty_deg")
    spread = math.radians(angle) if isinstance(angle, int | float) else 0.0
    if isinstance(features, MechanismRows):
        shares = np.einsum("sp,sp->p", selection, selection)
        held = {name for name, share in zip(features.row_names, shares, strict=True) if share > 0.5}
        kind = next((k for k in MECHANISM_KINDS if set(k.rows) == held), None)
        if kind is not None and not np.any(np.abs(shares - np.round(shares)) > CLEAR_SHARE):
            read = mechanism_of(kind, features.geometry, features.radius)
    elif isinstance(features, CurveRows):
        along = np.array([not name.startswith("across") for name in features.row_names])
        if len(selection) == 2 and not np.any(np.abs(selection[:, along]) > CLEAR_SHARE):
            read = Mechanism("other", name=CURVE, curve=features.curve)
    elif isinstance(features, PlaceRows):
        read = _of_place_rows(selection, features, learnt.get("postures"), spread)
    elif isinstance(features, PoseRows):
        read = _of_twist_rows(selection, features, spread)
    if read is not None and (seen_from := getattr(features, "relative_to", None)) is not None:
        read = dataclasses.replace(read, relative_to=seen_from.name)
    if read is None or not isinstance(fitted, Mapping):
        return read
    try:
        known = Mechanism.from_dict(fitted)
    except (KeyError, TypeError, ValueError):
        return read  # of another version, or damaged: Lambda has said what it says
    same = known.type == read.type and (known.orientation == read.orientation or "whole" in learnt)
    if same and known.axis is not None and read.axis is not None:
        same = known.axis.shape == (3,) and abs(float(known.axis @ read.axis)) > SAME_AXIS * np.linalg.norm(known.axis)
    return known if same else read


def _of_place_rows(selection: np.ndarray, features: PlaceRows, postures: Any, spread: float) -> Mechanism | None:
    """The hand is where the postures show it; without them its radius is unknown, and so is a helix."""
    shown = features.middle[None]
    if isinstance(postures, list) and postures:
        shown = np.array([features.twist.placement(q)[0] for q in postures])
    read = read_kind(features, selection, np.zeros((0, features.n_rows)), shown)
    if read is None or (read[0].name == "screw" and not postures):
        return None
    (kind, place), radius = _hinge_or_screw(read, shown[0], spread), None
    if postures and set(kind.rows) & set(AT_A_DISTANCE):
        out = shown - place.point
        out -= 0.0 if kind.type == "ball" else np.outer(out @ place.axis, place.axis)
        radius = float(np.linalg.norm(out, axis=1).mean())
    return mechanism_of(kind, place, radius)


def named_rows(
    mechanism: Mechanism | None, features: FeatureMap, selection: Float[np.ndarray, "s p"]
) -> tuple[FeatureMap, Float[np.ndarray, "s r"]]:
    """Phi and Lambda of rows that are named after the mechanism, in the place of those of `PlaceRows`."""
    kind = None if mechanism is None else KIND_BY_NAME.get(mechanism.name)
    if mechanism is None or kind is None or not isinstance(features, PlaceRows):
        return features, selection
    axis = Z if mechanism.axis is None else mechanism.axis
    point = features.middle if mechanism.point is None else mechanism.point
    place = Place(_unit(axis), point, mechanism.pitch or 0.0)
    return rows_of(kind, place, mechanism.radius, features.twist)


def _of_twist_rows(selection: np.ndarray, features: PoseRows, spread: float) -> Mechanism | None:
    """From constant rows of a frame's twist (v, w) of its origin, known to an angle [rad]; of no place."""
    hand, none = np.zeros(3), np.zeros((0, features.n_rows))
    if features.own_axes and len(selection) == 5 and features.n_rows == len(AXES):
        read = of_twists(null_basis(on_twist(features.row_names, selection)).T, hand)
        if read is None:
            return None
        kind, place = _hinge_or_screw(read, hand, spread)
        found = mechanism_of(kind, place, None if kind.type == "line" else float(np.linalg.norm(place.point)))
        return dataclasses.replace(found, axis=None, point=None, grip="firm")
    held, blind = (on_twist(features.row_names, rows, distance=True) for rows in (selection, none))
    read = of_point_rows(held, blind, hand, aligned=False)
    if read is None:
        return None
    kind, place = read
    if kind.type != "held-orientation":
        if not set(AXES[:3]) <= set(features.row_names):
            return None
        if features.own_axes and kind.orientation != "fixed":
            return None  # directions of a hand that turns are no line and no plane
    found = mechanism_of(kind, place.as_told(), None, point=None)
    return dataclasses.replace(found, axis=None) if features.own_axes else found


def _hinge_or_screw(read: Read, hand: Float[np.ndarray, " 3"], spread: float) -> Read:
    """The one twist of a firm grip is a hinge's unless it travels more than three standard deviations of its angle."""
    kind, place = read
    radius = float(np.linalg.norm(place.point - hand))
    if kind.name != "screw, firm" or abs(place.pitch) >= max(LEAST_PITCH, 3.0 * spread * math.hypot(1.0, radius)):
        return read
    return KIND_BY_NAME["hinge, firm"], place
