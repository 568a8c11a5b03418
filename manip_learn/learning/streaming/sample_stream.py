"""The trajectories of a source as samples, with the features' joints and with velocities; what `partial_fit` keeps."""

from __future__ import annotations

import dataclasses
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, islice
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import RecordingError
from manip_learn.learning.samples import check_joints, stacked
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.preprocessing import evenly
from manip_learn.recordings.readers.read_request import refuse_unmatched
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.trajectory_source import TrajectorySource, part_starts
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


@final
@dataclass(frozen=True)
class FilePlace:
    """Where a trajectory lies in the file: time, q, u, one after the other."""

    offset: int
    n: int
    m: int
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
        self._in_memory = in_memory
        self._file = tempfile.SpooledTemporaryFile(in_memory, prefix="manip_learn_")
        weakref.finalize(self, self._file.close)
        self._held: list[FilePlace] = []
        self._notes: list[str] = []

    @property
    def _starts(self) -> list[int]:
        return part_starts([place.n for place in self._held])

    @property
    def n_parts(self) -> int:
        """As for a list."""
        return len(self._starts) - 1

    @property
    def bytes_in_memory(self) -> int:
        """Of the arrays that are not in the file."""
        size = self._file.seek(0, 2)
        return size if size <= self._in_memory else 0

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
                    place = FilePlace(self._file.seek(0, 2), len(t), t.q.shape[1], t.joint_names, t.name)
                    for array in (t.time, t.q, t.u):
                        self._file.write(np.ascontiguousarray(array, dtype=np.float64).tobytes())
                    self._held.append(place)
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
            columns = 1 + place.m + len(place.joint_names)
            values = np.frombuffer(self._file.read(8 * place.n * columns), dtype=np.float64)
            time, q, u = np.split(values, [place.n, place.n * (1 + place.m)])
            yield Trajectory(time, q.reshape(place.n, place.m), u.reshape(place.n, -1), place.joint_names, place.name)
