"""`manip-learn inspect`: what a robot is made of."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

from manip_learn.commands.robot_options import RobotOptions
from manip_learn.robot.robot_summary import RobotSummary, summarise, with_cross_check


def inspect(
    robot_name: str,
    robot_options: RobotOptions | None = None,
) -> Iterator[RobotSummary]:
    """Load a robot and look at it.

    Yields:
        What is known at once, and the same with the independent check of forward kinematics, which takes longer.

    Raises:
        ManipLearnError: The robot cannot be loaded.
    """
    robot = (robot_options or RobotOptions()).load(robot_name)
    summary = summarise(robot)
    yield summary
    yield with_cross_check(summary, robot)


def summary_dict(summary: RobotSummary) -> dict[str, Any]:
    """The JSON answer; limits that do not exist are null."""
    content = dataclasses.asdict(summary)
    for joint in content["joints"]:
        for key in ("lower", "upper", "velocity"):
            if not math.isfinite(joint[key]):
                joint[key] = None
    content["source"] = None if summary.source is None else str(summary.source)
    content["meshes_found"] = {k: str(v) for k, v in summary.meshes_found.items()}
    for key in ("joints", "frames", "warnings", "tips", "mimics"):
        content[key] = list(content[key])
    return content
