"""Which trajectories belong together: two drawers share a plane, two doors a sphere, neither is what was recorded."""

from __future__ import annotations

import numpy as np

from manip_learn.learning.mechanisms.evidence import DISAGREE, HELD, UNEVEN, Scales, margins, residual_rows, unevenness
from manip_learn.learning.mechanisms.fits import SMALLEST, Fit, fit_candidate
from manip_learn.learning.mechanisms.kinds import MECHANISM_KINDS, MechanismKind
from manip_learn.learning.mechanisms.residuals import QUANTITIES
from manip_learn.learning.mechanisms.tip_paths import TipPaths

LEAST = 3  # trajectories that must agree
TRIED = ("line, not turning", "hinge, firm", "screw, firm", "line", "hinge")  # one way to go: seen in one trajectory


def agreeing(paths: TipPaths, rows: int, scales: Scales) -> tuple[int, ...]:
    """Numbers of the trajectories that agree on a mechanism with more rows than these; all if none is found.

    Each trajectory by itself proposes a place, and the proposal that most others obey wins, if more than half do.
    """
    n = len(paths.starts)
    everyone = tuple(range(n))
    if n <= LEAST:
        return everyone
    parts = [paths.alone(i) for i in everyone]
    for candidate in (c for name in TRIED for c in MECHANISM_KINDS if c.name == name and c.n_rows > rows):
        supporters = max(_supporters(parts, candidate, scales), key=len, default=())
        if len(supporters) >= max(LEAST, n // 2 + 1):
            return supporters
    return everyone


def _supporters(parts: list[TipPaths], candidate: MechanismKind, scales: Scales) -> list[tuple[int, ...]]:
    """For each trajectory that the candidate holds by itself: those that obey its place."""
    alone = [fit_candidate(part, candidate) for part in parts]
    own = [residual_rows(part, fit) for part, fit in zip(parts, alone, strict=True)]
    held = [float(np.min(margins(fit, scales))) > HELD and unevenness(fit) < UNEVEN for fit in alone]
    out = []
    for i, fit in enumerate(alone):
        if held[i]:
            out.append(tuple(j for j, part in enumerate(parts) if held[j] and _obeys(part, fit, own[j])))
    return out


def _obeys(part: TipPaths, fit: Fit, own: dict[str, np.ndarray]) -> bool:
    there = residual_rows(part, fit)
    return all(
        bool(np.all(there[name] <= DISAGREE * np.maximum(own[name], 5.0 * SMALLEST[QUANTITIES[name].unit])))
        for name in fit.candidate.holds
    )
