"""What holds the hand, in the terms of a machine: a line, a plane, a hinge, a ball, a screw, an orientation.

The lower pairs of a machine are the subgroups of SE(3), and the motions that one of them allows are a constant space of
twists; the type, the axis and the pitch of a mechanism are therefore read from Lambda itself.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.features.place_fields import AT_A_DISTANCE, Place
from manip_learn.constraint.features.place_rows import PlaceRows
from manip_learn.constraint.features.relative_frame_jacobian import RelativeFrameJacobian
from manip_learn.constraint.mechanism_kinds import MECHANISM_KINDS, MechanismKind, MechanismType, Orientation
from manip_learn.constraint.mechanism_reading import Read, of_point_rows, of_twists, on_twist, read_kind, rows_of
from manip_learn.linalg import null_basis

Grip = Literal["loose", "firm"]
# rows of translation and of rotation stand apart where each is held to this share, or free to it: a row of a learnt
# Lambda leaks by its uncertainty, 1e-2 at 0.6 degrees, and a row that mixes the two for good does so by 0.3 and more
CLEAR_SHARE = 0.1
# [m/rad] a travel below this is that of a hinge: a tenth of the flattest thread in use (M6, 1 mm a turn, 0.16 mm/rad)
LEAST_PITCH = 1.6e-5
# the axis that the learner fitted belongs to these rows if it is nearer to theirs than this: 1 degree
SAME_AXIS = 0.9998
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
        if self.axis is None and self.grip == "firm" and self.type in ("line", "hinge", "screw"):
            return "fixed to the hand" + ("" if self.radius is None else f", {self.radius:.3f} m from its origin")
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

    @staticmethod
    def from_dict(described: Mapping[str, Any]) -> Mechanism:
        """What `to_dict` wrote."""
        kept = ("type", "axis", "point", "radius", "pitch", "grip", "orientation", "uncertainty", "arc", "name")
        return Mechanism(**{name: described[name] for name in kept if name in described})

    def __str__(self) -> str:
        return self.sentence


def in_words(vector: np.ndarray | None) -> str:
    """A direction or a place with two digits; `"unknown"` for None."""
    if vector is None:
        return "unknown"
    return "(" + ", ".join(f"{x + 0.0:.2f}" for x in np.round(vector, 2)) + ")"


def read_mechanism(
    selection: Float[np.ndarray, "s p"], features: FeatureMap, learnt: Mapping[str, Any]
) -> Mechanism | None:
    """The mechanism whose motions Lambda leaves free; None if it is none that a machine has, or features of no frame.

    Args:
        selection: Lambda, with orthonormal rows.
        features: Phi.
        learnt: What is known of how Lambda was learnt, empty if it was not: the mechanism fitted to positions adds the
            place, the radius and the uncertainty, if it is the mechanism of these rows.
    """
    read, fitted, angle = None, learnt.get("mechanism"), learnt.get("uncertainty_deg")
    spread = math.radians(angle) if isinstance(angle, int | float) else 0.0
    if isinstance(features, MechanismRows):
        read = _of_mechanism_rows(selection, features)
    elif isinstance(features, PlaceRows):
        read = _of_place_rows(selection, features, learnt.get("postures"), spread)
    elif isinstance(features, FrameJacobian | RelativeFrameJacobian):
        read = _of_twist_rows(selection, features, spread)
    if read is None or not isinstance(fitted, Mapping):
        return read
    try:
        known = Mechanism.from_dict(fitted)
    except (KeyError, TypeError, ValueError):
        return read  # of another version, or damaged: Lambda has said what it says
    same = known.type == read.type and known.orientation == read.orientation
    if same and known.axis is not None and read.axis is not None:
        same = known.axis.shape == (3,) and abs(float(known.axis @ read.axis)) > SAME_AXIS * np.linalg.norm(known.axis)
    return known if same else read


def _of_mechanism_rows(selection: np.ndarray, features: MechanismRows) -> Mechanism | None:
    shares = np.einsum("sp,sp->p", selection, selection)
    if np.any(np.abs(shares - np.round(shares)) > CLEAR_SHARE):
        return None
    held = {name for name, share in zip(features.row_names, shares, strict=True) if share > 0.5}
    kind = next((k for k in MECHANISM_KINDS if set(k.rows) == held), None)
    return None if kind is None else _of_kind(kind, features.geometry, features.radius)


def _of_place_rows(selection: np.ndarray, features: PlaceRows, postures: Any, spread: float) -> Mechanism | None:
    """The hand is where the postures show it; without them its radius is unknown, and so is a helix."""
    shown = features.middle[None]
    if isinstance(postures, list) and postures:
        shown = np.array([features.robot.position(q, features.frame) for q in postures])
    read = read_kind(features, selection, np.zeros((0, features.n_rows)), shown)
    if read is None or (read[0].name == "screw" and not postures):
        return None
    (kind, place), radius = _hinge_or_screw(read, shown[0], spread), None
    if postures and set(kind.rows) & set(AT_A_DISTANCE):
        out = shown - place.point
        out -= 0.0 if kind.type == "ball" else np.outer(out @ place.axis, place.axis)
        radius = float(np.linalg.norm(out, axis=1).mean())
    found = _of_kind(kind, place, radius)
    return dataclasses.replace(found, axis=None) if kind.name == "orientation" else found


def _of_kind(kind: MechanismKind, place: Place, radius: float | None) -> Mechanism:
    return Mechanism(
        kind.type,
        None if kind.type == "ball" else place.axis,
        None if kind.type == "held-orientation" else place.point,
        radius,
        place.pitch if kind.type == "screw" else None,
        "firm" if kind.orientation == "carried" else "loose",
        kind.orientation,
        name=kind.name,
    )


def named_rows(
    mechanism: Mechanism | None, features: FeatureMap, selection: Float[np.ndarray, "s p"]
) -> tuple[FeatureMap, Float[np.ndarray, "s r"]]:
    """Phi and Lambda of rows that are named after the mechanism, in the place of those of `PlaceRows`."""
    kind = next((k for k in MECHANISM_KINDS if mechanism is not None and k.name == mechanism.name), None)
    if mechanism is None or kind is None or not isinstance(features, PlaceRows):
        return features, selection
    axis = np.array([0.0, 0.0, 1.0]) if mechanism.axis is None else mechanism.axis
    point = features.middle if mechanism.point is None else mechanism.point
    place = Place(axis / np.linalg.norm(axis), point, mechanism.pitch or 0.0)
    return rows_of(kind, place, mechanism.radius, features.robot, features.frame.name)


def _of_twist_rows(
    selection: np.ndarray, features: FrameJacobian | RelativeFrameJacobian, spread: float
) -> Mechanism | None:
    """From constant rows of a frame's twist (v, w) of its origin, known to an angle [rad]; of no place in the base."""
    reference = features.reference if isinstance(features, FrameJacobian) else None
    hand, none = np.zeros(3), np.zeros((0, features.n_rows))
    if reference == "local" and len(selection) == 5 and features.n_rows == len(AXES):
        read = of_twists(null_basis(on_twist(features.row_names, selection)).T, hand)
        if read is None:
            return None
        kind, place = _hinge_or_screw(read, hand, spread)
        found = _of_kind(kind, place, None if kind.type == "line" else float(np.linalg.norm(place.point)))
        return dataclasses.replace(found, axis=None, point=None, grip="firm")
    held, blind = (on_twist(features.row_names, rows, distance=True) for rows in (selection, none))
    read = of_point_rows(held, blind, hand, aligned=False)
    if read is None:
        return None
    kind, place = read
    if kind.type != "held-orientation":
        if not set(AXES[:3]) <= set(features.row_names):
            return None
        if reference == "local" and kind.orientation != "fixed":
            return None  # directions of a hand that turns are no line and no plane
    axis = place.axis * np.sign(place.axis[np.argmax(np.abs(place.axis))])
    known = reference == "world" and kind.name != "orientation"
    return dataclasses.replace(_of_kind(kind, place, None), axis=axis if known else None, point=None)


def _hinge_or_screw(read: Read, hand: Float[np.ndarray, " 3"], spread: float) -> Read:
    """The one twist of a firm grip is a hinge's unless it travels more than three standard deviations of its angle."""
    kind, place = read
    radius = float(np.linalg.norm(place.point - hand))
    if kind.name != "screw, firm" or abs(place.pitch) >= max(LEAST_PITCH, 3.0 * spread * math.hypot(1.0, radius)):
        return read
    return next(k for k in MECHANISM_KINDS if k.name == "hinge, firm"), place
