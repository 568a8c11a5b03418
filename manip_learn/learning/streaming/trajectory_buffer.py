"""Trajectories kept from one `partial_fit` to the next: in memory, beyond a limit in a temporary file."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Iterable
from dataclasses import dataclass
from typing import BinaryIO, final

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import RecordingError
from manip_learn.learning.streaming.sample_stream import open_stream
from manip_learn.recordings.readers.option_uses import refuse_unmatched
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.trajectory_source import TrajectorySource, part_starts
from manip_learn.recordings.velocities import VelocityMethod

IN_MEMORY = 256_000_000  # bytes


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
        in_memory: Number of bytes kept in memory; later trajectories go to a temporary file, which vanishes with this
            object.
    """

    def __init__(self, in_memory: int = IN_MEMORY):
        self._in_memory = in_memory
        self._held: list[Trajectory | FilePlace] = []
        self._lengths: list[int] = []
        self._notes: list[str] = []
        self._bytes = 0
        self._file: BinaryIO | None = None

    @property
    def n_parts(self) -> int:
        """As for a list."""
        return len(part_starts(self._lengths)) - 1

    @property
    def bytes_in_memory(self) -> int:
        """Of the arrays that are not in the file."""
        return self._bytes

    def add(self, source: TrajectorySource, features: list[FeatureMap], velocities: VelocityMethod) -> None:
        """Keep the trajectories of a source, with velocities; all of them, or none if one cannot be used.

        Raises:
            RecordingError: One of them cannot be used.
        """
        stream = open_stream(source, features, velocities)
        before, notes = (len(self._held), self._bytes), []
        try:
            for part in range(source.n_parts):
                for trajectory in stream.trajectories(part, notes):
                    self._keep(trajectory)
            kept = refuse_unmatched(notes, source.n_parts)
        except RecordingError:
            del self._held[before[0] :], self._lengths[before[0] :]
            self._bytes = before[1]
            raise
        self._notes += kept

    def part(self, index: int, notes: list[str] | None = None) -> Iterable[Trajectory]:
        """The trajectories of a part."""
        if notes is not None and index == 0:
            notes += self._notes
        starts = part_starts(self._lengths)
        for held in self._held[starts[index] : starts[index + 1]]:
            yield held if isinstance(held, Trajectory) else self._loaded(held)

    def _keep(self, trajectory: Trajectory) -> None:
        arrays = [trajectory.time, trajectory.q, trajectory.u]
        size = sum(a.nbytes for a in arrays if a is not None)
        self._lengths.append(len(trajectory))
        if self._bytes + size <= self._in_memory:
            self._bytes += size
            self._held.append(trajectory)
            return
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="manip_learn_")
            weakref.finalize(self, self._file.close)
        offset = self._file.seek(0, 2)
        for array in arrays:
            self._file.write(array.tobytes())  # type: ignore[union-attr]
        place = FilePlace(offset, len(trajectory), trajectory.q.shape[1], trajectory.joint_names, trajectory.name)
        self._held.append(place)

    def _loaded(self, place: FilePlace) -> Trajectory:
        columns = 1 + place.m + len(place.joint_names)
        self._file.seek(place.offset)  # type: ignore[union-attr]
        values = np.frombuffer(self._file.read(8 * place.n * columns), dtype=np.float64)  # type: ignore[union-attr]
        time, q, u = np.split(values, [place.n, place.n * (1 + place.m)])
        return Trajectory(time, q.reshape(place.n, place.m), u.reshape(place.n, -1), place.joint_names, place.name)
