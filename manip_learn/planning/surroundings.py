"""What stands around an arm while it goes a way: a scene, or what may be assumed where nobody says.

Assumed are the floor under the base and the front of what is opened, pushed or wiped: a half space behind the place
where the hand takes hold, of a drawer or a door by the depth of a flat handle. What is pushed takes its front along.
The hand may go as far behind the front as it is at the start or when it takes hold, other links may not. The leaf of a
door is there in every scene, from the hinge to a little beyond the handle, and turns with the way. What the arm is in
at the start cannot be there: the floor is lower then, and a link that is in the front or in the leaf passes through it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from types import MappingProxyType
from typing import final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.constraint.mechanism import Mechanism
from manip_learn.planning.scene import Scene
from manip_learn.planning.stations import Stations
from manip_learn.robot.collision import LARGE_BLOCK, Obstacle, collision_shapes, known_shapes, obstacles_of
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.visual_shapes import Solid

FLOOR, FRONT, LEAF, BEHIND = "floor", "front", "leaf", " behind the hand"
_HANDLE = 0.025  # [m] that the flattest usual handles stand out of their front
SLANTED = 0.3  # of a hand's lever that must point out of a front to tell its side: 17 degrees from lying along it
BEGUN = 1e-3  # [m] of a way from which on its direction counts
TALL, _THICK = 0.6, 0.018  # [m] of a leaf: a door of a kitchen, of the usual board
EDGE = 0.05  # [m] of the leaf at the hinge that is not looked at, the frame of the door; and beyond its handle
LAST = 10**9  # a station behind all of them: the last one
FAR_AWAY = np.array([0.0, 0.0, -100.0])  # [m] of what no hand shall meet
_Pose = Float[np.ndarray, "4 4"]
AWAY: Mapping[str, Float[np.ndarray, " 3"]] = MappingProxyType({})


@final
@dataclass(frozen=True, eq=False)
class Surroundings:
    """Solids, and those of them that move.

    Attributes:
        obstacles: All of them, where they are before a way.
        leaf: shape (L, 4, 4), where the leaf of a door is at each station of the way [m]; None without one.
        sinks: shape (L,), how far the front has been pushed in at each station [m]; None without a front.
        assumed: Names of those of which nobody said that they are there.
    """

    obstacles: tuple[Obstacle, ...] = ()
    leaf: Float[np.ndarray, "L 4 4"] | None = None
    sinks: Float[np.ndarray, " L"] | None = None
    assumed: frozenset[str] = frozenset()

    @property
    def shown(self) -> tuple[Obstacle, ...]:
        """What a person would see of them."""
        return tuple(o for o in self.obstacles if not o.name.endswith(BEHIND))

    @property
    def names(self) -> tuple[str, ...]:
        """What stands around, by its names."""
        return tuple(dict.fromkeys(o.name for o in self.shown))

    @property
    def held(self) -> tuple[str, ...]:
        """Names of what the hand may touch."""
        return tuple(o.name.removesuffix(BEHIND) for o in self.obstacles if o.name.endswith(BEHIND))

    def for_hand(self, robot: Robot, hand: frozenset[str]) -> Surroundings:
        """With all that the hand may touch once more, for the hand alone: how far behind its face is said to `at`.

        Not the leaf of a door, about whose handle a hand may turn.
        """
        others = frozenset(_links(robot)) - hand
        held = [o for o in self.obstacles if hand <= o.may_touch and o.name != LEAF]
        twins = (replace(o, name=o.name + BEHIND, may_touch=others) for o in held)
        return replace(self, obstacles=(*self.obstacles, *twins))

    def at(self, station: int, behind: Mapping[str, Float[np.ndarray, " 3"]] = AWAY) -> dict[str, _Pose]:
        """Where what moves is at a station.

        Args:
            station: Number of it.
            behind: Name of what the hand may touch -> how far from there its twin for the hand is [m]; others are out
                of every hand's way.
        """
        out = {} if self.leaf is None else {LEAF: self.leaf[min(station, len(self.leaf) - 1)]}
        places = {o.name: o.placement for o in self.obstacles}
        if FRONT in places and self.sinks is not None:
            out[FRONT] = _shifted(places[FRONT], float(self.sinks[min(station, len(self.sinks) - 1)]))
        for name in self.held:
            twin = out.get(name, places[name]).copy()
            twin[:3, 3] += behind.get(name, FAR_AWAY)
            out[name + BEHIND] = twin
        return out

    def placed(self, behind: Mapping[str, Float[np.ndarray, " 3"]]) -> tuple[Obstacle, ...]:
        """The obstacles where they are before the way."""
        now = self.at(0, behind)
        return tuple(replace(o, placement=now.get(o.name, o.placement)) for o in self.obstacles)

    @property
    def afterwards(self) -> Surroundings:
        """What a person would see of them where the way has ended."""
        last = self.at(LAST)
        moved = tuple(replace(o, placement=last.get(o.name, o.placement)) for o in self.shown)
        return Surroundings(moved, assumed=self.assumed)

    def with_room(self, name: str, links: Mapping[str, float]) -> Surroundings:
        """With a lower floor, or with other things that some links may touch.

        Args:
            name: Of what was assumed.
            links: Names of the links that are in it, and how deep [m].
        """
        deepest, found = max(links.values()), list[Obstacle]()
        for o in self.obstacles:
            if o.name == name == FLOOR:
                o = replace(o, placement=_shifted(o.placement, deepest))
            elif o.name.removesuffix(BEHIND) == name:
                o = replace(o, may_touch=o.may_touch | links.keys())
            found.append(o)
        return replace(self, obstacles=tuple(found))


def _shifted(placement: _Pose, depth: float) -> _Pose:
    """A block farther away along its face's normal [m]."""
    out = placement.copy()
    out[:3, 3] -= depth * out[:3, 2]
    return out


def surroundings_of(
    scene: Scene | None, robot: Robot, frame: Frame, stations: Stations, mechanism: Mechanism | None
) -> Surroundings:
    """A scene, or the floor under the base and the front of what a hand holds; and the leaf of a door.

    Args:
        scene: What stands around; None where nobody says.
        robot: The robot.
        frame: Of the hand.
        stations: The way of the hand, in the robot's base frame.
        mechanism: What holds the hand; None where that has no name, or another frame than the base sees it.
    """
    hand, leaf, sinks = hand_of(robot, frame), None, None
    obstacles = [*(Scene(floor=floor_under(robot)) if scene is None else scene).obstacles(robot, hand)]
    assumed = {FLOOR} if scene is None else set[str]()
    normal = None if mechanism is None else _normal(robot, frame, stations, mechanism)
    if normal is not None and mechanism is not None and scene is None:
        face = stations.places[0] - (0.0 if mechanism.type == "plane" else _HANDLE) * normal
        obstacles.append(half_space(FRONT, face, normal, hand))
        sinks = np.maximum(0.0, (stations.places[0] - stations.places) @ normal)
        assumed.add(FRONT)
    if normal is not None and mechanism is not None and mechanism.type == "hinge":
        leaf = _leaf(stations, np.asarray(mechanism.axis), np.asarray(mechanism.point), normal)
    if leaf is not None:
        solid, leaf = leaf
        obstacles += obstacles_of(LEAF, leaf[0], solid, hand)
        assumed.add(LEAF)
    return Surroundings(tuple(obstacles), leaf, sinks, frozenset(assumed)).for_hand(robot, hand)


def hand_of(robot: Robot, frame: Frame) -> frozenset[str]:
    """Names of the links that a frame's link carries, and of it: the hand, with its fingers."""
    model, joint = robot.pinocchio_model, frame.parent_joint
    return frozenset(name for name, carrier in _links(robot).items() if joint in model.supports[carrier])


def _links(robot: Robot) -> dict[str, int]:
    """Names of the links, and the joint that carries each."""
    return {f.name: f.parentJoint for f in robot.pinocchio_model.frames if f.type == pin.FrameType.BODY}


def half_space(name: str, point: np.ndarray, normal: np.ndarray, may_touch: frozenset[str]) -> Obstacle:
    """A large block with a face through a point, and out of that face a unit vector."""
    placement = np.eye(4)
    placement[:3, :3] = np.column_stack([*np.linalg.svd(normal[None])[2][1:], normal])
    placement[:3, 0] *= np.sign(np.linalg.det(placement[:3, :3]))
    placement[:3, 3] = point - LARGE_BLOCK * normal
    return obstacles_of(name, placement, Solid("box", (2.0 * LARGE_BLOCK,) * 3), may_touch)[0]


@lru_cache(maxsize=8)
def floor_under(robot: Robot) -> float:
    """Height of the lowest corner of the shapes that carry the first joint, at most that of the base's origin [m]."""
    heights, tag = [0.0], known_shapes(robot)
    for shape in (one for one in collision_shapes(robot, tag) if one.joint == 0 and tag != "links"):
        shape.geometry.computeLocalAABB()
        box = shape.geometry.aabb_local
        corners = np.array(list(product(*zip(box.min_, box.max_, strict=True))))
        heights.append(float(np.min(corners @ shape.placement[2, :3]) + shape.placement[2, 3]))
    return min(heights)


def _normal(robot: Robot, frame: Frame, stations: Stations, mechanism: Mechanism) -> np.ndarray | None:
    """Out of the front: along the way of a drawer or a door, across a plane, to the side from which the hand comes."""
    if mechanism.type in ("line", "hinge"):
        gone = stations.places - stations.places[0]
        begun = np.flatnonzero(np.linalg.norm(gone, axis=1) > BEGUN)
        if not len(begun):
            return None  # a hand on the axis of a knob
        along = gone[begun[0]]
    elif mechanism.type == "plane" and mechanism.axis is not None:
        along = np.asarray(mechanism.axis, dtype=np.float64)
    else:
        return None
    normal = along / np.linalg.norm(along)
    model = robot.pinocchio_model
    carrier = model.frames[frame.index].placement.inverse().translation  # the hand's joint, as the hand sees it
    orientation = stations.grasp if stations.grip is None else stations.grip[0]
    lever = orientation @ carrier
    out = float(normal @ lever)
    if abs(out) <= SLANTED * float(np.linalg.norm(lever)):
        out = -float(normal @ stations.places[0])  # a hand that lies along the front: the side of the base
    return normal if out >= 0.0 else -normal


def _leaf(
    stations: Stations, axis: np.ndarray, point: np.ndarray, normal: np.ndarray
) -> tuple[Solid, Float[np.ndarray, "L 4 4"]] | None:
    """The leaf of a door, and where it is at each station; None of a knob, which is no door.

    Args:
        stations: The way of the hand.
        axis: shape (3,), of the hinge.
        point: shape (3,), on it [m].
        normal: shape (3,), out of the front, before the way.
    """
    arms = stations.places - point
    heights = arms @ axis
    arms -= np.outer(heights, axis)
    if (reach := float(np.linalg.norm(arms[0]))) <= EDGE:
        return None
    poses = np.repeat(np.eye(4)[None], len(stations), axis=0)
    out = float(np.sign(np.cross(axis, arms[0]) @ normal))  # of the handle, from its leaf
    for pose, arm, height in zip(poses, arms, heights, strict=True):
        behind = out * _HANDLE * np.cross(axis, arm / reach)
        x = (arm - behind) / np.linalg.norm(arm - behind)
        y = np.cross(axis, x)
        pose[:3, :3] = np.column_stack([x, y, axis])
        pose[:3, 3] = point + height * axis + (0.5 * reach + EDGE) * x - out * 0.5 * _THICK * y
    return Solid("box", (reach, _THICK, TALL)), poses
