"""Rows that constrain the orientation of the hand as well as its position, its grip, and the rows in selected axes.

The search uses the position of the hand. A mechanism may also rotate the hand, keep its orientation, or leave it free:
the orientations in the stretches that were found tell which. Where the position does not move about an axis (a knob, a
peg), the rows of the whole twist are fitted to displacements instead. Nothing is searched twice, and rotation is never
compared with translation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import AXES, PoseRows
from manip_learn.constraint.features.mechanism_rows import MechanismRows, PlaceForm, PlaceRows
from manip_learn.constraint.mechanism import KINDS, MECHANISM_KINDS, MIXED, ON_THE_AXIS, MechanismKind
from manip_learn.constraint.place import across
from manip_learn.learning.fit import Motion, RowFit
from manip_learn.learning.place import Placed, kind_of, movable
from manip_learn.learning.table import CLEAR_GAP, OVER_NOISE, WEAK_GAP, View
from manip_learn.linalg import null_basis, orthonormal_rows, pivoted_rows
from manip_learn.recordings.trajectory import evenly

# [deg] RMS orientation of a firmly held hand about the mechanism: grips of a weld in simulation give way by 0.03
# to 1.5, hands kept straight by habit by 1.6 to 5
GIVES_WAY = 1.5
KEPT = OVER_NOISE * GIVES_WAY  # above which a hand was free to turn: loose grips reach 5.9 to 30


def whole_fit(
    views: Sequence[View], place: RowFit, believed: Callable[[RowFit, View], bool]
) -> tuple[RowFit, View] | None:
    """Return the rows of the whole twist that constrain the hand, more than those of its position; None if loose.

    They are rows of a mechanism, or else clear and accepted; they constrain the orientation as well as a grip does, and
    the position with no fewer rows than were found. Of these, the rows with the largest gap between the displacements
    along them and along free directions are returned.

    Args:
        views: Views of the whole twist.
        place: Fit of the rows that constrain the position of the hand.
        believed: Function of a fit and a view: True if the recordings show that all rows are constrained.
    """
    best, largest = None, (False, WEAK_GAP)
    J, few = place.motion.hand.batch(place.motion.x), evenly(len(place.motion.x), 50)
    for view in views:
        motion = place.motion.seen_as(view.features, view.W)
        levels = np.append(motion.least[0], 1.0)
        for s in range(view.largest, len(place.rows), -1):
            gap = float(levels[s] / max(levels[s - 1], 1e-12))
            if gap <= WEAK_GAP or (True, gap) <= largest:
                continue
            fit = RowFit(motion, orthonormal_rows(motion.least[1][:s])).best()
            turned = np.sum(np.einsum("nij,nj->ni", J[:, 3:], fit.shortest_way_back()) ** 2, axis=1)
            away = np.degrees(np.median([np.sqrt(np.mean(turned[p])) for p in motion.parts]))
            free = (x @ null_basis(A) for x, A in zip(J[few, :3], fit.rows @ motion.Phi[few], strict=True))
            moves = [np.count_nonzero(np.linalg.svd(x, compute_uv=False) > ON_THE_AXIS) for x in free]
            if away > gives_way(motion, gap) or 3 - int(np.median(moves)) < len(place.rows):
                continue
            named = kind_of(fit, view) is not None
            if (named, gap) > largest and (named or (gap > CLEAR_GAP and believed(fit, view))):
                best, largest = (fit, view), (named, gap)
    return best


def held_kind(known: Placed, motion: Motion) -> tuple[MechanismKind, float, float]:
    """Return the kind of mechanism with the orientation that it constrains, and how well the orientation is kept.

    Args:
        known: Mechanism that constrains the position of the hand.
        motion: Contacts.

    Returns:
        The kind with the most rows from which the hand deviates by no more than a grip gives way; the known one if
        there is none. The smallest RMS deviation of the orientation from one that is fixed or carried by the mechanism,
        and that by independent joints [deg], medians of the contacts.
    """
    seen = [_turned(known, motion.hand.poses(motion.x[p])) for p in motion.parts]
    rms = {name: float(np.median([x[name] for x in seen])) for name in seen[0]}
    kept, apart = min(rms["fixed"], rms.get("carried", np.inf)), motion.turned_by_joints
    kinds = [k for k in MECHANISM_KINDS if k.type == known.kind.type and len(k.rows) > len(known.kind.rows)]
    firm = [k for k in kinds if rms.get(k.orientation, np.inf) <= gives_way(motion)]
    firm = [k for k in firm if k.orientation != "about-axis" or kept > KEPT]
    return max(firm, key=lambda k: (len(k.rows), -rms[k.orientation]), default=known.kind), kept, apart


def gives_way(motion: Motion, gap: float = 0.0) -> float:
    """Return the largest RMS rotation of a hand in a firm grip, far less than by independent joints [deg].

    Where the gap is clear, the latter alone counts.
    """
    return min(GIVES_WAY if gap < CLEAR_GAP else np.inf, motion.turned_by_joints / CLEAR_GAP)


def _turned(known: Placed, T: Float[np.ndarray, "T 4 4"]) -> dict[str, float]:
    """Return the RMS rotation of the hand from each orientation that a mechanism may constrain [deg]."""
    rotation, place = Rotation.from_matrix(T[:, :3, :3]), known.place
    away, turns, directions = T[:, :3, 3] - place.point, {"fixed": rotation}, dict[str, np.ndarray]()
    if known.kind.type == "ball":
        directions["carried"] = rotation.inv().apply(-away)
    elif known.kind.type != "line":
        directions["about-axis"] = rotation.inv().apply(place.axis)
    if known.kind.type in ("hinge", "screw", "other"):
        sides = across(place.axis)
        angle = np.unwrap(np.arctan2(away @ sides[1], away @ sides[0]))
        turns["carried"] = Rotation.from_rotvec(-angle[:, None] * place.axis) * rotation
    out = {name: (turn * turn.mean().inv()).magnitude() for name, turn in turns.items()}
    for name, vectors in directions.items():
        units = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        mean = units.mean(axis=0)
        out[name] = np.arccos(np.clip(units @ mean / np.linalg.norm(mean), -1.0, 1.0))
    return {name: float(np.degrees(np.sqrt(np.mean(angles**2)))) for name, angles in out.items()}


def asked_rows(
    features: FeatureMap, selection: np.ndarray, known: Placed | None, asked: Sequence[FeatureMap], q: np.ndarray
) -> tuple[FeatureMap, Float[np.ndarray, "k r"]]:
    """Return the rows in the requested axes: combinations x Lambda with no share in other columns; else all.

    Args:
        features: Phi of all rows that constrain the hand.
        selection: shape (s, p), their Lambda.
        known: Mechanism, or None.
        asked: Requested feature maps.
        q: shape (n, nq), postures.

    Returns:
        Phi and Lambda.
    """
    poses, names = [f for f in asked if isinstance(f, PoseRows)], {n for f in asked for n in f.row_names}
    if isinstance(features, MechanismRows) and known is not None and names == set(AXES[:3]):
        own, radius = KINDS[known.kind.kind, "free"].rows, known.mechanism.radius
        if len(poses) == len(asked) and (radius is None or radius >= ON_THE_AXIS):
            features = movable(features.with_rows(own, None if known.kind.type == "screw" else radius), q)
            return features, np.eye(features.n_rows)
    if len(poses) < len(asked) or not isinstance(features, PoseRows | PlaceRows):
        return features, selection
    columns = features.row_names

    def inside(kept: Sequence[str]) -> np.ndarray:
        """Return the rows with no share in other columns."""
        own = np.array([n in kept for n in columns])
        _, sigma, Vt = np.linalg.svd(selection[:, ~own].T)
        return Vt[np.append(sigma, np.zeros(len(selection) - len(sigma))) < MIXED] @ (selection * own)

    own_axes = isinstance(features, PoseRows) and features.own_axes
    given: FeatureMap | None = next((f for f in poses if f.own_axes == own_axes), None)
    rows = inside(given.row_names if given is not None else ())
    if isinstance(features, PlaceRows) and features.form != "twist":
        form: PlaceForm = "point" if names <= set(AXES[:3]) else "point and rotation"
        wide = PlaceRows(features.robot, features.frame.name, form, features.middle, **features.twist.seen_from)
        if len(among := inside(wide.row_names)) > len(rows):
            given, rows = (features if form == features.form else wide), among
    if given is None or given is features or not len(rows):
        return features, selection
    return given, pivoted_rows(rows) @ np.array([[column == n for n in given.row_names] for column in columns])
