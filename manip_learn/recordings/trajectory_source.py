"""Demonstrations that need not fit into memory: trajectories that can be read again and again, part by part."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import cast, final

from manip_learn.errors import RecordingError
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.given_motions import Motion, demonstrations_of
from manip_learn.recordings.trajectory import Trajectory

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
        return ListedPart(tuple(self.part(index, notes)), tuple(notes))


@final
class ListedPart(TrajectorySource):
    """Trajectories that stay together."""

    def __init__(self, trajectories: tuple[Trajectory, ...], notes: tuple[str, ...]):
        self._trajectories = trajectories
        self._notes = notes

    @property
    def n_parts(self) -> int:
        """One."""
        return 1

    def part(self, index: int, notes: list[str] | None = None) -> Iterable[Trajectory]:
        """All trajectories."""
        if notes is not None:
            notes += self._notes
        return self._trajectories


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
