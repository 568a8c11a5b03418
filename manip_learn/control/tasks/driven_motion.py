"""Geometry of a motion along a free direction of a constraint: one coordinate is driven, all others are held.

A chart maps the distance along a motion to poses of the hand, and poses back to distances.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import sum_in_words
from manip_learn.constraint.mechanism import CURVE, Mechanism, kind_of_rows, mechanism_of
from manip_learn.constraint.place import AXES, Chart, Place, across
from manip_learn.constraint.shown import Shown, Unit
from manip_learn.control.tasks.motion_profile import PathProfile
from manip_learn.errors import ConstraintError, TargetError, advice
from manip_learn.linalg import along_axes, complement_rows, finite, unit
from manip_learn.robot.rotations import left_jacobian, pose_error, rotation_matrix, rotation_vector, rotation_vectors

Origin = Float[np.ndarray, "..."]  # a pose (4, 4), or coordinates of the features (p,)
Direction = ArrayLike | str | None  # numbers along rows, the name of a row, or None for the only free direction
ChartAt = Callable[[Origin], Any]  # origin -> chart whose first coordinate is the distance from there
_STILL = np.zeros(3)  # velocity of a screw that does not travel, or does not turn
_LEVER = 0.1  # [m] lever that converts a rotation of the hand into path length: half the length of a hand
_DRIVEN = {  # rows that may be driven, in words
    "turn": "turn (about the axis, with the hand) [rad]",
    "slide": "slide (along the axis) [m]",
    "tangential": "tangential (around the axis) [rad]",
    "axial": "axial (along the axis) [m]",
    "radial": "radial (away from the axis) [m]",
    "along": "along (the curve, forth, or back by a negative way) [m]",
}
# a held row that involves several motions -> the row that it determines
_FIXES = {"spherical": "radial", "helical": "axial", "screw": "slide", "across-1": "radial", "across-2": "tangential"}
_HOW = {"m": "move along", "rad": "turn about", None: "move along"}


def way_in_words(way: float, unit: Unit) -> str:
    """Return the absolute value of a distance or angle with its unit, e.g. `"0.3 m"` or `"60 degrees"`.

    Args:
        way: Distance [m] or angle [rad]; its sign is dropped.
        unit: `"m"` or `"rad"`.
    """
    return f"{abs(way):.3g} m" if unit == "m" else f"{math.degrees(abs(way)):.3g} degrees"


@final
@dataclass(frozen=True, eq=False)
class DrivenMotion:
    """Motion along one free direction of a constraint; the held rows keep their values at the start.

    Attributes:
        held: The learnt constraint.
        constraint: Constraint with the learnt rows, further rows that are held, and the driven row.
        driven: shape (p,), change of the features' coordinates per unit of distance, at the start of the motion.
        unit: Unit of distances along the motion, `"m"` or `"rad"`.
        origin: Function of a posture that returns the pose of the frame (4, 4), or the coordinates (p,) of features
            without a frame.
        chart_at: Function of such a pose or coordinates, the origin of the motion, that returns a `Chart`, or an object
            with the same methods.
        by_row: True if the distance is measured along the driven row instead of by the chart, as for constant rows.
        around: Mechanism with more free directions than this motion; its held rows are the first ones of the
            constraint. None if there is no such mechanism.
    """

    held: Constraint
    constraint: Constraint
    driven: Float[np.ndarray, " p"]
    unit: Unit
    origin: Callable[[ArrayLike], Origin]
    chart_at: ChartAt
    by_row: bool = False
    around: Mechanism | None = None


@final
class Course:
    """Driven motion that starts at a given origin, for evaluating postures along it.

    Args:
        motion: The motion.
        origin: Pose (4, 4) or coordinates (p,) at which the motion starts.
    """

    def __init__(self, motion: DrivenMotion, origin: Origin):
        self.motion, self.origin, self.chart = motion, origin, motion.chart_at(origin)
        self._around = None if motion.around is None else motion.around.at(origin, np.inf)

    def evaluate(self, q: ArrayLike, near: float) -> tuple[float, Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        """Return the hand's distance along the motion, the tangent of the motion, and the deviation from it.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            near: Previous distance [m or rad]; of all angles that differ by full turns, the nearest to it is returned.

        Returns:
            The distance along the motion [m or rad]; the change of the rows (p,) per unit of distance; and the
            deviation (p,) of the rows, in their units.
        """
        here, f = self.motion.origin(q), self.motion.driven
        place = near if self.motion.by_row else float(self.chart.coordinates(here, near)[0])
        error, ahead = self.chart.error(here, (place,)), self.chart.twist((place,), here)[:, 0]
        W = _weights(self.motion.constraint, here, len(error))
        ahead, off = W.dot(ahead), W.dot(error)
        if self.motion.by_row:  # along it the rows are as far off everywhere
            step = float(f.dot(off)) / float(f.dot(f))
            place, off = place + step, off - step * f
        if self._around is not None:
            held_error = self._around.held_error(here)
            off[: len(held_error)] = held_error
        return place, ahead, off

    def deviation(self, q: ArrayLike, distance: float) -> float:
        """Return the deviation of the held rows from their values on the motion, as a norm [m or rad].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            distance: Distance along the motion at which the values are taken [m or rad].
        """
        here, learnt = self.motion.origin(q), self.motion.held
        if self._around is not None:
            return float(np.linalg.norm(self._around.held_error(here)))
        error = self.chart.error(here, (distance,))
        return float(np.linalg.norm(learnt.selection @ _weights(learnt, here, len(error)) @ error))


def _weights(constraint: Constraint, here: Origin, size: int) -> Float[np.ndarray, "p k"]:
    """Return the weights (p, k) of the first k rates of an origin in the rows of the features."""
    features: Any = constraint.features
    return features.weights_at(here[None])[0, :, :size] if here.ndim == 2 else unit(size)


@dataclass(frozen=True, eq=False)
class _Line:
    """Chart of a straight motion, r* = r0 + s f, of coordinates, or of the position of a hand whose orientation is
    free.
    """

    driven: Float[np.ndarray, " k"]
    begin: Origin

    def pose(self, s: tuple[float]) -> Origin:
        """Return the coordinates (p,) at a distance along the motion.

        Args:
            s: The distance, a tuple of one number [m or rad].
        """
        out = self.begin.copy()
        _place(out)[:] += s[0] * self.driven
        return out

    def twist(self, _s: tuple[float], _here: Origin) -> Float[np.ndarray, "k 1"]:
        """Return the tangent of the motion (k, 1), which is the same at all distances.

        Args:
            _s: Not used.
            _here: Not used.
        """
        return self.driven[:, None]

    def error(self, here: Origin, s: tuple[float]) -> Float[np.ndarray, " k"]:
        """Return the deviation of the hand from the motion (k,), in the rows' units.

        Args:
            here: Pose or coordinates of the hand.
            s: The distance along the motion, a tuple of one number [m or rad].
        """
        return _place(here) - _place(self.begin) - s[0] * self.driven

    def heading(self, _pose: Origin) -> Float[np.ndarray, " 6"]:
        """Return the twist of the motion without rotation, shape (6,): the velocity of the position, and three zeros.

        Args:
            _pose: Not used.
        """
        return np.append(self.driven, _STILL)


def _place(origin: Origin) -> Float[np.ndarray, " k"]:
    return origin if origin.ndim == 1 else origin[:3, 3]


def driven_motion(constraint: Constraint, direction: Direction, unit: Unit | None, straight: bool) -> DrivenMotion:
    """Return the motion along a free direction of a constraint.

    Args:
        constraint: The learnt constraint.
        direction: One number per feature row, or three for the linear rows; for a mechanism the name of a free row; for
            a ball joint the axis of the rotation in the base frame (right-handed). None if only one direction is free.
        unit: `"m"` for a translation, `"rad"` for a rotation; None for any free direction.
        straight: True to hold the other free translations, too; False leaves them to the null-space policy.

    Raises:
        ConstraintError: No direction is free, several are free and none was selected, or the constraint holds
            combinations of a mechanism's rows instead of single rows.
        TargetError: The direction has the wrong size, is not finite, or is held.
    """
    features: Any = constraint.features
    if features.curve is not None or features.geometry is not None:
        return _along_row(constraint, direction, unit, straight)
    angular = np.array([unit == "rad/s" for unit in features.row_units])
    f = _direction(constraint, direction, unit, angular)
    rows = np.vstack([constraint.selection, f])
    if straight:  # also hold the free translations other than f
        linear = np.eye(len(angular))[~angular]
        _, sigma, Vt = np.linalg.svd(linear - linear @ rows.T @ rows)
        rows = np.vstack([constraint.selection, Vt[: int(np.count_nonzero(sigma > 0.5))], f])
    sizes = [float(np.linalg.norm(f[part])) for part in (~angular, angular)]
    f = f / max(sizes)  # a distance counts along the larger part
    counts: Unit = "rad" if sizes[1] > sizes[0] else "m"
    driven = (constraint, Constraint(rows, features, constraint.provenance), f, counts)
    if features.twist is None or features.own_axes is None:
        return DrivenMotion(*driven, features.coordinates, partial(_Line, f), by_row=True)
    v, w = np.split(f @ np.eye(6)[[AXES.index(name) for name in features.row_names]], 2)
    line = partial(_Line, v) if features.only_linear else screw(v, spin=w)
    chart_at = partial(_hand_chart, v, w) if features.own_axes else line
    return DrivenMotion(*driven, features.twist.pose, chart_at, by_row=True)


def screw(travel: np.ndarray, turn: np.ndarray = _STILL, spin: np.ndarray = _STILL, **more: Any) -> ChartAt:
    """Return a function of an origin that returns the `Chart` of a screw motion which starts there.

    Args:
        travel: Velocity of the point at the base's origin (3,) [m per unit of distance].
        turn: Rotation of the mechanism (3,) [rad per unit of distance].
        spin: Additional rotation of the hand (3,) [rad per unit of distance].
        **more: Further arguments of `Chart`.
    """
    return partial(Chart, travel=travel[None], turn=turn[None], spin=spin[None], **more)


def _hand_chart(v: np.ndarray, w: np.ndarray, origin: Origin) -> Chart:
    """Return the chart of a hand that moves along its own axes, and turns about them."""
    turn = origin[:3, :3] @ w
    return screw(origin[:3, :3] @ v + np.cross(origin[:3, 3], turn), turn, is_carried=True)(origin)


def _radial_chart(g: Place, origin: Origin) -> Chart:
    """Return the chart of a hand that moves away from an axis."""
    sides = across(g.axis)
    out = sides.T @ (sides @ (origin[:3, 3] - g.point))
    return screw(out / np.linalg.norm(out))(origin)


def _single_direction(free: Any, words: str, python: str, flag: str) -> Any:
    """Return the free direction.

    Raises:
        ConstraintError: There are several.
    """
    if len(free) > 1:
        how = advice(" with {}", f"direction={python}", f"--direction {flag}")
        raise ConstraintError(f"the constraint leaves {len(free)} directions free ({words}): name one{how}")
    return free[0]


def _direction(
    constraint: Constraint, direction: Direction, unit: Unit | None, angular: np.ndarray
) -> Float[np.ndarray, " p"]:
    """Return the free direction along constant rows, shape (p,), of unit length."""
    features, p, free = constraint.features, constraint.features.n_rows, complement_rows(constraint.selection)
    names = features.row_names
    if unit is not None and direction is None:
        # a learnt direction leaks into the other unit by its uncertainty, 0.1 at most; a single twist with both, of a
        # hinge or a screw in the hand's axes, counts as its larger part
        least = math.sqrt(0.5) if len(free) == 1 else 0.995
        U, sigma, _ = np.linalg.svd(free[:, angular == (unit == "rad")])
        free = U.T[: int(np.count_nonzero(sigma > least))] @ free
    if not len(free):
        raise ConstraintError(f"the constraint leaves none of {' '.join(names)} free to {_HOW[unit]}")
    basis = along_axes(free)
    words = "; ".join(sum_in_words(row, names, "+.3g", 1e-3) for row in basis)
    if direction is None:
        return _single_direction(basis, words, "", ",".join(f"{c:.3g}" for c in basis[0]))
    numbers, place = finite(direction, p), finite(direction, 3)
    if place is not None and p > 3 and set(AXES[:3]) <= set(names):
        numbers = place @ [[axis == name for name in names] for axis in AXES[:3]]
    if numbers is None or not numbers.any():
        expected = f"{p} finite numbers ({', '.join(names)}) that are not all zero, or 'shown' or 'back'"
        raise TargetError(f"the direction must be {expected}, got {direction!r}")
    moved = free.T @ (free @ numbers)
    if np.linalg.norm(moved) < 0.1 * np.linalg.norm(numbers):
        raise TargetError(f"the constraint holds the direction {numbers.tolist()}; free is {words}")
    return moved / np.linalg.norm(moved)


def _along_row(constraint: Constraint, direction: Direction, unit: Unit | None, straight: bool) -> DrivenMotion:
    """Return the motion along a free row of a mechanism, or of a curve."""
    rows: Any = constraint.features
    weights = constraint.selection.T @ constraint.selection
    if np.max(np.abs(weights - np.round(weights))) > 1e-9:
        words = f"combinations of the rows {' '.join(rows.row_names)}"
        raise ConstraintError(f"the constraint holds {words}: FreeDirection needs each held as it is, or not at all")
    names_held = [name for name, weight in zip(rows.row_names, np.diag(weights), strict=True) if weight > 0.5]
    if "spherical" in names_held or {"slide", "slide-1", "slide-2"} == {*names_held}:  # a ball turns about any axis
        turn = finite(direction, 3)
        if turn is None or not turn.any():
            axis = advice(", e.g. {}", "direction=(0, 0, 1)", "--direction 0,0,1")
            words = "a ball leaves turns about every axis free: give three numbers not all zero in the base frame"
            raise (ConstraintError if direction is None else TargetError)(f"{words}{axis}; got {direction!r}")
        rows, direction, unit = rows.changed(axis=turn, pitch=0.0), None, "rad"
    g: Place = rows.geometry  # None of a curve
    is_firm = any(name.startswith("slide") or name == "screw" for name in names_held)
    names = ("along",) if g is None else ("turn", "slide") if is_firm else ("tangential", "axial", "radial")
    rest = [name for name in names if name not in {*names_held, *(_FIXES.get(name) for name in names_held)}]
    driven = _free_row(names_held, rest, direction, unit)
    beside = [name for name in rest if name != driven] if straight and not is_firm else []
    kind = None if g is None else kind_of_rows(names_held)
    features = rows.with_rows((*(names_held if kind is None else kind.rows), *beside, driven))
    one = np.eye(features.n_rows)
    counts: Unit = "rad" if "[rad]" in _DRIVEN[driven] else "m"
    if g is None:
        chart_at = partial(Mechanism("other", name=CURVE, curve=rows.curve, orientation="fixed").at, within=np.inf)
    elif counts == "rad":
        pitch = g.pitch if {"screw", "helical"} & {*names_held} else 0.0
        spin = _STILL if "turn" in names_held else g.axis  # a hand that is free to turn about the axis turns with it
        travel = pitch * g.axis + np.cross(g.point, g.axis)
        chart_at = screw(travel, g.axis, spin, is_carried=driven == "turn", centre=g.point)
    else:
        chart_at = partial(_radial_chart, g) if driven == "radial" else screw(g.axis)
    wide = None if kind is None or straight or kind.kind in ("hinge", "screw") else mechanism_of(kind, g, None)
    selected = Constraint(one, features, constraint.provenance)
    return DrivenMotion(constraint, selected, one[-1], counts, features.twist.pose, chart_at, around=wide)


def _free_row(held: list[str], rest: list[str], direction: Direction, unit: Unit | None) -> str:
    """Return the row to drive: the named one, or the only free one of the unit."""
    free = [name for name in rest if unit is None or f"[{unit}]" in _DRIVEN[name]]
    if not free:
        words = f"the mechanism's rows {' '.join(held)} leave nothing free to do so"
        raise ConstraintError(f"the hand does not {_HOW[unit]} anything: {words}")
    words = "; ".join(_DRIVEN[name] for name in free)
    if direction is None:
        return _single_direction(free, words, repr(free[0]), free[0])
    if not (isinstance(direction, str) and direction in free):
        raise TargetError(f"the direction of a mechanism is the name of a row that is free: {words}; got {direction!r}")
    return direction


def along_path(constraint: Constraint, shown: Shown, ramp: float) -> tuple[DrivenMotion, PathProfile]:
    """Return the motion of the hand along a demonstrated path on a surface, and its distance over time.

    The rows of the motion are the hand's velocity along the base's axes, and the constrained rows of its rotation.

    Args:
        constraint: The learnt constraint.
        shown: The demonstrated motion with its path.
        ramp: Time from rest until the path is followed at its demonstrated speed [s].
    """
    twist, mechanism = constraint.features.twist, constraint.mechanism
    turning = np.zeros((0, 3)) if mechanism is None or mechanism.orientation == "free" else np.eye(3)
    if mechanism is not None and mechanism.orientation == "about-axis" and mechanism.axis is not None:
        turning = across(mechanism.axis)
    features = twist.changed(axes=AXES if len(turning) else AXES[:3])
    rows = Constraint(block_diag(np.eye(3), turning[:, : features.n_rows - 3]), features, constraint.provenance)
    poses = shown.poses
    turns = _LEVER * rotation_vectors(poses[:, :3, :3] @ poses[0, :3, :3].T) * (len(turning) > 0)
    places = np.hstack([poses[:, :3, 3], turns])
    ways = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    moves = np.append(True, np.diff(ways) > 1e-9)
    ways, places, times = ways[moves], places[moves], shown.time[moves]
    chart_at = partial(_Path, ways, np.hstack([places, np.gradient(places, ways, axis=0)]))
    driven = chart_at(poses[0]).twist((0.0,), poses[0])[: features.n_rows, 0]
    fastest = float(np.max(np.diff(ways) / np.diff(times))) * min(1.0, float(times[-1]) / ramp)
    profile = PathProfile(float(ways[-1]), fastest, ramp, times, ways)
    return DrivenMotion(constraint, rows, driven, "m", twist.pose, chart_at), profile


@dataclass(frozen=True, eq=False)
class _Path:
    """Chart of a demonstrated path, by its length [m], for a hand that may have another orientation at the beginning.

    A rotation counts as length at a lever, so that the motion continues where the position rests while the hand turns.
    """

    ways: Float[np.ndarray, " k"]
    table: Float[np.ndarray, "k 12"]  # positions, rotation vectors from the beginning times the lever, their tangents
    begin: Float[np.ndarray, "4 4"]

    def _at(self, s: float) -> tuple[Float[np.ndarray, " 6"], Float[np.ndarray, " 6"]]:
        """Return position and rotation from the beginning, and the tangent; straight on before and after the path."""
        row = np.array([np.interp(s, self.ways, column) for column in self.table.T])
        return row[:6] + (s - min(max(s, 0.0), float(self.ways[-1]))) * row[6:], row[6:]

    def pose(self, s: tuple[float]) -> Origin:
        """Return the pose of the hand (4, 4) in the base frame at a distance along the path.

        Args:
            s: The distance along the path, a tuple of one number [m].
        """
        out, (place, _) = self.begin.copy(), self._at(s[0])
        out[:3, 3], out[:3, :3] = place[:3], rotation_matrix(place[3:] / _LEVER) @ out[:3, :3]
        return out

    def coordinates(self, pose: Origin, near: float) -> Float[np.ndarray, " 1"]:
        """Return the distance along the path of its point nearest to the hand.

        Because a path may cross itself, only points less than 2 cm along the path from `near` are considered.

        Args:
            pose: Pose of the hand (4, 4) in the base frame.
            near: Previous distance along the path [m].

        Returns:
            shape (1,) [m].
        """
        turned = _LEVER * rotation_vector(pose[:3, :3] @ self.begin[:3, :3].T) * bool(self.table[:, 3:6].any())
        here, some = np.append(pose[:3, 3], turned), np.flatnonzero(np.abs(self.ways - near) <= 0.02)
        if len(some):
            # a point must be nearer by half of its distance along the path
            off = np.linalg.norm(self.table[some, :6] - here, axis=1) + 0.5 * np.abs(self.ways[some] - near)
            near = float(self.ways[some[int(np.argmin(off))]])
        place, tangent = self._at(near)
        return np.array([near + float((here - place) @ tangent)])

    def twist(self, s: tuple[float], _pose: Origin) -> Float[np.ndarray, "6 1"]:
        """Return the twist of the hand (6, 1) per metre of the path, along the base's axes.

        Args:
            s: The distance along the path, one number [m].
            _pose: Not used.
        """
        place, tangent = self._at(s[0])
        return np.append(tangent[:3], left_jacobian(place[3:] / _LEVER) @ tangent[3:] / _LEVER)[:, None]

    def error(self, pose: Origin, s: tuple[float]) -> Float[np.ndarray, " 6"]:
        """Return the deviation of the hand (6,) from the path along the base's axes [m, rad].

        Args:
            pose: Pose of the hand (4, 4) in the base frame.
            s: The distance along the path, one number [m].
        """
        return -pose_error(pose, self.pose(s), False)
