"""What an estimator returns: Lambda, and the evidence for the number of its rows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.bootstrap import PolicyPrior
from manip_learn.learning.estimators.joint_fit import JointFit

# ratios of singular values, noise directions against free ones
CLEAR_GAP = 10.0
WEAK_GAP = 3.0
# the joint estimator compares residuals of whole fits: noise enters both, so that less of a ratio says as much
WEAK_RESIDUAL_GAP = 1.3

# 68 % within this angle [deg] is no answer: of all directions in space 13 % are as close to any
MOST_UNCERTAIN_DEG = 30.0

Verdict = Literal["clear", "weak", "none"]


@final
@dataclass(frozen=True)
class GapTable:
    """Evidence for each number of rows.

    Attributes:
        counts: Candidate numbers of rows s.
        gaps: Ratio that supports each.
        weak_from: Gap from which a weak answer is given.
        best: The number of rows that the gaps support.
    """

    counts: tuple[int, ...]
    gaps: tuple[float, ...]
    weak_from: float
    best: int

    def gap(self, count: int) -> float:
        """Gap of a number of rows; 0 if it is no candidate."""
        return self.gaps[self.counts.index(count)] if count in self.counts else 0.0

    def verdict(self, count: int) -> Verdict:
        """How sure a number of rows is."""
        gap = self.gap(count)
        return "clear" if gap >= CLEAR_GAP else "weak" if gap >= self.weak_from else "none"


@final
@dataclass(frozen=True, eq=False)
class Estimate:
    """A learnt row space with its evidence, in whitened coordinates.

    Attributes:
        name: Of the estimator.
        whitened_selection: Lambda, shape (s, p').
        table: Evidence for the number of rows.
        unexplained: Share of the energy that is not explained on the data it was fitted to.
        held_out: The same on trajectories that were left out.
        gradients, hessians: Of each trajectory at the optimum, for the bootstrap.
        policy_model: Name of the policy model, if there is one.
        policy_residuals: Policy model -> held-out share of unexplained energy.
        noise: Held-out residual energy per degree of freedom [(rad/s)^2]; 0 where there is no such thing.
        warnings: Doubts.
        joint: Joint estimator: the fit with the policy's parameters, the start of a refinement on more samples.
        prior: Joint estimator: of the policy's parameters, where they were integrated out.
        levels: Null-space estimator: levels of the whitened directions, least first [1], see `null_space.levels`.
    """

    name: str
    whitened_selection: Float[np.ndarray, "s r"]
    table: GapTable
    unexplained: float
    held_out: float
    gradients: Float[np.ndarray, "g m"]
    hessians: Float[np.ndarray, "g m m"]
    policy_model: str | None = None
    policy_residuals: dict[str, float] = field(default_factory=dict)
    noise: float = 0.0
    warnings: tuple[str, ...] = ()
    joint: JointFit | None = None
    prior: PolicyPrior | None = None
    levels: Float[np.ndarray, " r"] = field(default_factory=lambda: np.zeros(0))


def check_uncertainty(estimate: Estimate, uncertainty_deg: float | None) -> None:
    """Refuse a joint estimate that says next to nothing; one of held rows has gap and recombination to stand on.

    Args:
        estimate: What was learnt.
        uncertainty_deg: Of its row space [deg].

    Raises:
        NotIdentifiableError: It is known to more than `MOST_UNCERTAIN_DEG` only.
    """
    if estimate.name == "joint" and uncertainty_deg is not None and uncertainty_deg > MOST_UNCERTAIN_DEG:
        raise NotIdentifiableError(
            f"record more trajectories, from other starts to other targets: these tell the rows to "
            f"{uncertainty_deg:.0f} degrees only, and beyond {MOST_UNCERTAIN_DEG:g} that is no answer",
            code="uncertain",
        )


def gaps_of_levels(levels: Float[np.ndarray, " r"], nv: int) -> GapTable:
    """Gaps between the levels of a motion with b = 0, least level first.

    s = p (nothing of Phi moves) has no free direction to be compared with; there the level of a motion that is equally
    strong in all joints, 1, takes its place.
    """
    r = len(levels)
    # levels are roots of eigenvalues: below this they are rounding, and a gap among them says nothing
    floor = 3e-8 * max(float(levels[-1]), 1.0)
    padded = np.maximum(np.append(levels, 1.0), floor)
    counts = [s for s in range(1, r + 1) if s < nv]
    gaps = tuple(float(padded[s] / padded[s - 1]) for s in counts)
    return GapTable(tuple(counts), gaps, WEAK_GAP, counts[int(np.argmax(gaps))])


def gaps_of_residuals(residuals: dict[int, float], floor: float, n_samples: int) -> GapTable:
    """Gaps between the held-out residuals [root mean square per degree of freedom] of fits with s - 1 and with s rows.

    With too few rows the task's own motion is left over; with enough rows only noise is, and more rows change nothing.
    So the last row that still helps is the answer, not the one that helps most: a task that moves much more along one
    of its rows than along the other has its largest gap too early. What counts as help grows with the largest gap,
    for imperfect policy models leave small differences, and with the chance of few samples.
    """
    counts = [s for s in sorted(residuals) if s > 0]
    gaps = tuple(max(residuals[s - 1], floor) / max(residuals[s], floor) for s in counts)
    weak_from = max(WEAK_RESIDUAL_GAP, float(np.sqrt(1.0 + 6.0 * np.sqrt(2.0 / n_samples))))
    needed = max(weak_from, max(gaps) ** 0.25)
    helping = [s for s, gap in zip(counts, gaps, strict=True) if gap >= needed]
    return GapTable(tuple(counts), gaps, weak_from, helping[-1] if helping else counts[int(np.argmax(gaps))])
