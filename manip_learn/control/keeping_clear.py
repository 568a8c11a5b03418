"""Links that keep clear of each other and of what stands around: rows for the law's program, where they are needed."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Protocol, final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import ConfigurationError
from manip_learn.robot.collision import Obstacle, SelfCollision, Shapes, known_shapes
from manip_learn.robot.robot import Robot

Barrier = tuple[Float[np.ndarray, "r nv"], Float[np.ndarray, " r"]]  # (G, least): rows G u >= least
# [m] from links to each other and to what stands around, in plans too: what a servo's lag makes of a path; links that
# are neighbours come within 2 cm
CLEARANCE = 0.005
# [m] beyond the clearance, which rows aim at: their solutions are within it after one or two rounds; and as a share of
# the way until then, for between the postures that are looked at surfaces may be 1 % of it nearer
AIMED, FUNNEL = 2e-5, 0.02
# of the time until the arm stands; one that brakes as hard as it can stands at half of it
LOOKED_AT = 0.25, 0.5, 1.0
_ROUNDED = 1e-9  # [m] of Coal's distances
_AT_REST = 1e-3  # [m] beyond the clearance: what is farther away has slowed the arm down, and does not stop it


class Standing(Protocol):
    """What stands around a robot, as a `Scene`."""

    def obstacles(self, robot: Robot) -> tuple[Obstacle, ...]:
        """What its links keep clear of."""
        ...


@lru_cache(maxsize=8)
def _hulls_of(robot: Robot, shapes: Shapes) -> SelfCollision:
    """The pairs of a robot's links."""
    return SelfCollision(robot, shapes=shapes)


@final
class KeptClear:
    """Pairs of shapes that stay at a distance from each other.

    Where an arm at q would be after a time t at the velocity u, no pair may be nearer than the clearance, or than it is
    now if that is less. The pairs that are get rows, tangents of their distances d at x = q + t u:

        d(x) + grad d(x) . t (v - u) >= clearance

    Where shapes would overlap there, x is a posture on the way where they do not yet: the depth of an overlap says
    little of the way out. The law's program gets the rows where its solution breaks what is asked for, until it does
    not, as for `TipLimits`.

    A pair that no joint could bring near in that time is not looked at: a distance that was known at another posture
    has changed by at most sum_j lever_j |dq_j| since.

    Args:
        robot: The robot.
        around: Its pairs of shapes, or what stands around it.
        clearance: [m].

    Raises:
        ConfigurationError: Pairs of another robot, something that is none, or no distance.
    """

    def __init__(self, robot: Robot, around: SelfCollision | Standing, clearance: float):
        if not isinstance(around, SelfCollision):
            shapes = known_shapes(robot)  # capsules along links overlap where these are joined
            around = _hulls_of(robot, shapes).with_obstacles(around.obstacles(robot), own=shapes != "links")
        if around.robot is not robot:
            raise ConfigurationError(
                f"clear_of is of another {around.robot.name!r}; give pairs of the robot of the limits"
            )
        if not (math.isfinite(clearance) and clearance >= 0.0):
            raise ConfigurationError(
                f"clearance is {clearance!r}; a distance of at least 0 is expected [m]; correct it"
            )
        self.pairs, self.clearance, self._robot = around, float(clearance), robot
        q, n = robot.neutral(), len(around.levers)
        # a posture, distances there or less, and which of them are known
        self._known = q, np.full(n, -math.inf), np.zeros(n, dtype=bool)
        self._clear = q, q  # posture and velocity that were last found clear
        self._nearest: tuple[float, tuple[str, str]] | None = None

    def rows(
        self,
        q: Float[np.ndarray, " n"],
        u: Float[np.ndarray, " nv"],
        dt: float,
        longest: float,
        slope: Float[np.ndarray, " nv"],
    ) -> Barrier | None:
        """What must hold of v so that no pair is too near where it leads; None if u itself leads nowhere near.

        The arm stands after `longest` [s], whose gradient by the velocity is `slope`.
        """
        (posture, here, known), levers, clearance = self._known, self.pairs.levers, self.clearance
        if not np.array_equal(posture, q):
            here, known = here - levers.dot(np.abs(self._robot.difference(posture, q))), np.zeros_like(known)
        reach, rows, least, nearest = levers.dot(np.abs(u)), [], [], None
        close = here - longest * reach < clearance
        if (new := np.flatnonzero(close & ~known)).size:
            here, known = here.copy(), known.copy()
            here[new], known[new] = self.pairs.distances(q, new.tolist()), True
            self._known = q.copy(), here, known
            close = here - longest * reach < clearance
        for time, share in ((dt, 0.0), *((longest * x, x) for x in LOOKED_AT)) if close.any() else ():
            close = np.flatnonzero(here - time * reach < clearance).tolist()
            there = self.pairs.closer_than(self._robot.integrate(q, time * u), clearance, only=close) if close else ()
            for pair in there:
                allowed = min(clearance, float(here[pair.number]))
                if pair.distance >= allowed - _ROUNDED:
                    continue
                nearest = min(nearest or (math.inf, pair.links), (float(here[pair.number]), pair.links))
                at = time
                while pair.distance < 0.0 < allowed:
                    at *= 0.5
                    x = self._robot.integrate(q, at * u)
                    pair = self.pairs.closer_than(x, math.inf, only=(pair.number,))[0]  # noqa: PLW2901
                rate = float(pair.gradient.dot(u))
                rows.append(pair.gradient + rate * share / time * slope)
                away = allowed - pair.distance + AIMED * time / longest + FUNNEL * time * float(reach[pair.number])
                least.append(float(rows[-1].dot(u)) - (1.0 - at / time) * rate + away / time)
        if nearest is None:
            self._clear = q.copy(), u.copy()
            return None
        self._nearest = nearest
        return np.array(rows), np.array(least)

    def was_clear(self, q: Float[np.ndarray, " n"], u: Float[np.ndarray, " nv"]) -> bool:
        """Whether this velocity at this posture is the latest for which there were no rows."""
        return np.array_equal(self._clear[0], q) and np.array_equal(self._clear[1], u)

    def words(self) -> str | None:
        """Which two things were the nearest ones and how near, if that stops the arm."""
        if self._nearest is None or self._nearest[0] > self.clearance + _AT_REST:
            return None
        distance, (link, other) = self._nearest
        the = "the " if other in {obstacle.name for obstacle in self.pairs.obstacles} else ""
        return f"{link} {1e3 * distance:.0f} mm from {the}{other}"
