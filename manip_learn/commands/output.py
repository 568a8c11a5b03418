"""Answers of commands: shown while one works, printed as JSON or for people, or refused in a sentence."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from manip_learn.errors import printable

if TYPE_CHECKING:
    from manip_learn.playback import ReplayResult

Progress = Callable[[str, float], None]  # called with what is being done and the share of it that is done, in 0 .. 1
# keys of sentences, for people; what other keys hold is for programs, which need names and paths as they are
SENTENCES = {"message", "sentence", "notes", "warnings", "advice", "evidence", "reason", "reasons", "refused"}
SENTENCES |= {"stopped_by", "why", "helps", "hint", "story"}


def for_json(value: object, sentence: bool = False) -> Any:
    """A value for JSON: null in place of NaN, which JSON does not have, names of files, and sentences for printing."""
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, dict):
        return {str(k): for_json(v, k in SENTENCES) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [for_json(v, sentence) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return printable(value, layout=True) if sentence and isinstance(value, str) else value


@final
@dataclass(frozen=True)
class Answer:
    """Answer of a command: a document for programs, and the same for people, printed in this order.

    Attributes:
        content: JSON document.
        title: First sentence.
        sentences: More of them, each on a line of its own; empty ones are left out, here and below.
        facts: Name -> words.
        remarks: Sentences about the facts.
        rows: Lines of a table, heading -> words; the headings in the order in which they matter.
        warnings: Doubts, and obstacles, in sentences.
        notes: More to know, in sentences.
        written: Lines that end in the name of a file.
        page: Replay that was written.
        pages: Heading -> text in Markdown.
        following: Command to type next.
    """

    content: dict[str, Any]
    title: str = ""
    sentences: Sequence[str] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    remarks: Sequence[str] = ()
    rows: Sequence[Mapping[str, str]] = ()
    warnings: Sequence[str] = ()
    notes: Sequence[str] = ()
    written: Sequence[str] = ()
    page: ReplayResult | None = None
    pages: Mapping[str, str] = field(default_factory=dict)
    following: str = ""

    def with_files(self, out: Path | None, page: ReplayResult | None = None) -> Answer:
        """Return the answer with the files that were written."""
        files = {"out": out, "html": None if page is None else page.html}
        return replace(self, content=self.content | files, written=[f"written: {out}" if out else ""], page=page)


def cells(content: Mapping[str, Any], layout: str) -> dict[str, str]:
    """Return numbers of a JSON document in words, by their headings: "-" where one does not exist or is not finite.

    Args:
        content: The document.
        layout: Headings with formats of keys of the document, e.g. `"time: {seconds:.1f} s; margin: {margin:.0%}"`.
    """
    known, words = for_json(dict(content)), {}
    for heading, form in (part.split(": ") for part in layout.split("; ")):
        try:
            words[heading] = form.format_map(known).replace("%", " %")
        except TypeError:  # None has no digits
            words[heading] = "-"
    return words


def place(point: Iterable[float]) -> str:
    """Return a point in metres as it is printed."""
    return f"({', '.join(f'{x:.3f}' for x in point)}) m"


def silent(step: str, share: float) -> None:
    """Take progress, and show nothing."""


@contextmanager
def progress(quiet: bool) -> Iterator[Progress]:
    """A progress bar on standard error; silent when it is not a terminal."""
    if quiet or not sys.stderr.isatty():
        yield silent
        return
    from rich import progress as bars
    from rich.console import Console

    shown = (*bars.Progress.get_default_columns()[:-1], bars.TimeElapsedColumn())  # in place of the time that is left
    with bars.Progress(*shown, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda step, share: bar.update(task, description=step, completed=share)


def refused_by_system(error: OSError) -> str:
    """A sentence about an error of the operating system, e.g. that the answer cannot be printed (a full disk).

    What was not printed is given up, so that the interpreter does not complain of it once more at its end.
    """
    try:
        sys.stdout.flush()
    except OSError:
        nobody_reads()
    if error.filename is None:
        return f"the answer cannot be printed: {error.strerror or error}; send it to another file or disk"
    return f"the system refuses: {error.strerror or error} ({error.filename})"


def refuse(sentence: str, as_json: bool, code: str, facts: Mapping[str, Any] | None = None, exit_code: int = 2) -> int:
    """Print a sentence on standard error; under --json also `{"error": {"code", "message", ...}}` on standard output.

    Returns:
        The exit code.
    """
    message = printable(" ".join(sentence.split()))
    if as_json:
        content = for_json({"error": {"code": code, "message": message, **(facts or {})}})
        try:
            print(json.dumps(content, indent=2), flush=True)
        except OSError:  # a pipe that nobody reads any more, or a full disk, which the sentence below tells
            nobody_reads()
    print(f"manip-learn: {message}", file=sys.stderr)
    return exit_code


def nobody_reads() -> int:
    """The reader of a pipe, such as `head`, has what it wants: what is left is given up, without a word.

    Returns:
        The exit code.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0
