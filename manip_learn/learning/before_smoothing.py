"""The positions as they were recorded, beside the smoothed ones that velocities are derived with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

from manip_learn.learning.explanation.stretch import Stretch
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory


@final
@dataclass(frozen=True, eq=False)
class BeforeSmoothing:
    """Recordings before and after velocities were derived.

    Attributes:
        derived: With velocities; smoothing cuts off the ends.
        recorded: The same, as they were.
    """

    derived: Demonstrations
    recorded: Demonstrations

    def of(self, stretches: Sequence[Stretch], parts: Sequence[Trajectory]) -> list[Trajectory]:
        """The recorded samples of parts of the derived trajectories.

        A part that begins or ends with the derived trajectory begins or ends with the recorded one.

        Args:
            stretches: Which trajectory each part is of.
            parts: With velocities.
        """
        return [self._of(s.trajectory, part) for s, part in zip(stretches, parts, strict=True)]

    def _of(self, number: int, part: Trajectory) -> Trajectory:
        derived, recorded = self.derived[number], self.recorded[number]
        if derived is recorded:
            return part
        start = None if part.time[0] == derived.time[0] else float(part.time[0])
        end = None if part.time[-1] == derived.time[-1] else float(part.time[-1])
        return recorded[start:end]
