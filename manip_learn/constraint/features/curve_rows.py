"""Rows across and along a curve in space: the Phi(q) of a rail of any shape, with the frame that moves along it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from manip_learn.constraint.features.feature_map import FeatureMap, parsed_rows
from manip_learn.constraint.features.frame_jacobian import AXES
from manip_learn.constraint.features.weighed_velocity import WeighedVelocity
from manip_learn.errors import FeatureError
from manip_learn.robot.robot import Robot

# names of the rows: velocities across and along the curve, then angular ones
CURVE_ROWS = ("across-1", "across-2", "along", *AXES[3:])
FRAME_PLACES = 12  # of the frame from one point to the next: its error falls with the fourth power of their distance
COARSE_PLACES = 3  # places from one point to the next, from the nearest of which the nearest of all is looked for
NEAREST_STEPS = 6  # of Newton's method from there: each doubles the digits
# share of the radius of curvature that a hand may be off the curve before the nearest place is no longer told
WITHIN = 0.95


@final
class Curve:
    """A smooth curve through points, straight beyond both ends, by its length.

    Natural cubic splines, by the length of the chords and then by that of the curve itself (so that the tangent has
    unit length to 1e-4 or better). The frame across it does not turn about it (R. L. Bishop, 1975).

    Args:
        points: In order, at least four, shape (k, 3) [m].

    Attributes:
        points: As given, read-only.
        length: From the first to the last point [m].

    Raises:
        FeatureError: Fewer points, points that are not finite, or two that follow each other at one place.
    """

    def __init__(self, points: ArrayLike):
        self.points = np.array(points, dtype=np.float64)
        if self.points.ndim != 2 or self.points.shape[1] != 3 or len(self.points) < 4:
            raise FeatureError(f"a curve goes through at least four points (k, 3) [m], got {self.points.shape}")
        chords = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        if not np.all(np.isfinite(self.points)) or not np.all(chords > 0.0):
            raise FeatureError("the points of a curve must be finite, and each elsewhere than the one before")
        self.points.setflags(write=False)
        at = np.concatenate([[0.0], np.cumsum(chords)])
        for _ in range(2):  # by the length of the chords, then of the curve: the middle of 4 in each piece
            spline = CubicSpline(at, self.points, bc_type="natural")
            inside = at[:-1, None] + np.diff(at)[:, None] * (np.arange(4) + 0.5) / 4
            speed = np.linalg.norm(spline(inside, 1), axis=2).mean(axis=1)
            at = np.concatenate([[0.0], np.cumsum(speed * np.diff(at))])
        self._spline = CubicSpline(at, self.points, bc_type="natural")
        self.length = float(at[-1])

    def at(self, s: Float[np.ndarray, " n"], order: int = 0) -> Float[np.ndarray, "n 3"]:
        """Places [m] at lengths s [m], or their derivatives of an order up to 3."""
        inside = np.clip(s, 0.0, self.length)
        beyond, value = s - inside, self._spline(inside, order)
        if order == 0:
            return value + beyond[:, None] * self._spline(inside, 1)
        return value if order == 1 else np.where(beyond[:, None] == 0.0, value, 0.0)

    @cached_property
    def _frames(self) -> CubicSpline:
        """Two unit vectors across the curve, by its length, shape (2, 3)."""
        s = np.linspace(0.0, self.length, FRAME_PLACES * (len(self.points) - 1) + 1)
        places, tangents = self.at(s), self.at(s, 1)
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        across = np.linalg.svd(tangents[:1])[2][1:]
        across[1] = np.cross(tangents[0], across[0])
        frames = [across]
        for i in range(len(s) - 1):  # two reflections (W. Wang and others, 2008)
            step = places[i + 1] - places[i]
            half = _reflected(np.vstack([frames[-1], tangents[i]]), step)
            frames.append(_reflected(half[:2], tangents[i + 1] - half[2]))
        return CubicSpline(s, np.array(frames), bc_type="clamped")

    def frame(self, s: Float[np.ndarray, " n"], order: int = 0) -> Float[np.ndarray, "n 2 3"]:
        """Two unit vectors across the curve at lengths s [m], or their derivatives."""
        inside = np.clip(s, 0.0, self.length)
        value = self._frames(inside, order)
        return value if order == 0 else np.where((s == inside)[:, None, None], value, 0.0)

    def nearest(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Length at which the curve comes nearest to places [m]; beyond its ends that of the straight lines there."""
        some = np.linspace(0.0, self.length, COARSE_PLACES * (len(self.points) - 1) + 1)
        places, step = self.at(some), some[1]
        s = some[np.argmin(np.sum(places**2, axis=1) - 2.0 * p @ places.T, axis=1)]
        for _ in range(NEAREST_STEPS):
            away, c1, c2 = p - self.at(s), self.at(s, 1), self.at(s, 2)
            slope = np.maximum(np.sum(c1 * c1, axis=1) - np.sum(c2 * away, axis=1), 1.0 - WITHIN)
            move = np.sum(c1 * away, axis=1) / slope
            outside = (s <= 0.0) & (move < 0.0) | (s >= self.length) & (move > 0.0)
            s = s + np.where(outside, move, np.clip(move, -step, step))
        return s

    def tangents(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Unit vectors along the curve where it comes nearest to places."""
        along = self.at(self.nearest(p), 1)
        return along / np.linalg.norm(along, axis=1, keepdims=True)

    def along(self, p: Float[np.ndarray, " 3"], way: float) -> Float[np.ndarray, " 3"]:
        """The place that is so far along the curve from another place [m], and as far off it."""
        s = self.nearest(p[None])
        off = self.frame(s)[0] @ (p - self.at(s)[0])
        return self.at(s + way)[0] + off @ self.frame(s + way)[0]

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> Curve:
        """This curve where it stands elsewhere, p' = R p + t."""
        return Curve(self.points @ transform[:3, :3].T + transform[:3, 3])


def _reflected(vectors: Float[np.ndarray, "k 3"], normal: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "k 3"]:
    size = normal @ normal
    return vectors - 2.0 * np.outer(vectors @ normal, normal) / size if size > 0.0 else vectors


@final
class CurveRows(WeighedVelocity):
    """Velocity of a frame across a curve, and along it: rows that follow the place of the hand.

    With p the origin of the frame, c(s) the place of the curve next to it, t the tangent there and n_1, n_2 two unit
    vectors across that do not turn about the curve:

    - `across-1`, `across-2`: n_i.v, the rate of n_i.(p - c) [m/s];
    - `along`: the rate of the length s, t.v / (1 - c''.(p - c)) [m/s];
    - `rx`, `ry`, `rz`: the angular velocity along the base's axes [rad/s].

    A rail of any shape makes the first two zero.

    Args:
        robot: The robot.
        frame: Name of the frame, e.g. the tool's tip.
        points: Of the curve, in order, in the base frame, shape (k, 3) [m].
        rows: Names of the rows, each at most once.
        relative_to: Frame from which the hand is seen, and in which the points are given; None for the base.

    Raises:
        UnknownNameError: No such frame; lists near matches.
        FeatureError: Unknown rows, or points that make no curve.
    """

    # of weights that are not affine in the place
    padded = FeatureMap.padded
    value_and_vjp = FeatureMap.value_and_vjp

    def __init__(
        self,
        robot: Robot,
        frame: str,
        points: ArrayLike | Curve,
        rows: str | Sequence[str] = CURVE_ROWS[:3],
        relative_to: str | None = None,
    ):
        super().__init__(robot, frame, relative_to)
        self.row_names = parsed_rows(rows, CURVE_ROWS, "row")
        self.row_units = tuple("rad/s" if name in AXES else "m/s" for name in self.row_names)
        self.curve = points if isinstance(points, Curve) else Curve(points)
        self._rows = [CURVE_ROWS.index(name) for name in self.row_names]

    def with_rows(self, rows: Sequence[str]) -> CurveRows:
        """Other rows of the same curve."""
        return CurveRows(self.robot, self.frame.name, self.curve, rows, **self.twist.seen_from)

    def weights(self, p: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n r 6"], Float[np.ndarray, "n r 6 3"]]:
        """W(p) and dW/dp at n places [m]."""
        s = self.curve.nearest(p)
        away, c1, c2, c3 = p - self.curve.at(s), *(self.curve.at(s, k) for k in (1, 2, 3))
        bend = np.sum(c2 * away, axis=1)
        far = bend > WITHIN  # near the centre of curvature the length would run away
        D = np.sum(c1 * c1, axis=1) - np.minimum(bend, WITHIN)
        along = c1 / D[:, None]
        by_length = 3.0 * np.sum(c1 * c2, axis=1) - np.sum(c3 * away, axis=1)
        dD = np.where(far, 2.0 * np.sum(c1 * c2, axis=1), by_length)[:, None] * along - np.where(far[:, None], 0.0, c2)
        W, dW = np.zeros((len(p), len(CURVE_ROWS), 6)), np.zeros((len(p), len(CURVE_ROWS), 6, 3))
        W[:, 3:, 3:] = np.eye(3)
        W[:, :2, :3], W[:, 2, :3] = self.curve.frame(s), along
        dW[:, :2, :3] = self.curve.frame(s, 1)[..., None] * along[:, None, None]
        dW[:, 2, :3] = (c2[:, :, None] * along[:, None] - along[:, :, None] * dD[:, None]) / D[:, None, None]
        return W[:, self._rows], dW[:, self._rows]

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Distances from the curve along n_1 and n_2, and the length along it [m].

        Raises:
            FeatureError: Rows of the angular velocity, which is the rate of nothing.
        """
        if max(self._rows) >= len(AXES[:3]):
            return super().coordinates(q)
        place = self.twist.placement(q)[0]
        s = self.curve.nearest(place[None])
        across = self.curve.frame(s)[0] @ (place - self.curve.at(s)[0])
        return np.append(across, s)[self._rows]

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> CurveRows:
        """The same rows of a curve that stands elsewhere, p' = R p + t."""
        curve = self.curve.moved(transform)
        return CurveRows(self.robot, self.frame.name, curve, self.row_names, **self.twist.seen_from)

    def describe(self) -> dict[str, Any]:
        """Frame, rows and points, as saved in a constraint file."""
        return {
            "kind": "curve-rows",
            "frame": self.frame.name,
            **self.twist.seen_from,
            "rows": list(self.row_names),
            "units": list(self.row_units),
            "points": self.curve.points.tolist(),
        }

    def __repr__(self) -> str:
        what = f"{self.robot.name!r}, frame={self.frame.name!r}, {self.curve.length:.3g} m"
        return f"CurveRows({what}, {' '.join(self.row_names)!r}{self._seen})"
