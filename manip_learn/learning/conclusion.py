"""The evidence of a fit put together: estimate -> constraint and report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.learning.estimators.estimate import Estimate
from manip_learn.learning.excitation import shares
from manip_learn.learning.report import LearningReport
from manip_learn.learning.samples import Samples
from manip_learn.learning.streaming.summary_pass import Extent
from manip_learn.learning.words import free_directions, in_words

MOST_NOTES = 20


@final
@dataclass(frozen=True, eq=False)
class Outcome:
    """What a candidate came to.

    Attributes:
        samples: From which it was learnt first: all, or few of many.
        estimate: What was learnt.
        warnings: Doubts so far.
        rng: For the bootstrap.
    """

    samples: Samples
    estimate: Estimate
    warnings: list[str]
    rng: np.random.Generator

    @property
    def gap(self) -> float:
        """Gap that speaks for its number of rows."""
        return float(self.estimate.table.gap(self.estimate.selection.shape[0]))


def concluded(
    outcome: Outcome, extent: Extent, joint_names: tuple[str, ...], uncertainty: float | None, seconds: float
) -> tuple[Constraint, LearningReport]:
    """The constraint, and why it should be believed.

    Args:
        outcome: The winner.
        extent: Of all samples.
        joint_names: One a velocity.
        uncertainty: Of the row space [deg].
        seconds: Time for the fit [s].
    """
    samples, estimate, warnings = outcome.samples, outcome.estimate, list(outcome.warnings)
    features = samples.features
    selection = samples.selection(estimate.selection)
    used = np.linalg.norm(samples.whitening, axis=0) > 0.0
    unused = [n for n, u in zip(features.row_names, used, strict=True) if not u]
    if unused:
        warnings.append(f"row(s) {', '.join(unused)} are always zero for this robot and frame and were left out")
    kind = "motion-constrained" if estimate.name == "null-space" else "self-imposed"
    free = free_directions(selection, used)
    report = LearningReport(
        sentence=in_words(kind, selection, free, features, used, uncertainty),
        estimator=estimate.name,
        kind=kind,
        n_constraints=selection.shape[0],
        row_names=features.row_names,
        reference=getattr(features, "reference", None),
        free_directions=tuple(tuple(float(c) for c in row) for row in free),
        gap=outcome.gap,
        gap_table=dict(zip(estimate.table.counts, estimate.table.gaps, strict=True)),
        levels=(),
        energy_fraction=float(estimate.unexplained),
        held_out_residual=float(np.sqrt(estimate.held_out)),
        uncertainty_deg=uncertainty,
        excitation=dict(zip(joint_names, shares(extent.squares).tolist(), strict=True)),
        policy_model=estimate.policy_model,
        policy_residuals=estimate.policy_residuals,
        n_samples=extent.n_samples,
        n_trajectories=extent.n_groups,
        seconds=seconds,
        notes=_few_notes(extent.notes),
        warnings=tuple(warnings),
    )
    provenance = {
        key: value
        for key, value in report.to_dict().items()
        if key in ("estimator", "kind", "gap", "uncertainty_deg", "n_samples", "n_trajectories", "sentence", "warnings")
    }
    return Constraint(selection, features, provenance), report


def _few_notes(notes: tuple[str, ...]) -> tuple[str, ...]:
    """Each sentence once; of thousands of files, not thousands of sentences."""
    unique = tuple(dict.fromkeys(notes))
    if len(unique) <= MOST_NOTES:
        return unique
    return (*unique[:MOST_NOTES], f"and {len(unique) - MOST_NOTES} more notes of this kind")
