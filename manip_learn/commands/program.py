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
        work: File in `commands` and function that does the work: options and progress -> an answer with `to_dict`.
        printer: Function in `commands.tables` that prints the answer.
    """

    name: str
    options: type
    work: str
    printer: str

    def __call__(self, given: Any) -> None:
        """Do the work, and print the answer."""
        file, function = self.work.split(".")
        work = getattr(import_module(f"manip_learn.commands.{file}"), function)
        with progress(given.as_json) as report:
            answer = work(given, report)
        if given.as_json:
            print(json.dumps(for_json(answer.to_dict()), indent=2, allow_nan=False))
        else:
            explain = {"explain": given.explain} if "explain" in vars(given) else {}
            getattr(import_module("manip_learn.commands.tables"), self.printer)(console(), answer, **explain)


COMMANDS = (
    _Command("robots", options.RobotsOptions, "robots.known_robots", "print_robots"),
    _Command("demo", options.DemoOptions, "demo.demo", "print_demo"),
    _Command("inspect", options.InspectOptions, "robots.inspect", "print_robot"),
    _Command("record", options.RecordOptions, "record.record_motions", "print_recorded"),
    _Command("teach", options.TeachOptions, "teach.teach", "print_taught"),
    _Command("learn", options.LearnOptions, "learn.learn_task", "print_learnt"),
    _Command("audit", options.AuditOptions, "audit.audit", "print_audit"),
    _Command("control", options.ControlOptions, "control.control", "print_controlled"),
    _Command("repeat", options.RepeatOptions, "repeat.repeat_skill", "print_repeated"),
    _Command("replay", options.ReplayOptions, "replay.replay_files", "print_replayed"),
    _Command("export", options.ExportOptions, "export.export", "print_exported"),
    _Command("reproduce", options.ReproduceOptions, "reproduce.reproduce_paper", "print_reproduction"),
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
