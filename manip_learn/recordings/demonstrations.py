"""Recorded motions of one robot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import final, overload

from manip_learn.errors import RecordingError, counted, printable
from manip_learn.recordings.data_frame import PandasFrame, pandas_frame_of
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot import html_card


@final
@dataclass(frozen=True, eq=False, repr=False)
class Demonstrations(Sequence[Trajectory]):
    """Several trajectories of one robot.

    Attributes:
        trajectories: At least one; all with the same joint names in the same order.
        notes: What the reader noticed or did, in sentences.

    Raises:
        RecordingError: None given, or joint names that differ.

    Example:
        >>> import numpy as np
        >>> import manip_learn as ml
        >>> time = np.linspace(0.0, 2.0, 201)  # [s]
        >>> motions = [ml.Trajectory(time, np.outer(np.sin(time), amplitude)) for amplitude in np.eye(3)]
        >>> demos = ml.Demonstrations(motions)
        >>> len(demos), len(demos[:2])
        (3, 2)
    """

    trajectories: tuple[Trajectory, ...]
    notes: tuple[str, ...] = ()

    def __init__(self, trajectories: Iterable[Trajectory], notes: Iterable[str] = ()):
        if not isinstance(trajectories, Iterable):
            raise RecordingError(
                f"demonstrations must be Trajectory objects, got {type(trajectories).__name__}", code="type"
            )
        object.__setattr__(self, "trajectories", tuple(trajectories))
        object.__setattr__(self, "notes", tuple(map(printable, notes)))
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

    def to_frame(self) -> PandasFrame:
        """All samples in one table, which `load_demonstrations` reads again: one row per sample.

        Returns:
            Columns `trajectory` (its name), `time` [s], one per joint [rad or m], and `<joint>_velocity` if any
            trajectory has velocities (NaN for those that have none), `<joint>_effort` likewise.

        Raises:
            RecordingError: Postures that are no joint positions (nq differs from nv) have no column names.
            MissingExtraError: pandas is not installed.
        """
        return pandas_frame_of(self.trajectories)

    @property
    def n_samples(self) -> int:
        """Number of samples in all trajectories."""
        return sum(len(t) for t in self.trajectories)

    @property
    def has_velocities(self) -> bool:
        """True if every trajectory has u."""
        return all(t.u is not None for t in self.trajectories)

    def __repr__(self) -> str:
        return f"Demonstrations({self._in_words()}; first: {self.trajectories[0]!r})"

    def _repr_html_(self) -> str:
        rows = [
            (t.name, len(t), f"{t.duration:.3f}", f"{(len(t) - 1) / t.duration:.4g}" if t.duration else "")
            for t in self.trajectories
        ]
        return html_card.card(
            "Demonstrations",
            html_card.sentence(self._in_words()),
            html_card.table(("recording", "samples", "duration [s]", "rate [Hz]"), rows),
            html_card.folded(f"Joints ({len(self.joint_names)})", html_card.sentence(", ".join(self.joint_names))),
            html_card.folded(f"Notes ({len(self.notes)})", "".join(map(html_card.sentence, self.notes))),
        )

    def _in_words(self) -> str:
        seconds = sum(t.duration for t in self.trajectories)
        some = any(t.u is not None for t in self.trajectories)
        velocities = "with" if self.has_velocities else "some with" if some else "without"
        amount = f"{counted(len(self), 'recording')}, {counted(self.n_samples, 'sample')}"
        return f"{amount} over {seconds:.4g} s, {velocities} velocities"

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


def distinct_names(demonstrations: Demonstrations) -> tuple[str, ...]:
    """A name for each recording: its own, numbered where several have the same."""
    names = [t.name for t in demonstrations]
    often = Counter(names)
    return tuple(n if often[n] == 1 else f"{n} {i + 1}" for i, n in enumerate(names))
