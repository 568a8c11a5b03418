"""Errors: one base, and a child for each thing that a caller can act on.

Every message says what is wrong, where, the value seen, the value wanted and what to do. The same facts are kept as
attributes, so that a program need not parse the sentence.
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

# what Python, NumPy and zipfile raise for files that are broken, cut short, or of another kind
DAMAGE: tuple[type[Exception], ...] = (
    *(ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError, SyntaxError),
    *(TypeError, ValueError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error, lzma.LZMAError),
)
# line ends and tabs of a sentence may stay, where it is printed line by line
_LAYOUT = frozenset("\n\t")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
# flags of the command that runs; None where the library is called from Python
_FLAGS: ContextVar[frozenset[str] | None] = ContextVar("flags of the command", default=None)


@contextmanager
def advice_for_command(flags: Iterable[str]) -> Iterator[None]:
    """Within it, errors advise flags of the command line, and only those that the command at hand has."""
    token = _FLAGS.set(frozenset(flags))
    try:
        yield
    finally:
        _FLAGS.reset(token)


def advice(sentence: str, python: str, flag: str) -> str:
    """The sentence with `{}` replaced by what the caller can write: the Python argument, or the flag with its value.

    Empty where a command runs that does not have the flags.
    """
    flags = _FLAGS.get()
    if flags is None:
        return sentence.replace("{}", python)
    return sentence.replace("{}", flag) if flags.issuperset(FLAG.findall(flag)) else ""


def printable(text: object, layout: bool = False) -> str:
    r"""A text in which no character can move the cursor, colour the terminal or turn the direction of reading.

    Names of files, columns, frames and joints are whatever their maker wrote. Control characters (C0, C1, escape),
    marks of direction and halves of characters are written as Python writes them, e.g. `\x1b`.

    Args:
        text: Anything that has a text.
        layout: Line ends and tabs stay as they are.
    """
    said = str(text)
    if said.isprintable():
        return said
    return "".join(c if _is_safe(c) or (layout and c in _LAYOUT) else ascii(c)[1:-1] for c in said)


def _is_safe(character: str) -> bool:
    return character.isprintable() or unicodedata.category(character) == "Zs"  # a space that is none of ASCII


def _printable_record(record: logging.LogRecord) -> bool:
    record.msg, record.args = printable(record.getMessage(), layout=True), None
    return True


logging.getLogger("manip_learn").addFilter(_printable_record)  # where all records of the library are made


def counted(n: SupportsInt, noun: str) -> str:
    """A number with its noun: "1 row", "2 trajectories", "3 stretches"."""
    if int(n) == 1:
        return f"1 {noun}"
    if noun[-1] == "y" and noun[-2] not in "aeiou":
        return f"{int(n):,} {noun[:-1]}ies"
    return f"{int(n):,} {noun}" + ("es" if noun.endswith(("s", "x", "ch", "sh")) else "s")


def named(noun: str, names: Iterable[str]) -> str:
    """Names with their noun: "joint a", "joints a and b"."""
    words = list(names)
    return f"{counted(len(words), noun).partition(' ')[2]} {listed(words)}"


def under_new_names(who: str, former: Mapping[str, str], renamed: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments that were given under former names by those that they have now; until 0.4.

    Raises:
        TypeError: There is no such argument.
    """
    for name in renamed:
        if name not in former:
            raise TypeError(f"{who} got an unexpected keyword argument {name!r}")
    return {former[name]: value for name, value in renamed.items()}


def an(given: object) -> str:
    """A value by its kind: `"a Robot"`, `"an ndarray of shape (7,)"`; `"None"`; a class as `"the class Robot"`."""
    if given is None:
        return "None"
    if isinstance(given, type):
        return f"the class {given.__name__}"
    kind = type(given).__name__
    shape = getattr(given, "shape", None)
    article = "an" if kind[0] in "aeiouAEIO" or kind == "ndarray" else "a"
    return f"{article} {kind} of shape {shape}" if shape else f"{article} {kind}"


def error_in_words(value: float, unit: str) -> str:
    """An uncertainty as it is said: `"0.0008 degrees"`, `"7.4 degrees"`."""
    if value < 1e-4:  # nobody asks for more digits, and 3e-06 is no word
        return f"better than 0.0001 {unit}"
    return f"{value:.1g} {unit}" if value < 0.095 else f"{value:.2g} {unit}"


def listed(words: Iterable[str]) -> str:
    """Words as said aloud: "a", "a and b", "a, b and c"."""
    *most, last = words
    return f"{', '.join(most)} and {last}" if most else last


def few(words: Sequence[str], most: int = 8, between: str = ", ") -> str:
    """Return the first words, as many as an arm has joints, and how many more there are; "none" without any."""
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return between.join(words[:most]) + more or "none"


def number_if_known(n: int) -> str:
    """Advice to give the number of rows, as the end of a sentence."""
    return ", or give the number of rows if you know it" + advice(" ({})", f"n_constraints={n}", f"--constraints {n}")


def spoken(python: str, command: str) -> str:
    """The first text where the library is called from Python, the second where a command runs."""
    return python if _FLAGS.get() is None else command


class ManipLearnError(Exception):
    """Base of all errors raised on purpose by manip_learn.

    Attributes:
        code: Short stable name of the reason, e.g. `"option"`; docs/troubleshooting.md has an entry for each.
    """

    code: str = "input"

    def __init__(self, message: str, *, code: str | None = None):
        super().__init__(printable(message, layout=True))
        if code is not None:
            self.code = code

    def __reduce__(self):
        return _rebuilt, (type(self), self.args, vars(self))  # the children take other arguments

    def facts(self) -> dict[str, object]:
        """What the sentence says, for programs: values of its attributes that JSON can hold, without the code."""
        kept = {key: value for key, value in vars(self).items() if key != "code" and value is not None}
        return {key: str(value) if isinstance(value, Path) else value for key, value in kept.items()}


def _rebuilt(kind: type[ManipLearnError], args: tuple[Any, ...], facts: dict[str, Any]) -> ManipLearnError:
    error = kind.__new__(kind, *args)
    vars(error).update(facts)
    return error


class _InFileError(ManipLearnError):
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
        path: File of the description, or None.
        line: Line in the file, counted from 1, or None.
    """

    code = "robot"


class UnknownNameError(ManipLearnError):
    """A name that the robot does not have.

    Attributes:
        kind: What was looked for: `"frame"`, `"joint"`, `"robot"`, ...
        name: The name that was asked for.
        near: The closest names that exist.
    """

    code = "unknown-name"

    def __init__(
        self, kind: str, name: str, known: Iterable[str], where: str = "", more: str = "", others: Iterable[str] = ()
    ):
        """An error about a name; `others` are names that look alike and are known to be of another thing."""
        names, unlike = sorted({str(n) for n in known}), [str(n) for n in others]
        self.kind = kind
        self.name = str(name)
        self.near = () if unlike else tuple(closest_names(self.name, names))
        place = f" in {where}" if where else ""
        if unlike:
            thing = "arm" if kind == "robot" else kind
            hint = f"{listed(map(repr, unlike))} {'is' if len(unlike) == 1 else 'are'} not the same {thing}"
        elif self.near:
            hint = f"did you mean {', '.join(repr(n) for n in self.near)}?"
        elif names:
            hint = f"it has {few([repr(n) for n in names], 12)}"
        else:
            hint = f"there are no {kind}s"
        super().__init__(f"unknown {kind} {self.name!r}{place}: {hint}{more}")


def closest_names(name: str, known: Iterable[str], n: int = 4) -> list[str]:
    """Names of `known` that look like `name`: by similarity, then by containing it."""
    known, lowered = list(known), name.lower()
    by_letters = {k.lower(): k for k in known}
    near = [by_letters[k] for k in difflib.get_close_matches(lowered, by_letters, n=n, cutoff=0.55)]
    near += [k for k in known if lowered and (lowered in k.lower() or k.lower() in lowered) and k not in near]
    return near[:n]


class ConfigurationError(ManipLearnError):
    """A configuration or velocity vector has the wrong size or holds NaN or infinity."""

    code = "posture"


class FeatureError(ManipLearnError):
    """A feature map cannot be built or evaluated as asked."""

    code = "features"


@final
class NumberOfConstraintsError(FeatureError):
    """A number of constraints that the features cannot have.

    Attributes:
        given: The number asked for.
        most: The largest possible number; the smallest is 1.
        features: The features, in words.
    """

    code = "number-of-constraints"

    def __init__(self, given: int, most: int, features: str):
        self.given = given
        self.most = most
        self.features = features
        asked = advice("{}", "n_constraints", "--constraints") or "the number of constraints"
        super().__init__(f"{asked} must be between 1 and {most} for {features}, got {given}")


class ConstraintError(ManipLearnError):
    """A selection matrix is unusable (wrong size, dependent rows, not finite)."""

    code = "constraint"


class ConstraintMismatchError(ConstraintError):
    """A saved constraint belongs to another robot or another kind of file."""

    code = "constraint-file"


class RecordingError(_InFileError):
    """A recording cannot be used.

    Attributes:
        code: Short stable name of the reason, e.g. `"missing-joint"`.
        path: File of the recording, or None.
        line: Line in the file, counted from 1, or None.
        column: Column name, or None.
    """

    code = "recording"


class NotIdentifiableError(ManipLearnError):
    """The demonstrations do not determine the constraint.

    Attributes:
        code: Short stable name of the reason, e.g. `"weak-gap"`.
        gaps: Number of rows -> the gap that supports it, where gaps were found: 10 is clear.
        advice: What the data show, and what to try next.
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
    """What a learner has learnt is asked for before `fit`; an AttributeError too, so that `hasattr` works.

    Attributes:
        name: The attribute that was asked for.
    """

    code = "not-fitted"

    def __init__(self, name: str):
        AttributeError.__init__(self, name=name)
        ManipLearnError.__init__(self, f"call learner.fit(demonstrations) first: there is no {name} before it")
        self.name = name

    def __reduce__(self):
        return NotFittedError, (self.name,)


class TargetError(ManipLearnError):
    """A task target or a joint target has the wrong size or is not finite."""

    code = "target"


class SceneError(ManipLearnError):
    """A thing that stands in the world cannot be used, or a file of such things cannot be read."""

    code = "scene"


@final
class NoPlanError(ManipLearnError):
    """A way cannot be done from any posture that was tried.

    Attributes:
        largest: How much of the way can be done [m or rad]; 0 where the hand cannot even take hold.
        posture: Joint positions from which that much is done; None where there are none.
        stopped_by: What stops the arm there, in words.
        helps: What would let the whole way be done, in sentences; empty where nothing that was tried does.
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
        """The facts of every error, with the posture as a list."""
        return super().facts() | ({} if self.posture is None else {"posture": list(map(float, self.posture))})


class ExperimentError(ManipLearnError):
    """An experiment cannot be run as asked, e.g. with zero trials."""

    code = "experiment"


class OutputError(ManipLearnError):
    """An output file or folder cannot be written."""

    code = "output"


@final
def install_hint(extra: str) -> str:
    """Return the commands that install an optional extra.

    Args:
        extra: Name of the extra in `pyproject.toml`, e.g. `"ros"`.
    """
    return f"pip install '.[{extra}]' in a checkout, elsewhere pip install 'manip_learn[{extra}]'"


class MissingExtraError(ManipLearnError):
    """An optional dependency is not installed.

    Attributes:
        extra: Name of the extra that brings it.
    """

    code = "missing-extra"

    def __init__(self, what: str, extra: str):
        self.extra = extra
        super().__init__(f"{what} needs the optional extra {extra!r}: {install_hint(extra)}")
