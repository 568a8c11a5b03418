"""What holds the hand, in the terms of a machine: a line, a plane, a hinge, a ball, a screw, an orientation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.learning.mechanisms.kinds import MechanismType, Orientation

Grip = Literal["loose", "firm"]
_TURNS: dict[Orientation, str] = {
    "free": "the hand may turn",
    "about-axis": "the hand may turn about {axis} only",
    "fixed": "the hand does not turn",
    "carried": "the hand turns with it",
}
_NAMES: dict[MechanismType, str] = {
    "line": "a line ",
    "plane": "a plane ",
    "hinge": "a hinge: ",
    "ball": "a ball: ",
    "screw": "a screw: ",
    "held-orientation": "a held orientation",
    "other": "a cylinder: ",
}


@final
@dataclass(frozen=True, eq=False)
class Mechanism:
    """A mechanism that holds the hand; places and directions in the robot's base frame.

    Attributes:
        type: `"line"`, `"plane"`, `"hinge"`, `"ball"`, `"screw"`, `"held-orientation"` or `"other"` (a cylinder).
        axis: shape (3,), unit vector: along a line, normal to a plane, along the axis of a hinge, a screw or a
            cylinder, the direction about which the hand may still turn. None for a ball, and where the hand does not
            turn at all.
        point: shape (3,) [m]: the centre of a ball, the point of an axis that is next to the hand, a point of a line
            or a plane. None for an orientation.
        radius: Distance of the hand from the axis or the centre, mean over the trajectories [m]; None where there is
            no such thing.
        pitch: Travel along the axis a radian of turning, right-handed screws positive [m/rad]; one full turn moves
            2 pi times as far. None but for screws.
        grip: `"firm"` if the mechanism holds the hand's orientation too, `"loose"` if the hand may turn.
        orientation: What the hand may do: `"free"`, `"about-axis"`, `"fixed"` or `"carried"` (it turns with the
            mechanism).
        uncertainty: What the error of each parameter stays below in 68 % of cases: `"axis"` [deg], `"point"` [m],
            `"radius"` [m], `"pitch"` [m/rad]; one standard deviation of a single number, the length of the error of an
            axis (two directions) or a point. It speaks of errors of the joints, those that differ from sample to sample
            and constant ones, and of what the trajectories scatter beyond these.
        arc: By how much the path turns about the axis or the centre [rad]; None where nothing turns.
        name: Which of the candidates it is, e.g. `"hinge, firm"`.
    """

    type: MechanismType
    axis: Float[np.ndarray, " 3"] | None = None
    point: Float[np.ndarray, " 3"] | None = None
    radius: float | None = None
    pitch: float | None = None
    grip: Grip = "loose"
    orientation: Orientation = "free"
    uncertainty: Mapping[str, float] = field(default_factory=dict)
    arc: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        for what in ("axis", "point"):
            vector = getattr(self, what)
            if vector is not None:
                vector = np.array(vector, dtype=np.float64)
                vector.setflags(write=False)
                object.__setattr__(self, what, vector)
        object.__setattr__(self, "uncertainty", MappingProxyType(dict(self.uncertainty)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mechanism) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.type, self.name))

    def __reduce__(self):
        # a read-only view of a dictionary cannot be pickled
        values = (self.type, self.axis, self.point, self.radius, self.pitch, self.grip, self.orientation)
        return Mechanism, (*values, dict(self.uncertainty), self.arc, self.name)

    @property
    def sentence(self) -> str:
        """The mechanism in words and numbers, e.g. `"a line along (1.00, 0.00, 0.00); the hand may turn"`."""
        return f"{_NAMES[self.type]}{self.place}; {self.turns}"

    @property
    def place(self) -> str:
        """Its axis, centre, pitch and distance in words, in the robot's base frame; empty for an orientation."""
        axis, point = in_words(self.axis), in_words(self.point)
        words = {"line": f"along {axis}", "plane": f"across {axis}", "ball": f"centre {point}", "held-orientation": ""}
        said = words.get(self.type, f"axis {axis} through {point}")
        if self.pitch is not None:
            said += f", {1e3 * self.pitch:.2f} mm a radian"
        return said if self.radius is None else f"{said}, {self.radius:.3f} m from the hand"

    @property
    def turns(self) -> str:
        """How the hand may turn, in words."""
        around = "its normal" if self.type == "plane" else "the axis"
        if self.type == "held-orientation" and self.axis is not None:
            around = in_words(self.axis)
        slides = " and may slide along it" if self.name.startswith("sleeve") else ""
        return _TURNS[self.orientation].format(axis=around) + slides

    def to_dict(self) -> dict[str, Any]:
        """Type, axis, point, radius, pitch and uncertainty, and how the hand is held, ready for JSON."""
        return {
            "type": self.type,
            "axis": None if self.axis is None else self.axis.tolist(),
            "point": None if self.point is None else self.point.tolist(),
            "radius": self.radius,
            "pitch": self.pitch,
            "grip": self.grip,
            "orientation": self.orientation,
            "arc": self.arc,
            "uncertainty": dict(self.uncertainty),
            "name": self.name,
            "sentence": self.sentence,
        }

    def __str__(self) -> str:
        return self.sentence


def in_words(vector: np.ndarray | None) -> str:
    """A direction or a place with two digits; `"unknown"` for None."""
    if vector is None:
        return "unknown"
    return "(" + ", ".join(f"{x + 0.0:.2f}" for x in np.round(vector, 2)) + ")"
