"""Which of the candidates explains the paths: as many rows as are held, as few parameters as do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from manip_learn.constraint.mechanism_kinds import MECHANISM_KINDS
from manip_learn.learning.mechanisms.evidence import (
    DISAGREE,
    ENOUGH,
    FARTHEST,
    HELD,
    UNEVEN,
    Scales,
    bends,
    disagreement,
    margins,
    radius_of,
    recombination_ratio,
    score,
    unevenness,
)
from manip_learn.learning.mechanisms.fits import SMALLEST, Fit, closed_form_starts, fit_candidate
from manip_learn.learning.mechanisms.residuals import QUANTITIES
from manip_learn.learning.mechanisms.tip_paths import TipPaths

SHARED_LOSS = 1.15  # a quantity is the same for all trajectories if its residual grows by less
ELSEWHERE = 2.0  # [deg] by which the axes of two fits differ that tell different stories
REPEATED = "held by the repetition of one motion, not by a contact"
APART = "each trajectory by itself, but not in one place"
# what each mechanism becomes when it bends
BENT_FORMS = {
    "line": ("hinge",),
    "line, not turning": ("hinge, not turning",),
    "plane": ("ball", "cylinder"),
    "hinge": ("screw",),
}


@final
@dataclass(frozen=True)
class Alternative:
    """One candidate in the comparison.

    Attributes:
        name: Its name.
        n_rows: Rows that it would hold.
        n_unknowns: Parameters.
        held_out: Largest standard deviation of a held row on trajectories that were left out, in units of what the
            motion would vary without it (1: holds nothing).
        score: Sum over the rows of the logarithm of what is gained, less the price of the parameters; comparable only
            among those that hold.
        recombination: Least ratio of residuals after and before joints are exchanged between trajectories; None if it
            was not needed.
        verdict: `"chosen"`, or why not.
    """

    name: str
    n_rows: int
    n_unknowns: int
    held_out: float
    score: float
    recombination: float | None
    verdict: str


def fit_all(paths: TipPaths) -> list[Fit]:
    """Every candidate at its best place; those that share a position start from it."""
    by_position: dict[tuple[str, ...], Fit] = {}
    fits = []
    for candidate in sorted(MECHANISM_KINDS, key=lambda c: len(c.holds)):
        base = tuple(n for n in candidate.holds if n not in ("axis-in-hand", "orientation")) or candidate.holds
        known = by_position.get(base) if candidate.orientation != "carried" else None
        if known is not None:
            place = known.place
            fit = fit_candidate(paths, candidate, [place])
        else:
            fit = fit_candidate(paths, candidate)
            if candidate.orientation == "free":
                by_position[base] = fit
        fits.append(fit)
    return fits


def with_shared(paths: TipPaths, fit: Fit) -> Fit:
    """The fit with as many quantities as the data allow the same for all trajectories: better determined."""
    names = [n for n in fit.candidate.holds if n in ("radius", "height", "distance", "across-line")]
    trials = [tuple(names), *((n,) for n in names if len(names) > 1)]
    for shared in trials:
        if not shared:
            break
        tied = fit_candidate(paths, fit.candidate, [fit.place, *closed_form_starts(paths, fit.candidate)], shared)
        if all(
            np.all(
                np.hypot(tied.held_out[n], SMALLEST[QUANTITIES[n].unit])
                <= SHARED_LOSS * np.hypot(fit.held_out[n], SMALLEST[QUANTITIES[n].unit])
            )
            for n in fit.candidate.holds
        ):
            return tied
    return fit


@final
@dataclass(frozen=True, eq=False)
class Choice:
    """What was chosen.

    Attributes:
        fit: The best candidate; None if none is confirmed.
        rival: Its bent form, where the motion is too short to tell the two apart.
        table: All candidates, best first.
        unlike: Whether a few trajectories are unlike the others in how tightly it holds them.
    """

    fit: Fit | None
    rival: Fit | None
    table: tuple[Alternative, ...]
    unlike: bool = False


def choose(paths: TipPaths, recombined: TipPaths | None) -> Choice:
    """The best candidate that the evidence confirms, and the table of all.

    A candidate must hold each of its rows to 1 / `HELD` of the motion; among those the score decides; and when joints
    are exchanged between trajectories its residuals must grow, or the motion itself, not a contact, keeps the rows.
    """
    scales = Scales.of(paths, recombined)
    chosen: Fit | None = None
    rival: Fit | None = None
    unlike, table = False, []
    for value, fit in ranked(paths, fit_all(paths), scales):
        c, least, ratio = fit.candidate, float(np.min(margins(fit, scales))), None
        verdict = _objection(paths, fit, least)
        if not verdict and chosen is not None:
            verdict = f"explained by {chosen.candidate.name}"
            if _rivals(chosen, fit):
                verdict, rival = f"not told from {chosen.candidate.name}", fit
        elif not verdict:
            ratio = None if recombined is None else recombination_ratio(fit, paths, recombined)
            if ratio is not None and ratio < ENOUGH:
                verdict = REPEATED if ratio > 0.0 else "the arm cannot move otherwise"
            else:
                apart, unlike = disagreement(paths, fit) if len(paths.starts) > 1 else (1.0, False)
                verdict = APART if apart > DISAGREE else "chosen"
                chosen = None if verdict == APART else fit
        table.append(Alternative(c.name, c.n_rows, c.n_unknowns, 1.0 / least, value, ratio, verdict))
    return Choice(chosen, rival, tuple(table), unlike)


def _rivals(chosen: Fit, other: Fit) -> bool:
    """Whether the other is the bent form of the chosen one and would put the mechanism elsewhere."""
    if other.candidate.name not in BENT_FORMS.get(chosen.candidate.name, ()):
        return False
    return chosen.candidate.constant or axes_apart(chosen, other) > ELSEWHERE


def axes_apart(one: Fit, other: Fit) -> float:
    """Angle between the axes of two fits [deg]."""
    return float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(np.cross(one.place.axis, other.place.axis))))))


def ranked(paths: TipPaths, fits: list[Fit], scales: Scales) -> list[tuple[float, Fit]]:
    """Fits by their score, best first; a simple mechanism comes after its bent form where the data are bent."""
    by_name = {f.candidate.name: f for f in fits}
    scores = {name: score(f, scales) for name, f in by_name.items()}
    for straight, forms in BENT_FORMS.items():
        for bent in forms:
            if scores[bent] <= scores[straight] and bends(paths, by_name[straight], by_name[bent]):
                scores[bent] = scores[straight] + 1e-3
    order = sorted(scores, key=lambda name: -scores[name])
    return [(scores[name], by_name[name]) for name in order]


def _objection(paths: TipPaths, fit: Fit, least: float) -> str:
    """Why a fit cannot be the answer; empty if it can."""
    if least < HELD:
        return "not held"
    if unevenness(fit) > UNEVEN:
        return "not all its rows are held alike"
    radius = radius_of(paths, fit)
    return f"too far away ({radius[0]:.1f} m)" if radius is not None and radius[0] > FARTHEST else ""
