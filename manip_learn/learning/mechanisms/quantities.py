"""What each mechanism keeps constant along the hand's path, and how it moves with the mechanism's place and the hand.

Derivatives are taken along the seven numbers of the place, axis a (3), point c (3), pitch h (1). How errors of the
joints move a quantity follows from them: to move the hand is to move the place the other way, seen from the hand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.mechanism_rows import Place
from manip_learn.learning.mechanisms.tip_paths import TipPaths
from manip_learn.robot.rotations import left_jacobian_inverse, skew

NEAR_AXIS = 1e-4  # [m] angles about an axis are not trusted closer to it


Slopes = Float[np.ndarray, "N d 7"]
Values = tuple[Float[np.ndarray, "N d"], Slopes]


@final
@dataclass(frozen=True)
class Quantity:
    """Something that a mechanism holds constant.

    Attributes:
        evaluate: Values and derivatives along the paths.
        width: Number of values.
        rank: How many independent rows they stand for.
        unit: `"m"` or `"rad"`.
        by_twist: Derivatives along the twist of the frame in base axes, linear part first, from those by the place.
    """

    evaluate: Callable[[TipPaths, Place], Values]
    width: int
    rank: int
    unit: Literal["m", "rad"]
    by_twist: Callable[[TipPaths, Place, Slopes], Float[np.ndarray, "N d 6"]]


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
    J[:, :, :3], J[:, :, 3:6] = -(d @ place.axis)[:, None, None] * base, -base
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


def _of_position(paths: TipPaths, place: Place, J: Slopes) -> Float[np.ndarray, "N d 6"]:
    return np.concatenate([-J[:, :, 3:6], np.zeros((*J.shape[:2], 3))], axis=2)


def _seen_from_hand(paths: TipPaths, place: Place, J: Slopes) -> Float[np.ndarray, "N d 6"]:
    lever = -np.cross((place.point - paths.p)[:, None, :], np.eye(3))  # [c - p]_x
    return np.concatenate([-J[:, :, 3:6], J[:, :, :3] @ skew(place.axis) + J[:, :, 3:6] @ lever], axis=2)


def _along_screw(paths: TipPaths, place: Place, J: Slopes) -> Float[np.ndarray, "N d 6"]:
    """The hand's turn about the axis moves it along the axis, too."""
    out = _seen_from_hand(paths, place, J)
    out[:, :, 3:] += paths.R.transpose(0, 2, 1) @ (place.pitch * np.outer(place.axis, place.axis))
    return out


def _of_turns(paths: TipPaths, place: Place, J: Slopes) -> Float[np.ndarray, "N d 6"]:
    turning = np.array([left_jacobian_inverse(v) for v in paths.turns])
    return np.concatenate([np.zeros_like(turning), turning], axis=2)


QUANTITIES: dict[str, Quantity] = {
    "across-line": Quantity(_across_line, 2, 2, "m", _of_position),
    "height": Quantity(_height, 1, 1, "m", _of_position),
    "radius": Quantity(_radius, 1, 1, "m", _of_position),
    "distance": Quantity(_distance, 1, 1, "m", _of_position),
    "thread": Quantity(_thread, 1, 1, "m", _of_position),
    "axis-in-hand": Quantity(_axis_in_hand, 3, 2, "rad", _seen_from_hand),
    "point-in-hand": Quantity(_point_in_hand, 3, 3, "m", _seen_from_hand),
    "screw-in-hand": Quantity(_screw_in_hand, 3, 3, "m", _along_screw),
    "axis-line-in-hand": Quantity(_axis_line_in_hand, 3, 2, "m", _seen_from_hand),
    "orientation": Quantity(_orientation, 3, 3, "rad", _of_turns),
}
