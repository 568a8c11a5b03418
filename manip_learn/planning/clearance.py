"""Whether postures are clear: of the arm's own links, and of what stands around."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.keeping_clear import CLEARANCE
from manip_learn.errors import listed
from manip_learn.planning.surroundings import AWAY, BEHIND, FLOOR, Surroundings
from manip_learn.robot.collision import Obstacle, Proximity, SelfCollision, known_shapes, missing_meshes
from manip_learn.robot.robot import Robot

_ROUNDED = 1e-3  # [m] behind the hand that takes hold there is this much more room than it takes: it shakes a little
DEEPER = 4  # times that what the hand is in is moved out of its way: its faces are met one after the other
_NEAR = 0.3  # [m] up to which a plan says how near it comes to what stands around: farther away nobody asks
MOST_TRIANGLES = 10_000  # of all that stands around, in a rollout: 0.3 MB of text
Posture = Float[np.ndarray, " nv"]


@lru_cache(maxsize=8)
def links_of(robot: Robot) -> tuple[SelfCollision, str]:
    """The links with their collision shapes, or else the drawn ones, or else capsules; and which of these."""
    shapes = known_shapes(robot)
    return SelfCollision(robot, shapes=shapes, hulls=False), shapes


def self_collision(robot: Robot) -> SelfCollision | None:
    """The links that can touch each other, of the collision shapes or else the drawn ones; None if there are none."""
    links, shapes = links_of(robot)
    return None if shapes == "links" else links


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
        least: The clearance [m]; of two things that are nearer at the start, half their distance there.
        links: Distances of the links from each other and from what stands around.
        notes: What was left out, in sentences.
    """

    def __init__(
        self,
        robot: Robot,
        links: SelfCollision | bool,
        around: Surroundings,
        start: Posture,
        shown: Sequence[Posture] = (),
    ):
        found, shapes = links_of(robot) if isinstance(links, bool) else (links, "collision")
        self._robot, self.notes = robot, list[str]()
        self._own = links is not False and shapes != "links"
        if links is True and shapes == "links":
            self.notes.append(
                "the robot has no shapes: self-collision was not looked at"
                + (", capsules along its links keep clear of what stands around" if around.obstacles else "")
            )
        if lost := missing_meshes(robot):
            files = listed(uri.rpartition("/")[2] for uri in lost)
            self.notes.append(f"the robot's shapes {files} are not found: capsules along the links stand for them")
        self.links = found.with_obstacles(around.obstacles, self._own)
        self._start, self._around, self._behind = start, around, AWAY
        postures = [(start, "at the start"), *((q, "in the recordings") for q in shown)]
        seen = [(pair, where) for q, where in postures for pair in self._pairs(q, CLEARANCE)]
        below = [(-p.distance, where, p.links[0]) for p, where in seen if p.links[1] == FLOOR and p.distance <= 0.0]
        if FLOOR in around.assumed and below:
            depth, where, link = max(below)
            self._around = around.lowered(CLEARANCE + depth)
            self.notes.append(f"{where} {link!r} is below the base: the floor is taken {CLEARANCE + depth:.3f} m lower")
        self.links = self.links.with_obstacles(self._around.obstacles, self._own)
        near = [pair for pair in self._pairs(start, 2.0 * CLEARANCE) if pair.distance >= 0.0]
        self._near = {pair.links: 0.5 * pair.distance for pair in reversed(near)}
        for pair, where in seen:  # an arm has been there: where its links touch, their shapes are too large
            if where != "at the start" and pair.links[1] not in self._around.names:
                least = pair.distance - _ROUNDED
                self._near[pair.links] = min(least, self._near.get(pair.links, least))
        touching = [(*links, -1e3 * least) for links, least in self._near.items() if least < -_ROUNDED]
        self.notes += [
            f"{one!r} and {other!r} touch in the recordings: their shapes count as {depth:.0f} mm too large"
            for one, other, depth in touching
        ]
        self.least = min([CLEARANCE, *(max(x, 0.0) for x in self._near.values())])

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """What stands around, where it is."""
        return self._around.placed(self._behind)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Which shapes of `links.geometry` must not touch, a link's first."""
        return [(p.first, p.second) for p in self.links.geometry.collisionPairs]

    @property
    def around(self) -> Surroundings:
        """What stands around, with room for the start."""
        return self._around

    def plain(self, path: Iterable[Posture]) -> tuple[dict[str, Any], ...]:
        """The same as plain data: whether it was assumed, and how near what link comes to it on a path [m]."""
        nearest = dict[str, Proximity]()
        for q in path:
            for pair in self._pairs(q, _NEAR):
                if (known := nearest.get(pair.links[1])) is None or pair.distance < known.distance:
                    nearest[pair.links[1]] = pair
        out = list[dict[str, Any]]()
        for o in self._around.shown:
            told: dict[str, Any] = {"assumed": o.name in self._around.assumed}
            if (pair := nearest.get(o.name)) is not None:
                told |= {"nearest": pair.distance, "link": pair.links[0]}
            out.append(o.to_dict(MOST_TRIANGLES // len(self._around.shown)) | told)
        return tuple(out)

    @property
    def names(self) -> tuple[str, ...]:
        """What stands around, by its names."""
        return self._around.names

    def holding(self, holds: Iterable[Posture]) -> Clearance:
        """This clearance for a hand that goes no deeper into what it may touch than it has to.

        Args:
            holds: Postures in which it could take hold. That in which it is least deep sets how deep it may go, or the
                start, if it is deeper there.
        """
        other, names = copy.copy(self), {name + BEHIND: name for name in self._around.held}
        other._behind = {name: np.zeros(3) for name in names.values()}
        if not names:
            return other
        room = CLEARANCE + _ROUNDED

        def met(q: Posture) -> list[Proximity]:
            return [pair for pair in other._pairs(q, room) if pair.links[1] in names]

        least, best = np.inf, self._start
        for q in holds:
            deep = max((room - pair.distance for pair in met(q)), default=0.0)
            if deep < least:
                least, best = deep, q
            if least == 0.0:
                break
        for _ in range(DEEPER):
            if not (found := met(best) + met(self._start)):
                return other
            deepest = min(found, key=lambda pair: pair.distance)
            moved = (1e-6 + room - deepest.distance) * deepest.normal
            other._behind = {**other._behind, names[deepest.links[1]]: other._behind[names[deepest.links[1]]] + moved}
        other._behind = AWAY
        return other

    def touching(self, q: Posture, distance: float | None = None) -> Proximity | None:
        """Two things nearer to each other than a distance [m], by default the clearance; None if none are."""
        most = CLEARANCE if distance is None else distance
        pairs = [p for p in self._pairs(q, most) if p.distance <= min(most, self._near.get(p.links, most))]
        if not pairs:
            return None
        found = min(pairs, key=lambda pair: pair.distance)
        return found._replace(links=(found.links[0], found.links[1].removesuffix(BEHIND)))

    def __call__(self, q: Posture) -> bool:
        """Whether a posture is clear."""
        clear = self.links.is_clear(self._robot.configuration(q), CLEARANCE, self._around.at(self._behind))
        return clear or (bool(self._near) and self.touching(q) is None)

    def of_line(self, a: Posture, b: Posture) -> bool:
        """Whether the straight joint motion between two postures is clear, the middle looked at first."""
        between = self._line(a, b)[1:-1]
        half = (len(between) + 1) // 2
        return all(self(q) for _, q in sorted(enumerate(between, 1), key=lambda one: abs(one[0] - half)))

    def in_line(self, a: Posture, b: Posture) -> tuple[str, str] | None:
        """The first two things that touch on the straight joint motion between two postures."""
        pairs = map(self.touching, self._line(a, b))
        return next((pair.links for pair in pairs if pair is not None), None)

    def of_way(self, path: Float[np.ndarray, "k nv"]) -> bool:
        """Whether a way of joint positions is clear, with the straight motions between its postures."""
        return all(map(self, path)) and all(map(self.of_line, path[:-1], path[1:]))

    def _pairs(self, q: Posture, distance: float) -> list[Proximity]:
        return self.links.closer_than(self._robot.configuration(q), distance, self._around.at(self._behind))

    def _line(self, a: Posture, b: Posture) -> list[Posture]:
        """Postures of the straight joint motion from one to another, so near each other that no point of a link moves
        by more than twice the clearance in between: what touches there is too near at one of the two.
        """
        n = max(1, int(np.ceil(np.abs(b - a) @ levers_of(self._robot) / (2.0 * CLEARANCE))))
        return [a + i / n * (b - a) for i in range(n + 1)]


@lru_cache(maxsize=8)
def levers_of(robot: Robot) -> Float[np.ndarray, " nv"]:
    """How far a point of a link moves at most per joint motion: a joint that turns, to the arm's end [m]; else 1."""
    model, slides = robot.pinocchio_model, np.array(robot.joint_units) != "rad"
    lengths = np.linalg.norm([place.translation for place in model.jointPlacements], axis=1)
    ends = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper))
    for block in robot.blocks:  # a base that floats goes where it likes, and its arm with it
        lengths[block.index] += np.sum(ends[block.v][slides[block.v] & np.isfinite(ends[block.v])])
    before = np.array([np.sum(lengths[list(chain)]) for chain in model.supports])
    reach = max(before[f.parentJoint] + float(np.linalg.norm(f.placement.translation)) for f in model.frames)
    return np.where(slides, 1.0, [reach - before[block.index] for block in robot.blocks for _ in block.units])
