"""What the recombination test says of each row, and the rule that makes a number of rows of it."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from statistics import NormalDist
from typing import Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import counted, listed

Verdict = Literal["clear", "weak", "none"]
RowState = Literal["held", "unclear", "free", "untried"]

# chance of at least the evidence seen, were the joints independent of each other, that a row may have
CHANCE = 0.01
# growth of a row's motion by recombination, exceeded with 99 % confidence, from which the row is believed to be held,
# and from which it is so beyond doubt. Free motion is coordinated, too: people guiding an arm reach 2.2 (real
# recordings of two arms), a curved part wiped by hand 2.2 to 3.3, contacts with rails, hinges and tables 4 to 400
BELIEVED, CLEAR = 2.0, 4.0
# least strength of a row that is ranked before one found held: noise spreads unevenly, the first row has the least
LEANING_STRENGTH = 1.3
# a direction that the motion uses less than this share of the most used one was not tried
USED_SHARE = 1.0 / 6.0
# fewer trajectories give no clear answer
FEWEST_TRAJECTORIES = 3


@final
@dataclass(frozen=True, eq=False)
class RowEvidence:
    """Evidence for each row, most firmly held first.

    Attributes:
        strengths: How much more the motion uses each row when joints are exchanged between the trajectories: median.
        least: The same, least of all recombinations.
        p_values: Chance of a level as low as the recorded one if the joints moved independently of each other.
        levels: How much the recorded motion uses each row: 0 not at all, 1 as a motion equally strong in all joints.
        directions: The rows, in the features' own units, orthonormal, shape (r, p).
        n_trajectories: Trajectories that move.
        n_recombinations: Recombinations that the recorded motion was compared with.
        spread: Standard deviation of the logarithm of each strength over the recombinations.
        choices: In how many ways as many recordings can be chosen from all there were: one hypothesis each, the best of
            which was found.
    """

    strengths: tuple[float, ...]
    least: tuple[float, ...]
    p_values: tuple[float, ...]
    levels: tuple[float, ...]
    directions: Float[np.ndarray, "r p"]
    n_trajectories: int
    n_recombinations: int
    spread: tuple[float, ...] = ()
    choices: int = 1

    @property
    def lower(self) -> tuple[float, ...]:
        """What the strength of each row exceeds with 99 % confidence, the choice of the recordings paid for."""
        z = -NormalDist().inv_cdf(max(CHANCE / self.choices, sys.float_info.min))
        return tuple(s * math.exp(-z * sd) for s, sd in zip(self.strengths, self.spread, strict=True))

    @property
    def n_rows(self) -> int:
        """Number of rows that the evidence supports, counted without a gap; the last ones may be weak."""
        supported = 0
        for i, (strength, lower, p) in enumerate(zip(self.strengths, self.lower, self.p_values, strict=True)):
            if p > CHANCE or strength < LEANING_STRENGTH:
                break
            supported = i + 1 if lower >= BELIEVED else supported
        return supported

    @property
    def enough(self) -> bool:
        """Whether there are trajectories enough to exchange joints between."""
        return self.n_trajectories >= FEWEST_TRAJECTORIES

    @property
    def verdict(self) -> Verdict:
        """How sure the rows are: as sure as the weakest of them."""
        n = self.n_rows
        if not n:
            return "none"
        return "clear" if self.enough and self.lower[n - 1] >= CLEAR else "weak"

    @property
    def states(self) -> tuple[RowState, ...]:
        """What each row is.

        Held; free, for the motion uses it; untried: neither used nor shown to be held; or unclear: softly held, held in
        a part of the way only, or in rows that turn with the place, and too little of that to be counted.
        """
        most = max(self.levels, default=0.0)
        states: list[RowState] = []
        for i, level in enumerate(self.levels):
            if i < self.n_rows:
                states.append("held")
            elif self.strengths[i] >= BELIEVED and self.p_values[i] <= CHANCE:
                states.append("unclear")
            else:
                states.append("free" if level >= USED_SHARE * most and level > 0.0 else "untried")
        return tuple(states)

    def sentence(self) -> str:
        """The evidence in words, for reports."""
        if not self.strengths:
            return "the recordings do not move, so nothing shows which rows are held"
        return f"{self._held()}; {self._rest()}{self._few()}"

    def _held(self) -> str:
        n = self.n_rows
        if n == 0:
            return (
                f"no row is shown to be held (best strength {self.strengths[0]:.2g}, with 99 % confidence above "
                f"{self.lower[0]:.2g}; {BELIEVED:g} is the least that counts)"
            )
        softly = "held softly, or by the way of moving only" if self.enough else "held, it seems"
        firmly = "held" if self.verdict == "clear" else softly
        strengths = listed(f"{s:.3g}" for s in self.strengths[:n])
        return f"{counted(n, 'row')} {firmly} (strength {strengths}, p = {max(self.p_values[:n]):.2g})"

    def _rest(self) -> str:
        n, states = self.n_rows, self.states
        if n == len(states):
            return "nothing of the features is left free"
        if "untried" in states:
            return f"{counted(states.count('untried'), 'direction')} hardly tried, so held or free cannot be told"
        kind = "is free" if states[n] == "free" else "may be held softly, or only at each place by itself"
        return f"the next row (strength {self.strengths[n]:.2g}) {kind}"

    def _few(self) -> str:
        return (
            ""
            if self.enough
            else f"; too few to be sure with {counted(self.n_trajectories, 'recording')}, record 5 or more"
        )
