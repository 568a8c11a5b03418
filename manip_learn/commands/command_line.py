"""Options as the parser takes them: flags made from dataclasses, help under headings, and the line as it was typed."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, get_type_hints

from typer.core import TyperCommand

from manip_learn.atomic_write import check_folder

PROGRAM = "manip-learn"
VECTORS = ("--start", "--target", "--rest", "--direction")
HEADINGS = {"learn": "Learning", "control": "Task"}  # of a command's own options
HEADINGS_AFTER = ("Plan", "Controller", "Reading recordings", "Robot", "Output")
CONTROLLER = {"policy", "rest", "gain", "task_gain", "inverse", "duration", "dt"}
WRITTEN = {"out", "html", "csv"}
OUTPUT = {*WRITTEN, "open_browser", "browser", "explain", "as_json", "help"}
_WORDS: ContextVar[tuple[str, ...]] = ContextVar("typed words", default=())


def parsed_by(options: type, run: Callable[[Any], None]) -> Callable[..., None]:
    """A function for typer that has the fields of some options as its parameters, and runs a command with them.

    A field that is itself a dataclass is a set of options: its fields stand in its place, under its `HEADING`.

    Args:
        options: A dataclass; the first paragraph of its docstring is the help of the command.
        run: Takes an object of it.
    """
    own = _parameters(options)
    sets: dict[str, Any] = {name: p.annotation for name, p in own.items() if dataclasses.is_dataclass(p.annotation)}
    flags = {name: _parameters(kind) for name, kind in sets.items()}

    def with_options(**given: Any) -> None:
        made = {name: sets[name](**{flag: given.pop(flag) for flag in of}) for name, of in flags.items()}
        run(options(**given, **made))

    merged = [q for name, p in own.items() for q in flags.get(name, {name: p}).values()]
    with_options.__doc__ = (inspect.getdoc(options) or "").partition("\n\n")[0]
    with_options.__annotations__ = {}
    headings = {flag: sets[name].HEADING for name, of in flags.items() for flag in of}
    vars(with_options).update(__signature__=inspect.Signature(merged), headings=headings)
    return with_options


def _parameters(options: Any) -> dict[str, inspect.Parameter]:
    """Fields of a dataclass as keywords of a function."""
    hints = get_type_hints(options, include_extras=True)
    defaults = {
        f.name: inspect.Parameter.empty if f.default is dataclasses.MISSING else f.default
        for f in dataclasses.fields(options)
    }
    return {
        name: inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hints[name])
        for name, default in defaults.items()
    }


class GroupedCommand(TyperCommand):
    """A command whose options are listed under headings, and which looks where it is to write before it works."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Arguments, then options of the command, the controller, of reading, of the robot, and of the output."""
        own = HEADINGS.get(self.name or "", "Options")
        named = (
            dict.fromkeys(OUTPUT, "Output") | dict.fromkeys(CONTROLLER, "Controller") | vars(self.callback)["headings"]
        )
        sections: dict[str, list[Any]] = {title: [] for title in ("Arguments", own, *HEADINGS_AFTER)}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                heading = named.get(parameter.name or "", own)
                sections["Arguments" if parameter.param_type_name == "argument" else heading].append(record)
        for heading, records in sections.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)

    def invoke(self, ctx: Any) -> object:
        """Run the command.

        Raises:
            OutputError: The folder of a file to write is not there.
        """
        for parameter in self.params:
            path = ctx.params.get(parameter.name)
            if parameter.name in WRITTEN and path:
                check_folder(Path(path))  # some versions of typer make it a path later
        return super().invoke(ctx)


def flags_of(program: Any, arguments: Sequence[str]) -> set[str]:
    """Flags that the command named in the arguments has; `program` is typer's group of commands."""
    command = next((program.commands[a] for a in arguments if a in program.commands), program)
    return {flag for parameter in command.params for flag in (*parameter.opts, *parameter.secondary_opts)}


def joined_vectors(arguments: list[str]) -> list[str]:
    """The arguments with the numbers behind a vector option joined: `--start 0.1 -0.2` means `--start 0.1,-0.2`."""
    out: list[str] = []
    numbers: list[str] | None = None  # open while the values of a vector option follow
    for argument in arguments:
        if numbers is not None and _is_vector(argument):
            numbers.append(argument)
            continue
        if numbers:
            out.append(",".join(numbers))
        numbers = [] if argument in VECTORS else None
        out.append(argument)
    return [*out, ",".join(numbers)] if numbers else out


def _is_vector(text: str) -> bool:
    try:
        [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        return False
    return bool(text.strip())


@contextmanager
def typed(arguments: Sequence[str]) -> Iterator[None]:
    """Within it, `typed_command` knows the arguments."""
    token = _WORDS.set((PROGRAM, *arguments))
    try:
        yield
    finally:
        _WORDS.reset(token)


def typed_command() -> tuple[str, ...]:
    """Words of the command line; empty if the library was called from Python."""
    return _WORDS.get()
