"""A mechanism in the scene, as lines and surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.mechanism import Mechanism
from manip_learn.constraint.place import across
from manip_learn.constraint.shown import Intention, Shown
from manip_learn.errors import RecordingError
from manip_learn.linalg import finite
from manip_learn.playback.page_writer import packed

MAX_NUMBER = 1e9  # [m] what is farther away cannot be drawn
_MAX_TEXT = 400


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
    patches: tuple[Float[np.ndarray, "4 3"], ...]
    shown: str
    way: Float[np.ndarray, "_n 3"]
    hold: bool

    def to_dict(self) -> dict[str, Any]:
        """For the page."""
        packed_up = {name: [packed(x, "<f4") for x in getattr(self, name)] for name in ("lines", "patches")}
        return vars(self) | packed_up | {"way": packed(self.way, "<f4")}


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
    way, hold = np.zeros((0, 3)), False
    if isinstance(shown, Shown) and not described.get("relative_to"):
        way, hold = shown.points, shown.hold is not None
    sentence = str(described.get("sentence") or kind)[:_MAX_TEXT]
    return MechanismDrawing(
        kind, sentence, *_form(kind, described, held), "" if shown is None else shown.sentence, way, hold
    )


def _form(
    kind: str, described: Mapping[str, Any], held: Float[np.ndarray, "n 3"]
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Return the lines and the patches of a mechanism; none where it lacks an axis or a place."""
    known = dict[str, Any]()
    for name, shape in {"axis": (3,), "point": (3,), "radius": (), "pitch": ()}.items():
        given = described.get(name)
        known[name] = None if given is None else finite(given, *shape)
        if given is not None and (known[name] is None or not np.all(np.abs(known[name]) < MAX_NUMBER)):
            wanted = f"{'three finite numbers' if shape else 'a finite number'} below {MAX_NUMBER:g}"
            raise RecordingError(f"the mechanism's {name} must be {wanted}, got {given!r:.80}", code="mechanism")
    axis, point, radius, pitch = known["axis"], known["point"], float(known["radius"] or 0), float(known["pitch"] or 0)
    if kind == "ball" and point is not None and radius:
        return tuple(_helix(a, point, radius) for a in np.eye(3)), ()
    if kind == "ball" or axis is None or point is None or not np.any(axis):
        return (), ()
    axis = axis / np.linalg.norm(axis)
    beside, along = (held - point) @ across(axis).T, (held - point) @ axis
    if kind == "plane":  # a rectangle, its sides along the widest and the narrowest spread of the motion
        turn = np.linalg.svd(beside - beside.mean(axis=0), full_matrices=False)[2] if len(held) > 2 else np.eye(2)
        within = beside @ turn.T
        margin = _margin(float(np.ptp(within, axis=0).max()))
        (x, y), (right, top) = within.min(axis=0) - margin, within.max(axis=0) + margin
        patch = point + np.array([[x, y], [right, y], [right, top], [x, top]]) @ turn @ across(axis)
        return (np.vstack([patch, patch[:1]]),), (patch,)
    low, high = float(along.min()), float(along.max())
    reach = _margin(high - low) + 0.3 * radius
    lines = [np.array([point + (low - reach) * axis, point + (high + reach) * axis])]
    if kind == "screw" and pitch and radius:
        phase = np.arctan2(beside[0, 1], beside[0, 0]) + (low - along[0]) / pitch  # at the lowest place held
        turn = np.sign(pitch) * min((high - low) / abs(pitch), 2.0 * np.pi * 12.0)  # more turns are not told apart
        lines.append(_helix(axis, point + low * axis, radius, turn, pitch, phase))
    elif kind != "line" and radius:  # the circle of a hinge, the two rims of a cylinder
        heights = (low, high) if kind == "other" else (0.5 * (low + high),)
        lines += [_helix(axis, point + h * axis, radius) for h in heights]
    return tuple(lines), ()


def _helix(
    axis: np.ndarray, point: np.ndarray, radius: float, turn: float = 2.0 * np.pi, pitch: float = 0.0, phase: float = 0
) -> Float[np.ndarray, "n 3"]:
    """Return the circle, or the helix, of a hand that turns about an axis; it begins beside the point at a phase [rad].

    Lines of 3.75 degrees look round when they fill a screen.
    """
    angles = np.linspace(0.0, turn, max(2, round(96 * abs(turn) / (2.0 * np.pi)) + 1))[:, None]
    turned = np.hstack([np.cos(phase + angles), np.sin(phase + angles)]) @ across(axis)
    return point + radius * turned + pitch * angles * axis


def _margin(extent: float) -> float:
    return max(0.25 * extent, 0.06)  # [m] beyond a motion of that extent
