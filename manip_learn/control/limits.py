"""Limits of joints: position, velocity, acceleration, jerk, and the braking distance before a position limit."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Int
from numpy.typing import ArrayLike

from manip_learn.control import barriers
from manip_learn.control.command import ACCELERATION, POSITION, VELOCITY, Posture, Vector
from manip_learn.errors import ConfigurationError, TargetError
from manip_learn.robot.collision import SelfCollision
from manip_learn.robot.robot import Robot

RETURN_SPEED = 0.25  # share of the velocity limit at which a joint that starts outside its position limits returns
OUTSIDE = 1e-9  # [rad or m] a joint is outside when it is more than this beyond a position limit
FINE = 1e-13  # [rad/s or m/s] excess of a velocity over a bound due to rounding, e.g. of a joint at its limit


def stopping_speed(distance: Vector, acceleration: Vector, dt: float) -> Vector:
    """Return the highest speed for the next step from which a joint can still stop within a distance.

    The joint then brakes in steps of dt: its displacements per step decrease by acceleration * dt^2 from step to step,
    and add up to the distance.

    Args:
        distance: Remaining distances (nv,), at least 0 [rad or m].
        acceleration: Acceleration limits (nv,) [rad/s2 or m/s2].
        dt: Step [s].

    Returns:
        The speeds (nv,) [rad/s or m/s].
    """
    distances = distance / (acceleration * dt * dt)
    n = np.floor(0.5 * (np.sqrt(1.0 + 8.0 * distances) - 1.0))
    return acceleration * dt * (distances + 0.5 * n * (n + 1.0)) / (n + 1.0)


def farthest_positions(robot: Robot) -> Vector | float:
    """Return upper bounds of the absolute joint positions, beyond which a reading cannot be a position.

    Args:
        robot: The robot.

    Returns:
        For each joint the larger absolute position limit plus 2 pi (nv,) [rad or m], because an encoder may be off by
        a turn; the number 1e6 for all joints if any limit is infinite or if nq differs from nv.
    """
    farthest = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper)) + 2.0 * math.pi
    return farthest if robot.nq == robot.nv and bool(np.all(np.isfinite(farthest))) else 1e6


def check_inside(robot: Robot, positions: Vector) -> None:
    """Check that a start is within the position limits.

    Args:
        robot: The robot.
        positions: Joint positions (nv,) [rad or m].

    Raises:
        TargetError: A joint is outside; the first one is named.
    """
    outside = (positions < robot.position_lower - OUTSIDE) | (positions > robot.position_upper + OUTSIDE)
    if np.any(outside):
        i = int(np.argmax(outside))
        low, high, unit = robot.position_lower[i], robot.position_upper[i], robot.joint_units[i]
        where = f"at {positions[i]:.4g}, outside its limits {low:.4g} .. {high:.4g} {unit}"
        fix = f"give positions in {unit}, not in degrees or mm"
        raise TargetError(f"the start puts joint {robot.joint_names[i]!r} {where}: {fix}")


@final
class Bounds(NamedTuple):
    """Lowest and highest velocity of each joint for the next step.

    Attributes:
        low: shape (nv,) [rad/s or m/s].
        high: shape (nv,) [rad/s or m/s]; low <= high. If a joint must keep moving, because it brakes or returns from
            outside its limits, both have the same sign.
        low_cause: shape (nv,), which limit sets `low`: `POSITION`, `VELOCITY` or `ACCELERATION`.
        high_cause: shape (nv,), which limit sets `high`.
        outside: Largest distance of a joint beyond a position limit [rad or m], 0 if none is outside.
    """

    low: Vector
    high: Vector
    low_cause: Int[np.ndarray, " nv"]
    high_cause: Int[np.ndarray, " nv"]
    outside: float

    def admit(self, velocity: Vector) -> bool:
        """Return True if a velocity is within the bounds.

        Args:
            velocity: Joint velocity (nv,) [rad/s or m/s].
        """
        return self.excess(velocity) <= 0.0

    def excess(self, velocity: Vector) -> float:
        """Return the largest excess of a velocity over the bounds [rad/s or m/s]; negative within them.

        Args:
            velocity: shape (nv,) [rad/s or m/s].
        """
        return float(np.maximum(velocity - self.high, self.low - velocity).max(initial=-math.inf))

    def nearest(self, velocity: Vector) -> Vector:
        """Return a velocity with each joint clipped to its own bounds, shape (nv,) [rad/s or m/s].

        Args:
            velocity: shape (nv,) [rad/s or m/s].
        """
        return np.minimum(np.maximum(velocity, self.low), self.high)

    def binding(self, velocity: Vector, desired: Vector) -> tuple[int, int]:
        """Return the joint at a bound whose desired velocity exceeds that bound most, and the kind of the limit.

        Args:
            velocity: shape (nv,), within the bounds [rad/s or m/s].
            desired: shape (nv,), velocity without the bounds [rad/s or m/s].

        Returns:
            Index of the joint, and POSITION, VELOCITY or ACCELERATION; (-1, -1) if there is no such joint.
        """
        room = 1e-7 * (1.0 + np.abs(velocity))  # largest distance of a velocity that counts as being at a bound
        above = np.where(velocity >= self.high - room, desired - self.high, 0.0)
        over = np.maximum(above, np.where(velocity <= self.low + room, self.low - desired, 0.0))
        j = int(over.argmax())
        if not over[j] > FINE:
            return -1, -1
        return j, int((self.high_cause if above[j] > FINE else self.low_cause)[j])

    def after(self, previous: Vector, change: Vector) -> Bounds:
        """Return these bounds, narrowed to the velocities that acceleration limits allow after the previous velocity.

        If there is no such velocity within these bounds, the acceleration limits have precedence: a joint that is too
        fast, or beyond its position limit, brakes as hard as they allow.

        Args:
            previous: Velocity of the previous step (nv,) [rad/s or m/s].
            change: Largest change of the velocity per joint in one step (nv,) [rad/s or m/s].
        """
        slowest, fastest = previous - change, previous + change
        low, high = np.maximum(self.low, slowest), np.minimum(self.high, fastest)
        only = np.where(high < slowest, slowest, fastest)
        low_cause = np.where(slowest > self.low, ACCELERATION, self.low_cause)
        high_cause = np.where(fastest < self.high, ACCELERATION, self.high_cause)
        low, high = (np.where(low > high, only, x) for x in (low, high))
        return Bounds(low, high, low_cause, high_cause, self.outside)


@final
class Limits:
    r"""Joint limits: position (with the braking distance), velocity, acceleration and jerk; and limits of the hand.

    The next velocity :math:`u` of a joint at distance :math:`d` from its upper position limit is bounded by

    .. math::

        u \le \min(v_\text{max},\ \text{brake}(d),\ u' + a\,dt)

    where :math:`u'` is the velocity commanded in the previous step, :math:`a` the acceleration limit, and brake(d) the
    highest velocity from which the joint can stop at the position limit; the lower limit is treated in the same way.
    With deceleration :math:`a` in steps of :math:`dt` a joint stops within :math:`u^2 / (2 a) + u\,dt / 2`, so that

    .. math::

        \text{brake}(d) = \begin{cases}
            \sqrt{2 a (d - d_0) + (a\,dt / 2)^2} - a\,dt / 2 & d > d_1 \\
            \kappa d & d \le d_1
        \end{cases}

    with :math:`d_0` and :math:`d_1` chosen so that value and slope are continuous: a joint approaches its limit
    exponentially. brake(d) is also at most :math:`d / T`, where :math:`T = \max_j |u'_j| / a_j` is the time in which
    all joints can stop: if a slow joint stopped sooner than the fast ones, the hand would leave its path. Such bounds
    can always be satisfied in the next step (Del Prete, "Joint position and velocity bounds in discrete-time
    acceleration/torque control of robot manipulators", 2018), unless the motion started too fast or outside the limits:
    then the acceleration limit has precedence. A joint outside its limits returns.

    Args:
        robot: The robot, for its position and velocity limits.
        velocity: Largest speed of the joints, shape (nv,) or a number [rad/s or m/s]; by default the robot's limits.
        acceleration: Largest acceleration of the joints, shape (nv,) or a number [rad/s2 or m/s2]; by default 5 times
            the velocity limit, so that full speed is reached in 0.2 s, and 10 for a joint without a velocity limit. inf
            for no limit.
        jerk: Largest jerk of the joints, shape (nv,) or a number [rad/s3 or m/s3]; None for no limit. Only a
            `ServoLoop` applies it.
        position: False ignores the position limits.
        margin: Distance to keep from the position limits [rad or m].
        tip_speed: Largest speed of the origins of `frames` [m/s], e.g. 0.25 near people; None for no limit.
        tip_box: shape (2, 3), lowest and highest x, y, z of the origins of `frames` in the base frame [m], -inf and inf
            for no limit; None for no box.
        tip_walls: shape (w, 4), one wall per row (n, d): the origins p of `frames` stay where n^T p <= d, with a normal
            n in the base frame and d in m times the length of n; None for no walls.
        frames: Name or names of the frames that `tip_speed`, `tip_box` and `tip_walls` limit; by default the robot's
            likeliest tip.
        clear_of: Obstacles that the links avoid: a `Scene`, which includes collisions between the robot's own links, or
            a `SelfCollision` for these alone. None for no collision avoidance.
        clearance: Distance that links keep from obstacles and from each other [m]. Pairs that are nearer already may
            move apart, but not nearer.

    Attributes:
        barriers: Barriers for frames and links.
        velocity: shape (nv,), velocity limits [rad/s or m/s].
        acceleration: shape (nv,), acceleration limits [rad/s2 or m/s2].
        jerk: shape (nv,), jerk limits [rad/s3 or m/s3]; None for no limit.
        lower: shape (nv,), lowest positions [rad or m].
        upper: shape (nv,), highest positions [rad or m].

    Raises:
        ConfigurationError: A limit is not positive or has the wrong size, or the margin exceeds half a joint's range.
        UnknownNameError: The robot has no such frame.
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
        tip_box: ArrayLike | None = None,
        tip_walls: ArrayLike | None = None,
        frames: str | Sequence[str] | None = None,
        clear_of: SelfCollision | barriers.Obstacles | None = None,
        clearance: float = barriers.CLEARANCE,
    ):
        self.robot = robot
        names = robot.joint_names
        self.velocity = per_joint("velocity limit", robot.velocity_limit if velocity is None else velocity, names)
        if acceleration is None:
            bounded = np.isfinite(self.velocity)
            acceleration = np.where(bounded, 5.0 * self.velocity, 10.0)
        self.acceleration = per_joint("acceleration limit", acceleration, names)
        self.jerk = None if jerk is None else per_joint("jerk limit", jerk, names)
        if not (math.isfinite(margin) and margin >= 0.0):
            raise ConfigurationError(f"margin must be a distance of at least 0, got {margin!r}")
        clear = None if clear_of is None else barriers.CollisionAvoidance(robot, clear_of, clearance)
        self.barriers = barriers.Barriers(robot, tip_speed, tip_box, tip_walls, frames, clear)
        infinite = np.full(robot.nv, np.inf)
        self.lower = robot.position_lower + margin if position else -infinite
        self.upper = robot.position_upper - margin if position else infinite
        narrow = np.flatnonzero(self.lower > self.upper)
        if narrow.size:
            j = int(narrow[0])
            width = robot.position_upper[j] - robot.position_lower[j]
            raise ConfigurationError(
                f"margin={margin:g} leaves no room to joint {names[j]!r}, whose range is {width:g} wide"
            )
        for array in (self.lower, self.upper):
            array.setflags(write=False)

    def bounds(self, q: Posture, dt: float, previous: Vector | None, share: float = 1.0) -> Bounds:
        """Return the bounds on the velocity of the next step.

        Args:
            q: Configuration (nq,) or joint positions (nv,) as a float64 array [rad or m]; not checked.
            dt: Step [s].
            previous: Velocity that was commanded in the previous step (nv,) [rad/s or m/s]; None for no limit of the
                acceleration.
            share: Share of the acceleration limits with which a joint brakes before its position limits.
        """
        x = q if q.shape[0] == self.robot.nv else self.robot.positions(q)
        distances = np.stack((x - self.lower, self.upper - x))  # above the lower limits, and below the upper ones
        fastest = self._braking_speed(distances, dt, 0.0 if previous is None else self.stopping_time(previous), share)
        cause = np.where(fastest < self.velocity, POSITION, VELOCITY)
        low, high = np.minimum(fastest, self.velocity)
        outside = -float(distances.min(initial=0.0))
        bounds = Bounds(-low, high, cause[0], cause[1], outside if outside > OUTSIDE else 0.0)
        return bounds if previous is None else bounds.after(previous, self.acceleration * dt)

    def _braking_speed(self, distance: np.ndarray, dt: float, together: float, share: float) -> np.ndarray:
        """Return brake(d), at most d / T; negative outside, where a joint returns."""
        # a joint without an acceleration limit gets a huge one, so that braking distances stay finite
        a = share * barriers.BRAKING_SHARE * np.minimum(self.acceleration, 1e12)
        rate = barriers.approach_gain(dt)
        joined = a / rate - 0.5 * a * dt  # speed at d1
        linear = joined / rate
        offset = linear - joined * (joined + a * dt) / (2.0 * a)
        returning = -RETURN_SPEED * np.minimum(self.velocity, 1e6)
        far = np.sqrt((0.5 * a * dt) ** 2 + 2.0 * a * np.maximum(distance - offset, 0.0)) - 0.5 * a * dt
        speed = np.where(distance <= linear, np.maximum(rate * distance, returning), far)
        return np.where(distance > 0.0, np.minimum(speed, distance / max(together, 1e-300)), speed)

    def stopping_time(self, velocity: Vector) -> float:
        """Return the time in which all joints can stop, T = max_j |u_j| / a_j [s].

        Args:
            velocity: Joint velocity u, shape (nv,) [rad/s or m/s].
        """
        return float((np.abs(velocity) / self.acceleration).max())

    def towards(self, wish: Vector, previous: Vector, bounds: Bounds, dt: float) -> Vector:
        """Return the next velocity on the way from the previous to a desired velocity, shape (nv,) [rad/s or m/s].

        The desired velocity is first scaled down to the velocity limits. The next velocity is on the straight line from
        `previous` to it, as far as the acceleration limits allow. Then each joint is clipped to its own bounds, so that
        a joint that stops at its position limit does not stop the others.

        Args:
            wish: Desired velocity (nv,) [rad/s or m/s].
            previous: Velocity of the previous step (nv,) [rad/s or m/s].
            bounds: Bounds of the next step.
            dt: Step [s].
        """
        slowed = wish / float(np.max(np.abs(wish) / self.velocity, initial=1.0))
        change = slowed - previous
        longest = float(np.max(np.abs(change) / (self.acceleration * dt), initial=1.0))
        return np.clip(previous + change / longest, bounds.low, bounds.high)

    def with_rates(self, acceleration: ArrayLike | None, jerk: ArrayLike | None) -> Limits:
        """Return a copy of these limits with other acceleration and jerk limits.

        Args:
            acceleration: shape (nv,) or a number [rad/s2 or m/s2]; None keeps the present limits.
            jerk: shape (nv,) or a number [rad/s3 or m/s3]; None keeps the present limits.

        Raises:
            ConfigurationError: A limit that is not positive or has the wrong size.
        """
        other, names = copy.copy(self), self.robot.joint_names
        if acceleration is not None:
            other.acceleration = per_joint("acceleration limit", acceleration, names)
        other.jerk = self.jerk if jerk is None else per_joint("jerk limit", jerk, names)
        return other

    def with_tip_speed(self, speed: float, frames: Sequence[str]) -> Limits:
        """Return a copy of these limits with a speed limit for further frames.

        Args:
            speed: Largest speed of the frames' origins [m/s]; if these limits have a lower `tip_speed`, that one counts
                for all frames.
            frames: Names of further frames; the box and the walls of these limits then apply to them, too.

        Returns:
            Limits of the same robot.

        Raises:
            ConfigurationError: A speed that is not a positive number.
            UnknownNameError: The robot has no such frame.
        """
        other, present = copy.copy(self), self.barriers
        names = tuple(dict.fromkeys([*(frame.name for frame in present.frames), *frames]))
        other.barriers = barriers.Barriers(self.robot, speed, None, present.walls, names, present.clear)
        other.barriers.speed = min(other.barriers.speed, present.speed)
        return other

    def may_approach(self, square: float, size: float, smallest: float, dt: float) -> bool:
        """Return True if a velocity u may approach a singularity too fast, so that `approach_bound` must be evaluated.

        This is a cheap estimate, which assumes that the gradient of the singular value is about as large as A.

        Args:
            square: Squared norm of the joint velocity u [(rad/s)^2 or (m/s)^2].
            size: Squared Frobenius norm of the constraint matrix A, in its units squared.
            smallest: Smallest singular value of A, in the constraint's units (m or 1).
            dt: Step [s].
        """
        rate = barriers.approach_gain(dt) * smallest
        return square * size >= min(
            2.0 * barriers.BRAKING_SHARE * float(self.acceleration.min()) * math.sqrt(size) * smallest, rate * rate
        )

    def freer_sense(self, q: Posture, direction: Vector) -> Vector:
        """Return a direction of joint motion, or its negative if the position limits leave more room there.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            direction: Direction (nv,) of joint motion, of any length.

        Returns:
            `direction` or `-direction`; `direction` also if it has room for 0.1 rad or m.
        """
        x = q if q.shape[0] == self.robot.nv else self.robot.positions(q)
        fastest = float(np.max(np.abs(direction), initial=0.0))
        moves = np.abs(direction) > 1e-3 * fastest
        up, down, d = (self.upper - x)[moves], (x - self.lower)[moves], direction[moves]
        ahead, behind = (
            np.min(np.where(d > 0.0, *ways) / np.abs(d), initial=np.inf) for ways in ((up, down), (down, up))
        )
        # the joints need 0.1 rad or m to leave a singularity
        return direction if fastest == 0.0 or ahead >= min(behind, 0.1 / fastest) else -direction


def per_joint(what: str, values: ArrayLike, names: tuple[str, ...]) -> Vector:
    """Return one positive number for each joint.

    Args:
        what: Name of the quantity, for the error message.
        values: shape (nv,) or a number.
        names: Names of the joints.

    Returns:
        shape (nv,), not writable.

    Raises:
        ConfigurationError: A number is not positive, or their number is not nv.
    """
    array = np.asarray(values, dtype=np.float64)
    if array.shape not in ((), (len(names),)):
        raise ConfigurationError(f"{what}: {len(names)} numbers or one are needed, got shape {array.shape}")
    array = np.array(np.broadcast_to(array, (len(names),)))
    wrong = np.flatnonzero(~(array > 0.0))
    if wrong.size:
        j = int(wrong[0])
        raise ConfigurationError(f"the {what} of joint {names[j]!r} must be positive, got {array[j]:g}")
    array.setflags(write=False)
    return array
