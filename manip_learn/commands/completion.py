"""What the shell offers behind a command: names of robots, frames of the robot that was named, constraint files.

Completions never fail: what cannot be found out is not offered.
"""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import typer

DESCRIPTIONS = (".urdf", ".xml", ".xacro", ".mjcf")
LOOKED_AT = 200  # files of a folder
HEAD = 400  # bytes of a file


def robot_completions(incomplete: str) -> list[str]:
    """Names of robots, and robot descriptions in the folder at hand."""
    from manip_learn.robot.description.catalogue import robot_names

    names = [name for name in robot_names() if name.startswith(incomplete)]
    return names + [p for p in _paths(incomplete) if p.endswith("/") or p.endswith(DESCRIPTIONS)]


def frame_completions(context: typer.Context, incomplete: str) -> list[str]:
    """Frames of the robot that was named before: the likely tips first, then all others."""
    from manip_learn.errors import ManipLearnError
    from manip_learn.robot import load_robot
    from manip_learn.robot.tips import likely_tips

    try:
        robot = load_robot(str(context.params.get("robot") or _typed_robot()))
    except ManipLearnError:
        return []
    frames = dict.fromkeys([*likely_tips(robot), *robot.frame_names])
    return [name for name in frames if name.startswith(incomplete)]


def constraint_completions(incomplete: str) -> list[str]:
    """Constraint files in the folder at hand, and folders."""
    return [p for p in _paths(incomplete) if p.endswith("/") or _is_constraint(Path(p))]


def _typed_robot() -> str:
    """The robot on the unfinished line: the parser gives up at an option that still lacks its value."""
    line = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS") or ""
    try:
        words = shlex.split(line)
    except ValueError:  # an open quote
        words = line.split()
    return next((word for word in words[2:] if not word.startswith("-")), "")


def _is_constraint(path: Path) -> bool:
    if path.suffix != ".json":
        return False
    try:
        with path.open("rb") as file:
            return b"manip_learn.constraint" in file.read(HEAD)
    except OSError:
        return False


def _paths(incomplete: str) -> list[str]:
    folder, _, start = incomplete.rpartition("/")
    place = Path(folder or ("/" if incomplete.startswith("/") else "."))
    prefix = f"{folder}/" if incomplete.startswith("/") or folder else ""
    try:
        found = sorted(p for p in place.iterdir() if p.name.startswith(start) and (start or not p.name.startswith(".")))
    except OSError:
        return []
    return [f"{prefix}{p.name}{'/' if p.is_dir() else ''}" for p in found[:LOOKED_AT]]


def print_version(asked: bool) -> None:
    """Print the version and leave, if it was asked for."""
    if asked:
        from importlib.metadata import version

        typer.echo(f"manip-learn {version('manip-learn')}")
        raise typer.Exit
