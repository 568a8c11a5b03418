"""The evidence that comes with a learnt constraint."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.learning.answer import Answer
from manip_learn.learning.candidate import Candidate
from manip_learn.learning.data_summary import DataSummary
from manip_learn.learning.excitation import energy_shares
from manip_learn.learning.mechanisms.mechanism import Mechanism
from manip_learn.learning.overview import OddTrajectory, Phase, RecordingOverview
from manip_learn.linalg import null_basis

MOST_NOTES = 20
PROVENANCE = (
    *("estimator", "kind", "gap", "uncertainty_deg", "n_samples", "n_trajectories", "sentence", "warnings"),
    *("phases", "odd_trajectories", "mechanism"),
)
# entries of a unit vector that are printed as 0: half of the last of two digits
NEGLIGIBLE = 5e-3


class RowSupport(NamedTuple):
    """Evidence that one row is held, from the recombination test.

    Attributes:
        strength: How many times as much the motion uses the row when joints are exchanged between trajectories.
        p_value: Chance of so low a use if the joints moved independently of each other.
        state: `"held"`, `"unclear"`, `"free"` or `"untried"`.
    """

    strength: float
    p_value: float
    state: str


@final
@dataclass(frozen=True)
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
        uncertainty_deg: 68 % of bootstrap repetitions over trajectories put the row space within this angle; None with
            a single trajectory or where there is only one possible row space.
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

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, for JSON; None where there is no number."""
        content = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        for name in ("phases", "odd_trajectories", "row_evidence"):
            content[name] = [entry._asdict() for entry in content[name]]
        content["mechanism"] = None if self.mechanism is None else self.mechanism.to_dict()
        return _plain(content)

    def __str__(self) -> str:
        lines = [self.sentence]
        lines += [f"warning: {w}" for w in self.warnings]
        return "\n".join(lines)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def build_report(
    best: Candidate,
    data: DataSummary,
    joint_names: tuple[str, ...],
    uncertainty_deg: float | None,
    seconds: float,
    answer: Answer | None = None,
    overview: RecordingOverview | None = None,
) -> tuple[Constraint, LearningReport]:
    """The constraint, and the evidence for it.

    Args:
        best: The candidate chosen.
        data: Summary of all samples.
        joint_names: One per velocity.
        uncertainty_deg: Of the row space [deg].
        seconds: Time for the fit [s].
        answer: Evidence and mechanism, where they were looked for.
        overview: What the recordings show as a whole.
    """
    overview = overview or RecordingOverview()
    samples, estimate, warnings = best.samples, best.estimate, list(best.warnings)
    features = samples.features
    selection = samples.selection(estimate.whitened_selection)
    if isinstance(features, MechanismRows) and len(selection) == features.n_rows:
        selection = np.eye(features.n_rows)  # all of the rows: any basis of theirs will do, so the plainest
    used = np.linalg.norm(samples.whitening, axis=0) > 0.0
    unused = [n for n, u in zip(features.row_names, used, strict=True) if not u]
    if unused:
        warnings.append(f"row(s) {', '.join(unused)} are always zero for this robot and frame and were left out")
    kind = "motion-constrained" if estimate.name == "null-space" else "self-imposed"
    free = free_directions(selection, used)
    mechanism = answer.mechanism.mechanism if answer and answer.mechanism else None
    sentence = describe(kind, selection, free, features, used, uncertainty_deg)
    if mechanism is not None and isinstance(features, MechanismRows):
        sentence = f"held about the mechanism's axis or centre: {' '.join(features.row_names)}"
    report = LearningReport(
        sentence=sentence if mechanism is None else f"{sentence}; {mechanism.sentence}",
        estimator=estimate.name,
        kind=kind,
        n_constraints=selection.shape[0],
        row_names=features.row_names,
        reference=getattr(features, "reference", None),
        free_directions=tuple(tuple(float(c) for c in row) for row in free),
        gap=best.gap,
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
        warnings=(*warnings, *_doubts(answer), *overview.warnings),
        row_evidence=_row_support(answer),
        evidence=answer.evidence.sentence() if answer and answer.evidence else "",
        phases=overview.phases,
        odd_trajectories=overview.odd_trajectories,
        mechanism=mechanism,
    )
    provenance = {key: value for key, value in report.to_dict().items() if key in PROVENANCE}
    return Constraint(selection, features, provenance), report


def _doubts(answer: Answer | None) -> tuple[str, ...]:
    """About the number of rows and about the mechanism."""
    if answer is None:
        return ()
    return (*answer.warnings, *(answer.mechanism.warnings if answer.mechanism else ()))


def _row_support(answer: Answer | None) -> tuple[RowSupport, ...]:
    if answer is None or answer.evidence is None:
        return ()
    e = answer.evidence
    return tuple(RowSupport(*row) for row in zip(e.strengths, e.p_values, e.states, strict=True))


def _few_notes(notes: tuple[str, ...]) -> tuple[str, ...]:
    """Each sentence once; of thousands of files, not thousands of sentences."""
    unique = tuple(dict.fromkeys(notes))
    if len(unique) <= MOST_NOTES:
        return unique
    return (*unique[:MOST_NOTES], f"and {len(unique) - MOST_NOTES} more notes of this kind")


def free_directions(selection: Float[np.ndarray, "s p"], used: Bool[np.ndarray, " p"]) -> Float[np.ndarray, "k p"]:
    """Orthonormal rows that the constraint leaves free, among the feature rows that can move at all.

    Each points so that its largest entry is positive; several are turned so that they share as few rows as possible.
    """
    out = np.zeros((0, selection.shape[1]))
    inner = null_basis(selection[:, used]).T
    if inner.shape[0]:
        out = np.zeros((inner.shape[0], selection.shape[1]))
        out[:, used] = _echelon(inner)
    return out


def describe(
    kind: str,
    selection: Float[np.ndarray, "s p"],
    free: Float[np.ndarray, "k p"],
    features: FeatureMap,
    used: Bool[np.ndarray, " p"],
    uncertainty_deg: float | None,
) -> str:
    """One sentence: what moves freely, what is held or commanded, how sure it is."""
    verb = "held" if kind == "motion-constrained" else "commanded by the task"
    spread = "" if uncertainty_deg is None else f" +- {_degrees(uncertainty_deg)} degrees"
    names = [n for n, u in zip(features.row_names, used, strict=True) if u]
    where = getattr(features, "reference", None)
    place = f" in the {where} frame" if where else ""
    rows = "; ".join(_row(row[used], names) for row in _echelon(selection))
    if free.shape[0] == 0:
        return f"{verb}{place}: all of {' '.join(names)}; nothing of it is free"
    freedom = " and ".join(_row(row[used], names) for row in free)
    return f"moves freely along {freedom}{spread} in ({', '.join(names)}){place}; {verb}: {rows}"


def _echelon(rows: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "k p"]:
    """Orthonormal rows of the same space, turned towards single axes one after the other, largest first."""
    remaining, out = rows.copy(), []
    while remaining.shape[0]:
        # the unit axis that lies deepest in what remains
        share = np.sum(remaining**2, axis=0)
        axis = int(np.argmax(share))
        direction = remaining[:, axis] / np.linalg.norm(remaining[:, axis])
        row = direction @ remaining
        out.append(row if row[np.argmax(np.abs(row))] > 0 else -row)
        remaining = null_basis(direction[None, :]).T @ remaining if remaining.shape[0] > 1 else remaining[:0]
    # in the order of the axes that they point along most
    return np.array(sorted(out, key=lambda row: int(np.argmax(np.abs(row)))))


def _vector(row: np.ndarray) -> str:
    return "(" + ", ".join(f"{c + 0.0:.2f}" for c in np.where(np.abs(row) < NEGLIGIBLE, 0.0, row)) + ")"


def _row(row: np.ndarray, names: list[str]) -> str:
    large = [i for i in range(len(row)) if abs(row[i]) >= NEGLIGIBLE]
    if len(large) == 1:
        return names[large[0]]
    return _vector(row)


def _degrees(angle: float) -> str:
    return f"{angle:.2f}" if angle >= 0.095 else f"{angle:.1g}"
