"""Stretches of whole recordings cut to where a mechanism holds: constant rows do not show every end of a contact."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.learning.mechanisms.consensus import consensus, usual_residuals
from manip_learn.learning.mechanisms.evidence import DISAGREE, Scales, residual_rows
from manip_learn.learning.mechanisms.find_mechanism import SAMPLES
from manip_learn.learning.mechanisms.fits import Fit
from manip_learn.learning.mechanisms.residuals import QUANTITIES
from manip_learn.learning.mechanisms.tip_paths import TipPaths, thinned
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.frame import Frame
from manip_learn.robot.robot import Robot

INNER = 0.2  # share of a stretch at either end that may not belong to the contact


def where_held(robot: Robot, frame: Frame, trajectories: Sequence[Trajectory], rows: int) -> list[slice] | None:
    """Samples of each trajectory in which the mechanism holds on which the inner parts of most agree.

    All samples of a trajectory whose inner part does not obey it. None if there is no such mechanism.

    Args:
        robot: The robot.
        frame: The frame that is held.
        trajectories: Stretches of recordings, one contact each.
        rows: Rows that are held anyway: the mechanism must hold more.
    """
    inner = [slice(int(INNER * len(t)), len(t) - int(INNER * len(t))) for t in trajectories]
    paths = TipPaths.of(
        robot, frame, [thinned(t.q[part], SAMPLES) for t, part in zip(trajectories, inner, strict=True)]
    )
    found = consensus(paths, rows, Scales.of(paths, None))
    if found is None:
        return None
    fit, members = found
    usual = usual_residuals([residual_rows(paths.alone(i), fit) for i in members])
    out = [slice(0, len(t)) for t in trajectories]
    for i in members:
        obeys = _obeys(TipPaths.of(robot, frame, [trajectories[i].q]), fit, inner[i], usual)
        outside = np.flatnonzero(~obeys)
        before, after = outside[outside < inner[i].start], outside[outside >= inner[i].stop]
        out[i] = slice(int(before[-1]) + 1 if len(before) else 0, int(after[0]) if len(after) else len(obeys))
    return out


def _obeys(
    path: TipPaths, fit: Fit, inner: slice, usual: dict[str, Float[np.ndarray, " rank"]]
) -> Bool[np.ndarray, " N"]:
    out = np.ones(len(path.p), dtype=bool)
    for name in fit.candidate.holds:
        value = QUANTITIES[name].evaluate(path, fit.place)[0]
        away = np.linalg.norm(value - np.median(value[inner], axis=0), axis=1)
        out &= away <= DISAGREE * float(np.max(usual[name]))
    return out
