"""A smooth curve in space, the frame that moves along it, and the weights of a hand's twist across and along it."""

from __future__ import annotations

from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from manip_learn.errors import FeatureError

# names of the rows: velocities across and along the curve, then angular ones
CURVE_ROWS = ("across-1", "across-2", "along", "rx", "ry", "rz")
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

    def tangents_at(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Return unit vectors along the curve at lengths s [m]."""
        along = self.at(s, 1)
        return along / np.linalg.norm(along, axis=1, keepdims=True)

    @cached_property
    def _frames(self) -> CubicSpline:
        """Two unit vectors across the curve, by its length, shape (2, 3)."""
        s = np.linspace(0.0, self.length, FRAME_PLACES * (len(self.points) - 1) + 1)
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
        """Two unit vectors across the curve at lengths s [m], or their derivatives."""
        inside = np.clip(s, 0.0, self.length)
        value = self._frames(inside, order)
        return value if order == 0 else np.where((s == inside)[:, None, None], value, 0.0)

    def frames(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3 3"]:
        """Return rotations whose columns are the tangent at lengths s [m] and two directions across the curve."""
        tangent, normal = self.tangents_at(s), self.frame(s)[:, 0]
        normal = normal - np.sum(normal * tangent, axis=1, keepdims=True) * tangent
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.stack([tangent, normal, np.cross(tangent, normal)], axis=2)

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
        return self.tangents_at(self.nearest(p))

    def weights(self, p: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 6 6"], Float[np.ndarray, "n 6 6 3"]]:
        """Return the weights of all `CURVE_ROWS` at n places [m], and their derivatives along the place."""
        s = self.nearest(p)
        away, c1, c2, c3 = p - self.at(s), *(self.at(s, k) for k in (1, 2, 3))
        bend = np.sum(c2 * away, axis=1)
        far = bend > WITHIN  # near the centre of curvature the length would run away
        D = np.sum(c1 * c1, axis=1) - np.minimum(bend, WITHIN)
        along = c1 / D[:, None]
        by_length = 3.0 * np.sum(c1 * c2, axis=1) - np.sum(c3 * away, axis=1)
        dD = np.where(far, 2.0 * np.sum(c1 * c2, axis=1), by_length)[:, None] * along - np.where(far[:, None], 0.0, c2)
        W, dW = np.zeros((len(p), len(CURVE_ROWS), 6)), np.zeros((len(p), len(CURVE_ROWS), 6, 3))
        W[:, 3:, 3:] = np.eye(3)
        W[:, :2, :3], W[:, 2, :3] = self.frame(s), along
        dW[:, :2, :3] = self.frame(s, 1)[..., None] * along[:, None, None]
        dW[:, 2, :3] = (c2[:, :, None] * along[:, None] - along[:, :, None] * dD[:, None]) / D[:, None, None]
        return W, dW

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> Curve:
        """This curve where it stands elsewhere, p' = R p + t."""
        return Curve(self.points @ transform[:3, :3].T + transform[:3, 3])


def _reflected(vectors: Float[np.ndarray, "k 3"], normal: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "k 3"]:
    size = normal @ normal
    return vectors - 2.0 * np.outer(vectors @ normal, normal) / size if size > 0.0 else vectors
