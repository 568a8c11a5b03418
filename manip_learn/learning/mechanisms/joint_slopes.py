"""How the quantities that a mechanism holds move with the frame, and so with errors of the joints."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.place_fields import Place, mechanism_weights
from manip_learn.learning.mechanisms.residuals import NEAR_AXIS, turn_about
from manip_learn.learning.mechanisms.tip_paths import TipPaths
from manip_learn.robot.rotations import left_jacobian_inverse, skew

# derivative of a quantity along the twist of the frame in base axes, linear part first
Slope = Callable[[TipPaths, Place], Float[np.ndarray, "N d 6"]]


def _linear(slopes: Float[np.ndarray, "N d 3"]) -> Float[np.ndarray, "N d 6"]:
    return np.concatenate([slopes, np.zeros_like(slopes)], axis=2)


def _angular(slopes: Float[np.ndarray, "N d 3"]) -> Float[np.ndarray, "N d 6"]:
    return np.concatenate([np.zeros_like(slopes), slopes], axis=2)


def _skews(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3 3"]:
    return -np.cross(vectors[:, None, :], np.eye(3)[None])


def _across_line(paths: TipPaths, place: Place) -> Float[np.ndarray, "N 2 6"]:
    return _linear(np.tile(place.across, (len(paths.p), 1, 1)))


def _row(name: str) -> Slope:
    return lambda paths, place: mechanism_weights((name,), place, None).at(paths.p)[0]


def _thread(paths: TipPaths, place: Place) -> Float[np.ndarray, "N 1 6"]:
    around = np.cross(place.axis, paths.p - place.point)
    around /= np.maximum(np.sum(around**2, axis=1), NEAR_AXIS**2)[:, None]
    return _linear((place.axis - place.pitch * around)[:, None])


def _axis_in_hand(paths: TipPaths, place: Place) -> Float[np.ndarray, "N 3 6"]:
    return _angular(paths.R.transpose(0, 2, 1) @ skew(place.axis))


def _point_in_hand(paths: TipPaths, place: Place) -> Float[np.ndarray, "N 3 6"]:
    R_T = paths.R.transpose(0, 2, 1)
    return np.concatenate([-R_T, R_T @ _skews(place.point - paths.p)], axis=2)


def _screw_in_hand(paths: TipPaths, place: Place) -> Float[np.ndarray, "N 3 6"]:
    slopes, R_T = _point_in_hand(paths, place), paths.R.transpose(0, 2, 1)
    angle = place.pitch * turn_about(paths, place.axis)
    turning = place.pitch * np.outer(place.axis, place.axis) + angle[:, None, None] * skew(place.axis)
    slopes[:, :, 3:] += R_T @ turning
    return slopes


def _axis_line_in_hand(paths: TipPaths, place: Place) -> Float[np.ndarray, "N 3 6"]:
    R_T, e, P = paths.R.transpose(0, 2, 1), place.point - paths.p, np.eye(3) - np.outer(place.axis, place.axis)
    return np.concatenate([-R_T @ P, R_T @ _skews(e @ P)], axis=2)


def _orientation(paths: TipPaths, place: Place) -> Float[np.ndarray, "N 3 6"]:
    return _angular(np.array([left_jacobian_inverse(v) for v in paths.turns]))


SLOPES: dict[str, Slope] = {
    "across-line": _across_line,
    "height": _row("axial"),
    "radius": _row("radial"),
    "distance": _row("spherical"),
    "thread": _thread,
    "axis-in-hand": _axis_in_hand,
    "point-in-hand": _point_in_hand,
    "screw-in-hand": _screw_in_hand,
    "axis-line-in-hand": _axis_line_in_hand,
    "orientation": _orientation,
}
