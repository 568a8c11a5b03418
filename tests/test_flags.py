"""Flags and command lines that the texts of the library name exist."""

from __future__ import annotations

import ast
import re

from library_source import library

from manip_learn.commands.command_line import flags_of
from manip_learn.commands.program import program
from manip_learn.errors import FLAG

# flags of other programs: of `ros2 topic pub` and `echo`, of the program that writes the planar arms, and of git
FOREIGN = {"--once", "--name", "--no-optional-locks", "--always", "--abbrev", "--exclude", "--dirty", "--csv"}
COMMAND_LINE = re.compile(r"`manip-learn ([a-z]+)([^`]*)`")


def test_what_texts_name_exists():
    """A flag is one of some command; in a command line, one of that command."""
    own = {name: set(flags_of(program, [name])) for name in program.commands}
    every, found, faults = set().union(*own.values(), {"--version", "--help"}, FOREIGN), set[str](), list[str]()
    for source in library():
        for node in ast.walk(source.tree):
            if not isinstance(node, ast.Constant) or not isinstance(node.value, str):
                continue
            for command, words in COMMAND_LINE.findall(node.value):
                known = own.get(command, set()) if "..." not in command else every
                faults += [f"{source.relative}: {command} {flag}" for flag in FLAG.findall(words) if flag not in known]
            named = set(FLAG.findall(COMMAND_LINE.sub("", node.value)))
            found |= named
            faults += [f"{source.relative}: {flag}" for flag in named - every]
    assert {"--rename", "--lock", "--time-unit", "--frame", "--xacro"} <= found
    assert not faults, faults


def test_commands_share_their_options():
    """One set of reading options and one of the robot's, for all commands that read recordings or load robots."""
    sets = {name: flags_of(program, [name]) for name in program.commands}
    robot = {"--lock", "--package-dir", "--object", "--xacro", "--xacro-arg"}
    reading = {flag for flag in sets["export"] if flag.startswith("--")} - robot - {"--out", "--to", "--at"}
    assert {"--rename", "--columns", "--degrees", "--episodes"} <= reading
    assert all(robot <= sets[name] for name in ("learn", "audit", "replay", "export", "control", "inspect"))
    assert all(reading <= sets[name] for name in ("learn", "audit", "replay", "export"))
    assert all("--json" in own for own in sets.values())
