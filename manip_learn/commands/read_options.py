"""Options of the command line that say how recordings are read: one set, shared by all commands that read them."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from manip_learn.commands.robot_options import pair

# the keywords of `load_demonstrations`; their own type is not imported here, so that `--help` stays quick
ReadOptions = Any


def read_options(
    degrees: Annotated[bool, typer.Option("--degrees", help="The recordings are in degrees.")] = False,
    units: Annotated[str | None, typer.Option(help="Of the recorded angles: radians, degrees or normalised.")] = None,
    time_unit: Annotated[str | None, typer.Option(help="Of the time stamps: s, ms, us or ns.")] = None,
    ignore_column: Annotated[list[str] | None, typer.Option(help="Column to ignore; repeatable.")] = None,
    rename: Annotated[list[str] | None, typer.Option(help="NAME_IN_FILE=NAME_IN_ROBOT of a joint.")] = None,
    columns: Annotated[
        list[str] | None,
        typer.Option(help="Pattern of the columns, 'position.{joint}' or 'q[{index}]'; given twice: velocities."),
    ] = None,
    joint_names: Annotated[str | None, typer.Option(help="Column names, in order, for files without names.")] = None,
    topic: Annotated[list[str] | None, typer.Option(help="Topic of a bag; default: all that hold joints.")] = None,
    rate: Annotated[float | None, typer.Option(help="Samples per second, for files without time stamps.")] = None,
    outside_limits: Annotated[str | None, typer.Option(help="Samples far outside the limits: refuse or note.")] = None,
    last_line: Annotated[
        str | None, typer.Option(help="A table's last line without a line end (cut off?): drop or keep.")
    ] = None,
    episodes: Annotated[
        str | None, typer.Option(help="Which to read, from 0, e.g. 0:50,60,75: LeRobot episodes, or files in order.")
    ] = None,
    feature: Annotated[str | None, typer.Option(help="LeRobot feature that holds the joint positions.")] = None,
    task: Annotated[str | None, typer.Option(help="Read only the LeRobot episodes that show this task.")] = None,
) -> dict[str, Any]:
    """Keywords of `load_demonstrations`; what was not given is left out. The reader checks the values.

    Raises:
        ManipLearnError: A renaming that is not FILE_NAME=ROBOT_NAME.
    """
    pairs = [pair("--rename", "NAME_IN_FILE=NAME_IN_ROBOT", text, unnamed=True) for text in rename or ()]
    given: dict[str, Any] = {
        "degrees": degrees or None,
        "units": units,
        "time_unit": time_unit,
        "ignore_columns": ignore_column,
        "rename": dict(pairs) or None,
        "columns": columns,
        "joint_names": joint_names.replace(",", " ").split() if joint_names else None,
        "topics": topic,
        "rate": rate,
        "outside_limits": outside_limits,
        "last_line": last_line,
        "episodes": episodes,
        "task": task,
        "feature": feature,
    }
    return {key: value for key, value in given.items() if value is not None and value != []}
