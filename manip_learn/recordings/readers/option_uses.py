"""Which options of the caller the recordings had a use for: one that matched nothing is a mistake, not a detail."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, final

from manip_learn.errors import RecordingError, advice, closest_names, spoken

MOST_SEEN = 10_000  # names kept for near matches


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
    """What was used of the options while recordings were read, and the names that were seen."""

    def __init__(self) -> None:
        self._used: dict[str, set[str]] = {}
        self._seen: dict[str, None] = {}

    def see(self, *names: str) -> None:
        """Names of columns, joints or arrays in a file."""
        if len(self._seen) < MOST_SEEN:
            self._seen.update(dict.fromkeys(names))

    def renamed(self, name: str, rename: Mapping[str, str]) -> str:
        """The name in a file after renaming."""
        self.see(name)
        if name in rename:
            self.use("rename", name)
        return rename.get(name, name)

    def use(self, option: str, *names: str) -> None:
        """An option was used; of options that list names, these."""
        self._used.setdefault(option, set()).update(names)

    def as_words(self) -> dict[str, Any]:
        """As JSON can write it."""
        return {"used": {option: sorted(names) for option, names in self._used.items()}, "seen": list(self._seen)}

    def add_words(self, words: dict[str, Any]) -> None:
        """What was used and seen elsewhere, from what `as_words` gave."""
        for option, names in words["used"].items():
            self.use(option, *names)
        self.see(*words["seen"])

    def unmatched(
        self,
        *,
        rename: Mapping[str, str],
        ignore_columns: Sequence[str],
        topics: Sequence[str] | None,
        joint_names: Sequence[str] | None,
        rate: float | None,
        time_unit: str | None,
        feature: str | None,
        columns: Sequence[str] | None,
    ) -> list[UnmatchedOption]:
        """A sentence for each option that matched nothing."""
        names = [
            (name, f"rename={{{name!r}: {new!r}}}", f"--rename {name}={new}")
            for name, new in rename.items()
            if name not in self._used.get("rename", ())
        ]
        names += [
            (name, f"ignore_columns=[{name!r}]", f"--ignore-column {name}")
            for name in ignore_columns
            if name not in self._used.get("ignore_columns", ())
        ]
        said = [UnmatchedOption(python, advice("{}: ", python, flag) + self._no(name)) for name, python, flag in names]
        flags = " ".join(f"--topic {topic}" for topic in topics or ())
        given = {
            "topics": (topics, f"topics={list(topics or ())}", flags),
            "joint_names": (joint_names, f"joint_names={list(joint_names or ())}", "--joint-names"),
            "rate": (rate, f"rate={rate}", f"--rate {rate}"),
            "time_unit": (time_unit, f"time_unit={time_unit!r}", f"--time-unit {time_unit}"),
            "columns": (columns, f"columns={columns}", " ".join(f"--columns '{p}'" for p in columns or ())),
            "feature": (feature, f"feature={feature!r}", f"--feature {feature}"),
        }
        for option, (value, python, flag) in given.items():
            if value is not None and option not in self._used:
                said.append(UnmatchedOption(python, advice("{}: ", python, flag) + f"{WHY[option]}: leave it out"))
        return said

    def _no(self, name: str) -> str:
        near = [n for n in closest_names(name, self._seen) if n != name]
        hint = f"did you mean {', '.join(map(repr, near))}?" if near else f"there is {self._shown()}"
        return f"nothing in the recordings is called {name!r}; {hint}"

    def _shown(self) -> str:
        names = list(self._seen)
        return (", ".join(map(repr, names[:12])) or "nothing") + (" ..." if len(names) > 12 else "")


WHY = {
    "topics": "topics are read from ROS bags, and none of the recordings is one",
    "joint_names": "the recordings name their columns or joints themselves, so these names are not used",
    "columns": "patterns are those of columns of text tables, and none of the recordings is one",
    "rate": "the recordings have time stamps, so the rate is not used",
    "feature": "features are those of LeRobot data sets, and none of the recordings is one",
    "time_unit": "the recordings are of formats that state the unit of their time stamps",
}


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
