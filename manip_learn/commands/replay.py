"""`manip-learn replay`: rollout files -> one HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from manip_learn.commands.robot_loading import load_for_joints, robot_of_constraint
from manip_learn.constraint.constraint import Constraint
from manip_learn.control.rollout import Rollout
from manip_learn.errors import RecordingError
from manip_learn.playback import ReplayResult
from manip_learn.playback import replay as write_replay
from manip_learn.playback.phase_bands import phases_from_json
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.load_demonstrations import ReadOptions
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot import Robot, load_robot


def replay(
    robot_name: str,
    files: list[str],
    *,
    html: Path | None = None,
    open_browser: bool = False,
    tip: str | None = None,
    locked: list[str] | None = None,
    package_dirs: list[str] | None = None,
    objects: list[str] | None = None,
    options: ReadOptions | None = None,
    constraint_file: Path | None = None,
) -> ReplayResult:
    """Write a replay of rollouts (NPZ of `control`) or of recordings.

    With a constraint file, the phases and the mechanism that were learnt with it are shown, and the joints are locked
    that were locked then.

    Raises:
        RecordingError: No files, files that are neither rollouts nor recordings, or phases of other recordings.
        ConstraintMismatchError: A constraint file of another robot, or none at all.
        ManipLearnError: Anything else that is wrong with the robot or the output.
    """
    dirs = package_dirs or []
    named: dict[str, Rollout | Trajectory] = {}
    robot: Robot | None = None
    learnt: dict[str, Any] = {}
    if constraint_file is not None:
        robot = robot_of_constraint(robot_name, str(constraint_file), dirs, objects)
        constraint = Constraint.load(constraint_file, robot)
        learnt = constraint.provenance
        tip = tip or getattr(constraint.features, "frame", None)
    for file in files:
        if _is_rollout(Path(file)):
            rollout = Rollout.load(file)
            robot = robot or load_for_joints(robot_name, rollout.joint_names, locked or (), dirs, objects or ())
            named[_unique(Path(file).stem, named)] = rollout
        else:
            robot = robot or load_robot(robot_name, dirs, locked or (), objects=objects or ())
            for trajectory in load_demonstrations(file, robot, **(options or {})):
                named[_unique(trajectory.name, named)] = trajectory
    if robot is None or not named:
        raise RecordingError("name at least one rollout file; `manip-learn control ... --out rollout.npz` writes one")
    return write_replay(
        robot,
        named,
        html or Path("replay.html"),
        tip=tip,
        open_browser=open_browser,
        phases=phases_from_json(learnt.get("phases") or []),
        mechanism=learnt.get("mechanism"),
    )


def _is_rollout(path: Path) -> bool:
    if not path.is_file():
        if path.exists():
            return False
        raise RecordingError(f"rollout file {path} does not exist", code="missing", path=path)
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as content:
            return "format" in content
    except (OSError, ValueError, EOFError, AttributeError):
        return False


def _unique(name: str, taken: dict[str, Rollout | Trajectory]) -> str:
    candidate, n = name, 2
    while candidate in taken:
        candidate, n = f"{name} ({n})", n + 1
    return candidate
