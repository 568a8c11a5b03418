"""The trajectories of a source as samples, with the features' joints and with velocities; what `partial_fit` keeps; and
passes over all samples, in an order of sums that depends on the data alone, whoever makes them.
"""

from __future__ import annotations

import dataclasses
import tempfile
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby, islice
from typing import Any, NamedTuple, TypeVar, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import RecordingError
from manip_learn.learning.samples import check_joints, stacked
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.preprocessing import evenly
from manip_learn.recordings.readers.read_request import refuse_unmatched
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.trajectory_source import Progress, TrajectorySource, part_starts
from manip_learn.recordings.velocities import VelocityMethod, derive_together
from manip_learn.robot.robot import Robot

CHUNK = 4096  # samples that are looked at together
DERIVED = "velocities were derived from the positions"
TOGETHER = 16  # trajectories whose velocities are derived at a time
MOST_RECORDINGS = 64  # that stand for all: what holds in most of them holds in most of the others
IN_MEMORY = 256_000_000  # bytes that `partial_fit` keeps in memory


@final
@dataclass(frozen=True, eq=False)
class Chunk:
    """Consecutive samples, as recorded.

    Attributes:
        q: Postures, shape (n, m).
        u: Velocities, shape (n, nv).
        trajectory: Trajectory of each sample, counted from 0 in its part, never decreasing, shape (n,).
        part: Which part of the source it belongs to.
        first: Number of samples before it in the part.
    """

    q: Float[np.ndarray, "n m"]
    u: Float[np.ndarray, "n nv"]
    trajectory: Int[np.ndarray, " n"]
    part: int = 0
    first: int = 0

    def __len__(self) -> int:
        return len(self.u)


def chunks(trajectories: Iterable[Trajectory], part: int = 0) -> Iterator[Chunk]:
    """The samples of trajectories with velocities, CHUNK at a time, however long each trajectory is.

    Raises:
        RecordingError: Postures of different sizes.
    """
    held: list[tuple[np.ndarray, np.ndarray, int]] = []
    first = count = 0
    for number, trajectory in enumerate(trajectories):
        start = 0
        while start < len(trajectory):
            stop = min(len(trajectory), start + CHUNK - count)
            held.append((trajectory.q[start:stop], trajectory.u[start:stop], number))  # type: ignore[index]
            count += stop - start
            start = stop
            if count == CHUNK:
                yield Chunk(*stacked(held), part, first)
                held, count, first = [], 0, first + CHUNK
    if held:
        yield Chunk(*stacked(held), part, first)


@final
@dataclass(frozen=True)
class SampleStream:
    """How a source is read; picklable.

    Attributes:
        source: The trajectories.
        joint_names: Which each must have, in this order.
        robot: Derives missing velocities; None if there is none.
        velocities: How.
        left_out: Trajectories that are passed over, by their part and their number in it.
    """

    source: TrajectorySource
    joint_names: tuple[str, ...]
    robot: Robot | None
    velocities: VelocityMethod
    left_out: frozenset[tuple[int, int]] = frozenset()

    def alone(self, part: int) -> SampleStream:
        """How one part is read, without the others: what a worker is sent."""
        own = frozenset((0, number) for other, number in self.left_out if other == part)
        return dataclasses.replace(self, source=self.source.alone(part), left_out=own)

    def trajectories(self, part: int, notes: list[str]) -> Iterator[Trajectory]:
        """The trajectories of a part, with velocities.

        Raises:
            RecordingError: Joints of another robot, or velocities that can neither be found nor derived.
        """
        derived = False
        for has_velocities, run in groupby(self._checked(part, notes), lambda t: t.u is not None):
            if has_velocities or self.robot is None:
                yield from run
                continue
            derived = True
            while some := list(islice(run, TOGETHER)):
                yield from derive_together(some, self.robot, self.velocities)
        if derived:
            notes.append(DERIVED)

    def _checked(self, part: int, notes: list[str]) -> Iterator[Trajectory]:
        """The trajectories of a part as they were recorded.

        Raises:
            RecordingError: As for `trajectories`.
        """
        for number, trajectory in enumerate(self.source.part(part, notes)):
            if (part, number) in self.left_out:
                continue
            check_joints(trajectory.joint_names, self.robot)
            if trajectory.joint_names != self.joint_names:
                raise RecordingError(
                    f"{trajectory.name} has the joints {trajectory.joint_names}, others have {self.joint_names}: all "
                    "trajectories must name the same joints in the same order",
                    code="joint-names",
                )
            if trajectory.u is None and self.robot is None:
                raise RecordingError(
                    f"{trajectory.name} has no velocities: give features of a robot to derive them with",
                    code="no-velocities",
                )
            yield trajectory


def open_stream(source: TrajectorySource, features: Sequence[FeatureMap], velocities: VelocityMethod) -> SampleStream:
    """The samples of a source, for some features.

    Raises:
        RecordingError: The source is empty or belongs to another robot.
    """
    robot = getattr(features[0], "robot", None)
    for part in range(source.n_parts):
        for first in source.part(part):
            names = first.joint_names if robot is None else tuple(robot.joint_names)
            if len(names) != features[0].nv:
                raise RecordingError(
                    f"{first.name} has {len(names)} joint velocities, the features act on {features[0].nv}",
                    code="shape",
                )
            return SampleStream(source, names, robot, velocities)
    raise RecordingError("there are no demonstrations: give at least one trajectory", code="empty")


def representative(stream: SampleStream, most: int) -> tuple[Demonstrations, tuple[tuple[int, int], ...], bool]:
    """Whole recordings that stand for all, evenly chosen; the part of each and its number in it; whether they are all.

    Args:
        stream: The recordings.
        most: Number of samples that they may have together.

    Raises:
        RecordingError: As for `SampleStream.trajectories`; or a setting that no part has a use for.
    """
    parts, notes = evenly(stream.source.n_parts, MOST_RECORDINGS).tolist(), list[str]()
    taken, places, complete = list[Trajectory](), list[tuple[int, int]](), len(parts) == stream.source.n_parts
    for part in parts:
        made = list(stream.trajectories(part, notes))
        longest = max((len(t) for t in made), default=1)
        each = max(1, min(MOST_RECORDINGS, most // longest) // len(parts))
        fits = sum(len(t) for t in [*taken, *made]) <= most and complete
        chosen = range(len(made)) if fits else evenly(len(made), each).tolist()
        complete &= len(chosen) == len(made)
        taken += [made[i] for i in chosen]
        places += [(part, i) for i in chosen]
    kept = refuse_unmatched(notes, len(parts)) if len(parts) == stream.source.n_parts else notes
    return Demonstrations(taken, tuple(dict.fromkeys(kept))), tuple(places), complete


class FilePlace(NamedTuple):
    """Where time, q and u of a trajectory begin in the file."""

    offset: int
    n_samples: int
    joint_names: tuple[str, ...]
    name: str


@final
class TrajectoryBuffer(TrajectorySource):
    """Grows by `add`; read like any other source, in the same parts as a list of the same trajectories.

    Args:
        in_memory: Number of bytes kept in memory; beyond it all of them go to a temporary file, which vanishes with
            this object.
    """

    def __init__(self, in_memory: int = IN_MEMORY):
        self._file = tempfile.SpooledTemporaryFile(in_memory, prefix="manip_learn_")
        weakref.finalize(self, self._file.close)
        self._held: list[FilePlace] = []
        self._notes: list[str] = []

    @property
    def _starts(self) -> list[int]:
        return part_starts([place.n_samples for place in self._held])

    @property
    def n_parts(self) -> int:
        """Number of parts, as a list of the same trajectories has them."""
        return len(self._starts) - 1

    def add(self, source: TrajectorySource, features: list[FeatureMap], velocities: VelocityMethod) -> None:
        """Keep the trajectories of a source, with velocities; all of them, or none if one cannot be used.

        Raises:
            RecordingError: One of them cannot be used.
        """
        stream = open_stream(source, features, velocities)
        count, size, notes = len(self._held), self._file.seek(0, 2), list[str]()
        try:
            for part in range(source.n_parts):
                for t in stream.trajectories(part, notes):
                    self._held.append(FilePlace(self._file.seek(0, 2), len(t), t.joint_names, t.name))
                    for array in (t.time, t.q, t.u):
                        np.save(self._file, np.asarray(array), allow_pickle=False)
            self._notes += refuse_unmatched(notes, source.n_parts)
        except RecordingError:
            del self._held[count:]
            self._file.truncate(size)
            raise

    def part(self, index: int, notes: list[str] | None = None) -> Iterable[Trajectory]:
        """The trajectories of a part."""
        if notes is not None and index == 0:
            notes += self._notes
        starts = self._starts
        for place in self._held[starts[index] : starts[index + 1]]:
            self._file.seek(place.offset)
            time, q, u = (np.load(self._file) for _ in range(3))
            yield Trajectory(time, q, u, place.joint_names, place.name)


# of postures and velocities that are kept from one pass to the next: a million samples of a 7-joint arm
KEPT_BYTES = 128_000_000
Total = TypeVar("Total")


class Accumulator(ABC):
    """What a pass gathers: the total of a chunk, and how totals are merged. Picklable."""

    @abstractmethod
    def of(self, chunk: Chunk) -> Any:
        """The total of one chunk."""

    @abstractmethod
    def merge(self, before: Any, after: Any) -> Any:
        """The total of two consecutive runs of chunks, of the same part or of different ones."""


class Executor(ABC):
    """Makes passes over all samples of a source."""

    @abstractmethod
    def total(self, accumulator: Accumulator, title: str, first_trajectories: dict[int, int] | None = None) -> Any:
        """What a pass gathers over all parts, and the notes of their readers.

        Args:
            accumulator: What the pass gathers.
            title: What is being done, for the progress.
            first_trajectories: Part -> number of trajectories before it; a part that is not named starts at 0.
        """


def accumulate(
    accumulator: Accumulator, samples: Iterable[Chunk], notes: list[str], first_trajectory: int = 0
) -> tuple[Any, tuple[str, ...]] | None:
    """Total and notes of a part; None of a part without samples.

    Args:
        accumulator: What the pass gathers.
        samples: Of the part.
        notes: May fill while the samples are read.
        first_trajectory: Number of trajectories before the part, from which its own are counted on.
    """
    total = None
    for chunk in samples:
        own = accumulator.of(replace(chunk, trajectory=chunk.trajectory + np.int64(first_trajectory)))
        total = own if total is None else accumulator.merge(total, own)
    return None if total is None else (total, tuple(notes))


def merge_parts(accumulator: Accumulator, before: Any, after: Any) -> Any:
    """Total and notes of two runs of parts; a part without samples (None) adds nothing."""
    if before is None or after is None:
        return after if before is None else before
    return accumulator.merge(before[0], after[0]), before[1] + after[1]


def merge_tree(merge: Callable[[Total, Total], Total], parts: Iterable[Total]) -> Total:
    """Total of all parts, merged in pairs, pairs of pairs and so on; only a few totals are in memory at a time.

    The order depends on the number of parts only, so the sum is reproducible to the last bit.
    """
    waiting: list[tuple[int, Total]] = []  # (level, total), levels falling
    for part in parts:
        level = 0
        while waiting and waiting[-1][0] == level:
            part = merge(waiting.pop()[1], part)
            level += 1
        waiting.append((level, part))
    _, total = waiting.pop()
    for _, part in reversed(waiting):
        total = merge(part, total)
    return total


@final
class LocalExecutor(Executor):
    """Part after part in this process: the first ones are kept in memory, the others are read anew in each pass.

    Memory does not grow with the samples beyond KEPT_BYTES; what is kept is what reading again would yield.

    Args:
        stream: The samples.
        progress: Told how far a pass is.
    """

    def __init__(self, stream: SampleStream, progress: Progress | None = None):
        self._stream = stream
        self._progress = progress
        self._kept: dict[int, tuple[list[Chunk], list[str]]] = {}
        self._room = KEPT_BYTES

    def total(self, accumulator: Accumulator, title: str, first_trajectories: dict[int, int] | None = None) -> Any:
        """One pass."""
        first, n = first_trajectories or {}, self._stream.source.n_parts

        def parts() -> Iterator[Any]:
            for part in range(n):
                notes: list[str] = []
                samples, notes = self._kept.get(part) or (self._read(part, notes), notes)
                yield accumulate(accumulator, samples, notes, first.get(part, 0))
                if self._progress is not None:
                    self._progress(title, (part + 1) / n)

        return merge_tree(partial(merge_parts, accumulator), parts())

    def _read(self, part: int, notes: list[str]) -> Iterator[Chunk]:
        """The samples of a part, which is kept as a whole if there is room for it."""
        held: list[Chunk] = []
        for chunk in chunks(self._stream.trajectories(part, notes), part):
            if self._room > 0:
                held.append(chunk)
                self._room -= chunk.q.nbytes + chunk.u.nbytes + chunk.trajectory.nbytes
                if self._room <= 0:
                    held = []
            yield chunk
        if self._room > 0:
            self._kept[part] = held, notes
