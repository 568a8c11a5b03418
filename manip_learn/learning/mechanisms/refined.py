"""The mechanism that was chosen, at its most likely place, in the terms of a machine."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.mechanism import Mechanism
from manip_learn.learning.deciding import SHARED_LOSS, SMALLEST_RESIDUAL
from manip_learn.learning.mechanisms.fits import Fit, fit_candidate
from manip_learn.learning.mechanisms.residuals import QUANTITIES, angles_about, turn_about
from manip_learn.learning.mechanisms.tip_paths import TipPaths, thinned
from manip_learn.learning.mechanisms.weighted_fit import WeightedFit, fit_weighted
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.frame import Frame
from manip_learn.robot.robot import Robot

SAMPLES, LEAST = 4000, 60  # of all trajectories in the last fit, and of each


def refined(
    robot: Robot,
    tip: Frame,
    postures: Sequence[Float[np.ndarray, "_ nv"]],
    start: Fit,
    rng: np.random.Generator,
) -> tuple[Fit, Mechanism]:
    """The chosen candidate at its most likely place, from nearly all samples, and what that is.

    Args:
        robot: The robot.
        tip: The frame that is held.
        postures: Along each trajectory, as they were recorded.
        start: The candidate with a place to start from.
        rng: For draws of the error.
    """
    few = [thinned(q, max(LEAST, SAMPLES // len(postures))) for q in postures]
    fine = TipPaths.of(robot, tip, few)
    fit = _with_shared(fine, fit_candidate(fine, start.candidate, [start.place]))
    weighted = fit_weighted(fine, batch_kinematics(robot, tip).jacobian(np.concatenate(few)), fit, rng)
    fit = dataclasses.replace(fit, place=weighted.place)
    return fit, _described(fine, fit, weighted)


def _described(paths: TipPaths, fit: Fit, weighted: WeightedFit) -> Mechanism:
    """The mechanism of a fit, with the uncertainty of each parameter."""
    c, place = fit.candidate, fit.place
    axis = place.axis * (1.0 if place.axis[int(np.argmax(np.abs(place.axis)))] > 0.0 else -1.0)
    known, radius = set(c.unknowns), weighted.radius or radius_of(paths, fit, weighted.errors)
    uncertainty: dict[str, float] = {}
    if "axis" in known:
        uncertainty["axis"] = float(np.degrees(weighted.within(slice(0, 3))))
    if known & {"point", "point-across"}:
        uncertainty["point"] = weighted.within(slice(3, 6))
    if radius is not None:
        uncertainty["radius"] = radius[1]
    if "pitch" in known:
        uncertainty["pitch"] = weighted.within(slice(6, 7))
    return Mechanism(
        c.type,
        axis if "axis" in known else None,
        None if c.type == "held-orientation" else place.point,
        None if radius is None else radius[0],
        place.pitch if "pitch" in known else None,
        "loose" if c.orientation == "free" else "firm",
        c.orientation,
        uncertainty,
        _arc(paths, fit),
        c.name,
    )


def _arc(paths: TipPaths, fit: Fit) -> float | None:
    c = fit.candidate
    if c.orientation == "carried" and "axis" in c.unknowns:
        angle = turn_about(paths, fit.place.axis)
    elif "point-across" in c.unknowns:
        angle = angles_about(paths, fit.place)
    elif "point" in c.unknowns:
        d = paths.p - fit.place.point
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        mean = d.mean(axis=0) / np.linalg.norm(d.mean(axis=0))
        return float(2.0 * np.arccos(np.clip(d @ mean, -1.0, 1.0)).max())
    else:
        return None
    return float(max(np.ptp(angle[paths.part(i)]) for i in range(len(paths.starts))))


def _with_shared(paths: TipPaths, fit: Fit) -> Fit:
    """The fit with as many quantities as the data allow the same for all trajectories: better determined."""
    names = [n for n in fit.candidate.holds if n in ("radius", "height", "distance", "across-line")]
    trials = [tuple(names), *((n,) for n in names if len(names) > 1)]
    for shared in trials:
        if not shared:
            break
        tied = fit_candidate(paths, fit.candidate, [fit.place], shared)
        if all(
            np.all(
                np.hypot(tied.held_out[n], SMALLEST_RESIDUAL[QUANTITIES[n].unit])
                <= SHARED_LOSS * np.hypot(fit.held_out[n], SMALLEST_RESIDUAL[QUANTITIES[n].unit])
            )
            for n in fit.candidate.holds
        ):
            return tied
    return fit


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
