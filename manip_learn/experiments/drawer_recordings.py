"""The project's physics recordings of a drawer, turned so that the drawer opens along x or along y."""

from __future__ import annotations

import importlib.resources
from functools import cache
from pathlib import Path

import numpy as np

from manip_learn.errors import RecordingError
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.load_demonstrations import load_demonstrations
from manip_learn.recordings.preprocessing import subsample
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.velocities import with_velocities
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot

FRAME = "right_gripper_tip"
KIND, HARD = "sawyer_drawer", "sawyer_drawer_hard"
DRAWER_DIRECTION = np.deg2rad(25.0)  # of the recordings, about the vertical, from x


@cache
def sawyer_arm() -> Robot:
    """The shipped Sawyer-like arm."""
    return load_robot("sawyer")


def turned_recordings(along_x: bool, points: int | None, folder: str = KIND) -> Demonstrations:
    """All demonstrations, as from an arm whose base is turned.

    The first joint turns about the vertical through the base: turning the base is an offset of that joint, exactly.

    Args:
        along_x: The drawer opens along x; else along y.
        points: So many samples of each demonstration; None for all.
        folder: `KIND`: grip within a micrometre, noise of 1e-4 rad, 100 Hz, velocities derived from the positions.
            `HARD`: 2 mm of play in the grip, stick and slip, 1e-3 rad, 20 Hz, velocities as recorded, 60 ms old.
    """
    offset = -DRAWER_DIRECTION + (0.0 if along_x else np.pi / 2)
    shift = np.eye(7)[sawyer_arm().joint_names.index("right_j0")] * offset
    out = []
    for t in _recordings(folder):
        turned = Trajectory(t.time, t.q + shift, t.u, t.joint_names, t.name)
        out.append(turned if points is None else subsample(turned, points))
    return Demonstrations(out)


@cache
def _recordings(name: str) -> Demonstrations:
    files = sorted(recordings_folder(name).glob("*.csv"))
    return with_velocities(load_demonstrations(files, sawyer_arm()), sawyer_arm())


def recordings_folder(name: str) -> Path:
    """A folder of shipped recordings, of the installed package or of the repository.

    Raises:
        RecordingError: It is in neither.
    """
    installed = Path(str(importlib.resources.files("manip_learn"))) / "_recordings"
    here = Path(__file__).resolve().parents[2] / "examples" / "data"
    for folder in (installed / name, here / name):
        if folder.is_dir():
            return folder
    raise RecordingError(
        f"the shipped recordings are missing: neither {installed} nor {here} holds {name}; install again",
        code="missing",
    )
