"""How many rows the constraint has, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from jaxtyping import Float

# ratios of singular values, noise directions against free ones
CLEAR_GAP = 10.0
WEAK_GAP = 3.0
# the joint estimator compares residuals of whole fits: noise enters both, so that less of a ratio says as much
WEAK_RESIDUAL_GAP = 1.5

Verdict = Literal["clear", "weak", "none"]


@final
@dataclass(frozen=True)
class GapTable:
    """Evidence for each number of rows.

    Attributes:
        counts: Candidate numbers of rows s.
        gaps: Ratio that speaks for each; the largest wins.
        weak_from: Gap from which a weak answer is given.
    """

    counts: tuple[int, ...]
    gaps: tuple[float, ...]
    weak_from: float

    @property
    def best(self) -> int:
        """The number of rows with the largest gap."""
        return self.counts[int(np.argmax(self.gaps))]

    def gap(self, count: int) -> float:
        """Gap of a number of rows; 0 if it is no candidate."""
        return self.gaps[self.counts.index(count)] if count in self.counts else 0.0

    def verdict(self, count: int) -> Verdict:
        """How sure a number of rows is."""
        gap = self.gap(count)
        return "clear" if gap >= CLEAR_GAP else "weak" if gap >= self.weak_from else "none"


def gaps_of_levels(levels: Float[np.ndarray, " r"], nv: int) -> GapTable:
    """Gaps between the levels of a motion with b = 0, least level first.

    s = p (nothing of Phi moves) has no free direction to be compared with; there the level of a motion that is equally
    strong in all joints, 1, takes its place.
    """
    r = len(levels)
    floor = 1e-16 * max(float(levels[-1]), 1.0)
    padded = np.maximum(np.append(levels, 1.0), floor)
    counts = [s for s in range(1, r + 1) if s < nv]
    return GapTable(tuple(counts), tuple(float(padded[s] / padded[s - 1]) for s in counts), WEAK_GAP)


def gaps_of_residuals(residuals: dict[int, float], floor: float) -> GapTable:
    """Gaps between the held-out residuals [root mean square a degree of freedom] of fits with s - 1 and with s rows.

    With too few rows the task's own motion is left over; with enough rows only noise is.
    """
    counts = [s for s in sorted(residuals) if s > 0]
    gaps = [max(residuals[s - 1], floor) / max(residuals[s], floor) for s in counts]
    return GapTable(tuple(counts), tuple(gaps), WEAK_RESIDUAL_GAP)
