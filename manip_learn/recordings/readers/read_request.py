"""What the caller asked for when recordings are read, and what of it they had a use for."""

from __future__ import annotations

import functools
import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, final, get_args

import numpy as np
from jaxtyping import Float

from manip_learn.errors import RecordingError, advice, closest_names, spoken
from manip_learn.recordings.earned_velocities import Velocities
from manip_learn.recordings.format_words import VELOCITY_SUFFIX
from manip_learn.recordings.readers.name_patterns import INDEX, JOINT, renamed
from manip_learn.robot import Robot

Units = Literal["radians", "degrees", "normalised"]
TimeUnit = Literal["s", "ms", "us", "ns"]

SECONDS: dict[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # of one unit
UNIT_WORDS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
# options that only some formats have a use for, and why the recordings had none
WHY = {
    "topics": "topics are read from ROS bags, and none of the recordings is one",
    "joint_names": "the recordings name their columns or joints themselves, so these names are not used",
    "time_unit": "the recordings are of formats that state the unit of their time stamps",
    "columns": "patterns are those of columns of text tables, and none of the recordings is one",
    "feature": "features are those of LeRobot data sets, and none of the recordings is one",
}


def first_names(names: Sequence[str], most: int = 12) -> str:
    """Names in quotes, the first of them where they are many; "none" without any."""
    return (", ".join(map(repr, names[:most])) or "none") + (" ..." if len(names) > most else "")


def flag_of(option: str) -> str:
    """The flag of the command line for a keyword of `load_demonstrations`."""
    return {"ignore_columns": "--ignore-column", "topics": "--topic"}.get(option, "--" + option.replace("_", "-"))


def as_written(option: str) -> str:
    """A keyword of `load_demonstrations` as the caller writes it: in Python, or on the command line."""
    return spoken(option, flag_of(option))


@final
class UnmatchedOption(str):
    """A sentence about an option that matched nothing in the files that were read; it travels among their notes.

    Of recordings that are read in several parts, an option is a mistake only if it matched nothing in any of them.

    Attributes:
        option: The option with its value, the same in every part.
    """

    option: str

    def __new__(cls, option: str, sentence: str) -> UnmatchedOption:
        """The sentence, and the option that it is about."""
        self = super().__new__(cls, sentence)
        self.option = option
        return self

    def __reduce__(self) -> tuple[type[UnmatchedOption], tuple[str, str]]:
        return UnmatchedOption, (self.option, str(self))


@final
class OptionUses:
    """What was used of the options while recordings were read, and the names that were seen.

    Attributes:
        used: Option -> of those that list names, what was called so in the files.
    """

    def __init__(self) -> None:
        self.used: dict[str, set[str]] = {}
        self._seen: dict[str, None] = {}

    def see(self, *names: str) -> None:
        """Names of columns, joints or arrays in a file."""
        if len(self._seen) < 10_000:  # for near matches
            self._seen.update(dict.fromkeys(names))

    def use(self, option: str, *names: str) -> None:
        """An option was used; of options that list names, these."""
        self.used.setdefault(option, set()).update(names)

    def no(self, name: str) -> str:
        """The sentence that nothing is called so, with near matches."""
        near = [n for n in closest_names(name, self._seen) if n != name]
        there = first_names(list(self._seen)) if self._seen else "nothing"
        hint = f"did you mean {', '.join(map(repr, near))}?" if near else f"there is {there}"
        return f"nothing in the recordings is called {name!r}; {hint}"


def refuse_unmatched(notes: Iterable[str], n_parts: int = 1) -> list[str]:
    """The notes without sentences about options that matched in some part.

    Raises:
        RecordingError: An option that matched nothing in any part.
    """
    kept: list[str] = []
    unmatched: dict[str, list[UnmatchedOption]] = {}
    for note in notes:
        if isinstance(note, UnmatchedOption):
            unmatched.setdefault(note.option, []).append(note)
        else:
            kept.append(note)
    for sentences in unmatched.values():
        if len(sentences) >= n_parts:
            raise RecordingError(str(sentences[0]), code="option")
    return kept


@final
@dataclass(frozen=True)
class EpisodeSelection:
    """Numbers and half-open ranges of numbers, as Python counts: 0:50 is 0 to 49.

    Attributes:
        items: First number and the one after the last, None for no end; one pair per item.
    """

    items: tuple[tuple[int, int | None], ...]

    @staticmethod
    def of(episodes: str | int | Iterable[int]) -> EpisodeSelection:
        """From text such as `0:50,60,75`, `10:` or `:5`, or from numbers.

        Raises:
            RecordingError: Anything else.
        """
        if isinstance(episodes, int) and not isinstance(episodes, bool):
            episodes = [episodes]
        if isinstance(episodes, str):
            items = [_item(part, episodes) for part in episodes.split(",")]
        else:
            given = list(episodes) if isinstance(episodes, Iterable) else []
            numbers = [n for n in given if isinstance(n, int) and not isinstance(n, bool) and n >= 0]
            if not numbers or len(numbers) < len(given):
                raise _refused(episodes)
            items = [(n, n + 1) for n in numbers]
        return EpisodeSelection(tuple(items))

    def __str__(self) -> str:
        return ",".join(str(a) if b == a + 1 else f"{a}:{'' if b is None else b}" for a, b in self.items)

    def of_known(self, known: Sequence[int], where: str) -> frozenset[int]:
        """The selected ones among the numbers that exist.

        Raises:
            RecordingError: An item selects nothing; names the nearest numbers.
        """
        chosen: set[int] = set()
        for first, end in self.items:
            found = {n for n in known if n >= first and (end is None or n < end)}
            if not found:
                near = sorted(sorted(known, key=lambda n: abs(n - first))[:4])
                item = EpisodeSelection(((first, end),))
                raise RecordingError(
                    f"{where}: no episode is selected by {str(item)!r}; there are {len(known)}, numbered "
                    f"{min(known)} to {max(known)}; the nearest: {', '.join(map(str, near))}",
                    code="no-episode",
                )
            chosen |= found
        return frozenset(chosen)


def _item(part: str, text: str) -> tuple[int, int | None]:
    found = re.fullmatch(r"\s*(?:(\d{1,9})|(\d{1,9})?\s*:\s*(\d{1,9})?)\s*", part)
    if found is None:
        raise _refused(text)
    number, first, end = found.groups()
    if number is not None:
        return int(number), int(number) + 1
    return int(first or 0), None if end is None else int(end)


def _refused(given: object) -> RecordingError:
    return RecordingError(
        f"{advice('{}', 'episodes', '--episodes')} must be numbers and ranges such as '0:50,60,75' (counted from 0; "
        f"0:50 is 0 to 49), got {given!r}",
        code="option",
    )


def names_advice(n: int, robot: Robot, stamps: bool | None = None) -> str:
    """How to name n columns without names, if they are in the robot's order; the end of a sentence.

    Args:
        n: Number of columns.
        robot: Whose joints they may be.
        stamps: Whether the first column could be time stamps; None where they are kept elsewhere.
    """
    joints = list(robot.joint_names)
    names = [*(["time"] if stamps else []), *joints]
    if stamps is not None and len(names) + len(joints) <= n:
        names += [j + VELOCITY_SUFFIX for j in joints]
    if n > 6 * len(names):  # no table of this robot
        return advice(", or pass {}", "joint_names=[...]", "--joint-names NAME,NAME,...")
    names = [*names, *["-"] * n][:n]
    rate = (" and rate=<samples per second>", " --rate <samples per second>") if stamps is False else ("", "")
    python, flags = f"joint_names={names}{rate[0]}", f"--joint-names {','.join(names)}{rate[1]}"
    return advice(", or pass {} if they are in the robot's order ('-': not read)", python, flags)


def rename_words(rename: Mapping[str, str]) -> tuple[str, str]:
    """An option `rename` as it is written in Python, and as flags for a shell."""
    python = ", ".join(f"{old!r}: {new!r}" for old, new in rename.items())
    pairs = [old if new == JOINT else f"{old}={new}" for old, new in rename.items()]
    return f"rename={{{python}}}", " ".join(f"--rename {shlex.quote(p)}" for p in pairs)


@functools.lru_cache(maxsize=8)
def unmoved_joint_names(robot: Robot) -> tuple[str, ...]:
    """Joints of the description that are no degrees of freedom: locked, fixed and mimic joints."""
    frames = robot.pinocchio_model.frames
    fixed = [f.name for f in frames if f.type.name in ("FIXED_JOINT", "JOINT")]
    return tuple(n for n in (*fixed, *(m.joint for m in robot.mimics)) if n not in robot.joint_names)


@final
@dataclass(frozen=True)
class ReadRequest:
    """Options of `load_demonstrations`, checked once; every reader gets the same object.

    The options are described by `ReadOptions`.

    Attributes:
        units_insisted: Whether `units` was given as a word: then what looks like radians may be degrees.
        columns: Patterns of the names of columns: of positions, and of velocities.
        chosen: Numbers of the episodes of a data set, once `episodes` has been looked up; None: all.
        uses: What of the options the recordings that were read so far had a use for.

    Raises:
        RecordingError: An option that is not one of its allowed values.
    """

    robot: Robot
    units: Units | None = None
    units_insisted: bool = False
    time_unit: TimeUnit | None = None
    ignore_columns: tuple[str, ...] = ()
    rename: Mapping[str, str] | str = field(default_factory=dict)
    columns: tuple[str, ...] = ()
    joint_names: tuple[str, ...] | None = None
    topics: tuple[str, ...] | None = None
    rate: float | None = None
    outside_limits: Literal["refuse", "note"] = "refuse"
    episodes: EpisodeSelection | None = None
    feature: str | None = None
    velocities: Velocities = "auto"
    chosen: frozenset[int] | None = None
    uses: OptionUses = field(default_factory=OptionUses, compare=False, repr=False)

    def __post_init__(self) -> None:
        _check_choice("units", self.units, (None, *get_args(Units)))
        _check_choice("time_unit", self.time_unit, (None, *get_args(TimeUnit)))
        _check_choice("velocities", self.velocities, get_args(Velocities))
        _check_choice("outside_limits", self.outside_limits, ("refuse", "note"))
        for option in ("ignore_columns", "columns", "joint_names", "topics"):
            object.__setattr__(self, option, _names(option, getattr(self, option)))
        if self.joint_names is not None:  # a column that is not read
            object.__setattr__(self, "joint_names", tuple("" if n == "-" else n for n in self.joint_names))
        wrong = [p for p in self.columns if p.count("{joint}") + p.count("{index}") != 1]
        if wrong or len(self.columns) > 2:
            seen = f"{wrong[0]!r}" if wrong else f"{len(self.columns)} patterns"
            raise RecordingError(
                f"{as_written('columns')} must be one pattern of the columns of positions, and at most one of "
                "velocities, each with {joint} or {index}, e.g. 'position.{joint}' or 'q[{index}]', "
                f"got {seen}",
                code="option",
            )
        if self.feature is not None and not (isinstance(self.feature, str) and self.feature.strip()):
            text = f"{as_written('feature')} must be the name of a feature, got {self.feature!r}"
            raise RecordingError(text, code="option")
        rename = {self.rename: JOINT} if isinstance(self.rename, str) else self.rename
        if not isinstance(rename, Mapping) or not all(isinstance(n, str) for pair in rename.items() for n in pair):
            raise RecordingError(
                f"rename must be a mapping {{name in the file: name in the robot}}, got {self.rename!r}", code="option"
            )
        for old, new in rename.items():
            known = new == JOINT if INDEX in old else old.count(JOINT) == new.count(JOINT) < 2
            if not known:
                raise RecordingError(
                    f"{as_written('rename')} must be a name and its new name, or a pattern such as 'left_{JOINT}', "
                    f"'left_{JOINT}={JOINT}_l' or 'q{INDEX}', got {old!r} and {new!r}",
                    code="option",
                )
        object.__setattr__(self, "rename", rename)
        is_number = isinstance(self.rate, int | float)
        if self.rate is not None and not (is_number and math.isfinite(self.rate) and self.rate > 0):
            text = f"{as_written('rate')} must be a positive number of samples per second [Hz], got {self.rate!r}"
            raise RecordingError(text, code="option")

    def renamed(self, *names: str) -> tuple[str, ...]:
        """All names of one kind in a file, e.g. those of its columns, after renaming."""
        self.uses.see(*names)
        moving = self.robot.joint_names
        new = renamed(names, self.new_names, moving, unmoved_joint_names(self.robot)) if self.rename else {}
        self.uses.use("rename", *(entry for _, entry in new.values()))
        return tuple(new[n][0] if n in new else n for n in names)

    @property
    def new_names(self) -> Mapping[str, str]:
        """Name or pattern in the file -> new name."""
        return {} if isinstance(self.rename, str) else self.rename

    def counted(self, n: int) -> Float[np.ndarray, " n"]:
        """Time stamps of n samples at the rate that the caller gives [s]."""
        self.uses.use("rate")
        return np.arange(n) / (self.rate or 1.0)

    def unmatched(self) -> list[UnmatchedOption]:
        """A sentence for each option that the recordings read so far had no use for."""
        used = self.uses.used.get("rename", ())
        names = [(old, *rename_words({old: new})) for old, new in self.new_names.items() if old not in used]
        names += [
            (name, f"ignore_columns=[{name!r}]", f"--ignore-column {name}")
            for name in self.ignore_columns
            if name not in self.uses.used.get("ignore_columns", ())
        ]
        said = [(python, flag, self.uses.no(name)) for name, python, flag in names]
        topics, patterns = self.topics or (), self.columns
        flags = {
            "topics": " ".join(f"--topic {topic}" for topic in topics),
            "joint_names": "--joint-names",
            "columns": " ".join(f"--columns '{p}'" for p in patterns),
        }
        for option, why in WHY.items():
            value = getattr(self, option)
            if value not in (None, ()) and option not in self.uses.used:
                listed = list(value) if option in ("topics", "joint_names") else value
                flag = flags.get(option, f"{flag_of(option)} {value}")
                said.append((f"{option}={listed!r}", flag, f"{why}: leave it out"))
        return [UnmatchedOption(python, advice("{}: ", python, flag) + text) for python, flag, text in said]

    def ignores(self, *names: str) -> bool:
        """True if a column with these names (in the file, and after renaming) is not to be read."""
        self.uses.see(*names)
        asked = [n for n in names if n in self.ignore_columns]
        for name in asked:
            self.uses.use("ignore_columns", name)
        return bool(asked)


def _check_choice(option: str, value: object, allowed: tuple[object, ...]) -> None:
    if value not in allowed:
        choices = ", ".join(spoken(repr(a), str(a)) for a in allowed if a)
        raise RecordingError(f"{as_written(option)} must be one of {choices}, got {value!r}", code="option")


def _names(option: str, value: str | Sequence[str] | None) -> tuple[str, ...] | None:
    if value is None:
        return None
    given = (value,) if isinstance(value, str) else value
    names = tuple(n for n in given if isinstance(n, str)) if isinstance(given, Sequence) else ()
    if not isinstance(given, Sequence) or len(names) != len(given):
        raise RecordingError(f"{as_written(option)} must be names, got {value!r}", code="option")
    return names
