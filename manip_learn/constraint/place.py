"""Where a mechanism is, and the weights W(p) of a hand's twist (v, w) in its rows: f(p).v + g(p).w.

With the origin p of the hand, the axis a (unit length) through the point c, d = p - c, x = d - (a.d) a and rho = |x|,
f and g are affine in p on a mechanism of known radius; rows of a hand that may be at any distance are made unit length.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.robot.rotations import skew

# Units are those of the row times a joint velocity.
AXIS_UNITS = {**dict.fromkeys(("x", "y", "z"), "m/s"), **dict.fromkeys(("rx", "ry", "rz"), "rad/s")}
AXES = tuple(AXIS_UNITS)  # rows of a twist (v, w)
ON_AXIS = 1e-5  # [m] below this distance from the axis (or the centre) a direction fades to zero instead of flipping
ROW_UNITS: dict[str, str] = {
    **dict.fromkeys(("radial", "tangential", "axial", "helical", "spherical", "across-1", "across-2"), "m/s"),
    **dict.fromkeys(("turn-1", "turn-2", "turn"), "rad/s"),
    **dict.fromkeys(("slide-1", "slide-2", "slide", "screw"), "m/s"),
}
AT_A_DISTANCE = ("radial", "tangential", "helical", "spherical")  # rows that ask how far the hand is


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

    def as_told(self) -> Place:
        """This place, its axis in the sense in which mechanisms are told: the largest number is positive.

        The pitch stays: of an axis the other way both the turn and the travel count the other way.
        """
        sense = 1.0 if self.axis[int(np.argmax(np.abs(self.axis)))] > 0.0 else -1.0
        return Place(sense * self.axis, self.point, self.pitch)

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


def mechanism_weights(names: tuple[str, ...], place: Place, radius: float | None) -> PlaceWeights:
    """The rows of that name, see `MechanismRows`.

    - `radial` f = x / rho; `tangential` f = a x x / rho; `spherical` f = d / |d|;
    - `helical` f = (rho^2 a - h a x x) / (rho sqrt(rho^2 + h^2)), orthogonal to the velocity a x x + h a of a point
      that a screw of pitch h moves;
    - `axial` f = a and `across-1`, `across-2`; `turn` g = a and `turn-1`, `turn-2`;
    - `slide` and `screw`, the velocity e.(v + w x (c - p)) - h e.w of the hand's point that is at c: f = e and
      g = (c - p) x e - h e.

    With a radius, rho (and |d|) in these formulas are that number; without one they are the hand's own.
    """
    a, c, h = place.axis, place.point, place.pitch
    directions = {"1": place.across[0], "2": place.across[1]}
    outward, around = np.eye(3) - np.outer(a, a), skew(a)
    fields = {"radial": outward, "tangential": around, "spherical": np.eye(3), "helical": around}
    constant, by_place = np.zeros((len(names), 6)), np.zeros((len(names), 6, 3))
    free = {i: (a, h) if x == "helical" else (np.zeros(3), 0.0) for i, x in enumerate(names) if x in fields}
    for i, name in enumerate(names):
        e = directions.get(name[-1], a)
        if name in fields:
            by_place[i, :3] = fields[name]
            if radius is not None and name == "helical":
                by_place[i, :3] *= -h / (radius * math.hypot(radius, h))
                constant[i, :3] = radius / math.hypot(radius, h) * a
            elif radius is not None:
                by_place[i, :3] *= 1.0 / radius
            constant[i, :3] -= by_place[i, :3] @ c
        elif name.startswith("turn"):
            constant[i, 3:] = e
        else:
            constant[i, :3] = e
        if name.startswith(("slide", "screw")):
            by_place[i, 3:] = skew(e)
            constant[i, 3:] = np.cross(c, e) - (h * e if name == "screw" else 0.0)
    return PlaceWeights(constant, by_place, free if radius is None else {})


@final
@dataclass(frozen=True, eq=False)
class PlaceWeights:
    """W(p) = T_0 + sum_k p_k T_k; row i weighs (v, w) of a frame whose origin is at p, in the base frame.

    Attributes:
        constant: T_0, shape (r, 6).
        by_place: T_k, shape (r, 6, 3).
        free: Rows whose weights of v, y = T_0 + sum_k p_k T_k, are made unit length, y / sqrt(|y|^2 + e^2) with
            e = `ON_AXIS`; with a direction b (otherwise zero) and a pitch h those of a helix about b at any distance,
            (|y|^2 b - h y) / sqrt((|y|^2 + e^2) (|y|^2 + h^2 + e^2)). By number: b and h.
    """

    constant: Float[np.ndarray, "r 6"]
    by_place: Float[np.ndarray, "r 6 3"]
    free: Mapping[int, tuple[Float[np.ndarray, " 3"], float]] = field(default_factory=dict)

    def values(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n r 6"]:
        """W(p) at n places [m]."""
        W = self.constant + (p @ self.by_place.reshape(-1, 3).T).reshape(len(p), -1, 6)
        for i, (b, h) in self.free.items():
            y = W[:, i, :3]
            s = (y * y).sum(1, keepdims=True)
            edge = s + ON_AXIS**2
            W[:, i, :3] = (s * b - h * y) / np.sqrt(edge * (edge + h * h)) if b.any() else y / np.sqrt(edge)
        return W

    def at(self, p: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n r 6"], Float[np.ndarray, "n r 6 3"]]:
        """W(p) and dW/dp at n places [m]."""
        W, dW = self.values(p), np.broadcast_to(self.by_place, (len(p), *self.by_place.shape))
        dW = dW.copy() if self.free else dW
        for i in self.free:
            dW[:, i, :3] = self.slopes(i, p, W[:, i, :3])
        return W, dW

    def slopes(self, i: int, p: Float[np.ndarray, "n 3"], f: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
        """The derivative along p of the weights f of v in a free row."""
        (b, h), Y = self.free[i], self.by_place[i, :3]
        y = self.constant[i, :3] + p @ Y.T
        edge, along = (y * y).sum(1)[:, None] + ON_AXIS**2, y @ Y
        size, df, rise = np.sqrt(edge), Y, 1.0
        if b.any():
            size, rise = np.sqrt(edge * (edge + h * h)), 2.0 * edge + h * h
            df = 2.0 * b[:, None] * along[:, None] - h * Y
        return (df - f[:, :, None] * (rise * along / size)[:, None]) / size[:, None]
