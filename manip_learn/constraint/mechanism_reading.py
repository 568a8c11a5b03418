"""From rows to the kind of a mechanism and its place, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.features.place_fields import AT_A_DISTANCE, Place, mechanism_weights
from manip_learn.constraint.features.place_rows import PlaceRows
from manip_learn.constraint.mechanism_kinds import MECHANISM_KINDS, MechanismKind, Orientation
from manip_learn.linalg import null_basis
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import skew

# rows of translation and of rotation stand apart where each is of one kind to this share: a row of a learnt Lambda
# leaks by its uncertainty, 1e-2 at 0.6 degrees, and a row that mixes the two for good does so by 0.3 and more
MIXED = 0.2
# [m] an axis or a centre farther away is read as this far: the fit to positions decides how far it is
FARTHEST_START = 5.0
_TURNS: dict[int, Orientation] = {0: "free", 2: "about-axis", 3: "fixed"}

Read = tuple[MechanismKind, Place]


def read_kind(
    features: FeatureMap,
    selection: Float[np.ndarray, "s p"],
    immovable: Float[np.ndarray, "k p"],
    p: Float[np.ndarray, "N 3"],
) -> Read | None:
    """The mechanism that leaves these rows zero, and where it is; None if it is none that a machine has.

    Args:
        features: Rows of the whole pose: of a `FrameJacobian` along the base's axes, or `PlaceRows`.
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
    if not isinstance(features, FrameJacobian) or features.reference != "world":
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
    kind: MechanismKind, place: Place, radius: float | None, robot: Robot, frame: str
) -> tuple[FeatureMap, Float[np.ndarray, "s p"]]:
    """Phi and Lambda of a mechanism: constant rows where they do, rows about an axis or a centre else.

    Of a helix no radius is said: its row is that of one radius only, and grips differ.
    """
    if not kind.constant:
        of_one = set(kind.rows) & set(AT_A_DISTANCE) and kind.type != "screw"
        options: dict[str, Any] = {"axis": place.axis, "point": place.point, "pitch": place.pitch}
        return MechanismRows(robot, frame, kind.rows, **options, radius=radius if of_one else None), np.eye(kind.n_rows)
    # the point of the hand that is held is its own origin, wherever that is
    rows = mechanism_weights(kind.rows, Place(place.axis, np.zeros(3)), None).at(np.zeros((1, 3)))[0][0]
    used = [part for part in (slice(0, 3), slice(3, 6)) if np.any(rows[:, part])]
    axes = [name for part in used for name in AXES[part]]
    return FrameJacobian(robot, frame, axes), np.concatenate([rows[:, part] for part in used], axis=1)


def _kind(kind: str, orientation: Orientation) -> MechanismKind | None:
    return next((k for k in MECHANISM_KINDS if (k.type, k.orientation) == (kind, orientation)), None)


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
        kind, place = "held-orientation", Place(np.array([0.0, 0.0, 1.0]) if axis is None else axis, middle)
    elif held == 1:
        centre = middle - normals[0] * distances[0] / max(distances[0] ** 2, FARTHEST_START**-2)
        normal = normals[0] / np.linalg.norm(normals[0])
        kind, place = ("plane", Place(normal, middle)) if far else ("ball", Place(normal, centre))
    elif far:
        kind, place = "line", Place(np.cross(*normals) / np.linalg.norm(np.cross(*normals)), middle)
    else:
        along = distances[1] * normals[0] - distances[0] * normals[1]
        centre = middle - distances @ normals / float(distances @ distances)
        kind, place = "hinge", Place(along / np.linalg.norm(along), centre)
    found = _kind(kind, _TURNS[turns])
    turned = aligned and axis is not None and held and abs(float(axis @ place.axis)) < 1.0 - MIXED
    if found is None or turned:
        return None
    return found, place


def _rank(block: Float[np.ndarray, "s k"]) -> int | None:
    """Number of rows that lie in these columns; None if some lie in them in part."""
    sizes = np.linalg.svd(block, compute_uv=False)
    if np.any((sizes > MIXED) & (sizes < np.sqrt(1.0 - MIXED**2))):
        return None
    return int(np.count_nonzero(sizes > 0.5))


def of_twists(free: Float[np.ndarray, "k 6"], middle: Float[np.ndarray, " 3"]) -> Read | None:
    """From the twists (v, w) about m that are left free; every displacement is a screw (G. Chasles)."""
    v, w = free[:, :3], free[:, 3:]
    U, turning, axes = np.linalg.svd(w)
    turns = int(np.count_nonzero(turning > MIXED))
    U = U.T
    spun, slid = U[:turns] @ free, U[turns:] @ free
    slides = slid[:, :3]
    if len(free) == 1 and turns == 0:
        return _named("line", "fixed", Place(_unit(v[0]), middle))
    if turns == 0 and len(free) == 2:
        return _named("plane", "fixed", Place(_unit(np.cross(*slides)), middle))
    if turns == 0:
        return _named("held-orientation", "fixed", Place(np.array([0.0, 0.0, 1.0]), middle)) if len(free) == 3 else None
    axis = axes[0]
    if turns == 1:
        across = spun[0, :3] / (spun[0, 3:] @ axis)
        foot = middle + np.cross(axis, across)
        if len(free) == 1:
            return _named("screw", "carried", Place(axis, foot, float(across @ axis)))
        along = np.linalg.norm(np.cross(slides, axis), axis=1)
        if len(free) == 2 and along[0] < MIXED * np.linalg.norm(slides[0]):
            return next(k for k in MECHANISM_KINDS if k.name == "sleeve, firm"), Place(axis, foot)
        if len(free) == 3 and np.max(np.abs(slides @ axis)) < MIXED:
            return _named("plane", "about-axis", Place(axis, middle))
        return _named("held-orientation", "about-axis", Place(axis, middle)) if len(free) == 4 else None
    if turns == 3 and len(free) == 3:
        # v_i = w_i x (m - c) for all three
        M = np.concatenate([skew(x) for x in spun[:, 3:]])
        away = np.linalg.lstsq(M, spun[:, :3].reshape(-1), rcond=None)[0]
        return _named("ball", "carried", Place(np.array([0.0, 0.0, 1.0]), middle - away))
    return None


def _named(kind: str, orientation: Orientation, place: Place) -> Read | None:
    found = _kind(kind, orientation)
    return None if found is None else (found, place)


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
    if abs(values[order[0]]) > MIXED * abs(values[order[1]]) or abs(values[order[1]] - values[order[2]]) > MIXED * abs(
        values[order[2]]
    ):
        return None
    axis, size = vectors[:, order[0]], float(values[order[1:]].mean())
    point = middle - (foot - (foot @ axis) * axis) / size
    if len(selection) == 1:
        return _named("other", "free", Place(axis, point))
    if len(selection) != 2 or sizes[0] < MIXED:
        return None
    # the other row is that of rho^2 a - h a x (p - c)
    T = np.tensordot(U[:, 0], B, axes=1)
    turn = 0.5 * np.array([T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]])
    square = float(np.mean(np.sum(np.cross(p - point, axis) ** 2, axis=1)))
    return _named("screw", "free", Place(axis, point, square * float(turn @ axis) / float(U[:, 0] @ n @ axis)))


def _unit(x: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    return x / np.linalg.norm(x)
