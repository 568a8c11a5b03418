"""A motion along what a constraint leaves free: a straight way, as a mechanism turns, or a path on a surface."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.curve_rows import CurveRows
from manip_learn.constraint.features.feature_map import sum_in_words
from manip_learn.constraint.features.frame_jacobian import AXES, PoseRows, pose_error
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.mechanism import ON_THE_AXIS
from manip_learn.constraint.place import Place, across
from manip_learn.constraint.shown import Shown, Unit
from manip_learn.control.tasks.motion_profile import PathProfile
from manip_learn.errors import ConstraintError, TargetError, advice
from manip_learn.linalg import along_axes, complement_rows, finite
from manip_learn.robot.rotations import left_jacobian, left_jacobian_inverse, rotation_matrix, rotation_vector, skew

Origin = Float[np.ndarray, "..."]  # a pose (4, 4), or coordinates of the features (p,)
# an error along p rows [m or rad], its rate per unit rate of the distance at a frame that stands still, what makes
# velocities of the features of the rates of coordinates, and E of `Task.error_jacobian`, None where that is A(q)
MovingError = tuple[np.ndarray, np.ndarray, np.ndarray | float, np.ndarray | None]
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


class DrivenMotion(ABC):
    """A free direction, driven; the constrained rows are held at their values at the start.

    Attributes of every child:
        constraint: The constrained rows and the driven one.
        unit: `"m"` or `"rad"`, of distances along the motion.
        held: shape (k, p), the constrained rows, and
        driven: shape (p,), what a unit of distance adds to the features' coordinates; of a motion for which these are
            the same all along.
    """

    constraint: Constraint
    unit: Unit
    held: Float[np.ndarray, "k p"]
    driven: Float[np.ndarray, " p"]

    def held_at(self, distance: float) -> Float[np.ndarray, "k p"]:
        """Return the constrained rows, at a distance."""
        return self.held

    def driven_at(self, distance: float) -> Float[np.ndarray, " p"]:
        """Return what a unit of distance adds to the features' coordinates, at a distance."""
        return self.driven

    @abstractmethod
    def axis_at(self, origin: Origin) -> Float[np.ndarray, " 3"]:
        """Direction in which the hand goes, or axis about which it turns, at the beginning: in the base frame."""

    def origin(self, q: ArrayLike) -> Origin:
        """Return what has to be known of the start posture: the pose of the frame, or the features' coordinates."""
        return self.constraint.features.twist.pose(q)

    @abstractmethod
    def goal(self, origin: Origin, distance: float) -> Origin:
        """Where the frame is after a distance: a pose (4, 4), or numbers for the features' rows (p,)."""

    def error(self, origin: Origin, q: ArrayLike, distance: float) -> Float[np.ndarray, " p"]:
        """Return how far the coordinates of posture q are from where they should be after a distance [m or rad]."""
        return self.moving_error(origin, q, distance)[0]

    @abstractmethod
    def moving_error(self, origin: Origin, q: ArrayLike, distance: float) -> MovingError:
        """The error, its rate while the goal moves, the scale of its rates, and E (see `MovingError`)."""

    def progress(self, origin: Origin, q: ArrayLike, near: float) -> float:
        """How far posture q is from the start [m or rad]; of angles a turn apart the one next to `near`."""
        return near - self._lag(self.error(origin, q, near), near)

    def deviation(self, origin: Origin, q: ArrayLike, distance: float) -> Float[np.ndarray, " k"]:
        """How far the constrained coordinates are from where they are held [m or rad], at that distance."""
        return self.held_at(distance) @ self.error(origin, q, distance)

    def rates_and_jacobian(
        self, origin: Origin, q: ArrayLike, place: float, rate: float, gain: float
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "s nv"] | None]:
        """Velocities wanted of the features of `constraint`; E of `Task.error_jacobian`, None where that is A(q).

        Args:
            origin: Where the motion begins.
            q: Posture.
            place: How far along the motion the hand is [m or rad].
            rate: At which it is to go on [m/s or rad/s].
            gain: Rate at which what is off the motion there is taken back [1/s].
        """
        error, along, scale, E = self.moving_error(origin, q, place)
        off = error - self._lag(error, place) * self.driven_at(place)
        return scale * (along * rate + gain * off), E

    def driven_row(self, place: float) -> Float[np.ndarray, "1 s"]:
        """The combination of the rows of `constraint` that is driven, of unit length."""
        row = self.constraint.selection.dot(self.driven_at(place))
        return row[None] / math.sqrt(row.dot(row))

    def _lag(self, error: Float[np.ndarray, " p"], distance: float) -> float:
        driven = self.driven_at(distance)
        return float(driven.dot(error)) / float(driven.dot(driven))

    def placed(self, here: Origin, place: Float[np.ndarray, " 3"], orientation: np.ndarray | None = None) -> Origin:
        """The origin of a hand at another place [m], turned as here where no orientation is given."""
        out = here.copy()
        if out.ndim == 1:
            names = self.constraint.features.row_names
            out[:] = [place[AXES.index(name)] for name in names]
            return out
        out[:3, 3] = place
        if orientation is not None:
            out[:3, :3] = orientation
        return out


def between(start: Origin, end: Origin, share: float) -> Origin:
    """An origin on the straight way from one to another; of poses the hand turns evenly meanwhile."""
    out = start.copy()
    if start.ndim == 1:
        return out + share * (end - start)
    out[:3, 3] += share * (end[:3, 3] - start[:3, 3])
    turn = end[:3, :3] @ start[:3, :3].T
    if not np.array_equal(end[:3, :3], start[:3, :3]):
        out[:3, :3] = rotation_matrix(share * rotation_vector(turn)) @ start[:3, :3]
    return out


def apart(one: Origin, other: Origin) -> float:
    """Distance of two origins, poses or coordinates [m]."""
    if one.ndim == 2:
        one, other = one[:3, 3], other[:3, 3]
    return float(np.linalg.norm(other - one))


def nearest_turn(angle: float, near: float) -> float:
    """The angle [rad] that is the same but for whole turns and next to another one."""
    return angle + 2.0 * math.pi * round((near - angle) / (2.0 * math.pi))


@final
class StraightMotion(DrivenMotion):
    """Features move along f, a direction that Lambda leaves free: the goal moves with the constant twist f.

    Along the axes of the base p* = p0 + f_lin s and R* = exp([f_rot]x s) R0; along the frame's own axes the goal is
    (p0, R0) exp(f s). Features that are the rate of coordinates r have r* = r0 + f s.

    Args:
        constraint: The learnt constraint, of constant rows.
        direction: Along the features' rows, or three numbers for the linear ones; None where only one is free.
        unit: `"m"` or `"rad"`: a translation or a rotation is meant; None for whatever is free.
        straight: The other free translations stand still too; False leaves them to the null-space policy.

    Raises:
        ConstraintError: Nothing is free, or several directions are and none was named.
        TargetError: The direction has the wrong size, is not finite, or is held.
    """

    def __init__(
        self, constraint: Constraint, direction: ArrayLike | None, unit: Unit | None = None, straight: bool = False
    ):
        features = constraint.features
        angular = np.array([unit == "rad/s" for unit in features.row_units])
        f = _direction(constraint, direction, unit, angular)
        driven = np.vstack([constraint.selection, f])
        if straight:  # the translations beside f, beyond what is held
            linear = np.eye(len(angular))[~angular]
            _, sigma, Vt = np.linalg.svd(linear - linear @ np.linalg.pinv(driven) @ driven)
            driven = np.vstack([constraint.selection, Vt[: int(np.count_nonzero(sigma > 0.5))], f])
        self.constraint = Constraint(driven, features, constraint.provenance)
        linear_size, angular_size = (float(np.linalg.norm(f[part])) for part in (~angular, angular))
        self.unit = "rad" if angular_size > linear_size else "m"
        self.driven = f / max(linear_size, angular_size)  # a distance counts along the larger part
        self.held = constraint.selection
        self._twist = np.zeros(6)
        self._features: PoseRows | None = None
        if isinstance(features, PoseRows) and not features.only_linear:
            self._features = features
            self._rows = [AXES.index(name) for name in features.row_names]
            self._twist[self._rows] = self.driven
            self._own_axes = features.own_axes

    def axis_at(self, origin: Origin) -> Float[np.ndarray, " 3"]:
        """The part of f that counts, in the base frame; zero of features that are no rows of a frame."""
        twist = dict(zip(self.constraint.features.row_names, self.driven, strict=True))
        axis = np.array([twist.get(name, 0.0) for name in (AXES[:3] if self.unit == "m" else AXES[3:])])
        return origin[:3, :3] @ axis if self._features is not None and self._own_axes else axis

    def origin(self, q: ArrayLike) -> Origin:
        """Pose of the frame, or the coordinates."""
        return self.constraint.features.coordinates(q) if self._features is None else self._features.pose(q)

    def goal(self, origin: Origin, distance: float) -> Origin:
        """The pose, or the coordinates, after a distance along f."""
        if self._features is None:
            return origin + distance * self.driven
        v, turn = self._twist[:3] * distance, self._twist[3:] * distance
        goal, turned = np.eye(4), rotation_matrix(turn)
        if self._own_axes:
            goal[:3, :3] = origin[:3, :3] @ turned
            goal[:3, 3] = origin[:3, 3] + origin[:3, :3] @ left_jacobian(turn) @ v
        else:
            goal[:3, :3], goal[:3, 3] = turned @ origin[:3, :3], origin[:3, 3] + v
        return goal

    def error(self, origin: Origin, q: ArrayLike, distance: float) -> Float[np.ndarray, " p"]:
        """From the posture to the goal after a distance."""
        goal = self.goal(origin, distance)
        if self._features is None:
            return goal - self.constraint.features.coordinates(q)
        return pose_error(self._features.pose(q), goal, self._own_axes)[self._rows]

    def moving_error(self, origin: Origin, q: ArrayLike, distance: float) -> MovingError:
        """As for `DrivenMotion`, from one look at the pose."""
        if self._features is None:
            E = self.constraint.features.coordinates_jacobian(q)
            error, along = self.error(origin, q, distance), self.driven
        else:
            goal, pose, along = self.goal(origin, distance), self._features.pose(q), np.empty(6)
            error, E = self._features.error_and_jacobian(goal, q)
            turn, (v, w) = pose_error(pose, goal, self._own_axes)[3:], (self._twist[:3], self._twist[3:])
            along[:3] = pose[:3, :3].T @ goal[:3, :3] @ v if self._own_axes else v
            along[3:] = left_jacobian_inverse(-turn if self._own_axes else turn) @ w
            along = along[self._rows]
        return error, along, 1.0, None if E is None else self.constraint.selection.dot(E)


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
    if direction is None:
        basis = along_axes(free)
        if len(free) > 1:
            words = "; ".join(direction_in_words(row, features.row_names) for row in basis)
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
        words = "; ".join(direction_in_words(row, features.row_names) for row in along_axes(free))
        raise TargetError(f"the constraint holds the direction {given.tolist()}; free is {words}")
    return moved / np.linalg.norm(moved)


def direction_in_words(row: Float[np.ndarray, " p"], names: tuple[str, ...]) -> str:
    """A direction as a sum of rows, e.g. "+0.6 x +0.8 y"."""
    return sum_in_words(row, names, "+.3g", 1e-3)


@final
class MechanismMotion(DrivenMotion):
    """One free row of a mechanism, driven, while each held row keeps the coordinate that it is the rate of.

    Loose rows are the rates of the cylindrical coordinates (rho, phi, z) of the frame's origin about the axis: `radial`
    of rho, `axial` of z, `spherical` of the distance from the centre, `helical` of rho (z - h phi) / sqrt(rho^2 + h^2)
    on its cylinder, and `tangential` rho dphi/dt. Firm rows are those of the hand as a whole, with the rotation
    R R0^T = swing * exp([a]x theta) since the start and the hand's point that was at c, x: `turn` of theta, `turn-1`
    and `turn-2` of the swing, `slide` and `slide-1`, `slide-2` of x, `screw` of a.x - h theta.

    Args:
        constraint: The learnt constraint, of rows of a mechanism.
        direction: Name of the row that is driven; for a ball the axis of the turn in the base frame (right-handed).
        unit: `"m"` or `"rad"`: a row that slides or one that turns is meant; None for whatever is free.
        straight: The other free places of the hand's origin stand still too, so that it stays on one circle or on one
            line; False leaves them to the null-space policy.

    Raises:
        ConstraintError: Nothing is free, several are and none was named, or combinations of rows are held.
        TargetError: A direction that is not free, or no direction.
    """

    def __init__(
        self,
        constraint: Constraint,
        direction: ArrayLike | str | None,
        unit: Unit | None = None,
        straight: bool = False,
    ):
        rows: MechanismRows = constraint.features  # type: ignore[assignment]
        g = rows.geometry
        weights = constraint.selection.T @ constraint.selection
        if np.max(np.abs(weights - np.round(weights))) > 1e-9:
            raise ConstraintError(
                f"the constraint holds combinations of the rows {' '.join(rows.row_names)}: FreeDirection needs each "
                "of them to be held as it is, or not at all"
            )
        held = tuple(name for name, weight in zip(rows.row_names, np.diag(weights), strict=True) if weight > 0.5)
        firm = any(name.startswith("slide") or name == "screw" for name in held)
        axis = g.axis
        if "spherical" in held or {"slide", "slide-1", "slide-2"} == set(held):
            if direction is None:
                raise ConstraintError(
                    "a ball leaves turns about every axis free: give the axis in the base frame"
                    + advice(", e.g. {}", "direction=(0, 0, 1)", "--direction 0,0,1")
                )
            turn = finite(direction, 3)
            if turn is None or not turn.any():
                raise TargetError(
                    "the direction of a ball is the axis of the turn, three finite numbers not all zero; "
                    f"got {direction!r}"
                )
            axis, driven = turn, "turn" if firm else "tangential"
        else:
            driven = _chosen(held, firm, direction, unit)
        beside: list[str] = []
        if straight and not firm:
            # a ball and a screw hold a combination of two: with it and the driven one, one is left
            combined = {"spherical": "radial", "helical": "axial"}
            taken = {driven, *held, *(combined[name] for name in held if name in combined)}
            beside = [name for name in ("radial", "axial", "tangential") if name not in taken]
        place = {"axis": axis, "point": g.point, "pitch": g.pitch, **rows.twist.seen_from}
        self._rows = MechanismRows(rows.robot, rows.frame.name, (*held, *beside, driven), **place)
        self.constraint = Constraint(np.eye(self._rows.n_rows), self._rows, constraint.provenance)
        self.unit = "rad" if driven in ("turn", "tangential") else "m"
        self._name = driven
        self.driven, self.held = np.eye(self._rows.n_rows)[-1], np.eye(len(held), self._rows.n_rows)
        self._turns = any(name.startswith(("turn", "slide", "screw")) for name in (*held, driven))

    def axis_at(self, origin: Origin) -> Float[np.ndarray, " 3"]:
        """The axis of the mechanism, or the direction away from it of a hand that is driven there."""
        g = self._rows.geometry
        if self._name != "radial":
            return g.axis
        out = origin[:3, 3] - g.point
        return out - float(g.axis @ out) * g.axis

    def goal(self, origin: Origin, distance: float) -> Origin:
        """Pose of the frame after a distance of the driven row, as on a hand that turns with the mechanism."""
        g, goal = self._rows.geometry, np.eye(4)
        turned, moved = (distance, 0.0) if self.unit == "rad" else (0.0, distance)
        if self.unit == "rad" and {"screw", "helical"} & set(self._rows.row_names):
            moved = g.pitch * distance
        turn, way = rotation_matrix(turned * g.axis), self.axis_at(origin)
        goal[:3, :3] = turn @ origin[:3, :3]
        goal[:3, 3] = g.point + turn @ (origin[:3, 3] - g.point) + moved * way / np.linalg.norm(way)
        return goal

    def moving_error(self, origin: Origin, q: ArrayLike, distance: float) -> MovingError:
        """As for `DrivenMotion`: each row's coordinate is to be as at the start, the driven one at the distance.

        `tangential` is a speed, its coordinate an angle.
        """
        pose, g, names = self.origin(q), self._rows.geometry, self._rows.row_names
        # only what is driven goes beyond half a turn: angles are next to the distance
        turned, around = (distance if self._name == name else 0.0 for name in ("turn", "tangential"))
        now = place_about(origin[:3, 3] - g.point, pose[:3, 3] - g.point, g, around)
        now |= _hand(origin, pose, g, turned) if self._turns else {}
        scale = np.array([now["distance from the axis"] if name == "tangential" else 1.0 for name in names])
        return distance * self.driven - np.array([now[name] for name in names]), self.driven, scale, None


def place_about(d0: np.ndarray, d: np.ndarray, g: Place, near: float) -> dict[str, float]:
    """Of the frame's origin, from its places about the point of the axis at the start and now."""
    a = g.axis
    z0, z = float(a @ d0), float(a @ d)
    x0, x = d0 - z0 * a, d - z * a
    rho0, rho = math.sqrt(x0 @ x0), math.sqrt(x @ x)
    phi = nearest_turn(math.atan2(float(x @ (skew(a) @ x0)), float(x0 @ x)), near)
    size = math.hypot(rho, g.pitch)
    return {
        "tangential": phi,
        "radial": rho - rho0,
        "axial": z - z0,
        "spherical": math.sqrt(d @ d) - math.sqrt(d0 @ d0),
        "helical": rho / size * (z - z0 - g.pitch * phi) if size > 0.0 else 0.0,
        "distance from the axis": rho,
    }


def _hand(start: np.ndarray, pose: np.ndarray, g: Place, near: float) -> dict[str, float]:
    """Of the hand as a whole, from its poses at the start and now."""
    Q, a = pose[:3, :3] @ start[:3, :3].T, g.axis
    r = rotation_vector(Q)
    angle = math.sqrt(r @ r)
    along = math.sin(0.5 * angle) * float(a @ r) / angle if angle > 0.0 else 0.0
    theta = 2.0 * math.atan2(along, math.cos(0.5 * angle))
    swing = rotation_vector(Q @ rotation_matrix(-theta * a))
    theta = nearest_turn(theta, near)
    x = pose[:3, 3] + Q @ (g.point - start[:3, 3]) - g.point
    return {
        "turn": theta,
        "turn-1": float(g.across[0] @ swing),
        "turn-2": float(g.across[1] @ swing),
        "slide": float(a @ x),
        "slide-1": float(g.across[0] @ x),
        "slide-2": float(g.across[1] @ x),
        "screw": float(a @ x) - g.pitch * theta,
    }


def _chosen(held: tuple[str, ...], firm: bool, direction: ArrayLike | str | None, unit: Unit | None) -> str:
    taken = {*held, "slide" if "screw" in held else "", "axial" if "helical" in held else ""}
    names = ("turn", "slide") if firm else ("tangential", "axial", "radial")
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


@final
class CurveMotion(DrivenMotion):
    """The hand goes along a curve, as far off it as where it began, and keeps its orientation where that is held.

    Raises:
        ConstraintError: A turn is asked for.
        TargetError: A direction is named.
    """

    def __init__(self, constraint: Constraint, direction: ArrayLike | str | None, unit: Unit | None = None):
        rows: CurveRows = constraint.features  # type: ignore[assignment]
        if unit == "rad":
            raise ConstraintError("a hand on a curve goes along it and does not turn about anything: say how far [m]")
        if direction is not None:
            raise TargetError(f"on a curve the hand goes forth, or back by a negative way: leave {direction!r} out")
        held = tuple(name for name in rows.row_names if name != "along")
        self._rows, self.unit, selection = rows.with_rows((*held, "along")), "m", np.eye(len(held) + 1)
        self.constraint = Constraint(selection, self._rows, constraint.provenance)
        self.held, self.driven = selection[:-1], selection[-1]

    def axis_at(self, origin: Origin) -> Float[np.ndarray, " 3"]:
        """The curve's direction next to the hand."""
        return self._rows.curve.tangents(origin[None, :3, 3])[0]

    def goal(self, origin: Origin, distance: float) -> Origin:
        """The pose so far along the curve."""
        out = origin.copy()
        out[:3, 3] = self._rows.curve.along(origin[:3, 3], distance)
        return out

    def progress(self, origin: Origin, q: ArrayLike, near: float) -> float:
        """How much farther along the curve the hand is."""
        begin, now = self._rows.curve.nearest(np.stack([origin[:3, 3], self.origin(q)[:3, 3]]))
        return float(now - begin)

    def error(self, origin: Origin, q: ArrayLike, distance: float) -> Float[np.ndarray, " p"]:
        """From the posture to the goal after a distance, along the rows where the hand is."""
        pose = self.origin(q)
        return self._rows.weights(pose[None, :3, 3])[0][0] @ pose_error(pose, self.goal(origin, distance), False)

    def moving_error(self, origin: Origin, q: ArrayLike, distance: float) -> MovingError:
        """As for `DrivenMotion`."""
        return self.error(origin, q, distance), self.driven, 1.0, None


@final
class PathMotion(DrivenMotion):
    """The hand's place goes along a path that was shown on a surface; what the constraint holds of it stays held.

    The rows are the hand's velocity along the base's axes, and those of its rotation that are held.

    Raises:
        ConstraintError: Features that are not rows of one frame; a hand that turns where its place rests.
    """

    def __init__(self, constraint: Constraint, shown: Shown):
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
        self._features = twist.with_axes(AXES if len(turning) else AXES[:3])
        self._p = self._features.n_rows
        selection = block_diag(np.eye(3), turning[:, : self._p - 3])
        self.constraint = Constraint(selection, self._features, constraint.provenance)
        self.unit = "m"
        ways = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(shown.points, axis=0), axis=1))])
        moves = np.concatenate([[True], np.diff(ways) > 1e-9])
        self._ways, self._times, self._points = ways[moves], shown.time[moves], shown.points[moves]
        self._turns = np.array([shown.coordinates.turn(c) for c in shown.path[moves]])
        self._carried = orientation == "carried"
        self._tangents = np.gradient(self._points, self._ways, axis=0)
        self._normals = [complement_rows(shown.coordinates.directions(point)) for point in self._points]

    def profile(self, ramp: float) -> PathProfile:
        """The way in time, as it was shown."""
        return PathProfile(self._times, self._ways, float(self._ways[-1]), ramp)

    def _at(self, table: Float[np.ndarray, "k n"], distance: float) -> Float[np.ndarray, " n"]:
        return np.array([np.interp(distance, self._ways, column) for column in table.T])

    def driven_at(self, distance: float) -> Float[np.ndarray, " p"]:
        """Along the path, and the turning of a hand that is carried."""
        out = np.zeros(self._p)
        out[:3] = self._at(self._tangents, distance)
        if self._carried:
            step = float(self._ways[-1]) / len(self._ways)
            before, after = (rotation_matrix(self._at(self._turns, distance + x)) for x in (-step, step))
            out[3:] = rotation_vector(after @ before.T) / (2.0 * step)
        return out

    def held_at(self, distance: float) -> Float[np.ndarray, "k p"]:
        """The normals of the surface, and the rotations that are held."""
        normals = self._normals[min(int(np.searchsorted(self._ways, distance)), len(self._ways) - 1)]
        return block_diag(normals, self.constraint.selection[3:, 3:])

    def axis_at(self, origin: Origin) -> Float[np.ndarray, " 3"]:
        """The path's first direction."""
        return self._tangents[0]

    def goal(self, origin: Origin, distance: float) -> Origin:
        """The pose after a distance along the path, wherever the hand began; straight on before and after it."""
        out, beyond = origin.copy(), distance - min(max(distance, 0.0), float(self._ways[-1]))
        out[:3, 3] = self._at(self._points, distance) + beyond * self._at(self._tangents, distance)
        if self._carried:
            out[:3, :3] = rotation_matrix(self._at(self._turns, distance)) @ origin[:3, :3]
        return out

    def progress(self, origin: Origin, q: ArrayLike, near: float) -> float:
        """The place of the path next to the hand, of those less than 2 cm along it from `near`: it may cross itself."""
        some = np.flatnonzero(np.abs(self._ways - near) <= _BESIDE)
        if not len(some):
            return super().progress(origin, q, near)
        hand = self.origin(q)[:3, 3]
        off = np.linalg.norm(self._points[some] - hand, axis=1) + _AHEAD * np.abs(self._ways[some] - near)
        return super().progress(origin, q, float(self._ways[some[int(np.argmin(off))]]))

    def error(self, origin: Origin, q: ArrayLike, distance: float) -> Float[np.ndarray, " p"]:
        """From the posture to the goal after a distance."""
        return pose_error(self.origin(q), self.goal(origin, distance), False)[: self._p]

    def moving_error(self, origin: Origin, q: ArrayLike, distance: float) -> MovingError:
        """As for `DrivenMotion`."""
        along = self.driven_at(distance)
        if self._p == 3:  # the hand may turn as it likes
            return self.error(origin, q, distance), along, 1.0, None
        error, E = self._features.error_and_jacobian(self.goal(origin, distance), q)
        return error, along, 1.0, None if E is None else self.constraint.selection.dot(E)
