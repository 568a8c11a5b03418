"""One constraint from one part of the recordings: estimate -> evidence per row -> number of rows -> mechanism."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.errors import NotIdentifiableError, counted, number_if_known
from manip_learn.learning.candidate import Candidate, LearnerSettings
from manip_learn.learning.data_summary import DataSummary
from manip_learn.learning.division import Part
from manip_learn.learning.estimators.estimate import CLEAR_GAP
from manip_learn.learning.evidence.recombination import recombination_test
from manip_learn.learning.evidence.row_evidence import RowEvidence
from manip_learn.learning.mechanisms.find_mechanism import MechanismFit
from manip_learn.learning.phases.result import Stretch
from manip_learn.learning.place_rows import all_held, mechanism_of, place_rows
from manip_learn.recordings.demonstrations import Demonstrations

# (what to learn from, which Phi, with which settings) -> the best candidate, and a summary of all samples
Fit = Callable[[Part, LearnerSettings], tuple[Candidate, DataSummary]]
# constant rows give way to as many rows about an axis if they leave this many times more energy unexplained
TIGHTER = 1.1
# refusals that rows which depend on the place, or the evidence alone, may answer
RESCUED = ("weak-gap", "no-freedom", "no-evidence")


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
        left_out: Stretches of trajectories in which the mechanism of the others does not hold, not in `part`.
    """

    part: Part
    candidate: Candidate
    data: DataSummary
    evidence: RowEvidence | None
    mechanism: MechanismFit | None
    warnings: tuple[str, ...]
    left_out: tuple[Stretch, ...] = ()

    @property
    def odd(self) -> tuple[tuple[int, str], ...]:
        """Trajectories that the mechanism leaves out, and why."""
        if self.mechanism is None or self.mechanism.mechanism is None:
            return ()
        name = self.mechanism.mechanism.name
        return tuple((s.trajectory, f"the others agree on a {name} that does not hold in it") for s in self.left_out)


def find_answer(part: Part, settings: LearnerSettings, fit: Fit) -> Answer:
    """Learn one constraint from one part of the recordings.

    The gap of the fit and the recombination test both count rows. Where they differ, the test decides if it is clear,
    since a gap cannot tell what is held from what was never tried; the difference is said. Rows that depend on the
    place, as those of a door that is held loosely, replace constant ones if they hold more. Trajectories in which the
    mechanism of the others does not hold are left out.

    Args:
        part: Recordings or stretches.
        settings: What the user asked for.
        fit: Makes an estimate from a part.

    Raises:
        NotIdentifiableError: The part determines no constraint.
    """
    answer = _learnt(part, settings, fit)
    kept, odd = list(range(len(part.demonstrations))), _odd(answer)
    while odd:
        fewer = [i for k, i in enumerate(kept) if k not in odd]
        rest = dataclasses.replace(
            part,
            demonstrations=Demonstrations([part.demonstrations[i] for i in fewer], part.demonstrations.notes),
            stretches=tuple(part.stretches[i] for i in fewer),
        )
        try:
            again = _learnt(rest, settings, fit)
        except NotIdentifiableError:
            break
        if again.mechanism is None or again.mechanism.mechanism is None:
            break
        left_out = tuple(s for i, s in enumerate(part.stretches) if i not in fewer)
        answer, kept, odd = dataclasses.replace(again, left_out=left_out), fewer, _odd(again)
    return answer


def _odd(answer: Answer) -> tuple[int, ...]:
    """Trajectories of its part that its mechanism leaves out."""
    return () if answer.mechanism is None or answer.mechanism.mechanism is None else answer.mechanism.odd


def _learnt(part: Part, settings: LearnerSettings, fit: Fit) -> Answer:
    """`find_answer` from all trajectories of the part.

    Raises:
        NotIdentifiableError: The part determines no constraint.
    """
    user, asked = settings, settings.n_constraints
    if part.is_held:
        settings = dataclasses.replace(
            settings, estimator="null-space", n_constraints=settings.n_constraints or part.n_constraints
        )
    try:
        candidate, data = fit(part, settings)
    except NotIdentifiableError as refusal:
        return _despite(refusal, part, user, fit)
    if candidate.estimate.name != "null-space":
        return Answer(part, candidate, data, None, None, ())
    evidence = _evidence(candidate.samples.features, part, settings)
    try:
        answer = _with_rows(Answer(part, candidate, data, evidence, None, ()), settings, fit, asked)
    except NotIdentifiableError as refusal:
        return _despite(refusal, part, user, fit)
    if evidence.n_rows == 0:
        return answer  # a path that lies on something by chance is no mechanism
    return _with_mechanism(dataclasses.replace(answer, mechanism=_mechanism(part, settings)), settings, fit, asked)


def _with_rows(answer: Answer, settings: LearnerSettings, fit: Fit, asked: int | None) -> Answer:
    """The number of rows that gap and evidence together support, unless the user asked for one.

    Raises:
        NotIdentifiableError: The evidence supports none, and there are trajectories enough to tell.
    """
    evidence, candidate = answer.evidence, answer.candidate
    if evidence is None or not evidence.strengths:
        return answer
    supported, s = evidence.n_rows, candidate.n_constraints
    if asked is not None:
        return dataclasses.replace(answer, warnings=_doubt_given_rows(evidence, s))
    if supported == s:
        return dataclasses.replace(answer, warnings=_doubt(evidence))
    if supported == 0:
        return _unsupported(answer)
    if evidence.verdict == "clear" or supported < s:
        # rows that the test finds held are not moved on purpose: no model of a policy needs to be tried against them
        held = dataclasses.replace(settings, estimator="null-space", n_constraints=supported)
        again, data = fit(answer.part, held)
        said = (
            f"the gap supports {counted(s, 'row')}, the recombination test {supported}, which is the answer: "
            f"{evidence.sentence()}"
        )
        return dataclasses.replace(answer, candidate=again, data=data, warnings=(said,))
    said = f"the recombination test finds {counted(supported, 'row')} weakly, the gap {s}, which is the answer"
    return dataclasses.replace(answer, warnings=(said,))


def _unsupported(answer: Answer) -> Answer:
    evidence, s = answer.evidence, answer.candidate.n_constraints
    if evidence is None:
        return answer
    if evidence.enough:
        raise NotIdentifiableError(
            f"nothing shows that what the motion leaves unused ({counted(s, 'direction')}, gap "
            f"{answer.candidate.gap:.3g}) is held rather than never tried: {evidence.sentence()}",
            code="no-evidence",
            gaps=dict(zip(answer.candidate.estimate.table.counts, answer.candidate.estimate.table.gaps, strict=True)),
            advice=("vary the way and the posture between recordings" + number_if_known(s),),
        )
    return dataclasses.replace(
        answer,
        warnings=(
            f"record 3, better 5, that differ: {counted(evidence.n_trajectories, 'recording')} cannot show that "
            f"{counted(s, 'row')} held rather than never tried",
        ),
    )


def _doubt_given_rows(evidence: RowEvidence, s: int) -> tuple[str, ...]:
    if evidence.n_rows == s:
        return _doubt(evidence)
    return (f"{counted(s, 'row')} asked for, the recombination test supports {evidence.n_rows}: {evidence.sentence()}",)


def _doubt(evidence: RowEvidence) -> tuple[str, ...]:
    return () if evidence.verdict == "clear" else (f"weak evidence: {evidence.sentence()}",)


def _mechanism(part: Part, settings: LearnerSettings) -> MechanismFit | None:
    """What the path of the features' frame says, where the features belong to a frame of a robot."""
    maps = [f for f in part.feature_maps if isinstance(f, FrameJacobian)]
    if not settings.mechanism or not maps or settings.estimator not in ("auto", "null-space"):
        return None
    return mechanism_of(maps, part.demonstrations, np.random.default_rng(settings.seed), part.recorded)


def _with_mechanism(answer: Answer, settings: LearnerSettings, fit: Fit, asked: int | None) -> Answer:
    """Rows that depend on the place, if they hold more than constant ones."""
    features = place_rows(answer.mechanism, answer.part.feature_maps, answer.part.demonstrations)
    if features is None or asked is not None:
        return answer
    constant = answer.candidate
    candidate, data = _fit_rows(features, answer.part, settings, fit)
    if constant.n_constraints >= features.n_rows and constant.gap >= CLEAR_GAP:
        # a short arc is nearly a line: constant rows are right only if they hold as firmly as those about the axis
        firmly = constant.estimate.unexplained <= TIGHTER * candidate.estimate.unexplained
        if constant.n_constraints > features.n_rows or firmly:
            return answer
    evidence = _evidence(features, answer.part, settings)
    if not all_held(features, evidence):
        return answer
    return dataclasses.replace(answer, candidate=candidate, data=data, evidence=evidence, warnings=_doubt(evidence))


def _despite(refusal: NotIdentifiableError, part: Part, settings: LearnerSettings, fit: Fit) -> Answer:
    """An answer where the gap shows none: rows that depend on the place, or rows that the evidence alone supports.

    Raises:
        NotIdentifiableError: There is none.
    """
    if refusal.code not in RESCUED or settings.n_constraints is not None:
        raise refusal
    mechanism = _mechanism(part, settings)
    features = place_rows(mechanism, part.feature_maps, part.demonstrations)
    if features is not None and all_held(features, evidence := _evidence(features, part, settings)):
        candidate, data = _fit_rows(features, part, settings, fit)
        return Answer(part, candidate, data, evidence, mechanism, _doubt(evidence))
    if refusal.code == "weak-gap":
        for rows in part.feature_maps:
            evidence = _evidence(rows, part, settings)
            if evidence.verdict == "clear":
                only = dataclasses.replace(part, feature_maps=(rows,))
                again = dataclasses.replace(settings, estimator="null-space", n_constraints=evidence.n_rows)
                candidate, data = fit(only, again)
                said = f"no gap shows the number of rows, the recombination test does: {evidence.sentence()}"
                return Answer(part, candidate, data, evidence, mechanism, (said,))
    if mechanism is not None and mechanism.mechanism is None and mechanism.warnings:
        raise NotIdentifiableError(str(refusal), code=refusal.code, gaps=refusal.gaps, advice=mechanism.warnings)
    raise refusal


def _evidence(features: FeatureMap, part: Part, settings: LearnerSettings) -> RowEvidence:
    return recombination_test(features, part.demonstrations, np.random.default_rng(settings.seed))


def _fit_rows(
    features: MechanismRows, part: Part, settings: LearnerSettings, fit: Fit
) -> tuple[Candidate, DataSummary]:
    again = dataclasses.replace(settings, estimator="null-space", n_constraints=features.n_rows)
    return fit(dataclasses.replace(part, feature_maps=(features,)), again)
