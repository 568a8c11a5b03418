"""What Lambda says of a mechanism: the motions that one leaves free are a constant space of twists.

The lower pairs of a machine are the subgroups of SE(3); the kind, the axis and the pitch of a mechanism are therefore
read from Lambda itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.mechanism import MECHANISM_KINDS, Mechanism, MechanismKind, Z
from manip_learn.constraint.place import AXES, Place
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
KINDS = {(kind.kind, kind.orientation): kind for kind in MECHANISM_KINDS}


def on_twist(
    names: Sequence[str], rows: Float[np.ndarray, "s p"], *, distance: bool = False
) -> Float[np.ndarray, "s k"]:
    """Rows of some of (v, w) as rows of all six, or of [v; (p - m).v; w] with no share of the distance."""
    out = np.zeros((len(rows), len(AXES) + distance))
    for name, column in zip(names, rows.T, strict=True):
        out[:, AXES.index(name) + (distance and AXES.index(name) > 2)] = column
    return out


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
    if held is None or turns is None or turns == 1 or (held > 2 and turns != 2):
        return None
    free = np.linalg.svd(turning)[2][2] if turns == 2 else Z
    if held > 2:  # the hand's own place rests, and it turns about an axis there: a knob
        return KINDS["hinge", "carried"], Place(free, middle)
    rows = np.linalg.svd(position)[2][:held]
    normals, distances = rows[:, :3], rows[:, 3]
    far = float(np.linalg.norm(distances)) * FARTHEST_START < 1.0
    axis = free if held == 0 else normals[0]
    if held == 2:
        axis = np.cross(*normals) if far else distances[1] * normals[0] - distances[0] * normals[1]
    place = Place(_unit(axis), middle if far else middle - distances @ normals / float(distances @ distances))
    name = ("space", "plane" if far else "ball", "line" if far else "hinge")[held]
    found = KINDS.get((name, {0: "free", 2: "about-axis", 3: "fixed"}[turns]))
    turned = aligned and turns == 2 and abs(float(free @ place.axis)) < 1.0 - MIXED
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
            return KINDS["line", "fixed"], Place(_unit(free[0, :3]), middle)
        case 0, 2:
            return KINDS["plane", "fixed"], Place(_unit(np.cross(*slides)), middle)
        case 0, 3:
            return KINDS["space", "fixed"], Place(Z, middle)
        case 1, (1 | 2):
            across = spun[0, :3] / (spun[0, 3:] @ axis)
            foot = middle + np.cross(axis, across)
            if len(slides) == 0:
                return KINDS["screw", "carried"], Place(axis, foot, float(across @ axis))
            if np.linalg.norm(np.cross(slides[0], axis)) < MIXED * np.linalg.norm(slides[0]):
                return KINDS["cylinder", "carried"], Place(axis, foot)
        case 1, 3 if np.max(np.abs(slides @ axis)) < MIXED:
            return KINDS["plane", "about-axis"], Place(axis, middle)
        case 1, 4:
            return KINDS["space", "about-axis"], Place(axis, middle)
        case 3, 3:  # v_i = w_i x (m - c) for all three
            levers = np.concatenate([skew(x) for x in spun[:, 3:]])
            away = np.linalg.lstsq(levers, spun[:, :3].reshape(-1), rcond=None)[0]
            return KINDS["ball", "carried"], Place(Z, middle - away)
    return None


def of_surface(
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
    if abs(along) >= MIXED * abs(one) or abs(one - other) > MIXED * abs(other):
        return None
    axis, size = vectors[:, order[0]], 0.5 * float(one + other)
    point = middle - (foot - (foot @ axis) * axis) / size
    if len(selection) == 1:
        return KINDS["cylinder", "free"], Place(axis, point)
    if len(selection) != 2 or sizes[0] < MIXED:
        return None
    # the other row is that of rho^2 a - h a x (p - c)
    T = np.tensordot(U[:, 0], B, axes=1)
    turn = 0.5 * np.array([T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]])
    square = float(np.mean(np.sum(np.cross(p - point, axis) ** 2, axis=1)))
    return KINDS["screw", "free"], Place(axis, point, square * float(turn @ axis) / float(U[:, 0] @ n @ axis))


def _unit(x: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    return x / np.linalg.norm(x)


def hinge_or_screw(read: Read, hand: Float[np.ndarray, " 3"], learnt: Mapping[str, Any]) -> Read:
    """Return a hinge for the twist of a firm grip, unless it travels more than three standard deviations of its angle.

    Args:
        read: Kind and place.
        hand: A place of the hand [m].
        learnt: What is known of how Lambda was learnt: the error of its rows.
    """
    kind, place = read
    angle, radius = learnt.get("uncertainty_deg"), float(np.linalg.norm(place.point - hand))
    spread = math.radians(angle) if isinstance(angle, int | float) else 0.0
    if kind != KINDS["screw", "carried"] or abs(place.pitch) >= max(
        LEAST_PITCH, 3.0 * spread * math.hypot(1.0, radius)
    ):
        return read
    return KINDS["hinge", "carried"], place


def as_learnt(read: Mechanism, learnt: Mapping[str, Any]) -> Mechanism:
    """Return the mechanism that was fitted to positions, with place and uncertainty, if it is the one that Lambda says.

    Args:
        read: The mechanism that was read from Lambda.
        learnt: What is known of how Lambda was learnt, empty if it was not.
    """
    try:
        known = Mechanism.from_dict(learnt["mechanism"])
    except (KeyError, TypeError, ValueError):
        return read  # none, or of another version, or damaged: Lambda has said what it says
    same = known.type == read.type and (known.orientation == read.orientation or "whole" in learnt)
    if same and known.axis is not None and read.axis is not None:
        same = known.axis.shape == (3,) and abs(float(known.axis @ read.axis)) > SAME_AXIS * np.linalg.norm(known.axis)
    return known if same else read
