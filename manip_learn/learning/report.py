"""The report: where each constraint holds, with the evidence for it; or why none was found, and what to try next."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, final

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.curve_rows import CurveRows
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.intention import intention_of
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.constraint.selection_in_words import describe, free_directions, known_to, said_by_rows
from manip_learn.constraint.shown import shown_by
from manip_learn.errors import (
    NotIdentifiableError,
    advice,
    counted,
    error_in_words,
    listed,
    named,
    number_if_known,
    printable,
)
from manip_learn.learning.answer import Answer
from manip_learn.learning.arm_errors import ArmErrors
from manip_learn.learning.checks import REST_SPEED, energy_shares
from manip_learn.learning.estimate import CLEAR_GAP
from manip_learn.learning.explanation.findings import IN_ONE_ONLY, Findings, Part, held_throughout
from manip_learn.learning.recombination import FEWEST_TRAJECTORIES, RowSupport
from manip_learn.learning.repeats import IndependentRecordings
from manip_learn.learning.samples import STILL_ENERGY
from manip_learn.learning.uncertainty import (
    PARTS,
    Uncertainty,
    mu_within_place,
    parts_in_words,
    total_deg,
    uncertainty_of,
)
from manip_learn.recordings.trajectory import Demonstrations, distinct_names, evenly
from manip_learn.robot import html_card

# recordings from which on nothing is said of their number: what several do by chance, five hardly do
_ENOUGH = 5
SPANS_SHOWN = 6  # of each constraint, in words
NO_ANSWER = "what several recordings show here could not be learnt"
MOST_NOTES = 20  # lines, one screen
# what a constraint file keeps of where its task was shown, evenly over all samples: the place and the reach of a drawer
# to a centimetre or two, in 10 kB
KEPT_POSTURES = 144
_PHASE_COLUMNS = ("recording", "from [s]", "until [s]", "constraint")
# what of a report goes into the constraint's file
PROVENANCE = set(
    "estimator kind gap uncertainty_deg uncertainty mu_uncertainty n_samples n_trajectories sentence warnings phases "
    "odd_trajectories mechanism evidence row_evidence held_out_residual n_constraints".split()
)
ADVICES_SAID = 2  # in the sentence, the likeliest ones; more would hide them
ADVISED = ("weak-gap", "no-evidence", "no-freedom")


class _Phase(NamedTuple):
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

    phases: tuple[_Phase, ...] = ()
    odd_trajectories: tuple[OddTrajectory, ...] = ()
    warnings: tuple[str, ...] = ()

    @staticmethod
    def of(answers: Sequence[Answer], findings: Findings, recordings: IndependentRecordings) -> RecordingOverview:
        """The phases with the names of the recordings, on the clocks of those that were given."""
        names, given = distinct_names(recordings.demonstrations), distinct_names(recordings.given)
        number = {id(answer.part): k for k, answer in enumerate(answers)}
        held = [(s, number.get(id(part)), NO_ANSWER) for part in findings.parts for s in part.stretches]
        beside = [*((s, None, "") for s in findings.free), *((s, None, why) for s, why in findings.unlearnt)]
        phases = []
        for s, constraint, why in sorted([*held, *beside], key=lambda x: (x[0].trajectory, x[0].start)):
            reason = why if constraint is None else ""
            phases += [_Phase(given[p.trajectory], p.start, p.end, constraint, reason) for p in recordings.places(s)]
        odd = dict(findings.odd)
        warnings = [*findings.warnings, *lone_contacts(findings, recordings)]
        if odd:
            listed = "; ".join(f"{names[i]}: {why}" for i, why in sorted(odd.items()))
            warnings.append(
                f"{len(odd)} of {len(names)} recordings do not agree with the others; what does not agree was "
                f"left out of the first constraint: {listed}"
            )
        return RecordingOverview(
            tuple(phases),
            tuple(OddTrajectory(names[i], printable(why)) for i, why in sorted(odd.items())),
            tuple(warnings),
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
        return tuple(map(printable, out))


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


@final
@dataclass(frozen=True, repr=False)
class LearningReport:
    """What was learnt, and why it should be believed.

    Attributes:
        sentence: The result in words.
        estimator: `"null-space"`, `"joint"` or `"separate"`.
        kind: `"motion-constrained"` (b = 0: the world holds the rows) or `"self-imposed"` (the demonstrator moves
            them).
        n_constraints: Number of rows s.
        row_names: Names of the feature rows.
        reference: `"world"`, `"local"`, or None for features without a frame.
        free_directions: Unit vectors over the rows that the constraint leaves free.
        gap: Ratio that supports n_constraints; 10 and above is clear, below 3 says little (joint estimator: 1.5).
        gap_table: Number of rows -> gap.
        levels: Null-space and separate estimator: root mean square of the motion along each whitened direction, least
            first, relative to a motion that is equally strong in all joints [1]. Empty for the joint estimator.
        energy_fraction: Share of the motion's energy that breaks A u = 0, for the best A of n_constraints rows.
        held_out_residual: Root of the share of energy that is not explained, on trajectories that were left out.
        uncertainty_deg: In 68 % of cases the row space is within this angle of the true one: the root of the sum of
            the squares of the parts in `uncertainty`; None with a single trajectory or where there is only one
            possible row space. A base that stands turned turns all recordings alike, which none of them shows: it is
            not included.
        excitation: Joint name -> its share of the motion's energy.
        policy_model: Joint estimator: what the data determine of the null-space policy, or the model asked for.
        policy_residuals: Joint estimator: model -> held-out share of unexplained energy.
        n_samples, n_trajectories: What was learnt from.
        seconds: Time for the fit [s].
        notes: What was done to the recordings.
        warnings: What should make you careful.
        row_evidence: Evidence for each row, most firmly held first; empty where the demonstrator moves the rows.
        evidence: The same in words.
        phases: Stretches of the recordings, each held by a constraint or free.
        odd_trajectories: Recordings that do not agree with the others, and why.
        mechanism: What holds the hand, if that was found out.
        uncertainty: The parts of `uncertainty_deg` [deg]: `"noise"`, the scatter over trajectories (bootstrap);
            `"joint zeros"`, what the residual says of constant errors of the joints' zeros (null-space estimator);
            `"policy"`, the part of the policy that the data leave open (joint estimator, where its parameters are
            integrated out). None where a part does not apply.
        mu_uncertainty: In 68 % of cases, at the postures that were shown, the manipulability of the true constraint is
            within this share of the learnt one's; None with a single trajectory.
    """

    sentence: str
    estimator: str
    kind: str
    n_constraints: int
    row_names: tuple[str, ...]
    reference: str | None
    free_directions: tuple[tuple[float, ...], ...]
    gap: float
    gap_table: dict[int, float]
    levels: tuple[float, ...]
    energy_fraction: float
    held_out_residual: float
    uncertainty_deg: float | None
    excitation: dict[str, float]
    policy_model: str | None
    policy_residuals: dict[str, float]
    n_samples: int
    n_trajectories: int
    seconds: float
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    row_evidence: tuple[RowSupport, ...] = ()
    evidence: str = ""
    phases: tuple[_Phase, ...] = ()
    odd_trajectories: tuple[OddTrajectory, ...] = ()
    mechanism: Mechanism | None = None
    uncertainty: Uncertainty = field(default_factory=lambda: dict.fromkeys(PARTS))
    mu_uncertainty: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, for JSON; None where there is no number."""
        content = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        for name in ("phases", "odd_trajectories", "row_evidence"):
            content[name] = [entry._asdict() for entry in content[name]]
        content["uncertainty"] = dict(self.uncertainty)
        content["mechanism"] = None if self.mechanism is None else self.mechanism.to_dict()
        return _plain(content)

    def __str__(self) -> str:
        return "\n".join([self.sentence, *(f"warning: {w}" for w in self.warnings)])

    def __repr__(self) -> str:
        warned = f", {counted(len(self.warnings), 'warning')}" if self.warnings else ""
        return f"LearningReport({self.sentence} Gap {self.gap:.3g}, {counted(self.n_samples, 'sample')}{warned})"

    def _repr_html_(self) -> str:
        phases = [
            (printable(name), f"{start:.2f}", f"{end:.2f}", "free" if held is None else held + 1)
            for name, start, end, held, _ in self.phases
        ]
        return html_card.card(
            "What was learnt",
            html_card.sentence(self.sentence),
            html_card.warnings(self.warnings),
            html_card.facts(self._facts()),
            html_card.bars(
                [(f"{'held' if i < self.n_constraints else 'free'}, {x:.2g}", x) for i, x in enumerate(self.levels)],
                "how much the recordings move along each direction, by powers of ten",
            ),
            html_card.folded(
                "Gap for each number of rows",
                html_card.table(("rows", "gap"), [(n, float(gap)) for n, gap in self.gap_table.items()]),
            ),
            html_card.folded(f"Phases ({len(self.phases)})", html_card.table(_PHASE_COLUMNS, phases)),
            html_card.folded(
                f"Recordings that do not agree ({len(self.odd_trajectories)})",
                html_card.table(("recording", "why"), [tuple(map(printable, odd)) for odd in self.odd_trajectories]),
            ),
            html_card.folded("Notes", "".join(map(html_card.sentence, self.notes))),
        )

    def _facts(self) -> list[tuple[str, object]]:
        """Name -> value in words, with units and what would be good; None where there is nothing to say."""
        residual = self.held_out_residual
        unexplained = f"{100 * residual:.2g} % of the motion on recordings that were left out"
        return [
            ("rows", f"{self.n_constraints} of {len(self.row_names)} ({printable(' '.join(self.row_names))})"),
            ("reference frame", self.reference),
            ("estimator", f"{self.estimator} ({self.kind})"),
            ("gap", f"{self.gap:.3g} (a ratio; {CLEAR_GAP:g} is clear)"),
            ("unexplained", unexplained if math.isfinite(residual) else None),
            ("uncertainty", self.known_to() or None),
            ("mechanism", self.mechanism_in_words() or None),
            (
                "learnt from",
                f"{counted(self.n_samples, 'sample')} of {counted(self.n_trajectories, 'recording')} "
                f"in {self.seconds:.2g} s",
            ),
        ]

    def known_to(self) -> str:
        """The uncertainty in words, as in the sentence: which quantity is known how well; empty if none is."""
        said = known_to(self.uncertainty_deg, self.mechanism, self._is_told)
        mu = "" if self.mu_uncertainty is None else f", mu to {error_in_words(100.0 * self.mu_uncertainty, '%')}"
        return f"{said}{mu} (68 %, {parts_in_words(self.uncertainty, self.reference)})" if said else ""

    def mechanism_in_words(self) -> str:
        """What holds the hand, without the place if the sentence tells it; empty if nothing was found."""
        m = self.mechanism
        return "" if m is None else f"{m.noun}; {m.turns}" if self._is_told else m.sentence

    @property
    def _is_told(self) -> bool:
        free = np.reshape(self.free_directions, (-1, len(self.row_names)))
        return said_by_rows(self.mechanism, self.row_names, self.reference, free)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def build_report(
    answer: Answer,
    overview: RecordingOverview,
    joint_names: tuple[str, ...],
    arm: ArmErrors,
    started: float,
    made: Mapping[str, Any],
) -> tuple[Constraint, LearningReport]:
    """The constraint, and the evidence for it; the fit started when the clock `time.perf_counter` was at `started`.

    The constraint's provenance says what it was `made` from.

    Raises:
        NotIdentifiableError: A joint estimate that is known too badly for an answer.
    """
    best, evidence, found = answer.candidate, answer.evidence, answer.mechanism
    samples, estimate, warnings = best.samples, best.estimate, list(best.warnings)
    features, mechanism = samples.features, found and found.mechanism
    selection = answer.selection
    uncertainty, mu_uncertainty = uncertainty_of(samples, estimate, best.rng, arm)
    uncertainty_deg = total_deg(uncertainty)
    if isinstance(features, MechanismRows | CurveRows) and len(selection) == features.n_rows:
        selection = np.eye(features.n_rows)  # all of the rows: any basis of theirs will do, so the plainest
        off = None if found is None else found.errors
        if off is not None and isinstance(features, MechanismRows):
            mu_uncertainty = mu_within_place(features, samples.q, off.numbers, off.radius, off.arm, arm)
    used = np.linalg.norm(samples.whitening, axis=0) > 0.0
    unused = [n for n, u in zip(features.row_names, used, strict=True) if not u]
    if unused:
        warnings.append(f"always zero for this robot and frame, so left out: {listed(unused)}")
    if (n := len(answer.part.demonstrations)) < _ENOUGH:
        count = "one trajectory" if n == 1 else f"{n} trajectories"
        warnings.append(f"only {count}: evidence from so few is thin; record {_ENOUGH} or more")
    notes = tuple(dict.fromkeys(map(printable, answer.part.demonstrations.notes)))
    if len(notes) > MOST_NOTES:  # of thousands of files, not thousands of sentences
        notes = (*notes[:MOST_NOTES], f"and {len(notes) - MOST_NOTES} more notes of this kind")
    kind = "motion-constrained" if estimate.name == "null-space" else "self-imposed"
    free = free_directions(selection, used)
    report = LearningReport(
        sentence=printable(describe(kind, free, features, used, uncertainty_deg, mechanism)),
        estimator=estimate.name,
        kind=kind,
        n_constraints=selection.shape[0],
        row_names=features.row_names,
        reference=getattr(features, "reference", None),
        free_directions=tuple(tuple(float(c) for c in row) for row in free),
        gap=estimate.gap,
        gap_table=estimate.table.by_count,
        levels=tuple(float(level) for level in estimate.levels),
        energy_fraction=float(estimate.unexplained),
        held_out_residual=float(np.sqrt(estimate.held_out)),
        uncertainty_deg=uncertainty_deg,
        excitation=dict(
            zip(joint_names, energy_shares(np.einsum("nv,nv->v", samples.u, samples.u)).tolist(), strict=True)
        ),
        policy_model=estimate.policy_model,
        policy_residuals=estimate.policy_residuals,
        n_samples=len(samples),
        n_trajectories=samples.n_trajectories,
        seconds=time.perf_counter() - started,
        notes=notes,
        warnings=tuple(
            map(printable, (*warnings, *answer.warnings, *(found.warnings if found else ()), *overview.warnings))
        ),
        row_evidence=() if evidence is None else evidence.rows,
        evidence="" if evidence is None else evidence.sentence(),
        phases=overview.phases,
        odd_trajectories=overview.odd_trajectories,
        mechanism=mechanism,
        uncertainty=uncertainty,
        mu_uncertainty=mu_uncertainty,
    )
    provenance = {key: value for key, value in report.to_dict().items() if key in PROVENANCE}
    provenance["made"] = dict(made)
    kept = evenly(len(samples), KEPT_POSTURES)
    provenance["postures"] = np.round(samples.q[kept], 5).tolist()
    provenance["posture_trajectories"] = samples.trajectory[kept].tolist()
    if kind == "motion-constrained":
        mechanism = Constraint(selection, features, provenance).mechanism
        part, whole = answer.part, answer.part.source
        contacts = (
            part.demonstrations if whole is None else [whole[s.trajectory][s.start : s.end] for s in part.stretches]
        )
        shown = shown_by(features, selection, mechanism, contacts)  # to their ends, which rows are not learnt from
        provenance["shown"] = None if shown is None else shown.to_dict()
    else:
        recordings = [(t.q, t.u) for t in answer.part.demonstrations if t.u is not None]
        meant = intention_of(features, selection, recordings)
        provenance["intention"] = None if meant is None else meant.to_dict()
    return Constraint(selection, features, provenance), report


def advise(
    refusal: NotIdentifiableError,
    everything: Part,
    findings: Findings,
    fits: Callable[[FeatureMap], bool],
    *,
    recordings: IndependentRecordings,
    phases: str,
) -> NotIdentifiableError:
    """The refusal with its likely causes and the next thing to try for each; others than those of the evidence pass.

    Other rows are advised if the recordings fit them (`fits`): if they are answered, as by `ConstraintLearner.fit`. Of
    the recordings, the independent ones are learnt from; phases are looked for (`"auto"`) or not (`"off"`).
    """
    if refusal.code not in ADVISED:
        return _advised(refusal, (), recordings.warnings) if recordings.warnings else refusal
    table, names = everything.table, everything.demonstrations.joint_names
    n, wanted = len(recordings.demonstrations), f"record at least {FEWEST_TRAJECTORIES}, better 5, that differ"
    few = f"{wanted} in way and posture, not {counted(n, 'recording')}"
    speed, shares = float(np.max(np.abs(table.u))), energy_shares(np.sum(table.u**2, axis=0))
    slow = f"move faster, noise hides a motion in which no joint exceeds {speed:.2g} rad/s"
    still = [name for name, share in zip(names, shares, strict=True) if share < STILL_ENERGY] if speed else []
    locked = advice(" ({})", f"load_robot(..., locked={still})", " ".join(f"--lock {name}" for name in still))
    causes = [
        *([few] if n < FEWEST_TRAJECTORIES else []),
        *lone_contacts(findings, recordings),
        *_several_phases(findings, everything.demonstrations, phases),
        *_other_rows(everything, fits),
        *([f"move {named('joint', still)} too, or lock what shall hardly move{locked}"] if still else []),
        *([slow] if speed < REST_SPEED else []),
    ]
    # where something seems held, or nearly so: each recording with its times
    given, times = distinct_names(recordings.given), dict[str, list[str]]()
    for place in (p for s in findings.held or findings.refused for p in recordings.places(s)):
        times.setdefault(given[place.trajectory], []).append(f"{place.start:.1f} to {place.end:.1f} s")
    what = "what seems held" if findings.held else "the likeliest contact, if anything was touched"
    spans = ", ".join(f"{name} {listed(of_one)}" for name, of_one in times.items())
    facts = [*recordings.warnings, *([f"{what}: {spans}"] if spans else [])]
    if not causes and refusal.code == "weak-gap":  # what usually helps
        causes, facts = ["record more varied motions, try other axes or the other reference" + number_if_known(2)], []
    return _advised(refusal, causes, facts if causes else ())


def _advised(refusal: NotIdentifiableError, causes: Sequence[str], facts: Sequence[str] = ()) -> NotIdentifiableError:
    """What to do, then why and the facts, in two sentences; the first advices are said, all are kept."""
    everything = (*refusal.advice, *causes)
    why = "; ".join([str(refusal), *facts])
    said = f"{'; or '.join(everything[:ADVICES_SAID])}. {why[0].upper()}{why[1:]}" if everything else why
    return NotIdentifiableError(said, code=refusal.code, gaps=refusal.gaps, advice=(*everything, *facts))


def _several_phases(findings: Findings, demonstrations: Demonstrations, phases: str) -> list[str]:
    whole = ", since no single constraint fits {} as a whole"
    if phases == "off":
        allowed = advice(", or allow {}", "phases='auto'", "--phases auto")
        return ["cut the recordings to the contact" + whole.format("them") + allowed]
    spans = {(s.trajectory, s.start, s.end) for s in findings.refused}
    is_whole = all((i, float(t.time[0]), float(t.time[-1])) in spans for i, t in enumerate(demonstrations))
    if findings.unlearnt or is_whole:
        return []
    if findings.held:
        return ["cut the recordings more closely to what seems held, each stretch in a file of its own"]
    if len(demonstrations) < 2:
        how = advice(" with {}", "trajectory[start:until]", "--from and --until")
        return ["cut the recording to the contact" + how + whole.format("it")]
    how = advice(" ({})", "trajectory[start:until]", "--from and --until")
    unconfirmed = ", for no stretch of them obeys a constraint that several confirm, as in free motion"
    return ["cut the recordings to the contact" + how + unconfirmed]


def _other_rows(everything: Part, fits: Callable[[FeatureMap], bool]) -> list[str]:
    """Whether rows that were not asked for are held."""
    first = everything.asked[0]
    if not isinstance(first, FrameJacobian) or len(everything.demonstrations) < 2:
        return []
    tried = {(f.row_names, f.reference) for f in everything.asked if isinstance(f, FrameJacobian)}
    for axes in ("xyz", "rotation", "pose"):
        for reference in ("world", "local"):
            other = FrameJacobian(first.robot, first.frame.name, axes, reference)
            # few of those that stay still are found to be held
            is_new = (other.row_names, reference) not in tried
            if is_new and held_throughout([other], everything.table) and fits(other):
                python, flags = f"axes={axes!r}, reference={reference!r}", f"--axes {axes} --reference {reference}"
                return [f"try other rows{advice(', {}', python, flags)}, with which one constraint does fit"]
    return []
