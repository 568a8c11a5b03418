"""The search for the next constraint in whole recordings: hypotheses, scores, refits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.learning.phases.hypotheses import MOST, Propose, fitted_rows, window_hypotheses
from manip_learn.learning.phases.motion import PhaseMotion, broken_energy
from manip_learn.learning.phases.segmentation import HeldScale, best_gains, evidence, held_samples

# scale with which a hypothesis from one window is scored: its rows are still off by degrees
FIRST_SCALE = HeldScale(steady=2.0, share=0.1)
# scales among which the held samples choose
STEADY = (1.0, 2.0, 4.0, 8.0, 16.0)
SHARES = (0.003, 0.01, 0.03, 0.1, 0.2)
# hypotheses of each number of rows that are refitted
REFINED = 6
REFITS = 4
# hypotheses of each number of rows where only the best support is asked for
FEWER, FEWER_REFINED, FEWER_REFITS = 80, 3, 2
# largest share of velocities along held rows of a firm contact
FIRM = 0.05
# rows closer together than this are one hypothesis [rad]
SAME = np.radians(8.0)
# least evidence from the trajectories beside the best supporter [nats]
LEAST_SUPPORT = 12.0


@final
@dataclass(frozen=True, eq=False)
class Found:
    """A hypothesis after refits.

    Attributes:
        rows: Whitened, orthonormal, shape (s, p').
        scale: How large velocities along its rows are.
        support: Total evidence without the best supporter's, where there are several trajectories [nats].
        gains: Evidence of each trajectory [nats], shape (g,).
    """

    rows: Float[np.ndarray, "s r"]
    scale: HeldScale
    support: float
    gains: Float[np.ndarray, " g"]

    @property
    def n_rows(self) -> int:
        """Number of rows s."""
        return len(self.rows)

    @property
    def firm(self) -> bool:
        """Whether its rows are held firmly; if not, they may as well be the operator's own straight motion."""
        return self.scale.share <= FIRM


def evidence_of(motion: PhaseMotion, found: Found) -> Float[np.ndarray, " n"]:
    """Evidence of each sample for a found constraint."""
    energy = broken_energy(motion, found.rows[None])
    return evidence(motion, energy, found.n_rows, [found.scale])[:, 0]


def candidates(
    motion: PhaseMotion,
    thin: PhaseMotion,
    baseline: Float[np.ndarray, " k"],
    largest: int,
    most: int = MOST,
    kept: int = REFINED,
    refits: int = REFITS,
    propose: Propose = window_hypotheses,
) -> list[Found]:
    """The best hypotheses beyond what is explained already, best first.

    Args:
        motion: All samples.
        thin: Evenly chosen ones, on which hypotheses are scored.
        baseline: Evidence of each chosen sample for the constraint that explains it already; 0 where none does.
        largest: Largest number of rows.
        most: Hypotheses of each number of rows that are scored.
        kept: Hypotheses of each number of rows that are refitted.
        refits: How often.
        propose: Makes the hypotheses.
    """
    starts: list[np.ndarray] = []
    for h in propose(motion, largest, most):
        s = h.rows.shape[1]
        values = evidence(thin, broken_energy(thin, h.rows), s, [FIRST_SCALE] * len(h.rows))
        gains = best_gains(values - baseline[:, None], thin.first)
        support = supports_of(gains)
        starts += [h.rows[i] for i in _distinct(h.rows, np.argsort(-support), kept)]
    found = refined(thin, starts, baseline, refits)
    return sorted((f for f in found if f.support > LEAST_SUPPORT), key=lambda f: -f.support)


def supports_of(gains: Float[np.ndarray, "g h"]) -> Float[np.ndarray, " h"]:
    """Evidence for each hypothesis from the trajectories beside its best supporter; all of a single trajectory."""
    return gains.sum(axis=0) - (gains.max(axis=0) if len(gains) > 1 else 0.0)


def best_supports(thin: PhaseMotion, largest: int, propose: Propose = window_hypotheses) -> Float[np.ndarray, "s 2"]:
    """Support of the best hypothesis of each number of rows [nats], of any and of firm ones.

    By a search that looks less closely.
    """
    found = candidates(thin, thin, np.zeros(len(thin)), largest, FEWER, FEWER_REFINED, FEWER_REFITS, propose)
    out = np.zeros((largest, 2))
    for f in found:
        best = out[f.n_rows - 1]
        best[:] = np.maximum(best, [f.support, f.support if f.firm else 0.0])
    return out


def refined(
    thin: PhaseMotion,
    starts: Sequence[Float[np.ndarray, "_ r"]],
    baseline: Float[np.ndarray, " k"],
    refits: int = REFITS,
) -> list[Found]:
    """Hypotheses fitted to the samples that they explain, in turns with their scales; the best of each one's turns."""
    now = [(rows, FIRST_SCALE) for rows in starts]
    best: list[Found | None] = [None] * len(now)
    for turn in range(refits + 1):
        energies = [broken_energy(thin, rows[None]) for rows, _ in now]
        values = [
            evidence(thin, e, len(rows), [scale]) - baseline[:, None]
            for e, (rows, scale) in zip(energies, now, strict=True)
        ]
        if not values:
            break
        stacked = np.concatenate(values, axis=1)
        gains = best_gains(stacked, thin.first)
        for i, (rows, scale) in enumerate(now):
            trial = Found(rows, scale, float(supports_of(gains)[i]), gains[:, i])
            previous = best[i]
            if previous is None or trial.support > previous.support:
                best[i] = trial
        if turn == refits:
            break
        held = held_samples(stacked, thin.first)
        for i, (rows, scale) in enumerate(now):
            if np.count_nonzero(held[:, i] & thin.moving) >= 3 * rows.shape[1]:
                rows = refit(thin, held[:, i], len(rows), scale)
                now[i] = rows, scale_of(thin, rows, held[:, i])
    return [f for f in best if f is not None]


def refit(motion: PhaseMotion, held: Bool[np.ndarray, " n"], s: int, scale: HeldScale) -> Float[np.ndarray, "s r"]:
    """Rows from the held samples, each weighted by the inverse of the variance that is expected of it."""
    variance = scale.steady**2 * motion.noise + scale.share**2 * motion.free
    return fitted_rows(motion, np.where(held, motion.weight / variance, 0.0), s)[0]


def scale_of(motion: PhaseMotion, rows: Float[np.ndarray, "s r"], held: Bool[np.ndarray, " n"]) -> HeldScale:
    """The scale that makes the held samples most likely."""
    part = motion.chosen(held)
    energy = broken_energy(part, rows[None])
    scales = [HeldScale(a, b) for a in STEADY for b in SHARES]
    totals = evidence(part, np.repeat(energy, len(scales), axis=1), len(rows), scales).sum(axis=0)
    return scales[int(np.argmax(totals))]


def similar(first: Found, second: Found) -> bool:
    """Whether two have nearly the same rows."""
    if first.rows.shape != second.rows.shape:
        return False
    return float(np.linalg.svd(first.rows @ second.rows.T, compute_uv=False)[-1]) > np.cos(SAME)


def _distinct(rows: Float[np.ndarray, "h s r"], order: Int[np.ndarray, " h"], most: int) -> list[int]:
    """The first few in this order whose row spaces differ."""
    kept: list[int] = []
    for i in order[:60]:
        shared = [np.linalg.svd(rows[i] @ rows[j].T, compute_uv=False)[-1] for j in kept]
        if all(c < np.cos(SAME) for c in shared):
            kept.append(int(i))
        if len(kept) == most:
            break
    return kept
