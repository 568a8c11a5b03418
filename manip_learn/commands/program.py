"""The program `manip-learn`: run each command and print its answer."""

from __future__ import annotations

import json
from functools import partial
from importlib import import_module
from typing import Annotated

import typer
from typer.main import get_command

from manip_learn.commands.command_line import PROGRAM_NAME, GroupedCommand, ProgramHelp, command_function
from manip_learn.commands.options import COMMANDS, Options
from manip_learn.commands.output import for_json, progress

# removed commands of 0.1, and their replacements; until 0.3
REMOVED_COMMANDS = {"warm-up": "nothing is compiled any more: leave the command out"}
app = typer.Typer(name=PROGRAM_NAME, cls=ProgramHelp, pretty_exceptions_enable=False, rich_markup_mode=None)


def run_command(work: str, given: Options) -> None:
    """Run a command, and print its answer.

    Args:
        work: Module in `commands` and name of its function, which takes the options and a progress function, and
            returns an `Answer`.
        given: Options of the command.
    """
    file, function = work.split(".")
    answer_of = getattr(import_module(f"manip_learn.commands.{file}"), function)
    with progress(given.as_json) as report:
        answer = answer_of(given, report)
    if given.as_json:
        print(json.dumps(for_json(answer.content), indent=2, allow_nan=False))
    else:
        from manip_learn.commands.tables import Console, show  # rich takes a moment

        show(Console(), answer, vars(given).get("explain"))


for each_name, (each_work, each_options) in COMMANDS.items():
    app.command(each_name, cls=GroupedCommand)(command_function(each_options, partial(run_command, each_work)))


def print_version(asked: bool) -> None:
    """Print the version and exit, if it was requested.

    Args:
        asked: True if the flag `--version` was typed.
    """
    if asked:
        from importlib.metadata import version

        typer.echo(f"{PROGRAM_NAME} {version(PROGRAM_NAME)}")
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", help="Show the version and exit.", callback=print_version, is_eager=True)
]


@app.callback()
def front(version: Version = False) -> None:
    """Learn which directions a demonstrated task constrains, and keep the arm away from its singularities."""


program = get_command(app)  # only once: typer takes 50 ms to read all signatures
