"""Which trajectories belong together: two drawers share a plane, two doors a sphere, neither is what was recorded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from manip_learn.constraint.mechanism_kinds import MECHANISM_KINDS, MechanismKind
from manip_learn.learning.mechanisms.evidence import (
    DISAGREE,
    HELD,
    LEVER,
    UNEVEN,
    Scales,
    margins,
    residual_rows,
    unevenness,
)
from manip_learn.learning.mechanisms.fits import SMALLEST, Fit, fit_candidate
from manip_learn.learning.mechanisms.residuals import QUANTITIES
from manip_learn.learning.mechanisms.tip_paths import TipPaths

LEAST = 3  # trajectories that must agree
EXPLAINED = 0.7  # without a majority for one place: least share of the trajectories in the two largest groups
AS_TIGHT = 3.0  # residuals of two mechanisms are alike up to this factor
CANNOT = 1.2  # a mechanism whose least residual exceeds this times the one allowed is not fitted
SETTLING = 4  # fits to those that agree, until they stay the same
TRIED = ("line, not turning", "hinge, firm", "screw, firm", "line", "hinge")  # one way to go: seen in one trajectory


def agreeing(paths: TipPaths, rows: int, scales: Scales) -> tuple[int, ...]:
    """Numbers of the trajectories that agree on a mechanism with more rows than these; all if none is found."""
    found = consensus(paths, rows, scales)
    return tuple(range(len(paths.starts))) if found is None else found[1]


def consensus(paths: TipPaths, rows: int, scales: Scales) -> tuple[Fit, tuple[int, ...]] | None:
    """A mechanism with more rows than these, and the trajectories that obey it; None if not enough of them do.

    Each trajectory by itself proposes a place. The proposal that most others obey wins, if more than half do, or if
    most of the rest agree on another place; it is fitted to all that obey it, for what a single short arc says of
    another one may be far off.
    """
    n = len(paths.starts)
    if n <= LEAST:
        return None
    parts = [paths.alone(i) for i in range(n)]
    found: list[tuple[float, Fit, tuple[int, ...]]] = []
    for candidate in (c for name in TRIED for c in MECHANISM_KINDS if c.name == name and c.n_rows > rows):
        proposals = _supporters(parts, candidate, scales)
        proposal = max(proposals, key=len, default=())
        other = max((p for p in proposals if not set(p) & set(proposal)), key=len, default=())
        if len(proposal) >= LEAST and (len(proposal) > n // 2 or len(proposal) + len(other) >= EXPLAINED * n):
            found.append(_settled(paths, candidate, proposal))
    # short arcs are lines, too, but not as tightly
    tightest = min((size for size, *_ in found), default=0.0)
    tight = [(fit, members) for size, fit, members in found if size <= AS_TIGHT * tightest]
    return max(tight, key=lambda x: len(x[1]), default=None)


def obeying(paths: TipPaths, fit: Fit, among: Sequence[int]) -> tuple[int, ...]:
    """Numbers of the trajectories that obey a fit as those do to which it was fitted."""
    parts = [residual_rows(paths.alone(i), fit) for i in range(len(paths.starts))]
    usual = usual_residuals([parts[i] for i in among])
    return tuple(i for i, part in enumerate(parts) if _within(part, usual))


def _settled(
    paths: TipPaths, candidate: MechanismKind, proposal: tuple[int, ...]
) -> tuple[float, Fit, tuple[int, ...]]:
    """The residual that is usual among those that obey a fit to all of them [m], the fit, and their numbers."""
    members, fit = proposal, fit_candidate(paths.chosen(proposal), candidate)
    for _ in range(SETTLING):
        now = obeying(paths, fit, members)
        if now == members or len(now) < LEAST:
            break
        members, fit = now, fit_candidate(paths.chosen(now), candidate)
    usual = usual_residuals([residual_rows(paths.alone(i), fit) for i in members])
    size = max(float(np.max(x)) * (LEVER if QUANTITIES[name].unit == "rad" else 1.0) for name, x in usual.items())
    return size, fit, members


def _supporters(parts: list[TipPaths], candidate: MechanismKind, scales: Scales) -> list[tuple[int, ...]]:
    """Those that obey the place of each trajectory that the candidate holds by itself, and are held so, too."""
    possible = [i for i, part in enumerate(parts) if not cannot_hold(part, candidate, scales)]
    if len(possible) < LEAST:
        return []
    alone = {i: fit_candidate(parts[i], candidate) for i in possible}
    held = [i for i in possible if np.min(margins(alone[i], scales)) > HELD and unevenness(alone[i]) < UNEVEN]
    usual = usual_residuals([residual_rows(parts[i], alone[i]) for i in held])
    return [tuple(j for j in held if _within(residual_rows(parts[j], alone[i]), usual)) for i in held]


def cannot_hold(part: TipPaths, candidate: MechanismKind, scales: Scales) -> bool:
    """Whether no place, wherever it is, holds all rows of a candidate to the margin that is asked for.

    With C the covariance of the positions and l_1 <= l_2 <= l_3 its eigenvalues, two rows across any line have a
    largest variance of l_2 at least, and the row across any plane one of l_1 (Courant and Fischer). The image of any
    axis in the hand varies by the least eigenvalue of sum (R - mean R)(R - mean R)^T, over at most three rows.
    """
    holds, (m, rad) = candidate.holds, (CANNOT * scales.m / HELD, CANNOT * scales.rad / HELD)
    n, x = len(part.p), part.centred(part.p)
    positions = np.linalg.eigvalsh(x.T @ x / n)
    if "across-line" in holds and positions[1] > m**2 or "height" in holds and positions[0] > m**2:
        return True
    if "orientation" in holds:
        turns = part.centred(part.turns)
        return bool(np.linalg.eigvalsh(turns.T @ turns / n)[-1] > rad**2)
    if "axis-in-hand" in holds:
        R = part.centred(part.R.reshape(-1, 9)).reshape(-1, 3, 3)
        return bool(np.linalg.eigvalsh(np.einsum("nij,nkj->ik", R, R) / n)[0] > 3.0 * rad**2)
    return False


def usual_residuals(residuals: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Of each held row the median over trajectories, no less than noise makes."""
    names = residuals[0] if residuals else ()
    floors = {name: 5.0 * SMALLEST[QUANTITIES[name].unit] for name in names}
    return {name: np.maximum(np.median([r[name] for r in residuals], axis=0), floors[name]) for name in names}


def _within(there: dict[str, np.ndarray], usual: dict[str, np.ndarray]) -> bool:
    """Whether residuals are no larger than those that are usual, by much."""
    return all(bool(np.all(there[name] <= DISAGREE * size)) for name, size in usual.items())
