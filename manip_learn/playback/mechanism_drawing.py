"""A mechanism in the scene, as lines and surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.constraint.mechanism import Mechanism
from manip_learn.constraint.shown import Intention, Shown
from manip_learn.errors import RecordingError
from manip_learn.linalg import finite, null_basis
from manip_learn.playback.page_writer import packed

CIRCLE_POINTS = 96  # 3.75 degrees apart: looks round when it fills a screen
MAX_TURNS = 12.0  # of a screw that is drawn
MAX_NUMBER = 1e9  # [m] what is farther away cannot be drawn
_MAX_TEXT = 400
CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))  # of a cube with sides of 1
UPRIGHT = 0.98  # cosine of the tilt up to which a chest stands on the floor


@final
@dataclass(frozen=True, eq=False)
class MechanismDrawing:
    """What is drawn of a mechanism, in the robot's base frame [m].

    Attributes:
        type: E.g. `"hinge"`.
        sentence: The mechanism in words.
        lines: Polylines, each of shape (n, 3).
        patches: Corners of flat surfaces in order around them, each of shape (4, 3).
        shown: What the recordings did along it, in words; empty if that is not known.
        way: shape (n, 3), from where they began to the farthest point, or along the path on a surface.
        hold: Whether all of them began at one place.
    """

    type: str
    sentence: str
    lines: tuple[Float[np.ndarray, "_n 3"], ...]
    patches: tuple[Float[np.ndarray, "4 3"], ...] = ()
    shown: str = ""
    way: Float[np.ndarray, "_n 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    hold: bool = False

    def to_dict(self) -> dict[str, Any]:
        """For the page."""
        content: dict[str, Any] = {name: getattr(self, name) for name in ("type", "sentence", "shown", "hold")}
        content |= {name: [packed(x, "<f4") for x in getattr(self, name)] for name in ("lines", "patches")}
        return content | {"way": packed(self.way, "<f4")}


def _numbers(described: Mapping[str, Any], name: str, n: int) -> Any:
    """Return a vector of n numbers, or the single number if n is 0; None where the mechanism has none.

    Raises:
        RecordingError: Numbers of a wrong size, not finite or too large.
    """
    given = described.get(name)
    numbers = None if given is None else finite(given, *(n,) * bool(n))
    if given is not None and (numbers is None or not np.all(np.abs(numbers) < MAX_NUMBER)):
        wanted = f"{'three finite numbers' if n else 'a finite number'} below {MAX_NUMBER:g}"
        raise RecordingError(f"the mechanism's {name} must be {wanted}, got {given!r:.80}", code="mechanism")
    return numbers


def mechanism_drawing(
    mechanism: Mechanism | Mapping[str, Any] | None,
    held: Float[np.ndarray, "n 3"],
    shown: Shown | Intention | None = None,
) -> MechanismDrawing:
    """Lines and patches of a mechanism, as large as the motion that it held, and what was shown along it.

    What a mechanism lacks, e.g. the axis of an orientation that is held, is not drawn; its sentence is always shown.

    Args:
        mechanism: Or its dictionary, as a constraint file holds it; None where it has no name.
        held: The tip where the mechanism held it, in the base frame [m]; at least one point.
        shown: What the recordings did along it, or where they went, if that is known.

    Raises:
        RecordingError: Numbers of a wrong size or not finite.
    """
    described = mechanism.to_dict() if isinstance(mechanism, Mechanism) else dict(mechanism or {})
    kind = str(described.get("type") or "mechanism")[:_MAX_TEXT] if described or shown is None else ""
    drawn = MechanismDrawing(kind, str(described.get("sentence") or kind)[:_MAX_TEXT], *_form(kind, described, held))
    if shown is None:
        return drawn
    if isinstance(shown, Intention) or described.get("relative_to"):
        return replace(drawn, shown=shown.sentence)
    return replace(drawn, shown=shown.sentence, way=shown.points, hold=shown.hold is not None)


def _form(
    kind: str, described: Mapping[str, Any], held: Float[np.ndarray, "n 3"]
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Return the lines and the patches of a mechanism; none where it lacks an axis or a place."""
    axis, point = (_numbers(described, name, 3) for name in ("axis", "point"))
    radius, pitch = (float(_numbers(described, name, 0) or 0.0) for name in ("radius", "pitch"))
    if kind == "ball":
        return tuple(_around(a, point, radius) for a in np.eye(3) if point is not None and radius), ()
    if axis is None or point is None or not np.any(axis):
        return (), ()
    axis = axis / np.linalg.norm(axis)
    if kind == "plane":  # a rectangle, its sides along the widest and the narrowest spread of the motion
        basis = np.array(_across(axis))
        flat = (held - point) @ basis.T
        turn = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2] if len(flat) > 2 else np.eye(2)
        within, sides = flat @ turn.T, turn @ basis
        margin = _margin(float(np.ptp(within, axis=0).max()))
        (x, y), (right, top) = within.min(axis=0) - margin, within.max(axis=0) + margin
        patch = point + np.array([[x, y], [right, y], [right, top], [x, top]]) @ sides
        return (np.vstack([patch, patch[:1]]),), (patch,)
    along = (held - point) @ axis
    low, high = float(along.min()), float(along.max())
    reach = _margin(high - low) + 0.3 * radius
    lines = [np.array([point + (low - reach) * axis, point + (high + reach) * axis])]
    if kind == "screw" and pitch and radius:
        arm, (first, second) = held[0] - point, _across(axis)
        phase = np.arctan2(arm @ second, arm @ first) + (low - arm @ axis) / pitch  # at the lowest place held
        turn = np.sign(pitch) * min((high - low) / abs(pitch), 2.0 * np.pi * MAX_TURNS)
        lines.append(_around(axis, point + low * axis, radius, turn, pitch, phase))
    elif kind != "line" and radius:  # the circle of a hinge, the two rims of a cylinder
        heights = (low, high) if kind == "other" else (0.5 * (low + high),)
        lines += [_around(axis, point + h * axis, radius) for h in heights]
    return tuple(lines), ()


def _around(
    axis: np.ndarray,
    point: np.ndarray,
    radius: float,
    turn: float = 2.0 * np.pi,
    pitch: float = 0.0,
    phase: float = 0.0,
) -> Float[np.ndarray, "n 3"]:
    """The circle, or the helix, of a hand that turns about an axis; it begins beside the point, at a phase [rad]."""
    first, second = _across(axis)
    begin = point + radius * (np.cos(phase) * first + np.sin(phase) * second)
    angles = np.linspace(0.0, turn, max(2, round(CIRCLE_POINTS * abs(turn) / (2.0 * np.pi)) + 1))[:, None]
    return Mechanism("screw", axis, point, pitch=pitch).places(begin, angles)


def _across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that make a right-handed frame with the axis."""
    first = null_basis(axis[None, :])[:, 0]
    return first, np.cross(axis, first)


def _margin(extent: float) -> float:
    return max(0.25 * extent, 0.06)  # [m] beyond a motion of that extent


def facing(out: Float[np.ndarray, " 3"], handle: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    """Pose of a handle that is pulled along `out`, as upright as that allows."""
    up = np.array([0.0, 0.0, 1.0]) if abs(out[2]) < UPRIGHT else np.array([1.0, 0.0, 0.0])
    up = up - (up @ out) * out
    up /= np.linalg.norm(up)
    return pin.SE3(np.column_stack([np.cross(out, up), out, up]), handle).homogeneous
