"""Limits on the speed and the place of frames, as rows of the program that keeps a command within the limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeVar, final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from manip_learn.control.singularity import BRAKING_SHARE, approach_rate
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip

# share of the speed that is given away, so that few rows do: the tangents at two points whose directions are 5 degrees
# apart let 0.1 % more through between them
RESERVE = 1e-3
MOST_ROWS = 12  # rounds in which a speed was too large; in practice one to four
Barrier = tuple[Float[np.ndarray, "r nv"], Float[np.ndarray, " r"]]  # (G, least): rows G u >= least


class Solution(Protocol):
    """What a program answers."""

    @property
    def velocity(self) -> Float[np.ndarray, " nv"]:
        """The velocity found, shape (nv,) [rad/s or m/s]."""
        ...


S = TypeVar("S", bound=Solution)


@final
class Tips(NamedTuple):
    """The limited frames at one posture.

    Attributes:
        jacobians: Of the frames' origins, each (3, nv) [m].
        G: shape (w, nv), minus the rate at which each frame approaches each wall, per unit of joint velocity.
        least: shape (w,) [m/s], minus the rates that are allowed.
    """

    jacobians: list[Float[np.ndarray, "3 nv"]]
    G: Float[np.ndarray, "w nv"]
    least: Float[np.ndarray, " w"]

    def too_near(self, u: Float[np.ndarray, " nv"]) -> Bool[np.ndarray, " w"]:
        """Which walls the velocity u approaches too fast."""
        return self.G.dot(u) < self.least


@final
class TipLimits:
    """|J_f(q) u| <= speed, and n^T p_f(q) <= d for each wall (n, d), for the origin p_f of each frame f.

    The ball of velocities is bounded by tangent planes, n^T J u <= speed, where it was exceeded: first at the velocity
    wished for, then, as long as one is needed, at the solution with those so far (Kelley, "The cutting-plane method for
    solving convex programs", 1960). A wall is approached no faster than `singularity.approach_rate` of its distance, so
    that the joints can stop the frame there; a frame beyond a wall returns. No more is asked of a step than
    BRAKING_SHARE of what the acceleration limits allow all joints together. Where they allow no velocity that keeps all
    this, they have precedence.

    Args:
        robot: The robot.
        speed: [m/s]; None for no limit.
        walls: shape (w, 4), rows (n, d), n of any length but 0 in the base frame, d [m] times that length.
        frames: Name or names; None for the robot's likeliest tip.

    Raises:
        ConfigurationError: A speed that is not positive, walls that are none.
        UnknownNameError: No such frame.
    """

    def __init__(self, robot: Robot, speed: float | None, walls: ArrayLike, frames: str | Sequence[str] | None = None):
        if speed is not None and not (isinstance(speed, int | float) and 0.0 < speed < math.inf):
            raise ConfigurationError(f"tip_speed must be a positive number of metres per second, got {speed!r}")
        rows = np.array(walls, dtype=np.float64).reshape(-1, 4)
        lengths = np.linalg.norm(rows[:, :3], axis=1)
        if not (np.all(np.isfinite(rows)) and np.all(lengths > 0.0)):
            raise ConfigurationError(f"walls must be rows (nx, ny, nz, d) with n^T p <= d, got {rows.tolist()}")
        names = (default_tip(robot),) if frames is None else (frames,) if isinstance(frames, str) else tuple(frames)
        self.speed = math.inf if speed is None else float(speed)
        self.frames = tuple(robot.frame(name) for name in names)
        self.walls = rows / lengths[:, None]
        self._robot = robot

    def at(
        self,
        q: Float[np.ndarray, " n"],
        dt: float,
        acceleration: Float[np.ndarray, " nv"],
        previous: Float[np.ndarray, " nv"] | None,
    ) -> Tips:
        """The frames at a posture.

        Args:
            q: Posture.
            dt: Time for which the next velocity is held [s].
            acceleration: Of the joints [rad/s2 or m/s2].
            previous: Velocity commanded in the step before [rad/s or m/s]; None bounds no acceleration.
        """
        jacobians = [self._robot.jacobian(q, frame)[:3] for frame in self.frames]
        if not self.walls.size:
            return Tips(jacobians, np.empty((0, self._robot.nv)), np.empty(0))
        normals, offsets = self.walls[:, :3], self.walls[:, 3]
        G = np.vstack([normals.dot(J) for J in jacobians])
        left = np.concatenate([offsets - normals.dot(self._robot.position(q, frame)) for frame in self.frames])
        acceleration = np.minimum(acceleration, 1e12)  # inf for none; what follows must stay finite
        least = -np.array([approach_rate(x, g, acceleration, dt) for x, g in zip(left.tolist(), G, strict=True)])
        if previous is not None:
            least = np.minimum(least, BRAKING_SHARE * dt * np.abs(G).dot(acceleration) - G.dot(previous))
        return Tips(jacobians, -G, least)

    def rows(self, tips: Tips, u: Float[np.ndarray, " nv"]) -> Barrier | None:
        """What the velocity u breaks: tangents where a frame is too fast, and walls; None where nothing."""
        broken = tips.too_near(u)
        rows, least = list(tips.G[broken]), tips.least[broken].tolist()
        for J in tips.jacobians:
            v = J.dot(u)
            fast = math.sqrt(v.dot(v))
            if fast > self.speed:
                rows.append((-v / fast).dot(J))
                least.append(self.speed * (RESERVE - 1.0))
        return (np.array(rows), np.array(least)) if rows else None

    def slowed(self, tips: Tips, u: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
        """A velocity, slowed down as a whole to what is allowed; at rest where that is none."""
        fastest = max(float(np.linalg.norm(J.dot(u))) for J in tips.jacobians)
        rates, shares = tips.G.dot(u), [min(1.0, self.speed / max(fastest, 1e-300))]
        shares += [max(0.0, b) / r for r, b in zip((-rates).tolist(), (-tips.least).tolist(), strict=True) if r > b]
        return u * max(0.0, min(shares))

    def bounded(
        self, tips: Tips, wish: Float[np.ndarray, " nv"], barrier: Barrier | None, solve: Callable[[Barrier | None], S]
    ) -> S:
        """The solution of the program with the rows that it needs.

        Args:
            tips: At this posture.
            wish: Velocity before limits.
            barrier: Rows of the program that are there already.
            solve: Rows -> solution.
        """
        u: np.ndarray = wish
        found: S | None = None
        for _ in range(MOST_ROWS):
            broken = self.rows(tips, u)
            if broken is None and found is not None:
                break
            if broken is not None:
                G, least = broken
                barrier = broken if barrier is None else (np.vstack((barrier[0], G)), np.append(barrier[1], least))
            found = solve(barrier)
            u = found.velocity
        return solve(barrier) if found is None else found


def walls_of(box: ArrayLike | None, walls: ArrayLike | None) -> Float[np.ndarray, "w 4"]:
    """Walls as rows (n, d) with n^T p <= d, those of a box before the others.

    Args:
        box: shape (2, 3), lowest and highest x, y, z [m]; -inf and inf for none.
        walls: shape (w, 4).

    Raises:
        ConfigurationError: Numbers of another shape, or a box without room.
    """
    rows = np.empty((0, 4)) if walls is None else np.array(walls, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 4:
        raise ConfigurationError(f"walls must be rows (nx, ny, nz, d) with n^T p <= d, got shape {rows.shape}")
    if box is None:
        return rows
    sides = np.array(box, dtype=np.float64)
    if sides.shape != (2, 3) or not np.all(sides[0] < sides[1]):
        raise ConfigurationError(
            f"a box is two rows, lowest and highest x, y, z [m], the first below the second; got {sides.tolist()}"
        )
    unit = np.eye(3)
    faces = np.vstack((np.column_stack((-unit, -sides[0])), np.column_stack((unit, sides[1]))))
    return np.vstack((faces[np.isfinite(faces[:, 3])], rows))
