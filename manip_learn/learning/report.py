"""The evidence that comes with a learnt constraint."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.constraint.selection_in_words import describe, free_directions, known_to, said_by_rows
from manip_learn.errors import counted, listed
from manip_learn.learning.answer import Answer
from manip_learn.learning.deciding import CLEAR_GAP
from manip_learn.learning.effort_witness import EffortWitness, effort_witness
from manip_learn.learning.excitation import energy_shares
from manip_learn.learning.overview import OddTrajectory, Phase, RecordingOverview
from manip_learn.learning.recombination import RowSupport
from manip_learn.learning.uncertainty import PARTS, Uncertainty, in_words, total_deg
from manip_learn.recordings.demonstrations import distinct_names
from manip_learn.recordings.preprocessing import evenly
from manip_learn.robot import html_card

MOST_NOTES = 20
# what a constraint file keeps of where its task was shown, evenly over all samples: the place and the reach of a drawer
# to a centimetre or two, in 10 kB
KEPT_POSTURES = 144
_PHASE_COLUMNS = ("recording", "from [s]", "until [s]", "constraint")
# what of a report goes into the constraint's file
PROVENANCE = set(
    "estimator kind gap uncertainty_deg uncertainty n_samples n_trajectories sentence warnings phases odd_trajectories "
    "mechanism evidence row_evidence held_out_residual n_constraints".split()
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
            first, relative to a motion that is equally strong in all joints [1]; of more than 16,384 samples, those
            learnt from directly. Empty for the joint estimator.
        energy_fraction: Share of the motion's energy that breaks A u = 0, for the best A of n_constraints rows.
        held_out_residual: Root of the share of energy that is not explained, on trajectories that were left out.
        uncertainty_deg: In 68 % of cases the row space is within this angle of the true one: the root of the sum of
            the squares of the parts in `uncertainty`; None with a single trajectory or where there is only one
            possible row space. A base that stands turned turns all recordings alike, which none of them shows: it is
            not included.
        excitation: Joint name -> its share of the motion's energy.
        policy_model: Joint estimator: the model of the null-space policy.
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
            `"policy"`, what is not known of the policy (joint estimator, where its parameters are integrated out). None
            where a part does not apply.
        effort: What recorded efforts say of the held rows, a witness that the motion knows nothing of; None where none
            were recorded, or nothing can be told from them (see `effort_witness`).
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
    phases: tuple[Phase, ...] = ()
    odd_trajectories: tuple[OddTrajectory, ...] = ()
    mechanism: Mechanism | None = None
    uncertainty: Uncertainty = field(default_factory=lambda: dict.fromkeys(PARTS))
    effort: EffortWitness | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, for JSON; None where there is no number."""
        content = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        for name in ("phases", "odd_trajectories", "row_evidence"):
            content[name] = [entry._asdict() for entry in content[name]]
        content["uncertainty"] = dict(self.uncertainty)
        content["effort"] = None if self.effort is None else dataclasses.asdict(self.effort)
        content["mechanism"] = None if self.mechanism is None else self.mechanism.to_dict()
        return _plain(content)

    def __str__(self) -> str:
        lines = [self.sentence]
        lines += [f"warning: {w}" for w in self.warnings]
        return "\n".join(lines)

    def __repr__(self) -> str:
        warned = f", {counted(len(self.warnings), 'warning')}" if self.warnings else ""
        return f"LearningReport({self.sentence} Gap {self.gap:.3g}, {counted(self.n_samples, 'sample')}{warned})"

    def _repr_html_(self) -> str:
        return html_card.card(
            "What was learnt",
            html_card.sentence(self.sentence),
            html_card.warnings(self.warnings),
            html_card.facts(self._facts()),
            html_card.folded(
                "Gap for each number of rows",
                html_card.table(("rows", "gap"), [(n, float(gap)) for n, gap in self.gap_table.items()]),
            ),
            html_card.folded(f"Phases ({len(self.phases)})", html_card.table(_PHASE_COLUMNS, self._phase_rows())),
            html_card.folded(
                f"Recordings that do not agree ({len(self.odd_trajectories)})",
                html_card.table(("recording", "why"), self.odd_trajectories),
            ),
            html_card.folded("Notes", "".join(map(html_card.sentence, self.notes))),
        )

    def _facts(self) -> list[tuple[str, object]]:
        """Name -> value in words, with units and what would be good; None where there is nothing to say."""
        residual = self.held_out_residual
        unexplained = f"{100 * residual:.2g} % of the motion on recordings that were left out"
        return [
            ("rows", f"{self.n_constraints} of {len(self.row_names)} ({' '.join(self.row_names)})"),
            ("reference frame", self.reference),
            ("estimator", f"{self.estimator} ({self.kind})"),
            ("gap", f"{self.gap:.3g} (a ratio; {CLEAR_GAP:g} is clear)"),
            ("unexplained", unexplained if math.isfinite(residual) else None),
            ("uncertainty", self.known_to() or None),
            ("effort", None if self.effort is None else self.effort.sentence()),
            ("mechanism", self.mechanism_in_words() or None),
            (
                "learnt from",
                f"{counted(self.n_samples, 'sample')} of {counted(self.n_trajectories, 'recording')} "
                f"in {self.seconds:.2g} s",
            ),
        ]

    def known_to(self) -> str:
        """The uncertainty in words, as in the sentence: what is known how well; empty if nothing is known of it."""
        said = known_to(self.uncertainty_deg, self.mechanism, self._is_told)
        return f"{said} (68 %, {in_words(self.uncertainty, self.reference)})" if said else ""

    def mechanism_in_words(self) -> str:
        """What holds the hand, without the place if the sentence tells it; empty if nothing was found."""
        m = self.mechanism
        return "" if m is None else f"{m.type}; {m.turns}" if self._is_told else m.sentence

    @property
    def _is_told(self) -> bool:
        return said_by_rows(self.mechanism, self.row_names, self.reference, np.array(self.free_directions))

    def _phase_rows(self) -> list[tuple[object, ...]]:
        return [
            (p.trajectory, f"{p.start:.2f}", f"{p.end:.2f}", "free" if p.constraint is None else p.constraint + 1)
            for p in self.phases
        ]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def build_report(
    answer: Answer, overview: RecordingOverview, joint_names: tuple[str, ...], uncertainty: Uncertainty, seconds: float
) -> tuple[Constraint, LearningReport]:
    """The constraint, and the evidence for it.

    Args:
        answer: The candidate chosen, with its evidence and mechanism where they were looked for.
        overview: What the recordings show as a whole.
        joint_names: One per velocity.
        uncertainty: Parts of the angle of the row space [deg], see `uncertainty_of`.
        seconds: Time for the fit [s].
    """
    best, data, evidence, found = answer.candidate, answer.data, answer.evidence, answer.mechanism
    samples, estimate, warnings = best.samples, best.estimate, list(best.warnings)
    features, uncertainty_deg, mechanism = samples.features, total_deg(uncertainty), found and found.mechanism
    selection = samples.selection(estimate.whitened_selection)
    if isinstance(features, MechanismRows) and len(selection) == features.n_rows:
        selection = np.eye(features.n_rows)  # all of the rows: any basis of theirs will do, so the plainest
    used = np.linalg.norm(samples.whitening, axis=0) > 0.0
    unused = [n for n, u in zip(features.row_names, used, strict=True) if not u]
    if unused:
        warnings.append(f"always zero for this robot and frame, so left out: {listed(unused)}")
    kind = "motion-constrained" if estimate.name == "null-space" else "self-imposed"
    free = free_directions(selection, used)
    report = LearningReport(
        sentence=describe(kind, free, features, used, uncertainty_deg, mechanism),
        estimator=estimate.name,
        kind=kind,
        n_constraints=selection.shape[0],
        row_names=features.row_names,
        reference=getattr(features, "reference", None),
        free_directions=tuple(tuple(float(c) for c in row) for row in free),
        gap=estimate.gap,
        gap_table=dict(zip(estimate.table.counts, estimate.table.gaps, strict=True)),
        levels=tuple(float(level) for level in estimate.levels),
        energy_fraction=float(estimate.unexplained),
        held_out_residual=float(np.sqrt(estimate.held_out)),
        uncertainty_deg=uncertainty_deg,
        excitation=dict(zip(joint_names, energy_shares(data.squares).tolist(), strict=True)),
        policy_model=estimate.policy_model,
        policy_residuals=estimate.policy_residuals,
        n_samples=data.n_samples,
        n_trajectories=data.n_trajectories,
        seconds=seconds,
        notes=_few_notes(data.notes),
        warnings=(*warnings, *answer.warnings, *(found.warnings if found else ()), *overview.warnings),
        row_evidence=() if evidence is None else evidence.rows,
        evidence="" if evidence is None else evidence.sentence(),
        phases=overview.phases,
        odd_trajectories=overview.odd_trajectories,
        mechanism=mechanism,
        uncertainty=uncertainty,
        effort=_effort(answer, overview, selection) if kind == "motion-constrained" else None,
    )
    provenance = {key: value for key, value in report.to_dict().items() if key in PROVENANCE}
    kept = evenly(len(data.q), KEPT_POSTURES)
    provenance["postures"] = np.round(data.q[kept], 5).tolist()
    provenance["posture_trajectories"] = data.trajectory[kept].tolist()
    return Constraint(selection, features, provenance), report


def _effort(answer: Answer, overview: RecordingOverview, selection: np.ndarray) -> EffortWitness | None:
    """Of the contact from which was learnt, beside the free stretches of the same recordings."""
    if answer.part.source is None:
        return None
    derived = answer.part.source.derived
    named = dict(zip(distinct_names(derived), derived, strict=True))
    free = [
        named[p.trajectory][p.start : p.end]
        for p in overview.phases
        if p.constraint is None and not p.reason and p.trajectory in named
    ]
    return effort_witness(answer.candidate.samples.features, selection, answer.part.demonstrations, free)


def _few_notes(notes: tuple[str, ...]) -> tuple[str, ...]:
    """Each sentence once; of thousands of files, not thousands of sentences."""
    unique = tuple(dict.fromkeys(notes))
    if len(unique) <= MOST_NOTES:
        return unique
    return (*unique[:MOST_NOTES], f"and {len(unique) - MOST_NOTES} more notes of this kind")
