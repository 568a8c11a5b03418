"""What the recordings show as a whole: where each constraint holds, and which recordings do not agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

from manip_learn.learning.answer import Answer
from manip_learn.learning.division import Division
from manip_learn.recordings.demonstrations import Demonstrations

SPANS_SHOWN = 6  # of each constraint, in words


class Phase(NamedTuple):
    """A stretch of a recording.

    Attributes:
        trajectory: Name of the recording.
        start, end: On the recording's own clock [s].
        constraint: Number of the constraint that holds, counted from 0 in `constraints_`; None for free motion.
    """

    trajectory: str
    start: float
    end: float
    constraint: int | None


class OddTrajectory(NamedTuple):
    """A recording that does not agree with the others.

    Attributes:
        trajectory: Its name.
        reason: How it differs, in numbers and units.
    """

    trajectory: str
    reason: str


@final
@dataclass(frozen=True)
class RecordingOverview:
    """What the recordings show as a whole, the same for every constraint.

    Attributes:
        phases: Every stretch that moves.
        odd_trajectories: Recordings that do not agree with the others.
        warnings: Doubts about the division.
    """

    phases: tuple[Phase, ...] = ()
    odd_trajectories: tuple[OddTrajectory, ...] = ()
    warnings: tuple[str, ...] = ()

    @staticmethod
    def of(answers: Sequence[Answer], division: Division, demonstrations: Demonstrations) -> RecordingOverview:
        """The phases with the names of the recordings; parts without an answer count as free motion."""
        names = distinct_names(demonstrations)
        number = {id(answer.part): k for k, answer in enumerate(answers)}
        phases = tuple(
            Phase(names[i], start, end, None if part is None else number.get(id(division.parts[part])))
            for i, start, end, part in division.phases()
        )
        odd = {i: why for i, why in division.odd}
        for answer in answers:
            for i, why in answer.odd:
                odd.setdefault(i, why)
        warnings = list(division.warnings)
        if odd:
            listed = "; ".join(f"{names[i]}: {why}" for i, why in sorted(odd.items()))
            warnings.append(
                f"{len(odd)} of {len(demonstrations)} recordings do not agree with the others and were left out of the "
                f"first constraint: {listed}"
            )
        return RecordingOverview(
            phases, tuple(OddTrajectory(names[i], why) for i, why in sorted(odd.items())), tuple(warnings)
        )

    def sentences(self) -> tuple[str, ...]:
        """Where each constraint holds, in words."""
        numbers = sorted({p.constraint for p in self.phases if p.constraint is not None})
        free = sum(p.constraint is None for p in self.phases)
        if not free and len(numbers) < 2:
            return ()
        out = []
        for k in numbers:
            spans = [
                f"from {p.start:.2f} s to {p.end:.2f} s in {p.trajectory}" for p in self.phases if p.constraint == k
            ]
            more = f" and {len(spans) - SPANS_SHOWN} more" if len(spans) > SPANS_SHOWN else ""
            out.append(f"constraint {k + 1} is held {', '.join(spans[:SPANS_SHOWN])}{more}")
        if free:
            out.append(f"free motion in {free} stretch(es)")
        return tuple(out)


def distinct_names(demonstrations: Demonstrations) -> tuple[str, ...]:
    """A name for each recording: its own, numbered where several have the same."""
    names = [t.name for t in demonstrations]
    return tuple(n if names.count(n) == 1 else f"{n} {i + 1}" for i, n in enumerate(names))
