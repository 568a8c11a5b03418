"""Recorded motions of one robot."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import final, overload

from manip_learn.errors import RecordingError
from manip_learn.recordings.trajectory import Trajectory


@final
@dataclass(frozen=True, eq=False)
class Demonstrations(Sequence[Trajectory]):
    """Several trajectories of one robot.

    Attributes:
        trajectories: At least one; all with the same joint names in the same order.
        notes: What the reader noticed or did, in sentences.

    Raises:
        RecordingError: None given, or joint names that differ.
    """

    trajectories: tuple[Trajectory, ...]
    notes: tuple[str, ...] = ()

    def __init__(self, trajectories: Iterable[Trajectory], notes: Iterable[str] = ()):
        if not isinstance(trajectories, Iterable):
            raise RecordingError(
                f"demonstrations must be Trajectory objects, got {type(trajectories).__name__}", code="type"
            )
        object.__setattr__(self, "trajectories", tuple(trajectories))
        object.__setattr__(self, "notes", tuple(notes))
        if not self.trajectories:
            raise RecordingError("no demonstrations: give at least one trajectory", code="empty")
        for t in self.trajectories:
            if not isinstance(t, Trajectory):
                raise RecordingError(f"demonstrations must be Trajectory objects, got {type(t).__name__}", code="type")
        first = self.trajectories[0]
        for t in self.trajectories[1:]:
            if t.joint_names != first.joint_names:
                raise RecordingError(
                    f"{t.name} has the joints {t.joint_names}, {first.name} has {first.joint_names}: all trajectories "
                    "must name the same joints in the same order",
                    code="joint-names",
                )

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the velocity columns."""
        return self.trajectories[0].joint_names

    def with_joint_names(self, joint_names: tuple[str, ...]) -> Demonstrations:
        """The same trajectories with their columns named; see `Trajectory.joint_names`.

        Raises:
            RecordingError: Another number of columns.
        """
        return Demonstrations([t.with_joint_names(joint_names) for t in self.trajectories], self.notes)

    @property
    def n_samples(self) -> int:
        """Number of samples in all trajectories."""
        return sum(len(t) for t in self.trajectories)

    @property
    def has_velocities(self) -> bool:
        """True if every trajectory has u."""
        return all(t.u is not None for t in self.trajectories)

    def __len__(self) -> int:
        return len(self.trajectories)

    @overload
    def __getitem__(self, index: int) -> Trajectory: ...

    @overload
    def __getitem__(self, index: slice) -> Demonstrations: ...

    def __getitem__(self, index: int | slice) -> Trajectory | Demonstrations:
        if isinstance(index, slice):
            return Demonstrations(self.trajectories[index], self.notes)
        return self.trajectories[index]

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.trajectories)
