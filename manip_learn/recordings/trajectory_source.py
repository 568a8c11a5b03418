"""Motions in memory, and trajectories that need not fit into it: read again and again, part by part."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import cast, final

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


# a part of a list holds about this many samples: a task for a worker, and what is in memory at a time
PART = 65_536
# called with what is being done and the share of it that is done, between 0 and 1
Progress = Callable[[str, float], None]


class TrajectorySource(ABC):
    """Trajectories in parts, always the same ones in the same order; each pass of the learner reads each part once.

    A child that is read by other processes must be picklable. `manip_learn.recordings.RecordingSource` reads files.
    """

    @property
    @abstractmethod
    def n_parts(self) -> int:
        """Number of parts; it decides in which order sums are taken, so it must not depend on the machine."""

    @abstractmethod
    def part(self, index: int, notes: list[str] | None = None) -> Iterable[Trajectory]:
        """The trajectories of a part; sentences for the report are added to `notes`."""

    def alone(self, index: int) -> TrajectorySource:
        """A source of this part only, for another process: no more than it needs."""
        return OnePart(self, index)


@final
class OnePart(TrajectorySource):
    """One part of another source."""

    def __init__(self, whole: TrajectorySource, index: int):
        self._whole = whole
        self._index = index

    @property
    def n_parts(self) -> int:
        """One."""
        return 1

    def part(self, index: int, notes: list[str] | None = None) -> Iterable[Trajectory]:
        """The trajectories of the part."""
        return self._whole.part(self._index, notes)


@final
class ListedTrajectories(TrajectorySource):
    """Trajectories in memory.

    Args:
        trajectories: All of them.
        notes: Sentences about them, for the report.
    """

    def __init__(self, trajectories: Sequence[Trajectory], notes: Sequence[str] = ()):
        self._trajectories = tuple(trajectories)
        self._notes = tuple(notes)
        self._starts = part_starts([len(t) for t in self._trajectories])

    @property
    def n_parts(self) -> int:
        """Runs of trajectories with at least `PART` samples."""
        return len(self._starts) - 1

    def part(self, index: int, notes: list[str] | None = None) -> Iterable[Trajectory]:
        """The trajectories of a run."""
        if notes is not None and index == 0:
            notes += self._notes
        return self._trajectories[self._starts[index] : self._starts[index + 1]]

    def alone(self, index: int) -> TrajectorySource:
        """The trajectories of one run, without the others."""
        notes: list[str] = []
        return ListedTrajectories(tuple(self.part(index, notes)), tuple(notes))


@final
class IteratedTrajectories(TrajectorySource):
    """An object that yields trajectories each time it is iterated over; never more than a few are in memory.

    Args:
        trajectories: The object; not an iterator, which can be read only once.

    Raises:
        RecordingError: An iterator.
    """

    def __init__(self, trajectories: Iterable[Trajectory]):
        if isinstance(trajectories, Iterator):
            raise RecordingError(
                "these demonstrations can be read only once, and learning reads them several times: give a list, or an "
                "object whose __iter__ starts anew each time",
                code="read-once",
            )
        self._trajectories = trajectories

    @property
    def n_parts(self) -> int:
        """One: where it could be cut is not known."""
        return 1

    def part(self, index: int, notes: list[str] | None = None) -> Iterable[Trajectory]:
        """All trajectories, once more."""
        if notes is not None and isinstance(self._trajectories, Demonstrations):
            notes += self._trajectories.notes
        return self._trajectories


def part_starts(lengths: Sequence[int]) -> list[int]:
    """First trajectory of each part, and the number of trajectories at the end."""
    starts, samples = [0], 0
    for i, length in enumerate(lengths):
        if samples >= PART:
            starts.append(i)
            samples = 0
        samples += length
    return [*starts, len(lengths)]


def source_of(demonstrations: TrajectorySource | Motion | Iterable[Motion]) -> TrajectorySource:
    """The demonstrations as a source: lists by runs, other objects as one stream; an iterator is read into a list.

    Raises:
        RecordingError: Not trajectories, or none.
    """
    if isinstance(demonstrations, TrajectorySource):
        return demonstrations
    held = demonstrations_of(demonstrations)
    if held is not None:
        return ListedTrajectories(held.trajectories, held.notes)
    if isinstance(demonstrations, Iterable):
        return IteratedTrajectories(cast("Iterable[Trajectory]", demonstrations))
    raise RecordingError(
        f"demonstrations must be trajectories or a source of them, got {type(demonstrations).__name__}", code="type"
    )
