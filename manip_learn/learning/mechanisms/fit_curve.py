"""A curve in space that the hand keeps to where no mechanism does: least squares, from its own paths."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_lsq_spline

from manip_learn.constraint.features.curve_rows import Curve
from manip_learn.errors import FeatureError
from manip_learn.learning.mechanisms.place_fit import LEAST_RESIDUAL, alike
from manip_learn.learning.mechanisms.quantities import TipPaths

_CUBIC = 3  # degree of the spline: its curvature is continuous
PIECES = (2, 4, 8, 16, 32)  # of the spline that is fitted: as many as foretell the other trajectories best
_ROUNDS = 5  # of fitting, each to the places on the curve that are next to the samples
_POINTS = 4  # of the curve in each piece of the spline
FIRST = 8  # points of the curve that the fit begins with


def fit_curve(paths: TipPaths) -> tuple[Curve, Float[np.ndarray, "N 3"]] | None:
    """The curve next to the places of the hand, and where from it they are [m], each judged by the curve of the other
    trajectories; None where there are fewer than three of these, or where the hand stays at one place.
    """
    parts = paths.parts
    if len(parts) < 3:
        return None
    best: tuple[Curve, np.ndarray] | None = None
    try:
        p = paths.p[max(parts, key=lambda part: float(np.ptp(paths.p[part], axis=0).sum()))]
        # from its beginning to its farthest place, without what it goes back meanwhile
        away = np.linalg.norm(p - p[0], axis=1)
        onward = np.unique(np.maximum.accumulate(away[: int(np.argmax(away)) + 1]), return_index=True)[1]
        curve = Curve(p[onward][np.linspace(0, len(onward) - 1, min(FIRST, len(onward))).round().astype(int)])
        for pieces in PIECES:
            for _ in range(_ROUNDS):
                curve = _through(curve, paths.p, pieces)
            off = np.empty_like(paths.p)
            for part in parts:
                own = np.delete(paths.p, np.arange(part.start, part.stop), axis=0)
                others = _through(curve, own, pieces)
                off[part] = paths.p[part] - others.at(others.nearest(paths.p[part]))
            if best is None or np.mean(off**2) < np.mean(best[1] ** 2):
                best = curve, off
    except (FeatureError, ValueError):  # more pieces than samples can tell, or a hand that stands still
        return best
    return best


def gain_in_nats(variance: float, off: Float[np.ndarray, "N 3"], paths: TipPaths) -> float:
    """Of a curve over something that leaves this variance in each direction that it holds [m^2]."""
    least = LEAST_RESIDUAL["m"] ** 2
    return len(off) / alike(off, paths.parts) * float(np.log((variance + least) / (variance_across(off) + least)))


def variance_across(off: Float[np.ndarray, "N 3"]) -> float:
    """Mean square in one of the two directions across a curve [m^2]."""
    return 0.5 * float(np.mean(np.sum(off**2, axis=1)))


def _through(curve: Curve, p: Float[np.ndarray, "n 3"], pieces: int) -> Curve:
    """The spline of so many pieces next to places, at the lengths at which a curve is nearest to them."""
    s = curve.nearest(p)
    order = np.argsort(s)
    s, p = s[order], p[order]
    inside = np.quantile(s, np.arange(1, pieces) / pieces)
    knots = np.concatenate([np.full(_CUBIC + 1, s[0]), inside, np.full(_CUBIC + 1, s[-1])])
    return Curve(make_lsq_spline(s, p, knots, _CUBIC)(np.linspace(s[0], s[-1], _POINTS * pieces + 1)))
