"""`manip-learn robots`: the robots that can be named."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

from manip_learn.errors import ManipLearnError
from manip_learn.robot.description.catalogue import SHIPPED, example_robots, find_robot, robot_names
from manip_learn.robot.description.text import read_description
from manip_learn.robot.description.validation import validate_urdf


@final
@dataclass(frozen=True)
class KnownRobot:
    """One robot.

    Attributes:
        name: As `load_robot` takes it.
        origin: `package`, or `extra` for those of the extra `robots`.
        joints: Joints that move on their own; empty where the description is refused.
        refused: Why it cannot be loaded; empty where it can.
    """

    name: str
    origin: str
    joints: tuple[str, ...]
    refused: str = ""


@final
@dataclass(frozen=True)
class KnownRobots:
    """All of them, those of the package first.

    Attributes:
        robots: In the order of their names.
        extra: Whether the extra `robots` is installed.
    """

    robots: tuple[KnownRobot, ...]
    extra: bool

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer."""
        listed = [
            {"name": r.name, "origin": r.origin, "joints": list(r.joints), "refused": r.refused or None}
            for r in self.robots
        ]
        return {"robots": listed, "extra_installed": self.extra}


def known_robots() -> KnownRobots:
    """Every robot that has a name here and now, with its joints."""
    names = sorted(robot_names(), key=lambda name: (name not in SHIPPED, name))
    return KnownRobots(tuple(_described(name) for name in names), bool(example_robots()))


def _described(name: str) -> KnownRobot:
    origin = "package" if name in SHIPPED else "extra"
    path = find_robot(name)
    try:
        checked = validate_urdf(read_description(path), path, ())
    except ManipLearnError as error:
        return KnownRobot(name, origin, (), str(error))
    followers = {m.joint for m in checked.mimics.followers}
    moving = [j.name for j in checked.urdf.joints if j.type != "fixed" and j.name not in followers]
    return KnownRobot(name, origin, tuple(moving))
