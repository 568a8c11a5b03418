"""Commands with the shared sets of options: those of the robot, and those of reading recordings."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

from manip_learn.commands.read_options import read_options
from manip_learn.commands.robot_options import robot_options

# parameter of a command -> the function whose parameters are the flags, and which makes its value of them
SETS: dict[str, Callable[..., Any]] = {"robot_options": robot_options, "options": read_options}


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


def flags_of(program: Any, arguments: Sequence[str]) -> set[str]:
    """Flags that the command named in the arguments has; `program` is typer's group of commands."""
    command = next((program.commands[a] for a in arguments if a in program.commands), program)
    return {flag for parameter in command.params for flag in (*parameter.opts, *parameter.secondary_opts)}
