"""Which robot a file was made with: enough to refuse another one, and to lock the same joints again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from manip_learn.errors import RecordingError, advice, few, spoken
from manip_learn.linalg import finite
from manip_learn.robot.description.catalogue import known_as
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot


@final
@dataclass(frozen=True)
class RobotIdentity:
    """Which robot, with which joints locked where.

    Attributes:
        name: Name of the robot.
        fingerprint: `Robot.fingerprint`: hash of its kinematics and masses, with the locked joints.
        nq: Size of a configuration.
        joint_names: One name per degree of freedom.
        locked: Joints that are held still, and where [rad or m]; as `load_robot(..., locked=...)` takes them.
        objects: Names of things whose pose is recorded; as `load_robot(..., objects=...)` takes them.
        source: The name or the file that `load_robot` found it by; empty where that is not known.
    """

    name: str
    fingerprint: str
    nq: int
    joint_names: tuple[str, ...]
    locked: Mapping[str, float] = field(default_factory=dict)
    objects: tuple[str, ...] = ()
    source: str = field(default="", compare=False)

    @staticmethod
    def of(robot: Robot) -> RobotIdentity:
        """That of a loaded robot."""
        source = known_as(robot.source) or str(robot.source or "")
        return RobotIdentity(
            robot.name, robot.fingerprint, robot.nq, robot.joint_names, dict(robot.locked), robot.objects, source
        )

    def load(self) -> Robot:
        """The robot once more, with the same joints locked.

        Raises:
            ManipLearnError: Its file is gone, or nothing of its name is known here.
        """
        return load_robot(self.source or self.name, locked=self.locked, objects=self.objects)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        words = {key: list(value) if isinstance(value, tuple) else value for key, value in vars(self).items()}
        return words | {"locked": dict(self.locked)}

    @staticmethod
    def from_dict(content: object) -> RobotIdentity:
        """The identity that `to_dict` was called on.

        Raises:
            ValueError: Something else.
        """
        if not isinstance(content, Mapping):
            raise ValueError(f"the robot must be an object, it is {type(content).__name__}")
        words = {"locked": {}, "objects": [], "source": "", **content}
        texts = {key: (key, str, "text") for key in ("name", "fingerprint", "source")}
        for key, (what, kind, wanted) in (texts | {"locked": ("locked joints", Mapping, "an object")}).items():
            if not isinstance(words.get(key), kind):
                raise ValueError(f"the robot's {what} must be {wanted}, it is {words.get(key)!r:.40}")
        nq, locked = words.get("nq"), words["locked"]
        if not isinstance(nq, int) or isinstance(nq, bool) or not 0 <= nq < 100_000:
            raise ValueError(f"the robot's nq must be a number, it is {nq!r:.40}")
        for name, value in locked.items():
            if not isinstance(name, str) or finite(value) is None:
                raise ValueError(f"joint {name!r} is locked at {value!r:.40}, a finite number is needed")
        joints, objects = (names_from(words.get(key), f"the robot's {key}") for key in ("joint_names", "objects"))
        held = {name: float(value) for name, value in locked.items()}
        return RobotIdentity(words["name"], words["fingerprint"], nq, joints, held, objects, words["source"])

    def differences(self, robot: Robot) -> tuple[str, ...]:
        """Its differences from a loaded robot, one part of a sentence each; empty if there are none."""
        other, found = RobotIdentity.of(robot), []
        if self.joint_names != other.joint_names:
            found.append(f"its joints are {few(self.joint_names)}, not {few(other.joint_names)}")
        if dict(self.locked) != dict(other.locked):
            mine, theirs = self.locked, other.locked
            changed = [j for j in dict.fromkeys([*mine, *theirs]) if mine.get(j) != theirs.get(j)]
            parts = [f"{j!r} is {_held(mine.get(j))}, not {_held(theirs.get(j))}" for j in changed]
            found.append(few(parts, between="; "))
        if self.objects != other.objects:
            found.append(f"its objects are {few(self.objects)}, not {few(other.objects)}")
        if not found and self.fingerprint != other.fingerprint:
            hashes = f"hash {self.fingerprint[:12]!r}, not {other.fingerprint[:12]!r}"
            found.append(f"the description has changed (kinematics or masses; {hashes})")
        return tuple(found)

    def mismatch(self, robot: Robot, where: str) -> str | None:
        """Return how a loaded robot differs from that of a file, and what to do; None if it does not."""
        found = self.differences(robot)
        if not found:
            return None
        locked = f"locked={dict(self.locked)!r}"
        how = f"load_robot(..., {locked})" if self.locked else "load_robot(...) with no joint locked"
        fix = spoken(
            f"Load the robot that it was made with, {how}",
            f"Give the description of {self.name!r} that it was made with; the joints that were locked then are locked"
            + advice(" without {}", "", "--lock"),
        )
        made = f"{where} was made with robot {self.name!r}, the robot loaded is {robot.name!r}"
        return f"{made}: {'; '.join(found)}. {fix}"

    def refuse_another(self, robot: Robot, where: str, path: Path | None = None) -> None:
        """Nothing, if it is this robot.

        Raises:
            RecordingError: Another robot, or other joints locked; code `other-robot`.
        """
        if said := self.mismatch(robot, where):
            raise RecordingError(said, code="other-robot", path=path)


def names_from(value: object, what: str) -> tuple[str, ...]:
    """Names as JSON holds them.

    Raises:
        ValueError: Not a list of texts.
    """
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise ValueError(f"{what} must be a list of names, it is {value!r:.60}")
    return tuple(value)


def _held(position: float | None) -> str:
    return "free to move" if position is None else f"locked at {position:.6g}"
