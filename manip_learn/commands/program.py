"""The program `manip-learn`: its commands, and how each is run and its answer printed."""

from __future__ import annotations

import json
from functools import partial
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.main import get_command

from manip_learn.commands import options
from manip_learn.commands.command_line import PROGRAM_NAME, GroupedCommand, ProgramHelp, parsed_by
from manip_learn.commands.output import console, for_json, progress

# as it is typed -> file in `commands` and function that does the work, and its options, whose docstring is the help
COMMANDS: dict[str, tuple[str, type]] = {
    "robots": ("robots.known_robots", options.RobotsOptions),
    "demo": ("demo.demo", options.DemoOptions),
    "inspect": ("robots.inspect", options.InspectOptions),
    "record": ("record.record_motions", options.RecordOptions),
    "teach": ("teach.teach", options.TeachOptions),
    "learn": ("learn.learn_task", options.LearnOptions),
    "audit": ("audit.audit", options.AuditOptions),
    "control": ("control.control", options.ControlOptions),
    "repeat": ("repeat.repeat_skill", options.RepeatOptions),
    "replay": ("replay.replay_files", options.ReplayOptions),
    "export": ("export.export", options.ExportOptions),
    "reproduce": ("reproduce.reproduce_paper", options.ReproduceOptions),
}
# commands of 0.1 that are gone, and what to do instead; until 0.3
REMOVED_COMMANDS = {"warm-up": "nothing is compiled any more: leave the command out"}
app = typer.Typer(
    name=PROGRAM_NAME,
    cls=ProgramHelp,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def run_command(place: str, given: Any, as_json: bool) -> None:
    """Do the work of a command, and print its answer.

    Args:
        place: File in `commands` and function: options and progress -> an `Answer`.
        given: The options.
        as_json: Print one JSON document.
    """
    file, function = place.split(".")
    work = getattr(import_module(f"manip_learn.commands.{file}"), function)
    with progress(as_json) as report:
        answer = work(given, report)
    if as_json:
        print(json.dumps(for_json(answer.content), indent=2, allow_nan=False))
    else:
        from manip_learn.commands.tables import show  # rich takes a moment

        show(console(), answer, vars(given).get("explain"))


for each_name, (each_place, each_options) in COMMANDS.items():
    app.command(each_name, cls=GroupedCommand)(parsed_by(each_options, partial(run_command, each_place)))


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
