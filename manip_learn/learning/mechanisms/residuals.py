"""What each mechanism keeps constant: residuals of the hand's path and their derivatives.

A quantity that a mechanism holds is constant along a trajectory, so its residual is the quantity less its mean over the
trajectory (its grip differs from the next one's), or less the mean over all. Derivatives are taken along the seven
numbers axis a (3), point c (3), pitch h (1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.place_fields import Place
from manip_learn.learning.mechanisms.tip_paths import TipPaths
from manip_learn.robot.rotations import skew

NEAR_AXIS = 1e-4  # [m] angles about an axis are not trusted closer to it


Values = tuple[Float[np.ndarray, "N d"], Float[np.ndarray, "N d 7"]]


@final
@dataclass(frozen=True)
class Quantity:
    """Something that a mechanism holds constant.

    Attributes:
        evaluate: Values and derivatives along the paths.
        width: Number of values.
        rank: How many independent rows they stand for.
        unit: `"m"` or `"rad"`.
    """

    evaluate: Callable[[TipPaths, Place], Values]
    width: int
    rank: int
    unit: Literal["m", "rad"]


def _cylindrical(paths: TipPaths, place: Place) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """d = p - c, z = a.d, rho, and the unit vector away from the axis."""
    d = paths.p - place.point
    z = d @ place.axis
    x = d - z[:, None] * place.axis
    rho = np.sqrt(np.einsum("ni,ni->n", x, x))
    return d, z, rho, x / np.maximum(rho, NEAR_AXIS)[:, None]


def _across_line(paths: TipPaths, place: Place) -> Values:
    base = place.across
    d = paths.p - place.point
    J = np.zeros((len(d), 2, 7))
    J[:, :, :3] = -(d @ place.axis)[:, None, None] * base
    return d @ base.T, J


def _height(paths: TipPaths, place: Place) -> Values:
    d = paths.p - place.point
    J = np.zeros((len(d), 1, 7))
    J[:, 0, :3], J[:, 0, 3:6] = d, -place.axis
    return (d @ place.axis)[:, None], J


def _radius(paths: TipPaths, place: Place) -> Values:
    _, z, rho, n = _cylindrical(paths, place)
    J = np.zeros((len(z), 1, 7))
    J[:, 0, :3], J[:, 0, 3:6] = -z[:, None] * n, -n
    return rho[:, None], J


def _distance(paths: TipPaths, place: Place) -> Values:
    d = paths.p - place.point
    length = np.sqrt(np.einsum("ni,ni->n", d, d))[:, None]
    J = np.zeros((len(d), 1, 7))
    J[:, 0, 3:6] = -d / np.maximum(length, NEAR_AXIS)
    return length, J


def angles_about(paths: TipPaths, place: Place) -> Float[np.ndarray, " N"]:
    """Angle of the path about the axis, without jumps along each trajectory [rad]."""
    base = place.across
    y = (paths.p - place.point) @ base.T
    return paths.unwrapped(np.arctan2(y[:, 1], y[:, 0]))


def turn_about(paths: TipPaths, axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " N"]:
    """Angle by which the hand has turned about an axis since the start of each trajectory [rad]."""
    vee, trace = paths.turned
    return paths.unwrapped(np.arctan2(vee @ axis, trace - 1.0))


def _thread(paths: TipPaths, place: Place) -> Values:
    d, z, rho, n = _cylindrical(paths, place)
    phi = angles_about(paths, place)
    around = n @ skew(place.axis).T / np.maximum(rho, NEAR_AXIS)[:, None]
    h, J = place.pitch, np.zeros((len(z), 1, 7))
    J[:, 0, :3] = d + h * z[:, None] * around
    J[:, 0, 3:6] = -place.axis + h * around
    J[:, 0, 6] = -phi
    return (z - h * phi)[:, None], J


def _axis_in_hand(paths: TipPaths, place: Place) -> Values:
    J = np.zeros((len(paths.p), 3, 7))
    J[:, :, :3] = paths.R.transpose(0, 2, 1)
    return np.einsum("nji,j->ni", paths.R, place.axis), J


def _point_in_hand(paths: TipPaths, place: Place) -> Values:
    J = np.zeros((len(paths.p), 3, 7))
    J[:, :, 3:6] = paths.R.transpose(0, 2, 1)
    return np.einsum("nji,nj->ni", paths.R, place.point - paths.p), J


def _screw_in_hand(paths: TipPaths, place: Place) -> Values:
    value, J = _point_in_hand(paths, place)
    psi = turn_about(paths, place.axis)
    J[:, :, 6] = psi[:, None] * np.einsum("nji,j->ni", paths.R, place.axis)
    J[:, :, :3] = (place.pitch * psi)[:, None, None] * paths.R.transpose(0, 2, 1)
    return value + place.pitch * J[:, :, 6], J


def _axis_line_in_hand(paths: TipPaths, place: Place) -> Values:
    """The point of the axis next to the hand, seen from the hand: constant across the axis, zero along it."""
    a, e = place.axis, place.point - paths.p
    along = e @ a
    R_T = paths.R.transpose(0, 2, 1)
    J = np.zeros((len(e), 3, 7))
    J[:, :, :3] = -R_T @ (along[:, None, None] * np.eye(3) + a[:, None] * e[:, None, :])
    J[:, :, 3:6] = R_T @ (np.eye(3) - np.outer(a, a))
    return np.einsum("nij,nj->ni", R_T, e - along[:, None] * a), J


def _orientation(paths: TipPaths, place: Place) -> Values:
    return paths.turns, np.zeros((len(paths.p), 3, 7))


QUANTITIES: dict[str, Quantity] = {
    "across-line": Quantity(_across_line, 2, 2, "m"),
    "height": Quantity(_height, 1, 1, "m"),
    "radius": Quantity(_radius, 1, 1, "m"),
    "distance": Quantity(_distance, 1, 1, "m"),
    "thread": Quantity(_thread, 1, 1, "m"),
    "axis-in-hand": Quantity(_axis_in_hand, 3, 2, "rad"),
    "point-in-hand": Quantity(_point_in_hand, 3, 3, "m"),
    "screw-in-hand": Quantity(_screw_in_hand, 3, 3, "m"),
    "axis-line-in-hand": Quantity(_axis_line_in_hand, 3, 2, "m"),
    "orientation": Quantity(_orientation, 3, 3, "rad"),
}
