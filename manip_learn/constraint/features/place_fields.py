"""Directions that depend on where the hand is: each row of a mechanism as weights on the hand's velocity.

With the hand's velocity (v, w), origin p, axis a (unit length) through the point c, d = p - c, x = d - (a.d) a and
rho = |x|, a row is f(p).v + g(p).w. Every field comes with its exact derivative along p, over many places at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.robot.rotations import skew

ON_AXIS = 1e-5  # [m] below this distance from the axis (or the centre) a direction fades to zero instead of flipping
Field = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]
Row = tuple[Field | None, Field | None]


@final
@dataclass(frozen=True, eq=False)
class Geometry:
    """Where a mechanism is, in the base frame.

    Attributes:
        axis: Unit vector a.
        point: A point c on the axis, or the centre of a ball [m].
        pitch: Travel along the axis a radian of turning [m/rad].
        across: Two unit vectors, shape (2, 3), that make a right-handed base with the axis.
    """

    axis: Float[np.ndarray, " 3"]
    point: Float[np.ndarray, " 3"]
    pitch: float
    across: Float[np.ndarray, "2 3"]

    @staticmethod
    def of(axis: Float[np.ndarray, " 3"], point: Float[np.ndarray, " 3"], pitch: float = 0.0) -> Geometry:
        """The geometry of an axis that need not have unit length."""
        unit = axis / np.linalg.norm(axis)
        return Geometry(unit, point, pitch, across(unit))


def across(axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "2 3"]:
    """Two unit vectors that make a right-handed orthonormal base with a unit vector: (first, second, axis)."""
    a = axis.tolist()  # three numbers: floats are faster than arrays
    least = min(range(3), key=lambda i: abs(a[i]))
    first = [-a[least] * x for x in a]
    first[least] += 1.0
    x = np.array(first)
    x /= math.sqrt(x @ x)
    return np.array([x, skew(axis) @ x])


def _constant(vector: np.ndarray, n: int) -> Field:
    return np.broadcast_to(vector, (n, 3)), np.zeros((n, 3, 3))


def _unit(x: np.ndarray, projector: np.ndarray) -> Field:
    """x / sqrt(|x|^2 + ON_AXIS^2) and its derivative, where dx/dp is the projector."""
    length = np.sqrt(np.einsum("ni,ni->n", x, x) + ON_AXIS**2)
    n = x / length[:, None]
    return n, (projector - n[:, :, None] * n[:, None, :]) / length[:, None, None]


def _from_axis(p: np.ndarray, geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    projector = np.eye(3) - np.outer(geometry.axis, geometry.axis)
    return (p - geometry.point) @ projector, projector


def radial(p: np.ndarray, geometry: Geometry) -> Row:
    """Away from the axis: f = x / rho, df/dp = (I - a a^T - f f^T) / rho."""
    return _unit(*_from_axis(p, geometry)), None


def tangential(p: np.ndarray, geometry: Geometry) -> Row:
    """Around the axis: f = a x radial."""
    n, dn = _unit(*_from_axis(p, geometry))
    turn = skew(geometry.axis)
    return (n @ turn.T, turn @ dn), None


def spherical(p: np.ndarray, geometry: Geometry) -> Row:
    """Away from the centre: f = d / |d|, df/dp = (I - f f^T) / |d|."""
    return _unit(p - geometry.point, np.eye(3)), None


def helical(p: np.ndarray, geometry: Geometry) -> Row:
    """Across the helix and along its cylinder: f = (rho^2 a - h a x x) / (rho sqrt(rho^2 + h^2)), so that f is
    orthogonal to the velocity a x x + h a of a point that a screw of pitch h moves.
    """
    x, projector = _from_axis(p, geometry)
    h, a, turn = geometry.pitch, geometry.axis, skew(geometry.axis)
    s = np.einsum("ni,ni->n", x, x)
    size = np.sqrt((s + ON_AXIS**2) * (s + h**2 + ON_AXIS**2))[:, None]
    f = (s[:, None] * a - h * x @ turn.T) / size
    dsize = (2.0 * s + h**2 + 2.0 * ON_AXIS**2)[:, None] * x / size
    df = 2.0 * a[:, None] * x[:, None, :] - h * turn @ projector
    return (f, (df - f[:, :, None] * dsize[:, None, :]) / size[:, :, None]), None


def axial(p: np.ndarray, geometry: Geometry) -> Row:
    """Along the axis: f = a."""
    return _constant(geometry.axis, len(p)), None


def _turn(direction: np.ndarray, p: np.ndarray) -> Row:
    return None, _constant(direction, len(p))


def _slide(direction: np.ndarray, p: np.ndarray, geometry: Geometry, pitch: float = 0.0) -> Row:
    """Velocity e.(v + w x (c - p)) - h e.w of the hand's point that is at c, so g = (c - p) x e - h e."""
    derivative = np.broadcast_to(skew(direction), (len(p), 3, 3))
    angular = np.cross(geometry.point - p, direction) - pitch * direction
    return _constant(direction, len(p)), (angular, derivative)


# Units are those of the row times a joint velocity.
FIELDS: dict[str, tuple[str, Callable[[np.ndarray, Geometry], Row]]] = {
    "radial": ("m/s", radial),
    "tangential": ("m/s", tangential),
    "axial": ("m/s", axial),
    "helical": ("m/s", helical),
    "spherical": ("m/s", spherical),
    "turn-1": ("rad/s", lambda p, g: _turn(g.across[0], p)),
    "turn-2": ("rad/s", lambda p, g: _turn(g.across[1], p)),
    "turn": ("rad/s", lambda p, g: _turn(g.axis, p)),
    "slide-1": ("m/s", lambda p, g: _slide(g.across[0], p, g)),
    "slide-2": ("m/s", lambda p, g: _slide(g.across[1], p, g)),
    "slide": ("m/s", lambda p, g: _slide(g.axis, p, g)),
    "screw": ("m/s", lambda p, g: _slide(g.axis, p, g, g.pitch)),
}


def weights(
    names: tuple[str, ...], p: Float[np.ndarray, "n 3"], geometry: Geometry
) -> tuple[Float[np.ndarray, "n k 6"], Float[np.ndarray, "n k 6 3"]]:
    """W(p) and dW/dp for the rows of that name: row i of W weighs (v, w) of the hand."""
    W, dW = np.zeros((len(p), len(names), 6)), np.zeros((len(p), len(names), 6, 3))
    for i, name in enumerate(names):
        for start, field in zip((0, 3), FIELDS[name][1](p, geometry), strict=True):
            if field is not None:
                W[:, i, start : start + 3], dW[:, i, start : start + 3] = field
    return W, dW
