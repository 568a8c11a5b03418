"""An answer for each part of the recordings, and for trajectories left out of one that agree among themselves."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.answer import Answer, Fit, find_answer
from manip_learn.learning.candidate import LearnerSettings
from manip_learn.learning.division import DISAGREES, Division, Part
from manip_learn.learning.mechanisms.recut import where_held
from manip_learn.learning.phases.result import Stretch
from manip_learn.learning.same_mechanism import joined, same_mechanism
from manip_learn.recordings.demonstrations import Demonstrations


def find_answers(
    division: Division, demonstrations: Demonstrations, settings: LearnerSettings, fit: Fit
) -> tuple[list[Answer], Division]:
    """Learn a constraint from each part.

    Recordings of two doors can lie on one sphere. Only the mechanism tells them apart, so trajectories that do not obey
    it are learnt separately. They make a constraint of their own if it holds as many rows.

    Args:
        division: The recordings, divided.
        demonstrations: The recordings as they are.
        settings: What the user asked for.
        fit: Makes an estimate from a part.

    Returns:
        The answers, best supported first, and the division with a part for each of them.

    Raises:
        NotIdentifiableError: No part determines a constraint; the reason for the first.
    """
    answers: list[Answer] = []
    refusals: list[NotIdentifiableError] = []
    refused: list[Part] = []
    for part in division.parts:
        try:
            answers.append(_found(part, settings, fit))
        except NotIdentifiableError as refusal:
            refusals.append(refusal)
            refused.append(part)
    if not answers:
        raise refusals[0]
    answers = answers if division.one_fits else _without_twins(answers, demonstrations, settings, fit)
    odd, unlearnt = dict(division.odd), list(division.unlearnt)
    for answer in tuple(answers):
        further, left = _of_the_rest(answer, demonstrations, settings, fit)
        answers += further
        unlearnt += [(s, DISAGREES) for s in left]
        odd = dict(answer.odd) | odd
    return answers, dataclasses.replace(
        division,
        parts=(*(a.part for a in answers), *refused),
        odd=tuple(sorted(odd.items())),
        unlearnt=tuple(unlearnt),
        warnings=(*division.warnings, *(f"a further constraint is not learnt: {refusal}" for refusal in refusals)),
    )


def _without_twins(
    answers: Sequence[Answer], demonstrations: Demonstrations, settings: LearnerSettings, fit: Fit
) -> list[Answer]:
    """One answer for all that are parts of one mechanism."""
    out: list[Answer] = []
    for answer in answers:
        twin = next((k for k, other in enumerate(out) if same_mechanism(other, answer)), None)
        if twin is None:
            out.append(answer)
            continue
        try:
            out[twin] = _of_both(out[twin], answer, demonstrations, settings, fit)
        except NotIdentifiableError:
            out.append(answer)
    return out


def _of_both(one: Answer, other: Answer, demonstrations: Demonstrations, settings: LearnerSettings, fit: Fit) -> Answer:
    """One answer for two parts of one mechanism; what either leaves out is left out.

    Raises:
        NotIdentifiableError: Together they determine no constraint.
    """
    left_out = (*one.left_out, *other.left_out)
    both = joined([one.part, other.part], demonstrations, {s.trajectory for s in left_out})
    answer = _found(both, settings, fit)
    return dataclasses.replace(answer, left_out=(*answer.left_out, *left_out))


def _found(part: Part, settings: LearnerSettings, fit: Fit) -> Answer:
    """The answer of one part, cut more closely where a mechanism shows that its ends do not belong to the contact.

    Raises:
        NotIdentifiableError: The part determines no constraint.
    """
    refusal: NotIdentifiableError | None = None
    answer: Answer | None = None
    try:
        answer = find_answer(part, settings, fit)
    except NotIdentifiableError as why:
        refusal = why
    if part.n_constraints is not None and settings.mechanism and (answer is None or _doubtful(answer)):
        closer = _closer(part)
        if closer is not None:
            try:
                again = find_answer(closer, settings, fit)
            except NotIdentifiableError:
                again = None
            if again is not None and (
                answer is None or again.candidate.n_constraints >= answer.candidate.n_constraints
            ):
                return again
    if answer is None:
        raise refusal or NotIdentifiableError("nothing was learnt", code="no-evidence")
    return answer


def _doubtful(answer: Answer) -> bool:
    found = answer.mechanism
    return bool(answer.left_out) or found is None or found.mechanism is None or bool(found.warnings)


def _closer(part: Part) -> Part | None:
    """The part with its stretches cut to where a mechanism holds; None if that changes nothing."""
    maps = [f for f in part.feature_maps if isinstance(f, FrameJacobian)]
    if not maps or part.n_constraints is None:
        return None
    demos = part.demonstrations
    spans = where_held(maps[0].robot, maps[0].frame, demos.trajectories, part.n_constraints)
    if spans is None or all(s == slice(0, len(t)) for s, t in zip(spans, demos, strict=True)):
        return None
    cut = [t.part(span) for t, span in zip(demos, spans, strict=True)]
    stretches = tuple(
        dataclasses.replace(s, start=float(t.time[0]), end=float(t.time[-1]))
        for s, t in zip(part.stretches, cut, strict=True)
    )
    return dataclasses.replace(part, demonstrations=Demonstrations(cut, demos.notes), stretches=stretches)


def _of_the_rest(
    answer: Answer, demonstrations: Demonstrations, settings: LearnerSettings, fit: Fit
) -> tuple[list[Answer], list[Stretch]]:
    """Further constraints on which the trajectories that were left out agree, and what is left."""
    further: list[Answer] = []
    left = list(answer.left_out)
    while len(left) > 1:
        members = Demonstrations([demonstrations[s.trajectory][s.start : s.end] for s in left], demonstrations.notes)
        part = dataclasses.replace(answer.part, demonstrations=members, stretches=tuple(left))
        try:
            again = find_answer(part, settings, fit)
        except NotIdentifiableError:
            break
        found = None if again.mechanism is None else again.mechanism.mechanism
        if found is None or again.candidate.n_constraints < answer.candidate.n_constraints:
            break
        further.append(again)
        left = list(again.left_out)
    return further, left
