"""`manip-learn robots` and `inspect`: the robots that can be named, and what one is made of."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, final

from manip_learn.commands.options import InspectOptions, RobotsOptions
from manip_learn.errors import ManipLearnError
from manip_learn.recordings.trajectory_source import Progress
from manip_learn.robot.description.catalogue import SHIPPED, example_robots, find_robot, robot_names
from manip_learn.robot.description.text import read_description
from manip_learn.robot.description.validation import validate_urdf
from manip_learn.robot.robot_summary import RobotSummary, summarise, with_cross_check


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
        return {
            "robots": [vars(r) | {"refused": r.refused or None} for r in self.robots],
            "extra_installed": self.extra,
        }


def known_robots(options: RobotsOptions, progress: Progress | None = None) -> KnownRobots:
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


@final
@dataclass(frozen=True)
class Inspected:
    """What a robot is made of."""

    summary: RobotSummary

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer; limits that do not exist are infinite, which JSON says as null."""
        content = dataclasses.asdict(self.summary)
        content["source"] = None if self.summary.source is None else str(self.summary.source)
        content["meshes_found"] = {k: str(v) for k, v in self.summary.meshes_found.items()}
        return content


def inspect(options: InspectOptions, progress: Progress | None = None) -> Iterator[Inspected]:
    """Load a robot and look at it.

    Yields:
        What is known at once, and that with the independent check of forward kinematics: the library that checks it
        takes longer to load than the robot.
    """
    robot = options.loading.load(options.robot)
    summary = summarise(robot)
    yield Inspected(summary)
    yield Inspected(with_cross_check(summary, robot))
