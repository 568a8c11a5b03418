"""What the estimators of Lambda share: their answer, the evidence for the number of its rows, and the way to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeVar, final

import numpy as np
from jaxtyping import Float

from manip_learn.learning.descent import State, descend
from manip_learn.linalg import turned

# ratios of singular values, noise directions against free ones, that are clear, and weak. Set by hand
CLEAR_GAP, WEAK_GAP = 10.0, 3.0
# root mean square of residuals over that of the noise, from which it is more than noise: the ratio of the energies,
# 1.69, is three standard deviations sqrt(2 / n) of a variance that is estimated from n = 38 samples
RESIDUAL_RATIO = 1.3
# share of the motion's energy that breaks A u = 0 below which the rows are held beyond doubt: a hundredth of the
# velocity; and above which they are called soft: a tenth. Set by hand
HELD_ENERGY, SOFT_ENERGY = 1e-4, 1e-2
# ratio up to which two answers are equally good, so that the first feature map and the simpler model are taken. Set
# by hand
EQUALLY_GOOD = 1.1
# share of the motion of left-out recordings that a policy may leave to explain it, beside the mean motion, which has no
# posture in it. Set by hand
EXPLAINED = 0.3

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

    @property
    def by_count(self) -> dict[int, float]:
        """Number of rows -> gap."""
        return dict(zip(self.counts, self.gaps, strict=True))

    def gap(self, count: int) -> float:
        """Gap of a number of rows; 0 if it is no candidate."""
        return self.by_count.get(count, 0.0)

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
    # levels are roots of eigenvalues: below this they are rounding, and a gap among them says nothing
    floor = 3e-8 * max(float(levels[-1]), 1.0)
    padded = np.maximum(np.append(levels, 1.0), floor)
    counts = [s for s in range(1, r + 1) if s < nv]
    gaps = tuple(float(padded[s] / padded[s - 1]) for s in counts)
    return GapTable(tuple(counts), gaps, WEAK_GAP, counts[int(np.argmax(gaps))])


@final
@dataclass(frozen=True, eq=False)
class PolicyPrior:
    """Gaussian prior of the policy's parameters, independent of each other.

    Attributes:
        precision: Noise variance over the variance of each unknown, 0 for those of Lambda, shape (d,).
        noise: Noise variance [(rad/s)^2].
    """

    precision: Float[np.ndarray, " d"]
    noise: float

    def errors(
        self, hessians: Float[np.ndarray, "g d d"], m: int, repetitions: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "k m"]:
        """Errors of the last m unknowns since the parameters are drawn towards zero, as often as asked for.

        With M = sum H_i + P the estimate is off by M^-1 P times the parameters, whose covariance is sigma^2 P^-1.
        """
        total = hessians.sum(axis=0) + np.diag(self.precision)
        own = np.linalg.solve(total, np.eye(len(total))[:, len(total) - m :])
        factor = own * np.sqrt(self.precision * self.noise)[:, None]
        return rng.standard_normal((repetitions, len(factor))) @ factor


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
        policy_model: Name of the policy model, or what the data determine of the general prior.
        policy_residuals: Policy model -> held-out share of unexplained energy.
        nats: Joint estimator: log-likelihood of the motion, see `imposed`.
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
    nats: float = 0.0
    prior: PolicyPrior | None = None
    levels: Float[np.ndarray, " r"] = field(default_factory=lambda: np.zeros(0))

    @property
    def n_rows(self) -> int:
        """Number of rows s."""
        return len(self.whitened_selection)

    @property
    def gap(self) -> float:
        """Gap that supports the number of rows."""
        return self.table.gap(self.n_rows)

    @property
    def is_held(self) -> bool:
        """Whether the motion obeys A u = 0 beyond doubt."""
        return self.name == "null-space" and self.gap >= CLEAR_GAP and self.unexplained < HELD_ENERGY


class Rows(State, Protocol):
    """Lambda, in whitened coordinates with orthonormal rows, and the equations for dLambda = B Lambda_perp."""

    @property
    def whitened_selection(self) -> Float[np.ndarray, "s r"]:
        """The rows."""
        ...


Point = TypeVar("Point", bound=Rows)


def descend_rows(
    here: Point,
    at: Callable[[Float[np.ndarray, "s r"]], Point],
    max_iterations: int,
    tolerance: float,
    gain: float,
    **further: Any,
) -> Point:
    """`descend` on the Grassmann manifold, from rows that have a choice; `at` gives the point of other rows."""
    s, r = here.whitened_selection.shape
    return descend(
        here,
        lambda point, B: at(turned(point.whitened_selection, B)),
        max_iterations if 0 < s < r else 0,
        tolerance=tolerance,
        gain=gain,
        **further,
    )
