"""Constraints that some of the trajectories obey throughout, and how much evidence there is for each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.learning.phases.hypotheses import rows_of_moments
from manip_learn.learning.phases.motion import PhaseMotion, broken_energy
from manip_learn.learning.phases.search import FIRST_SCALE, refit, scale_of
from manip_learn.learning.phases.segmentation import HeldScale, evidence

REFITS = 4
# more trajectories, and more pairs of them, than these add nothing to the hypotheses but time
MOST_ALONE, MOST_PAIRS = 16, 24
# a hypothesis with more rows is preferred from this share of the best one's support
NESTED_SHARE = 0.3
# a trajectory obeys a constraint if it has at least this share of the evidence that it would have if the constraint
# held exactly and throughout
OBEYED = 0.4


@final
@dataclass(frozen=True, eq=False)
class Cluster:
    """A constraint and the trajectories that obey it.

    Attributes:
        rows: Whitened, orthonormal, shape (s, p').
        scale: How large velocities along its rows are.
        members: The trajectories that obey it.
        evidence: Of the members [nats].
        support: The same without the best supporter.
    """

    rows: Float[np.ndarray, "s r"]
    scale: HeldScale
    members: tuple[int, ...]
    evidence: float
    support: float


def best_cluster(motion: PhaseMotion, among: Sequence[int], counts: Iterable[int]) -> Cluster | None:
    """The constraint that most of these trajectories obey; None if no two of them obey any."""
    found = [c for c in _refined(motion, among, counts) if len(c.members) > 1 and c.support > 0.0]
    return max(found, key=lambda c: c.support) if found else None


def clusters_of(motion: PhaseMotion, among: Sequence[int], counts: Iterable[int], single: Cluster) -> list[Cluster]:
    """Constraints one after the other, with as many rows as each cluster obeys as firmly as all obey the single one."""
    left, out, counts = list(among), [], list(counts)
    while len(left) > 1:
        found = [c for c in _refined(motion, left, counts) if len(c.members) > 1 and c.support > 0.0]
        found = [c for c in found if c.scale.share <= max(single.scale.share, FIRST_SCALE.share / 3)]
        if not found:
            break
        most = max(c.support for c in found)
        chosen = max((c for c in found if c.support >= NESTED_SHARE * most), key=lambda c: (len(c.rows), c.support))
        out.append(chosen)
        left = [i for i in left if i not in chosen.members]
    return sorted(out, key=lambda c: -c.evidence)


def drifts(
    motion: PhaseMotion, rows: Float[np.ndarray, "s r"]
) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, " g"], Float[np.ndarray, " g"]]:
    """How far each trajectory gets along the rows, how far it gets at all, and how far white noise on its velocities
    alone would take it along the rows: one standard deviation at its end [rad of a typical joint].

    Velocities are summed up before they are judged: what the noise adds averages out, a wrong direction does not.
    """
    along, ways, noise = np.zeros((3, motion.n_trajectories))
    for i, (a, b) in enumerate(zip(motion.first[:-1], motion.first[1:], strict=True)):
        steps = motion.rates[a:b] * motion.weight[a:b, None]
        way = np.cumsum(steps, axis=0)
        along[i], ways[i] = _extent(way @ rows.T), _extent(way)
        # of neighbours: what is common to them is motion
        noise[i] = np.sqrt(0.5 * np.sum(np.diff(steps @ rows.T, axis=0) ** 2))
    return np.maximum(along, 1e-12), ways, noise


def _extent(way: Float[np.ndarray, "n k"]) -> float:
    return float(np.linalg.norm(np.ptp(way, axis=0))) if len(way) else 0.0


def _refined(motion: PhaseMotion, among: Sequence[int], counts: Iterable[int]) -> list[Cluster]:
    out = []
    starts = _starts(motion, among)
    for s in counts:
        seen: list[np.ndarray] = []
        known: dict[tuple[int, ...], Cluster] = {}
        ceiling = _ceiling(motion, s, FIRST_SCALE)
        for M, S in starts:
            rows = rows_of_moments(M, S, s)[0]
            if seen and np.any(np.linalg.svd(np.array(seen) @ rows.T, compute_uv=False)[:, -1] > np.cos(0.05)):
                continue
            seen.append(rows)
            out.append(_grown(motion, rows, among, ceiling, known))
    return out


def _starts(motion: PhaseMotion, among: Sequence[int]) -> list[Float[np.ndarray, "2 r r"]]:
    """Sums of r r^T and of Phi Phi^T over all trajectories, over each, and over pairs, for a first fit."""
    weighted = motion.rates * motion.weight[:, None]
    each = {}
    for i in among:
        own = slice(int(motion.first[i]), int(motion.first[i + 1]))
        S = np.tensordot(motion.weight[own], motion.gram[own], axes=1)
        each[i] = np.stack([weighted[own].T @ motion.rates[own], S])
    chosen = [each[i] for i in among[:: max(1, len(among) // MOST_ALONE)]]
    pairs = [(a, b) for a in range(len(chosen)) for b in range(a)]
    step = max(1, len(pairs) // MOST_PAIRS)
    return [np.sum(list(each.values()), axis=0), *chosen, *(chosen[a] + chosen[b] for a, b in pairs[::step])]


def _grown(
    motion: PhaseMotion,
    rows: Float[np.ndarray, "s r"],
    among: Sequence[int],
    ceiling: Float[np.ndarray, " g"],
    known: dict[tuple[int, ...], Cluster],
) -> Cluster:
    """Refitted to the trajectories that obey it, until they stay the same; `ceiling` is that of `FIRST_SCALE`.

    What comes of it depends on the trajectories that obey the first rows alone: `known` holds it for those seen before.
    """
    s, scale = len(rows), FIRST_SCALE
    first: tuple[int, ...] | None = None
    members: tuple[int, ...] = ()
    gains = np.zeros(motion.n_trajectories)
    for _ in range(REFITS):
        gains = _totals(motion, evidence(motion, broken_energy(motion, rows[None]), s, [scale])[:, 0])
        obeyed = gains > OBEYED * ceiling
        now = tuple(i for i in among if obeyed[i] and ceiling[i] > 0.0)
        if first is None:
            if now in known:
                return known[now]
            first = now
        if not now or now == members:
            members = now
            break
        members = now
        held = _samples_of(motion, members)
        rows = refit(motion, held, s, scale)
        scale = scale_of(motion, rows, held)
        ceiling = _ceiling(motion, s, scale)
    values = np.array([gains[i] for i in members])
    found = Cluster(rows, scale, members, float(values.sum()), float(values.sum() - values.max(initial=0.0)))
    if first:
        known[first] = found
    return found


def _ceiling(motion: PhaseMotion, s: int, scale: HeldScale) -> Float[np.ndarray, " g"]:
    """Evidence of each trajectory for s rows that it obeys to the last digit."""
    return _totals(motion, evidence(motion, np.zeros((len(motion), 1)), s, [scale])[:, 0])


def _totals(motion: PhaseMotion, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " g"]:
    return np.bincount(motion.trajectory, values, minlength=motion.n_trajectories).astype(np.float64)


def _samples_of(motion: PhaseMotion, members: Sequence[int]) -> Bool[np.ndarray, " n"]:
    return np.isin(motion.trajectory, members)
