"""A straight way and its profile in time: from rest to a speed, on at that speed, and back to rest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import sum_in_words
from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian
from manip_learn.constraint.features.pose_error import pose_error
from manip_learn.constraint.features.relative_frame_jacobian import RelativeFrameJacobian
from manip_learn.control.tasks.driven_motion import DrivenMotion, Setpoint, Unit
from manip_learn.errors import ConstraintError, TargetError, advice
from manip_learn.linalg import complement_rows
from manip_learn.robot.rotations import left_jacobian, left_jacobian_inverse, rotation_matrix


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


FREE = 0.1  # share of a direction that must be free for it to be meant
NEGLIGIBLE = 1e-6
PURE = (
    0.995  # share of a direction that is translation, or rotation: a learnt one leaks by its uncertainty, 0.1 at most
)


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
        self,
        constraint: Constraint,
        direction: ArrayLike | None,
        unit: Unit | None = None,
        straight: bool = False,
    ):
        features = constraint.features
        angular = np.array([unit == "rad/s" for unit in features.row_units])
        f = _direction(constraint, direction, unit, angular)
        driven = np.vstack([constraint.selection, f])
        if straight:
            driven = np.vstack([constraint.selection, _beside(driven, angular), f])
        self.constraint = Constraint(driven, features, constraint.provenance)
        linear_size, angular_size = (float(np.linalg.norm(f[part])) for part in (~angular, angular))
        self.unit = "rad" if angular_size > linear_size else "m"
        self._f = f / max(linear_size, angular_size)  # a distance counts along the larger part
        self._square = float(self._f.dot(self._f))
        self._held = constraint.selection
        self._twist = np.zeros(6)
        self.along_rows = isinstance(features, FrameJacobian) and features.only_linear
        self._features: FrameJacobian | RelativeFrameJacobian | None = None
        if isinstance(features, FrameJacobian | RelativeFrameJacobian) and not features.only_linear:
            self._features = features
            self._rows = [AXES.index(name) for name in features.row_names]
            self._twist[self._rows] = self._f
            self._own_axes = isinstance(features, FrameJacobian) and features.reference == "local"

    def origin(self, q: ArrayLike) -> Float[np.ndarray, "..."]:
        """Pose of the frame, or the coordinates."""
        return self.constraint.features.coordinates(q) if self._features is None else self._features.pose(q)

    def progress(self, origin: Float[np.ndarray, "..."], q: ArrayLike, near: float) -> float:
        """How far posture q is from the start, along f."""
        return near - self._lag(self._error(origin, q, near))

    def rates(
        self, origin: Float[np.ndarray, "..."], q: ArrayLike, setpoint: Setpoint, gain: float
    ) -> Float[np.ndarray, " p"]:
        """The rate of the error that the moving goal causes, and gain times the error; along f within the speed."""
        error, along = self._error_and_along(origin, q, setpoint.distance)
        return self._rates(error, along, setpoint, gain)

    def rates_and_jacobian(
        self, origin: Float[np.ndarray, "..."], q: ArrayLike, setpoint: Setpoint, gain: float
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "s nv"] | None]:
        """Both from one look at the pose."""
        if self._features is None:
            return super().rates_and_jacobian(origin, q, setpoint, gain)
        goal = self._goal(origin, setpoint.distance)
        error, E = self._features.error_and_jacobian(goal, q)
        along = self._moved(goal, self._features.pose(q))
        rates = self._rates(error, along, setpoint, gain)
        return rates, None if E is None else self.constraint.selection.dot(E)

    def _rates(self, error: np.ndarray, along: np.ndarray, setpoint: Setpoint, gain: float) -> np.ndarray:
        lag = self._lag(error)
        excess = setpoint.rate + gain * lag - setpoint.approached(lag, gain)
        rates = along * setpoint.rate + gain * error
        return rates - excess * self._f if excess else rates

    def deviation(self, origin: Float[np.ndarray, "..."], q: ArrayLike, distance: float) -> Float[np.ndarray, " k"]:
        """Error along the constrained rows."""
        return self._held @ self._error(origin, q, distance)

    def goal(self, origin: Float[np.ndarray, "..."], distance: float) -> Float[np.ndarray, "..."]:
        """The pose, or the coordinates, after a distance along f."""
        return origin + distance * self._f if self._features is None else self._goal(origin, distance)

    def error_jacobian(
        self, origin: Float[np.ndarray, "..."], q: ArrayLike, distance: float
    ) -> Float[np.ndarray, "s nv"] | None:
        """E of `Task.error_jacobian`; None where that is A(q)."""
        if self._features is None:
            E = self.constraint.features.coordinates_jacobian(q)
        else:
            E = self._features.error_jacobian(self._goal(origin, distance), q)
        return None if E is None else self.constraint.selection @ E

    def _lag(self, error: np.ndarray) -> float:
        return float(self._f.dot(error)) / self._square

    def _error(self, origin: np.ndarray, q: ArrayLike, distance: float) -> np.ndarray:
        if self._features is None:
            return origin + distance * self._f - self.constraint.features.coordinates(q)
        goal = self._goal(origin, distance)
        return pose_error(self._features.pose(q), goal, self._own_axes)[self._rows]

    def _goal(self, origin: np.ndarray, distance: float) -> np.ndarray:
        v, turn = self._twist[:3] * distance, self._twist[3:] * distance
        goal, turned = np.eye(4), rotation_matrix(turn)
        if self._own_axes:
            goal[:3, :3] = origin[:3, :3] @ turned
            goal[:3, 3] = origin[:3, 3] + origin[:3, :3] @ left_jacobian(turn) @ v
        else:
            goal[:3, :3], goal[:3, 3] = turned @ origin[:3, :3], origin[:3, 3] + v
        return goal

    def _error_and_along(self, origin: np.ndarray, q: ArrayLike, distance: float) -> tuple[np.ndarray, np.ndarray]:
        """The error, and its rate per unit rate of the distance at a frame that stands still."""
        if self._features is None:
            return self._error(origin, q, distance), self._f
        goal, pose = self._goal(origin, distance), self._features.pose(q)
        return pose_error(pose, goal, self._own_axes)[self._rows], self._moved(goal, pose)

    def _moved(self, goal: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Rate of the error per unit rate of the distance, at a frame that stands still."""
        out = np.empty(6)
        turn = pose_error(pose, goal, self._own_axes)[3:]
        v, w = self._twist[:3], self._twist[3:]
        out[:3] = pose[:3, :3].T @ goal[:3, :3] @ v if self._own_axes else v
        out[3:] = left_jacobian_inverse(-turn if self._own_axes else turn) @ w
        return out[self._rows]


def _beside(driven: Float[np.ndarray, "k p"], angular: np.ndarray) -> Float[np.ndarray, "m p"]:
    """The translations that a straight way along the last row leaves out, beside what is held."""
    linear = np.eye(len(angular))[~angular]
    rest = linear - linear @ np.linalg.pinv(driven) @ driven
    _, sigma, Vt = np.linalg.svd(rest)
    return Vt[: int(np.count_nonzero(sigma > 0.5))]


def _direction(
    constraint: Constraint, direction: ArrayLike | None, unit: Unit | None, angular: np.ndarray
) -> Float[np.ndarray, " p"]:
    features, Lambda = constraint.features, constraint.selection
    p, free = features.n_rows, features.n_rows - constraint.n_constraints
    projector = np.eye(p) - Lambda.T @ Lambda
    if free < 1:
        raise ConstraintError(f"the constraint leaves none of {' '.join(features.row_names)} free to move along")
    if unit is not None and direction is None:
        projector, free = _of_one_unit(Lambda, angular if unit == "rad" else ~angular)
        if free < 1:
            what = "turn about" if unit == "rad" else "move along"
            raise ConstraintError(f"the constraint leaves nothing of {' '.join(features.row_names)} free to {what}")
    if direction is None:
        basis = free_directions(projector, free)
        if free > 1:
            words = "; ".join(in_words(row, features.row_names) for row in basis)
            raise ConstraintError(
                f"the constraint leaves {free} directions free ({words}): say along which one to move"
                + advice(" with {}", "direction=", "--direction " + ",".join(f"{c:.3g}" for c in basis[0]))
            )
        return basis[0]
    try:
        given = np.array(direction, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TargetError(f"the direction must be numbers along the rows of the features: {direction!r}") from error
    if given.shape == (3,) and p > 3 and set(AXES[:3]) <= set(features.row_names):
        wanted = np.zeros(p)
        wanted[[features.row_names.index(name) for name in AXES[:3]]] = given
        given = wanted
    if given.shape != (p,) or not np.all(np.isfinite(given)) or not np.linalg.norm(given) > 0.0:
        raise TargetError(
            f"the direction must be {p} finite numbers ({', '.join(features.row_names)}) that are not all zero, "
            f"got {direction!r}"
        )
    moved = projector @ given
    if np.linalg.norm(moved) < FREE * np.linalg.norm(given):
        words = "; ".join(in_words(row, features.row_names) for row in free_directions(projector, free))
        raise TargetError(f"the constraint holds the direction {given.tolist()}; free is {words}")
    return moved / np.linalg.norm(moved)


def _of_one_unit(Lambda: Float[np.ndarray, "s p"], wanted: np.ndarray) -> tuple[Float[np.ndarray, "p p"], int]:
    """The projector onto the free directions that only translate, or only rotate, and how many there are.

    A learnt Lambda leaks a little from one to the other: a direction counts from `PURE` of it on. A single free twist
    that does both, of a hinge or a screw in the hand's axes, counts as what it mostly is.
    """
    free = complement_rows(Lambda).T  # (p, k)
    _, sigma, Vt = np.linalg.svd(free[wanted], full_matrices=True)
    pure = free @ Vt[: int(np.count_nonzero(sigma > PURE))].T
    if pure.shape[1] == 0 and free.shape[1] == 1 and np.sum(free[wanted] ** 2) > 0.5:
        pure = free
    return pure @ pure.T, pure.shape[1]


def free_directions(projector: Float[np.ndarray, "p p"], number: int) -> Float[np.ndarray, "k p"]:
    """An orthonormal base of what a projector leaves, each along an axis as far as that goes (pivoted Gram-Schmidt).

    The largest entry of each is positive, so that the sense of a direction does not depend on rounding.
    """
    rest, out = projector.copy(), []
    for _ in range(number):
        row = rest[int(np.argmax(np.diag(rest)))].copy()
        row /= np.linalg.norm(row)
        row *= np.sign(row[int(np.argmax(np.abs(row) > np.max(np.abs(row)) - NEGLIGIBLE))])
        out.append(row)
        rest -= np.outer(row, row)
    return np.array(out)


def in_words(row: Float[np.ndarray, " p"], names: tuple[str, ...]) -> str:
    """A direction as a sum of rows, e.g. "+0.6 x +0.8 y"."""
    return sum_in_words(row, names, "+.3g", 1e-3)
