"""The door for motions: whatever a caller has becomes recordings in memory, or a source of them that is read part by
part, here or elsewhere; files too.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack, cast, final

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.errors import RecordingError
from manip_learn.recordings.data_frame import DataFrame, frames_as_files
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.earned_velocities import Velocities, judged_in_turn
from manip_learn.recordings.format_words import DATASET_HEADER
from manip_learn.recordings.holes import split_at_holes, stalled
from manip_learn.recordings.load_demonstrations import (
    Paths,
    ReadOptions,
    folded_notes,
    open_recordings,
    read_recordings,
    validated,
)
from manip_learn.recordings.readers.lerobot_reader import episode_number, open_dataset, separate_files
from manip_learn.recordings.readers.name_patterns import helpful_renaming
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording
from manip_learn.recordings.readers.recording_files import CSV, LEROBOT, RecordingFile
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Robot

PART_BYTES = 1_000_000  # of files that make a part: small ones share a task, and workers get even shares

# times (T,) [s], positions (T, n) [rad or m], and velocities (T, nv) where they are known
Arrays = tuple[ArrayLike, ArrayLike] | tuple[ArrayLike, ArrayLike, ArrayLike]
_Motion = Trajectory | Arrays | DataFrame
# called with what is being done and the share of it that is done, between 0 and 1
Progress = Callable[[str, float], None]


class TrajectorySource(ABC):
    """Trajectories in parts, always the same ones in the same order; each part is read once.

    A child whose parts are read by the workers of a cluster must be picklable.
    """

    @property
    @abstractmethod
    def n_parts(self) -> int:
        """Number of parts; what is chosen of many samples depends on it, so it must not depend on the machine."""

    @abstractmethod
    def part(self, index: int, notes: list[str] | None = None) -> Iterable[Trajectory]:
        """The trajectories of a part; sentences for the report are added to `notes`."""


@final
class RecordingSource(TrajectorySource):
    """The demonstrations in some files, never all in memory.

    Args:
        paths: As for `load_demonstrations`. Workers on other machines must see the same files under the same names.
        robot: As for `load_demonstrations`.
        **options: See `ReadOptions`.

    Raises:
        RecordingError: No path, one that is missing, a folder without recordings of exactly one format, or episodes
            that do not exist.
    """

    def __init__(self, paths: Paths, robot: Robot, **options: Unpack[ReadOptions]):
        files, self._request, notes = open_recordings(paths, robot, options)
        self._notes = tuple(notes)
        chosen = self._request.chosen
        self._parts = _in_parts([piece for file in files for piece in _pieces(file, chosen)])

    @property
    def n_parts(self) -> int:
        """Runs of files of about `PART_BYTES`; a single large file is one part."""
        return len(self._parts)

    def part(self, index: int, notes: list[str] | None = None) -> Iterator[Trajectory]:
        """The demonstrations in the files of a part, one after the other.

        Raises:
            RecordingError: A recording that cannot be trusted.
            MissingExtraError: The format needs a library that is not installed.
        """
        said = [] if notes is None else notes
        yield from read_recordings(self._parts[index], self._request, said)
        said += self._notes if index == 0 else ()


def _pieces(file: RecordingFile, chosen: frozenset[int] | None) -> list[RecordingFile]:
    """Files that can be read one by one: those of a LeRobot data set, if no episode goes on in the next one.

    Version 2 has one file per episode; those that are not chosen are left out.
    """
    paths = [file.path]  # where an episode goes on in the next file, the whole folder
    if file.format is LEROBOT and file.path.is_dir():
        dataset = open_dataset(file.path)
        numbers = [episode_number(path) for path in dataset.files]
        is_ours = (file.path / DATASET_HEADER).is_file()  # its header speaks for the folder, not for a file in it
        if None not in numbers:
            if chosen is None:
                dataset.refuse_lost("episodes", len(numbers))
            paths = [p for p, n in zip(dataset.files, numbers, strict=True) if chosen is None or n in chosen]
        elif chosen is None and not is_ours:
            runs = separate_files(file.path)
            if len(runs) > 1 and all(len(run) == 1 for run in runs):
                paths = [path for (path,) in runs]
    # for workers too, whose working folder is another
    return [RecordingFile(Path(os.path.abspath(path)), file.format) for path in paths]


def _in_parts(files: list[RecordingFile]) -> list[list[RecordingFile]]:
    parts: list[list[RecordingFile]] = [[]]
    size = 0
    for file in files:
        if parts[-1] and size >= PART_BYTES:
            parts.append([])
            size = 0
        parts[-1].append(file)
        inside = file.path.rglob("*") if file.path.is_dir() else [file.path]
        size += sum(one.stat().st_size for one in inside if one.is_file())
    return parts


Given = TrajectorySource | _Motion | Iterable[_Motion]


@final
@dataclass(frozen=True, eq=False)
class CheckedSource(TrajectorySource):
    """A source, or anything that can be iterated over, whose motions are checked while they are read.

    Attributes:
        given: The source, or an iterable, which is one part.
        robot: Whose joints each motion must have; None for features without a robot.
        nv: Number of velocities of the features.
        velocities: Which recorded ones are kept, see `earned`.
    """

    given: TrajectorySource | Iterable[_Motion]
    robot: Robot | None
    nv: int
    velocities: Velocities = "auto"

    @property
    def n_parts(self) -> int:
        """Number of parts."""
        return self.given.n_parts if isinstance(self.given, TrajectorySource) else 1

    def part(self, index: int, notes: list[str] | None = None) -> Iterator[Trajectory]:
        """The trajectories of a part, with the joints of the features."""
        said: list[str] = [] if notes is None else notes
        found: list[tuple[str, str]] = []
        source, together = self.given, isinstance(self.given, Sequence)
        entries = source.part(index, said) if isinstance(source, TrajectorySource) else source
        motions = (motion for i, entry in enumerate(entries, 1) for motion in self._motions(entry, i, found))
        named = map(self._named, motions)
        yield from judged_in_turn(named, self.robot, self.velocities, found, together=together)
        said += folded_notes(found, self.robot)

    def _named(self, motion: Trajectory) -> Trajectory:
        """A motion with the names of the joints of the features, which must be its own if it has names."""
        if motion.joint_names:
            check_joints(motion.joint_names, self.robot)
            return motion
        names = [f"q{i}" for i in range(self.nv)] if self.robot is None else self.robot.joint_names
        return motion.with_joint_names(tuple(names))

    def _motions(self, entry: Any, number: int, found: list[tuple[str, str]]) -> Iterator[Trajectory]:
        """A motion as it is, or arrays and tables checked like a file; they may fall into several."""
        name, robot = f"motion {number}", self.robot
        if isinstance(entry, Trajectory):
            stalls = stalled(entry.time, entry.q)
            entry = entry.part(np.delete(np.arange(len(entry)), stalls)) if stalls.size else entry
            parts, said = split_at_holes(entry, robot)
            found += [(entry.name, note) for note in said]
            yield from parts
        elif robot is not None and isinstance(entry, DataFrame):
            request = ReadRequest(robot, velocities=self.velocities)
            with frames_as_files([entry], number) as files:
                tables = (table for file in files for table in RecordingFile(file, CSV).recordings(request))
                yield from validated(tables, request, found)
        elif not isinstance(entry, list | tuple) or len(entry) not in (2, 3):
            text = f"{name} must be a Trajectory, or arrays (time, q) or (time, q, u), got {type(entry).__name__}"
            raise RecordingError(text, code="type")
        elif robot is None:
            yield Trajectory(*entry, name=name)
        else:
            try:  # they are checked like those of a file
                stamps = np.asarray(entry[0], dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise RecordingError(f"{name}: time must be numbers: {error}", code="not-a-number") from error
            if stamps.ndim != 1:
                raise RecordingError(f"{name}: time must have 1 dimension, got shape {stamps.shape}", code="shape")
            motion = Trajectory(np.arange(float(len(stamps))), *entry[1:], name=name)
            width, names = motion.q.shape[1], robot.joint_names
            if width == robot.nq != robot.nv:
                yield replace(motion, time=stamps)
                return
            if width != robot.nv:
                text = f"{name}: q has {width} columns, robot {robot.name!r} has {robot.nv} joints ({', '.join(names)})"
                raise RecordingError(f"{text}: one column per joint is needed, in this order", code="shape")
            recording = Recording.of(Path(name), name, stamps, names, motion.q, motion.u, None)
            yield from validated([recording], ReadRequest(robot, velocities=self.velocities), found)


def recordings_given(
    given: Given, robot: Robot | None, nv: int, velocities: Velocities = "auto"
) -> Demonstrations | CheckedSource:
    """What a learner or an audit was given: recordings in memory, or a source of more than are held at a time.

    Args:
        given: `Demonstrations`; a `Trajectory`, or arrays `(time, q)` or `(time, q, u)` with shapes (T,), (T, n) and
            (T, nv) [s, rad or m, and those per second]; a data frame of pandas with the columns of a CSV file, if there
            is a robot; or a list of these: all of them are in memory. A `TrajectorySource`, an iterator or another
            iterable of motions is read once, one motion after the other.
        robot: Whose joints the columns of arrays are, in its order: the arrays are then checked like a file.
        nv: Number of velocities.
        velocities: Which recorded ones are kept, see `earned`.

    Raises:
        RecordingError: Motions that do not fit, or that a file would be refused for; postures without time.
    """
    if isinstance(given, Trajectory | DataFrame) or _is_motion(given):
        given = cast("Sequence[_Motion]", [given])
    wrong = ""
    if isinstance(given, np.ndarray):
        wrong = f"an array of shape {given.shape} alone is no motion, for its times are not known: give (time, q), or "
        wrong += "(time, q, u) with velocities, or a list of such pairs"
    elif isinstance(given, str | os.PathLike):
        file = os.fspath(given)
        wrong = f"{file!r} is the name of a file: load_demonstrations({file!r}, robot) reads it"
    elif not isinstance(given, TrajectorySource | Iterable):
        wrong = f"demonstrations must be trajectories or a source of them, got {type(given).__name__}"
    if wrong:
        raise RecordingError(wrong, code="type")
    source = CheckedSource(cast("TrajectorySource | Iterable[_Motion]", given), robot, nv, velocities)
    if not isinstance(given, Sequence):
        return source
    notes = list(given.notes) if isinstance(given, Demonstrations) else []
    trajectories = list(source.part(0, notes))
    return Demonstrations(trajectories, notes)


def _is_motion(given: object) -> bool:
    """True for the arrays of one motion: it begins with times, a list of motions begins with a motion."""
    if not isinstance(given, list | tuple) or len(given) not in (2, 3):
        return False
    times = given[0]
    return getattr(times, "ndim", None) == 1 or (isinstance(times, list) and all(np.isscalar(t) for t in times))


def check_joints(joint_names: Sequence[str], robot: Robot | None) -> None:
    """Refuse demonstrations of another robot than that of the features.

    Raises:
        RecordingError: The joint names differ, or their order does.
    """
    if robot is not None and tuple(joint_names) != tuple(robot.joint_names):
        ways = helpful_renaming(joint_names, robot.joint_names, robot.joint_names)
        in_order = any([reads.get(n) for n in joint_names] == list(robot.joint_names) for _, reads in ways)
        same = "; if they are the same joints: trajectory.with_joint_names(robot.joint_names)" if in_order else ""
        text = f"the demonstrations have the joints {', '.join(joint_names)}; robot {robot.name!r} has "
        text += f"{', '.join(robot.joint_names)}: load them with load_demonstrations(files, robot), which sorts by name"
        raise RecordingError(text + same, code="joint-names")
