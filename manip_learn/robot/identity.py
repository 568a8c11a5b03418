"""Identity of the robot of a file, to refuse another robot and to load the same one with the same locked joints."""

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
    """Identity of a robot, with its locked joints and their positions.

    Attributes:
        name: Name of the robot.
        fingerprint: `Robot.fingerprint`: hash of its kinematics and masses, with the locked joints.
        nq: Size of a configuration.
        joint_names: One name per degree of freedom.
        locked: Locked joint -> position [rad or m], the argument `locked` of `load_robot`.
        objects: Names of objects whose pose is recorded, the argument `objects` of `load_robot`.
        source: Name or file with which `load_robot` loaded it; empty if not known.
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
        """Return the identity of a loaded robot.

        Args:
            robot: The robot.
        """
        source = known_as(robot.source) or str(robot.source or "")
        return RobotIdentity(
            robot.name, robot.fingerprint, robot.nq, robot.joint_names, dict(robot.locked), robot.objects, source
        )

    def load(self) -> Robot:
        """Load the robot again, with the same joints locked and the same objects.

        Returns:
            The robot. If its file has changed since, `differences` reports it.

        Raises:
            ManipLearnError: Its file is missing, or no robot of this name is known on this machine.
        """
        return load_robot(self.source or self.name, locked=self.locked, objects=self.objects)

    def to_dict(self) -> dict[str, Any]:
        """Return the identity as a dictionary of JSON values."""
        words = {key: list(value) if isinstance(value, tuple) else value for key, value in vars(self).items()}
        return words | {"locked": dict(self.locked)}

    @staticmethod
    def from_dict(content: object) -> RobotIdentity:
        """Build an identity from the output of `to_dict`.

        Args:
            content: The output of `to_dict`; `locked`, `objects` and `source` may be missing.

        Raises:
            ValueError: The content is not valid; the message names the entry and its value.
        """
        if not isinstance(content, Mapping):
            raise ValueError(f"the robot must be an object, it is {type(content).__name__}")
        words = {"locked": {}, "objects": [], "source": "", **content}
        texts = {key: (key, str, "text") for key in ("name", "fingerprint", "source")}
        for key, (what, kind, expected) in (texts | {"locked": ("locked joints", Mapping, "an object")}).items():
            if not isinstance(words.get(key), kind):
                raise ValueError(f"the robot's {what} must be {expected}, it is {words.get(key)!r:.40}")
        nq, locked = words.get("nq"), words["locked"]
        if not isinstance(nq, int) or isinstance(nq, bool) or not 0 <= nq < 100_000:
            raise ValueError(f"the robot's nq must be a number, it is {nq!r:.40}")
        for name, value in locked.items():
            if not isinstance(name, str) or finite(value) is None:
                raise ValueError(f"joint {name!r} is locked at {value!r:.40}, a finite number is needed")
        joints, objects = (names_from(words.get(key), f"the robot's {key}") for key in ("joint_names", "objects"))
        positions = {name: float(value) for name, value in locked.items()}
        return RobotIdentity(words["name"], words["fingerprint"], nq, joints, positions, objects, words["source"])

    def differences(self, robot: Robot) -> tuple[str, ...]:
        """Return the differences from a loaded robot, each as a phrase; empty if there are none.

        Args:
            robot: The robot to compare with.
        """
        other, differences = RobotIdentity.of(robot), []
        if self.joint_names != other.joint_names:
            differences.append(f"its joints are {few(self.joint_names)}, not {few(other.joint_names)}")
        if dict(self.locked) != dict(other.locked):
            mine, theirs = self.locked, other.locked
            changed = [j for j in dict.fromkeys([*mine, *theirs]) if mine.get(j) != theirs.get(j)]
            parts = [f"{j!r} is {_describe_lock(mine.get(j))}, not {_describe_lock(theirs.get(j))}" for j in changed]
            differences.append(few(parts, between="; "))
        if self.objects != other.objects:
            differences.append(f"its objects are {few(self.objects)}, not {few(other.objects)}")
        if not differences and self.fingerprint != other.fingerprint:
            hashes = f"hash {self.fingerprint[:12]!r}, not {other.fingerprint[:12]!r}"
            differences.append(f"the description has changed (kinematics or masses; {hashes})")
        return tuple(differences)

    def mismatch(self, robot: Robot, where: str) -> str | None:
        """Explain in a sentence how a loaded robot differs from the robot of a file, with the remedy.

        Args:
            robot: The robot to compare with.
            where: Name of the file or the object, with which the sentence begins.

        Returns:
            The sentence; None if there are no differences.
        """
        differences = self.differences(robot)
        if not differences:
            return None
        locked = f"locked={dict(self.locked)!r}"
        how = f"load_robot(..., {locked})" if self.locked else "load_robot(...) with no joint locked"
        fix = spoken(
            f"Load the robot that it was made with, {how}",
            f"Give the description of {self.name!r} that it was made with; the joints that were locked then are locked"
            + advice(" without {}", "", "--lock"),
        )
        finding = f"{where} was made with robot {self.name!r}, the robot loaded is {robot.name!r}"
        return f"{finding}: {'; '.join(differences)}. {fix}"

    def refuse_another(self, robot: Robot, where: str, path: Path | None = None) -> None:
        """Raise an error if a loaded robot differs from this one.

        Args:
            robot: The robot to compare with.
            where: Name of the file or the object, with which the message begins.
            path: File to store in the error; None if there is none.

        Raises:
            RecordingError: The robot is another one, or has other locked joints; code `other-robot`.
        """
        if mismatch := self.mismatch(robot, where):
            raise RecordingError(mismatch, code="other-robot", path=path)


def names_from(value: object, what: str) -> tuple[str, ...]:
    """Check that a JSON value is a list of names.

    Args:
        value: The JSON value.
        what: Name of the value, for the error message.

    Returns:
        The names.

    Raises:
        ValueError: The value is not a list of texts.
    """
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise ValueError(f"{what} must be a list of names, it is {value!r:.60}")
    return tuple(value)


def _describe_lock(position: float | None) -> str:
    """Return the state of a joint in words: its locked position [rad or m], or "free to move" for None."""
    return "free to move" if position is None else f"locked at {position:.6g}"
