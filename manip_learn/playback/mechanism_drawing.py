"""A mechanism as lines and surfaces in the scene: the axis and circle of a hinge, the patch of a plane, a line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import RecordingError
from manip_learn.linalg import null_basis

CIRCLE_POINTS = 96
MARGIN = 0.25  # how far lines and patches reach beyond the motion, relative to its extent
LEAST_MARGIN = 0.06  # [m]
MAX_TURNS = 12.0  # of a screw that is drawn
MAX_NUMBER = 1e9  # [m] what is farther away cannot be drawn
MAX_TEXT = 400


class DescribedMechanism(Protocol):
    """A mechanism that can describe itself, as `Mechanism` of the learner does."""

    def to_dict(self) -> Mapping[str, Any]:
        """Type, axis, point, radius, pitch, and a sentence."""
        ...


@final
@dataclass(frozen=True, eq=False)
class MechanismDrawing:
    """What is drawn of a mechanism, in the robot's base frame [m].

    Attributes:
        type: E.g. `"hinge"`.
        sentence: The mechanism in words.
        lines: Polylines, each of shape (n, 3).
        patches: Corners of flat surfaces in order around them, each of shape (4, 3).
    """

    type: str
    sentence: str
    lines: tuple[Float[np.ndarray, "_n 3"], ...]
    patches: tuple[Float[np.ndarray, "4 3"], ...]


@final
@dataclass(frozen=True, eq=False)
class Geometry:
    """Where a mechanism is, as far as that is known.

    Attributes:
        axis: shape (3,), unit vector in the base frame.
        point: shape (3,), on the axis, or the centre [m].
        radius: Of the hand about the axis or the centre [m].
        pitch: Travel along the axis per radian [m/rad].
    """

    axis: Float[np.ndarray, " 3"] | None
    point: Float[np.ndarray, " 3"] | None
    radius: float | None
    pitch: float | None


def geometry_of(described: Mapping[str, Any]) -> Geometry:
    """The numbers of a mechanism's dictionary.

    Raises:
        RecordingError: Numbers of a wrong size or not finite.
    """
    axis = _vector(described, "axis")
    if axis is not None:
        length = float(np.linalg.norm(axis))
        axis = axis / length if length > 0.0 else None
    return Geometry(axis, _vector(described, "point"), _number(described, "radius"), _number(described, "pitch"))


def mechanism_drawing(
    mechanism: DescribedMechanism | Mapping[str, Any], held: Float[np.ndarray, "n 3"]
) -> MechanismDrawing:
    """Lines and patches of a mechanism, as large as the motion that it held.

    What a mechanism lacks, e.g. the axis of an orientation that is held, is not drawn; its sentence is always shown.

    Args:
        mechanism: Or its dictionary, as a constraint file holds it.
        held: The tip where the mechanism held it, in the base frame [m]; at least one point.

    Raises:
        RecordingError: Numbers of a wrong size or not finite.
    """
    described = mechanism if isinstance(mechanism, Mapping) else mechanism.to_dict()
    kind = str(described.get("type") or "mechanism")[:MAX_TEXT]
    sentence = str(described.get("sentence") or kind)[:MAX_TEXT]
    geometry = geometry_of(described)
    lines: list[np.ndarray] = []
    patches: list[np.ndarray] = []
    if kind == "ball":
        lines = _ball(geometry)
    elif geometry.axis is not None and geometry.point is not None and kind == "plane":
        patches = [_patch(geometry.axis, geometry.point, held)]
        lines = [np.vstack([patches[0], patches[0][:1]])]
    elif geometry.axis is not None and geometry.point is not None:
        lines = _along_axis(kind, geometry.axis, geometry.point, geometry, held)
    return MechanismDrawing(kind, sentence, tuple(lines), tuple(patches))


def _along_axis(
    kind: str, axis: np.ndarray, point: np.ndarray, geometry: Geometry, held: np.ndarray
) -> list[np.ndarray]:
    """The axis, and around it the circle of a hinge, the helix of a screw, the two rims of a cylinder."""
    along = (held - point) @ axis
    low, high = float(along.min()), float(along.max())
    radius = geometry.radius
    reach = _margin(high - low) + (0.3 * radius if radius else 0.0)
    lines = [np.array([point + (low - reach) * axis, point + (high + reach) * axis])]
    if kind == "line" or not radius:
        return lines
    if kind == "screw" and geometry.pitch:
        return [*lines, _helix(axis, point, radius, geometry.pitch, low, high, held)]
    heights = (low, high) if kind == "other" else (0.5 * (low + high),)
    return [*lines, *(_circle(point + h * axis, axis, radius) for h in heights)]


def _ball(geometry: Geometry) -> list[np.ndarray]:
    """Three great circles around the centre."""
    if geometry.point is None or not geometry.radius:
        return []
    return [_circle(geometry.point, axis, geometry.radius) for axis in np.eye(3)]


def _circle(centre: np.ndarray, axis: np.ndarray, radius: float) -> Float[np.ndarray, "n 3"]:
    first, second = _across(axis)
    angle = np.linspace(0.0, 2.0 * np.pi, CIRCLE_POINTS + 1)[:, None]
    return centre + radius * (np.cos(angle) * first + np.sin(angle) * second)


def _helix(
    axis: np.ndarray, point: np.ndarray, radius: float, pitch: float, low: float, high: float, held: np.ndarray
) -> Float[np.ndarray, "n 3"]:
    """The path of the hand around the axis, through the first point held; pitch is travel per radian."""
    first, second = _across(axis)
    arm = held[0] - point
    phase = np.arctan2(arm @ second, arm @ first)
    turn = min((high - low) / abs(pitch), 2.0 * np.pi * MAX_TURNS)
    angle = np.sign(pitch) * np.linspace(0.0, turn, max(2, int(CIRCLE_POINTS * turn / (2.0 * np.pi))))
    start = low - float(arm @ axis)  # along the axis, from the first point held to the lowest
    turned = (angle + phase + start / pitch)[:, None]
    return point + radius * (np.cos(turned) * first + np.sin(turned) * second) + np.outer(low + pitch * angle, axis)


def _patch(normal: np.ndarray, point: np.ndarray, held: np.ndarray) -> Float[np.ndarray, "4 3"]:
    """A rectangle in the plane, its sides along the widest and the narrowest spread of the motion."""
    basis = np.array(_across(normal))
    flat = (held - point) @ basis.T
    turn = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2] if len(flat) > 2 else np.eye(2)
    sides = turn @ basis
    within = (held - point) @ sides.T
    low, high = within.min(axis=0), within.max(axis=0)
    margin = _margin(float((high - low).max()))
    low, high = low - margin, high + margin
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return point + corners @ sides


def _across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that make a right-handed frame with the axis."""
    first = null_basis(axis[None, :])[:, 0]
    return first, np.cross(axis, first)


def _margin(extent: float) -> float:
    return max(MARGIN * extent, LEAST_MARGIN)


def _vector(described: Mapping[str, Any], name: str) -> Float[np.ndarray, " 3"] | None:
    if described.get(name) is None:
        return None
    try:
        vector = np.array(described[name], dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise RecordingError(f"the mechanism's {name} must be three numbers: {error}", code="mechanism") from error
    if vector.shape != (3,) or not np.all(np.abs(vector) < MAX_NUMBER):
        raise RecordingError(
            f"the mechanism's {name} must be three finite numbers below {MAX_NUMBER:g}, got {described[name]!r:.80}",
            code="mechanism",
        )
    return vector


def _number(described: Mapping[str, Any], name: str) -> float | None:
    if described.get(name) is None:
        return None
    try:
        number = float(described[name])
    except (TypeError, ValueError, OverflowError) as error:
        raise RecordingError(f"the mechanism's {name} must be a number: {error}", code="mechanism") from error
    if not abs(number) < MAX_NUMBER:
        raise RecordingError(
            f"the mechanism's {name} must be finite and below {MAX_NUMBER:g}, got {number}", code="mechanism"
        )
    return number
