"""Where a mechanism is, and its rows as weights on the hand's velocity that are affine in the hand's place.

With the hand's velocity (v, w), origin p, axis a (unit length) through the point c, d = p - c, x = d - (a.d) a and
rho = |x|, a row is f(p).v + g(p).w. On a mechanism of known radius f and g are affine in p; rows of a hand that may be
at any distance are made unit length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.weighed_velocity import PlaceWeights
from manip_learn.robot.rotations import skew


@final
@dataclass(frozen=True, eq=False)
class Place:
    """Where a mechanism is, in the base frame.

    Attributes:
        axis: Unit vector a.
        point: A point c on the axis, or the centre of a ball [m].
        pitch: Travel along the axis a radian of turning [m/rad].
    """

    axis: Float[np.ndarray, " 3"]
    point: Float[np.ndarray, " 3"]
    pitch: float = 0.0

    @cached_property
    def across(self) -> Float[np.ndarray, "2 3"]:
        """Two unit vectors that make a right-handed base with the axis."""
        return across(self.axis)

    def moved(self, step: Float[np.ndarray, " 7"]) -> Place:
        """The place after a step of the seven numbers axis, point, pitch."""
        axis = self.axis + step[:3]
        return Place(axis / np.linalg.norm(axis), self.point + step[3:6], self.pitch + float(step[6]))


def across(axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "2 3"]:
    """Two unit vectors that make a right-handed orthonormal base with a unit vector: (first, second, axis)."""
    a = axis.tolist()  # three numbers: floats are faster than arrays
    least = min(range(3), key=lambda i: abs(a[i]))
    first = [-a[least] * x for x in a]
    first[least] += 1.0
    x = np.array(first)
    x /= math.sqrt(x @ x)
    return np.array([x, skew(axis) @ x])


# Units are those of the row times a joint velocity.
FIELDS: dict[str, str] = {
    **dict.fromkeys(("radial", "tangential", "axial", "helical", "spherical"), "m/s"),
    **dict.fromkeys(("turn-1", "turn-2", "turn"), "rad/s"),
    **dict.fromkeys(("slide-1", "slide-2", "slide", "screw"), "m/s"),
}
AT_A_DISTANCE = ("radial", "tangential", "helical", "spherical")  # rows that ask how far the hand is


def mechanism_weights(names: tuple[str, ...], place: Place, radius: float | None) -> PlaceWeights:
    """The rows of that name, see `MechanismRows`.

    - `radial` f = x / rho; `tangential` f = a x x / rho; `spherical` f = d / |d|;
    - `helical` f = (rho^2 a - h a x x) / (rho sqrt(rho^2 + h^2)), orthogonal to the velocity a x x + h a of a point
      that a screw of pitch h moves;
    - `axial` f = a; `turn` g = a;
    - `slide` and `screw`, the velocity e.(v + w x (c - p)) - h e.w of the hand's point that is at c: f = e and
      g = (c - p) x e - h e.

    With a radius, rho (and |d|) in these formulas are that number; without one they are the hand's own.
    """
    a, c, h = place.axis, place.point, place.pitch
    directions = {"1": place.across[0], "2": place.across[1]}
    outward, around = np.eye(3) - np.outer(a, a), skew(a)
    fields = {"radial": outward, "tangential": around, "spherical": np.eye(3), "helical": around}
    constant, by_place = np.zeros((len(names), 6)), np.zeros((len(names), 6, 3))
    free = dict[int, tuple[np.ndarray, float]]()
    for i, name in enumerate(names):
        e = directions.get(name[-1], a)
        if name in AT_A_DISTANCE:
            screws = name == "helical"
            scale = 1.0
            if radius is None:
                free[i] = (a, h) if screws else (np.zeros(3), 0.0)
            elif screws:
                scale = -h / (radius * math.hypot(radius, h))
                constant[i, :3] = radius / math.hypot(radius, h) * a
            else:
                scale = 1.0 / radius
            by_place[i, :3] = scale * fields[name]
            constant[i, :3] -= by_place[i, :3] @ c
        elif name == "axial":
            constant[i, :3] = a
        elif name.startswith("turn"):
            constant[i, 3:] = e
        else:
            constant[i, :3], by_place[i, 3:] = e, skew(e)
            constant[i, 3:] = np.cross(c, e) - (h * e if name == "screw" else 0.0)
    return PlaceWeights(constant, by_place, free)
