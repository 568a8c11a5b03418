"""Evidence for and against a mechanism that was fitted: how tightly, how evenly, how repeatably its rows are held."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.learning.mechanisms.fits import SMALLEST, Fit, fit_candidate
from manip_learn.learning.mechanisms.residuals import QUANTITIES
from manip_learn.learning.mechanisms.tip_paths import TipPaths

HELD = 8.0  # a held row varies this many times less than the motion
UNEVEN = 50.0  # rows of one mechanism are held alike: none varies this many times more than another
LEVER = 0.5  # [m/rad] to compare rotations with positions
PRICE = 0.15  # of a parameter, in logarithms of a residual
ENOUGH = 2.5  # recombined residuals over the data's: 1 is no evidence, free motion reaches 2.1
DISAGREE = 10.0  # residuals of all trajectories together over those of each alone
UNLIKE = 3.0  # residual of one trajectory in the common fit over that by itself
FARTHEST = 3.0  # [m] beyond this an axis or a centre is not told from a line or a plane
BENT = 5e-5  # [m] by which a path must leave a simpler mechanism: rails wobble
CLEARLY = 5.0  # radius or pitch over its standard deviation


@final
@dataclass(frozen=True, eq=False)
class Scales:
    """What a row varies by when nothing holds it: positions [m], orientations [rad]."""

    m: float
    rad: float

    @staticmethod
    def of(paths: TipPaths, recombined: TipPaths | None) -> Scales:
        """The larger of the motion and of what its joints make when they are not coordinated."""
        both = [p for p in (paths, recombined) if p is not None]
        m = max(float(np.sqrt(np.mean(np.sum(p.centred(p.p) ** 2, axis=1)))) for p in both)
        rad = max(float(np.sqrt(np.mean(np.sum(p.turns**2, axis=1)))) for p in both)
        return Scales(max(m, 1e-9), max(rad, 1e-9))


def residual_rows(paths: TipPaths, fit: Fit) -> dict[str, np.ndarray]:
    """Standard deviation of each held row about the mean of its trajectory, largest first."""
    out = {}
    for name in fit.candidate.holds:
        value = paths.centred(QUANTITIES[name].evaluate(paths, fit.place)[0])
        rows = np.sqrt(np.linalg.eigvalsh(value.T @ value / len(value))[::-1].clip(0.0))
        out[name] = rows[: QUANTITIES[name].rank]
    return out


def recombination_ratio(fit: Fit, paths: TipPaths, recombined: TipPaths) -> float:
    """Least ratio over the held rows; rows that the arm cannot move anyway are left out, 0 if none is left."""
    mixed, own = residual_rows(recombined, fit), residual_rows(paths, fit)
    ratios = []
    for name in fit.candidate.holds:
        floor = SMALLEST[QUANTITIES[name].unit]
        movable = mixed[name] > floor
        ratios += (mixed[name] / np.hypot(own[name], floor))[movable].tolist()
    return float(min(ratios, default=0.0))


def margins(fit: Fit, scales: Scales) -> np.ndarray:
    """Scale over residual of each held row."""
    out = []
    for name in fit.candidate.holds:
        unit = QUANTITIES[name].unit
        out.append((scales.m if unit == "m" else scales.rad) / np.hypot(fit.held_out[name], SMALLEST[unit]))
    return np.concatenate(out)


def score(fit: Fit, scales: Scales) -> float:
    """Sum of log (margin / HELD) less the price of the parameters."""
    return float(np.sum(np.log(margins(fit, scales) / HELD))) - PRICE * fit.candidate.n_unknowns


def unevenness(fit: Fit) -> float:
    """Largest over smallest residual of the held rows; below the usual noise of encoders differences do not count."""
    sizes = [
        np.maximum(fit.held_out[n], 5.0 * SMALLEST[QUANTITIES[n].unit])
        * (LEVER if QUANTITIES[n].unit == "rad" else 1.0)
        for n in fit.candidate.holds
    ]
    return float(max(s.max() for s in sizes) / min(s.min() for s in sizes))


def disagreement(paths: TipPaths, fit: Fit) -> tuple[float, bool]:
    """Median over trajectories: residual in the common fit over that of the trajectory by itself; and whether a few of
    them are unlike the others in that, or in how tightly they are held by themselves.

    One door shared gives about 1; a door that stands elsewhere each time fits each trajectory alone much better; a grip
    that slips in one of them spoils the common fit, and its own.
    """
    ratios, sizes = [], []
    for i in range(len(paths.starts)):
        part = paths.alone(i)
        alone = residual_rows(part, fit_candidate(part, fit.candidate, [fit.place]))
        together = residual_rows(part, fit)
        floors = {n: 5.0 * SMALLEST[QUANTITIES[n].unit] for n in fit.candidate.holds}
        own = {n: np.hypot(alone[n], floor) for n, floor in floors.items()}
        ratios.append(max(float(np.max(np.hypot(together[n], floor) / own[n])) for n, floor in floors.items()))
        sizes.append(max(float(np.max(own[n])) / floor for n, floor in floors.items()))
    unlike = max(ratios) > UNLIKE or max(sizes) > DISAGREE * float(np.median(sizes))
    return float(np.median(ratios)), unlike


def radius_of(paths: TipPaths, fit: Fit, errors: Float[np.ndarray, "k 7"] | None = None) -> tuple[float, float] | None:
    """Mean distance from the axis or the centre and its standard deviation [m]; None where there is none.

    With draws of the error of axis, point and pitch these make the standard deviation, not the fit's covariance.
    """
    unknowns = fit.candidate.unknowns
    name = "distance" if "point" in unknowns else "radius" if "point-across" in unknowns else None
    if name is None:
        return None
    values, J = QUANTITIES[name].evaluate(paths, fit.place)
    slope = J.mean(axis=(0, 1))
    if errors is not None:
        return float(values.mean()), float(np.std(errors @ slope))
    slope = slope @ fit.tangents
    return float(values.mean()), float(np.sqrt(max(slope @ fit.covariance @ slope, 0.0)))


def bends(paths: TipPaths, simple: Fit, richer: Fit) -> bool:
    """Whether the data show what a simpler mechanism lacks, a curvature or a pitch: measurable, and more than rails
    wobble.
    """
    if "pitch" in richer.candidate.unknowns:
        index = int(np.argmax(richer.tangents[6]))
        size = abs(richer.place.pitch), float(np.sqrt(richer.covariance[index, index]))
    else:
        size = radius_of(paths, richer) or (0.0, 0.0)
        if size[0] > FARTHEST:
            return False
    rest = [
        sum(float(np.sum(f.held_out[n] ** 2)) for n in f.candidate.holds if QUANTITIES[n].unit == "m")
        for f in (simple, richer)
    ]
    return size[0] > CLEARLY * size[1] and rest[0] - rest[1] > BENT**2
