"""Axis and point of a mechanism, its curve, and the free coordinates of a hand on it.

A hand with the origin p moves with the twist (v, w): linear velocity v of its origin, and angular velocity w. Each row
of a mechanism is a velocity f(p).v + g(p).w; its six coefficients f and g form a row of the weight matrix W(p). With
the axis `a` (unit length) through the point c, let d = p - c, x = d - (a.d) a and rho = |x|. On a mechanism of known
radius, f and g are affine in p; rows for a hand at any distance are normalised to unit length.

A mechanism displaces a body fixed to it by g(s) of SE(3), g(0) = 1: the exponential of its screws, g(s) = exp(sum_i s_i
X_i) (R. W. Brockett, "Robotic Manipulators and the Product of Exponentials Formula", 1984), or the frame that moves
along a curve. The grasp pose is at s = 0. With g = (G, t), a hand with grasp pose (p0, R0) is at

    p = G p0 + t,    R = C R0,    C = G for a carried hand, exp(sum_i s_i c_i) for a hand that turns by itself

A line is a screw that only translates, a hinge one that only rotates; screws that do both, cylinders, balls and planes
use the same formula with other numbers. A hand that may turn freely adds its own rotations as further coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from manip_learn.errors import FeatureError
from manip_learn.robot import rotations as so3

# unit of each row times a joint velocity
AXIS_UNITS = {**dict.fromkeys(("x", "y", "z"), "m/s"), **dict.fromkeys(("rx", "ry", "rz"), "rad/s")}
AXES = tuple(AXIS_UNITS)  # rows of a twist (v, w)
ON_AXIS = 1e-5  # [m] closer to the axis (or the centre) a direction fades to zero instead of flipping
ROTATION_ROWS = ("turn-1", "turn-2", "turn")  # the rows that make up an angular velocity
_VELOCITIES = "radial tangential axial helical spherical across-1 across-2 {} {} {} slide-1 slide-2 slide screw"
ROW_UNITS = {x: "rad/s" if x in ROTATION_ROWS else "m/s" for x in _VELOCITIES.format(*ROTATION_ROWS).split()}
DISTANCE_ROWS = ("radial", "tangential", "helical", "spherical")  # rows that depend on the distance of the hand


@final
@dataclass(frozen=True, eq=False)
class Place:
    """Axis, point and pitch of a mechanism in the base frame.

    Attributes:
        axis: Unit vector along the axis.
        point: A point on the axis, or the centre of a ball [m].
        pitch: Travel along the axis per radian of rotation [m/rad].
    """

    axis: Float[np.ndarray, " 3"]
    point: Float[np.ndarray, " 3"]
    pitch: float = 0.0

    def canonical(self) -> Place:
        """Return an equal place whose axis has the sign used in reports: its largest component is positive.

        The pitch does not change, because rotation and travel both change sign with the axis.
        """
        sense = 1.0 if self.axis[int(np.argmax(np.abs(self.axis)))] > 0.0 else -1.0
        return Place(sense * self.axis, self.point, self.pitch)

    def moved(self, step: Float[np.ndarray, " 7"]) -> Place:
        """Return the place with its axis, point and pitch changed by a small step, e.g. of an optimisation.

        Args:
            step: shape (7,): changes of the axis (3), of the point (3) [m] and of the pitch [m/rad].

        Returns:
            The new place; its axis is normalised to unit length.
        """
        axis = self.axis + step[:3]
        return Place(axis / np.linalg.norm(axis), self.point + step[3:6], self.pitch + float(step[6]))


def across(axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "2 3"]:
    """Return two unit vectors across an axis; the two and the axis form a right-handed orthonormal basis in this order.

    Args:
        axis: Unit vector (3,).

    Returns:
        The two vectors as rows, shape (2, 3).
    """
    a = axis.tolist()  # floats are faster than arrays for three numbers
    least = min(range(3), key=lambda i: abs(a[i]))
    first = [-a[least] * x for x in a]
    first[least] += 1.0
    x = np.array(first)
    x /= math.sqrt(x @ x)
    return np.array([x, so3.skew(axis) @ x])


def mechanism_weights(names: tuple[str, ...], place: Place, radius: float | None) -> PlaceWeights:
    r"""Return the weights W(p) that turn the twist (v, w) of a hand into rows of `MechanismRows`.

    Each row is f.v + g.w. With the axis `a`, point c and pitch h of the place, :math:`d = p - c`,
    :math:`x = d - (a^T d) \, a` and :math:`\rho = |x|`:

    - `radial`: :math:`f = x / \rho`; `tangential`: :math:`f = a \times x / \rho`; `spherical`: :math:`f = d / |d|`;
    - `helical`: :math:`f = (\rho^2 a - h \, a \times x) / (\rho \sqrt{\rho^2 + h^2})`, orthogonal to the velocity
      :math:`a \times x + h a` of a point that a screw moves;
    - `axial`: :math:`f = a`; `across-1` and `across-2`: f is one of two fixed directions across the axis;
    - `turn`: :math:`g = a`; `turn-1` and `turn-2`: g is one of the same two directions;
    - `slide`, `slide-1` and `slide-2`: :math:`f = e`, :math:`g = (c - p) \times e`, the velocity along e of the hand's
      point that is at c; e is the axis for `slide`, and the first or second direction across it for the others;
      `screw`: :math:`f = a`, :math:`g = (c - p) \times a - h a`.

    If `radius` is given, it replaces rho and |d| in these formulas.

    Args:
        names: Names of the r rows, from `ROW_UNITS`.
        place: Axis, point [m] and pitch [m/rad].
        radius: Distance of the hand from the axis or the centre [m]; None for any distance.

    Returns:
        The weights, whose `values` gives W (n, r, 6) at n positions.
    """
    a, c, h = place.axis, place.point, place.pitch
    directions = dict(zip("12", across(a), strict=True))
    fields = dict.fromkeys(("tangential", "helical"), so3.skew(a))
    fields |= {"radial": np.eye(3) - np.outer(a, a), "spherical": np.eye(3)}
    constant, by_place = np.zeros((len(names), 6)), np.zeros((len(names), 6, 3))
    free = {i: (a, h) if x == "helical" else (np.zeros(3), 0.0) for i, x in enumerate(names) if x in fields}
    for i, name in enumerate(names):
        e = directions.get(name[-1], a)
        if name in fields:
            scale = 1.0 if radius is None else 1.0 / radius
            if radius is not None and name == "helical":
                scale = -h / (radius * math.hypot(radius, h))
                constant[i, :3] = radius / math.hypot(radius, h) * a
            by_place[i, :3] = scale * fields[name]
            constant[i, :3] -= by_place[i, :3] @ c
        elif name.startswith("turn"):
            constant[i, 3:] = e
        else:
            constant[i, :3] = e
        if name.startswith(("slide", "screw")):
            by_place[i, 3:] = so3.skew(e)
            constant[i, 3:] = np.cross(c, e) - (h * e if name == "screw" else 0.0)
    return PlaceWeights(constant, by_place, free if radius is None else {})


@final
@dataclass(frozen=True, eq=False)
class PlaceWeights:
    r"""Weight matrix of the rows of a mechanism, as a function of the position p (3,) of a frame's origin.

    The product of W(p) (r, 6) and the twist (v, w) of the frame in the base frame gives r velocities.

    .. math::

        W(p) = T_0 + \sum_k p_k T_k

    Some rows are then normalised. With the entries y (3,) of such a row for v, its direction b and pitch h in `free`,
    and :math:`\varepsilon` = `ON_AXIS`, the entries for v become

    .. math::

        \frac{y}{\sqrt{|y|^2 + \varepsilon^2}} \quad (b = 0), \qquad
        \frac{|y|^2 \, b - h \, y}{\sqrt{(|y|^2 + \varepsilon^2)(|y|^2 + h^2 + \varepsilon^2)}} \quad
        \text{(a helix about } b \text{)}

    Attributes:
        constant: T_0, shape (r, 6).
        by_place: The three matrices T_k, shape (r, 6, 3).
        free: Index of each row to normalise -> direction b (3,) and pitch h [m/rad].
    """

    constant: Float[np.ndarray, "r 6"]
    by_place: Float[np.ndarray, "r 6 3"]
    free: Mapping[int, tuple[Float[np.ndarray, " 3"], float]] = field(default_factory=dict)

    def values(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n r 6"]:
        """Return the weight matrix W(p) at n positions of the hand's origin.

        Args:
            p: Positions (n, 3) [m].

        Returns:
            W, shape (n, r, 6).
        """
        W = self.constant + (p @ self.by_place.reshape(-1, 3).T).reshape(len(p), -1, 6)
        for i, (b, h) in self.free.items():
            y = W[:, i, :3]
            s = (y * y).sum(1, keepdims=True)
            edge = s + ON_AXIS**2
            W[:, i, :3] = (s * b - h * y) / np.sqrt(edge * (edge + h * h)) if b.any() else y / np.sqrt(edge)
        return W

    def at(self, p: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n r 6"], Float[np.ndarray, "n r 6 3"]]:
        """Return the weight matrix W(p) and its derivative at n positions of the hand's origin.

        Args:
            p: Positions (n, 3) [m].

        Returns:
            W (n, r, 6) and dW/dp (n, r, 6, 3).
        """
        W, dW = self.values(p), np.broadcast_to(self.by_place, (len(p), *self.by_place.shape))
        dW = dW.copy() if self.free else dW
        for i, (b, h) in self.free.items():
            Y = self.by_place[i, :3]
            y = self.constant[i, :3] + p @ Y.T
            edge, along = (y * y).sum(1)[:, None] + ON_AXIS**2, y @ Y
            size, df, rise = np.sqrt(edge), Y, 1.0
            if b.any():
                size, rise = np.sqrt(edge * (edge + h * h)), 2.0 * edge + h * h
                df = 2.0 * b[:, None] * along[:, None] - h * Y
            dW[:, i, :3] = (df - W[:, i, :3, None] * (rise * along / size)[:, None]) / size[:, None]
        return W, dW


# names of the rows: velocities across and along the curve, then angular velocities
CURVE_ROWS = ("across-1", "across-2", "along", "rx", "ry", "rz")
# largest distance from the curve, as a share of the radius of curvature, at which the nearest point is still used
LARGEST_OFFSET = 0.95


@final
class Curve:
    """Smooth curve through points, parametrised by the length along it, straight beyond both ends.

    It is a natural cubic spline over the chord length, fitted again over the length of the first spline, so that the
    tangent has unit length to 1e-4 or better. The two directions across the curve do not rotate about the tangent (R.
    L. Bishop, 1975).

    Args:
        points: Points in order, at least four, shape (k, 3) [m].

    Attributes:
        points: The points, shape (k, 3), read-only.
        length: Length from the first to the last point [m].

    Raises:
        FeatureError: Fewer than four points, points that are not finite, or two consecutive points at one position.
    """

    def __init__(self, points: ArrayLike):
        self.points = np.array(points, dtype=np.float64)
        if self.points.ndim != 2 or self.points.shape[1] != 3 or len(self.points) < 4:
            raise FeatureError(f"a curve needs at least four points (k, 3) [m], got shape {self.points.shape}")
        chords = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        if not np.all(np.isfinite(self.points)) or not np.all(chords > 0.0):
            raise FeatureError("the points of a curve must be finite, and consecutive points must differ")
        self.points.setflags(write=False)
        lengths = np.concatenate([[0.0], np.cumsum(chords)])
        for _ in range(2):  # first over the chord length, then over the curve length, from 4 midpoints per segment
            spline = CubicSpline(lengths, self.points, bc_type="natural")
            inside = lengths[:-1, None] + np.diff(lengths)[:, None] * (np.arange(4) + 0.5) / 4
            speed = np.linalg.norm(spline(inside, 1), axis=2).mean(axis=1)
            lengths = np.concatenate([[0.0], np.cumsum(speed * np.diff(lengths))])
        self._spline = CubicSpline(lengths, self.points, bc_type="natural")
        self.length = float(lengths[-1])

    def at(self, s: Float[np.ndarray, " n"], order: int = 0) -> Float[np.ndarray, "n 3"]:
        """Return positions on the curve, or their derivatives with respect to the length along it.

        Args:
            s: Lengths (n,) along the curve from its first point [m].
            order: Order of the derivative, 0 to 3; 0 for the position.

        Returns:
            shape (n, 3): positions [m], or derivatives [m / m^order].
        """
        inside = np.clip(s, 0.0, self.length)
        beyond, value = s - inside, self._spline(inside, order)
        if order == 0:
            return value + beyond[:, None] * self._spline(inside, 1)
        return value if order == 1 else np.where(beyond[:, None] == 0.0, value, 0.0)

    def tangents_at(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Return unit vectors along the curve.

        Args:
            s: Lengths (n,) along the curve [m].

        Returns:
            shape (n, 3).
        """
        along = self.at(s, 1)
        return along / np.linalg.norm(along, axis=1, keepdims=True)

    @cached_property
    def _frames(self) -> CubicSpline:
        """Return two unit vectors across the curve as a spline over its length, shape (2, 3)."""
        # 12 samples per segment: the frame's error falls with the fourth power of their spacing
        s = np.linspace(0.0, self.length, 12 * (len(self.points) - 1) + 1)
        places, tangents = self.at(s), self.tangents_at(s)
        across = np.linalg.svd(tangents[:1])[2][1:]
        across[1] = np.cross(tangents[0], across[0])
        frames = [across]
        for i in range(len(s) - 1):  # two reflections (W. Wang and others, 2008)
            step = places[i + 1] - places[i]
            half = _reflected(np.vstack([frames[-1], tangents[i]]), step)
            frames.append(_reflected(half[:2], tangents[i + 1] - half[2]))
        return CubicSpline(s, np.array(frames), bc_type="clamped")

    def frame(self, s: Float[np.ndarray, " n"], order: int = 0) -> Float[np.ndarray, "n 2 3"]:
        """Return two unit vectors across the curve, or their derivatives with respect to the length along it.

        Args:
            s: Lengths (n,) along the curve [m].
            order: Order of the derivative; 0 for the vectors.

        Returns:
            shape (n, 2, 3).
        """
        inside = np.clip(s, 0.0, self.length)
        value = self._frames(inside, order)
        return value if order == 0 else np.where((s == inside)[:, None, None], value, 0.0)

    def frames(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3 3"]:
        """Return rotation matrices whose columns are the tangent and the two directions across the curve.

        Args:
            s: Lengths (n,) along the curve [m].

        Returns:
            shape (n, 3, 3).
        """
        tangent, normal = self.tangents_at(s), self.frame(s)[:, 0]
        normal = normal - np.sum(normal * tangent, axis=1, keepdims=True) * tangent
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.stack([tangent, normal, np.cross(tangent, normal)], axis=2)

    def nearest(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the length along the curve at which it is nearest to each position.

        Args:
            p: Positions (n, 3) [m].

        Returns:
            Lengths (n,) [m]: negative on the straight extension before the first point, above `length` after the last.
        """
        # the search starts at the nearest of three samples per segment
        samples = np.linspace(0.0, self.length, 3 * (len(self.points) - 1) + 1)
        places, step = self.at(samples), samples[1]
        s = samples[np.argmin(np.sum(places**2, axis=1) - 2.0 * p @ places.T, axis=1)]
        for _ in range(6):  # Newton steps, each doubles the number of correct digits
            offset, c1, c2 = p - self.at(s), self.at(s, 1), self.at(s, 2)
            slope = np.maximum(np.sum(c1 * c1, axis=1) - np.sum(c2 * offset, axis=1), 1.0 - LARGEST_OFFSET)
            move = np.sum(c1 * offset, axis=1) / slope
            outside = (s <= 0.0) & (move < 0.0) | (s >= self.length) & (move > 0.0)
            s = s + np.where(outside, move, np.clip(move, -step, step))
        return s

    def weights(self, p: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 6 6"], Float[np.ndarray, "n 6 6 3"]]:
        """Return the weights W(p) of all six `CURVE_ROWS`, and their derivatives with respect to the position.

        Args:
            p: Positions (n, 3) of the hand's origin [m].

        Returns:
            W (n, 6, 6) and dW/dp (n, 6, 6, 3).
        """
        s = self.nearest(p)
        offset, c1, c2, c3 = p - self.at(s), *(self.at(s, k) for k in (1, 2, 3))
        bend = np.sum(c2 * offset, axis=1)
        far = bend > LARGEST_OFFSET  # near the centre of curvature the length would diverge
        D = np.sum(c1 * c1, axis=1) - np.minimum(bend, LARGEST_OFFSET)
        along = c1 / D[:, None]
        by_length = 3.0 * np.sum(c1 * c2, axis=1) - np.sum(c3 * offset, axis=1)
        dD = np.where(far, 2.0 * np.sum(c1 * c2, axis=1), by_length)[:, None] * along - np.where(far[:, None], 0.0, c2)
        W, dW = np.zeros((len(p), len(CURVE_ROWS), 6)), np.zeros((len(p), len(CURVE_ROWS), 6, 3))
        W[:, 3:, 3:] = np.eye(3)
        W[:, :2, :3], W[:, 2, :3] = self.frame(s), along
        dW[:, :2, :3] = self.frame(s, 1)[..., None] * along[:, None, None]
        dW[:, 2, :3] = (c2[:, :, None] * along[:, None] - along[:, :, None] * dD[:, None]) / D[:, None, None]
        return W, dW

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> Curve:
        """Return this curve after a rigid motion, which moves each point p to p' = R p + t.

        Args:
            transform: Homogeneous matrix (4, 4) of R and t [m].

        Returns:
            The moved curve.
        """
        return Curve(self.points @ transform[:3, :3].T + transform[:3, 3])


@final
@dataclass(frozen=True, eq=False)
class CurveWeights:
    """Weight matrix of some rows across and along a curve; it has the methods of `PlaceWeights`.

    Attributes:
        curve: The curve.
        names: Names of the r rows, from `CURVE_ROWS`.
    """

    curve: Curve
    names: tuple[str, ...]

    def values(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n r 6"]:
        """Return the weight matrix W(p) at n positions of the hand's origin.

        Args:
            p: Positions (n, 3) [m].

        Returns:
            W, shape (n, r, 6).
        """
        return self.at(p)[0]

    def at(self, p: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n r 6"], Float[np.ndarray, "n r 6 3"]]:
        """Return the weight matrix W(p) and its derivative at n positions of the hand's origin.

        Args:
            p: Positions (n, 3) [m].

        Returns:
            W (n, r, 6) and dW/dp (n, r, 6, 3).
        """
        W, dW = self.curve.weights(p)
        rows = [CURVE_ROWS.index(name) for name in self.names]
        return W[:, rows], dW[:, rows]


def _reflected(vectors: Float[np.ndarray, "k 3"], normal: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "k 3"]:
    """Return vectors reflected at the plane with a normal."""
    size = normal @ normal
    return vectors - 2.0 * np.outer(vectors @ normal, normal) / size if size > 0.0 else vectors


@final
class Chart:
    """Coordinates s (k,) of a hand on a mechanism, one per free direction, relative to its grasp pose.

    Distances [m] and angles [rad] along the mechanism come first, then the angles of rotations of the hand that the
    mechanism does not follow. The formulas are in the docstring of this module. All poses are in one frame, the
    mechanism's.

    Args:
        grasp: Grasp pose (4, 4) of the hand [m], at which s = 0.
        travel: Linear velocity at the frame's origin per unit of each coordinate, shape (k, 3) [m].
        turn: Angular velocity of the mechanism per unit of each coordinate, shape (k, 3) [rad].
        spin: Rotation of the hand alone per unit of each coordinate, shape (k, 3) [rad].
        is_carried: True if the hand turns with the mechanism. The angle is then computed from the orientation of the
            hand, otherwise from its position.
        centre: shape (3,), a point on the axes of the pure rotations [m]; None for the point of a single axis that is
            nearest to the origin.
        curve: Curve that the hand follows, used instead of `turn`; None if there is none.
        rows: Function from a position (1, 3) of the hand to the weights (1, h, 6) of its twist in the h held rows; only
            needed for `held_error`.
        sizes: Factors that give the coordinates along the mechanism one unit: on a cylinder, angles become arcs [m].
    """

    def __init__(
        self,
        grasp: Float[np.ndarray, "4 4"],
        travel: Float[np.ndarray, "k 3"],
        turn: Float[np.ndarray, "k 3"],
        spin: Float[np.ndarray, "k 3"],
        *,
        is_carried: bool = False,
        centre: Float[np.ndarray, " 3"] | None = None,
        curve: Curve | None = None,
        rows: Callable[[Float[np.ndarray, "1 3"]], Float[np.ndarray, "1 h 6"]] | None = None,
        sizes: Sequence[float] = (1.0,),
    ):
        self.grasp, self._p, self._R = grasp, grasp[:3, 3].copy(), grasp[:3, :3].copy()
        self.turn, self.spin, self._carried = turn, spin, is_carried
        self._curve, self._rows, self.sizes = curve, rows, np.array(sizes)
        self._at = 0.0 if curve is None else float(curve.nearest(self._p[None])[0])
        by_itself = ~turn.any(axis=1) & (np.sum(spin**2, axis=1) > np.sum(travel**2, axis=1))
        self.n_ways = len(spin) - int(np.count_nonzero(by_itself))
        self._turns, self._spins = int(np.count_nonzero(turn.any(axis=1))), bool(spin.any())
        self._size = math.sqrt(turn[0] @ turn[0]) if self._turns == 1 else 1.0
        self._axis = turn[0] / self._size
        if centre is None:  # the point of the axis nearest to the origin
            centre = so3.skew(self._axis).dot(travel[0]) / self._size if self._turns == 1 else np.zeros(3)
        self._centre, self._slide = centre, travel - np.cross(centre, turn)
        lever = self._p - centre
        self._held = -self._R.T @ lever  # the point of a carried hand at the centre, in the hand's axes
        self._out = lever - (lever @ self._axis) * self._axis if self._turns == 1 else lever
        self._around = so3.skew(self._axis).dot(self._out)

    def coordinates(self, pose: Float[np.ndarray, "*n 4 4"], near: float = 0.0) -> Float[np.ndarray, "*n k"]:
        """Return the free coordinates of a hand, at one pose or along a motion.

        Args:
            pose: Pose (4, 4) of the hand, or poses (T, 4, 4) of a motion, whose angles are then unwrapped [m].
            near: Expected first angle [rad]: among angles that differ by full turns, the nearest one is returned.

        Returns:
            shape (k,) or (T, k) [m or rad].
        """
        p, Q = pose[..., :3, 3], pose[..., :3, :3] @ self._R.T
        vectors = so3.rotation_vector if pose.ndim == 2 else so3.rotation_vectors
        n, s = self.n_ways, np.zeros((*p.shape[:-1], len(self.spin)))
        if self._curve is not None:
            s[..., 0] = self._curve.nearest(p.reshape(-1, 3)).reshape(p.shape[:-1]) - self._at
        elif self._turns > 1:
            rotation = vectors(Q) if self._carried else so3.shortest_turn(self._out, p - self._centre)
            s[..., :n] = rotation @ self.turn[:n].T
        elif self._turns:
            d = p - self._centre
            angle = so3.turn_about(Q, self._axis) if self._carried else np.arctan2(d @ self._around, d @ self._out)
            turns = round((near * self._size - float(angle.flat[0])) / (2.0 * math.pi))
            s[..., 0] = ((angle if angle.ndim == 0 else np.unwrap(angle)) + 2.0 * math.pi * turns) / self._size
            if n > 1:
                s[..., 1] = (p - self._p) @ self._slide[1]
        elif n:
            s[..., :n] = (p - self._p) @ self._slide[:n].T / np.sum(self._slide[:n] ** 2, axis=1)
        if n_spins := len(self.spin) - n:
            c = self.spin[n:]
            s[..., n:] = vectors(Q) @ c.T if n_spins == 3 else so3.turn_about(Q, c[0])[..., None]
        return s

    def pose(self, s: ArrayLike) -> Float[np.ndarray, "4 4"]:
        """Return the pose of the hand at free coordinates.

        Args:
            s: Coordinates (k,) [m or rad]. Fewer than k are allowed; the missing last ones are 0.

        Returns:
            Pose (4, 4) [m].
        """
        s, out, place = self._whole(s), self.grasp.copy(), self._p
        if self._curve is not None:
            at = np.array([self._at, self._at + s[0]])
            (before, after), (c0, c1) = self._curve.frames(at), self._curve.at(at)
            G = after @ before.T
            out[:3, 3] = c1 + G @ (place - c0)
        elif self._turns:
            G = so3.rotation_matrix(s @ self.turn)
            out[:3, 3] = self._centre + G.dot(place - self._centre) + s @ self._slide
        else:
            G, out[:3, 3] = None, place + s @ self._slide
        if self._carried and G is not None:
            out[:3, :3] = G.dot(self._R)
        elif self._spins:
            out[:3, :3] = so3.rotation_matrix(s @ self.spin).dot(self._R)
        return out

    def twist(self, s: ArrayLike, pose: Float[np.ndarray, "4 4"] | None = None) -> Float[np.ndarray, "6 k"]:
        """Return the twist (v, w) of the hand per unit of each coordinate, with v the velocity of its origin.

        Args:
            s: Free coordinates (k,) [m or rad]. Fewer than k are allowed; the missing last ones are 0.
            pose: Pose (4, 4) of the hand if it deviates from the mechanism [m]; None for the pose at `s`.

        Returns:
            shape (6, k) [m, rad per unit of the coordinate].
        """
        s, K = self._whole(s), np.zeros((6, len(self.spin)))
        p = (self.pose(s) if pose is None else pose)[:3, 3]
        turning, K[:3] = self.turn.T, self._slide.T
        if self._curve is not None:
            c, c1, c2 = (self._curve.at(np.array([self._at + s[0]]), order)[0] for order in range(3))
            turning = (np.cross(c1, c2) / (c1 @ c1))[:, None]
            K[:3, 0] = c1 + np.cross(turning[:, 0], p - c)
        elif self._turns:
            turning = so3.left_jacobian(s @ self.turn) @ turning if self._turns > 1 else turning
            K[:3] -= so3.skew(p - self._centre).dot(turning)
        if self._carried:
            K[3:, : turning.shape[1]] = turning
        elif self._spins:
            K[3:] = so3.left_jacobian(s @ self.spin) @ self.spin.T
        return K

    def _whole(self, s: ArrayLike) -> Float[np.ndarray, " k"]:
        """Return all k coordinates, with zeros for missing ones at the end."""
        s = np.asarray(s, dtype=np.float64)
        return s if len(s) == len(self.spin) else np.append(s, np.zeros(len(self.spin) - len(s)))

    def error(self, pose: Float[np.ndarray, "4 4"], s: ArrayLike) -> Float[np.ndarray, " 6"]:
        """Return the displacement from the pose at some coordinates to the actual pose of the hand.

        If the hand turns with a mechanism that rotates, the linear part is corrected for the rotation: it is zero if
            the
        hand's point at the centre of the mechanism has not moved.

        Args:
            pose: Actual pose (4, 4) of the hand [m].
            s: Free coordinates (k,) [m or rad].

        Returns:
            shape (6,): translation [m] and rotation vector [rad], along the axes of the mechanism's frame.
        """
        goal, out = self.pose(s), np.empty(6)
        rotation = pose[:3, :3] @ goal[:3, :3].T
        out[:3], out[3:] = pose[:3, 3] - goal[:3, 3], so3.rotation_vector(rotation)
        if self._carried and self._turns:
            lever = goal[:3, :3] @ self._held
            out[:3] += rotation.dot(lever) - lever - so3.skew(out[3:]).dot(lever)
        return out

    def heading(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 6"]:
        """Return the direction in which the first coordinate increases: velocity of the hand, and rotation.

        Args:
            pose: Pose (4, 4) of the hand [m]; the chart's grasp pose is used for the coordinates.

        Returns:
            shape (6,): velocity of the hand's origin [m], and sum of the rotations of the mechanism and of the hand
            alone [rad], per unit of the coordinate.
        """
        return np.append(self.twist([], pose)[:3, 0], self.turn[0] + self.spin[0])

    def held_error(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " h"]:
        """Return the deviation of a hand from the mechanism, along the rows that the mechanism holds at zero.

        It is measured from the pose on the mechanism with the same free coordinates.

        Args:
            pose: Pose (4, 4) of the hand [m].

        Returns:
            shape (h,), one deviation per held row [m or rad].
        """
        return self._rows(pose[None, :3, 3])[0] @ self.error(pose, self.coordinates(pose))  # type: ignore[misc]
