"""`manip-learn robots` and `inspect`: the robots that can be named, and what one is made of."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, final

from manip_learn.commands.options import InspectOptions, RobotsOptions
from manip_learn.errors import ManipLearnError
from manip_learn.recordings.load import Progress
from manip_learn.robot.description.catalogue import SHIPPED, example_robots, fetched_names, find_robot
from manip_learn.robot.description.text import parse_xml, read_description
from manip_learn.robot.description.urdf import validate_urdf
from manip_learn.robot.robot_summary import RobotSummary, inspect_robot


@final
@dataclass(frozen=True)
class KnownRobot:
    """One robot.

    Attributes:
        name: As `load_robot` takes it.
        origin: `package`; `extra`, of the extra `robots`; `net`, fetched by the extra `descriptions`.
        joints: Joints that move on their own; empty where the description is refused, or is not fetched to be listed.
        refused: Why it cannot be loaded; empty where it can.
    """

    name: str
    origin: str
    joints: tuple[str, ...] = ()
    refused: str = ""


@final
@dataclass(frozen=True)
class KnownRobots:
    """All of them, those of the package first, then those that are there without a net."""

    robots: tuple[KnownRobot, ...]

    def of(self, origin: str) -> tuple[KnownRobot, ...]:
        """Those of one origin."""
        return tuple(robot for robot in self.robots if robot.origin == origin)

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer."""
        robots = [vars(r) | {"refused": r.refused or None} for r in self.robots]
        return {"robots": robots, "extra_installed": bool(self.of("extra"))}


def known_robots(options: RobotsOptions, progress: Progress | None = None) -> KnownRobots:
    """Every robot that has a name here and now, with its joints."""
    extra = sorted(example_robots())
    net = [KnownRobot(name, "net") for name in sorted(fetched_names().difference(SHIPPED, extra))]
    here = [*(_described(n, "package") for n in sorted(SHIPPED)), *(_described(n, "extra") for n in extra)]
    return KnownRobots((*here, *net))


def _described(name: str, origin: str) -> KnownRobot:
    path = find_robot(name)
    try:
        checked = validate_urdf(parse_xml(read_description(path), path))
    except ManipLearnError as error:
        return KnownRobot(name, origin, (), str(error))
    followers = {m.joint for m in checked.followers}
    moving = [j.name for j in checked.joints if j.type != "fixed" and j.name not in followers]
    return KnownRobot(name, origin, tuple(moving))


@final
@dataclass(frozen=True)
class Inspected:
    """What a robot is made of.

    Attributes:
        summary: Its facts.
        loaded: The words of a command that name it: its name or file, and how it is loaded.
    """

    summary: RobotSummary
    loaded: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer; limits that do not exist are infinite, which JSON says as null."""
        return dataclasses.asdict(self.summary)


def inspect(options: InspectOptions, progress: Progress | None = None) -> Inspected:
    """Load a robot and look at it, and check its forward kinematics by another library."""
    loaded = (options.robot, *options.loading.words)
    return Inspected(inspect_robot(options.loading.load(options.robot)), loaded)
