"""What the caller asked for when recordings are read, and what of it they had a use for."""

from __future__ import annotations

import functools
import math
import re
import shlex
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, final, get_args

import numpy as np
from jaxtyping import Float

from manip_learn.errors import RecordingError, advice, closest_names, spoken
from manip_learn.recordings.earned_velocities import Velocities
from manip_learn.recordings.format_words import VELOCITY_SUFFIX
from manip_learn.recordings.readers.name_patterns import INDEX, JOINT, renamed
from manip_learn.robot import Robot

Units = Literal["radians", "degrees", "normalised"]
TimeUnit = Literal["s", "ms", "us", "ns"]
OutsideLimits = Literal["refuse", "note"]

RATE = ("rate=<samples per second>", "--rate <samples per second>")  # how the option is written
SECONDS_OF: dict[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # of one unit
UNIT_WORDS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
FLAGS = {"ignore_columns": "--ignore-column", "topics": "--topic"}  # of options that are called otherwise in Python
CHOICES = {"units": Units, "time_unit": TimeUnit, "velocities": Velocities, "outside_limits": OutsideLimits}
# options that only some formats have a use for, and why the recordings had none
WHY = {
    "topics": "topics are read from ROS bags, and none of the recordings is one",
    "joint_names": "the recordings name their columns or joints themselves, so these names are not used",
    "time_unit": "the recordings are of formats that state the unit of their time stamps",
    "columns": "patterns are those of columns of text tables, and none of the recordings is one",
    "feature": "features are those of LeRobot data sets, and none of the recordings is one",
}
ITEM = re.compile(r"\s*(\d{1,9}|\d{0,9}\s*:\s*\d{0,9})\s*")  # of a selection of episodes


def first_names(names: Sequence[str], most: int = 12) -> str:
    """Names in quotes, the first of them where they are many; "none" without any."""
    return (", ".join(map(repr, names[:most])) or "none") + (" ..." if len(names) > most else "")


def flag_of(option: str) -> str:
    """The flag of the command line for a keyword of `load_demonstrations`."""
    return FLAGS.get(option, "--" + option.replace("_", "-"))


def option_words(option: str, value: Any) -> tuple[str, str]:
    """An option with its value, as it is written in Python, and as flags for a shell."""
    if isinstance(value, Mapping):
        words = [old if new == JOINT else f"{old}={new}" for old, new in value.items()]
    elif option == "joint_names":
        words = [",".join(name or "-" for name in value)]
    else:
        words = [value] if isinstance(value, str) else value
    listed = list(value) if isinstance(value, tuple) else value
    return f"{option}={listed!r}", " ".join(f"{flag_of(option)} {shlex.quote(word)}" for word in words)


rename_words = functools.partial(option_words, "rename")


def _refused(option: str, wanted: str, given: object) -> RecordingError:
    """The refusal of an option, which is called as the caller writes it: in Python, or on the command line."""
    return RecordingError(f"{spoken(option, flag_of(option))} must be {wanted}, got {given!r}", code="option")


@final
class UnmatchedOption(str):
    """A sentence about an option that matched nothing in the files that were read; it travels among their notes.

    Of recordings that are read in several parts, an option is a mistake only if it matched nothing in any of them.

    Attributes:
        option: The option with its value, the same in every part.
    """

    option = ""

    @staticmethod
    def of(option: str, value: Any, why: str) -> UnmatchedOption:
        """The sentence that says why an option had no use."""
        python, flags = option_words(option, value)
        sentence = UnmatchedOption(advice("{}: ", python, flags) + why)
        sentence.option = python
        return sentence


@final
class OptionUses:
    """What was used of the options while recordings were read, and the names that were seen.

    Attributes:
        used: Option -> of those that list names, what was called so in the files.
    """

    def __init__(self) -> None:
        self.used: dict[str, set[str]] = defaultdict(set)
        self._seen: dict[str, None] = {}

    def see(self, *names: str) -> None:
        """Names of columns, joints or arrays in a file."""
        if len(self._seen) < 10_000:  # for near matches
            self._seen.update(dict.fromkeys(names))

    def use(self, option: str, *names: str) -> None:
        """An option was used; of options that list names, these."""
        self.used[option].update(names)

    def no(self, name: str) -> str:
        """The sentence that nothing is called so, with near matches."""
        near = [n for n in closest_names(name, self._seen) if n != name]
        there = first_names(list(self._seen)) if self._seen else "nothing"
        hint = f"did you mean {', '.join(map(repr, near))}?" if near else f"there is {there}"
        return f"nothing in the recordings is called {name!r}; {hint}"


def refuse_unmatched(notes: Sequence[str], n_parts: int = 1) -> list[str]:
    """The notes without sentences about options that matched in some part.

    Raises:
        RecordingError: An option that matched nothing in any part.
    """
    unmatched = [note for note in notes if isinstance(note, UnmatchedOption)]
    parts = Counter(note.option for note in unmatched)
    for note in unmatched:
        if parts[note.option] >= n_parts:
            raise RecordingError(str(note), code="option")
    return [note for note in notes if not isinstance(note, UnmatchedOption)]


@final
@dataclass(frozen=True)
class EpisodeSelection:
    """Numbers and half-open ranges of numbers, as Python counts: 0:50 is 0 to 49.

    Attributes:
        items: Text of each of them, e.g. `5`, `0:50` or `10:`.
    """

    items: tuple[str, ...]

    @staticmethod
    def of(episodes: str | int | Iterable[int]) -> EpisodeSelection:
        """From text such as `0:50,60,75`, `10:` or `:5`, or from numbers.

        Raises:
            RecordingError: Anything else.
        """
        given = [episodes] if isinstance(episodes, int) else episodes
        texts = map(repr, given) if isinstance(given, Iterable) else ()  # True, 1.5 and '1' are no numbers of episodes
        items = given.split(",") if isinstance(given, str) else list(texts)
        if not items or not all(map(ITEM.fullmatch, items)):
            wanted = "numbers and ranges such as '0:50,60,75' (counted from 0; 0:50 is 0 to 49)"
            raise _refused("episodes", wanted, episodes)
        return EpisodeSelection(tuple(items))

    def of_known(self, known: Sequence[int], where: str) -> frozenset[int]:
        """The selected ones among the numbers that exist.

        Raises:
            RecordingError: An item selects nothing; names the nearest numbers.
        """
        chosen: set[int] = set()
        for item in self.items:
            first, is_range, end = (part.strip() for part in item.partition(":"))
            low = int(first or 0)
            high = low + 1 if not is_range else int(end) if end else math.inf
            found = {n for n in known if low <= n < high}
            if not found:
                near = sorted(sorted(known, key=lambda n: abs(n - low))[:4])
                text = f"{where}: no episode is selected by {item.strip()!r}; there are {len(known)}, numbered "
                text += f"{min(known)} to {max(known)}; the nearest: {', '.join(map(str, near))}"
                raise RecordingError(text, code="no-episode")
            chosen |= found
        return frozenset(chosen)


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
    outside_limits: OutsideLimits = "refuse"
    episodes: EpisodeSelection | None = None
    feature: str | None = None
    velocities: Velocities = "auto"
    chosen: frozenset[int] | None = None
    uses: OptionUses = field(default_factory=OptionUses, compare=False, repr=False)

    def __post_init__(self) -> None:
        for option, choices in CHOICES.items():
            value, allowed = getattr(self, option), get_args(choices)
            if value not in (*allowed, getattr(ReadRequest, option)):
                words = ", ".join(spoken(repr(a), str(a)) for a in allowed)
                raise _refused(option, f"one of {words}", value)
        for option in ("ignore_columns", "columns", "joint_names", "topics"):
            given = getattr(self, option)
            names = (given,) if isinstance(given, str) else given
            if names is None:
                continue
            if not isinstance(names, Sequence) or not all(isinstance(n, str) for n in names):
                raise _refused(option, "names", given)
            object.__setattr__(self, option, tuple(names))
        if self.joint_names is not None:  # a column that is not read
            object.__setattr__(self, "joint_names", tuple("" if n == "-" else n for n in self.joint_names))
        if len(self.columns) > 2 or any(p.count(JOINT) + p.count(INDEX) != 1 for p in self.columns):
            wanted = "one pattern of the columns of positions, and at most one of velocities, each with {joint} or "
            raise _refused("columns", wanted + "{index}, e.g. 'position.{joint}' or 'q[{index}]'", list(self.columns))
        if self.feature is not None and not (isinstance(self.feature, str) and self.feature.strip()):
            raise _refused("feature", "the name of a feature", self.feature)
        rename = {self.rename: JOINT} if isinstance(self.rename, str) else self.rename
        if not isinstance(rename, Mapping) or not all(isinstance(n, str) for pair in rename.items() for n in pair):
            raise _refused("rename", "a mapping {name in the file: name in the robot}", rename)
        for old, new in rename.items():
            known = new == JOINT if INDEX in old else old.count(JOINT) == new.count(JOINT) < 2
            if not known:
                wanted = "a name and its new name, or a pattern such as 'left_{joint}', 'left_{joint}={joint}_l' or "
                raise _refused("rename", wanted + "'q{index}'", f"{old}={new}")
        object.__setattr__(self, "rename", rename)
        rate = self.rate
        if rate is not None and not (isinstance(rate, int | float) and math.isfinite(rate) and rate > 0):
            raise _refused("rate", "a positive number of samples per second [Hz]", rate)

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
        parts = [("rename", {old: new}, old) for old, new in self.new_names.items()]
        parts += [("ignore_columns", (name,), name) for name in self.ignore_columns]
        used = self.uses.used
        said = [UnmatchedOption.of(o, part, self.uses.no(n)) for o, part, n in parts if n not in used[o]]
        asked = {option: value for option in WHY if (value := getattr(self, option)) and option not in used}
        return said + [UnmatchedOption.of(o, value, f"{WHY[o]}: leave it out") for o, value in asked.items()]

    def ignores(self, *names: str) -> bool:
        """True if a column with these names (in the file, and after renaming) is not to be read."""
        self.uses.see(*names)
        asked = [n for n in names if n in self.ignore_columns]
        for name in asked:
            self.uses.use("ignore_columns", name)
        return bool(asked)
