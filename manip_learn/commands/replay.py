"""`manip-learn replay`: rollout files -> one HTML file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from manip_learn.commands.robot_loading import load_for_joints
from manip_learn.control.rollout import Rollout
from manip_learn.errors import RecordingError
from manip_learn.playback import ReplayResult
from manip_learn.playback import replay as write_replay
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot import Robot, load_robot


def replay(
    robot_name: str,
    files: list[str],
    *,
    html: Path | None = None,
    open_browser: bool = False,
    tip: str | None = None,
    package_dirs: list[str] | None = None,
) -> ReplayResult:
    """Write a replay of rollouts (NPZ of `control`) or of recordings.

    Raises:
        RecordingError: No files, or files that are neither rollouts nor recordings.
        ManipLearnError: Anything else that is wrong with the robot or the output.
    """
    dirs = package_dirs or []
    named: dict[str, Rollout | Trajectory] = {}
    robot: Robot | None = None
    for file in files:
        if _is_rollout(Path(file)):
            rollout = Rollout.load(file)
            robot = robot or load_for_joints(robot_name, rollout.joint_names, package_dirs=dirs)
            named[_unique(Path(file).stem, named)] = rollout
        else:
            robot = robot or load_robot(robot_name, dirs)
            for trajectory in load_demonstrations(file, robot):
                named[_unique(trajectory.name, named)] = trajectory
    if robot is None:
        raise RecordingError("name at least one rollout file; `manip-learn control ... --out rollout.npz` writes one")
    return write_replay(robot, named, html or Path("replay.html"), tip=tip, open_browser=open_browser)


def _is_rollout(path: Path) -> bool:
    if not path.is_file():
        if path.exists():
            return False
        raise RecordingError(f"rollout file {path} does not exist", code="missing", path=path)
    try:
        with np.load(path, allow_pickle=False) as content:
            return "format" in content
    except (OSError, ValueError, EOFError, AttributeError):
        return False


def _unique(name: str, taken: dict[str, Rollout | Trajectory]) -> str:
    candidate, n = name, 2
    while candidate in taken:
        candidate, n = f"{name} ({n})", n + 1
    return candidate
