"""Whether postures are clear: of the arm's own links, and of what stands around it.

What stands around is a scene, or only a floor under the base where nobody says. The assumed floor lies below all that
the recordings show, and below what the arm is in at the start. What is handled counts for the hand no deeper than the
hand has to be in it where it takes hold.
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
_ROUNDED = 1e-3  # [m] deeper in what it holds than where it takes hold a hand may go: it shakes a little
_NEAR = 0.3  # [m] up to which a plan says how near it comes to what stands around: farther away nobody asks
MOST_TRIANGLES = 10_000  # of all that stands around, in a rollout: 0.3 MB of text
Posture = Float[np.ndarray, " nv"]
Links = SelfCollision | bool  # the pairs that must not touch: True for those of the robot's shapes, False for none


@final
@dataclass(frozen=True, eq=False)
class Surroundings:
    """Solids that stand around.

    Attributes:
        obstacles: All of them.
        assumed: Names of those of which nobody said that they are there.
        handled: Names of those that the hand may touch.
        hand: Names of its links.
    """

    obstacles: tuple[Obstacle, ...] = ()
    assumed: frozenset[str] = frozenset()
    handled: frozenset[str] = frozenset()
    hand: frozenset[str] = frozenset()

    @staticmethod
    def of(scene: Scene | None, robot: Robot, frame: Frame) -> Surroundings:
        """Return a scene as a hand's frame meets it; the floor under the base where nobody says what stands around."""
        if scene is None:
            return Surroundings(Scene(floor=floor_under(robot)).obstacles(robot), frozenset({FLOOR}))
        handled, hand = frozenset(scene.handled), hand_of(robot, frame)
        return Surroundings(scene.obstacles(robot), frozenset(), handled, hand)

    @property
    def names(self) -> tuple[str, ...]:
        """What stands around, by its names."""
        return tuple(dict.fromkeys(o.name for o in self.obstacles))

    def is_held(self, links: tuple[str, str]) -> bool:
        """Whether a link of the hand and what it handles are near each other."""
        return links[1] in self.handled and links[0] in self.hand

    def lowered(self, depth: float) -> Surroundings:
        """Return the same with a floor that lies lower [m]."""
        down = depth * np.outer(np.eye(4)[2], np.eye(4)[3])
        moved = (replace(o, placement=o.placement - down) if o.name == FLOOR else o for o in self.obstacles)
        return replace(self, obstacles=tuple(moved))


def hand_of(robot: Robot, frame: Frame) -> frozenset[str]:
    """Return the names of the links that a frame's link carries, and of it: the hand, with its fingers."""
    model = robot.pinocchio_model
    bodies = (f for f in model.frames if f.type == pin.FrameType.BODY)
    return frozenset(f.name for f in bodies if frame.parent_joint in model.supports[f.parentJoint])


@lru_cache(maxsize=8)
def floor_under(robot: Robot) -> float:
    """Return the height of the lowest corner of the shapes that carry the first joint, at most that of the base [m]."""
    heights, tag = [0.0], known_shapes(robot)
    for shape in (one for one in collision_shapes(robot, tag) if one.joint == 0 and tag != "links"):
        shape.geometry.computeLocalAABB()
        box = shape.geometry.aabb_local
        corners = np.array(list(product(*zip(box.min_, box.max_, strict=True))))
        heights.append(float(np.min(corners @ shape.placement[2, :3]) + shape.placement[2, 3]))
    return min(heights)


@lru_cache(maxsize=8)
def links_of(robot: Robot) -> tuple[SelfCollision, str]:
    """Return the links with their collision shapes, or else the drawn ones, or else capsules; and which of these."""
    shapes = known_shapes(robot)
    return SelfCollision(robot, shapes=shapes, hulls=False), shapes


@final
class Clearance:
    """Whether postures are clear of self-collision and of what stands around.

    An assumed floor gives way to the start, and to postures that were shown; so do links that touch each other there.

    Args:
        robot: The robot.
        links: The pairs of its links that must not touch; True for those of its shapes, False for none.
        around: What stands around.
        start: A posture that counts as clear as it is: where it is nearer to something than the clearance, that is
            taken.
        shown: shape (k, n), postures of recordings.

    Attributes:
        around: What stands around, with room for the start.
        links: Distances of the links from each other and from that.
        notes: What was left out, in sentences.
    """

    def __init__(self, robot: Robot, links: Links, around: Surroundings, start: Posture, shown: Sequence[Posture] = ()):
        found, shapes = links_of(robot) if isinstance(links, bool) else (links, "collision")
        own = links is not False and shapes != "links"
        self._robot, self._start, self.notes = robot, start, list[str]()
        if links is True and not own:
            self.notes.append(describe_shapes(robot))
        self.notes += missing_meshes(robot)
        self.around, self.links = around, found.with_obstacles(around.obstacles, own)
        self._least, self._held = dict[tuple[str, str], float](), -np.inf
        postures = [(start, "at the start"), *((q, "in the recordings") for q in shown)]
        seen = [(pair, where) for q, where in postures for pair in self._pairs(q, CLEARANCE)]
        below = [(-p.distance, where, p.links[0]) for p, where in seen if p.links[1] == FLOOR and p.distance <= 0.0]
        if FLOOR in around.assumed and below:
            depth, where, link = max(below)
            self.around = around.lowered(CLEARANCE + depth)
            self.links = self.links.with_obstacles(self.around.obstacles, own)
            self.notes.append(f"{where} {link!r} is below the base: the floor is taken {CLEARANCE + depth:.3f} m lower")
        near = [pair for pair in self._pairs(start, 2.0 * CLEARANCE) if pair.distance >= 0.0]
        # of links with several shapes the nearest counts
        self._least = {p.links: 0.5 * p.distance for p in sorted(near, key=lambda p: -p.distance)}
        for pair, where in seen:  # an arm has been there: where its links touch, their shapes are too large
            if where != "at the start" and pair.links[1] not in self.around.names:
                least = pair.distance - _ROUNDED
                self._least[pair.links] = min(least, self._least.get(pair.links, least))
        self.notes += [
            f"{one!r} and {other!r} touch in the recordings: their shapes count as {-1e3 * least:.0f} mm too large"
            for (one, other), least in self._least.items()
            if least < -_ROUNDED
        ]

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Which shapes of `links.geometry` must not touch, a link's first."""
        return tuple(pair for pair in self.links.pairs if self.allowed(self.links.links_of(*pair)) >= 0.0)

    @property
    def least(self) -> float:
        """The clearance of what must not touch [m]."""
        return min([CLEARANCE, *(least for least in (self._held, *self._least.values()) if least >= 0.0)])

    def allowed(self, links: tuple[str, str]) -> float:
        """Return how near two things may come to each other [m], negative where they may touch."""
        return min(CLEARANCE, self._least.get(links, np.inf), self._held if self.around.is_held(links) else np.inf)

    def plain(self, path: Iterable[Posture]) -> tuple[dict[str, Any], ...]:
        """Return what stands around as plain data: whether it was assumed, and what link comes how near on a path."""
        near = [pair for q in path for pair in self._pairs(q, _NEAR)]
        nearest = {pair.links[1]: pair for pair in sorted(near, key=lambda pair: -pair.distance)}
        out, around = list[dict[str, Any]](), self.around
        for o in around.obstacles:
            told: dict[str, Any] = {"assumed": o.name in around.assumed}
            if (pair := nearest.get(o.name)) is not None:
                told |= {"nearest": pair.distance, "link": pair.links[0]}
            out.append(o.to_dict(MOST_TRIANGLES // len(around.obstacles)) | told)
        return tuple(out)

    def holding(self, holds: Iterable[Posture]) -> Clearance:
        """Return this clearance for a hand that goes no deeper into what it handles than it has to.

        Args:
            holds: Postures in which it could take hold. That in which it is least deep sets how deep it may go, or the
                start, if it is deeper there.
        """
        other, room = copy.copy(self), CLEARANCE + _ROUNDED

        def left(q: Posture) -> float:
            return min((p.distance for p in self._pairs(q, room) if self.around.is_held(p.links)), default=room)

        if self.around.handled:
            other._held = min(max(map(left, holds), default=room), left(self._start)) - _ROUNDED
        return other

    def touching(self, q: Posture, distance: float = CLEARANCE) -> Proximity | None:
        """Return the two things nearest to each other, if nearer than a distance [m] and than they may be."""
        pairs = [p for p in self._pairs(q, distance) if p.distance <= min(distance, self.allowed(p.links))]
        return min(pairs, key=lambda pair: pair.distance, default=None)

    def __call__(self, q: Posture) -> bool:
        """Whether a posture is clear."""
        clear = self.links.is_clear(self._robot.configuration(q), CLEARANCE)
        return clear or (bool(self._least or self.around.handled) and self.touching(q) is None)

    def of_line(self, a: Posture, b: Posture) -> bool:
        """Whether the straight joint motion between two postures is clear, the middle looked at first."""
        between = self._line(a, b)[1:-1]
        half = (len(between) + 1) // 2
        return all(self(q) for _, q in sorted(enumerate(between, 1), key=lambda one: abs(one[0] - half)))

    def in_line(self, a: Posture, b: Posture) -> tuple[str, str] | None:
        """Return the first two things that touch on the straight joint motion between two postures."""
        return next((pair.links for q in self._line(a, b) if (pair := self.touching(q)) is not None), None)

    def of_way(self, path: Iterable[Posture]) -> bool:
        """Whether a way of joint positions is clear, with the straight motions between its postures."""
        path = list(path)
        return all(map(self, path)) and all(self.of_line(*ends) for ends in pairwise(path))

    def _pairs(self, q: Posture, distance: float) -> list[Proximity]:
        return self.links.closer_than(self._robot.configuration(q), distance)

    def _line(self, a: Posture, b: Posture) -> list[Posture]:
        """Postures of the straight joint motion from one to another, so near each other that no distance changes by
        more than twice the clearance in between: what touches there is too near at one of the two.
        """
        change = np.max(self.links.levers @ np.abs(b - a), initial=0.0)
        n = max(1, math.ceil(change / (2.0 * CLEARANCE)))
        return [a + i / n * (b - a) for i in range(n + 1)]
