"""Flags that the texts of the library name: each exists on the commands that can say so, and so does each command."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache

from library_source import Source, library
from test_floors import own_imports

from manip_learn.commands.command_line import flags_of
from manip_learn.commands.program import COMMANDS as DECLARED
from manip_learn.commands.program import program
from manip_learn.errors import FLAG

COMMANDS = sorted(program.commands)
FILES = {name: place.partition(".")[0] for name, (place, _) in DECLARED.items()}
SOURCES = {source.name: source for source in library()}
# flags of other programs: of `ros2 topic pub` and `echo`, of the program that writes the planar arms, and of git
FOREIGN = {"--once", "--name", "--no-optional-locks", "--always", "--abbrev", "--exclude", "--dirty", "--csv"}
# its flags reach the caller through `advice` only
ADVISING = ("recordings/options.py",)
COMMAND_LINE = re.compile(r"`manip-learn ([a-z]+)([^`]*)`")
READERS = ("learn", "audit", "replay", "export")
LOADERS = (*READERS, "control", "inspect")


def texts(source: Source) -> Iterator[tuple[str, int, bool]]:
    """Text in a file with its line, and whether `advice` drops it for commands that lack its flags; no docstrings."""
    advised = {
        id(part)
        for call in ast.walk(source.tree)
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "advice" and len(call.args) == 3
        for part in ast.walk(call.args[2])
    }
    # the flag is often made a line before: `python, flag = ...`
    advised |= {
        id(part)
        for assignment in ast.walk(source.tree)
        if isinstance(assignment, ast.Assign) and re.search(r"\bflags?\b", ast.unparse(assignment.targets[0]))
        for part in ast.walk(assignment.value)
    }
    for node in ast.walk(source.tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and "\n\n" not in node.value:
            yield node.value, node.lineno, id(node) in advised or source.relative in ADVISING


def reached(command: str) -> set[str]:
    """Names of the files that a command imports, directly or not."""
    found, open_ = set(), [f"commands.{FILES[command]}"]
    while open_:
        name = open_.pop()
        if name in found or name not in SOURCES:
            continue
        found.add(name)
        open_ += [target for target, _ in own_imports(SOURCES[name])]
    return found


# the program itself, and what writes a command line of `learn` for a page; a test of the page runs that line
WRITERS = (
    "cli.py",
    "commands/program.py",
    "commands/options.py",
    "commands/command_line.py",
    "commands/replay.py",
    "playback/replay_page.py",
)


@cache
def named_flags() -> list[tuple[str, int, str, bool, str]]:
    """(path, line, flag, whether it is advised, name of the file) of every flag in a text of the library."""
    return [
        (source.relative, line, flag, advised, source.name)
        for source in SOURCES.values()
        if source.relative not in WRITERS
        for text, line, advised in texts(source)
        for flag in FLAG.findall(COMMAND_LINE.sub("", text))
        if flag not in FOREIGN
    ]


def test_flags_are_found():
    """The collection itself: it sees the flags that every reader of recordings advises."""
    assert {"--rename", "--lock", "--time-unit", "--frame", "--xacro"} <= {flag for _, _, flag, _, _ in named_flags()}


def test_every_flag_that_a_command_may_name_exists():
    """What stands in a text as it is: a flag of every command that can get there; what is advised: of some command."""
    every = set().union(*(flags_of(program, [c]) for c in COMMANDS), {"--version"})
    # the demo's robot, frame and recordings come with the package, so it cannot say what `learn` says about them
    for command in (c for c in COMMANDS if c != "demo"):
        own, files = flags_of(program, [command]), reached(command)
        wrong = [
            f"{command} reaches {file}:{line}: {flag}"
            for file, line, flag, advised, name in named_flags()
            if (flag not in every) or (name in files and not advised and flag not in own)
        ]
        assert not wrong, "\n".join(wrong)


def test_every_command_that_is_named_exists():
    """`manip-learn COMMAND` in a text is a command, and the flags behind it are its own."""
    spelt = [text for source in SOURCES.values() for text, _, _ in texts(source)]
    named = {word for text in spelt for word in re.findall(r"manip-learn ([a-z]+(?:-[a-z]+)*)", text)}
    assert named and named <= {*COMMANDS}
    lines = [found for text in spelt for found in COMMAND_LINE.findall(text)]
    assert {flag for _, rest in lines for flag in FLAG.findall(rest)}
    assert all(set(FLAG.findall(rest)) <= flags_of(program, [command]) for command, rest in lines)


def test_commands_share_their_options():
    """One set of reading options and one of the robot's, for all commands that read recordings or load robots."""
    sets = {c: flags_of(program, [c]) for c in COMMANDS}
    robot = {"--lock", "--package-dir", "--object", "--xacro", "--xacro-arg"}
    reading = {flag for flag in sets["export"] if flag.startswith("--")} - robot - {"--out", "--to", "--at"}
    assert {"--rename", "--columns", "--degrees", "--episodes"} <= reading
    for command in LOADERS:
        assert robot <= sets[command], command
    for command in READERS:
        assert reading <= sets[command], command
    assert all("--json" in sets[c] for c in COMMANDS)
