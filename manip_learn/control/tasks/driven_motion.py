"""A motion along what a constraint leaves free: one coordinate of a chart, driven, while the others are held."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from manip_learn.constraint.chart import Chart
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import sum_in_words
from manip_learn.constraint.features.frame_jacobian import AXES, pose_error
from manip_learn.constraint.mechanism import CURVE, MECHANISM_KINDS, ON_THE_AXIS, Mechanism, mechanism_of
from manip_learn.constraint.place import across
from manip_learn.constraint.shown import Shown, Unit
from manip_learn.control.tasks.motion_profile import PathProfile
from manip_learn.errors import ConstraintError, TargetError, advice
from manip_learn.linalg import along_axes, complement_rows, finite
from manip_learn.robot.rotations import rotation_matrix, rotation_vector, rotation_vectors

Origin = Float[np.ndarray, "..."]  # a pose (4, 4), or coordinates of the features (p,)
_BESIDE = 0.02  # [m] along a path from where a hand should be, within which it is: some strokes of a wipe cross nearer
_AHEAD = 0.1  # of its distance along a path, by which a place must be nearer to the hand to be the one where it is
_FREE = 0.1  # share of a direction that must be free for it to be meant
# share of a direction that is translation, or rotation: a learnt one leaks by its uncertainty, 0.1 at most
_PURE = 0.995
_DRIVEN = {  # what may be driven, in words
    "turn": "turn (about the axis, with the hand) [rad]",
    "slide": "slide (along the axis) [m]",
    "tangential": "tangential (around the axis) [rad]",
    "axial": "axial (along the axis) [m]",
    "radial": "radial (away from the axis) [m]",
}


def way_in_words(way: float, unit: Unit) -> str:
    """The size of a way, e.g. `"0.3 m"` or `"60 degrees"`."""
    return f"{abs(way):.3g} m" if unit == "m" else f"{math.degrees(abs(way)):.3g} degrees"


class DrivenMotion:
    """A free direction, driven; the constrained rows are held at their values at the start.

    Args:
        held: The learnt constraint.
        rows: Its rows, others that stand still, and the driven one.
        driven: shape (p,), what a unit of distance adds to the features' coordinates at the beginning.
        unit: `"m"` or `"rad"`, of distances along the motion.
        course_of: Pose of the frame where the motion begins, or coordinates of features without one -> its course.
    """

    def __init__(
        self,
        held: Constraint,
        rows: Constraint,
        driven: Float[np.ndarray, " p"],
        unit: Unit,
        course_of: Callable[[Origin], Any],
    ):
        self.held, self.constraint, self.driven = held, rows, driven
        self.unit: Unit = unit
        self._course_of, self._ahead = course_of, driven
        self._known: tuple[Origin | None, Any] = (None, None)

    def course(self, origin: Origin) -> Any:
        """Return the course from where the motion begins."""
        if origin is not self._known[0]:
            self._known = origin, self._course_of(origin)
        return self._known[1]

    def origin(self, q: ArrayLike) -> Origin:
        """Return what has to be known of a posture: the pose of the frame, or the features' coordinates."""
        features = self.constraint.features
        return features.coordinates(q) if features.twist is None else features.twist.pose(q)

    def goal(self, origin: Origin, distance: float) -> Origin:
        """Return where the frame is after a distance: a pose (4, 4), or numbers for the features' rows (p,)."""
        return self.course(origin).goal(distance)

    def progress(self, origin: Origin, q: ArrayLike, near: float) -> float:
        """Return how far posture q is from the start [m or rad]; of angles a turn apart the one next to `near`."""
        return self.course(origin).look(q, near)[0]

    def rates(
        self, origin: Origin, q: ArrayLike, near: float, rate_at: Callable[[float], float], gain: float
    ) -> tuple[float, Float[np.ndarray, " s"]]:
        """Return how far the hand has come, and the velocities wanted along the rows of `constraint`.

        Args:
            origin: Where the motion begins.
            q: Posture.
            near: How far the hand was last [m or rad].
            rate_at: How far the hand has come -> rate at which it is to go on [m/s or rad/s].
            gain: Rate at which what is off the motion is taken back [1/s].
        """
        place, self._ahead, off = self.course(origin).look(q, near)
        return place, self.constraint.selection.dot(rate_at(place) * self._ahead - gain * off)

    def driven_row(self) -> Float[np.ndarray, "1 s"]:
        """Return the combination of the rows of `constraint` that was driven last, of unit length."""
        row = self.constraint.selection.dot(self._ahead if self._ahead.any() else self.driven)
        return row[None] / math.sqrt(row.dot(row))

    def deviation(self, origin: Origin, q: ArrayLike, distance: float) -> float:
        """Return how far the held rows are from where they should be after a distance [m or rad]."""
        return float(np.linalg.norm(self.course(origin).held(q, distance, self.held)))

    def jacobian(self, q: ArrayLike) -> Float[np.ndarray, "s nv"] | None:
        """Return E of `Task.error_jacobian`; None where that is A(q)."""
        features = self.constraint.features
        E = features.coordinates_jacobian(q) if features.twist is None else None
        return None if E is None else self.constraint.selection.dot(E)


@final
@dataclass(frozen=True, eq=False)
class OnChart:
    """A frame that goes along the first coordinate of a chart, seen along the rows of its features.

    Attributes:
        features: Rows of the frame's twist.
        chart: A `Chart` of one coordinate, or a path.
        driven: shape (p,), the row that tells the distance, for a direction that both moves and turns; else None.
        around: Chart of all that the mechanism leaves free, where that is more; its held rows are the first ones.
    """

    features: Any
    chart: Any
    driven: Float[np.ndarray, " p"] | None = None
    around: Chart | None = None

    def look(self, q: ArrayLike, near: float) -> tuple[float, Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        """Return how far the hand is, the way ahead along the rows, and how far it is off [m or rad]."""
        pose = self.features.twist.pose(q)
        W = self.features.weights_at(pose[None])[0]
        if self.driven is not None:
            off = W.dot(self.chart.error(pose, (near,)))
            place = near + float(self.driven.dot(off)) / float(self.driven.dot(self.driven))
        else:
            place = float(self.chart.coordinates(pose, near)[0])
        ahead, off = W.dot(self.chart.twist((place,), pose)[:, 0]), W.dot(self.chart.error(pose, (place,)))
        if self.around is not None:
            held = self.around.held_error(pose)
            off[: len(held)] = held
        return place, ahead, off

    def goal(self, distance: float) -> Origin:
        """Return the pose after a distance."""
        return self.chart.pose((distance,))

    def held(self, q: ArrayLike, distance: float, held: Constraint) -> Float[np.ndarray, " h"]:
        """Return how far held rows are off the motion after a distance [m or rad]."""
        pose = self.features.twist.pose(q)
        if self.around is not None:
            return self.around.held_error(pose)
        features: Any = held.features
        return held.selection @ features.weights_at(pose[None])[0] @ self.chart.error(pose, (distance,))


@final
@dataclass(frozen=True, eq=False)
class OnCoordinates:
    """Features that are the rate of coordinates r: r* = r0 + s f. The cheapest, as of a hand on a line that may turn.

    Attributes:
        features: Phi, whose coordinates are r.
        begin: shape (p,), r0.
        f: shape (p,), the direction.
        pose: shape (4, 4), of the frame at the beginning, of the rows x, y and z; None of features without one.
    """

    features: Any
    begin: Float[np.ndarray, " p"]
    f: Float[np.ndarray, " p"]
    pose: Float[np.ndarray, "4 4"] | None = None

    def look(self, q: ArrayLike, near: float) -> tuple[float, Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        """As for `OnChart`."""
        gone = self.features.coordinates(q) - self.begin
        place = float(self.f.dot(gone)) / float(self.f.dot(self.f))
        return place, self.f, gone - place * self.f

    def goal(self, distance: float) -> Origin:
        """As for `OnChart`."""
        if self.pose is None:
            return self.begin + distance * self.f
        out = self.pose.copy()
        out[[AXES.index(name) for name in self.features.row_names], 3] += distance * self.f
        return out

    def held(self, q: ArrayLike, distance: float, held: Constraint) -> Float[np.ndarray, " h"]:
        """As for `OnChart`."""
        return held.selection @ (self.features.coordinates(q) - self.begin - distance * self.f)

    @property
    def chart(self) -> Chart:
        """A chart of the same way."""
        v = self.f @ np.eye(6)[[AXES.index(name) for name in self.features.row_names]]
        return Chart(self.pose, v[None, :3], np.zeros((1, 3)), v[None, 3:])  # type: ignore[arg-type]  # of a frame


def between(start: Origin, end: Origin, share: float) -> Origin:
    """An origin on the straight way from one to another; of poses the hand turns evenly meanwhile."""
    out = start + share * (end - start)
    if start.ndim == 2 and not np.array_equal(end[:3, :3], start[:3, :3]):
        turn = rotation_vector(end[:3, :3] @ start[:3, :3].T)
        out[:3, :3] = rotation_matrix(share * turn) @ start[:3, :3]
    return out


def apart(one: Origin, other: Origin) -> float:
    """Distance of two origins, poses or coordinates [m]."""
    gap = other - one if one.ndim == 1 else other[:3, 3] - one[:3, 3]
    return math.sqrt(gap @ gap)


def driven_motion(
    constraint: Constraint, direction: ArrayLike | str | None, unit: Unit | None = None, straight: bool = False
) -> DrivenMotion:
    """Return the motion along a free direction of a constraint.

    Args:
        constraint: The learnt constraint; rows of a mechanism under their own names.
        direction: Along the features' rows, or three numbers for the linear ones; of a mechanism the name of a row, for
            a ball the axis of the turn in the base frame (right-handed). None where only one is free.
        unit: `"m"` or `"rad"`: a translation or a rotation is meant; None for whatever is free.
        straight: The other free translations stand still too; False leaves them to the null-space policy.

    Raises:
        ConstraintError: Nothing is free, several directions are and none was named, or rows of a mechanism are held in
            combinations.
        TargetError: The direction has the wrong size, is not finite, or is held.
    """
    features: Any = constraint.features
    if features.curve is not None:
        return _along_curve(constraint, direction, unit)
    if features.geometry is not None:
        return _along_mechanism(constraint, direction, unit, straight)
    angular = np.array([unit == "rad/s" for unit in features.row_units])
    f = _direction(constraint, direction, unit, angular)
    rows = np.vstack([constraint.selection, f])
    if straight:  # the translations beside f, beyond what is held
        linear = np.eye(len(angular))[~angular]
        _, sigma, Vt = np.linalg.svd(linear - linear @ np.linalg.pinv(rows) @ rows)
        rows = np.vstack([constraint.selection, Vt[: int(np.count_nonzero(sigma > 0.5))], f])
    sizes = [float(np.linalg.norm(f[part])) for part in (~angular, angular)]
    f, turns = f / max(sizes), sizes[1] > sizes[0]  # a distance counts along the larger part
    counts: Unit = "rad" if turns else "m"
    driven = (constraint, Constraint(rows, features, constraint.provenance), f, counts)
    if features.twist is None or features.own_axes is None:
        return DrivenMotion(*driven, lambda begin: OnCoordinates(features, begin, f))
    rows = [AXES.index(name) for name in features.row_names]
    v, w = np.split(f @ np.eye(6)[rows], 2)

    def course(origin: Origin) -> Any:
        R, p, none = origin[:3, :3], origin[:3, 3], np.zeros((1, 3))
        if max(rows) < 3 and not features.own_axes:
            return OnCoordinates(features, p[rows], f, origin)
        if not features.own_axes:
            return OnChart(features, Chart(origin, v[None], none, w[None]), f)
        turn = R @ w
        travel = R @ v + np.cross(p, turn)
        return OnChart(features, Chart(origin, travel[None], turn[None], none, is_carried=True), f)

    return DrivenMotion(*driven, course)


def _direction(
    constraint: Constraint, direction: ArrayLike | None, unit: Unit | None, angular: np.ndarray
) -> Float[np.ndarray, " p"]:
    features, p, free = constraint.features, constraint.features.n_rows, complement_rows(constraint.selection)
    if not len(free):
        raise ConstraintError(f"the constraint leaves none of {' '.join(features.row_names)} free to move along")
    if unit is not None and direction is None:
        wanted = free[:, angular if unit == "rad" else ~angular]
        U, sigma, _ = np.linalg.svd(wanted)
        pure = U.T[: int(np.count_nonzero(sigma > _PURE))] @ free  # a learnt Lambda leaks a little of the other
        # a single twist that does both, of a hinge or a screw in the hand's axes, counts as what it mostly is
        free = free if not len(pure) and len(free) == 1 and np.sum(wanted**2) > 0.5 else pure
        if not len(free):
            what = "turn about" if unit == "rad" else "move along"
            raise ConstraintError(f"the constraint leaves nothing of {' '.join(features.row_names)} free to {what}")
    basis = along_axes(free)
    words = "; ".join(sum_in_words(row, features.row_names, "+.3g", 1e-3) for row in basis)
    if direction is None:
        if len(free) > 1:
            raise ConstraintError(
                f"the constraint leaves {len(free)} directions free ({words}): say along which one to move"
                + advice(" with {}", "direction=", "--direction " + ",".join(f"{c:.3g}" for c in basis[0]))
            )
        return basis[0]
    given, place = finite(direction, p), finite(direction, 3)
    if place is not None and p > 3 and set(AXES[:3]) <= set(features.row_names):
        given = np.zeros(p)
        given[[features.row_names.index(name) for name in AXES[:3]]] = place
    if given is None or not given.any():
        raise TargetError(
            f"the direction must be {p} finite numbers ({', '.join(features.row_names)}) that are not all zero, "
            f"or 'shown' or 'back', got {direction!r}"
        )
    moved = free.T @ (free @ given)
    if np.linalg.norm(moved) < _FREE * np.linalg.norm(given):
        raise TargetError(f"the constraint holds the direction {given.tolist()}; free is {words}")
    return moved / np.linalg.norm(moved)


def _along_mechanism(
    constraint: Constraint, direction: ArrayLike | str | None, unit: Unit | None, straight: bool
) -> DrivenMotion:
    """Return the motion along a row of a mechanism that is free."""
    rows: Any = constraint.features
    weights = constraint.selection.T @ constraint.selection
    if np.max(np.abs(weights - np.round(weights))) > 1e-9:
        raise ConstraintError(
            f"the constraint holds combinations of the rows {' '.join(rows.row_names)}: FreeDirection needs each "
            "of them to be held as it is, or not at all"
        )
    held = tuple(name for name, weight in zip(rows.row_names, np.diag(weights), strict=True) if weight > 0.5)
    is_firm = any(name.startswith("slide") or name == "screw" for name in held)
    g = rows.geometry
    if "spherical" in held or {"slide", "slide-1", "slide-2"} == set(held):
        if direction is None:
            raise ConstraintError(
                "a ball leaves turns about every axis free: give the axis in the base frame"
                + advice(", e.g. {}", "direction=(0, 0, 1)", "--direction 0,0,1")
            )
        turn = finite(direction, 3)
        if turn is None or not turn.any():
            raise TargetError(
                f"the direction of a ball is the axis of the turn, three finite numbers not all zero; got {direction!r}"
            )
        g, driven = type(g)(turn / np.linalg.norm(turn), g.point), "turn" if is_firm else "tangential"
    else:
        driven = _chosen(held, is_firm, direction, unit)
    beside: list[str] = []
    if straight and not is_firm:
        # a ball and a screw hold a combination of two: with it and the driven one, one is left
        combined = {"spherical": "radial", "helical": "axial"}
        taken = {driven, *held, *(combined[name] for name in held if name in combined)}
        beside = [name for name in ("radial", "axial", "tangential") if name not in taken]
    kind = next((k for k in MECHANISM_KINDS if {*k.rows} == {*held}), None)
    features = rows.about(g).with_rows((*(held if kind is None else kind.rows), *beside, driven))
    one, turns = np.eye(features.n_rows), driven in ("turn", "tangential")
    pitch = g.pitch if {"screw", "helical"} & {*held} else 0.0
    wide = None if kind is None or straight or kind.kind in ("hinge", "screw") else mechanism_of(kind, g, None)

    def course(origin: Origin) -> OnChart:
        out, none = origin[:3, 3] - g.point, np.zeros(3)
        axis = g.axis if driven != "radial" else out - (out @ g.axis) * g.axis
        travel = pitch * axis + np.cross(g.point, axis) if turns else axis / np.linalg.norm(axis)
        turn = axis if turns else none
        spin = none if "turn" in held else turn  # a hand that may turn about the axis turns with it
        screw = (travel[None], turn[None], spin[None])
        chart = Chart(origin, *screw, is_carried=driven == "turn", centre=g.point if turns else None)
        return OnChart(features, chart, around=None if wide is None else wide.at(origin, np.inf))

    selected = Constraint(one, features, constraint.provenance)
    return DrivenMotion(constraint, selected, one[-1], "rad" if turns else "m", course)


def _chosen(held: tuple[str, ...], is_firm: bool, direction: ArrayLike | str | None, unit: Unit | None) -> str:
    taken = {*held, "slide" if "screw" in held else "", "axial" if "helical" in held else ""}
    names = ("turn", "slide") if is_firm else ("tangential", "axial", "radial")
    free = [name for name in names if name not in taken and (unit is None or f"[{unit}]" in _DRIVEN[name])]
    words = "; ".join(_DRIVEN[name] for name in free)
    if not free:
        how = {"m": "move along", "rad": "turn about", None: "move along"}[unit]
        raise ConstraintError(f"the mechanism's rows {' '.join(held)} leave nothing free to {how}")
    if direction is None:
        if len(free) > 1:
            raise ConstraintError(
                f"the mechanism leaves {len(free)} directions free ({words}): say along which one to move"
                + advice(" with {}", f"direction={free[0]!r}", f"--direction {free[0]}")
            )
        return free[0]
    if not (isinstance(direction, str) and direction in free):
        raise TargetError(f"the direction of a mechanism is the name of a row that is free: {words}; got {direction!r}")
    return direction


def _along_curve(constraint: Constraint, direction: ArrayLike | str | None, unit: Unit | None) -> DrivenMotion:
    """Return the motion along a curve, as far off it as where the hand begins."""
    rows: Any = constraint.features
    if unit == "rad":
        raise ConstraintError("a hand on a curve goes along it and does not turn about anything: say how far [m]")
    if direction is not None:
        raise TargetError(f"on a curve the hand goes forth, or back by a negative way: leave {direction!r} out")
    features = rows.with_rows((*(name for name in rows.row_names if name != "along"), "along"))
    one = np.eye(features.n_rows)
    curve = Mechanism("other", name=CURVE, curve=rows.curve, orientation="fixed")
    selected = Constraint(one, features, constraint.provenance)
    return DrivenMotion(constraint, selected, one[-1], "m", lambda origin: OnChart(features, curve.at(origin, np.inf)))


def along_path(constraint: Constraint, shown: Shown, ramp: float) -> tuple[DrivenMotion, PathProfile]:
    """Return the motion of the hand along a path that was shown on a surface, and its way in time.

    The rows are the hand's velocity along the base's axes, and those of its rotation that are held.

    Raises:
        ConstraintError: Features that are not rows of one frame; a hand that turns where its place rests.
    """
    if (twist := constraint.features.twist) is None:
        raise ConstraintError(f"a path is followed with a frame, not with {constraint.features!r}")
    mechanism = constraint.mechanism
    orientation = "free" if mechanism is None else mechanism.orientation
    if mechanism is not None and orientation == "carried" and (mechanism.radius or 0.0) < ON_THE_AXIS:
        slide = advice("{}", "distance=0.05, direction='slide'", "--along 0.05 --direction slide")
        turn = advice("{}", "angle=0.5, direction='turn'", "--turn 30 --direction turn")
        ways = f"{slide} or {turn}" if slide else "`manip-learn control` drives each"
        raise ConstraintError(
            f"the hand turns where its place rests ({mechanism.sentence}), and such a motion is not repeated as it "
            f"was shown: name one of its two ways ({ways})"
        )
    turning = np.zeros((0, 3)) if orientation == "free" else np.eye(3)
    if orientation == "about-axis" and mechanism is not None and mechanism.axis is not None:
        turning = across(mechanism.axis)
    features = twist.with_axes(AXES if len(turning) else AXES[:3])
    rows = Constraint(block_diag(np.eye(3), turning[:, : features.n_rows - 3]), features, constraint.provenance)
    poses = shown.poses
    ways = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)))
    moves = np.append(True, np.diff(ways) > 1e-9)
    path = _Path(ways[moves], poses[moves], poses[0])
    driven = path.twist([0.0], poses[0])[: features.n_rows, 0]
    profile = PathProfile(shown.time[moves], path.ways, float(path.ways[-1]), ramp)
    return DrivenMotion(
        constraint, rows, driven, "m", lambda origin: OnChart(features, replace(path, begin=origin))
    ), profile


@dataclass(frozen=True, eq=False)
class _Path:
    """A path that was shown, by its length [m], gone by a hand that was turned as it likes where it took hold."""

    ways: Float[np.ndarray, " k"]
    poses: Float[np.ndarray, "k 4 4"]
    begin: Float[np.ndarray, "4 4"]

    @cached_property
    def _table(self) -> Float[np.ndarray, "k 9"]:
        """Places, rotation vectors since the beginning, and tangents."""
        places, R = self.poses[:, :3, 3], self.poses[:, :3, :3]
        return np.hstack([places, rotation_vectors(R @ R[0].T), np.gradient(places, self.ways, axis=0)])

    def _at(self, s: float) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
        place, turn, tangent = np.split(np.array([np.interp(s, self.ways, x) for x in self._table.T]), 3)
        return place, rotation_matrix(turn), tangent

    def pose(self, s: ArrayLike) -> Origin:
        """Straight on before and after it."""
        s, out = float(np.asarray(s)[0]), self.begin.copy()
        place, R, tangent = self._at(s)
        out[:3, 3] = place + (s - min(max(s, 0.0), float(self.ways[-1]))) * tangent
        out[:3, :3] = R @ out[:3, :3]
        return out

    def coordinates(self, pose: Origin, near: float) -> Float[np.ndarray, " 1"]:
        """Of the place next to the hand, of those less than 2 cm along it from `near`: a path may cross itself."""
        some = np.flatnonzero(np.abs(self.ways - near) <= _BESIDE)
        if len(some):
            off = np.linalg.norm(self._table[some, :3] - pose[:3, 3], axis=1) + _AHEAD * np.abs(self.ways[some] - near)
            near = float(self.ways[some[int(np.argmin(off))]])
        return near + (pose[:3, 3] - self.pose([near])[:3, 3]) @ self._at(near)[2][:, None]

    def twist(self, s: ArrayLike, pose: Origin) -> Float[np.ndarray, "6 1"]:
        s, step = float(np.asarray(s)[0]), float(self.ways[-1]) / len(self.ways)
        turn = rotation_vector(self._at(s + step)[1] @ self._at(s - step)[1].T)
        return np.append(self._at(s)[2], turn / (2.0 * step))[:, None]

    def error(self, pose: Origin, s: ArrayLike) -> Float[np.ndarray, " 6"]:
        return -pose_error(pose, self.pose(s), False)
