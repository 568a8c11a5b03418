"""What stands around an arm while it goes a way: a scene, or only the floor under its base where nobody says.

The assumed floor lies below all that the recordings show, and below what the arm is in at the start.
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

from manip_learn.planning.scene import Scene
from manip_learn.robot.collision import Obstacle, collision_shapes, known_shapes
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot

FLOOR, BEHIND = "floor", " behind the hand"
FAR_AWAY = np.array([0.0, 0.0, -100.0])  # [m] of what no hand shall meet
_Pose = Float[np.ndarray, "4 4"]
AWAY: Mapping[str, Float[np.ndarray, " 3"]] = MappingProxyType({})


@final
@dataclass(frozen=True, eq=False)
class Surroundings:
    """Solids that stand around.

    Attributes:
        obstacles: All of them.
        assumed: Names of those of which nobody said that they are there.
    """

    obstacles: tuple[Obstacle, ...] = ()
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
        """With all that the hand may touch once more, for the hand alone: how far behind its face is said to `at`."""
        others = frozenset(_links(robot)) - hand
        twins = (replace(o, name=o.name + BEHIND, may_touch=others) for o in self.obstacles if hand <= o.may_touch)
        return replace(self, obstacles=(*self.obstacles, *twins))

    def at(self, behind: Mapping[str, Float[np.ndarray, " 3"]] = AWAY) -> dict[str, _Pose]:
        """Where the twins for the hand are.

        Args:
            behind: Name of what the hand may touch -> how far from there its twin for the hand is [m]; others are out
                of every hand's way.
        """
        out, places = dict[str, _Pose](), {o.name: o.placement for o in self.obstacles}
        for name in self.held:
            out[name + BEHIND] = places[name].copy()
            out[name + BEHIND][:3, 3] += behind.get(name, FAR_AWAY)
        return out

    def placed(self, behind: Mapping[str, Float[np.ndarray, " 3"]]) -> tuple[Obstacle, ...]:
        """The obstacles where they are."""
        now = self.at(behind)
        return tuple(replace(o, placement=now.get(o.name, o.placement)) for o in self.obstacles)

    @property
    def afterwards(self) -> Surroundings:
        """What a person would see of them."""
        return replace(self, obstacles=self.shown)

    def lowered(self, depth: float) -> Surroundings:
        """With a floor that lies lower [m]."""
        down = np.zeros((4, 4))
        down[2, 3] = depth
        moved = (replace(o, placement=o.placement - down) if o.name == FLOOR else o for o in self.obstacles)
        return replace(self, obstacles=tuple(moved))


def surroundings_of(scene: Scene | None, robot: Robot, frame: Frame) -> Surroundings:
    """A scene, or the floor under the base.

    Args:
        scene: What stands around; None where nobody says.
        robot: The robot.
        frame: Of the hand.
    """
    hand, assumed = hand_of(robot, frame), frozenset({FLOOR} if scene is None else set[str]())
    obstacles = (Scene(floor=floor_under(robot)) if scene is None else scene).obstacles(robot, hand)
    return Surroundings(tuple(obstacles), assumed).for_hand(robot, hand)


def hand_of(robot: Robot, frame: Frame) -> frozenset[str]:
    """Names of the links that a frame's link carries, and of it: the hand, with its fingers."""
    model, joint = robot.pinocchio_model, frame.parent_joint
    return frozenset(name for name, carrier in _links(robot).items() if joint in model.supports[carrier])


def _links(robot: Robot) -> dict[str, int]:
    """Names of the links, and the joint that carries each."""
    return {f.name: f.parentJoint for f in robot.pinocchio_model.frames if f.type == pin.FrameType.BODY}


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
