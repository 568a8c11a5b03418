"""What the caller asked for when recordings are read."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, final, get_args

from manip_learn.errors import RecordingError, spoken
from manip_learn.recordings.readers.episode_selection import EpisodeSelection
from manip_learn.recordings.readers.option_uses import OptionUses, UnmatchedOption, as_written
from manip_learn.recordings.readers.parser_request import ParserRequest, RobotOutline
from manip_learn.robot import Robot

Units = Literal["radians", "degrees", "normalised"]
TimeUnit = Literal["s", "ms", "us", "ns"]

SECONDS: dict[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


@final
@dataclass(frozen=True)
class ReadRequest:
    """Options of `load_demonstrations`, checked once; every reader gets the same object.

    Attributes:
        robot: The robot whose joints are read.
        units: Unit of angles in the files; None: radians, and values that look like another unit are
            refused. `"normalised"` is -100 .. 100 between the joint limits.
        units_insisted: Whether `units` was given as a word: then what looks like radians may be degrees.
        time_unit: Unit of the time column; None: seconds, and values that look like another unit are refused.
        ignore_columns: Names of columns that are not read.
        rename: Name in the file -> `"time"` or the name of a joint.
        columns: Patterns of the names of columns: of positions, and of velocities.
        joint_names: Names of the columns, in order, for files that have none.
        topics: Topics of a bag to read; None: all that carry the robot's joints.
        rate: Samples per second, for files without time stamps [Hz].
        outside_limits: What to do with positions far outside the joint limits.
        last_line: What to do with a last line of text that has no end, as that of a file that was cut off.
        episodes: Which episodes to read; None: all.
        task: Only episodes that show this task, of LeRobot data.
        feature: Feature of a LeRobot data set that holds the joint positions; None: `observation.state`.
        chosen: Numbers of the episodes to read of a data set, once these two have been looked up; None: all.
        uses: What of the options the recordings that were read so far had a use for.

    Raises:
        RecordingError: An option that is not one of its allowed values.
    """

    robot: Robot
    units: Units | None = None
    units_insisted: bool = False
    time_unit: TimeUnit | None = None
    ignore_columns: tuple[str, ...] = ()
    rename: Mapping[str, str] = field(default_factory=dict)
    columns: tuple[str, ...] = ()
    joint_names: tuple[str, ...] | None = None
    topics: tuple[str, ...] | None = None
    rate: float | None = None
    outside_limits: Literal["refuse", "note"] = "refuse"
    last_line: Literal["drop", "keep"] = "drop"
    episodes: EpisodeSelection | None = None
    task: str | None = None
    feature: str | None = None
    chosen: frozenset[int] | None = None
    uses: OptionUses = field(default_factory=OptionUses, compare=False, repr=False)

    def __post_init__(self) -> None:
        _check_choice("units", self.units, (None, *get_args(Units)))
        _check_choice("time_unit", self.time_unit, (None, *get_args(TimeUnit)))
        _check_choice("outside_limits", self.outside_limits, ("refuse", "note"))
        _check_choice("last_line", self.last_line, ("drop", "keep"))
        for option in ("ignore_columns", "columns", "joint_names", "topics"):
            object.__setattr__(self, option, _names(option, getattr(self, option)))
        _check_patterns(self.columns)
        for option, what in (("task", "the text of a task"), ("feature", "the name of a feature")):
            value = getattr(self, option)
            if value is not None and not (isinstance(value, str) and value.strip()):
                raise RecordingError(f"{as_written(option)} must be {what}, got {value!r}", code="option")
        if not isinstance(self.rename, Mapping):
            raise RecordingError(
                f"rename must be a mapping {{name in the file: name in the robot}}, got {self.rename!r}", code="option"
            )
        is_number = isinstance(self.rate, int | float)
        if self.rate is not None and not (is_number and math.isfinite(self.rate) and self.rate > 0):
            raise RecordingError(
                f"{as_written('rate')} must be a positive number of samples per second [Hz], got {self.rate!r}",
                code="option",
            )

    def renamed(self, name: str) -> str:
        """The name after renaming."""
        return self.uses.renamed(name, self.rename)

    def unmatched(self) -> list[UnmatchedOption]:
        """A sentence for each option that the recordings read so far had no use for."""
        return self.uses.unmatched(
            rename=self.rename,
            ignore_columns=self.ignore_columns,
            topics=self.topics,
            joint_names=self.joint_names,
            rate=self.rate,
            time_unit=self.time_unit,
            feature=self.feature,
            columns=self.columns or None,
        )

    def ignores(self, *names: str) -> bool:
        """True if a column with these names (in the file, and after renaming) is not to be read."""
        self.uses.see(*names)
        asked = [n for n in names if n in self.ignore_columns]
        for name in asked:
            self.uses.use("ignore_columns", name)
        return bool(asked)

    def for_parser(self) -> ParserRequest:
        """What a parser in another process needs of it."""
        robot = self.robot
        outline = RobotOutline(
            joint_names=robot.joint_names,
            continuous=tuple(b.name for b in robot.blocks if b.kind == "continuous"),
            position_lower=tuple(map(float, robot.position_lower)),
            position_upper=tuple(map(float, robot.position_upper)),
        )
        return ParserRequest(
            robot=outline,
            units=self.units,
            rename=dict(self.rename),
            joint_names=self.joint_names,
            topics=self.topics,
            rate=self.rate,
            chosen=self.chosen,
            feature=self.feature,
            uses=self.uses,
        )


def _check_choice(option: str, value: object, allowed: tuple[object, ...]) -> None:
    if value not in allowed:
        choices = ", ".join(spoken(repr(a), str(a)) for a in allowed if a)
        raise RecordingError(f"{as_written(option)} must be one of {choices}, got {value!r}", code="option")


def _check_patterns(patterns: tuple[str, ...]) -> None:
    wrong = [p for p in patterns if p.count("{joint}") + p.count("{index}") != 1]
    if wrong or len(patterns) > 2:
        seen = f"{wrong[0]!r}" if wrong else f"{len(patterns)} patterns"
        raise RecordingError(
            f"{as_written('columns')} must be one pattern of the columns of positions, and at most one of velocities, "
            f"each with {{joint}} or {{index}}, e.g. 'position.{{joint}}' or 'q[{{index}}]', got {seen}",
            code="option",
        )


def _names(option: str, value: str | Sequence[str] | None) -> tuple[str, ...] | None:
    if value is None:
        return None
    given = (value,) if isinstance(value, str) else value
    names = tuple(n for n in given if isinstance(n, str)) if isinstance(given, Sequence) else ()
    if not isinstance(given, Sequence) or len(names) != len(given):
        raise RecordingError(f"{as_written(option)} must be names, got {value!r}", code="option")
    return names
