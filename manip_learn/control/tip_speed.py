"""A limit on the speed of frames, as rows of the program that keeps a command within the limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar, final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip

# share of the speed that is given away, so that few rows do: the tangents at two points whose directions are 5 degrees
# apart let 0.1 % more through between them
RESERVE = 1e-3
MOST_ROWS = 12  # directions in which a speed was too large; in practice one to four
Barrier = tuple[Float[np.ndarray, "r nv"], Float[np.ndarray, " r"]]  # (G, least): rows G u >= least


class Solution(Protocol):
    """What a program answers."""

    @property
    def velocity(self) -> Float[np.ndarray, " nv"]:
        """The velocity found, shape (nv,) [rad/s or m/s]."""
        ...


S = TypeVar("S", bound=Solution)


@final
class TipSpeed:
    """|J_f(q) u| <= speed for the origin of each frame f.

    The ball is bounded by tangent planes, n^T J u <= speed, where it was exceeded: first at the velocity wished for,
    then, as long as one is needed, at the solution with those so far (Kelley, "The cutting-plane method for solving
    convex programs", 1960). Where the acceleration limits allow no velocity that is slow enough, they have precedence.

    Args:
        robot: The robot.
        speed: [m/s].
        frames: Name or names; None for the robot's likeliest tip.

    Raises:
        ConfigurationError: A speed that is not positive.
        UnknownNameError: No such frame.
    """

    def __init__(self, robot: Robot, speed: float, frames: str | Sequence[str] | None = None):
        if not (isinstance(speed, int | float) and 0.0 < speed < math.inf):
            raise ConfigurationError(f"tip_speed must be a positive number of metres per second, got {speed!r}")
        names = (default_tip(robot),) if frames is None else (frames,) if isinstance(frames, str) else tuple(frames)
        self.speed, self.frames = float(speed), tuple(robot.frame(name) for name in names)
        self._robot = robot

    def jacobians(self, q: Float[np.ndarray, " n"]) -> list[Float[np.ndarray, "3 nv"]]:
        """Of the frames' origins at a posture [m]."""
        return [self._robot.jacobian(q, frame)[:3] for frame in self.frames]

    def rows(self, jacobians: Sequence[np.ndarray], u: Float[np.ndarray, " nv"]) -> Barrier | None:
        """The tangents, where a frame is too fast at the velocity u; None where none is."""
        rows = []
        for J in jacobians:
            v = J.dot(u)
            fast = math.sqrt(v.dot(v))
            if fast > self.speed:
                rows.append((-v / fast).dot(J))
        return (np.array(rows), np.full(len(rows), self.speed * (RESERVE - 1.0))) if rows else None

    def slowed(self, q: Float[np.ndarray, " n"], u: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
        """A velocity, slowed down as a whole to what is allowed."""
        fastest = max(float(np.linalg.norm(J.dot(u))) for J in self.jacobians(q))
        return u if fastest <= self.speed else u * (self.speed / fastest)

    def bounded(
        self,
        jacobians: Sequence[np.ndarray],
        wish: Float[np.ndarray, " nv"],
        barrier: Barrier | None,
        solve: Callable[[Barrier | None], S],
    ) -> S:
        """The solution of the program with the rows that it needs.

        Args:
            jacobians: At this posture.
            wish: Velocity before limits.
            barrier: Rows of the program that are there already.
            solve: Rows -> solution.
        """
        u: np.ndarray = wish
        found: S | None = None
        for _ in range(MOST_ROWS):
            tangents = self.rows(jacobians, u)
            if tangents is None and found is not None:
                break
            if tangents is not None:
                G, least = tangents
                barrier = tangents if barrier is None else (np.vstack((barrier[0], G)), np.append(barrier[1], least))
            found = solve(barrier)
            u = found.velocity
        return solve(barrier) if found is None else found
