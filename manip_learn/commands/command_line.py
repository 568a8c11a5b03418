"""Command-line parser: makes flags and their help from dataclasses, and checks output files before a command runs."""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from contextvars import ContextVar
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from typer import Option
from typer.core import TyperCommand, TyperGroup

from manip_learn.atomic_write import check_folder
from manip_learn.errors import ManipLearnError, OutputError, RecordingError

PROGRAM_NAME = "manip-learn"
HELP_ALL = "help_all"
WRITTEN = {"out", "html", "csv"}
READ = {"robot", "driver", "constraint", "task", "recordings", "rollouts", "files"}  # arguments that may name a file
OUTPUT = {*WRITTEN, "open_browser", "browser", "explain", "as_json", "help", HELP_ALL}
# words of the command line; empty if the library was called from Python
TYPED: ContextVar[tuple[str, ...]] = ContextVar("typed words", default=())


def attribute_texts(kind: object) -> dict[str, str]:
    """Return the texts under `Attributes:` in the docstring of a class or a module.

    Args:
        kind: Class or module.

    Returns:
        Text of each attribute by its name.
    """
    entries = re.findall(r"^    (\w[\w ]*): (.*(?:\n {8}.*)*)", inspect.getdoc(kind) or "", re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in entries}


def command_function(options: type[Any], run: Callable[[Any], None]) -> Callable[..., None]:
    """Return a function for typer whose parameters are the fields of a class of options, and which runs the command.

    Args:
        options: Class of options. The first paragraph of its docstring is the help of the command, the second an
            example.
        run: Function that runs the command; its argument is an object of this class.
    """

    def with_options(**given: Any) -> None:
        run(options(**given))

    texts, headings = attribute_texts(sys.modules[options.__module__]), dict[str, str]()
    for kind in reversed(options.__mro__[:-1]):
        texts |= attribute_texts(kind)
        title = "Options" if kind is options else str(inspect.getdoc(kind)).partition(".")[0]
        headings |= dict.fromkeys(inspect.get_annotations(kind), title)
    hints, parameters = get_type_hints(options, include_extras=True), list[inspect.Parameter]()
    fields = sorted(dataclasses.fields(options), key=lambda field: (field.kw_only, headings[field.name] == "Output"))
    for field in fields:
        name, kind = field.name, hints[field.name]
        if get_origin(kind) is not Annotated:
            kind = Annotated[kind, Option("--" + name.replace("_", "-"))]
        get_args(kind)[1].help = texts[name]
        default = inspect.Parameter.empty if field.default is dataclasses.MISSING else field.default
        parameters.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind))
    with_options.__doc__, example, *_ = f"{inspect.getdoc(options)}\n\n".split("\n\n")
    with_options.__annotations__ = {}
    first = takewhile(lambda field: not field.kw_only or headings[field.name] == "Output", fields)
    layout = {"headings": headings, "first": {*(field.name for field in first), "help", HELP_ALL}, "example": example}
    vars(with_options).update(__signature__=inspect.Signature(parameters), **layout)
    return with_options


class GroupedCommand(TyperCommand):
    """Command whose help lists options under headings, and which checks its output files before it runs."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help: an example that works, then the rest.

        Args:
            ctx: Context of the parser.
            formatter: Formatter to write to.
        """
        words = textwrap.wrap(vars(self.callback)["example"], formatter.width - 11, break_on_hyphens=False)
        formatter.write("Example: " + " \\\n    ".join(words) + "\n\n")
        super().format_help(ctx, formatter)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments and the options for beginners; with `--help-all` all options by topic.

        Args:
            ctx: Context of the parser.
            formatter: Formatter to write to.
        """
        layout, others = vars(self.callback), []
        titles = ("Arguments", "Options", *(t for t in layout["headings"].values() if t != "Output"), "Output")
        sections: dict[str, list[Any]] = {title: [] for title in titles}
        for parameter in self.get_params(ctx):
            name, heading = parameter.name or "", "Arguments"
            if parameter.param_type_name != "argument":
                heading = "Output" if name in OUTPUT else layout["headings"][name]
            if HELP_ALL in ctx.meta or name in layout["first"]:
                sections[heading].append(parameter.get_help_record(ctx))
            else:
                others.append(parameter.opts[0])
        for heading, records in sections.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)
        if others:
            formatter.write_paragraph()
            text = f"--help-all also explains {', '.join(others)}"
            formatter.write(textwrap.fill(text, formatter.width, break_on_hyphens=False) + "\n")

    def invoke(self, ctx: Any) -> object:
        """Run the command.

        Args:
            ctx: Context of the parser, with the values of all options.

        Returns:
            Result of the command.

        Raises:
            OutputError: A folder of an output does not exist, or an output would replace an input.
        """
        values = {p.name: (p.opts[0], ctx.params.get(p.name)) for p in self.params}
        written = [(flag, Path(path)) for name, (flag, path) in values.items() if name in WRITTEN and path]
        for _, path in written:
            check_folder(path)
        # a constraint as JSON contains its whole file, and the task frame: it may replace the file
        adds = self.name == "export" and ctx.params.get("to") == "json"
        refuse_to_replace(written, [path for name, (_, path) in values.items() if name in READ and path and not adds])
        return super().invoke(ctx)


class ProgramHelp(TyperGroup):
    """Group of all commands, whose help begins with an example."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help: the first example to try, then the rest.

        Args:
            ctx: Context of the parser.
            formatter: Formatter to write to.
        """
        formatter.write(f"Example: {PROGRAM_NAME} demo\n\n")
        super().format_help(ctx, formatter)


def refuse_to_replace(outputs: Sequence[tuple[str, Path]], inputs: Iterable[str | Path | Sequence[str]]) -> None:
    """Refuse to overwrite an input, also if another path, a link or a hard link leads to it.

    Args:
        outputs: Pairs of a flag and the path of its output.
        inputs: Files, folders of recordings, names of robots, drivers as FILE.py:NAME, or lists of these.

    Raises:
        OutputError: An output is an input, a recording in a folder that is an input, a file that an input names (a mesh
            of a robot), or the same as another output.
    """
    places = {path.expanduser().resolve(): flag for flag, path in reversed(outputs)}
    for flag, path in outputs:
        if places[path.expanduser().resolve()] != flag:
            raise OutputError(f"{flag} {path} is the file that another option writes: name another file")
    there = [(flag, path.expanduser()) for flag, path in outputs if path.expanduser().exists()]
    if not there:  # new files replace nothing
        return
    texts = (text for one in inputs for text in ([one] if isinstance(one, str | Path) else one))
    for source in (source for text in texts for source in input_files(str(text))):
        for flag, path in there:
            if path.samefile(source) or path.resolve().name in _names_in(source):
                raise OutputError(f"{flag} {path} would replace an input, {source}: name another file")


def _names_in(source: Path) -> set[str]:
    """Return the names, without folders, of the meshes and other files in a robot's description."""
    from manip_learn.robot.loading import DESCRIPTION_SUFFIXES

    if source.suffix not in DESCRIPTION_SUFFIXES:
        return set()
    names = re.findall(r"""\bfile(?:name)?\s*=\s*["']([^"']+)""", source.read_text(encoding="utf-8", errors="replace"))
    return {PurePosixPath(name).name for name in names}


def input_files(text: str) -> Iterator[Path]:
    """Yield the file or folder that an argument names, and for a folder also the recordings in it.

    Args:
        text: File, folder, driver as FILE.py:NAME, or name of a robot.

    Yields:
        Paths of existing files.
    """
    from manip_learn.recordings.files import recording_files, recording_path

    path = recording_path(text)
    if not path.exists() and ".py:" in text:
        path = Path(text.rpartition(":")[0])
    if not path.exists():
        from manip_learn.robot.description.catalogue import find_robot

        with suppress(ManipLearnError):  # the command itself raises the error
            path = find_robot(text)
    if path.exists():
        yield path
    inside = [path] if path.is_dir() else []
    with suppress(RecordingError):
        inside = [file.path for folder in inside for file in recording_files(folder)[0]]
    for file in inside:
        yield from (p for p in file.rglob("*") if p.is_file()) if file.is_dir() else [file]


def flags_of(program: Any, arguments: Sequence[str]) -> set[str]:
    """Return the flags of the command that is named in the arguments.

    Args:
        program: Group of commands of typer.
        arguments: Arguments of a command line, with the name of the command.
    """
    command = next((program.commands[a] for a in arguments if a in program.commands), program)
    return {flag for parameter in command.params for flag in (*parameter.opts, *parameter.secondary_opts)}
