"""Barriers: linear inequalities on the joint velocity that keep hand and links away from walls and obstacles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Protocol, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.control.command import POSITION, VELOCITY, Posture, Vector
from manip_learn.errors import ConfigurationError
from manip_learn.robot.collision import Obstacle, SelfCollision, Shapes, known_shapes
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip

Barrier = tuple[Float[np.ndarray, "r nv"], Float[np.ndarray, " r"]]  # (G, least): rows G u >= least
# [1/s] rate at which a barrier is approached exponentially at the end of the braking distance; barriers are the
# singularities (in terms of the smallest singular value), the position limits and the walls of the hand
APPROACH_RATE = 20.0
BRAKING_SHARE = 0.5  # share of the joints' acceleration for braking before a wall; the rest keeps the task on its path
# [m] distance between links, and between links and obstacles, in plans too: it covers the path error due to servo lag;
# adjacent links come within 2 cm
CLEARANCE = 0.005


def approach_gain(dt: float) -> float:
    """Return the rate kappa of an exponential approach to a barrier: `APPROACH_RATE`, but at most half a gap a step.

    Args:
        dt: Step [s].

    Returns:
        The rate [1/s].
    """
    return min(APPROACH_RATE, 0.5 / dt)


def approach_rate(distance: float, slope: Vector, acceleration: Vector, dt: float) -> float:
    """Return the largest rate at which a distance may fall, so that the joints can stop where it is 0.

        rate = min(kappa x, sqrt(2 a x)),   a = BRAKING_SHARE |g| min_j (a_j / |n_j|),   n = g / |g|

    The distance `x` is e.g. the smallest singular value of A, or the distance of a frame from a wall; `g` is its
    gradient, `a_j` are the acceleration limits of the joints, and `kappa` is `approach_gain(dt)`.

    Args:
        distance: `x`, in any unit; negative if the limit is already exceeded.
        slope: `g` (nv,), gradient of `x` with respect to the joint positions [unit of x per rad or m].
        acceleration: Acceleration limits (nv,) [rad/s2 or m/s2].
        dt: Step [s].

    Returns:
        The rate [unit of x per second]; negative if `x` is negative: then `x` must grow.
    """
    largest, square = float((np.abs(slope) / acceleration).max()), float(slope.dot(slope))
    deceleration = BRAKING_SHARE * square / largest if largest > 0.0 else math.inf
    return min(approach_gain(dt) * distance, math.sqrt(2.0 * deceleration * max(distance, 0.0)))


def approach_bound(smallest: float, slope: Vector, acceleration: Vector, dt: float) -> float:
    """Return the largest rate at which the smallest singular value may fall, so that the arm can stop at 0.

    The bound is the sum of two rates: `approach_rate`, and 5e-4 rad/s times the norm of the gradient of sigma, with
    which a singularity may be crossed. A task whose target is out of reach presses the arm against a singularity (a
    stretched elbow), with joint velocities that grow as 1 / sigma until they change sign from step to step. With the
    bound the arm comes to rest there.

    Args:
        smallest: Smallest singular value sigma of A, in the constraint's units (m or 1).
        slope: Gradient of sigma with respect to the joint positions (nv,) [unit of sigma per rad or m].
        acceleration: Acceleration limits (nv,) [rad/s2 or m/s2].
        dt: Step [s].

    Returns:
        The rate [unit of sigma per second]; inf where the gradient is zero.
    """
    length = math.sqrt(slope.dot(slope))
    return 5e-4 * length + approach_rate(smallest, slope, acceleration, dt) if length > 0.0 else math.inf


class Obstacles(Protocol):
    """Source of the obstacles around a robot, e.g. a `Scene`."""

    def obstacles(self, robot: Robot) -> tuple[Obstacle, ...]:
        """Return the obstacles that the robot's links avoid.

        Args:
            robot: The robot; each obstacle's `may_touch` lists the links that may touch it.
        """
        ...


@lru_cache(maxsize=8)
def _hulls_of(robot: Robot, shapes: Shapes) -> SelfCollision:
    """Return the pairs of a robot's own links, built once per robot."""
    return SelfCollision(robot, shapes=shapes)


@final
class CollisionAvoidance:
    """Collision avoidance: pairs of shapes that stay at a distance from each other.

    No pair may come nearer than the clearance, or than its present distance if that is smaller. This holds in the next
    step and at x = q + t u, where the arm comes to rest if it brakes along its velocity u after that step. Braking uses
    BRAKING_SHARE of the acceleration limits, and ends exponentially. Each pair that would come nearer gets a row, the
    linearisation of its distance d at x = q + t u:

        d(x) + grad d(x) . t (v - u) >= clearance

    If the shapes would overlap at x, x is moved back along the motion until they do not: the gradient of the depth of
    an overlap is a poor guide to its exit. Rows are added and the quadratic program is solved again until its solution
    violates none, as for `Barriers`.

    A pair that is too far apart to come near in that time is skipped. Its distance is not computed again at each
    posture: when the joints move by dq, it changes by at most sum_j lever_j |dq_j|.

    Args:
        robot: The robot.
        around: Pairs of shapes of this robot, or a source of the obstacles around it, such as a `Scene`.
        clearance: Distance to keep [m].

    Raises:
        ConfigurationError: The pairs belong to another robot, or the clearance is negative or not finite.
    """

    def __init__(self, robot: Robot, around: SelfCollision | Obstacles, clearance: float):
        if not isinstance(around, SelfCollision):
            shapes = known_shapes(robot)  # capsules along links overlap where these are joined
            around = _hulls_of(robot, shapes).with_obstacles(around.obstacles(robot), own=shapes != "links")
        if around.robot is not robot:
            raise ConfigurationError(f"clear_of was built for {around.robot.name!r}: use the robot of these limits")
        if not (math.isfinite(clearance) and clearance >= 0.0):
            raise ConfigurationError(f"clearance is {clearance!r}: pass a distance of at least 0 [m]")
        self.pairs, self.clearance, self._robot = around, float(clearance), robot
        q, n = robot.neutral(), len(around.levers)
        # a posture, lower bounds of the distances there, and a mask of the bounds that are the distances themselves
        self._cache = q, np.full(n, -math.inf), np.zeros(n, dtype=bool)
        self._nearest: tuple[float, tuple[str, str]] | None = None
        self._clear = q, q  # posture and velocity of the newest check without rows

    def rows(self, q: Posture, dt: float, acceleration: Vector, before: Vector | None, u: Vector) -> Barrier | None:
        """Return the rows that keep all pairs apart in the next step, or None if u brings no pair too near.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            dt: Step [s].
            acceleration: Acceleration limits (nv,) [rad/s2 or m/s2].
            before: Velocity of the previous step (nv,) [rad/s or m/s]; u is clipped to the velocities that the
                acceleration limits allow after it. None does not clip.
            u: Velocity (nv,) to check [rad/s or m/s].

        Returns:
            `(G, least)`: the rows (r, nv), and lower bounds (r,) [m/s] on G v for the commanded velocity v.
        """
        (posture, here, exact), levers, clearance = self._cache, self.pairs.levers, self.clearance
        if not np.array_equal(posture, q):
            here, exact = here - levers.dot(np.abs(self._robot.difference(posture, q))), np.zeros_like(exact)
        u = u if before is None else np.clip(u, before - dt * acceleration, before + dt * acceleration)
        # the arm is at rest after the longest of the stopping times; slope is its gradient by the velocity
        times, slope, longest = 0.5 / BRAKING_SHARE * np.abs(u) / acceleration, np.zeros_like(u), 1.0 / APPROACH_RATE
        longest, j = max(longest, 2.0 * dt), int(np.argmax(times))
        if times[j] > longest:
            longest, slope[j] = float(times[j]), times[j] / u[j]
        reach, rows, least, nearest = levers.dot(np.abs(u)), [], [], None
        close = here - longest * reach < clearance
        if (new := np.flatnonzero(close & ~exact)).size:
            here, exact = here.copy(), exact.copy()
            here[new], exact[new] = self.pairs.distances(q, new.tolist()), True
            self._cache = q.copy(), here, exact
            close = here - longest * reach < clearance
        # an arm that brakes with all of its acceleration is at rest after half of the longest time
        checkpoints = ((dt, 0.0), *((longest * x, x) for x in (0.25, 0.5, 1.0))) if close.any() else ()
        for time, share in checkpoints:
            close = np.flatnonzero(here - time * reach < clearance).tolist()
            there = self.pairs.closer_than(self._robot.integrate(q, time * u), clearance, only=close) if close else ()
            for pair in there:
                allowed = min(clearance, float(here[pair.number]))
                if pair.distance >= allowed - 1e-9:  # [m] rounding of Coal's distances
                    continue
                nearest = min(nearest or (math.inf, pair.links), (float(here[pair.number]), pair.links))
                at = time
                while pair.distance < 0.0 < allowed:
                    at *= 0.5
                    x = self._robot.integrate(q, at * u)
                    pair = self.pairs.closer_than(x, math.inf, only=(pair.number,))[0]  # noqa: PLW2901
                rate = float(pair.gradient.dot(u))
                rows.append(pair.gradient + rate * share / time * slope)
                # rows aim 0.02 mm beyond the clearance, so that one or two rounds suffice, and 2 % of the travel
                # until then: between the postures that are checked surfaces may be nearer by 1 % of that travel
                gap = allowed - pair.distance + 2e-5 * time / longest + 0.02 * time * float(reach[pair.number])
                least.append(float(rows[-1].dot(u)) - (1.0 - at / time) * rate + gap / time)
        if nearest is None:
            self._clear = q.copy(), u.copy()
            return None
        self._nearest = nearest
        return np.array(rows), np.array(least)

    def is_latest_clear(self, q: Posture, u: Vector) -> bool:
        """Return True if `rows` last found this velocity free of collisions at this posture.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            u: Velocity (nv,) [rad/s or m/s].
        """
        return np.array_equal(self._clear[0], q) and np.array_equal(self._clear[1], u)

    def describe_nearest(self) -> str | None:
        """Return the nearest pair and its distance in words, or None if it is too far apart to stop the arm."""
        if self._nearest is None or self._nearest[0] > self.clearance + 1e-3:
            return None  # a pair that is a millimetre farther apart has slowed the arm down, but does not stop it
        distance, (link, other) = self._nearest
        the = "the " if other in {obstacle.name for obstacle in self.pairs.obstacles} else ""
        return f"{link} {1e3 * distance:.0f} mm from {the}{other}"


@final
@dataclass(frozen=True, eq=False)
class PostureBarriers:
    """Barriers at one posture.

    Attributes:
        speed: Largest speed of the frames [m/s].
        jacobians: Jacobians of the frames' origins, each (3, nv) [m].
        G: shape (w, nv); G u is minus the rate at which each frame approaches each wall [m/s] at joint velocity u.
        least: shape (w,), lower bounds on G u [m/s]: minus the allowed rates of approach.
        clear: Function of a joint velocity (nv,) that returns the rows for the pairs of shapes which this velocity
            would bring too near, or None if there are none; None without collision avoidance.
    """

    speed: float
    jacobians: Sequence[Float[np.ndarray, "3 nv"]]
    G: Float[np.ndarray, "w nv"]
    least: Float[np.ndarray, " w"]
    clear: Callable[[Vector], Barrier | None] | None

    def broken(self, u: Vector, slack: float = 0.0) -> tuple[Barrier, int] | None:
        """Return the rows that a velocity violates, and the kind of limit.

        Rows stand for walls, for pairs of shapes that come too near, and for frames that are too fast (a tangent plane
        of the ball of allowed velocities).

        Args:
            u: Velocity (nv,) [rad/s or m/s].
            slack: Tolerance for the rate of approach to a wall [m/s].

        Returns:
            `((G, least), kind)`: rows and lower bounds of G u, and POSITION if a wall or a pair of shapes is
            concerned, or VELOCITY for frames' speeds alone. None if the velocity violates no row.
        """
        rows, least = list[Vector](), list[float]()
        if len(self.least):
            broken = self.G.dot(u) < self.least - slack
            rows, least = list(self.G[broken]), self.least[broken].tolist()
        if self.clear is not None and (near := self.clear(u)) is not None:
            rows, least = [*rows, *near[0]], [*least, *near[1]]
        cause = POSITION if rows else VELOCITY
        for J in self.jacobians:
            v = J.dot(u)
            fast = math.sqrt(v.dot(v))
            if fast > self.speed:
                rows.append((-v / fast).dot(J))
                # the limit is lowered by a thousandth, so that few tangents suffice: between two tangents whose
                # directions differ by 5 degrees the speed exceeds the limit by as much
                least.append((1e-3 - 1.0) * self.speed)
        return ((np.array(rows), np.array(least)), cause) if rows else None

    def slowed(self, u: Vector) -> Vector:
        """Scale a velocity down until walls and the frames' speed limit allow it; to zero if they allow no motion.

        Args:
            u: Velocity (nv,) [rad/s or m/s].

        Returns:
            The scaled velocity (nv,) [rad/s or m/s].
        """
        fastest = max((float(np.linalg.norm(J.dot(u))) for J in self.jacobians), default=0.0)
        rates, shares = self.G.dot(u), [min(1.0, self.speed / max(fastest, 1e-300))]
        shares += [max(0.0, b) / r for r, b in zip((-rates).tolist(), (-self.least).tolist(), strict=True) if r > b]
        return u * max(0.0, min(shares))

    def solution(self, wish: Vector, barrier: Barrier | None, solve: Callable[[Barrier | None], Vector]) -> Vector:
        """Solve a program, adding violated rows until the solution violates none.

        Args:
            wish: Desired velocity (nv,) [rad/s or m/s]; the rows that it violates are added before the first solution.
            barrier: Rows that the program has from the beginning; None for none.
            solve: Function that solves the program with given rows (or None), and returns the velocity (nv,).

        Returns:
            The solution (nv,) [rad/s or m/s]. If the joint bounds leave no velocity that satisfies all rows, it
            satisfies the bounds and violates rows.
        """
        u, result = wish, None
        for _ in range(12):  # rounds; in practice one to four
            broken = self.broken(u, 1e-12)  # [m/s] rounding of a speed of 1
            if broken is None and result is not None:
                break
            if broken is not None:
                G, least = broken[0]
                barrier = broken[0] if barrier is None else (np.vstack((barrier[0], G)), np.append(barrier[1], least))
            u = result = solve(barrier)
            if barrier is not None and np.any(barrier[0].dot(u) < barrier[1] - 1e-6):
                break  # [m/s] there is no solution: bounds have precedence
        return u


@final
class Barriers:
    """Limits of the speed and the position of frames, and collision avoidance.

        |J_f(q) u| <= speed,    n^T p_f(q) <= d    for the origin p_f of each frame f and each wall (n, d)

    The speed limit is not linear: it allows a ball of velocities. Where a velocity leaves the ball, the program gets a
    tangent plane of it, n^T J u <= speed: first at the desired velocity, then at each solution, until the solution is
    inside (Kelley, "The cutting-plane method for solving convex programs", 1960). The rate at which a frame approaches
    a wall is at most `approach_rate` of its distance, so that the joints can stop the frame there; a frame beyond a
    wall returns. Per step, the rows demand at most BRAKING_SHARE of the change of that rate which all joints together
    can make at their acceleration limits. If the joint bounds leave no velocity that satisfies all rows, the bounds
    have precedence.

    Args:
        robot: The robot.
        speed: Largest speed of the frames' origins [m/s]; None for no limit.
        box: shape (2, 3), lowest and highest x, y, z of the frames' origins in the base frame [m], -inf and inf for
            no limit.
        walls: shape (w, 4), rows (n, d): origins p stay where n^T p <= d. The normal n is in the base frame, of any
            length but 0; d is the distance of the wall from the base's origin [m] times that length.
        frames: Name or names of the limited frames; None for the robot's likeliest tip.
        clear: Collision avoidance; None for none.

    Raises:
        ConfigurationError: The speed is not positive, the box is empty, or the walls are invalid.
        UnknownNameError: The robot has no such frame.
    """

    def __init__(
        self,
        robot: Robot,
        speed: float | None,
        box: ArrayLike | None = None,
        walls: ArrayLike | None = None,
        frames: str | Sequence[str] | None = None,
        clear: CollisionAvoidance | None = None,
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
                rows_of_box = "two rows, lowest and highest x, y, z [m], the first below the second"
                raise ConfigurationError(f"a box is {rows_of_box}; got {sides.tolist()}")
            faces = np.vstack((np.column_stack((-unit, -sides[0])), np.column_stack((unit, sides[1]))))
            rows = np.vstack((faces[np.isfinite(faces[:, 3])], rows))
        if frames is None:
            frames = () if speed is None and not len(rows) else default_tip(robot)
        names = (frames,) if isinstance(frames, str) else tuple(frames)
        self.speed = math.inf if speed is None else float(speed)
        self.frames = tuple(robot.frame(name) for name in names)
        self.walls = rows / np.linalg.norm(rows[:, :3], axis=1, keepdims=True)
        self.clear, self._robot = clear, robot
        self._none = PostureBarriers(self.speed, (), np.empty((0, robot.nv)), np.empty(0), None)

    def at(self, q: Posture, dt: float, acceleration: Vector, previous: Vector | None) -> PostureBarriers:
        """Return the barriers at a posture.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            dt: Step [s].
            acceleration: Acceleration limits (nv,) [rad/s2 or m/s2]; inf for no limit.
            previous: Velocity of the previous step (nv,) [rad/s or m/s]; None if there was none.
        """
        if not self.frames and self.clear is None:
            return self._none
        jacobians = [self._robot.jacobian(q, frame)[:3] for frame in self.frames]
        clear = None if self.clear is None else partial(self.clear.rows, q, dt, acceleration, previous)
        G, distances = np.empty((0, self._robot.nv)), np.empty(0)
        if self.walls.size and jacobians:
            normals, offsets = self.walls[:, :3], self.walls[:, 3]
            G = np.vstack([normals.dot(J) for J in jacobians])
            distances = np.concatenate([offsets - normals.dot(self._robot.position(q, frame)) for frame in self.frames])
        acceleration = np.minimum(acceleration, 1e12)  # inf for no limit, but the products below must stay finite
        least = -np.array([approach_rate(x, g, acceleration, dt) for x, g in zip(distances.tolist(), G, strict=True)])
        if previous is not None:
            least = np.minimum(least, BRAKING_SHARE * dt * np.abs(G).dot(acceleration) - G.dot(previous))
        return PostureBarriers(self.speed, jacobians, -G, least, clear)

    @property
    def pace(self) -> float:
        """Frame speed for which motions are planned [m/s]: 98 % of the speed limit.

        The remaining 2 % are for corrections; within a step of 0.01 s at 0.25 m/s a frame becomes 1 % faster.
        """
        return 0.98 * self.speed

    def fastest(self, q: Posture, u: Vector) -> float:
        """Return the speed of the fastest frame [m/s]; 0 without frames.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            u: Joint velocity (nv,) [rad/s or m/s].
        """
        return max((math.hypot(*self._robot.jacobian(q, frame)[:3].dot(u)) for frame in self.frames), default=0.0)
