"""Errors: one base class, and one subclass for each problem that a caller can handle.

Every message gives the problem, its place, the actual value, the expected value and a remedy. The same facts are
attributes, so that a program need not parse the message.
"""

from __future__ import annotations

import difflib
import logging
import lzma
import re
import struct
import tokenize
import unicodedata
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, SupportsInt, final

# errors that Python, NumPy and zipfile raise for files that are broken, truncated, or of another kind
DAMAGE: tuple[type[Exception], ...] = (
    *(ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError, SyntaxError),
    *(TypeError, ValueError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error, lzma.LZMAError),
)
# layout characters, which may stay in a sentence that is printed line by line
_LAYOUT = frozenset("\n\t")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
# flags of the running command; None if the library is called from Python
_FLAGS: ContextVar[frozenset[str] | None] = ContextVar("flags of the command", default=None)


@contextmanager
def advice_for_command(flags: Iterable[str]) -> Iterator[None]:
    """Open a context in which error messages name command-line flags, limited to those given, not Python arguments.

    Args:
        flags: Flags that the running command accepts, e.g. `"--constraints"`.

    Yields:
        Nothing; the previous setting is restored at the end.
    """
    token = _FLAGS.set(frozenset(flags))
    try:
        yield
    finally:
        _FLAGS.reset(token)


def advice(sentence: str, python: str, flag: str) -> str:
    """Fill the placeholder `{}` in a sentence with the Python argument, or with the flag if a command runs.

    Args:
        sentence: Sentence with `{}` for the argument or the flag.
        python: Text for calls from Python, e.g. `"n_constraints=2"`.
        flag: Text for a running command, e.g. `"--constraints 2"`.

    Returns:
        The sentence; an empty text if the running command does not have these flags.
    """
    flags = _FLAGS.get()
    if flags is None:
        return sentence.replace("{}", python)
    return sentence.replace("{}", flag) if flags.issuperset(FLAG.findall(flag)) else ""


def printable(text: object, layout: bool = False) -> str:
    r"""Return a text that is safe to print: no character moves the cursor, sets colours or reverses the direction.

    Names of files, columns, frames and joints may contain any character. Control characters (C0, C1, escape), direction
    marks and unpaired surrogates are replaced by their Python escapes, e.g. `\x1b`.

    Args:
        text: Object of any type; it is converted by `str`.
        layout: True to keep line ends and tabs.

    Returns:
        The text; printable characters are unchanged.
    """
    string = str(text)
    if string.isprintable():
        return string
    return "".join(c if _is_safe(c) or (layout and c in _LAYOUT) else ascii(c)[1:-1] for c in string)


def _is_safe(character: str) -> bool:
    """Return True for a character that a terminal shows as it is."""
    return character.isprintable() or unicodedata.category(character) == "Zs"  # a space outside ASCII


def _printable_record(record: logging.LogRecord) -> bool:
    """Make the text of a log record printable; keep every record."""
    record.msg, record.args = printable(record.getMessage(), layout=True), None
    return True


logging.getLogger("manip_learn").addFilter(_printable_record)  # the logger of all records of the library


def counted(n: SupportsInt, noun: str) -> str:
    """Return a number with a noun in the singular or plural: "1 row", "2 trajectories", "3 stretches".

    Args:
        n: Number; thousands are separated by commas.
        noun: Noun in the singular.
    """
    if int(n) == 1:
        return f"1 {noun}"
    if noun[-1] == "y" and noun[-2] not in "aeiou":
        return f"{int(n):,} {noun[:-1]}ies"
    return f"{int(n):,} {noun}" + ("es" if noun.endswith(("s", "x", "ch", "sh")) else "s")


def named(noun: str, names: Iterable[str]) -> str:
    """Return a noun followed by names: "joint a", "joints a and b".

    Args:
        noun: Noun in the singular.
        names: At least one name.

    Returns:
        The noun, in the plural for several names, and the names as `listed` joins them.
    """
    words = list(names)
    return f"{counted(len(words), noun).partition(' ')[2]} {listed(words)}"


def under_new_names(who: str, former: Mapping[str, str], renamed: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments that were passed by their former names under their present names; until 0.4.

    Args:
        who: Name of the called function or class, for the error.
        former: Mapping from former to present names.
        renamed: Values that the caller passed, by name.

    Raises:
        TypeError: A name in `renamed` is not a former name.
    """
    for name in renamed:
        if name not in former:
            raise TypeError(f"{who} got an unexpected keyword argument {name!r}")
    return {former[name]: value for name, value in renamed.items()}


def an(given: object) -> str:
    """Return the type of a value for a message.

    Examples are `"a Robot"`, `"an ndarray of shape (7,)"`, `"None"`, and `"the class Robot"` for a class itself.

    Args:
        given: Value of any type; its `shape`, if it has one, is included.
    """
    if given is None:
        return "None"
    if isinstance(given, type):
        return f"the class {given.__name__}"
    kind = type(given).__name__
    shape = getattr(given, "shape", None)
    article = "an" if kind[0] in "aeiouAEIO" or kind == "ndarray" else "a"
    return f"{article} {kind} of shape {shape}" if shape else f"{article} {kind}"


def error_in_words(value: float, unit: str) -> str:
    """Return an uncertainty with its unit: `"0.0008 degrees"`, `"7.4 degrees"`, or `"better than 0.0001 degrees"`.

    Args:
        value: Uncertainty in `unit`. It is rounded to one significant digit below 0.095, otherwise to two; a value
            below 0.0001 is not printed.
        unit: Name of the unit.
    """
    if value < 1e-4:  # more digits are useless, and 3e-06 is hard to read
        return f"better than 0.0001 {unit}"
    return f"{value:.1g} {unit}" if value < 0.095 else f"{value:.2g} {unit}"


def listed(words: Iterable[str]) -> str:
    """Return words as an English list: "a", "a and b", "a, b and c".

    Args:
        words: At least one word.
    """
    *most, last = words
    return f"{', '.join(most)} and {last}" if most else last


def few(words: Sequence[str], most: int = 8, between: str = ", ") -> str:
    """Return the first words of a list and the number of the others, e.g. "a, b and 3 more"; "none" for no words.

    Args:
        words: Words to list.
        most: Largest number of words to show.
        between: Separator between the words.
    """
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return between.join(words[:most]) + more or "none"


def number_if_known(n: int) -> str:
    """Return the advice to set the number of constraint rows if it is known, as the end of a sentence.

    Args:
        n: Number of rows in the example.

    Returns:
        Text that begins with a comma; without the example if the running command has no flag `--constraints`.
    """
    return ", or give the number of rows if you know it" + advice(" ({})", f"n_constraints={n}", f"--constraints {n}")


def spoken(python: str, command: str) -> str:
    """Return one of two texts: the first if the library is called from Python, the second if a command runs.

    Args:
        python: Text if the library is called from Python.
        command: Text if a command runs.
    """
    return python if _FLAGS.get() is None else command


class ManipLearnError(Exception):
    """Base class of all errors that manip_learn raises on purpose.

    Attributes:
        code: Short stable name of the reason, e.g. `"option"`; docs/troubleshooting.md has an entry for each.
    """

    code: str = "input"

    def __init__(self, message: str, *, code: str | None = None):
        super().__init__(printable(message, layout=True))
        if code is not None:
            self.code = code

    def __reduce__(self):
        return _rebuild, (type(self), self.args, vars(self))  # constructors of children take other arguments

    def facts(self) -> dict[str, object]:
        """Return the facts of the message for programs.

        Returns:
            Values of the attributes by name, as JSON can represent them (paths as texts); without `code`, and without
            attributes that are None.
        """
        values = {key: value for key, value in vars(self).items() if key != "code" and value is not None}
        return {key: str(value) if isinstance(value, Path) else value for key, value in values.items()}


def _rebuild(kind: type[ManipLearnError], args: tuple[Any, ...], facts: dict[str, Any]) -> ManipLearnError:
    """Restore a pickled error without calling its constructor."""
    error = kind.__new__(kind, *args)
    vars(error).update(facts)
    return error


class _InFileError(ManipLearnError):
    """Base of errors about a file: its path, line and column."""

    def __init__(
        self,
        message: str,
        *,
        code: str | None = None,
        path: Path | None = None,
        line: int | None = None,
        column: str | None = None,
    ):
        super().__init__(message, code=code)
        self.path, self.line, self.column = path, line, column


class RobotError(_InFileError):
    """A robot description cannot be used.

    Attributes:
        code: Short stable name of the reason, e.g. `"not-xml"`.
        path: File of the description; None if there is no file.
        line: Line of the fault in the file, counted from 1; None if it has none.
    """

    code = "robot"


class UnknownNameError(ManipLearnError):
    """The robot, or another collection of names, does not contain a name.

    Attributes:
        kind: Kind of the name: `"frame"`, `"joint"`, `"robot"`, ...
        name: The unknown name.
        near: The closest names that exist.
    """

    code = "unknown-name"

    def __init__(
        self, kind: str, name: str, known: Iterable[str], where: str = "", more: str = "", others: Iterable[str] = ()
    ):
        """Create an error about a name; `others` are similar names that belong to a different thing."""
        names, different = sorted({str(n) for n in known}), [str(n) for n in others]
        self.kind = kind
        self.name = str(name)
        self.near = () if different else tuple(closest_names(self.name, names))
        place = f" in {where}" if where else ""
        if different:
            thing = "arm" if kind == "robot" else kind
            hint = f"{listed(map(repr, different))} {'is' if len(different) == 1 else 'are'} not the same {thing}"
        elif self.near:
            hint = f"did you mean {', '.join(repr(n) for n in self.near)}?"
        elif names:
            hint = f"it has {few([repr(n) for n in names], 12)}"
        else:
            hint = f"there are no {kind}s"
        super().__init__(f"unknown {kind} {self.name!r}{place}: {hint}{more}")


def closest_names(name: str, known: Iterable[str], n: int = 4) -> list[str]:
    """Return the known names nearest to an unknown one.

    Similar names come first, then names that contain it or are contained in it.

    Args:
        name: Unknown name; case does not matter.
        known: Names that exist.
        n: Largest number of names to return.
    """
    choices, lowered = list(known), name.lower()
    by_letters = {k.lower(): k for k in choices}
    near = [by_letters[k] for k in difflib.get_close_matches(lowered, by_letters, n=n, cutoff=0.55)]
    near += [k for k in choices if lowered and (lowered in k.lower() or k.lower() in lowered) and k not in near]
    return near[:n]


class ConfigurationError(ManipLearnError):
    """A setting is invalid, or a configuration or velocity vector has the wrong size or contains NaN or infinity."""

    code = "posture"


class FeatureError(ManipLearnError):
    """A feature map cannot be built or evaluated with the given arguments."""

    code = "features"


@final
class NumberOfConstraintsError(FeatureError):
    """The number of constraints is impossible for the features.

    Attributes:
        given: Number that was passed.
        most: Largest possible number; the smallest is 1.
        features: Description of the features.
    """

    code = "number-of-constraints"

    def __init__(self, given: int, most: int, features: str):
        self.given = given
        self.most = most
        self.features = features
        argument = advice("{}", "n_constraints", "--constraints") or "the number of constraints"
        super().__init__(f"{argument} must be between 1 and {most} for {features}, got {given}")


class ConstraintError(ManipLearnError):
    """A constraint cannot be built or used as requested, e.g. its selection matrix has dependent rows."""

    code = "constraint"


class ConstraintMismatchError(ConstraintError):
    """A saved constraint belongs to another robot, or the file contains no constraint."""

    code = "constraint-file"


class RecordingError(_InFileError):
    """A recording cannot be used.

    Attributes:
        code: Short stable name of the reason, e.g. `"missing-joint"`.
        path: File of the recording; None for data in memory.
        line: Line of the fault in the file, counted from 1; None if it has none.
        column: Name of the column with the fault; None if it concerns no single column.
    """

    code = "recording"


class NotIdentifiableError(ManipLearnError):
    """The demonstrations do not determine the constraint.

    Attributes:
        code: Short stable name of the reason, e.g. `"weak-gap"`.
        gaps: For each number of rows the gap, the ratio of free to constrained motion that supports it (10 and above is
            clear); empty if gaps were not computed.
        advice: Findings about the data, and next steps, in sentences.
    """

    def __init__(
        self,
        message: str,
        *,
        code: str = "not-identifiable",
        gaps: Mapping[int, float] | None = None,
        advice: Iterable[str] = (),
    ):
        super().__init__(message, code=code)
        self.gaps = dict(gaps or {})
        self.advice = tuple(advice)


@final
class NotFittedError(ManipLearnError, AttributeError):
    """A result of a learner is read before `fit`; also an AttributeError, so that `hasattr` works.

    Attributes:
        name: Name of the attribute that was read.
    """

    code = "not-fitted"

    def __init__(self, name: str):
        AttributeError.__init__(self, name=name)
        ManipLearnError.__init__(self, f"call learner.fit(demonstrations) first: {name} exists only after it")
        self.name = name

    def __reduce__(self):
        return NotFittedError, (self.name,)


class TargetError(ManipLearnError):
    """A target, distance or other input of a task is invalid, e.g. has the wrong size or is not finite."""

    code = "target"


class SceneError(ManipLearnError):
    """An obstacle cannot be used, or a scene file cannot be read."""

    code = "scene"


@final
class NoPlanError(ManipLearnError):
    """The motion is infeasible from every posture that was tried.

    Attributes:
        largest: Longest feasible part of the motion [m or rad]; 0 if even the grasp pose is out of reach.
        posture: Joint positions from which that part is feasible [rad or m]; None if there are none.
        stopped_by: Reason why the motion ends there, in words.
        helps: Changes that make the whole motion feasible, in sentences; empty if none of the tried changes does.
    """

    code = "no-plan"

    def __init__(
        self,
        message: str,
        *,
        largest: float = 0.0,
        posture: Any = None,
        stopped_by: str = "",
        helps: Iterable[str] = (),
    ):
        super().__init__(message)
        self.largest, self.posture, self.stopped_by, self.helps = largest, posture, stopped_by, tuple(helps)

    def facts(self) -> dict[str, object]:
        """Return the facts of the message for programs, with the posture as a list."""
        return super().facts() | ({} if self.posture is None else {"posture": list(map(float, self.posture))})


class ExperimentError(ManipLearnError):
    """An experiment cannot be run with the given arguments, e.g. with zero trials."""

    code = "experiment"


class OutputError(ManipLearnError):
    """An output file or folder cannot be written."""

    code = "output"


def install_hint(extra: str) -> str:
    """Return the commands that install an optional extra.

    Args:
        extra: Name of the extra in `pyproject.toml`, e.g. `"ros"`.
    """
    return f"pip install '.[{extra}]' in a checkout, elsewhere pip install 'manip_learn[{extra}]'"


@final
class MissingExtraError(ManipLearnError):
    """An optional dependency is not installed.

    Attributes:
        extra: Name of the extra that installs it.
    """

    code = "missing-extra"

    def __init__(self, what: str, extra: str):
        self.extra = extra
        super().__init__(f"{what} needs the optional extra {extra!r}: {install_hint(extra)}")
