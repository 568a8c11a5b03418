"""What a hand can be held by: where it puts the tip, and what is true of the motion."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from make_recordings.mechanism_motion import TipPath

Held = Literal["loose", "firm", "soft"]


class Mechanism(ABC):
    """Something that holds the tip; all vectors in the base frame.

    Attributes:
        handle: shape (3,), where the hand takes hold [m].
        bar: shape (k, 3), ways along which it may take hold elsewhere, each demonstration its own [m].
        size: shape (k,), by how much the mechanism's own coordinates move [m] or [rad].
    """

    handle: Float[np.ndarray, " 3"]
    bar: Float[np.ndarray, "k 3"]
    size: Float[np.ndarray, " k"]

    @abstractmethod
    def carry(self, pose: Float[np.ndarray, "4 4"], way: Float[np.ndarray, "T k"]) -> TipPath:
        """Path of the tip that is at `pose` where the mechanism's coordinates are zero."""

    @abstractmethod
    def moved(self, motion: Float[np.ndarray, "4 4"]) -> Mechanism:
        """The same one elsewhere, held by the same place: a rigid motion of the base frame."""

    @abstractmethod
    def truth(self) -> dict[str, Any]:
        """Type, axis, point, radius, pitch, how it is held, constant rows in base axes, number of rows."""


@final
@dataclass(frozen=True)
class Slide(Mechanism):
    """A drawer: the tip moves along a line; held firmly, the hand does not turn."""

    handle: Float[np.ndarray, " 3"]
    bar: Float[np.ndarray, "k 3"]
    size: Float[np.ndarray, " 1"]
    axis: Float[np.ndarray, " 3"]
    firm: bool = False

    def carry(self, pose: Float[np.ndarray, "4 4"], way: Float[np.ndarray, "T k"]) -> TipPath:
        """Straight along the axis."""
        position = pose[:3, 3] + np.outer(way[:, 0], self.axis)
        return TipPath(position, np.tile(pose[:3, :3], (len(way), 1, 1)) if self.firm else None)

    def moved(self, motion: Float[np.ndarray, "4 4"]) -> Slide:
        """Elsewhere, with all that is in it."""
        turn, shift = motion[:3, :3], motion[:3, 3]
        return replace(self, handle=turn @ self.handle + shift, bar=self.bar[:0], axis=turn @ self.axis)

    def truth(self) -> dict[str, Any]:
        """Two rows across the axis; firmly held, three rotations more."""
        rows = _rows(linear=across(self.axis), angular=np.eye(3) if self.firm else None)
        return _truth("slide", "firm" if self.firm else "loose", rows, len(rows), axis=self.axis)


@final
@dataclass(frozen=True)
class Plane(Mechanism):
    """A table that is wiped: the tip stays in a plane; with a flat sponge the hand turns about the normal only."""

    handle: Float[np.ndarray, " 3"]
    bar: Float[np.ndarray, "k 3"]
    size: Float[np.ndarray, " 2"]
    normal: Float[np.ndarray, " 3"]
    flat: bool = False

    def carry(self, pose: Float[np.ndarray, "4 4"], way: Float[np.ndarray, "T k"]) -> TipPath:
        """To and fro in the plane."""
        position = pose[:3, 3] + way @ across(self.normal)
        if not self.flat:
            return TipPath(position)
        return TipPath(position, None, np.tile(self.normal, (len(way), 1)), pose[:3, :3].T @ self.normal)

    def moved(self, motion: Float[np.ndarray, "4 4"]) -> Plane:
        """Elsewhere, with all that is in it."""
        turn, shift = motion[:3, :3], motion[:3, 3]
        return replace(self, handle=turn @ self.handle + shift, bar=self.bar[:0], normal=turn @ self.normal)

    def truth(self) -> dict[str, Any]:
        """One row along the normal; flat, two rotations across it more."""
        rows = _rows(linear=self.normal[None], angular=across(self.normal) if self.flat else None)
        held: Held = "firm" if self.flat else "loose"
        return _truth("plane", held, rows, len(rows), axis=self.normal, point=self.handle)


@final
@dataclass(frozen=True)
class Axle(Mechanism):
    """What turns about an axis: door, hinge (no pitch), screw (pitch), sleeve (turns and slides).

    Attributes:
        point: shape (3,), a point on the axis [m].
        pitch: Way along the axis [m/rad].
        sleeve: Whether the hand also slides along the axis as it likes; the second coordinate [m].
        firm: Whether the hand turns with it, or holds a point of it.
    """

    handle: Float[np.ndarray, " 3"]
    bar: Float[np.ndarray, "k 3"]
    size: Float[np.ndarray, " k"]
    axis: Float[np.ndarray, " 3"]
    point: Float[np.ndarray, " 3"]
    pitch: float = 0.0
    sleeve: bool = False
    firm: bool = True

    @property
    def radius(self) -> float:
        """Distance of the handle from the axis [m]."""
        return float(np.linalg.norm(across(self.axis) @ (self.handle - self.point)))

    def carry(self, pose: Float[np.ndarray, "4 4"], way: Float[np.ndarray, "T k"]) -> TipPath:
        """Round the axis."""
        turn = Rotation.from_rotvec(np.outer(way[:, 0], self.axis))
        along = way[:, 1] if self.sleeve else self.pitch * way[:, 0]
        position = self.point + turn.apply(pose[:3, 3] - self.point) + np.outer(along, self.axis)
        return TipPath(position, turn.as_matrix() @ pose[:3, :3] if self.firm else None)

    def moved(self, motion: Float[np.ndarray, "4 4"]) -> Axle:
        """Elsewhere, with all that is in it."""
        turn, shift = motion[:3, :3], motion[:3, 3]
        return replace(
            self,
            handle=turn @ self.handle + shift,
            bar=self.bar[:0],
            axis=turn @ self.axis,
            point=turn @ self.point + shift,
        )

    def truth(self) -> dict[str, Any]:
        """Constant in base axes: along the axis [v - pitch w], and two rotations across it if held firmly."""
        bound = np.concatenate([self.axis, -self.pitch * self.axis])[None]
        rows = np.zeros((0, 6)) if self.sleeve else bound
        rows = np.concatenate([rows, _rows(angular=across(self.axis))]) if self.firm else rows
        name = "sleeve" if self.sleeve else "screw" if self.pitch else "hinge"
        count = (6 if self.firm else 3) - len(self.size)
        held: Held = "firm" if self.firm else "loose"
        facts = {"axis": self.axis, "point": self.point, "radius": self.radius}
        return _truth(name, held, rows, count, **facts, pitch=self.pitch if name == "screw" else None)


@final
@dataclass(frozen=True)
class Ball(Mechanism):
    """A point in space that the tip keeps its distance from: a tether; held firmly, a stick on a ball joint."""

    handle: Float[np.ndarray, " 3"]
    bar: Float[np.ndarray, "k 3"]
    size: Float[np.ndarray, " 3"]
    point: Float[np.ndarray, " 3"]
    firm: bool = False

    def carry(self, pose: Float[np.ndarray, "4 4"], way: Float[np.ndarray, "T k"]) -> TipPath:
        """Over the sphere."""
        turn = Rotation.from_rotvec(way)
        position = self.point + turn.apply(pose[:3, 3] - self.point)
        return TipPath(position, turn.as_matrix() @ pose[:3, :3] if self.firm else None)

    def moved(self, motion: Float[np.ndarray, "4 4"]) -> Ball:
        """Elsewhere, with all that is in it."""
        turn, shift = motion[:3, :3], motion[:3, 3]
        return replace(self, handle=turn @ self.handle + shift, bar=self.bar[:0], point=turn @ self.point + shift)

    def truth(self) -> dict[str, Any]:
        """No row is constant in base axes at the tip."""
        radius = float(np.linalg.norm(self.handle - self.point))
        count, held = (3, "firm") if self.firm else (1, "loose")
        return _truth("ball", held, np.zeros((0, 6)), count, point=self.point, radius=radius)


@final
@dataclass(frozen=True)
class Upright(Mechanism):
    """A glass that is carried level because the person wants to: soft, it sways by about a degree.

    Attributes:
        sway: Standard deviation of the tilt [rad].
    """

    handle: Float[np.ndarray, " 3"]
    bar: Float[np.ndarray, "k 3"]
    size: Float[np.ndarray, " 5"]
    sway: float

    def carry(self, pose: Float[np.ndarray, "4 4"], way: Float[np.ndarray, "T k"]) -> TipPath:
        """Anywhere (three coordinates), with a little tilt about x and y (two)."""
        up = np.array([0.0, 0.0, 1.0])
        tilt = Rotation.from_rotvec(np.column_stack([way[:, 3:], np.zeros(len(way))]))
        return TipPath(pose[:3, 3] + way[:, :3], None, tilt.apply(up), pose[:3, :3].T @ up)

    def moved(self, motion: Float[np.ndarray, "4 4"]) -> Upright:
        """Elsewhere, with all that is in it."""
        turn, shift = motion[:3, :3], motion[:3, 3]
        return replace(self, handle=turn @ self.handle + shift, bar=self.bar[:0])

    def truth(self) -> dict[str, Any]:
        """Nearly no rotation about x and y."""
        up = np.array([0.0, 0.0, 1.0])
        rows = _rows(angular=across(up))
        return _truth("upright", "soft", rows, 2, axis=up) | {"sway": self.sway}


def across(axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "2 3"]:
    """Two unit rows across an axis and each other."""
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(axis, first)])


def _rows(linear: np.ndarray | None = None, angular: np.ndarray | None = None) -> Float[np.ndarray, "s 6"]:
    parts = [np.hstack([linear, np.zeros_like(linear)])] if linear is not None else []
    parts += [np.hstack([np.zeros_like(angular), angular])] if angular is not None else []
    return np.concatenate(parts)


def _truth(
    name: str,
    held: str,
    rows: np.ndarray,
    count: int,
    axis: np.ndarray | None = None,
    point: np.ndarray | None = None,
    radius: float | None = None,
    pitch: float | None = None,
) -> dict[str, Any]:
    return {
        "type": name,
        "held": held,
        "axis": None if axis is None else axis.tolist(),
        "point": None if point is None else point.tolist(),
        "radius": radius,
        "pitch": pitch,
        "rows": rows.tolist(),
        "n_rows": count,
    }
