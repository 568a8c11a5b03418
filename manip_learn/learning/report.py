"""The evidence that comes with a learnt constraint."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, final


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
        gap: Ratio that speaks for n_constraints; 10 and above is clear, below 3 says little (joint estimator: 1.5).
        gap_table: Number of rows -> gap.
        levels: Null-space estimator: how strongly the motion uses each whitened direction, least first, relative to a
            motion that is equally strong in all joints.
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

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, for JSON; None where there is no number."""
        return _plain(dataclasses.asdict(self))

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
