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
        assumed: Names of obstacles that are assumed, not stated by the user.
        handled: Names of obstacles that the hand may touch.
        hand: Names of the links of the hand.
    """

    obstacles: tuple[Obstacle, ...] = ()
    assumed: frozenset[str] = frozenset()
    handled: frozenset[str] = frozenset()
    hand: frozenset[str] = frozenset()

    @staticmethod
    def of(scene: Scene | None, robot: Robot, frame: Frame) -> Surroundings:
        """Return the obstacles of a scene, with the links of the hand that may touch handled ones.

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
        """Return True if the link is of the hand and the obstacle is handled, so that the two may touch.

        Args:
            links: Names of the link and of the obstacle.
        """
        return links[1] in self.handled and links[0] in self.hand

    def with_lower_floor(self, depth: float) -> Surroundings:
        """Return the same obstacles with the floor moved down.

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
    """Return the height at which a floor under the robot is assumed.

    Args:
        robot: The robot.

    Returns:
        Height in the base frame [m], at most 0: lowest corner of the shapes that carry the first joint.
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
        The collision model, and the kind of its shapes in one word. It has the collision shapes of the links; without
        them the visual shapes, and without these capsules.
    """
    shapes = known_shapes(robot)
    return SelfCollision(robot, shapes=shapes, hulls=False), shapes


@final
class Clearance:
    """Collision checker for configurations, against the arm itself and against obstacles.

    The start and recorded configurations are assumed to be free of collisions: an assumed floor is lowered below them,
    and links that touch in a recording may touch as much later.

    Args:
        robot: The robot.
        links: Pairs of links that must not touch, as a collision model; True for all shapes of the robot, False for
            none.
        around: Obstacles.
        start: Joint positions (nv,) at the start [rad or m]. A pair that is near there may come to half of that
            distance.
        shown: Recorded joint positions (k, nv) [rad or m].

    Attributes:
        around: Obstacles, with the lowered floor.
        links: Collision model that computes distances of the links from each other and from the obstacles.
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
        """Pairs of shapes that must not touch, as indices in `links.geometry`; the first one is of a link."""
        return tuple(pair for pair in self.links.pairs if self.allowed(self.links.links_of(*pair)) >= 0.0)

    @property
    def least(self) -> float:
        """Smallest of the allowed distances of all pairs that must not touch [m]."""
        return min([CLEARANCE, *(least for least in (self._held, *self._least.values()) if least >= 0.0)])

    def allowed(self, links: tuple[str, str]) -> float:
        """Return the smallest allowed distance of a pair.

        Args:
            links: Names of the link, and of the second link or obstacle.

        Returns:
            Distance [m], negative for a pair that may touch.
        """
        return min(CLEARANCE, self._least.get(links, np.inf), self._held if self.around.is_held(links) else np.inf)

    def plain(self, path: Iterable[Posture]) -> tuple[dict[str, Any], ...]:
        """Describe the obstacles, and which link comes nearest to each on a path, as JSON values.

        Args:
            path: Configurations of the path, joint positions (nv,) each [rad or m].

        Returns:
            One dictionary per obstacle: its shape, `assumed`, and for a link within 0.3 m its name `link` and its
            distance `nearest` [m].
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
        """Return this checker with an allowed depth by which the hand may penetrate handled objects.

        Args:
            holds: Possible grasp configurations, joint positions (nv,) each [rad or m]. The depth is the smallest
                penetration in any of these, or the penetration at the start if that is deeper.
        """
        other, room = copy.copy(self), CLEARANCE + _TOLERANCE

        def distance(q: Posture) -> float:
            return min((p.distance for p in self._pairs(q, room) if self.around.is_held(p.links)), default=room)

        if self.around.handled:
            other._held = min(max(map(distance, holds), default=room), distance(self._start)) - _TOLERANCE
        return other

    def nearest_contact(self, q: Posture, distance: float = CLEARANCE) -> Proximity | None:
        """Return the pair of shapes that is closest together, among pairs that are closer than allowed.

        Args:
            q: Joint positions (nv,) [rad or m].
            distance: Largest distance of a reported pair [m].

        Returns:
            Nearest pair; None if the configuration is free of collisions.
        """
        pairs = [p for p in self._pairs(q, distance) if p.distance <= min(distance, self.allowed(p.links))]
        return min(pairs, key=lambda pair: pair.distance, default=None)

    def __call__(self, q: Posture) -> bool:
        """Return True if a configuration is free of collisions.

        Args:
            q: Joint positions (nv,) [rad or m].
        """
        clear = self.links.is_clear(self._robot.configuration(q), CLEARANCE)
        return clear or (bool(self._least or self.around.handled) and self.nearest_contact(q) is None)

    def is_line_clear(self, a: Posture, b: Posture) -> bool:
        """Return True if the straight joint motion between two configurations is free of collisions.

        Args:
            a: First joint positions (nv,) [rad or m].
            b: Last joint positions (nv,) [rad or m].
        """
        between = self._line(a, b)[1:-1]
        half = (len(between) + 1) // 2
        return all(self(q) for _, q in sorted(enumerate(between, 1), key=lambda one: abs(one[0] - half)))

    def first_contact(self, a: Posture, b: Posture) -> tuple[str, str] | None:
        """Return the first pair in collision on the straight joint motion between two configurations.

        Args:
            a: First joint positions (nv,) [rad or m].
            b: Last joint positions (nv,) [rad or m].

        Returns:
            Names of the link, and of the second link or obstacle; None if the motion is free of collisions.
        """
        return next((pair.links for q in self._line(a, b) if (pair := self.nearest_contact(q)) is not None), None)

    def is_path_clear(self, path: Iterable[Posture]) -> bool:
        """Return True if a joint path with straight segments is free of collisions.

        Args:
            path: Configurations of the path, joint positions (nv,) each [rad or m].
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
