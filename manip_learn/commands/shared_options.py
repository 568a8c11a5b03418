"""What commands share: the options of the robot and of reading, help under headings, a look at where they write."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from typer.core import TyperCommand

from manip_learn.atomic_write import check_folder
from manip_learn.commands.plan_options import plan_options
from manip_learn.commands.read_options import read_options
from manip_learn.commands.robot_options import robot_options

# parameter of a command -> the function whose parameters are the flags, and which makes its value of them
HEADINGS = {"learn": "Learning", "control": "Task"}
HEADINGS_AFTER = ("Plan", "Controller", "Reading recordings", "Robot", "Output")
CONTROLLER = {"policy", "rest", "gain", "task_gain", "inverse", "duration", "dt"}
WRITTEN = {"out", "html", "csv"}
OUTPUT = {*WRITTEN, "open_browser", "browser", "explain", "as_json", "help"}
SETS: dict[str, Callable[..., Any]] = {
    "planned": plan_options,
    "robot_options": robot_options,
    "options": read_options,
}
SET_HEADINGS = {"planned": "Plan", "options": "Reading recordings", "robot_options": "Robot"}


def takes_shared_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command with the flags of each set in place of its parameter of that name, which gets what they say."""
    own = inspect.signature(command, eval_str=True).parameters
    flags = {name: inspect.signature(SETS[name], eval_str=True).parameters for name in own if name in SETS}

    @functools.wraps(command)
    def with_options(**given: Any) -> None:
        made = {name: SETS[name](**{flag: given.pop(flag) for flag in of}) for name, of in flags.items()}
        command(**given, **made)

    merged: list[inspect.Parameter] = []
    for parameter in own.values():
        merged += flags[parameter.name].values() if parameter.name in flags else [parameter]
    merged = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in merged]
    vars(with_options).update(__signature__=inspect.Signature(merged), __annotations__={})
    return with_options


class GroupedCommand(TyperCommand):
    """A command whose options are listed under headings, and which looks where it is to write before it works."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Arguments, then options of the command, the controller, of reading, of the robot, and of the output."""
        own_flags = {parameter.name for parameter in self.get_params(ctx)}
        sets = {heading: set(inspect.signature(SETS[name]).parameters) for name, heading in SET_HEADINGS.items()}
        shared = {flag: heading for heading, flags in sets.items() if flags <= own_flags for flag in flags}
        sections: dict[str, list[Any]] = {
            title: [] for title in ("Arguments", HEADINGS.get(self.name or "", "Options"), *HEADINGS_AFTER)
        }
        own = list(sections)[1]
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                named = dict.fromkeys(OUTPUT, "Output") | dict.fromkeys(CONTROLLER, "Controller") | shared
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
