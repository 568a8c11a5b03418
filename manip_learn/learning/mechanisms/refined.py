"""The mechanism that was chosen, at its most likely place, in the terms of a machine."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.mechanism import Mechanism
from manip_learn.learning.mechanisms.choice import axes_apart, with_shared
from manip_learn.learning.mechanisms.evidence import radius_of
from manip_learn.learning.mechanisms.fits import Fit, fit_candidate
from manip_learn.learning.mechanisms.residuals import angles_about, turn_about
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
    rival: Fit | None,
    rng: np.random.Generator,
) -> tuple[Fit, Mechanism]:
    """The chosen candidate at its most likely place, from nearly all samples, and what that is.

    Args:
        robot: The robot.
        tip: The frame that is held.
        postures: Along each trajectory, as they were recorded.
        start: The candidate with a place to start from.
        rival: Another that fits as well.
        rng: For draws of the error.
    """
    few = [thinned(q, max(LEAST, SAMPLES // len(postures))) for q in postures]
    fine = TipPaths.of(robot, tip, few)
    fit = with_shared(fine, fit_candidate(fine, start.candidate, [start.place]))
    weighted = fit_weighted(fine, batch_kinematics(robot, tip).jacobian(np.concatenate(few)), fit, rng)
    fit = dataclasses.replace(fit, place=weighted.place)
    return fit, _described(fine, fit, weighted, rival)


def _described(paths: TipPaths, fit: Fit, weighted: WeightedFit, rival: Fit | None = None) -> Mechanism:
    """The mechanism of a fit, with the uncertainty of each parameter; a rival that fits as well widens the axis."""
    c, place = fit.candidate, fit.place
    axis = place.axis * (1.0 if place.axis[int(np.argmax(np.abs(place.axis)))] > 0.0 else -1.0)
    known, radius = set(c.unknowns), weighted.radius or radius_of(paths, fit, weighted.errors)
    uncertainty: dict[str, float] = {}
    if "axis" in known:
        uncertainty["axis"] = float(np.degrees(weighted.within(slice(0, 3))))
        if rival is not None and rival.candidate.type == "screw":
            uncertainty["axis"] = max(uncertainty["axis"], axes_apart(fit, rival))
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
