"""How recordings are to be read, from the options of the command line."""

from __future__ import annotations

from typing import Any

from manip_learn.errors import ManipLearnError
from manip_learn.recordings.load_demonstrations import ReadOptions


def read_options(
    *,
    degrees: bool = False,
    units: str | None = None,
    time_unit: str | None = None,
    ignore_column: list[str] | None = None,
    rename: list[str] | None = None,
    joint_names: str | None = None,
    topic: list[str] | None = None,
    rate: float | None = None,
    outside_limits: str | None = None,
) -> ReadOptions:
    """Keywords of `load_demonstrations`; what was not given is left out. The reader checks the values.

    Raises:
        ManipLearnError: A renaming that is not FILE_NAME=ROBOT_NAME.
    """
    given: dict[str, Any] = {
        "degrees": degrees or None,
        "units": units,
        "time_unit": time_unit,
        "ignore_columns": ignore_column,
        "rename": dict(_pair(r) for r in rename) if rename else None,
        "joint_names": joint_names.replace(",", " ").split() if joint_names else None,
        "topics": topic,
        "rate": rate,
        "outside_limits": outside_limits,
    }
    options: Any = {key: value for key, value in given.items() if value}
    return options


def _pair(text: str) -> tuple[str, str]:
    file_name, _, robot_name = text.partition("=")
    if not file_name or not robot_name:
        raise ManipLearnError(f"--rename must be NAME_IN_FILE=NAME_IN_ROBOT, got {text!r}")
    return file_name, robot_name
