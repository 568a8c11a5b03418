"""Learn the constraints of recordings, each with its evidence and warnings; the entry point is `learn`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap, sum_in_words
from manip_learn.constraint.features.frame_jacobian import PoseRows
from manip_learn.constraint.features.mechanism_rows import CurveRows, PlaceRows
from manip_learn.constraint.mechanism import ON_THE_AXIS, Grip, Mechanism
from manip_learn.errors import NotIdentifiableError, RecordingError, advice, counted, named, number_if_known
from manip_learn.learning.fit import LEVEL, Errors, Motion, RowFit, angles, draw_errors, group_fit, misfit, view_levels
from manip_learn.learning.gate import FEWEST, Gate, is_firm, simultaneous_joints
from manip_learn.learning.imposed import Imposed, learn_imposed
from manip_learn.learning.place import LOOSE, Placement, fit_shape, fit_whole, grip_kind, kind_of, locate, select_rows
from manip_learn.learning.repeats import drop_duplicates
from manip_learn.learning.search import SAME, Explanation, broken_energy, explain, lone_contacts
from manip_learn.learning.table import (
    CLEAR_GAP,
    LEAST_GAIN,
    LEAST_MOTION,
    MAX_RANGE,
    OVER_NOISE,
    REST_SPEED,
    SLIGHT,
    WEAK_GAP,
    Settings,
    Stretch,
    Table,
    View,
    excitation,
    row_maps,
    table_refusal,
)
from manip_learn.linalg import orthonormal_rows, row_space_angle
from manip_learn.recordings.load import Progress

DISAGREES = "does not agree with the other recordings"
IN_ONE_ONLY = "appears in one recording only"


Refusal = NotIdentifiableError | RecordingError


class Rows(NamedTuple):
    """Selection Lambda in a feature map, with the size of the motion along each direction.

    Attributes:
        features: Feature map Phi with p rows.
        selection: Lambda (s, p) with orthonormal rows.
        levels: Size of the motion along each direction, smallest first, shape (r,), see `fit.Levels`.
        gaps: Number of rows -> its gap, see `fit.Levels`.
    """

    features: FeatureMap
    selection: Float[np.ndarray, "s p"]
    levels: Float[np.ndarray, " r"]
    gaps: dict[int, float]


@dataclass(eq=False)
class Answer:
    """Learnt constraint with its evidence; the estimators and `complete_answer` fill in the attributes.

    Attributes:
        view, rows: View (samples in one feature map), and whitened rows (s, r) that constrain the position of the hand,
            or rows of the requested features.
        s, gap: Number of these rows, and its gap.
        stretches: Parts of the recordings in which the rows are constrained.
        levels, gaps: Sizes and gaps from `view_levels`.
        unexplained, held_out: Share of the motion energy that violates the rows, and the same on held-out recordings.
        estimator: Name of the estimator, see `ConstraintLearner`.
        evidence: `Evidence` from the recombination test for held rows; None otherwise.
        fit: `RowFit` to displacements for held rows; None otherwise.
        errors, uncertainty: Draws of the error of the last fit, and the parts of the uncertainty [deg].
        mu_uncertainty: Relative error of the manipulability, see `mu_error`; None if it is not known.
        placed, shape: Mechanism with axis and point; shape that replaces the rows if no constant rows fit.
        misfit: Result of `fit.misfit`: evidence for another shape [nats], and RMS residual [m or rad].
        over_noise: Residual of the rows over the noise of the recorded positions, a ratio.
        warnings: Warnings about this answer, in sentences.
        policy_model, policy_residuals: Null-space policy of self-imposed rows, see `LearningReport`.
        firm: Fit of rows of the hand's whole twist if the grip is firm; None otherwise.
        mechanism: Mechanism that constrains the hand; None if it is not known.
        uncertainty_deg: Angle error of the rows that is not exceeded in 68 % of cases [deg], at the positions of the
            hand; None if it is not known.
        contradiction: Result of a test that contradicts this answer, in words; empty if there is none.
        clear: True if both evidence and gap are clear.
        whole, asked: All rows that constrain the hand, and the rows in the requested axes.
    """

    view: View
    stretches: list[Stretch]
    rows: np.ndarray
    levels: np.ndarray
    gaps: dict[int, float]
    unexplained: float = 0.0
    held_out: float = float("nan")
    estimator: str = "null-space"
    evidence: Any = None
    fit: Any = None
    errors: Errors | None = None
    uncertainty: dict[str, float | None] = field(default_factory=dict)
    mu_uncertainty: float | None = None
    placed: Placement | None = None
    shape: Placement | CurveRows | None = None
    misfit: tuple[float, float] = (0.0, 0.0)
    over_noise: float = 0.0
    warnings: list[str] = field(default_factory=list)
    policy_model: str | None = None
    policy_residuals: dict[str, float] = field(default_factory=dict)
    firm: RowFit | None = None
    mechanism: Mechanism | None = None
    uncertainty_deg: float | None = None
    contradiction: str = ""
    clear: bool = False

    def __post_init__(self) -> None:
        self.whole = self.asked = Rows(self.view.features, self.view.selection(self.rows), self.levels, self.gaps)
        self.s, self.gap = len(self.rows), self.gaps.get(len(self.rows), 0.0)
        if self.evidence is None:
            return
        best, s = max(self.gaps, key=lambda s: self.gaps[s], default=self.s), self.evidence.n_rows
        if self.firm is not None:  # it has more rows than were tested
            pass
        elif s < self.s:
            self.contradiction = f"the recombination test supports {s}: {self.evidence.sentence()}"
        elif best < self.s and self.gaps[best] >= WEAK_GAP * self.gap:
            self.contradiction = f"the gap supports {best}: {self.gaps[best]:.3g} against {self.gap:.3g}"
        is_clear = self.evidence.verdict(self.s) == "clear" and self.gap >= CLEAR_GAP
        self.clear = is_clear and not self.contradiction


@dataclass(eq=False)
class Answers:
    """Learnt constraints of all recordings, and the stretches that belong to none of them.

    Attributes:
        answers: Constraints with their evidence, clear ones first.
        free: Stretches of free motion.
        unlearnt: Stretches from which nothing is learnt, each with the reason.
        odd: Index of a recording that does not agree with the others -> the difference in words.
        warnings: Warnings about all recordings.
    """

    answers: list[Answer]
    free: list[Stretch] = field(default_factory=list)
    unlearnt: list[tuple[Stretch, str]] = field(default_factory=list)
    odd: dict[int, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def _answer_driven_rows(imposed: Imposed) -> Answers:
    """Return the answer for rows that the demonstrator drives."""
    view, fit, wholes = imposed.view, imposed.fit, imposed.view.table.wholes
    names = ("held_out", "estimator", "uncertainty", "warnings", "policy_model", "policy_residuals")
    same = {name: getattr(imposed, name) for name in names}
    same["mu_uncertainty"] = imposed.errors and mu_error(view, fit, imposed.errors, view.table.inside(wholes))
    same["uncertainty_deg"] = float(np.linalg.norm([*imposed.uncertainty.values()])) if imposed.uncertainty else None
    return Answers([Answer(view, wholes, fit.rows, imposed.levels, imposed.gaps, fit.unexplained, **same)])


def add_advice(refusal: Refusal, table: Table, settings: Settings, facts: Sequence[str]) -> Refusal:
    """Add advice to the message of an error: the likeliest remedies first, then the reason and the facts.

    Args:
        refusal: Error from `learn`, without advice.
        table: Samples of all recordings.
        settings: Settings of the fit.
        facts: Facts about the recordings, in sentences.

    Returns:
        Error with the two likeliest remedies in its message; the same error if it is a `RecordingError`.
    """
    codes = ("weak-gap", "no-evidence", "no-freedom")  # other recordings may resolve these refusals
    if isinstance(refusal, RecordingError):
        return refusal
    causes = list(refusal.advice)
    if refusal.code in codes:
        if len(table.moved) < FEWEST:
            count = counted(len(table.moved), "recording")
            causes.append(f"record at least {FEWEST}, better 5, with different paths and postures, not {count}")
        if not settings.phases:
            allowed = advice(", or allow {}", "phases='auto'", "--phases auto")
            causes.append(f"cut the recordings to the contact, since no single constraint fits the whole{allowed}")
        if still := excitation(table.joint_names, table.u)[1]:
            locked = advice(" ({})", f"load_robot(..., locked={still})", " ".join(f"--lock {name}" for name in still))
            causes.append(f"move {named('joint', still)} too, or lock joints that should not move{locked}")
        if (fastest := float(np.max(np.abs(table.u)))) < REST_SPEED:
            causes.append(f"move faster: encoder noise hides a motion in which no joint exceeds {fastest:.2g} rad/s")
        if not causes:
            unsure = "no constraint is confirmed by several recordings"
            causes.append(f"record again, in contact, from other starts: {unsure}")
    why = "; ".join([str(refusal), *facts])
    text = f"{'; or '.join(causes[:2])}. {why[0].upper()}{why[1:]}" if causes else why
    return NotIdentifiableError(text, code=refusal.code, gaps=refusal.gaps, advice=(*causes, *facts))


def learn(table: Table, settings: Settings, progress: Progress) -> Answers | Refusal:
    """Learn the constraints of the recordings.

    Args:
        table: Samples of all recordings.
        settings: Settings of the fit.
        progress: Function that is called with the name of a stage and its completed share, 0 to 1.

    Returns:
        The learnt constraints, clear ones first. If there are none: the error that states why, not raised and without
        advice (see `add_advice`).
    """
    nv = table.u.shape[1]
    if other := {f.nv for f in settings.asked} - {nv}:
        return RecordingError(f"the recordings have {nv} joint velocities, the features {min(other)}", code="shape")
    requested = [v for v in (View(f, table) for f in settings.asked) if v.r]
    if not requested:
        why = "all rows are zero on these recordings: choose axes in which the frame can move"
        return NotIdentifiableError(why, code="zero-features")
    if refusal := table_refusal(table, requested[0].r, settings.n_constraints):
        return refusal
    if settings.estimator in ("joint", "separate"):
        imposed = learn_imposed(requested, settings)
        return _answer_driven_rows(imposed) if isinstance(imposed, Imposed) else imposed
    maps = [settings.asked, (), ()]
    if settings.mechanism and settings.n_constraints is None:
        curved = row_maps(settings.asked, table, "surface") if len(table.moved) >= FEWEST else ()
        maps = [row_maps(settings.asked, table, "place"), row_maps(settings.asked, table, "whole"), curved]
    first, whole, curved = ([v for v in (View(f, table) for f in some) if v.largest > 0] for some in maps)
    for rivals, searched in ((first, first), ([*first, *whole], whole), (curved, curved), (requested, requested)):
        for view in searched:
            view.tried = sum(rival.largest for rival in rivals)
    switch, gate = settings.switch if settings.phases else np.inf, Gate(settings.seed, settings.strength)
    # the place of the hand first; then its whole twist, if that does not explain; then curved surfaces
    out: Answers | NotIdentifiableError | None = None
    for share, searched in enumerate(([*first, *whole], whole if first else [], curved)):
        progress("searching", 0.2 * share)
        explanation = explain(searched, gate, switch, len(first) if searched[0] in first else 0) if searched else None
        if explanation is not None and explanation.hypotheses:
            progress("fitting", 0.2 * share + 0.1)
            now = _answer_parts(explanation, [*first, *whole, *curved], whole, gate, settings)
            out = out if out and isinstance(now, NotIdentifiableError) else now  # the first refusal
            if isinstance(out, Answers):
                break
    few = 0  # recordings with an answer that driven rows would not explain as well
    if isinstance(out, Answers) and (best := out.answers[0]):
        is_clear = best.evidence.verdict(best.s) == "clear" or (best.gap >= CLEAR_GAP and best.unexplained < 1e-4)
        few = is_clear * len({s.recording for a in out.answers for s in a.stretches})
    if settings.estimator == "auto" and len(table.moved) > 1 and 2 * few < len(table.moved):
        imposed = learn_imposed(requested, settings)
        if isinstance(imposed, Imposed):
            return _answer_driven_rows(imposed)
    out = out or _answer_whole(requested, gate, settings)
    if isinstance(out, Answers):
        out.answers = [complete_answer(a, settings) for a in out.answers]
    return out


# ------------------------------------------------------------------------------------------- recordings with parts


class _Part(NamedTuple):
    """Rows that a fit by displacements gave, where they are constrained, and the share of motion that violates them."""

    fit: RowFit
    share: float
    spans: list[Stretch]


def _fit_parts(explanation: Explanation, views: list[View], out: Answers, settings: Settings) -> list[_Part]:
    """Fit the hypotheses to displacements, separately for each place; report disagreeing recordings in `out`."""
    table, parts = explanation.views[0].table, list[_Part]()
    states = explanation.evaluate([v.all for v in explanation.views])[1]
    for k in np.argsort(-explanation.supports):
        h = explanation.hypotheses[k]
        view = explanation.views[h.view]
        all_spans = [view.trim(h.rows, s) for s in explanation.stretches(k + 1, states)]
        usual = np.median([s.end - s.start for s in all_spans]) if all_spans else 0.0
        # shorter stretches occur by chance
        all_spans = [s for s in all_spans if s.end - s.start >= 0.25 * usual and len(table.samples(s)) > 2]
        if not all_spans:
            continue
        alike = [v for v in views if v.turns == view.turns]
        spans = view.steady_stretches(h.rows, all_spans)
        fit = best_fit(alike, view, h.rows, spans, settings)
        if len(spans) < len(all_spans) and len(again := fit.view.steady_stretches(fit.rows, all_spans)) > len(spans):
            spans = again
            fit = best_fit(alike, fit.view, fit.rows, spans, settings)
        for s in (s for s in all_spans if s not in spans):
            out.odd[s.recording] = describe_difference(fit, [s], {x.recording for x in spans})
            out.unlearnt.append((s, DISAGREES))
        part = _Part(fit, h.scale[1], spans)
        for j, other in enumerate(parts):  # errors of the arm split one place into several hypotheses
            if both := _merge_same_place(other, part, settings):
                parts[j] = both
                break
        else:
            places = group_fit(fit)
            parts += [part] if len(places) == 1 else _split_places(part, places, out, settings)
    return parts


def angle_between(one: _Part | Answer, other: _Part | Answer) -> float:
    """Return the angle between the row spaces of two fits.

    Args:
        one: First answer, or part of one, with its fit.
        other: Second answer, or part of one, with its fit.

    Returns:
        Angle [rad]; infinite if the two have different features or different numbers of rows.
    """
    a, b, view = one.fit.rows, other.fit.rows, one.fit.view
    if view is not other.fit.view or len(a) != len(b):
        return np.inf
    return row_space_angle(view.selection(a), view.selection(b))


def _merge_same_place(one: _Part, other: _Part, settings: Settings) -> _Part | None:
    """Merge two parts of different recordings that share a place except for errors of the arm; None if they do not."""
    if angle_between(one, other) > 3.0 * SAME or {s.recording for s in one.spans} & {s.recording for s in other.spans}:
        return None
    spans = [*one.spans, *other.spans]
    both = best_fit([other.fit.view], other.fit.view, one.fit.rows, spans, settings)
    return _Part(both, other.share, spans) if len(group_fit(both)) == 1 else None


def _split_places(part: _Part, groups: list[set[int]], out: Answers, settings: Settings) -> list[_Part]:
    """Return the part for each place that several recordings share; report all other recordings in `out`."""
    (fit, _, spans), recordings = part, set(part.fit.motion.recs)

    def restrict(some: set[int]) -> _Part:
        """Return the part in some recordings.

        Args:
            some: Numbers of the recordings.
        """
        some_spans = [s for s in spans if s.recording in some]
        return part._replace(fit=best_fit([fit.view], fit.view, fit.rows, some_spans, settings), spans=some_spans)

    several = [g for g in groups if len(g) > 1]
    if 2 * sum(map(len, several)) <= len(recordings):
        last = max(recordings)
        places = f"{len(groups)} places in {counted(len(recordings), 'recording')}"
        stood = f"it is learnt where it stood in {fit.view.table.moved[last].name}"
        out.warnings.append(f"the mechanism was moved between recordings ({places}): {stood}")
        return [restrict({last})._replace(spans=spans)]
    parts = [restrict(g) for g in several]
    for s in (s for s in spans if not any(s.recording in g for g in several)):
        its_spans = [x for x in spans if x.recording == s.recording]
        out.odd[s.recording] = describe_difference(parts[0].fit, its_spans, several[0])
        out.unlearnt.append((s, DISAGREES))
    return parts


def _answer_parts(
    explanation: Explanation, views: list[View], whole: list[View], gate: Gate, settings: Settings
) -> Answers | NotIdentifiableError:
    """Return the answers for an explanation, with their common warnings; or the refusal of the first part."""
    table, out = explanation.views[0].table, Answers([])
    parts = _fit_parts(explanation, views, out, settings)
    results = [(part.spans, evaluate(part, gate, whole, settings)) for part in parts]
    out.answers = [a for _, a in results if isinstance(a, Answer)]
    refused = [(spans, a) for spans, a in results if isinstance(a, NotIdentifiableError)]
    if not out.answers:
        none = NotIdentifiableError("no contact is long enough to learn from", code="no-evidence")
        return refused[0][1] if refused else none
    out.answers.sort(key=lambda a: (not a.clear, a.gap < CLEAR_GAP))
    best = out.answers[0]
    if best.gap >= CLEAR_GAP and not settings.habits:
        for a in [a for a in out.answers if not a.clear and (best.clear or a.gap < CLEAR_GAP)]:
            out.answers.remove(a)
            out.unlearnt += [(s, "kept, not shown to be held") for s in a.stretches]
            text = f"{counted(a.s, 'row')} in {counted(len(a.stretches), 'stretch')} not learnt: they may"
            out.warnings.append(f"{text} only be habits of the demonstrator (gap {a.gap:.3g})")
    for spans, refusal in refused:
        out.warnings.append(f"a further constraint is not learnt: {refusal}")
        out.unlearnt += [(s, "a constraint in several recordings that could not be learnt") for s in spans]
    tasks = [{s.recording for s in a.stretches} for a in out.answers]
    if len(tasks) > 1 and not set.intersection(*tasks):
        sizes = " and ".join(counted(len(t), "recording") for t in tasks)
        out.warnings.append(f"the recordings show {len(tasks)} tasks, {sizes}: each constraint is learnt from its own")
    for i, (a, b) in enumerate(pairwise(out.answers), 1):
        if (angle := angle_between(a, b)) < 2.0 * SAME:
            difference = f"constraints {i} and {i + 1} differ by {np.degrees(angle):.1f} deg only"
            out.warnings.append(f"{difference}: kept apart, not averaged")
    _report_outliers(out, table)
    used = [s for a in out.answers for s in a.stretches] + [s for s, _ in out.unlearnt]
    if settings.phases and len(table.moved) > 1:
        places = [k for k, v in enumerate(explanation.views) if not v.turns and not v.curved]
        lone = lone_contacts(explanation, places, lambda view, s: gate.evidence(view, [s]).n_rows)
        lone = [s for s in lone if not any(overlap(s, other) for other in used)]
        out.unlearnt += [(s, IN_ONE_ONLY) for s in lone]
        used += lone
    out.free = explanation.stretches(0, np.where(table.inside(used), 1, 0))
    return out


def overlap(a: Stretch, b: Stretch) -> bool:
    """Return True if two stretches are of the same recording and overlap in time.

    Args:
        a: First stretch.
        b: Second stretch.
    """
    return a.recording == b.recording and a.start < b.end and b.start < a.end


def _report_outliers(out: Answers, table: Table) -> None:
    """Report recordings without a constraint that most show, and those with an interrupted contact, as by a slip."""
    stretches = [s for a in out.answers for s in a.stretches]
    missing = set(range(len(table.moved))) - {s.recording for s in stretches}
    for a in out.answers:
        numbers, view, motion = Counter(s.recording for s in a.stretches), a.view, a.fit.motion
        if len(numbers) >= max(2.0, 0.5 * len(table.moved)):
            for i in missing - set(out.odd):
                out.odd[i] = describe_difference(a.fit, [table.wholes[i]], set(numbers))
        usual = np.median([np.ptp(motion.y[p] @ a.rows.T, axis=0).max() for p in motion.parts])
        for x, y in pairwise(sorted(a.stretches)):
            gap = Stretch(x.recording, x.end, y.start)
            often = numbers[x.recording] > np.median([*numbers.values()])
            short = x.recording == y.recording and often and gap.end - gap.start <= 1.5
            if not short or any(overlap(s, gap) for s in stretches):
                continue
            way = view.way(table.inside([gap]), a.rows)
            if len(way) and np.ptp(way, axis=0).max() > 5.0 * usual:
                when = f"its contact is interrupted from {x.end:.2f} s to {y.start:.2f} s, as by a slip: "
                out.odd.setdefault(x.recording, when + describe_difference(a.fit, [gap], set(numbers)))


def describe_difference(fit: RowFit, spans: Sequence[Stretch], others: set[int]) -> str:
    """Describe in words how one recording moves along directions that are constrained in other recordings.

    Args:
        fit: Fit of the constrained rows to the other recordings.
        spans: Stretches of the one recording.
        others: Indices of the other recordings.

    Returns:
        Sentence with the motion [mm or mrad], its direction and the time at which it is fastest.
    """
    view, table = fit.view, fit.view.table
    rows, back = view.selection(fit.rows), np.linalg.pinv(view.W)
    inside = table.inside(spans)
    way = view.way(inside, rows @ back)
    worst = np.linalg.svd(way - way.mean(axis=0), full_matrices=False)[2][0]
    still, way = fit.motion.y @ (rows @ back).T @ worst, way @ worst
    extents = [np.ptp(still[p]) for p, j in zip(fit.motion.parts, fit.motion.recs, strict=True) if j in others]
    row, unit = worst @ rows, "mm (or mrad)" if view.turns else "mm"
    words = sum_in_words(row * np.sign(row[np.argmax(np.abs(row))]), view.features.row_names, "+.2f", 0.05)
    moves = f"{table.moved[spans[0].recording].name} moves {1e3 * np.ptp(way):.3g} {unit} along a direction ({words})"
    fastest = table.time[inside][np.argmax(np.abs(np.diff(way, prepend=way[0])) / table.weight[inside])]
    still = f"that {len(others)} others hold still (median {1e3 * np.median(extents):.2g})"
    return f"{moves} {still}, fastest at {fastest:.2f} s"


def best_fit(
    candidates: Sequence[View], view: View, rows: np.ndarray, spans: Sequence[Stretch], settings: Settings
) -> RowFit:
    """Fit constrained rows to displacements in several feature maps, and choose the simplest one that fits well.

    Args:
        candidates: Views (samples in different feature maps) to compare, simplest first.
        view: View in which `rows` are given.
        rows: Whitened rows (s, r) with which the fit starts.
        spans: Stretches in which the rows are constrained.
        settings: Settings of the fit.

    Returns:
        Among the fits that explain the stretches about as well as the best one, the first that is a known mechanism, or
        else the first.
    """
    s = settings.n_constraints or len(rows)

    def fitted(v: View) -> RowFit:
        start = rows if v is view and s == len(rows) else orthonormal_rows(view_levels(v, spans).directions[:s])
        return RowFit(Motion.of(v, spans, settings), start).best()

    fits = [fitted(v) for v in candidates if v is view or (v.largest >= s and not v.curved)]
    best = fits[0]
    for fit in fits[1:]:
        best = fit if fit.nats(best) > LEAST_GAIN else best
    curved = [v for v in candidates if v.curved and v is not view] if s == 1 else []
    gain, rms = misfit(best) if curved else (0.0, 0.0)
    if gain > LEAST_GAIN and rms > LEAST_MOTION:
        fit = fitted(curved[0])  # errors of the arm do not explain the residual: the shape is another one
        if fit.nats(best) > LEAST_GAIN and view_levels(curved[0], spans).gaps.get(s, 0.0) >= WEAK_GAP:
            return fit
    near = [f for f in fits if best.nats(f) < LEAST_GAIN]
    return next((f for f in near if kind_of(f)), near[0])


def evaluate(part: _Part, gate: Gate, whole: Sequence[View], settings: Settings) -> Answer | NotIdentifiableError:
    """Evaluate fitted rows: return the constraint with its evidence and warnings.

    Args:
        part: Rows that were fitted to displacements, and the stretches in which they are constrained.
        gate: Test that accepts or rejects rows by their evidence.
        whole: Views of the whole twist of the hand.
        settings: Settings of the fit.

    Returns:
        The answer; or, if the rows are not accepted, the error that states why, not raised.
    """
    fit, share, spans = part
    view, table, evidence = fit.view, fit.view.table, gate.evidence(fit.view, spans)
    if evidence.verdict(len(fit.rows)) != "clear" and is_firm(view, fit.rows, share, spans):
        evidence = replace(evidence, firm=len(fit.rows))
    first, firm = locate(fit, None) if settings.mechanism else None, None
    is_ball = first is not None and first.kind.type == "ball" and (first.mechanism.radius or 0.0) > ON_THE_AXIS
    if whole and fit.motion.J is not None and not is_ball:
        firm = fit_whole(whole, fit, [s for s in spans if s.recording in fit.motion.recs], settings, gate)
    sizes, _, gaps = view_levels(view, spans)
    a = Answer(view, spans, fit.rows, sizes, gaps, evidence=evidence, fit=fit, firm=firm)
    inside = table.inside(spans, learnt_from=True)
    broken, energy = np.sum(broken_energy(view.all, fit.rows[None])[inside]), np.sum(table.u[inside] ** 2)
    a.unexplained = a.held_out = float(broken / max(energy, 1e-300))
    e = np.concatenate([np.diff(table.moved[s.recording].q, 3, axis=0) for s in spans])
    noise = np.sqrt(np.median(e**2) / 0.455 / 20.0) if len(e) else 0.0  # of positions, by their third differences
    a.over_noise = float(np.sqrt(fit.variance) / (noise + 1e-6))
    if refusal := _refusal(a, settings):
        return refusal
    a.misfit = misfit(fit)
    last = firm or fit
    a.errors = draw_errors(last, settings.arm, np.random.default_rng(settings.seed))
    if a.errors is not None:
        both = (np.quantile(angles(last.rows, last.view.W, B), LEVEL) for B in (a.errors.noise, a.errors.arm))
        noise, arm = (x if x > 1e-9 else 0.0 for x in np.degrees([*both]).tolist())
        a.uncertainty, a.uncertainty_deg = {"noise": noise, "joint zeros": arm}, float(np.linalg.norm([noise, arm]))
        a.mu_uncertainty = mu_error(last.view, last, a.errors, inside)
    if settings.mechanism:
        a.placed = locate(last, a.errors)
        if firm is None and a.misfit[0] > LEAST_GAIN:
            a.shape = fit_shape(fit, a.placed, a.uncertainty.get("joint zeros") or 0.0)
            a.placed = a.placed if a.shape is None else a.shape if isinstance(a.shape, Placement) else None
    a.warnings += _warnings(a, settings)
    return a


def _refusal(a: Answer, settings: Settings) -> NotIdentifiableError | None:
    """Return the refusal of rows, or None."""
    nv, rows, why, code, remedies = a.view.table.u.shape[1], counted(a.s, "row"), "", "no-evidence", ()
    if a.s >= nv:
        return NotIdentifiableError(f"{a.s} constraints leave no null space for {nv} joints", code="no-freedom")
    if settings.n_constraints is not None or a.firm is not None:
        return None
    is_supported = a.evidence.n_pieces < FEWEST or a.evidence.verdict(a.s) == "clear"
    soft = a.gap < CLEAR_GAP and not is_at_one_place(a.fit)
    if a.gap < WEAK_GAP:
        why, code = f"no clear constraint: the gap is {a.gap:.2g} for {rows}, {WEAK_GAP:g} is needed", "weak-gap"
    elif a.over_noise > OVER_NOISE and (soft or (not is_supported and a.gap < 2.0 * CLEAR_GAP)):
        why = f"{rows} would be soft (gap {a.gap:.2g}), at a different place in each recording, as in free motion"
    elif a.contradiction:
        why = f"{rows} would explain the recordings, but {a.contradiction}"
        remedies = ("vary the path and the posture between recordings" + number_if_known(a.s),)
    return NotIdentifiableError(why, code=code, gaps=a.gaps, advice=remedies) if why else None


def _warnings(a: Answer, settings: Settings) -> list[str]:
    """Return warnings about an answer, in sentences."""
    few_joints = 1.6  # effective number of joints of a hand-guided arm with friction
    out, rows, fit, evidence, requested = list[str](), counted(a.s, "row"), a.fit, a.evidence, settings.n_constraints
    best = max(a.gaps, key=lambda s: a.gaps[s])
    if a.firm is None and requested is not None and best != a.s and a.gaps[best] >= WEAK_GAP:
        out.append(f"{rows} learnt, but the gap supports {best}: {a.gaps[best]:.3g} against {a.gap:.3g}")
    if a.firm is None and requested is None and best > a.s and a.gaps[best] >= WEAK_GAP * a.gap:
        more = counted(best - a.s, "further row")
        out.append(f"{more} constrained softly (gap {a.gaps[best]:.3g}): a habit, or a compliant contact")
    if a.unexplained > SLIGHT:
        share = f"{100 * a.unexplained:.2g} % of the motion's energy"
        out.append(f"{share} violates the constraint: it is soft, or the demonstrator drives the rows")
    if len(evidence.strengths) and evidence.n_rows < a.s:
        source = "asked for" if requested else "explain the recordings"
        out.append(f"{rows} {source}, the recombination test supports {evidence.n_rows}: {evidence.sentence()}")
    elif evidence.verdict(a.s) != "clear":
        out.append(f"weak evidence: {evidence.sentence()}")
    table = a.view.table
    each = [simultaneous_joints(table.u[table.samples(s)], table.noises[s.recording])[0] for s in a.stretches]
    together = np.median(each)
    if together < few_joints and table.u.shape[1] > 3:
        out.append(f"move all joints together: where {together:.1f} move at a time, friction looks like a constraint")
    if a.errors is not None and a.errors.beyond and settings.arm.zeros:
        off, ratio = f"offsets of {np.degrees(a.errors.beyond):.2g} degrees", a.errors.beyond / settings.arm.zeros
        off += f", or link errors of {1e3 * ratio * settings.arm.links:.2g} mm, explain the residual: {ratio:.0f} times"
        out.append(f"is this the robot that was recorded? Only joint {off} joint_offset_std and link_error_std")
    gain, rms = a.misfit
    leaves = f"the hand deviates from the best fit by {1e3 * rms:.2g} mm (or mrad)"
    if a.shape is not None:
        return out
    if rms > LEAST_MOTION and gain > LEAST_GAIN:
        out.append(f"{leaves} in the same way in all recordings: the true shape is different")
    elif rms > LEAST_MOTION and fit.inflation > 2.0 and a.over_noise > OVER_NOISE:
        out.append(f"{leaves}, {a.over_noise:.0f} times the encoder noise: it is compliant, or has another shape")
    if a.placed is not None and a.placed.kind.type == "line":
        span = float(np.linalg.norm(np.ptp(fit.motion.poses[:, :3, 3], axis=0)))
        # three standard deviations of the curvature of a parabola through evenly spaced samples
        bend = np.sqrt(fit.dof / fit.inflation) * span**2 / (3.0 * np.sqrt(720.0) * max(rms, 1e-12))
        if bend < MAX_RANGE:
            out.append(f"move it further than {1e3 * span:.2g} mm: a hinge at {bend:.2g} m or more would fit as well")
    if a.view.curved and kind_of(fit) is None:
        out.append("the mechanism is a curved surface of no simple kind: its rows are valid only where demonstrated")
    return out


def complete_answer(a: Answer, settings: Settings) -> Answer:
    """Complete an answer: its mechanism, grip, all rows of the hand, and the rows in the requested axes.

    Args:
        a: Answer from `evaluate`; it is modified.
        settings: Settings of the fit.

    Returns:
        The same answer `a`.
    """
    table, place, fit = a.view.table, a.placed, a.firm or a.fit
    view = fit.view
    if a.firm is not None:
        sizes, _, gaps = fit.motion.levels
        a.whole = Rows(view.features, view.selection(fit.rows), sizes, gaps)
    if place is not None:
        a.warnings += [place.doubt] if place.doubt else []
        kind, rms, apart = grip_kind(place, fit.motion)
        is_kept = rms < min(LOOSE, apart / WEAK_GAP)
        grip: Grip = "firm" if kind.orientation != "free" else "kept" if is_kept else "loose"
        gripped = replace(place.mechanism, grip=grip, orientation_rms=rms)
        a.mechanism = replace(gripped, orientation=kind.orientation, name=kind.name)
        a.placed = replace(place, kind=kind, mechanism=a.mechanism)
        # requested constant rows describe a knob completely
        is_knob = kind.kind == "hinge" and any(str(f) == str(view.features) for f in settings.asked)
        if not is_knob and (isinstance(view.features, PlaceRows) or a.firm or a.shape or grip == "firm"):
            features, selection = a.placed.rows(view)
            gaps = a.whole.gaps if a.firm is not None else {len(selection): a.gap}
            a.whole = a.whole._replace(features=features, selection=selection, gaps=gaps)
    if isinstance(a.shape, CurveRows):
        a.whole, a.mechanism = a.whole._replace(features=a.shape, selection=np.eye(2)), a.shape.mechanism(np.eye(2), {})
    if a.placed is not None and a.placed.off_deg is not None and len(a.whole.selection) == a.whole.features.n_rows:
        a.uncertainty_deg = a.placed.off_deg
    features, selection = select_rows(*a.whole[:2], a.placed, settings.asked, table.q)
    if features is a.whole.features and selection is a.whole.selection:
        a.asked = a.whole
    elif len(selection) == len(a.whole.selection) and features.n_rows >= a.whole.features.n_rows:
        a.asked = a.whole._replace(features=features, selection=selection)
    else:
        v = View(features, table)
        sizes, _, gaps = Motion.of(v, a.stretches, settings).levels if a.firm else view_levels(v, a.stretches)
        a.asked = Rows(features, selection, sizes, gaps)
    if (gap := a.asked.gaps.get(len(selection), 0.0)) < CLEAR_GAP:
        text = f"weak gap: {gap:.2g} for {counted(len(selection), 'row')}, {CLEAR_GAP:g} is clear"
        a.warnings.append(f"{text}; the constraint may be soft, or the recordings noisy")
    return a


def is_at_one_place(fit: RowFit) -> bool:
    """Return whether the constrained position coordinates have the same values in all recordings.

    Args:
        fit: Fit of the rows.

    Returns:
        True if the values differ between recordings by little more than they scatter within each. Also True for
        features that are no position coordinates along fixed axes, which are not tested.
    """
    f, motion = fit.view.features, fit.motion
    if not isinstance(f, PoseRows) or f.own_axes or not f.only_linear:
        return True
    along = motion.poses[:, [("x", "y", "z").index(n) for n in f.row_names], 3] @ fit.view.selection(fit.rows).T
    centres = np.array([along[p].mean(axis=0) for p in motion.parts])
    within = np.median([np.sqrt(np.mean((along[p] - c) ** 2)) for p, c in zip(motion.parts, centres, strict=True)])
    return float(np.sqrt(np.mean((centres - np.median(centres, axis=0)) ** 2))) <= OVER_NOISE * within


def mu_error(view: View, fit: Any, errors: Errors, inside: np.ndarray) -> float:
    """Return the relative error of the manipulability mu that is not exceeded in 68 % of draws and configurations.

    The error d log mu = tr(A^+ dA) - tr(Lambda^+ dLambda) is computed at up to 95 configurations.

    Args:
        view: View of the rows.
        fit: Fit with the whitened rows `rows` (s, r) and their orthonormal complement `perp`.
        errors: Draws of the error of the fit.
        inside: Mask (n,) of the samples to use.

    Returns:
        Relative error, without a unit.
    """
    few = np.flatnonzero(inside)
    few = few[:: max(1, len(few) // 48)]
    Lambda, beside = fit.rows @ view.W, fit.perp @ view.W
    Phi = view.Phi[few]
    back = np.linalg.pinv(fit.rows @ Phi, rcond=1e-6)
    by_rows = (fit.perp @ Phi @ back).transpose(0, 2, 1) - (beside @ np.linalg.pinv(Lambda)).T
    change = (errors.noise + errors.arm) @ by_rows.reshape(len(few), -1).T
    turned = view.features.batch_with_derivative(view.table.q[few])[1]
    by_zeros = np.einsum("nvp,npve->en", back @ Lambda, turned)
    return float(np.quantile(np.abs(change + errors.delta[:, : len(by_zeros)] @ by_zeros), LEVEL))


# --------------------------------------------------------------------------------------- recordings without parts


def _answer_whole(views: list[View], gate: Gate, settings: Settings) -> Answers | NotIdentifiableError:
    """Return the answer of too few recordings, or of a given number of rows; else the refusal."""
    table = views[0].table
    best: Any = None
    for v in [v for v in views if isinstance(v.features, PoseRows) or v is views[0]]:
        gaps = view_levels(v, table.wholes).gaps
        s = settings.n_constraints or max(gaps, key=lambda k: gaps[k])
        if s <= v.r and (best is None or gaps.get(s, 0.0) > 1.1 * best[2].get(best[1], 0.0)):
            best = v, s, gaps
    if best is None:
        why = f"{counted(settings.n_constraints or 1, 'constraint')} asked for, but the arm moves"
        return NotIdentifiableError(f"{why} {max(v.r for v in views)} rows here: ask for fewer", code="no-freedom")
    v, s, gaps = best
    gap = gaps.get(s, 0.0)
    if settings.n_constraints is None and (len(drop_duplicates(table, table.wholes)) >= FEWEST or gap < WEAK_GAP):
        unused = f"unused motion ({counted(s, 'direction')}, gap {gap:.3g}) is constrained, or was never exercised"
        why = f"cannot tell if the {unused}: {gate.evidence(v, table.wholes, 1.0).sentence()}"
        return NotIdentifiableError(why, code="no-evidence" if gap >= WEAK_GAP else "weak-gap", gaps=gaps)
    settings = replace(settings, n_constraints=s)
    fit = best_fit([v], v, np.eye(s, v.r), table.wholes, settings)
    a = evaluate(_Part(fit, 1.0, table.wholes), gate, (), settings)
    if isinstance(a, Answer) and len(table.moved) < FEWEST:
        few = f"{len(table.moved)} cannot show that {counted(s, 'row')} are constrained rather than never exercised"
        a.warnings.append(f"record 3 different motions, or better 5: {few}")
    return Answers([a]) if isinstance(a, Answer) else a
