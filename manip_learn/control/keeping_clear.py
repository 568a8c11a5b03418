"""Links that keep clear of each other and of what stands around: rows for the law's program, where they are needed."""

from __future__ import annotations

import math
from typing import Protocol, final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import ConfigurationError
from manip_learn.robot.collision import Obstacle, Proximity, SelfCollision, links_of
from manip_learn.robot.robot import Robot

Barrier = tuple[Float[np.ndarray, "r nv"], Float[np.ndarray, " r"]]  # (G, least): rows G u >= least
CLEARANCE = 0.005  # [m] default distance of links from each other and from what stands around, as that of plans
AIMED = 2e-5  # [m] beyond the clearance, which rows aim at: their solutions are within it after one or two rounds
ROUNDED = 1e-9  # [m] of Coal's distances
AT_REST = 1e-3  # [m] beyond the clearance: what is farther away has slowed the arm down, and does not stop it


class Standing(Protocol):
    """What stands around a robot, as a `Scene`."""

    def obstacles(self, robot: Robot) -> tuple[Obstacle, ...]:
        """What its links keep clear of."""
        ...


@final
class KeptClear:
    """Pairs of shapes that stay at a distance from each other.

    Where an arm at q would be after a time t at the velocity u, no pair may be nearer than the clearance, or than it is
    now if that is less. The pairs that are get rows, tangents of their distances d at x = q + t u:

        d(x) + grad d(x) . t (v - u) >= clearance

    Where shapes would overlap there, x is q: the depth of an overlap says little of the way out.

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
            links, shapes = links_of(robot)
            around = links.with_obstacles(around.obstacles(robot), own=shapes != "links")
        if around.robot is not robot:
            raise ConfigurationError(
                f"clear_of is of another {around.robot.name!r}; give pairs of the robot of the limits"
            )
        if not (math.isfinite(clearance) and clearance >= 0.0):
            raise ConfigurationError(
                f"clearance is {clearance!r}; a distance of at least 0 is expected [m]; correct it"
            )
        self.pairs, self.clearance, self._robot = around, float(clearance), robot
        q = robot.neutral()
        self._known = q, np.full(len(around.levers), -math.inf)  # distances at least, at a posture
        self._clear: tuple[np.ndarray, np.ndarray] = q, q  # posture and velocity that were last found clear
        self._nearest: Proximity | None = None

    def rows(self, q: Float[np.ndarray, " n"], u: Float[np.ndarray, " nv"], times: tuple[float, ...]) -> Barrier | None:
        """What must hold of v so that no pair is too near where it leads; None if u itself leads nowhere near.

        Args:
            q: Posture.
            u: Velocity [rad/s or m/s].
            times: t [s].
        """
        posture, least = self._known
        reach = self.pairs.levers.dot(np.abs(u))
        here = least if posture is q else least - self.pairs.levers.dot(np.abs(self._robot.difference(posture, q)))
        close = here - max(times) * reach < self.clearance
        now = dict[int, Proximity]()
        if close.any():
            now = {p.number: p for p in self.pairs.closer_than(q, math.inf, only=np.flatnonzero(close))}
            here = here.copy()
            here[list(now)] = [p.distance for p in now.values()]
            self._known = q, here
        G, least_rates, near = list[np.ndarray](), list[float](), list[Proximity]()
        for time in times:
            close = np.flatnonzero(here - time * reach < self.clearance)
            there = (
                self.pairs.closer_than(self._robot.integrate(q, time * u), self.clearance, only=close)
                if len(close)
                else []
            )
            for pair in there:
                allowed = min(self.clearance, here[pair.number])
                if pair.distance >= allowed - ROUNDED:
                    continue
                near.append(now[pair.number])
                x, start = (pair, u) if pair.distance > 0.0 or allowed < 0.0 else (now[pair.number], 0.0 * u)
                G.append(x.gradient)
                least_rates.append(float(x.gradient.dot(start)) + (allowed + AIMED - x.distance) / time)
        if not G:
            self._clear = q, u
            return None
        self._nearest = min(near, key=lambda pair: pair.distance)
        return np.array(G), np.array(least_rates)

    def was_clear(self, q: Float[np.ndarray, " n"], u: Float[np.ndarray, " nv"]) -> bool:
        """Whether this velocity at this posture is the latest for which there were no rows."""
        return np.array_equal(self._clear[0], q) and np.array_equal(self._clear[1], u)

    def words(self) -> str | None:
        """Which two things were the nearest ones and how near, if that stops the arm."""
        pair = self._nearest
        if pair is None or pair.distance > self.clearance + AT_REST:
            return None
        the = "the " if pair.links[1] in {obstacle.name for obstacle in self.pairs.obstacles} else ""
        return f"{pair.links[0]} {1e3 * pair.distance:.0f} mm from {the}{pair.links[1]}"
