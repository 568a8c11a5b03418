"""One constraint from one part of the recordings: its rows, the evidence for each of them, its mechanism."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows, PlaceRows
from manip_learn.errors import NotIdentifiableError, counted, number_if_known
from manip_learn.learning.candidate import Candidate, LearnerSettings
from manip_learn.learning.explanation.findings import Findings, Part
from manip_learn.learning.mechanisms.find_mechanism import BLIND, MechanismFit, find_mechanism
from manip_learn.learning.recombination import RowEvidence, recombination_test
from manip_learn.learning.samples import DataSummary
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.preprocessing import evenly

# (what to learn from, which Phi, with which settings) -> the best candidate, and a summary of all samples
Fit = Callable[[Part, LearnerSettings], tuple[Candidate, DataSummary]]
# trajectories beyond this number add nothing to a mechanism but time
MOST_PATHS = 16
# rows of a mechanism that concern the position of the frame alone, for features without rotations
POSITION_ROWS = {
    "hinge": ("radial", "axial"),
    "screw": ("radial", "helical"),
    "ball": ("spherical",),
    "other": ("radial",),
}


@final
@dataclass(frozen=True, eq=False)
class Answer:
    """A constraint with all that supports it.

    Attributes:
        part: What it was learnt from.
        candidate: Lambda with the evidence of the fit.
        data: Summary of the samples.
        evidence: Evidence for each row; None where the demonstrator moves the rows (b unknown).
        mechanism: What the hand's path says of the mechanism; None if it was not asked for.
        warnings: Doubts beside those of the candidate and of the mechanism.
    """

    part: Part
    candidate: Candidate
    data: DataSummary
    evidence: RowEvidence | None
    mechanism: MechanismFit | None
    warnings: tuple[str, ...]


def find_answers(
    findings: Findings, everything: Part, settings: LearnerSettings, fit: Fit
) -> tuple[list[Answer], Findings]:
    """Learn a constraint from each part; or one from all recordings, if the demonstrator imposes it.

    Args:
        findings: What explains the recordings.
        everything: All of them as one part.
        settings: What the user asked for.
        fit: Makes an estimate from a part.

    Returns:
        The answers, best supported first, and the findings with a part for each of them.

    Raises:
        NotIdentifiableError: No part determines a constraint; the reason for the first.
    """
    if not findings.explained:
        return [_undivided(findings.parts[0], settings, fit, elsewhere=findings.elsewhere)], findings
    answers, refused = list[Answer](), list[tuple[Part, NotIdentifiableError]]()
    for part in findings.parts:
        try:
            answers.append(_explained(part, settings, fit))
        except NotIdentifiableError as refusal:
            refused.append((part, refusal))
    if not answers:
        raise refused[0][1]
    best = answers[0]
    confirmed = best.evidence is not None and best.evidence.verdict == "clear"
    if settings.estimator == "auto" and not confirmed and not best.candidate.estimate.is_held:
        imposed = _imposed(everything, settings, fit)
        if imposed is not None:
            return [imposed], dataclasses.replace(findings, parts=(everything,), free=(), odd=(), unlearnt=())
    said = tuple(f"a further constraint is not learnt: {refusal}" for _, refusal in refused)
    parts = (*(a.part for a in answers), *(part for part, _ in refused))
    return answers, dataclasses.replace(findings, parts=parts, warnings=(*findings.warnings, *said))


def _imposed(everything: Part, settings: LearnerSettings, fit: Fit) -> Answer | None:
    """Rows that are moved on purpose, if a model of the null-space policy explains all recordings better than that
    rows are held.
    """
    try:
        candidate, data = fit(everything, settings)
    except NotIdentifiableError:
        return None
    return Answer(everything, candidate, data, None, None, ()) if candidate.estimate.name == "joint" else None


def _explained(part: Part, settings: LearnerSettings, fit: Fit) -> Answer:
    """The constraint of a part in which rows are known to be held.

    Raises:
        NotIdentifiableError: The part determines no constraint.
    """
    asked = settings.n_constraints
    mechanism = _mechanism(part, settings)
    features, n = part.feature_maps[0], None if part.found is None else len(part.found)
    rows = mechanism_rows(mechanism, part.asked, part.demonstrations) if asked is None else None
    evidence = None if rows is None else _evidence(rows, part, settings)
    if rows is not None and evidence is not None and evidence.n_rows == rows.n_rows:
        features, n = rows, rows.n_rows
    elif asked is None and isinstance(features, PlaceRows):
        features, n = _straight(mechanism, part) or (features, n)
    held = dataclasses.replace(settings, estimator="null-space", n_constraints=asked or n)
    candidate, data = fit(dataclasses.replace(part, feature_maps=(features,)), held)
    if isinstance(features, PlaceRows) and candidate.estimate.table.verdict(candidate.estimate.n_rows) == "none":
        # so few rows of so many are not determined by a contact that gives way: plainer ones are
        candidate, data = fit(dataclasses.replace(part, feature_maps=part.asked), held)
    if evidence is None or candidate.samples.features is not rows:
        evidence = _evidence(candidate.samples.features, part, settings)
    return Answer(part, candidate, data, evidence, mechanism, _doubts(evidence, candidate.estimate.n_rows, asked))


def _straight(found: MechanismFit | None, part: Part) -> tuple[FeatureMap, int] | None:
    """The rows asked for along the base's axes, and how many of them a line, a plane or an orientation holds."""
    if found is None or found.rival or not isinstance(found.features, FrameJacobian):
        return None
    maps = [f for f in part.asked if isinstance(f, FrameJacobian) and f.reference == "world"]
    if not maps or found.selection is None:
        return None
    held = dict(zip(found.features.row_names, found.selection.T, strict=True))
    columns = [held.get(name, np.zeros(len(found.selection))) for name in maps[0].row_names]
    return maps[0], int(np.linalg.matrix_rank(np.stack(columns), 1e-6))


def _undivided(part: Part, settings: LearnerSettings, fit: Fit, *, elsewhere: bool) -> Answer:
    """The constraint of recordings that nothing explains: one that the demonstrator imposes, or too few recordings.

    Raises:
        NotIdentifiableError: There is none.
    """
    candidate, data = fit(part, settings)
    if candidate.estimate.name != "null-space":
        return Answer(part, candidate, data, None, None, ())
    evidence, s = _evidence(candidate.samples.features, part, settings), candidate.estimate.n_rows
    answer = Answer(part, candidate, data, evidence, None, _doubts(evidence, s, settings.n_constraints))
    if settings.n_constraints is not None or not evidence.strengths or (elsewhere and evidence.n_rows == s):
        return answer
    if evidence.enough:
        gaps = candidate.estimate.table
        unused = f"{counted(s, 'direction')}, gap {candidate.estimate.gap:.3g}"
        raise NotIdentifiableError(
            f"nothing shows that what the motion leaves unused ({unused}) is held rather than never tried: "
            f"{evidence.sentence()}",
            code="no-evidence",
            gaps=dict(zip(gaps.counts, gaps.gaps, strict=True)),
            advice=("vary the way and the posture between recordings" + number_if_known(s),),
        )
    said = (
        f"record 3, better 5, that differ: {counted(evidence.n_trajectories, 'recording')} cannot show that "
        f"{counted(s, 'row')} held rather than never tried"
    )
    mechanism = _mechanism(part, settings) if evidence.n_rows else None
    return dataclasses.replace(answer, mechanism=mechanism, warnings=(said,))


def _evidence(features: FeatureMap, part: Part, settings: LearnerSettings) -> RowEvidence:
    rng = np.random.default_rng(settings.seed)
    return recombination_test(features, part.demonstrations, rng, part.choices, settings.strength)


def _doubts(evidence: RowEvidence, s: int, asked: int | None) -> tuple[str, ...]:
    if evidence.n_rows == s or not evidence.strengths:
        return () if evidence.verdict == "clear" else (f"weak evidence: {evidence.sentence()}",)
    wanted = "asked for" if asked is not None else "explain the recordings"
    return (f"{counted(s, 'row')} {wanted}, the recombination test supports {evidence.n_rows}: {evidence.sentence()}",)


def _mechanism(part: Part, settings: LearnerSettings) -> MechanismFit | None:
    """What holds the frame of the features, where they are the rows of one."""
    maps = [f for f in part.feature_maps if isinstance(f, FrameJacobian | PlaceRows)]
    if not settings.mechanism or not maps or settings.estimator not in ("auto", "null-space"):
        return None
    chosen, recorded = evenly(len(part.demonstrations), MOST_PATHS).tolist(), part.recorded
    before = None if recorded is None else [recorded[i] for i in chosen]
    rng, motion = np.random.default_rng(settings.seed), [part.demonstrations[i] for i in chosen]
    try:
        held = None if part.found is None else (part.feature_maps[0], part.found)
        robot, frame, strength = maps[0].robot, maps[0].frame.name, settings.strength
        return find_mechanism(robot, frame, motion, rng, recorded=before, held=held, strength=strength)
    except NotIdentifiableError:
        return None


def mechanism_rows(
    found: MechanismFit | None, feature_maps: Sequence[FeatureMap], demonstrations: Demonstrations
) -> MechanismRows | None:
    """The rows of a mechanism that depend on the place, in the axes asked for and in which the arm can move.

    Rows across the axis about which alone the hand may turn are constant, but the path of the hand tells that axis
    better than its velocity does where the hand sways: what sways to and fro has a large rate and a small angle.
    """
    if found is None or found.mechanism is None or found.features is None:
        return None
    features = found.features if isinstance(found.features, MechanismRows) else _turning(found.features, found)
    if features is None:
        return None
    units = {unit for f in feature_maps for unit in f.row_units if unit != "m^2/s"}
    names = tuple(n for n, unit in zip(features.row_names, features.row_units, strict=True) if unit in units)
    if units == {"m/s"}:
        names = POSITION_ROWS.get(found.mechanism.type, ())
    if names:
        movable = _movable(features.with_rows(names, features.radius), demonstrations)
        names = tuple(n for n, moves in zip(names, movable, strict=True) if moves)
    return features.with_rows(names, features.radius) if names else None


def _turning(features: FeatureMap, found: MechanismFit) -> MechanismRows | None:
    """The rows across the axis of a held orientation; None of anything else."""
    mechanism = found.mechanism
    if mechanism is None or mechanism.type != "held-orientation" or mechanism.axis is None:
        return None
    if not isinstance(features, FrameJacobian):
        return None
    return MechanismRows(features.robot, features.frame.name, ("turn-1", "turn-2"), axis=mechanism.axis)


def _movable(features: MechanismRows, demonstrations: Demonstrations) -> Bool[np.ndarray, " p"]:
    """Whether the arm can move the frame along each row, somewhere on the recordings."""
    few = np.concatenate([t.q[:: max(1, len(t) // 10)] for t in demonstrations])
    return np.max(np.linalg.norm(features.batch(few), axis=2), axis=0) > BLIND
