"""Output of commands: answers as JSON documents and as text, progress, and errors."""

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

Progress = Callable[[str, float], None]  # function of the name of a stage and its completed share, in 0 .. 1
# keys of sentences, for people; values of other keys are for programs, which need names and paths unchanged
SENTENCES = {"message", "sentence", "notes", "warnings", "advice", "evidence", "reason", "reasons", "refused"}
SENTENCES |= {"stopped_by", "why", "helps", "hint", "story"}


def for_json(value: object, sentence: bool = False) -> Any:
    """Return a value that JSON can represent: None instead of NaN, paths as texts, and sentences that are printable.

    Args:
        value: Value to convert.
        sentence: True if texts are sentences, in which control characters are escaped.
    """
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
    """Answer of a command: a JSON document for programs, and text for people, which is printed in this order.

    Attributes:
        content: JSON document.
        title: First sentence.
        sentences: More sentences, each on its own line; empty sentences are not printed, here and below.
        facts: Names of facts, and their values as text.
        remarks: Sentences about the facts.
        rows: Lines of a table: for each heading the text of its cell; the most important headings first.
        warnings: Warnings, and obstacles, in sentences.
        notes: Further remarks, in sentences.
        written: Lines that end in the name of a file.
        page: Replay; None if none was written.
        pages: Headings, and texts in Markdown.
        following: Command to type next; empty if there is none.
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
        """Return a copy of the answer that names the written files.

        Args:
            out: Output file; None if none was written.
            page: Replay; None if none was written.
        """
        files = {"out": out, "html": None if page is None else page.html}
        return replace(self, content=self.content | files, written=[f"written: {out}" if out else ""], page=page)


def cells(content: Mapping[str, Any], layout: str) -> dict[str, str]:
    """Return the cells of a table row as texts by heading; "-" for a number that is missing or not finite.

    Args:
        content: JSON document with the numbers.
        layout: Headings, each with a format of keys in the document: `"time: {seconds:.1f} s; margin: {margin:.0%}"`.
    """
    values, words = for_json(dict(content)), {}
    for heading, form in (part.split(": ") for part in layout.split("; ")):
        try:
            words[heading] = form.format_map(values).replace("%", " %")
        except TypeError:  # None has no digits
            words[heading] = "-"
    return words


def place(point: Iterable[float]) -> str:
    """Return the coordinates of a point as text.

    Args:
        point: Coordinates [m].
    """
    return f"({', '.join(f'{x:.3f}' for x in point)}) m"


def silent(step: str, share: float) -> None:
    """Ignore progress: a progress function that shows nothing.

    Args:
        step: Name of the stage.
        share: Completed fraction, 0 to 1.
    """


@contextmanager
def progress(quiet: bool) -> Iterator[Progress]:
    """Yield a function that shows a progress bar on standard error; silent if that is not a terminal.

    Args:
        quiet: True to show nothing.

    Yields:
        Function that is called with the name of a stage and its completed fraction, 0 to 1.
    """
    if quiet or not sys.stderr.isatty():
        yield silent
        return
    from rich import progress as bars
    from rich.console import Console

    columns = (*bars.Progress.get_default_columns()[:-1], bars.TimeElapsedColumn())  # instead of the remaining time
    with bars.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda step, share: bar.update(task, description=step, completed=share)


def system_refusal(error: OSError) -> str:
    """Return a message for an error of the operating system, e.g. that the disk is full and nothing can be printed.

    Output that could not be printed is discarded, so that the interpreter does not report it again at its end.

    Args:
        error: Error of the operating system.
    """
    try:
        sys.stdout.flush()
    except OSError:
        discard_output()
    if error.filename is None:
        return f"the answer cannot be printed: {error.strerror or error}; send it to another file or disk"
    return f"the system refuses: {error.strerror or error} ({error.filename})"


def refuse(sentence: str, as_json: bool, code: str, facts: Mapping[str, Any] | None = None, exit_code: int = 2) -> int:
    """Print an error message on standard error; with `as_json` also a JSON document on standard output.

    The document is `{"error": {"code", "message", ...}}`.

    Args:
        sentence: Message of the error.
        as_json: True to print the JSON document.
        code: Code of the error.
        facts: Further fields of the JSON document; None for none.
        exit_code: Exit code to return.

    Returns:
        The exit code.
    """
    message = printable(" ".join(sentence.split()))
    if as_json:
        content = for_json({"error": {"code": code, "message": message, **(facts or {})}})
        try:
            print(json.dumps(content, indent=2), flush=True)
        except OSError:  # a closed pipe, or a full disk, which the sentence below reports
            discard_output()
    print(f"manip-learn: {message}", file=sys.stderr)
    return exit_code


def discard_output() -> int:
    """Drop further output without a message, because the reader of a pipe, such as `head`, has closed it.

    Returns:
        The exit code.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0
