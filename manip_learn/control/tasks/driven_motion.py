"""A motion along one free direction of a constraint: along a straight way, or as a mechanism leaves it free."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal, NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import sum_in_words
from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian, pose_error
from manip_learn.constraint.features.mechanism_rows import MechanismRows, Place
from manip_learn.constraint.features.relative_frame_jacobian import RelativeFrameJacobian
from manip_learn.errors import ConstraintError, TargetError, advice
from manip_learn.linalg import along_axes, complement_rows, finite
from manip_learn.robot.rotations import left_jacobian, left_jacobian_inverse, rotation_matrix, rotation_vector, skew

Unit = Literal["m", "rad"]
Origin = Float[np.ndarray, "..."]  # a pose (4, 4), or coordinates of the features (p,)
# an error along p rows [m or rad], its rate per unit rate of the distance at a frame that stands still, what makes
# velocities of the features of the rates of coordinates, and E of `Task.error_jacobian`, None where that is A(q)
MovingError = tuple[np.ndarray, np.ndarray, np.ndarray | float, np.ndarray | None]
ONE_WAY = 0.5  # share of what lies to one side of where recordings begin, from which on that is the way shown
# [m] a hand this near to where a task was shown is on the mechanism: people take hold of a handle a finger's breadth
# further on, and a constraint file keeps a few postures only
GRIP = 0.02
FREE = 0.1  # share of a direction that must be free for it to be meant
# share of a direction that is translation, or rotation: a learnt one leaks by its uncertainty, 0.1 at most
PURE = 0.995
DRIVEN = {  # what may be driven, in words
    "turn": "turn (about the axis, with the hand) [rad]",
    "slide": "slide (along the axis) [m]",
    "tangential": "tangential (around the axis) [rad]",
    "axial": "axial (along the axis) [m]",
    "radial": "radial (away from the axis) [m]",
}


def way_in_words(way: float, unit: Unit) -> str:
    """The size of a way, e.g. `"0.3 m"` or `"60 degrees"`."""
    return f"{abs(way):.3g} m" if unit == "m" else f"{math.degrees(abs(way)):.3g} degrees"


@final
class Setpoint(NamedTuple):
    """Where a motion should be: how far from its start [m or rad], how fast, and how large its rate may be."""

    distance: float
    rate: float
    speed: float


class DrivenMotion(ABC):
    """A free direction, driven; the constrained rows are held at their values at the start.

    Attributes of every child:
        constraint: The constrained rows and the driven one.
        unit: `"m"` or `"rad"`, of distances along the motion.
        along_rows: Whether E of `rates_and_jacobian` is known to be None at every posture.
        driven: shape (p,), what a unit of distance adds to the features' coordinates.
        held: shape (k, p), the constrained rows.
    """

    constraint: Constraint
    unit: Unit
    along_rows: bool
    driven: Float[np.ndarray, " p"]
    held: Float[np.ndarray, "k p"]

    @abstractmethod
    def origin(self, q: ArrayLike) -> Origin:
        """What has to be known of the start posture: the pose of the frame, or the features' coordinates."""

    @abstractmethod
    def goal(self, origin: Origin, distance: float) -> Origin:
        """Where the frame is after a distance: a pose (4, 4), or numbers for the features' rows (p,)."""

    @abstractmethod
    def error(self, origin: Origin, q: ArrayLike, distance: float) -> Float[np.ndarray, " p"]:
        """How far the coordinates of posture q are from where they should be after a distance [m or rad]."""

    @abstractmethod
    def moving_error(self, origin: Origin, q: ArrayLike, distance: float) -> MovingError:
        """The error, its rate while the goal moves, the scale of its rates, and E (see `MovingError`)."""

    def progress(self, origin: Origin, q: ArrayLike, near: float) -> float:
        """How far posture q is from the start [m or rad]; of angles a turn apart the one next to `near`."""
        return near - self._lag(self.error(origin, q, near))

    def deviation(self, origin: Origin, q: ArrayLike, distance: float) -> Float[np.ndarray, " k"]:
        """How far the constrained coordinates are from where they are held [m or rad], at that distance."""
        return self.held @ self.error(origin, q, distance)

    def rates_and_jacobian(
        self, origin: Origin, q: ArrayLike, setpoint: Setpoint, gain: float
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "s nv"] | None]:
        """Velocities wanted of the features of `constraint`; E of `Task.error_jacobian`, None where that is A(q).

        The rate of the error that the moving goal causes, and gain times the error, along the motion within the speed.
        """
        error, along, scale, E = self.moving_error(origin, q, setpoint.distance)
        wanted = setpoint.rate + gain * self._lag(error)
        excess = wanted - min(max(wanted, -setpoint.speed), setpoint.speed)
        rates = along * setpoint.rate + gain * error
        return scale * (rates - excess * self.driven if excess else rates), E

    def _lag(self, error: Float[np.ndarray, " p"]) -> float:
        return float(self.driven.dot(error)) / float(self.driven.dot(self.driven))


def between(start: Origin, end: Origin, share: float) -> Origin:
    """An origin on the straight way from one to another: of poses the place moves and the orientation stays."""
    out = start.copy()
    if start.ndim == 1:
        return out + share * (end - start)
    out[:3, 3] += share * (end[:3, 3] - start[:3, 3])
    return out


def apart(one: Origin, other: Origin) -> float:
    """Distance of two origins, poses or coordinates [m]."""
    if one.ndim == 2:
        one, other = one[:3, 3], other[:3, 3]
    return float(np.linalg.norm(other - one))


def nearest_turn(angle: float, near: float) -> float:
    """The angle [rad] that is the same but for whole turns and next to another one."""
    return angle + 2.0 * math.pi * round((near - angle) / (2.0 * math.pi))


def _shown_postures(constraint: Constraint) -> Float[np.ndarray, "n m"] | None:
    """Postures in which a constraint was shown, as far as it keeps them; None if it keeps none of its robot."""
    robot, shown = constraint.robot, constraint.provenance.get("postures")
    if robot is None or not shown:
        return None
    postures = np.array(shown, dtype=np.float64)
    return postures if postures.ndim == 2 and postures.shape[1] in (robot.nq, robot.nv) else None


def shown_sense(constraint: Constraint, motion: DrivenMotion) -> float:
    """1 where a task was shown to the positive side of where its recordings began, -1 to the other; 0 if not known.

    Whether a person who opened a drawer shut it again does not matter; where the recordings went to both sides, the
    way is not known.
    """
    shown, of = _shown_postures(constraint), constraint.provenance.get("posture_trajectories")
    if shown is None or not of or len(of) != len(shown):
        return 0.0
    ways, numbers = [], np.array(of)
    for number in np.unique(numbers):
        first, *others = (shown[i] for i in np.flatnonzero(numbers == number))
        origin = motion.origin(first)
        ways += [motion.progress(origin, posture, 0.0) for posture in others]
    left, moved = float(np.sum(ways)), float(np.sum(np.abs(ways)))
    return math.copysign(1.0, left) if moved > 0.0 and abs(left) >= ONE_WAY * moved else 0.0


@final
@dataclass(frozen=True, eq=False)
class ShownPlaces:
    """Postures in which a task was shown, as a motion along it sees them.

    Attributes:
        motion: The motion along what is free.
        postures: shape (n, nq or nv).
        lever: Distance of the hand from the axis of a turn [m]; 1 where nothing turns.
        n_held: How many of the held coordinates of the motion belong to the constraint; others hold the orientation.
    """

    motion: DrivenMotion
    postures: Float[np.ndarray, "n m"]
    lever: float
    n_held: int

    @staticmethod
    def of(constraint: Constraint, motion: DrivenMotion) -> ShownPlaces | None:
        """Of a learnt constraint; None if it was not learnt, or if its rows do not say where its mechanism is.

        A hand that is fixed to the mechanism carries the mechanism's place with it, so that only a loose grip has one.
        """
        mechanism, postures = constraint.mechanism, _shown_postures(constraint)
        if mechanism is None or mechanism.grip != "loose" or mechanism.orientation != "free" or postures is None:
            return None
        lever = 1.0 if motion.unit == "m" else max(mechanism.radius or 0.0, GRIP)
        return ShownPlaces(motion, postures, lever, constraint.n_constraints)

    @property
    def span(self) -> float:
        """How far apart along the motion the farthest two of the postures are [m or rad]."""
        along = [self.motion.progress(self.motion.origin(self.postures[0]), p, 0.0) for p in self.postures]
        return float(max(along) - min(along))

    def nearest(self, here: Origin, distance: float) -> Origin:
        """The origin from which the way begins: that of the hand where it is on the mechanism, else the nearest one.

        Args:
            here: Origin of the motion where the hand is.
            distance: Of the way [m or rad].
        """
        motion = self.motion
        along = np.array([motion.progress(here, p, 0.0) for p in self.postures])
        across = np.array([motion.deviation(here, p, 0.0)[: self.n_held] for p in self.postures])
        origins = [motion.origin(p) for p in self.postures]
        low, high, room = float(along.min()), float(along.max()), GRIP / self.lever
        if low - room <= 0.0 <= high + room and np.all((across.min(0) <= GRIP) & (across.max(0) >= -GRIP)):
            return here
        # places from which the way ends within what was shown; if it is too long for that, those with the most room
        first, last = (low, max(high - distance, low)) if distance > 0.0 else (min(low - distance, high), high)
        places = [motion.goal(o, float(np.clip(s, first, last) - s)) for o, s in zip(origins, along, strict=True)]
        place = min(places, key=lambda place: apart(here, place))
        return between(here, place, 1.0)  # a loose grip keeps the hand's orientation as it is


@final
@dataclass(frozen=True)
class MotionProfile:
    """A distance in time with bounded acceleration and jerk.

    The speed rises and falls as 3 x^2 - 2 x^3 over the ramp, so that the acceleration is continuous and at most
    1.5 speed / ramp. Where the distance is too short to reach the speed, the ramps stay as long and the speed is less.

    Attributes:
        distance: [m or rad], negative for the other way.
        speed: Of the middle part, positive [m/s or rad/s].
        ramp: Time from rest to the speed [s].
    """

    distance: float
    speed: float
    ramp: float

    @property
    def peak(self) -> float:
        """Largest speed that is reached [m/s or rad/s]."""
        return min(self.speed, abs(self.distance) / self.ramp)

    @property
    def duration(self) -> float:
        """Time from rest to rest [s]."""
        return abs(self.distance) / self.peak + self.ramp

    def at(self, t: float) -> tuple[float, float]:
        """Distance covered and its rate, t [s] after the start; at rest before the start and after the end."""
        peak, ramp, duration = math.copysign(self.peak, self.distance), self.ramp, self.duration
        t = min(max(t, 0.0), duration)
        left = duration - t
        x = min(t, left) / ramp
        if x >= 1.0:
            return peak * (t - 0.5 * ramp), peak
        ramped, rate = peak * ramp * x**3 * (1.0 - 0.5 * x), peak * x * x * (3.0 - 2.0 * x)
        return (ramped if t < left else self.distance - ramped), rate


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
        self.along_rows = isinstance(features, FrameJacobian) and features.only_linear
        self._features: FrameJacobian | RelativeFrameJacobian | None = None
        if isinstance(features, FrameJacobian | RelativeFrameJacobian) and not features.only_linear:
            self._features = features
            self._rows = [AXES.index(name) for name in features.row_names]
            self._twist[self._rows] = self.driven
            self._own_axes = isinstance(features, FrameJacobian) and features.reference == "local"

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
        pure = U.T[: int(np.count_nonzero(sigma > PURE))] @ free  # a learnt Lambda leaks a little of the other
        # a single twist that does both, of a hinge or a screw in the hand's axes, counts as what it mostly is
        free = free if not len(pure) and len(free) == 1 and np.sum(wanted**2) > 0.5 else pure
        if not len(free):
            what = "turn about" if unit == "rad" else "move along"
            raise ConstraintError(f"the constraint leaves nothing of {' '.join(features.row_names)} free to {what}")
    if direction is None:
        basis = along_axes(free)
        if len(free) > 1:
            words = "; ".join(in_words(row, features.row_names) for row in basis)
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
            f"got {direction!r}"
        )
    moved = free.T @ (free @ given)
    if np.linalg.norm(moved) < FREE * np.linalg.norm(given):
        words = "; ".join(in_words(row, features.row_names) for row in along_axes(free))
        raise TargetError(f"the constraint holds the direction {given.tolist()}; free is {words}")
    return moved / np.linalg.norm(moved)


def in_words(row: Float[np.ndarray, " p"], names: tuple[str, ...]) -> str:
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
        self.along_rows = True
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
        axis, driven = g.axis, ""
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
        if (
            straight and not firm
        ):  # a ball and a screw hold a combination of two: with it and the driven one, one is left
            combined = {"spherical": "radial", "helical": "axial"}
            taken = {driven, *held, *(combined[name] for name in held if name in combined)}
            beside = [name for name in ("radial", "axial", "tangential") if name not in taken]
        self._rows = MechanismRows(
            rows.robot, rows.frame.name, (*held, *beside, driven), axis=axis, point=g.point, pitch=g.pitch
        )
        self.constraint = Constraint(np.eye(self._rows.n_rows), self._rows, constraint.provenance)
        self.unit = "rad" if driven in ("turn", "tangential") else "m"
        self._driven = driven
        self.driven, self.held = np.eye(self._rows.n_rows)[-1], np.eye(len(held), self._rows.n_rows)
        self._turns = any(name.startswith(("turn", "slide", "screw")) for name in (*held, driven))

    def origin(self, q: ArrayLike) -> Origin:
        """Pose of the frame."""
        return self._rows.robot.pose(q, self._rows.frame)

    def goal(self, origin: Origin, distance: float) -> Origin:
        """Pose of the frame after a distance of the driven row, as on a hand that turns with the mechanism."""
        g, goal = self._rows.geometry, np.eye(4)
        turn = rotation_matrix((distance if self.unit == "rad" else 0.0) * g.axis)
        shift = {"slide": distance, "axial": distance}.get(self._driven, 0.0) * g.axis
        if {"screw", "helical"} & set(self._rows.row_names):
            shift = g.pitch * distance * g.axis
        if self._driven == "radial":
            out = origin[:3, 3] - g.point
            out = out - float(g.axis @ out) * g.axis
            shift = distance * out / np.linalg.norm(out)
        goal[:3, :3] = turn @ origin[:3, :3]
        goal[:3, 3] = g.point + turn @ (origin[:3, 3] - g.point) + shift
        return goal

    def error(self, origin: Origin, q: ArrayLike, distance: float) -> Float[np.ndarray, " p"]:
        """What each row's coordinate is away from its value at the start, the driven one from the distance."""
        return self.moving_error(origin, q, distance)[0]

    def moving_error(self, origin: Origin, q: ArrayLike, distance: float) -> MovingError:
        """As for `DrivenMotion`; `tangential` is a speed, its coordinate an angle."""
        now, names = self._coordinates(origin, q, distance), self._rows.row_names
        scale = np.array([now["distance from the axis"] if name == "tangential" else 1.0 for name in names])
        return distance * self.driven - np.array([now[name] for name in names]), self.driven, scale, None

    def _coordinates(self, origin: np.ndarray, q: ArrayLike, near: float) -> dict[str, float]:
        """The coordinate of each row, less its value at the start; angles next to `near`."""
        pose, g = self.origin(q), self._rows.geometry
        # only what is driven goes beyond half a turn
        turned, around = (near if self._driven == name else 0.0 for name in ("turn", "tangential"))
        out = place_about(origin[:3, 3] - g.point, pose[:3, 3] - g.point, g, around)
        return out | _hand(origin, pose, g, turned) if self._turns else out


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
    free = [name for name in names if name not in taken and (unit is None or f"[{unit}]" in DRIVEN[name])]
    words = "; ".join(DRIVEN[name] for name in free)
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
