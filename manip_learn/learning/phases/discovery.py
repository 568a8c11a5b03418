"""Constraints of whole recordings, found one after the other and compared with chance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.evidence.row_evidence import CLEAR_STRENGTH
from manip_learn.learning.phases.chance import chance_support
from manip_learn.learning.phases.confirmation import Confirm, without_odd
from manip_learn.learning.phases.decoding import (
    TRIM,
    decoded,
    explained,
    finally_fitted,
    refitted,
    sharpened,
    stretches_of,
    supports,
)
from manip_learn.learning.phases.hypotheses import Propose, window_hypotheses
from manip_learn.learning.phases.motion import PhaseMotion
from manip_learn.learning.phases.result import PhaseConstraint, PhaseResult, Stretch
from manip_learn.learning.phases.search import Found, candidates, similar
from manip_learn.recordings.trajectory import Trajectory

MOST_CONSTRAINTS = 4
MOST_REJECTIONS = 3
MOST_STEPS = 10
# versions of the recordings without a contact, of each kind, that are searched for comparison
CHANCE_RUNS = 5
# least support of a constraint [nats], and its ratio (of soft ones) to what chance reaches (mean + 3 deviations)
LEAST = 40.0
MARGIN, SOFT_MARGIN = 1.4, 2.0
# share of the best support from which a hypothesis with more rows is tried first
NESTED_SHARE = 0.4
# a hypothesis so much firmer with so much of the best support is the contact: a short arc has soft rows besides
FIRMER, FIRMER_SUPPORT = 0.15, 0.6
# strength that rows need that are not held firmly
SOFT_STRENGTH = CLEAR_STRENGTH


@final
class PhaseDiscovery:
    """The constraints found so far in the rows of one feature map.

    Args:
        features: Phi.
        trajectories: Whole recordings with velocities.
        rng: For the comparison with chance.
        confirm: A second opinion.
        number: Of the feature map, counted from 0.
        propose: Makes the hypotheses.
        largest: Largest number of rows; by default one less than there are.
    """

    def __init__(
        self,
        features: FeatureMap,
        trajectories: Sequence[Trajectory],
        rng: np.random.Generator,
        confirm: Confirm,
        number: int = 0,
        propose: Propose = window_hypotheses,
        largest: int | None = None,
    ):
        self.features, self.trajectories = features, trajectories
        self.rng, self.confirm, self.number, self.propose = rng, confirm, number, propose
        self.found: list[Found] = []
        self.rejected: list[PhaseConstraint] = []
        self.motion = PhaseMotion.collect(self.features, self.trajectories)
        self.thin = self.motion.thinned()
        self.largest = min(self.motion.rates.shape[1], self.features.nv) - 1 if largest is None else largest
        self.marks: list[tuple[float, float]] = []
        self.least: list[float] = []
        self.refused: list[Found] = []
        self._chance: Float[np.ndarray, "s 2"] = np.zeros((self.largest, 2))

    def _update_chance(self) -> None:
        """Compare with chance what is not explained yet: contacts that are found already would count as chance."""
        states = decoded(self.thin, self.found)
        rest = self.thin.chosen(states == 0)
        if np.all(np.diff(rest.first) > 1):
            whole = self.trajectories if not self.found else ()
            self._chance = chance_support(self.features, whole, rest, self.largest, CHANCE_RUNS, self.rng, self.propose)

    def needed(self, found: Found) -> float:
        """Support that such a constraint must have [nats]."""
        any_one, firm = self._chance[found.n_rows - 1]
        if found.firm:
            return max(LEAST, MARGIN * float(firm), float(any_one))
        return max(LEAST, SOFT_MARGIN * float(any_one))

    def run(self) -> PhaseResult:
        """All constraints, one after the other."""
        for _ in range(MOST_STEPS):
            full = len(self.found) == MOST_CONSTRAINTS or len(self.rejected) == MOST_REJECTIONS
            if full or not self.step():
                break
        return self.result()

    def step(self) -> bool:
        """Look for one more constraint; False if there is no candidate."""
        baseline = explained(self.thin, self.found)
        best = candidates(self.motion, self.thin, baseline, self.largest, propose=self.propose)
        best = [f for f in best if not any(similar(f, r) for r in self.refused)]
        if not best or best[0].support < LEAST:
            return False
        self._update_chance()
        # rows that hold in several contacts hide those contacts' own rows; a curved path has no rows as firm
        good = [f for f in best if f.support > max(self.needed(f), NESTED_SHARE * best[0].support)]
        firmest = min((f.scale.share for f in good if f.support > FIRMER_SUPPORT * best[0].support), default=np.inf)
        firm = best[0].scale.share if firmest > FIRMER * best[0].scale.share else firmest
        good = [f for f in good if f.scale.share <= firm]
        candidate = max(good, key=lambda f: (f.n_rows, f.support)) if good else best[0]
        needed = self.needed(candidate)
        trial = refitted(self.thin, [*self.found, candidate])
        constraint = self._constraint(trial[-1], stretches_of(self.thin, decoded(self.thin, trial), len(trial)), needed)
        accepted, mark = self._judged(candidate, constraint)
        if not accepted:
            self.rejected.append(constraint)
            self.refused.append(candidate)
            return bool(good)
        kept = supports(self.thin, trial) > np.array([*self.least, needed])
        if not kept.any() and self.found:
            # each takes from the other what supports it: the one that was there stays
            self.refused.append(candidate)
            return True
        marks, least = [*self.marks, mark], [*self.least, needed]
        self.marks = [m for m, k in zip(marks, kept, strict=True) if k]
        self.least = [x for x, k in zip(least, kept, strict=True) if k]
        self.found = refitted(self.thin, [f for f, k in zip(trial, kept, strict=True) if k])
        # what a better one has replaced would otherwise be found, and replace that one, again and again
        self.refused += [f for f, k in zip(trial, kept, strict=True) if not k]
        return bool(kept[-1])

    def _judged(self, candidate: Found, constraint: PhaseConstraint) -> tuple[bool, tuple[float, float]]:
        mark = (float("nan"), float("nan"))
        if len(constraint.trajectories) < 2 or candidate.support <= self.needed(candidate):
            return False, mark
        parts = self._parts(constraint.stretches)
        confirmed, *mark = self.confirm(self.features, parts, constraint.n_rows, self.rng)
        if not confirmed and candidate.firm:
            agreeing = without_odd(self.features, parts, constraint.n_rows)
            if agreeing:
                confirmed, *mark = self.confirm(self.features, agreeing, constraint.n_rows, self.rng)
        firmly = candidate.firm or mark[0] >= SOFT_STRENGTH
        return confirmed and firmly, (mark[0], mark[1])

    def result(self) -> PhaseResult:
        """Boundaries on all samples, and a last fit of every constraint."""
        motion, states = self.motion, decoded(self.motion, self.found)
        constraints = []
        for k, f in enumerate(self.found):
            stretches = stretches_of(motion, states, k + 1)
            fitted = finally_fitted(motion, f, stretches)
            constraints.append(
                self._constraint(fitted, sharpened(motion, fitted, stretches), self.least[k], self.marks[k])
            )
        return PhaseResult(tuple(constraints), stretches_of(motion, states, 0), (), rejected=tuple(self.rejected))

    def _constraint(
        self,
        found: Found,
        stretches: tuple[Stretch, ...],
        needed: float,
        mark: tuple[float, float] = (float("nan"), float("nan")),
    ) -> PhaseConstraint:
        selection = self.motion.selection(found.rows)
        return PhaseConstraint(
            selection, stretches, self.number, found.scale.share, found.support, self.needed(found), *mark
        )

    def _parts(self, stretches: Sequence[Stretch]) -> list[Trajectory]:
        out = []
        for s in stretches:
            t = self.trajectories[s.trajectory]
            inside = np.flatnonzero((t.time >= s.start + TRIM) & (t.time <= s.end - TRIM))
            if len(inside) > 3:
                out.append(t.part(slice(int(inside[0]), int(inside[-1]) + 1)))
        return out
