"""One constraint from one part of the recordings: an estimate for each feature map, the choice among these, what shows
that each row is held, and the mechanism.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.curve_rows import CurveRows
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows, PlaceRows
from manip_learn.errors import NotIdentifiableError, advice, counted, listed, number_if_known
from manip_learn.learning.arm_errors import AS_DESCRIBED, ArmErrors
from manip_learn.learning.checks import check_samples
from manip_learn.learning.estimate import (
    CLEAR_GAP,
    EQUALLY_GOOD,
    EXPLAINED,
    SOFT_ENERGY,
    Estimate,
    estimate_null_space,
    gaps_of_levels,
    levels,
)
from manip_learn.learning.explanation.evidence import CHANGE_SECONDS, Stretch
from manip_learn.learning.explanation.findings import DISAGREES, LONGEST_SLIP_SECONDS, NEARLY_SAME_DEG, Findings, Part
from manip_learn.learning.imposed import estimate_imposed
from manip_learn.learning.mechanisms.find_mechanism import BLIND, MechanismFit, find_curve, find_mechanism
from manip_learn.learning.mechanisms.one_place import at_one_place
from manip_learn.learning.policy import held_nats
from manip_learn.learning.recombination import BELIEVED_STRENGTH, RowEvidence, recombination_test
from manip_learn.learning.repeats import once_each
from manip_learn.learning.samples import Samples
from manip_learn.learning.separate import estimate_separate
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.trajectory import Demonstrations, evenly

EstimatorName = Literal["auto", "joint", "null-space", "separate"]
# ratio of gaps from which on another number of rows contradicts the one that is answered. Of guided hands
# (benchmarks/guided_hands.py, even seeds 61000 to 61138) three of 59 are contradicted, by 2 to 4.3, and all three are
# wrong; of right ones none is
CONTRADICTED = 2.0
SURER_NATS = 5.0  # odds of 150 to 1, from which other features are more likely than the first by more than chance
_KEPT = "kept, not shown to be held"
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
@dataclass(frozen=True)
class LearnerSettings:
    """What the user asked for, by the names and with the meaning of `ConstraintLearner`."""

    n_constraints: int | None
    estimator: EstimatorName
    policy_model: str
    seed: int
    mechanism: bool = True
    strength: float = BELIEVED_STRENGTH
    habits: bool = False
    arm: ArmErrors = AS_DESCRIBED


@final
@dataclass(frozen=True, eq=False)
class Candidate:
    """What was learnt with one feature map.

    Attributes:
        samples: What it was learnt from: all samples, or a choice of them.
        estimate: Lambda with the evidence.
        warnings: Doubts so far.
        rng: For the steps that follow.
    """

    samples: Samples
    estimate: Estimate
    warnings: tuple[str, ...]
    rng: np.random.Generator


def learn_best(feature_maps: Sequence[FeatureMap], part: Part, settings: LearnerSettings) -> Candidate:
    """An estimate with each feature map; the first, unless a later one is better by more than chance.

    Raises:
        NotIdentifiableError: The data determine no constraint for any of them; the reason for the first.
        RecordingError: Outliers.
    """
    best: Candidate | None = None
    refusals: list[NotIdentifiableError] = []
    for features in feature_maps:
        try:
            samples = Samples.collect(features, part.table)
            warnings = check_samples(samples, part.demonstrations.joint_names, settings.n_constraints)
            # rows held beyond doubt: the same motion is not self-imposed in other features
            is_held = best is not None and best.estimate.is_held
            if best is not None and (is_held and settings.estimator == "auto" or settings.estimator == "null-space"):
                table = gaps_of_levels(levels(samples)[0], samples.nv)
                if table.gap(settings.n_constraints or table.best) <= EQUALLY_GOOD * best.estimate.gap:
                    continue  # the gap depends on the levels alone
            rng = np.random.default_rng(settings.seed)
            estimate = _estimate(samples, settings, rng, is_held)
            warnings += doubts_of_estimate(estimate, samples.nv, settings.n_constraints)
        except NotIdentifiableError as error:
            refusals.append(error)
            continue
        if best is not None and estimate.name == best.estimate.name == "joint":  # the same velocities
            better = estimate.nats > best.estimate.nats + SURER_NATS
        else:
            better = best is None or estimate.gap > EQUALLY_GOOD * best.estimate.gap
        if better:
            best = Candidate(samples, estimate, tuple(warnings), rng)
    if best is None:
        raise refusals[0]
    return best


def _estimate(samples: Samples, settings: LearnerSettings, rng: np.random.Generator, rival_is_held: bool) -> Estimate:
    """By the estimator asked for, or the one that the data select.

    That is the null-space one if the world holds the rows (b = 0), the joint one if the demonstrator moves them:
    whichever makes the same motion more likely.
    """
    if settings.estimator == "joint":
        return _joint(samples, settings, rng)
    if settings.estimator == "separate":
        return estimate_separate(samples, settings.n_constraints, rng)
    held = estimate_null_space(samples, settings.n_constraints)
    if settings.estimator == "null-space" or held.is_held or rival_is_held or samples.n_trajectories < 2:
        return held
    try:
        joint = _joint(samples, settings, rng, EXPLAINED)
    except NotIdentifiableError:
        return held  # no policy predicts this motion: the evidence is how little some directions are used
    return joint if joint.nats > held_nats(samples, held.whitened_selection) else held


def _joint(
    samples: Samples, settings: LearnerSettings, rng: np.random.Generator, unexplained: float = np.inf
) -> Estimate:
    try:
        return estimate_imposed(samples, settings.n_constraints, rng, settings.policy_model, unexplained)
    except np.linalg.LinAlgError as error:
        raise NotIdentifiableError(
            "the motion is too short, or too much the same in all recordings, for a model of the null-space policy: "
            "move further, and differently",
            code="too-few-samples",
        ) from error


def doubts_of_estimate(estimate: Estimate, nv: int, n_constraints: int | None) -> list[str]:
    """Warnings about the number of rows, and about what the estimate leaves unexplained.

    Raises:
        NotIdentifiableError: It was to be found and the data support none, or no joint motion is left free.
    """
    warnings = []
    s, table, gap = estimate.n_rows, estimate.table, estimate.gap
    verdict = table.verdict(s)
    if verdict == "none" and n_constraints is None:
        raise NotIdentifiableError(
            f"the recordings do not show a constraint: the largest gap is {gap:.2g}, for {counted(s, 'row')}, and "
            f"{table.weak_from:g} is the least that counts",
            code="weak-gap",
            gaps=table.by_count,
        )
    if s >= nv:
        raise NotIdentifiableError(f"{s} constraints leave no null space for {nv} joints", code="no-freedom")
    if verdict != "clear":
        warnings.append(
            f"weak gap: {gap:.2g} for {counted(s, 'row')}, {CLEAR_GAP:g} is clear; the constraint may be "
            "soft, or the recordings noisy"
        )
    if n_constraints is not None and table.best != s and table.verdict(table.best) != "none":
        warnings.append(
            f"{counted(s, 'row')} learnt, but the gap supports {table.best}: "
            f"{table.gap(table.best):.3g} against {gap:.3g}"
        )
    if estimate.name == "null-space" and estimate.unexplained > SOFT_ENERGY:
        warnings.append(
            f"{100 * estimate.unexplained:.2g} % of the motion's energy breaks the constraint: it is soft, or the "
            "demonstrator moves the constrained directions on purpose"
            + advice(" (then use {})", "estimator='joint'", "--estimator joint")
        )
    if estimate.name == "joint" and estimate.held_out > EXPLAINED:
        warnings.append(
            f"the policy model predicts only {100 * (1 - estimate.held_out):.0f} % of left-out trajectories: the "
            "null-space motion is not a function of the posture"
        )
    return warnings


@final
@dataclass(frozen=True, eq=False)
class Answer:
    """A constraint with all that supports it.

    Attributes:
        part: What it was learnt from.
        candidate: Lambda with the evidence of the fit.
        evidence: Evidence for each row; None where the demonstrator moves the rows (b unknown).
        mechanism: What the hand's path says of the mechanism; None if it was not asked for.
        warnings: Doubts beside those of the candidate and of the mechanism.
    """

    part: Part
    candidate: Candidate
    evidence: RowEvidence | None
    mechanism: MechanismFit | None
    warnings: tuple[str, ...]

    @property
    def features(self) -> dict[str, Any]:
        """Phi, described."""
        return self.candidate.samples.features.describe()

    @property
    def selection(self) -> Float[np.ndarray, "s p"]:
        """Lambda, with orthonormal rows."""
        return self.candidate.samples.selection(self.candidate.estimate.whitened_selection)

    @property
    def contradiction(self) -> str:
        """What its own tests say against it, in words; empty if they support it."""
        estimate, table, evidence = self.candidate.estimate, self.candidate.estimate.table, self.evidence
        n, best = estimate.n_rows, table.best
        if evidence is not None and evidence.n_rows < n:
            return f"the recombination test supports {evidence.n_rows}: {evidence.sentence()}"
        if best != n and table.gap(best) >= CONTRADICTED * estimate.gap:
            return f"the gap supports {best}: {table.gap(best):.3g} against {estimate.gap:.3g}"
        return ""

    @property
    def clear(self) -> bool:
        """Whether gap and recombination are, and agree."""
        estimate = self.candidate.estimate
        told = self.evidence is None or self.evidence.verdict == "clear"
        return told and estimate.table.verdict(estimate.n_rows) == "clear" and not self.contradiction

    def refusal(self) -> NotIdentifiableError:
        """Why it is not believed, where something contradicts it."""
        estimate = self.candidate.estimate
        rows = counted(estimate.n_rows, "row")
        return _no_evidence(estimate, f"{rows} would explain the recordings, but {self.contradiction}")


def _no_evidence(estimate: Estimate, why: str) -> NotIdentifiableError:
    """The refusal of rows that nothing shows to be held."""
    advised = "vary the way and the posture between recordings" + number_if_known(estimate.n_rows)
    return NotIdentifiableError(why, code="no-evidence", gaps=estimate.table.by_count, advice=(advised,))


def find_answers(findings: Findings, everything: Part, settings: LearnerSettings) -> tuple[list[Answer], Findings]:
    """Learn a constraint from each part; or one from everything as one part, if the demonstrator imposes it.

    The answers are returned clear ones first, then best supported first, with the findings that have a part for each of
    them. Beside a clear one, those that are not are named and not learnt, unless habits are asked for.

    Raises:
        NotIdentifiableError: No part determines a constraint; the reason for the first.
    """
    if not findings.explained:
        return [_undivided(findings.parts[0], settings, elsewhere=findings.elsewhere)], findings
    answers, refused = list[Answer](), list[tuple[Part, NotIdentifiableError]]()
    located, apart = _by_place(findings.parts, settings)
    for one in located:
        try:
            answers.append(_explained(one, settings))
        except NotIdentifiableError as refusal:
            refused.append((one.part, refusal))
    if not answers:
        raise refused[0][1]
    best = answers[0]
    confirmed = best.evidence is not None and best.evidence.verdict == "clear"
    if settings.estimator == "auto" and not confirmed and not best.candidate.estimate.is_held:
        # rows that are moved on purpose, if a model of the null-space policy explains all recordings better
        with suppress(NotIdentifiableError):
            imposed = learn_best(everything.feature_maps, everything, settings)
            if imposed.estimate.name == "joint":
                answer = Answer(everything, imposed, None, None, ())
                return [answer], dataclasses.replace(findings, parts=(everything,), free=(), odd=(), unlearnt=())
    if settings.n_constraints is None:
        refused += [(a.part, a.refusal()) for a in answers if a.contradiction]
        answers = [a for a in answers if not a.contradiction]
        if not answers:
            raise best.refusal()
    answers.sort(key=lambda a: not a.clear)
    habits = [a for a in answers if answers[0].clear and not a.clear and not settings.habits]
    said = [f"a further constraint is not learnt: {refusal}" for _, refusal in refused]
    for a in habits:
        rows = counted(a.candidate.estimate.n_rows, "row")
        said.append(
            f"{rows} in {counted(len(a.part.stretches), 'stretch')} may be kept by the way of moving rather than held "
            f"(gap {a.candidate.estimate.gap:.3g}), and are not learnt beside what is clear"
            + advice("; {} learns them too", "habits=True", "--habits")
        )
    unlearnt = (*findings.unlearnt, *((s, DISAGREES) for s in apart))
    unlearnt += tuple((s, _KEPT) for a in habits for s in a.part.stretches)
    answers = [a for a in answers if a not in habits]
    parts = (*(a.part for a in answers), *(part for part, _ in refused))
    warnings = (*findings.warnings, *_several(answers), *said)
    moved = {s.trajectory for x in located if x.example for s in x.part.stretches}
    odd = tuple((i, why) for i, why in findings.odd if i not in moved)
    return answers, dataclasses.replace(findings, parts=parts, unlearnt=unlearnt, odd=odd, warnings=warnings)


def _several(answers: Sequence[Answer]) -> list[str]:
    """Warnings about constraints that are nearly the same, and about recordings of different tasks."""
    said = []
    for (i, a), (j, b) in combinations(enumerate(answers, start=1), 2):
        angle = math.degrees(row_space_angle(a.selection, b.selection)) if a.features == b.features else 90.0
        if angle < NEARLY_SAME_DEG:
            said.append(
                f"constraints {i} and {j} differ by {angle:.1f} deg only: two contacts that nearly coincide, or one "
                "that is not quite constant; they are kept apart, not averaged"
            )
    tasks = [{s.trajectory for s in a.part.stretches} for a in answers]
    if len(tasks) > 1 and not set.intersection(*tasks):
        shown = listed(counted(len(task), "recording") for task in tasks)
        said.append(f"the recordings are of {len(tasks)} tasks, {shown}: each constraint is learnt from its own")
    return said


@final
@dataclass(frozen=True, eq=False)
class _Located:
    """A part, the mechanism that holds its stretches, and the stretch whose place is told if each has its own."""

    part: Part
    mechanism: MechanismFit | None
    example: Part | None = None


def _by_place(parts: Sequence[Part], settings: LearnerSettings) -> tuple[list[_Located], list[Stretch]]:
    """The parts, divided where mechanisms at several places explain one much better than a single one; and stretches
    that have a place of their own, beside others that share theirs.

    Where most have a place of their own, what holds the hand was moved between recordings: parts of other recordings,
    with as many rows, are of the same thing.
    """
    out, alone, waiting = list[_Located](), list[Stretch](), list(parts)
    divided = list[Stretch]()
    # What falls: stretches that were divided from others three times, as two tests may disagree for ever, are joined no
    # more. So each division leaves fewer divisions for stretches that can be joined, or fewer stretches in a part, and
    # each join leaves fewer parts.
    while waiting:
        part = waiting.pop(0)
        found = _mechanism(part, settings)
        places = () if found is None else found.places
        recordings = [s.trajectory for s in part.stretches]
        several = len(set(recordings)) > 1  # else the stretches of the only one count as such
        shared = [group for group in places if len({recordings[i] for i in group} if several else group) > 1]
        if 2 * sum(map(len, shared)) > sum(map(len, places)):
            divided += part.stretches
            waiting[:0] = [_with_own_rows(part.of([part.stretches[i] for i in group])) for group in shared]
            alone += [part.stretches[i] for group in places if group not in shared for i in group]
        elif found is not None and places:
            for other in [x for x in waiting if _same_rows(part, x)]:
                waiting.remove(other)
                part = part.of((*part.stretches, *other.stretches))
            last = max(s.trajectory for s in part.stretches)
            example = _with_own_rows(part.of([s for s in part.stretches if s.trajectory == last]))
            there = _mechanism(example, settings)
            moved = (
                f"{found.reason}; it was moved between recordings, and is learnt as it stood in "
                f"{example.demonstrations[0].name}"
                + advice(": {} says where it stands when the task is repeated", "repeat(moved=...)", "--moved")
            )
            out.append(_Located(part, there and dataclasses.replace(there, warnings=(moved,)), example))
        else:
            for one in [x for x in out if x.example is None and _same_rows(x.part, part)]:
                both = (*one.part.stretches, *part.stretches)
                fits = one.mechanism and one.mechanism.fit, found and found.fit
                if max(map(divided.count, both)) < 3 and at_one_place(*fits):
                    # apart for an arm that is not quite its description
                    out.remove(one)
                    waiting.insert(0, _with_own_rows(part.of(both)))
                    break
            else:
                out.append(_Located(part, found))
    return _as_one_curve(out), alone


def _as_one_curve(located: list[_Located]) -> list[_Located]:
    """A single part in the place of those that follow each other without a pause, where the hand goes along one curve
    that is nearer to its places than the mechanisms of all of them.

    The search sees velocities, and takes a bent rail for several mechanisms in turn.
    """
    spans = [(s, x) for x in located for s in x.part.stretches if x.mechanism is not None]
    runs = list[tuple[Stretch, set[int]]]()
    for s, x in sorted(spans, key=lambda span: (span[0].trajectory, span[0].start)):
        last, parts = runs[-1] if runs else (None, set())
        if last is None or last.trajectory != s.trajectory or s.start - last.end > LONGEST_SLIP_SECONDS:
            runs.append((s, {id(x)}))
        else:
            runs[-1] = Stretch(s.trajectory, last.start, max(last.end, s.end)), parts | {id(x)}
    longest = {run.trajectory: run for run, parts in sorted(runs, key=lambda r: r[0].duration) if len(parts) > 1}
    inside = [
        x
        for x in located
        if x.mechanism is not None
        and all(s.trajectory in longest and s.shared(longest[s.trajectory]) == s.duration for s in x.part.stretches)
    ]
    if len(inside) < 2:
        return located
    whole = inside[0].part.of(tuple(longest.values()))
    seconds = [sum(s.duration + 2.0 * CHANGE_SECONDS for s in x.part.stretches) for x in inside]
    variance = np.average([x.mechanism.variance for x in inside if x.mechanism is not None], weights=seconds)
    share = min(1.0, sum(seconds) / sum(s.duration for s in whole.stretches))
    features = inside[0].part.asked[0]
    if not isinstance(features, FrameJacobian):
        return located
    found = find_curve(features.robot, features.frame.name, whole.demonstrations, float(variance), share)
    if found is None:
        return located
    return [_Located(whole, found), *(x for x in located if x not in inside)]


def _same_rows(one: Part, other: Part) -> bool:
    """Whether both have as many rows of the same features, in different recordings."""
    apart = not {s.trajectory for s in one.stretches} & {s.trajectory for s in other.stretches}
    alike = one.found is not None and other.found is not None and len(one.found) == len(other.found)
    return apart and alike


def _with_own_rows(part: Part) -> Part:
    """The part with as many rows as it has, those that its own motion uses least."""
    if part.found is None:
        return part
    samples = Samples.collect(part.feature_maps[0], part.table)
    return dataclasses.replace(part, found=samples.selection(levels(samples)[1][: len(part.found)]))


def _explained(located: _Located, settings: LearnerSettings) -> Answer:
    """The constraint of a part in which rows are known to be held.

    Raises:
        NotIdentifiableError: The part determines no constraint.
    """
    asked, part, mechanism = settings.n_constraints, located.part, located.mechanism
    there = located.example or part
    features, n = part.feature_maps[0], None if part.found is None else len(part.found)
    rows = mechanism_rows(mechanism, part.asked, there.demonstrations) if asked is None else None
    evidence = None if rows is None else _evidence(rows, part, settings)
    if rows is not None and evidence is not None and evidence.n_rows == rows.n_rows:
        features, n = rows, rows.n_rows
    elif asked is None and isinstance(features, PlaceRows):
        features, n = _straight(mechanism, part) or (features, n)
    held = dataclasses.replace(settings, estimator="null-space", n_constraints=asked or n)
    candidate = learn_best((features,), there, held)
    if isinstance(features, PlaceRows) and candidate.estimate.table.verdict(candidate.estimate.n_rows) == "none":
        # a contact that gives way does not determine few rows among many: plainer ones it does
        candidate = learn_best(part.asked, there, held)
    if evidence is None or candidate.samples.features is not rows:
        evidence = _evidence(candidate.samples.features, part, settings)
    return Answer(part, candidate, evidence, mechanism, _doubts(evidence, candidate.estimate.n_rows, asked))


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


def _undivided(part: Part, settings: LearnerSettings, *, elsewhere: bool) -> Answer:
    """The constraint of recordings that nothing explains: one that the demonstrator imposes, or too few recordings.

    Raises:
        NotIdentifiableError: There is none.
    """
    candidate = learn_best(part.feature_maps, part, settings)
    if candidate.estimate.name != "null-space":
        return Answer(part, candidate, None, None, ())
    evidence, s = _evidence(candidate.samples.features, part, settings), candidate.estimate.n_rows
    answer = Answer(part, candidate, evidence, None, _doubts(evidence, s, settings.n_constraints))
    if settings.n_constraints is not None or not evidence.strengths or (elsewhere and evidence.n_rows == s):
        return answer
    if evidence.enough:
        unused = f"{counted(s, 'direction')}, gap {candidate.estimate.gap:.3g}"
        raise _no_evidence(
            candidate.estimate,
            f"nothing shows that what the motion leaves unused ({unused}) is held rather than never tried: "
            f"{evidence.sentence()}",
        )
    said = (
        f"record 3, better 5, that differ: {counted(evidence.n_trajectories, 'recording')} cannot show that "
        f"{counted(s, 'row')} held rather than never tried"
    )
    mechanism = _mechanism(part, settings) if evidence.n_rows else None
    return dataclasses.replace(answer, mechanism=mechanism, warnings=(said,))


def _evidence(features: FeatureMap, part: Part, settings: LearnerSettings) -> RowEvidence:
    pieces = [part.demonstrations[k] for k in once_each(part.stretches, part.demonstrations)]
    rng = np.random.default_rng(settings.seed)
    tested = recombination_test(features, pieces, rng, part.choices, settings.strength)
    return dataclasses.replace(tested, firm=part.firm)


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
    motion = [part.demonstrations[i] for i in evenly(len(part.demonstrations), MOST_PATHS).tolist()]
    rng = np.random.default_rng(settings.seed)
    try:
        held = None if part.found is None else (part.feature_maps[0], part.found)
        believed = {"strength": settings.strength, "arm": settings.arm}
        return find_mechanism(maps[0].robot, maps[0].frame.name, motion, rng, held=held, **believed)
    except NotIdentifiableError:
        return None


def mechanism_rows(
    found: MechanismFit | None, feature_maps: Sequence[FeatureMap], demonstrations: Demonstrations
) -> MechanismRows | CurveRows | None:
    """The rows of a mechanism that depend on the place, in the axes asked for and in which the arm can move.

    Rows across the axis about which alone the hand may turn are constant, but the path of the hand tells that axis
    better than its velocity does where the hand sways: what sways to and fro has a large rate and a small angle.
    """
    if found is None or found.mechanism is None:
        return None
    features, mechanism = found.features, found.mechanism
    if isinstance(features, CurveRows):
        return features
    if isinstance(features, FrameJacobian) and mechanism.type == "held-orientation" and mechanism.axis is not None:
        # the rows across the axis
        features = MechanismRows(features.robot, features.frame.name, ("turn-1", "turn-2"), axis=mechanism.axis)
    if not isinstance(features, MechanismRows):
        return None
    units = {unit for f in feature_maps for unit in f.row_units if unit != "m^2/s"}
    names = tuple(n for n, unit in zip(features.row_names, features.row_units, strict=True) if unit in units)
    if units == {"m/s"}:
        names = POSITION_ROWS.get(mechanism.type, ())
    if names:
        # whether the arm can move the frame along each row, somewhere on the recordings
        few = np.concatenate([t.q[:: max(1, len(t) // 10)] for t in demonstrations])
        size = np.linalg.norm(features.with_rows(names, features.radius).batch(few), axis=2).max(axis=0)
        names = tuple(n for n, moves in zip(names, size > BLIND, strict=True) if moves)
    return features.with_rows(names, features.radius) if names else None
