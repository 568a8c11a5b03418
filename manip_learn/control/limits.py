"""Limits of joints and of the hand, and how fast a joint or a frame may approach one."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from operator import le, neg, sub, truediv
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.control.command import ACCELERATION, POSITION, VELOCITY, Posture, Vector
from manip_learn.control.keeping_clear import CLEARANCE, Barrier, KeptClear, Standing
from manip_learn.errors import ConfigurationError, TargetError
from manip_learn.robot.collision import SelfCollision
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip

# share of the speed that is given away, so that few rows do: the tangents at two points whose directions are 5 degrees
# apart let 0.1 % more through between them
RESERVE = 1e-3
RETURN_SPEED = 0.25  # share of the velocity limit at which a joint that starts outside its position limits returns
ACCELERATION_RATE = 5.0  # [1/s] default acceleration limit over velocity limit: full speed is reached in 0.2 s
DEFAULT_ACCELERATION = 10.0  # [rad/s2 or m/s2] default limit of a joint that has no velocity limit
ROOM_TO_LEAVE = 0.1  # [rad or m] room that the joints need for leaving a singularity
OUTSIDE = 1e-9  # [rad or m] a joint is outside when it is more than this beyond a position limit
FINE = 1e-13  # [rad/s or m/s] by how much rounding makes a velocity exceed a bound, as that of a joint at its limit
AT_BOUND = 1e-7  # share of a bound within which a velocity counts as being at it
# [1/s] rate at which a wall is approached exponentially at the end of the braking distance: a singularity, where the
# smallest singular value falls, a position limit, a wall of the hand
APPROACH_RATE = 20.0
BRAKING_SHARE = 0.5  # of the joints' acceleration that braking before a wall uses; the rest keeps the task on its way
CROSSING_SPEED = 5e-4  # [rad/s] speed at which a singularity may be crossed
_ROUNDED = 1e-12  # [m/s] by how much the solution of a program may approach a wall too fast: rounding of a speed of 1
_FASTEST = 1e6  # [rad/s or m/s] speed of a joint without a velocity limit: braking distances stay finite
GIVEN_UP = 1e-6  # [m/s] by which a solution breaks its rows where these are left out
_MOST_ROWS = 12  # rounds in which a speed was too large; in practice one to four
# [rad or m] no joint is farther beyond its limits than encoders count a turn too much, and none without is so far away
_TURN, LARGEST_POSITION = 2.0 * math.pi, 1e6


def approach_rate(distance: float, slope: Vector, acceleration: Vector, dt: float) -> float:
    """Largest rate at which a distance may fall, so that the joints can stop where it is 0; negative beyond that.

        rate = min(kappa x, sqrt(2 a x)),   a = BRAKING_SHARE |g| min_j (a_j / |n_j|),   n = g / |g|

    x is e.g. the smallest singular value of A or the distance of a frame from a wall, g its gradient, a_j the
    acceleration limits of the joints.
    """
    parts = slope.tolist()
    largest = max(map(truediv, map(abs, parts), acceleration.tolist()))
    length = math.hypot(*parts)
    deceleration = BRAKING_SHARE * length * length / largest if largest > 0.0 else math.inf
    return min(min(APPROACH_RATE, 0.5 / dt) * distance, math.sqrt(2.0 * deceleration * max(distance, 0.0)))


def approach_bound(smallest: float, slope: Vector, acceleration: Vector, dt: float) -> float:
    """Largest rate at which the smallest singular value may fall, so that the arm can stop at the singularity.

    That of `approach_rate`, and |grad sigma| CROSSING_SPEED. A task whose target is out of reach presses the arm
    against a singularity (a stretched elbow), with joint velocities that grow as 1 / sigma until they flip from
    step to step; with the bound it comes to rest there.
    """
    length = math.hypot(*slope.tolist())
    if length == 0.0:
        return math.inf
    return length * CROSSING_SPEED + approach_rate(smallest, slope, acceleration, dt)


@final
class Tips(NamedTuple):
    """The limited frames at one posture.

    Attributes:
        jacobians: Of the frames' origins, each (3, nv) [m].
        G: shape (w, nv), minus the rate at which each frame approaches each wall, per unit of joint velocity.
        least: shape (w,) [m/s], minus the rates that are allowed.
        clear: u -> rows that keep apart what u would bring too near; None where nothing is kept clear of.
    """

    jacobians: list[Float[np.ndarray, "3 nv"]]
    G: Float[np.ndarray, "w nv"]
    least: Float[np.ndarray, " w"]
    clear: Callable[[Vector], Barrier | None] | None = None


@final
class TipLimits:
    """|J_f(q) u| <= speed, and n^T p_f(q) <= d for each wall (n, d), for the origin p_f of each frame f.

    The ball of velocities is bounded by tangent planes, n^T J u <= speed, where it was exceeded: first at the velocity
    wished for, then, as long as one is needed, at the solution with those so far (Kelley, "The cutting-plane method for
    solving convex programs", 1960). A wall is approached no faster than `approach_rate` of its distance, so
    that the joints can stop the frame there; a frame beyond a wall returns. No more is asked of a step than
    BRAKING_SHARE of what the acceleration limits allow all joints together. Where they allow no velocity that keeps all
    this, they have precedence.

    Args:
        robot: The robot.
        speed: [m/s]; None for no limit.
        box: shape (2, 3), lowest and highest x, y, z of the frames' origins [m], -inf and inf where there is none.
        walls: shape (w, 4), rows (n, d), n of any length but 0 in the base frame, d [m] times that length.
        frames: Name or names; None for the robot's likeliest tip.
        clear: What the links keep clear of.

    Raises:
        ConfigurationError: A speed that is not positive, a box without room, or walls that are none.
        UnknownNameError: No such frame.
    """

    def __init__(
        self,
        robot: Robot,
        speed: float | None,
        box: ArrayLike | None,
        walls: ArrayLike | None,
        frames: str | Sequence[str] | None = None,
        clear: KeptClear | None = None,
    ):
        if speed is not None and not (isinstance(speed, int | float) and 0.0 < speed < math.inf):
            raise ConfigurationError(f"tip_speed must be a positive number of metres per second, got {speed!r}")
        rows = np.empty((0, 4)) if walls is None else np.array(walls, dtype=np.float64)
        are_rows = rows.ndim == 2 and rows.shape[1] == 4
        if not (are_rows and np.all(np.isfinite(rows)) and np.all(rows[:, :3].any(axis=1))):
            raise ConfigurationError(f"walls must be rows (nx, ny, nz, d) with n^T p <= d, got {rows.tolist()}")
        if box is not None:
            sides, unit = np.array(box, dtype=np.float64), np.eye(3)
            if sides.shape != (2, 3) or not np.all(sides[0] < sides[1]):
                raise ConfigurationError(
                    "a box is two rows, lowest and highest x, y, z [m], the first below the second; "
                    f"got {sides.tolist()}"
                )
            faces = np.vstack((np.column_stack((-unit, -sides[0])), np.column_stack((unit, sides[1]))))
            rows = np.vstack((faces[np.isfinite(faces[:, 3])], rows))
        if frames is None:
            frames = () if speed is None and not len(rows) else default_tip(robot)
        names = (frames,) if isinstance(frames, str) else tuple(frames)
        self.speed = math.inf if speed is None else float(speed)
        self.frames = tuple(robot.frame(name) for name in names)
        self.walls = rows / np.linalg.norm(rows[:, :3], axis=1, keepdims=True)
        self.clear, self._robot = clear, robot

    def at(self, q: Posture, dt: float, acceleration: Vector, previous: Vector | None) -> Tips:
        """The frames at a posture."""
        jacobians = [self._robot.jacobian(q, frame)[:3] for frame in self.frames]
        clear = self.clear_at(q, dt, acceleration, previous)
        if not self.walls.size:
            return Tips(jacobians, np.empty((0, self._robot.nv)), np.empty(0), clear)
        normals, offsets = self.walls[:, :3], self.walls[:, 3]
        G = np.vstack([normals.dot(J) for J in jacobians])
        left = np.concatenate([offsets - normals.dot(self._robot.position(q, frame)) for frame in self.frames])
        acceleration = np.minimum(acceleration, 1e12)  # inf for none; what follows must stay finite
        least = -np.array([approach_rate(x, g, acceleration, dt) for x, g in zip(left.tolist(), G, strict=True)])
        if previous is not None:
            least = np.minimum(least, BRAKING_SHARE * dt * np.abs(G).dot(acceleration) - G.dot(previous))
        return Tips(jacobians, -G, least, clear)

    def clear_at(
        self, q: Posture, dt: float, acceleration: Vector, previous: Vector | None
    ) -> Callable[[Vector], Barrier | None] | None:
        """`Tips.clear`: pairs stay clear in the next step, and where the arm stops when it brakes along u from then on.

        Braking takes BRAKING_SHARE of the acceleration, and ends exponentially as everywhere. Arguments as for `at`.
        """
        clear = self.clear
        if clear is None:
            return None
        least, still = 1.0 / min(APPROACH_RATE, 0.5 / dt), np.zeros(self._robot.nv)
        reach = math.inf if previous is None else dt * acceleration
        before = still if previous is None else previous

        def rows(u: Vector) -> Barrier | None:
            u = np.clip(u, before - reach, before + reach)
            times, slope = 0.5 / BRAKING_SHARE * np.abs(u) / acceleration, still.copy()
            slowest = int(np.argmax(times))
            if times[slowest] > least:
                slope[slowest] = times[slowest] / u[slowest]
            return clear.rows(q, u, dt, max(least, float(times[slowest])), slope)

        return rows

    def rows(self, tips: Tips, u: Vector, slack: float = 0.0) -> tuple[Barrier, int] | None:
        """What the velocity u breaks, and its cause: walls, pairs that come near, tangents where a frame is too fast.

        None where it breaks nothing.

        A wall may be approached too fast by `slack` [m/s].
        """
        broken = tips.G.dot(u) < tips.least - slack
        rows, least = list(tips.G[broken]), tips.least[broken].tolist()
        if tips.clear is not None and (near := tips.clear(u)) is not None:
            rows, least = [*rows, *near[0]], [*least, *near[1]]
        cause = POSITION if rows else VELOCITY
        for J in tips.jacobians:
            v = J.dot(u)
            fast = math.sqrt(v.dot(v))
            if fast > self.speed:
                rows.append((-v / fast).dot(J))
                least.append(self.speed * (RESERVE - 1.0))
        return ((np.array(rows), np.array(least)), cause) if rows else None

    @property
    def pace(self) -> float:
        """The speed for which motions are timed [m/s]: the law stays below the limit itself.

        The rest takes deviations back, and a frame gains 1 % within a step of 0.01 s at 0.25 m/s.
        """
        return 0.98 * self.speed

    def fastest(self, q: Posture, u: Vector) -> float:
        """Return the speed of the fastest frame at posture q and velocity u [m/s]."""
        return max((math.hypot(*self._robot.jacobian(q, frame)[:3].dot(u)) for frame in self.frames), default=0.0)

    def slowed(self, tips: Tips, u: Vector) -> Vector:
        """A velocity, slowed down as a whole to what is allowed; at rest where that is none."""
        fastest = max((float(np.linalg.norm(J.dot(u))) for J in tips.jacobians), default=0.0)
        rates, shares = tips.G.dot(u), [min(1.0, self.speed / max(fastest, 1e-300))]
        shares += [max(0.0, b) / r for r, b in zip((-rates).tolist(), (-tips.least).tolist(), strict=True) if r > b]
        return u * max(0.0, min(shares))

    def bounded(
        self, tips: Tips, wish: Vector, barrier: Barrier | None, solve: Callable[[Barrier | None], Vector]
    ) -> Vector:
        """The solution of the program with the rows that it needs."""
        u, found = wish, None
        for _ in range(_MOST_ROWS):
            broken = self.rows(tips, u, _ROUNDED)
            if broken is None and found is not None:
                break
            if broken is not None:
                G, least = broken[0]
                barrier = broken[0] if barrier is None else (np.vstack((barrier[0], G)), np.append(barrier[1], least))
            u = found = solve(barrier)
            if barrier is not None and np.any(barrier[0].dot(u) < barrier[1] - GIVEN_UP):
                break  # there is no solution: bounds have precedence
        return solve(barrier) if found is None else found


@final
class _Approach(NamedTuple):
    """How fast one joint may approach a position limit, brake(d) of `Limits`, value and slope continuous at d1.

    Attributes:
        free: Distance from which every speed is allowed.
        rate: kappa, of the exponential approach [1/s].
        linear: d1, up to which the approach is exponential.
        offset: d0.
        twice: 2 a.
        half: a dt / 2.
        fastest: Speed at which a joint outside returns.
    """

    free: float
    rate: float
    linear: float
    offset: float
    twice: float
    half: float
    fastest: float

    @staticmethod
    def of(velocity: float, acceleration: float, dt: float) -> _Approach:
        acceleration = BRAKING_SHARE * acceleration
        rate = min(APPROACH_RATE, 0.5 / dt)
        v = min(velocity, _FASTEST)
        fastest = RETURN_SPEED * v
        if not math.isfinite(acceleration):  # stops at once
            return _Approach(v / rate, rate, math.inf, 0.0, 0.0, 0.0, fastest)
        twice, half = 2.0 * acceleration, 0.5 * acceleration * dt
        joined = acceleration / rate - half  # speed at d1
        linear = joined / rate
        offset = linear - joined * (joined + acceleration * dt) / twice
        free = v / rate if v <= joined else offset + v * (v + acceleration * dt) / twice
        return _Approach(free, rate, linear, offset, twice, half, fastest)

    def speed(self, distance: float, together: float) -> float:
        """brake(d), at most d / T; negative outside, where the joint returns."""
        if distance <= self.linear:
            speed = max(self.rate * distance, -self.fastest)
        else:
            speed = math.sqrt(self.half * self.half + self.twice * (distance - self.offset)) - self.half
        return min(speed, distance / together) if together > 0.0 and distance > 0.0 else speed


def stopping_speed(distance: Vector, acceleration: Vector, dt: float) -> Vector:
    """The speed now with which a joint covers a distance to rest in the fewest steps of dt.

    At unit acceleration the steps x, x - 1, x - 2, ... > 0 [dt^2] are as long together as the way that is left.
    """
    left = distance / (acceleration * dt * dt)
    n = np.floor(0.5 * (np.sqrt(1.0 + 8.0 * left) - 1.0))
    return acceleration * dt * (left + 0.5 * n * (n + 1.0)) / (n + 1.0)


def farthest_positions(robot: Robot) -> Vector | float:
    """Positions that no joint is at, however its encoder counts: a turn beyond the farther limit [rad or m]."""
    farthest = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper)) + _TURN
    return farthest if robot.nq == robot.nv and bool(np.all(np.isfinite(farthest))) else LARGEST_POSITION


def check_inside(robot: Robot, positions: Vector) -> None:
    """Refuse a start outside the position limits.

    Raises:
        TargetError: Names the first joint that is.
    """
    outside = (positions < robot.position_lower - OUTSIDE) | (positions > robot.position_upper + OUTSIDE)
    if np.any(outside):
        i = int(np.argmax(outside))
        raise TargetError(
            f"the start puts joint {robot.joint_names[i]!r} at {positions[i]:.4g}, outside its limits "
            f"{robot.position_lower[i]:.4g} .. {robot.position_upper[i]:.4g} {robot.joint_units[i]}: give positions in "
            f"{robot.joint_units[i]}, not in degrees or mm"
        )


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

    low: list[float]
    high: list[float]
    low_cause: list[int]
    high_cause: list[int]
    outside: float

    def admit(self, velocity: Vector) -> bool:
        """Whether a velocity is within the bounds."""
        u = velocity.tolist()
        return all(map(le, self.low, u)) and all(map(le, u, self.high))

    def excess(self, velocity: Vector) -> float:
        """By how much a velocity exceeds the bounds [rad/s or m/s]; negative within them."""
        u = velocity.tolist()
        return max(max(map(sub, u, self.high)), max(map(sub, self.low, u)))

    def nearest(self, velocity: Vector) -> Vector:
        """The velocity within the bounds that is nearest to one, each joint by itself; itself if it is within."""
        if self.admit(velocity):
            return velocity
        return np.array(list(map(min, map(max, velocity.tolist(), self.low), self.high)))

    def binding(self, velocity: Vector, desired: Vector) -> tuple[int, int]:
        """The joint at a bound whose desired velocity exceeds it most, and the limit that sets it; (-1, -1) if none."""
        joint, cause, most, u = -1, -1, FINE, velocity.tolist()
        for j, (wish, low, high) in enumerate(zip(desired.tolist(), self.low, self.high, strict=True)):
            if low <= wish <= high:
                continue
            if wish - high > most and u[j] >= high - AT_BOUND * (1.0 + abs(u[j])):
                joint, cause, most = j, self.high_cause[j], wish - high
            elif low - wish > most and u[j] <= low + AT_BOUND * (1.0 + abs(u[j])):
                joint, cause, most = j, self.low_cause[j], low - wish
        return joint, cause


@final
class _Approaches(NamedTuple):
    """How fast the joints may approach their limits in steps of dt [s].

    From `low` to `high` all speeds are allowed to joints that wait for no others, which may stop in `quick` [s].
    """

    dt: float
    joints: list[_Approach]
    low: list[float]
    high: list[float]
    quick: float


@final
class Limits:
    """Position limits with the distance that braking takes, velocity, acceleration and jerk.

    The next velocity u of a joint at distance d from its upper position limit, with u' commanded in the step before:

        u <= min(velocity, brake(d), u' + a dt),    brake(d): the fastest from which the joint stops at the limit

    and the mirror image below. With deceleration a in steps of dt a joint stops within u^2 / (2 a) + u dt / 2, so that

        brake(d) = sqrt(2 a (d - d0) + (a dt / 2)^2) - a dt / 2    for d > d1,    kappa d    for d <= d1,

    with d0 and d1 such that value and slope are continuous: a joint at its limit is approached exponentially. It is at
    most d / T, with the time T = max_j |u'_j| / a_j in which all joints can stop: a slow joint that stopped sooner than
    the fast ones that move with it would take the hand off its way. Bounds of this kind can always be met in the step
    that follows (Del Prete, "Joint position and velocity bounds in discrete-time acceleration/torque control of robot
    manipulators", 2018). Where they cannot, because the motion started too fast or outside, the acceleration limit has
    precedence. A joint outside returns.

    Args:
        robot: The robot, for its position and velocity limits.
        velocity: shape (nv,) or a number [rad/s or m/s]; the robot's own by default.
        acceleration: shape (nv,) or a number [rad/s2 or m/s2]; by default `ACCELERATION_RATE` times the velocity limit,
            and `DEFAULT_ACCELERATION` for a joint without one. inf for none.
        jerk: shape (nv,) or a number [rad/s3 or m/s3]; None for none. A `ServoLoop` keeps it.
        position: False ignores the position limits.
        margin: Distance to keep from the position limits [rad or m].
        tip_speed: Largest speed of the frames' origins [m/s], e.g. 0.25 beside people; None for none. Rows of the same
            program (see `TipLimits`).
        tip_box: shape (2, 3), lowest and highest x, y, z of the frames' origins in the base frame [m], -inf and inf
            where there is none; None for no box.
        tip_walls: shape (w, 4), rows (n, d): the frames' origins p stay where n^T p <= d [m]; None for no walls.
        frames: Name or names of these frames; by default the robot's likeliest tip.
        clear_of: What the links keep clear of, rows of the same program (see `KeptClear`): a `Scene`, and their own
            pairs; or the pairs of a `SelfCollision`. None for nothing.
        clearance: Distance that they keep [m]. Pairs that are nearer may part, and come no nearer.

    Attributes:
        tip: The limits of frames, or None.
        velocity: shape (nv,) [rad/s or m/s].
        acceleration: shape (nv,) [rad/s2 or m/s2].
        jerk: shape (nv,) [rad/s3 or m/s3], or None.
        lower: shape (nv,), lowest positions [rad or m].
        upper: shape (nv,), highest positions.
        weakest: Smallest acceleration limit of a joint [rad/s2 or m/s2].

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
        tip_box: ArrayLike | None = None,
        tip_walls: ArrayLike | None = None,
        frames: str | Sequence[str] | None = None,
        clear_of: SelfCollision | Standing | None = None,
        clearance: float = CLEARANCE,
    ):
        self.robot = robot
        names = robot.joint_names
        self.velocity = per_joint("velocity limit", robot.velocity_limit if velocity is None else velocity, names)
        if acceleration is None:
            bounded = np.isfinite(self.velocity)
            acceleration = np.where(bounded, ACCELERATION_RATE * self.velocity, DEFAULT_ACCELERATION)
        self.acceleration = per_joint("acceleration limit", acceleration, names)
        self.jerk = None if jerk is None else per_joint("jerk limit", jerk, names)
        if not (math.isfinite(margin) and margin >= 0.0):
            raise ConfigurationError(f"margin must be a distance of at least 0, got {margin!r}")
        self.tip = None
        clear = None if clear_of is None else KeptClear(robot, clear_of, clearance)
        if not (tip_speed is None and tip_box is None and tip_walls is None and clear is None):
            self.tip = TipLimits(robot, tip_speed, tip_box, tip_walls, frames, clear)
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
        self._prepare()

    def _prepare(self) -> None:
        """What follows from the limits."""
        self._columns = tuple(a.tolist() for a in (self.lower, self.upper, self.velocity, self.acceleration))
        self.weakest = float(self.acceleration.min())
        self._latest = _Approaches(0.0, [], [], [], 0.0)

    def far(self, q: Posture, dt: float, velocity: Vector) -> bool:
        """Whether no joint is near a position limit, or faster than its velocity limit: `bounds` then admit it."""
        approaches = self._approaches(dt)
        x = (q if q.shape[0] == self.robot.nv else self.robot.positions(q)).tolist()
        if not all(map(le, map(abs, velocity.tolist()), self._columns[2])):
            return False
        return all(map(le, approaches.low, x)) and all(map(le, x, approaches.high))

    def _approaches(self, dt: float) -> _Approaches:
        if dt == self._latest.dt:
            return self._latest
        joints = [_Approach.of(v, a, dt) for v, a in zip(*self._columns[2:], strict=True)]
        free = np.array([approach.free for approach in joints])
        quick = float(np.min(free / np.minimum(self.velocity, _FASTEST), initial=math.inf))
        self._latest = found = _Approaches(
            dt, joints, (self.lower + free).tolist(), (self.upper - free).tolist(), quick
        )
        return found

    def bounds(self, q: Posture, dt: float, previous: Vector | None) -> Bounds:
        """Bounds on the velocity of the next dt.

        The posture is checked already. Without a velocity that was commanded in the step before [rad/s or m/s] no
        acceleration is bounded.
        """
        approaches = self._approaches(dt)
        x = q if q.shape[0] == self.robot.nv else self.robot.positions(q)
        # loops over Python floats: NumPy calls on vectors as short as an arm's cost more
        lower, upper, speeds, accelerations = self._columns
        low, high, outside = list(map(neg, speeds)), speeds.copy(), 0.0
        low_cause, high_cause = [VELOCITY] * len(speeds), [VELOCITY] * len(speeds)
        together = 0.0 if previous is None else self.stopping_time(previous)
        for j, (y, bottom, top) in enumerate(zip(x.tolist(), approaches.low, approaches.high, strict=True)):
            if bottom <= y <= top and together <= approaches.quick:  # far from its limits
                continue
            below, above, approach = y - lower[j], upper[j] - y, approaches.joints[j]
            if (fastest := approach.speed(above, together)) < high[j]:
                high[j], high_cause[j] = fastest, POSITION
            if (fastest := approach.speed(below, together)) < speeds[j]:
                low[j], low_cause[j] = -fastest, POSITION
            if below < 0.0 or above < 0.0:
                outside = max(outside, -below, -above)
        bounds = Bounds(low, high, low_cause, high_cause, outside if outside > OUTSIDE else 0.0)
        if previous is not None:
            bound_changes(bounds, previous, accelerations, dt)
        return bounds

    def stopping_time(self, velocity: Vector) -> float:
        """T = max_j |u_j| / a_j, in which all joints can stop from a velocity u [s]."""
        return max(map(truediv, map(abs, velocity.tolist()), self._columns[3]))

    def towards(self, wish: Vector, previous: Vector, bounds: Bounds, dt: float) -> Vector:
        """The velocity within `bounds` that leads to `wish`, or to what the velocity limits leave of its direction.

        On the straight way from `previous`, as far as the acceleration limits go; then each joint is kept from
        its position limits by itself, so that a joint that is stopped there stops no other.
        """
        slowed = wish / float(np.max(np.abs(wish) / self.velocity, initial=1.0))
        change = slowed - previous
        longest = float(np.max(np.abs(change) / (self.acceleration * dt), initial=1.0))
        return np.clip(previous + change / longest, bounds.low, bounds.high)

    def with_rates(self, acceleration: ArrayLike | None, jerk: ArrayLike | None) -> Limits:
        """These limits with other accelerations and jerks; None keeps those there are.

        Raises:
            ConfigurationError: A limit that is not positive or has the wrong size.
        """
        if acceleration is None and jerk is None:
            return self
        other = copy.copy(self)
        if acceleration is not None:
            other.acceleration = per_joint("acceleration limit", acceleration, self.robot.joint_names)
        if jerk is not None:
            other.jerk = per_joint("jerk limit", jerk, self.robot.joint_names)
        other._prepare()
        return other

    def with_tip_speed(self, speed: float, frames: Sequence[str]) -> Limits:
        """Return these limits with a largest speed of more frames.

        Args:
            speed: Of the frames' origins [m/s]; the lower one counts where these limits have one already.
            frames: Names, beside those of these limits, whose box and walls then hold for all of them.

        Returns:
            Limits of the same robot.

        Raises:
            ConfigurationError: A speed that is not a positive number.
            UnknownNameError: No such frame.
        """
        other, own = copy.copy(self), self.tip or TipLimits(self.robot, None, None, None, ())
        names = tuple(dict.fromkeys([*(frame.name for frame in own.frames), *frames]))
        other.tip = TipLimits(self.robot, speed, None, own.walls, names, own.clear)
        other.tip.speed = min(other.tip.speed, own.speed)
        return other

    def may_approach(self, square: float, size: float, smallest: float, dt: float) -> bool:
        """Whether a velocity may approach a singularity too fast, so that a closer look is due.

        |grad sigma| is about as large as A itself.

        `square` is |u|^2, `size` |A|^2.
        """
        rate = min(APPROACH_RATE, 0.5 / dt) * smallest
        return square * size >= min(2.0 * BRAKING_SHARE * self.weakest * math.sqrt(size) * smallest, rate * rate)

    def freer_sense(self, q: Posture, direction: Vector) -> Vector:
        """A direction, or its opposite where position limits leave that more room."""
        x = q if q.shape[0] == self.robot.nv else self.robot.positions(q)
        fastest = float(np.max(np.abs(direction), initial=0.0))
        moves = np.abs(direction) > 1e-3 * fastest
        up, down, d = (self.upper - x)[moves], (x - self.lower)[moves], direction[moves]
        ahead, behind = (
            np.min(np.where(d > 0.0, *ways) / np.abs(d), initial=np.inf) for ways in ((up, down), (down, up))
        )
        return direction if fastest == 0.0 or ahead >= min(behind, ROOM_TO_LEAVE / fastest) else -direction


def bound_changes(bounds: Bounds, previous: Vector, accelerations: list[float], dt: float) -> Bounds:
    """Bounds narrowed in place to what acceleration limits allow in dt [s] after a velocity."""
    low, high = bounds.low, bounds.high
    for j, (u, a) in enumerate(zip(previous.tolist(), accelerations, strict=True)):
        slowest, fastest = u - a * dt, u + a * dt
        if slowest > low[j]:
            low[j], bounds.low_cause[j] = slowest, ACCELERATION
        if fastest < high[j]:
            high[j], bounds.high_cause[j] = fastest, ACCELERATION
        if low[j] > high[j]:  # too fast, or too far, for what the acceleration limit allows: it has precedence
            low[j] = high[j] = slowest if high[j] < slowest else fastest
    return bounds


def per_joint(what: str, values: ArrayLike, names: tuple[str, ...]) -> Vector:
    """Return one positive number for each joint.

    Args:
        what: They are, in words.
        values: shape (nv,) or a number.
        names: Of the joints.

    Returns:
        shape (nv,), not writable.

    Raises:
        ConfigurationError: A number that is not positive, or another number of them.
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
