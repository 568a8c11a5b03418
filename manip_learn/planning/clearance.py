"""Collision checks against the arm itself and against the scene.

Without a scene, only a floor under the base is assumed. It lies below all postures of the recordings and of the start.
The hand may penetrate a handled object no deeper than it has to at the grasp.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise, product
from typing import Any, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.control.barriers import CLEARANCE
from manip_learn.planning.scene import Scene
from manip_learn.robot.collision import (
    Obstacle,
    Proximity,
    SelfCollision,
    collision_shapes,
    describe_shapes,
    known_shapes,
    missing_meshes,
)
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot

FLOOR = "floor"
_TOLERANCE = 1e-3  # [m] tolerance of the penetration at the grasp: a moving hand shakes a little
Posture = Float[np.ndarray, " nv"]
Links = SelfCollision | bool  # pairs of links that must not touch: True for all of the robot's shapes, False for none


@final
@dataclass(frozen=True, eq=False)
class Surroundings:
    """Obstacles in the workspace of an arm.

    Attributes:
        obstacles: All obstacles.
        assumed: Names of obstacles that are only assumed.
        handled: Names of obstacles that the hand may touch.
        hand: Names of the links of the hand.
    """

    obstacles: tuple[Obstacle, ...] = ()
    assumed: frozenset[str] = frozenset()
    handled: frozenset[str] = frozenset()
    hand: frozenset[str] = frozenset()

    @staticmethod
    def of(scene: Scene | None, robot: Robot, frame: Frame) -> Surroundings:
        """Return the obstacles of a scene for a hand; only a floor under the base without a scene.

        Args:
            scene: Obstacles; None to assume a floor.
            robot: The robot.
            frame: Frame of the hand.
        """
        if scene is None:
            return Surroundings(Scene(floor=floor_height(robot)).obstacles(robot), frozenset({FLOOR}))
        handled, hand = frozenset(scene.handled), hand_of(robot, frame)
        return Surroundings(scene.obstacles(robot), frozenset(), handled, hand)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the obstacles."""
        return tuple(dict.fromkeys(o.name for o in self.obstacles))

    def is_held(self, links: tuple[str, str]) -> bool:
        """Return True if a link belongs to the hand and an obstacle is handled by it.

        Args:
            links: Names of the link and of the obstacle.
        """
        return links[1] in self.handled and links[0] in self.hand

    def with_lower_floor(self, depth: float) -> Surroundings:
        """Return the same obstacles with a lower floor.

        Args:
            depth: Distance by which the floor moves down [m].
        """
        down = depth * np.outer(np.eye(4)[2], np.eye(4)[3])
        obstacles = (replace(o, placement=o.placement - down) if o.name == FLOOR else o for o in self.obstacles)
        return replace(self, obstacles=tuple(obstacles))


def hand_of(robot: Robot, frame: Frame) -> frozenset[str]:
    """Return the names of the links of a hand: of the frame's link and of all links that it carries, such as fingers.

    Args:
        robot: The robot.
        frame: Frame of the hand.
    """
    model = robot.pinocchio_model
    bodies = (f for f in model.frames if f.type == pin.FrameType.BODY)
    return frozenset(f.name for f in bodies if frame.parent_joint in model.supports[f.parentJoint])


@lru_cache(maxsize=8)
def floor_height(robot: Robot) -> float:
    """Return the height of a floor under the base.

    Args:
        robot: The robot.

    Returns:
        Height of the lowest corner of the shapes that carry the first joint, at most 0, the height of the base [m].
    """
    heights, tag = [0.0], known_shapes(robot)
    for shape in (one for one in collision_shapes(robot, tag) if one.joint == 0 and tag != "links"):
        shape.geometry.computeLocalAABB()
        box = shape.geometry.aabb_local
        corners = np.array(list(product(*zip(box.min_, box.max_, strict=True))))
        heights.append(float(np.min(corners @ shape.placement[2, :3]) + shape.placement[2, 3]))
    return min(heights)


@lru_cache(maxsize=8)
def links_of(robot: Robot) -> tuple[SelfCollision, str]:
    """Return the collision model of the links.

    Args:
        robot: The robot.

    Returns:
        The links with their collision shapes, or else their visual shapes, or else capsules; and the kind of shapes.
    """
    shapes = known_shapes(robot)
    return SelfCollision(robot, shapes=shapes, hulls=False), shapes


@final
class Clearance:
    """Collision check of postures, against the arm itself and against obstacles.

    An assumed floor gives way to the start, and to recorded postures; so do links that touch each other there.

    Args:
        robot: The robot.
        links: Pairs of its links that must not touch; True for all of its shapes, False for none.
        around: Obstacles.
        start: Posture that counts as clear: a pair may come to half of its distance at the start.
        shown: Recorded postures (k, n).

    Attributes:
        around: Obstacles, with room for the start.
        links: Distances of the links from each other and from the obstacles.
        notes: Pairs that are not checked, in sentences.
    """

    def __init__(self, robot: Robot, links: Links, around: Surroundings, start: Posture, shown: Sequence[Posture] = ()):
        model, shapes = links_of(robot) if isinstance(links, bool) else (links, "collision")
        checks_links = links is not False and shapes != "links"
        self._robot, self._start, self.notes = robot, start, list[str]()
        if links is True and not checks_links:
            self.notes.append(describe_shapes(robot))
        self.notes += missing_meshes(robot)
        self.around, self.links = around, model.with_obstacles(around.obstacles, checks_links)
        self._least, self._held = dict[tuple[str, str], float](), -np.inf
        postures = [(start, "at the start"), *((q, "in the recordings") for q in shown)]
        pairs = [(pair, where) for q, where in postures for pair in self._pairs(q, CLEARANCE)]
        below = [(-p.distance, where, p.links[0]) for p, where in pairs if p.links[1] == FLOOR and p.distance <= 0.0]
        if FLOOR in around.assumed and below:
            depth, where, link = max(below)
            self.around = around.with_lower_floor(CLEARANCE + depth)
            self.links = self.links.with_obstacles(self.around.obstacles, checks_links)
            self.notes.append(
                f"{where} {link!r} is below the base: the floor is assumed {CLEARANCE + depth:.3f} m lower"
            )
        near = [pair for pair in self._pairs(start, 2.0 * CLEARANCE) if pair.distance >= 0.0]
        # the nearest shapes count for links with several shapes
        self._least = {p.links: 0.5 * p.distance for p in sorted(near, key=lambda p: -p.distance)}
        for pair, where in pairs:  # the arm has been there: if its links touch, their shapes are too large
            if where != "at the start" and pair.links[1] not in self.around.names:
                least = pair.distance - _TOLERANCE
                self._least[pair.links] = min(least, self._least.get(pair.links, least))
        self.notes += [
            f"{one!r} and {other!r} touch in the recordings: their shapes count as {-1e3 * least:.0f} mm too large"
            for (one, other), least in self._least.items()
            if least < -_TOLERANCE
        ]

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Pairs of shapes of `links.geometry` that must not touch, the shape of a link first."""
        return tuple(pair for pair in self.links.pairs if self.allowed(self.links.links_of(*pair)) >= 0.0)

    @property
    def least(self) -> float:
        """Smallest clearance of all pairs that must not touch [m]."""
        return min([CLEARANCE, *(least for least in (self._held, *self._least.values()) if least >= 0.0)])

    def allowed(self, links: tuple[str, str]) -> float:
        """Return the smallest allowed distance of a pair.

        Args:
            links: Names of the link and of the other link or obstacle.

        Returns:
            Distance [m], negative where they may touch.
        """
        return min(CLEARANCE, self._least.get(links, np.inf), self._held if self.around.is_held(links) else np.inf)

    def plain(self, path: Iterable[Posture]) -> tuple[dict[str, Any], ...]:
        """Return the obstacles as plain data: whether they are assumed, and the nearest link on a path.

        Args:
            path: Joint positions (nv,) of each posture [rad or m].

        Returns:
            Data of each obstacle for JSON, with the distance [m] and the name of the nearest link within 0.3 m.
        """
        # [m] largest reported distance; triangles of all obstacles in a rollout, 0.3 MB of text
        near_distance, max_triangles = 0.3, 10_000
        near = [pair for q in path for pair in self._pairs(q, near_distance)]
        nearest = {pair.links[1]: pair for pair in sorted(near, key=lambda pair: -pair.distance)}
        out, around = list[dict[str, Any]](), self.around
        for o in around.obstacles:
            facts: dict[str, Any] = {"assumed": o.name in around.assumed}
            if (pair := nearest.get(o.name)) is not None:
                facts |= {"nearest": pair.distance, "link": pair.links[0]}
            out.append(o.to_dict(max_triangles // len(around.obstacles)) | facts)
        return tuple(out)

    def for_grasps(self, holds: Iterable[Posture]) -> Clearance:
        """Return this check for a hand that penetrates handled objects no deeper than it has to.

        Args:
            holds: Possible grasp configurations. The one with the least penetration, or the start if it is deeper
                there, sets the allowed depth.
        """
        other, room = copy.copy(self), CLEARANCE + _TOLERANCE

        def distance(q: Posture) -> float:
            return min((p.distance for p in self._pairs(q, room) if self.around.is_held(p.links)), default=room)

        if self.around.handled:
            other._held = min(max(map(distance, holds), default=room), distance(self._start)) - _TOLERANCE
        return other

    def nearest_contact(self, q: Posture, distance: float = CLEARANCE) -> Proximity | None:
        """Return the nearest pair that is closer than allowed.

        Args:
            q: Joint positions (nv,) [rad or m].
            distance: Largest distance of a reported pair [m].

        Returns:
            Nearest pair; None if the posture is clear.
        """
        pairs = [p for p in self._pairs(q, distance) if p.distance <= min(distance, self.allowed(p.links))]
        return min(pairs, key=lambda pair: pair.distance, default=None)

    def __call__(self, q: Posture) -> bool:
        """Return True if a posture is clear.

        Args:
            q: Joint positions (nv,) [rad or m].
        """
        clear = self.links.is_clear(self._robot.configuration(q), CLEARANCE)
        return clear or (bool(self._least or self.around.handled) and self.nearest_contact(q) is None)

    def is_line_clear(self, a: Posture, b: Posture) -> bool:
        """Return True if the straight joint motion between two postures is clear; the middle is checked first.

        Args:
            a: First posture (nv,) [rad or m].
            b: Last posture (nv,) [rad or m].
        """
        between = self._line(a, b)[1:-1]
        half = (len(between) + 1) // 2
        return all(self(q) for _, q in sorted(enumerate(between, 1), key=lambda one: abs(one[0] - half)))

    def first_contact(self, a: Posture, b: Posture) -> tuple[str, str] | None:
        """Return the first pair in contact on the straight joint motion between two postures.

        Args:
            a: First posture (nv,) [rad or m].
            b: Last posture (nv,) [rad or m].

        Returns:
            Names of the pair; None if the motion is clear.
        """
        return next((pair.links for q in self._line(a, b) if (pair := self.nearest_contact(q)) is not None), None)

    def is_path_clear(self, path: Iterable[Posture]) -> bool:
        """Return True if a joint path is clear, with the straight motions between its postures.

        Args:
            path: Joint positions (nv,) of each posture [rad or m].
        """
        path = list(path)
        return all(map(self, path)) and all(self.is_line_clear(*ends) for ends in pairwise(path))

    def _pairs(self, q: Posture, distance: float) -> list[Proximity]:
        return self.links.closer_than(self._robot.configuration(q), distance)

    def _line(self, a: Posture, b: Posture) -> list[Posture]:
        """Return postures of the straight joint motion between two postures.

        They are so close that no distance changes by more than twice the clearance in between: a contact there is too
        near at one of the two neighbours.
        """
        change = np.max(self.links.levers @ np.abs(b - a), initial=0.0)
        n = max(1, math.ceil(change / (2.0 * CLEARANCE)))
        return [a + i / n * (b - a) for i in range(n + 1)]
