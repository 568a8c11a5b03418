"""What stands around an arm while it goes a way: a scene, or what may be assumed where nobody says.

Assumed are the floor under the base and the front of what is opened, pushed or wiped: a half space behind the place
where the hand takes hold, of a drawer or a door by the depth of a flat handle. What is pushed takes its front along.
The hand may go as far behind the front as it is at the start or when it takes hold, other links may not. Of a door the
leaf is there too, from the handle to the hinge, and turns with the way.
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
from manip_learn.robot.collision import LARGE, Obstacle, collision_shapes, known_shapes, obstacles_of
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.visual_shapes import Solid

FLOOR, FRONT, LEAF, BEHIND = "floor", "front", "leaf", " behind the hand"
HANDLE = 0.025  # [m] that the flattest usual handles stand out of their front
SLANTED = 0.3  # of a hand's lever that must point out of a front to tell its side: 17 degrees from lying along it
BEGUN = 1e-3  # [m] of a way from which on its direction counts
TALL, THICK = 0.6, 0.018  # [m] of a leaf: a door of a kitchen, of the usual board
EDGE = 0.05  # [m] of the leaf at the hinge that is not looked at: the frame of the door
FAR_AWAY = np.array([0.0, 0.0, -100.0])  # [m] of what no hand shall meet
Pose = Float[np.ndarray, "4 4"]
AWAY: Mapping[str, Float[np.ndarray, " 3"]] = MappingProxyType({})


@final
@dataclass(frozen=True, eq=False)
class Surroundings:
    """Solids, and those of them that move.

    Attributes:
        obstacles: All of them, where they are before a way.
        leaf: shape (L, 4, 4), where the leaf of a door is at each station of the way [m]; None without one.
        sinks: shape (L,), how far the front has been pushed in at each station [m]; None without a front.
        is_assumed: Whether nobody said that they are there.
    """

    obstacles: tuple[Obstacle, ...] = ()
    leaf: Float[np.ndarray, "L 4 4"] | None = None
    sinks: Float[np.ndarray, " L"] | None = None
    is_assumed: bool = False

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

    def at(self, station: int, behind: Mapping[str, Float[np.ndarray, " 3"]] = AWAY) -> dict[str, Pose]:
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

    def without(self, name: str) -> Surroundings:
        """All but one, and its twin for the hand."""
        kept = tuple(o for o in self.obstacles if o.name.removesuffix(BEHIND) != name)
        return replace(self, obstacles=kept, leaf=None if name == LEAF else self.leaf)

    def farther(self, name: str, far: float) -> Surroundings:
        """With a floor or a front farther away [m]."""
        named = (o for o in self.obstacles if o.name.removesuffix(BEHIND) == name)
        moved = {o.name: replace(o, placement=_shifted(o.placement, far)) for o in named}
        return replace(self, obstacles=tuple(moved.get(o.name, o) for o in self.obstacles))


def _shifted(placement: Pose, depth: float) -> Pose:
    """A block farther away along its face's normal [m]."""
    out = placement.copy()
    out[:3, 3] -= depth * out[:3, 2]
    return out


def assumed(robot: Robot, frame: Frame, stations: Stations, mechanism: Mechanism | None, in_base: bool) -> Surroundings:
    """The floor under the base, and the front of what a hand holds.

    Args:
        robot: The robot.
        frame: Of the hand.
        stations: The way of the hand.
        mechanism: What holds the hand, if that has a name.
        in_base: Whether the stations are places in the robot's base frame.
    """
    obstacles, leaf, sinks = [*Scene(floor=floor_under(robot)).obstacles(robot)], None, None
    if not in_base or mechanism is None:
        return Surroundings(tuple(obstacles), is_assumed=True)
    hand = hand_of(robot, frame)
    normal = _normal(robot, frame, stations, mechanism)
    if normal is not None:
        face = stations.places[0] - (0.0 if mechanism.type == "plane" else HANDLE) * normal
        obstacles.append(half_space(FRONT, face, normal, hand))
        sinks = np.maximum(0.0, (stations.places[0] - stations.places) @ normal)
    if mechanism.type == "hinge" and mechanism.axis is not None and mechanism.point is not None:
        solid, leaf = _leaf(stations, np.asarray(mechanism.axis), np.asarray(mechanism.point), normal, hand)
        obstacles += [] if solid is None else [solid]
    return Surroundings(tuple(obstacles), leaf, sinks, True).for_hand(robot, hand)


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
    placement[:3, 3] = point - LARGE * normal
    return obstacles_of(name, placement, Solid("box", (2.0 * LARGE,) * 3), may_touch)[0]


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
    stations: Stations, axis: np.ndarray, point: np.ndarray, normal: np.ndarray | None, hand: frozenset[str]
) -> tuple[Obstacle | None, np.ndarray | None]:
    """A door's leaf from its handle to its hinge, and where it is at each station; None of what is no door."""
    arms = stations.places - point
    arms = arms - np.outer(arms @ axis, axis)
    wide = float(np.linalg.norm(arms[0])) - EDGE
    if normal is None or wide <= 0.0:
        return None, None
    poses = np.repeat(np.eye(4)[None], len(stations), axis=0)
    side = np.sign(np.cross(axis, arms[0]) @ normal)
    for pose, place, arm in zip(poses, stations.places, arms, strict=True):
        x = arm / np.linalg.norm(arm)
        y = np.cross(axis, x)
        pose[:3, :3] = np.column_stack([x, y, axis])
        pose[:3, 3] = place - 0.5 * wide * x - side * (HANDLE + 0.5 * THICK) * y
    return obstacles_of(LEAF, poses[0], Solid("box", (wide, THICK, TALL)), hand)[0], poses
