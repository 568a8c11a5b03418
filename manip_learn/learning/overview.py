"""What the recordings show as a whole: where each constraint holds, and which recordings do not agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

from manip_learn.errors import counted
from manip_learn.learning.answer import Answer
from manip_learn.learning.explanation.findings import IN_ONE_ONLY, Findings
from manip_learn.learning.repeats import IndependentRecordings
from manip_learn.recordings.demonstrations import distinct_names

SPANS_SHOWN = 6  # of each constraint, in words
NO_ANSWER = "what several recordings show here could not be learnt"


class Phase(NamedTuple):
    """A stretch of a recording.

    Attributes:
        trajectory: Name of the recording.
        start, end: On the recording's own clock [s].
        constraint: Number of the constraint that holds, counted from 0 in `constraints_`; None for free motion.
        reason: Why nothing is learnt from a stretch in which something seems to be held; else empty.
    """

    trajectory: str
    start: float
    end: float
    constraint: int | None
    reason: str = ""


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
        warnings: Doubts about the findings.
    """

    phases: tuple[Phase, ...] = ()
    odd_trajectories: tuple[OddTrajectory, ...] = ()
    warnings: tuple[str, ...] = ()

    @staticmethod
    def of(answers: Sequence[Answer], findings: Findings, recordings: IndependentRecordings) -> RecordingOverview:
        """The phases with the names of the recordings, on the clocks of those that were given."""
        names, given = distinct_names(recordings.demonstrations), distinct_names(recordings.given)
        number = {id(answer.part): k for k, answer in enumerate(answers)}
        phases = []
        for s, part, why in findings.phases():
            constraint = None if part is None else number.get(id(findings.parts[part]))
            reason = NO_ANSWER if part is not None and constraint is None else why
            phases += [Phase(given[p.trajectory], p.start, p.end, constraint, reason) for p in recordings.places(s)]
        odd = dict(findings.odd)
        warnings = [*findings.warnings, *lone_contacts(findings, recordings)]
        if odd:
            listed = "; ".join(f"{names[i]}: {why}" for i, why in sorted(odd.items()))
            warnings.append(
                f"{len(odd)} of {len(names)} recordings do not agree with the others; what does not agree was "
                f"left out of the first constraint: {listed}"
            )
        return RecordingOverview(
            tuple(phases), tuple(OddTrajectory(names[i], why) for i, why in sorted(odd.items())), tuple(warnings)
        )

    def sentences(self) -> tuple[str, ...]:
        """Where each constraint holds, in words."""
        numbers = sorted({p.constraint for p in self.phases if p.constraint is not None})
        free = sum(p.constraint is None and not p.reason for p in self.phases)
        unlearnt = [p for p in self.phases if p.reason]
        if not free and not unlearnt and len(numbers) < 2:
            return ()
        out = []
        for k in numbers:
            spans = [
                f"from {p.start:.2f} s to {p.end:.2f} s in {p.trajectory}" for p in self.phases if p.constraint == k
            ]
            more = f" and {len(spans) - SPANS_SHOWN} more" if len(spans) > SPANS_SHOWN else ""
            out.append(f"constraint {k + 1} is held {', '.join(spans[:SPANS_SHOWN])}{more}")
        if free:
            out.append(f"free motion in {counted(free, 'stretch')}")
        out += [f"not learnt from {p.start:.2f} s to {p.end:.2f} s in {p.trajectory}: {p.reason}" for p in unlearnt]
        return tuple(out)


def lone_contacts(findings: Findings, recordings: IndependentRecordings) -> tuple[str, ...]:
    """Advice about contacts that one recording alone shows."""
    alone = [p for s, why in findings.unlearnt if why == IN_ONE_ONLY for p in recordings.places(s)]
    names = distinct_names(recordings.given)
    contacts = [f"in {names[p.trajectory]} from {p.start:.1f} s to {p.end:.1f} s" for p in alone]
    if not contacts:
        return ()
    more = f" and {len(contacts) - SPANS_SHOWN} more" if len(contacts) > SPANS_SHOWN else ""
    seen = counted(len(contacts), "contact")
    return (
        f"record again, at least twice, {seen} that one recording alone shows: "
        f"{', '.join(contacts[:SPANS_SHOWN])}{more}",
    )
