"""Limits of a robot's motion, as bounds on the next joint velocity."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from manip_learn.control.tip_speed import TipSpeed
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

# [1/s] default acceleration limit over velocity limit: a joint reaches its full speed in 0.2 s
ACCELERATION_RATE = 5.0
# [rad/s2 or m/s2] default acceleration limit of a joint that has no velocity limit
DEFAULT_ACCELERATION = 10.0
# [rad or m] room that the joints need for leaving a singularity
ROOM_TO_LEAVE = 0.1
# [rad or m] a joint is outside when it is more than this beyond a position limit
OUTSIDE = 1e-9
# share of the acceleration limit that braking before a position limit uses; the rest keeps the task on its way
BRAKING_SHARE = 0.5
# [1/s] rate at which a joint approaches its position limit exponentially, at the end of its braking distance
APPROACH_RATE = 20.0
# share of the velocity limit at which a joint that starts outside its position limits returns
RETURN_SPEED = 0.25
# [rad/s and rad/s2, or m] stand for no limit where a distance is made from one, which must be finite
FASTEST, LARGEST_ACCELERATION = 1e6, 1e12
# share of a bound within which a velocity counts as being at it
AT_BOUND = 1e-7
# [rad/s or m/s] by less than this a velocity exceeds a bound by rounding alone
ROUNDED = 1e-12

VELOCITY, POSITION, ACCELERATION = range(3)
Vector = Any  # one number a joint: an array, or a list where the interpreter reads them one by one


@final
class Bounds(NamedTuple):
    """Lowest and highest velocity of each joint for the next step, one number per joint.

    Attributes:
        low: [rad/s or m/s].
        high: [rad/s or m/s]; low <= high, and both have one sign where a joint must brake or return.
        low_cause: Which limit sets `low`: `POSITION`, `VELOCITY` or `ACCELERATION`.
        high_cause: Which limit sets `high`.
        outside: Largest distance of a joint beyond a position limit [rad or m], 0 if none is outside.
    """

    low: Float[np.ndarray, " nv"]
    high: Float[np.ndarray, " nv"]
    low_cause: Int[np.ndarray, " nv"]
    high_cause: Int[np.ndarray, " nv"]
    outside: float

    def admit(self, velocity: Float[np.ndarray, " nv"]) -> bool:
        """Whether a velocity is within the bounds."""
        return admitted(self, velocity)

    def binding(self, velocity: Float[np.ndarray, " nv"], desired: Float[np.ndarray, " nv"]) -> tuple[int, int]:
        """The joint at a bound whose desired velocity exceeds it most, and the limit that sets it; (-1, -1) if none."""
        return binding(self, velocity, desired)


@final
class LimitTable(NamedTuple):
    """`Limits` for steps of one length, as the law reads them; inf where there is none.

    Attributes:
        lower: Lowest positions [rad or m].
        upper: Highest positions [rad or m].
        velocity: [rad/s or m/s].
        acceleration: [rad/s2 or m/s2].
        free: Distance from a position limit from which every speed is allowed [rad or m].
        linear: d1 of `Limits`, where the exponential approach begins.
        offset: d0 of `Limits`.
        weakest: Smallest acceleration.
        dt: Length of a step [s].
    """

    lower: Vector
    upper: Vector
    velocity: Vector
    acceleration: Vector
    free: Vector
    linear: Vector
    offset: Vector
    weakest: float
    dt: float


@final
class Limits:
    """Position limits with the distance that braking takes, velocity, acceleration and jerk.

    The next velocity u of a joint at distance d from its upper position limit, with u' commanded in the step before:

        u <= min(velocity, brake(d), u' + a dt),    brake(d): the fastest from which the joint stops at the limit

    and the mirror image below. With deceleration a in steps of dt a joint stops within u^2 / (2 a) + u dt / 2, so that

        brake(d) = sqrt(2 a (d - d0) + (a dt / 2)^2) - a dt / 2    for d > d1,    kappa d    for d <= d1,

    with d0 and d1 such that value and slope are continuous: a joint at its limit is approached exponentially. Bounds
    of this kind can always be met in the step that follows (Del Prete, "Joint position and velocity bounds in
    discrete-time acceleration/torque control of robot manipulators", 2018). Where they cannot, because the motion
    started too fast or outside, the acceleration limit has precedence. A joint outside returns.

    Args:
        robot: The robot, for its position and velocity limits.
        velocity: shape (nv,) or a number [rad/s or m/s]; the robot's own by default.
        acceleration: shape (nv,) or a number [rad/s2 or m/s2]; by default `ACCELERATION_RATE` times the velocity limit,
            and `DEFAULT_ACCELERATION` for a joint without one. inf for none.
        jerk: shape (nv,) or a number [rad/s3 or m/s3]; None for none. A `ServoLoop` keeps it.
        position: False ignores the position limits.
        margin: Distance to keep from the position limits [rad or m].
        tip_speed: Largest speed of the frames' origins [m/s], e.g. 0.25 beside people; None for none. A row of the same
            program (see `TipSpeed`), which is then solved in Python.
        frames: Name or names of these frames; by default the robot's likeliest tip.

    Attributes:
        tip: The limit on the speed of frames, or None.
        velocity: shape (nv,) [rad/s or m/s].
        acceleration: shape (nv,) [rad/s2 or m/s2].
        jerk: shape (nv,) [rad/s3 or m/s3], or None.
        lower: shape (nv,), lowest positions [rad or m].
        upper: shape (nv,), highest positions.

    Raises:
        ConfigurationError: A limit that is not positive or has the wrong size, or a margin that leaves no room.
        UnknownNameError: No such frame.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        jerk: ArrayLike | None = None,
        position: bool = True,
        margin: float = 0.0,
        tip_speed: float | None = None,
        frames: str | Sequence[str] | None = None,
    ):
        self.robot = robot
        names = robot.joint_names
        self.velocity = _positive("velocity", robot.velocity_limit if velocity is None else velocity, names)
        if acceleration is None:
            bounded = np.isfinite(self.velocity)
            acceleration = np.where(bounded, ACCELERATION_RATE * self.velocity, DEFAULT_ACCELERATION)
        self.acceleration = _positive("acceleration", acceleration, names)
        self.jerk = None if jerk is None else _positive("jerk", jerk, names)
        if not (math.isfinite(margin) and margin >= 0.0):
            raise ConfigurationError(f"margin must be a distance of at least 0, got {margin!r}")
        self.tip = None if tip_speed is None else TipSpeed(robot, tip_speed, frames)
        self.position, self.margin = bool(position), float(margin)
        infinite = np.full(robot.nv, np.inf)
        self.lower = robot.position_lower + margin if position else -infinite
        self.upper = robot.position_upper - margin if position else infinite
        narrow = np.flatnonzero(self.lower > self.upper)
        if narrow.size:
            j = int(narrow[0])
            width = robot.position_upper[j] - robot.position_lower[j]
            raise ConfigurationError(
                f"a margin of {margin:g} leaves no room to joint {names[j]!r}, whose range is {width:g} wide"
            )
        for array in (self.lower, self.upper):
            array.setflags(write=False)
        self._table: LimitTable | None = None
        self._numbers: LimitTable | None = None

    def admit(
        self,
        q: Float[np.ndarray, " n"],
        dt: float,
        velocity: Float[np.ndarray, " nv"],
        previous: Float[np.ndarray, " nv"] | None,
    ) -> bool:
        """Whether a velocity is within `bounds`, and no joint outside its position limits."""
        x = (q if q.shape[0] == self.robot.nv else self.robot.positions(q)).tolist()
        before = x if previous is None else previous.tolist()
        return keeps(self._plain(dt), x, velocity.tolist(), before, previous is not None)

    def table(self, dt: float) -> LimitTable:
        """The limits for steps of dt [s]."""
        table = self._table
        if table is None or dt != table.dt:
            # copies: numba tells arrays that may not be written to from others
            lower, upper = self.lower.copy(), self.upper.copy()
            self._table = table = limit_table(lower, upper, self.velocity.copy(), self.acceleration.copy(), dt)
            self._numbers = None
        return table

    def _plain(self, dt: float) -> LimitTable:
        """The same in plain numbers: one by one they are read faster than those of an array."""
        table = self.table(dt)
        if self._numbers is None:
            columns = {name: getattr(table, name).tolist() for name in LimitTable._fields[:7]}
            self._numbers = LimitTable(**columns, weakest=table.weakest, dt=dt)
        return self._numbers

    def bounds(self, q: Float[np.ndarray, " n"], dt: float, previous: Float[np.ndarray, " nv"] | None) -> Bounds:
        """Bounds on the velocity of the next dt.

        Args:
            q: Posture, checked: a configuration or joint positions.
            dt: Time that the next velocity is held [s].
            previous: Velocity commanded in the step before [rad/s or m/s]; None bounds no acceleration.
        """
        table = self.table(dt)
        x = (q if q.shape[0] == self.robot.nv else self.robot.positions(q)).tolist()
        bounds = position_bounds(self._plain(dt), x, table.velocity)
        return bounds if previous is None else bound_changes(bounds, previous, self.acceleration, dt)

    def towards(
        self, wish: Float[np.ndarray, " nv"], previous: Float[np.ndarray, " nv"], bounds: Bounds, dt: float
    ) -> Float[np.ndarray, " nv"]:
        """The velocity within `bounds` that leads to `wish`, or to what the velocity limits leave of its direction.

        On the straight way from `previous`, as far as the acceleration limits go; then each joint is kept from
        its position limits by itself, so that a joint that is stopped there stops no other.
        """
        slowed = wish / float(np.max(np.abs(wish) / self.velocity, initial=1.0))
        change = slowed - previous
        longest = float(np.max(np.abs(change) / (self.acceleration * dt), initial=1.0))
        return np.clip(previous + change / longest, bounds.low, bounds.high)

    def with_rates(self, acceleration: ArrayLike | None, jerk: ArrayLike | None) -> Limits:
        """The same limits with other accelerations and jerks; None keeps what there is.

        Raises:
            ConfigurationError: A limit that is not positive or has the wrong size.
        """
        if acceleration is None and jerk is None:
            return self
        other = copy.copy(self)
        if acceleration is not None:
            other.acceleration = _positive("acceleration", acceleration, self.robot.joint_names)
        if jerk is not None:
            other.jerk = _positive("jerk", jerk, self.robot.joint_names)
        other._table = other._numbers = None
        return other

    def freer_sense(self, q: Float[np.ndarray, " n"], direction: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
        """A direction, or its opposite where position limits leave that more room."""
        x = q if q.shape[0] == self.robot.nv else self.robot.positions(q)
        return freer_sense(self.lower, self.upper, x, direction)


def limit_table(
    lower: Float[np.ndarray, " nv"],
    upper: Float[np.ndarray, " nv"],
    velocity: Float[np.ndarray, " nv"],
    acceleration: Float[np.ndarray, " nv"],
    dt: float,
) -> LimitTable:
    """The constants of brake(d) for steps of dt, see `Limits`: value and slope are continuous at d1."""
    nv, rate = velocity.shape[0], min(APPROACH_RATE, 0.5 / dt)
    free, linear, offset = np.empty(nv), np.empty(nv), np.empty(nv)
    for j in range(nv):
        v, a = min(velocity[j], FASTEST), BRAKING_SHARE * min(acceleration[j], LARGEST_ACCELERATION)
        joined = a / rate - 0.5 * a * dt  # speed at d1
        linear[j] = joined / rate
        offset[j] = linear[j] - joined * (joined + a * dt) / (2.0 * a)
        free[j] = v / rate if v <= joined else offset[j] + v * (v + a * dt) / (2.0 * a)
    return LimitTable(lower, upper, velocity, acceleration, free, linear, offset, acceleration.min(), dt)


def allowed_speed(limits: LimitTable, j: int, distance: float) -> float:
    """brake(d) of a joint at a distance from a position limit below `free`; negative outside, where it returns."""
    if distance <= limits.linear[j]:
        rate = min(APPROACH_RATE, 0.5 / limits.dt)
        return max(rate * distance, -RETURN_SPEED * min(limits.velocity[j], FASTEST))
    a = BRAKING_SHARE * min(limits.acceleration[j], LARGEST_ACCELERATION)
    half = 0.5 * a * limits.dt
    return math.sqrt(half * half + 2.0 * a * (distance - limits.offset[j])) - half


def keeps(limits: LimitTable, x: Vector, u: Vector, previous: Vector, known: bool) -> bool:
    """Whether a velocity keeps all limits at joint positions x, no joint outside: the short way to the bounds.

    Args:
        limits: For steps of this length; in plain numbers or arrays, as all vectors here.
        x: Joint positions [rad or m].
        u: Velocity [rad/s or m/s].
        previous: The one before, where it is known.
        known: Whether it is; otherwise no acceleration is bounded.
    """
    for j in range(len(u)):
        v = u[j]
        if not abs(v) <= limits.velocity[j] or (
            known and not abs(v - previous[j]) <= limits.acceleration[j] * limits.dt
        ):
            return False
        above, below = limits.upper[j] - x[j], x[j] - limits.lower[j]
        if above < 0.0 or below < 0.0:
            return False
        distance = above if v > 0.0 else below
        if distance < limits.free[j] and abs(v) > allowed_speed(limits, j, distance):
            return False
    return True


def position_bounds(limits: LimitTable, x: Vector, velocity: Float[np.ndarray, " nv"]) -> Bounds:
    """Bounds by position and velocity limits.

    Args:
        limits: For steps of this length; in plain numbers or arrays, as x.
        x: Joint positions [rad or m].
        velocity: The limits' own, an array.
    """
    low, high, outside = -velocity, velocity.copy(), 0.0
    low_cause, high_cause = np.zeros(len(x), np.int64), np.zeros(len(x), np.int64)  # `VELOCITY`
    for j in range(len(x)):
        above, below, free = limits.upper[j] - x[j], x[j] - limits.lower[j], limits.free[j]
        if above < free:
            fastest = allowed_speed(limits, j, above)
            if fastest < limits.velocity[j]:
                high[j], high_cause[j] = fastest, POSITION
            outside = max(outside, -above)
        if below < free:
            fastest = allowed_speed(limits, j, below)
            if fastest < limits.velocity[j]:
                low[j], low_cause[j] = -fastest, POSITION
            outside = max(outside, -below)
    return Bounds(low, high, low_cause, high_cause, outside if outside > OUTSIDE else 0.0)


def bound_changes(
    bounds: Bounds, previous: Float[np.ndarray, " nv"], acceleration: Float[np.ndarray, " nv"], dt: float
) -> Bounds:
    """The same bounds, narrowed to what acceleration limits allow in dt [s] after a velocity."""
    low, high = bounds.low, bounds.high
    slowest, fastest = previous - acceleration * dt, previous + acceleration * dt
    for j in range(low.shape[0]):
        if slowest[j] > low[j]:
            low[j], bounds.low_cause[j] = slowest[j], ACCELERATION
        if fastest[j] < high[j]:
            high[j], bounds.high_cause[j] = fastest[j], ACCELERATION
        if low[j] > high[j]:  # too fast, or too far, for what the acceleration limit allows: it has precedence
            low[j] = slowest[j] if high[j] < slowest[j] else fastest[j]
            high[j] = low[j]
    return bounds


def admitted(bounds: Bounds, u: Float[np.ndarray, " nv"]) -> bool:
    """Whether a velocity is within bounds."""
    for j in range(u.shape[0]):
        if not bounds.low[j] <= u[j] <= bounds.high[j]:
            return False
    return True


def binding(bounds: Bounds, u: Float[np.ndarray, " nv"], desired: Float[np.ndarray, " nv"]) -> tuple[int, int]:
    """The joint at a bound whose desired velocity exceeds it most, and the limit that sets it; (-1, -1) if none."""
    joint, cause, most = -1, -1, ROUNDED
    above, below = desired - bounds.high, bounds.low - desired
    for j in range(u.shape[0]):
        if above[j] > most and u[j] >= bounds.high[j] - AT_BOUND * (1.0 + abs(u[j])):
            joint, cause, most = j, bounds.high_cause[j], above[j]
        elif below[j] > most and u[j] <= bounds.low[j] + AT_BOUND * (1.0 + abs(u[j])):
            joint, cause, most = j, bounds.low_cause[j], below[j]
    return joint, int(cause)


def freer_sense(
    lower: Float[np.ndarray, " nv"],
    upper: Float[np.ndarray, " nv"],
    x: Float[np.ndarray, " nv"],
    direction: Float[np.ndarray, " nv"],
) -> Float[np.ndarray, " nv"]:
    """A direction, or its opposite where position limits leave that more room at joint positions x."""
    fastest, ahead, behind = 0.0, math.inf, math.inf
    for j in range(x.shape[0]):
        fastest = max(fastest, abs(direction[j]))
    for j in range(x.shape[0]):
        speed = abs(direction[j])
        if speed > 1e-3 * fastest:
            up, down = (upper[j] - x[j]) / speed, (x[j] - lower[j]) / speed
            if direction[j] < 0.0:
                up, down = down, up
            ahead, behind = min(ahead, up), min(behind, down)
    return direction if fastest == 0.0 or ahead >= min(behind, ROOM_TO_LEAVE / fastest) else -direction


def _positive(what: str, values: ArrayLike, names: tuple[str, ...]) -> Float[np.ndarray, " nv"]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape not in ((), (len(names),)):
        raise ConfigurationError(f"{what} limits: {len(names)} numbers or one are needed, got shape {array.shape}")
    array = np.array(np.broadcast_to(array, (len(names),)))
    wrong = np.flatnonzero(~(array > 0.0))
    if wrong.size:
        j = int(wrong[0])
        raise ConfigurationError(f"the {what} limit of joint {names[j]!r} must be positive, got {array[j]:g}")
    array.setflags(write=False)
    return array
