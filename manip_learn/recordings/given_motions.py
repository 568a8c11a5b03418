"""Motions as a caller holds them in memory: trajectories, or bare arrays."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.errors import RecordingError
from manip_learn.recordings.data_frame import DataFrame, data_frames_in
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.load_demonstrations import load_demonstrations
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.validation.validate import validate
from manip_learn.robot.robot import Robot

# times (T,) [s], positions (T, n) [rad or m], and velocities (T, nv) where they are known
Arrays = tuple[ArrayLike, ArrayLike] | tuple[ArrayLike, ArrayLike, ArrayLike]
Motion = Trajectory | Arrays | DataFrame


def demonstrations_of(given: object, robot: Robot | None = None) -> Demonstrations | None:
    """Demonstrations of what is held in memory; None for a stream, which is read anew in each pass.

    Args:
        given: `Demonstrations`; a `Trajectory`, or arrays `(time, q)` or `(time, q, u)` with shapes (T,), (T, n) and
            (T, nv) [s, rad or m, and those per second]; or a sequence or iterator of these; or data frames of pandas
            with the columns of a CSV file, if there is a robot.
        robot: Whose joints the columns of arrays are, in its order: the arrays are then checked like a file.

    Raises:
        RecordingError: Arrays or trajectories that do not fit, or that a file would be refused for; postures
            without time.
    """
    if isinstance(given, Demonstrations):
        return given
    if isinstance(given, Trajectory) or _is_motion(given):
        given = [given]
    if robot is not None and (frames := data_frames_in(given)):
        return load_demonstrations(frames, robot)
    if isinstance(given, np.ndarray):
        raise RecordingError(
            f"an array of shape {given.shape} alone is no motion, for its times are not known: give (time, q), or "
            "(time, q, u) with velocities, or a list of such pairs",
            code="type",
        )
    if isinstance(given, str | os.PathLike):
        raise RecordingError(
            f"{os.fspath(given)!r} is the name of a file: load_demonstrations({os.fspath(given)!r}, robot) reads it",
            code="type",
        )
    if not isinstance(given, Sequence | Iterator):
        return None
    trajectories: list[Trajectory] = []
    notes: list[str] = []
    for number, entry in enumerate(given, start=1):
        if isinstance(entry, Trajectory):
            trajectories.append(entry)
            continue
        checked = _checked(_bare(entry, number), robot)
        trajectories += checked.trajectories
        notes += [f"{checked[0].name}: {note}" for note in checked.notes]
    return Demonstrations(trajectories, notes)


def _is_motion(given: object) -> bool:
    """True for the arrays of one motion: it begins with times, a list of motions begins with a motion."""
    if not isinstance(given, list | tuple) or len(given) not in (2, 3):
        return False
    times = given[0]
    return getattr(times, "ndim", None) == 1 or (isinstance(times, list) and all(np.isscalar(t) for t in times))


def _bare(entry: object, number: int) -> Trajectory:
    """The arrays of one motion, without names."""
    if isinstance(entry, list | tuple) and len(entry) in (2, 3):
        time, q, *u = entry
        return Trajectory(time, q, u[0] if u else None, name=f"motion {number}")
    raise RecordingError(
        f"motion {number} must be a Trajectory, or arrays (time, q) or (time, q, u), got {type(entry).__name__}",
        code="type",
    )


def _checked(motion: Trajectory, robot: Robot | None) -> Demonstrations:
    """The motion in the robot's joints, checked like a file; as it is without a robot, or as configurations (nq)."""
    if robot is None or (motion.q.shape[1] == robot.nq != robot.nv):
        return Demonstrations([motion])
    names = robot.joint_names
    if motion.q.shape[1] != robot.nv:
        raise RecordingError(
            f"{motion.name}: q has {motion.q.shape[1]} columns, robot {robot.name!r} has {robot.nv} joints "
            f"({', '.join(names)}): one column per joint is needed, in this order",
            code="shape",
        )
    recording = Recording(Path(motion.name), motion.name, motion.time, names, motion.q, names, motion.u)
    return validate(recording, ReadRequest(robot))
