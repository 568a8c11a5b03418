"""The program `manip-learn`: its commands, and how each is run and its answer printed."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any, final

import typer
from typer.main import get_command

from manip_learn.commands import options
from manip_learn.commands.command_line import PROGRAM_NAME, GroupedCommand, ProgramHelp, parsed_by
from manip_learn.commands.output import console, for_json, progress


@final
@dataclass(frozen=True)
class _Command:
    """One command.

    Attributes:
        name: As it is typed.
        options: Dataclass of its arguments and options; its docstring is the help.
        work: File in `commands` and function that does the work: options and progress -> an `Answer`.
    """

    name: str
    options: type
    work: str

    def __call__(self, given: Any) -> None:
        """Do the work, and print the answer."""
        file, function = self.work.split(".")
        work = getattr(import_module(f"manip_learn.commands.{file}"), function)
        with progress(given.as_json) as report:
            answer = work(given, report)
        if given.as_json:
            print(json.dumps(for_json(answer.content), indent=2, allow_nan=False))
        else:
            from manip_learn.commands.tables import show  # rich takes a moment

            show(console(), answer, vars(given).get("explain"))


COMMANDS = (
    _Command("robots", options.RobotsOptions, "robots.known_robots"),
    _Command("demo", options.DemoOptions, "demo.demo"),
    _Command("inspect", options.InspectOptions, "robots.inspect"),
    _Command("record", options.RecordOptions, "record.record_motions"),
    _Command("teach", options.TeachOptions, "teach.teach"),
    _Command("learn", options.LearnOptions, "learn.learn_task"),
    _Command("audit", options.AuditOptions, "audit.audit"),
    _Command("control", options.ControlOptions, "control.control"),
    _Command("repeat", options.RepeatOptions, "repeat.repeat_skill"),
    _Command("replay", options.ReplayOptions, "replay.replay_files"),
    _Command("export", options.ExportOptions, "export.export"),
    _Command("reproduce", options.ReproduceOptions, "reproduce.reproduce_paper"),
)
# commands of 0.1 that are gone, and what to do instead; until 0.3
REMOVED_COMMANDS = {"warm-up": "nothing is compiled any more: leave the command out"}
app = typer.Typer(
    name=PROGRAM_NAME,
    help="Learn which directions a demonstrated task constrains, and keep the arm away from its singularities.",
    cls=ProgramHelp,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for each_command in COMMANDS:
    app.command(each_command.name, cls=GroupedCommand)(parsed_by(each_command.options, each_command))


def print_version(asked: bool) -> None:
    """Print the version and leave, if it was asked for."""
    if asked:
        from importlib.metadata import version

        typer.echo(f"{PROGRAM_NAME} {version(PROGRAM_NAME)}")
        raise typer.Exit


@app.callback()
def front(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=print_version, is_eager=True)
    ] = False,
) -> None:
    """Learn which directions a demonstrated task constrains, and keep the arm away from its singularities."""


program = get_command(app)  # once: typer takes 50 ms to read all signatures
