"""What a parser of a foreign format is asked, in words that fit through a pipe: it runs in a process of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, final

from manip_learn.recordings.readers.option_uses import OptionUses


@final
@dataclass(frozen=True)
class RobotOutline:
    """What a parser must know about a robot.

    Attributes:
        joint_names: In the robot's order.
        continuous: Joints that turn without end.
        position_lower: Per joint [rad or m].
        position_upper: Per joint [rad or m].
    """

    joint_names: tuple[str, ...]
    continuous: tuple[str, ...]
    position_lower: tuple[float, ...]
    position_upper: tuple[float, ...]

    def joint_index(self, name: str) -> int:
        """Place of a joint."""
        return self.joint_names.index(name)


@final
@dataclass(frozen=True)
class ParserRequest:
    """Options of a `ReadRequest` that a parser needs; see there.

    Attributes:
        robot: Its joints.
        units: Unit of angles.
        rename: Name in the file -> name of a joint.
        joint_names: Names of the columns.
        topics: Topics of a bag.
        rate: Samples per second [Hz].
        chosen: Numbers of the episodes to read.
        feature: Feature of a LeRobot data set that holds the joint positions.
        uses: Which options were used.
    """

    robot: RobotOutline
    units: str | None = None
    rename: Mapping[str, str] = field(default_factory=dict)
    joint_names: tuple[str, ...] | None = None
    topics: tuple[str, ...] | None = None
    rate: float | None = None
    chosen: frozenset[int] | None = None
    feature: str | None = None
    uses: OptionUses = field(default_factory=OptionUses, compare=False)

    def renamed(self, name: str) -> str:
        """The name after renaming."""
        return self.uses.renamed(name, self.rename)

    def as_words(self) -> dict[str, Any]:
        """As JSON can write it."""
        words = asdict(replace(self, uses=None))  # type: ignore[arg-type]
        del words["uses"]
        words["chosen"] = None if self.chosen is None else sorted(self.chosen)
        return words

    @staticmethod
    def of_words(words: dict[str, Any]) -> ParserRequest:
        """From what `as_words` gave."""
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in words.items()}
        robot = {k: tuple(v) for k, v in words["robot"].items()}
        chosen = words["chosen"]
        return ParserRequest(
            **{**values, "robot": RobotOutline(**robot), "chosen": None if chosen is None else frozenset(chosen)}
        )
