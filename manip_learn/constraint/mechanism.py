"""What holds the hand, in the terms of a machine: a line, a plane, a hinge, a ball, a screw, an orientation, a curve.

Its kind, what the hand may do while it holds on, and where it is say all: the rows that are zero, the chart of a grasp
(`Mechanism.at`), and with it every motion, what was shown, a drawing and a sentence.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.chart import Chart
from manip_learn.constraint.curve import CURVE_ROWS, Curve
from manip_learn.constraint.place import Place, across, mechanism_weights
from manip_learn.errors import ConstraintError
from manip_learn.linalg import finite

Kind = Literal["line", "plane", "space", "hinge", "screw", "cylinder", "ball", "curve"]
MechanismType = Literal["line", "plane", "hinge", "ball", "screw", "held-orientation", "other"]
Orientation = Literal["free", "about-axis", "fixed", "carried"]
Grip = Literal["firm", "kept", "loose"]
TURNING = ("turn-1", "turn-2", "turn")  # the rows that make up an angular velocity
_ABOUT, _FIRM, _AXLE = "turn-1 turn-2", "turn-1 turn-2 slide-1 slide-2", "axis point-across"


class _Kind(NamedTuple):
    """What is the same for all mechanisms of a kind.

    Attributes:
        type: What it is called in a report.
        words: In a sentence.
        unknowns: What is fitted.
        place: Rows that hold the place of the hand.
        carried: All rows, of a hand that turns with the mechanism; empty where that is no other case.
        told: How a hand may turn on those that the learner tells apart.
    """

    type: MechanismType
    words: str
    unknowns: str
    place: str
    carried: str
    told: str


_KINDS: dict[Kind, _Kind] = {
    "plane": _Kind("plane", "a plane ", "axis", "axial", "", "free about-axis fixed"),
    "line": _Kind("line", "a line ", "axis", "across-1 across-2", "", "free fixed"),
    "hinge": _Kind("hinge", "a hinge: ", _AXLE, "radial axial", f"{_FIRM} slide", "free about-axis fixed carried"),
    "ball": _Kind("ball", "a ball: ", "point", "spherical", "slide-1 slide-2 slide", "free carried"),
    "cylinder": _Kind("other", "a cylinder: ", _AXLE, "radial", _FIRM, "free carried"),
    "screw": _Kind("screw", "a screw: ", f"{_AXLE} pitch", "radial helical", f"{_FIRM} screw", "free carried"),
    "space": _Kind("held-orientation", "a held orientation", "", "", "", "about-axis fixed"),
    "curve": _Kind("other", "a curve", "", "across-1 across-2", "", ""),
}
# rows that hold how the hand turns, in words, and what the kind is called then
_TURNS: dict[Orientation, tuple[str, str, str]] = {
    "free": ("", "the hand may turn", ""),
    "about-axis": (_ABOUT, "the hand may turn about {axis} only", ", turning"),
    "fixed": (f"{_ABOUT} turn", "the hand does not turn", ", not turning"),
    "carried": (f"{_ABOUT} turn", "the hand turns with it", ", firm"),
}
_OTHER_NAMES = {"cylinder, firm": "sleeve, firm", "space, turning": "direction", "space, not turning": "orientation"}
CURVE = "curve"  # name of what is no lower pair, and holds the hand to a line of any shape
Z = np.array([0.0, 0.0, 1.0])  # the axis of what has none
CLEAR_SHARE = 0.1  # a row of `MechanismRows` is held, or free, to this share: see `MIXED`
# [m] distance from an axis below which the place of the hand does not tell the angle about it: an arm that places its
# hand to a millimetre tells it to a fifth of a radian there, its orientation tells it better
ON_THE_AXIS = 5e-3
GRIP = 0.02  # [m] a hand this near to a mechanism is on it: people take hold of a handle a finger's breadth further on


def held_rows(kind: Kind, orientation: Orientation) -> tuple[str, ...]:
    """Return the names of the rows of `MechanismRows`, or of `CurveRows`, that a mechanism leaves zero."""
    known = _KINDS[kind]
    firm = known.carried if orientation == "carried" else ""
    names = firm or f"{known.place} {_TURNS[orientation][0]}"
    turning = dict[str, str](zip(TURNING, CURVE_ROWS[3:], strict=True)) if kind == "curve" else {}  # of the base's axes
    return tuple(turning.get(name, name) for name in names.split())


@final
@dataclass(frozen=True)
class MechanismKind:
    """A mechanism that may hold the hand.

    Attributes:
        name: Unique name.
        kind: What the place of the hand is held to.
        orientation: What the hand may do: turn as it likes (`"free"`), turn about the mechanism's axis only
            (`"about-axis"`), not turn at all (`"fixed"`), or it turns with the mechanism (`"carried"`).
    """

    name: str
    kind: Kind
    orientation: Orientation

    @property
    def type(self) -> MechanismType:
        """What it is called in a report."""
        return _KINDS[self.kind].type

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Which of `"axis"`, `"point-across"` (two numbers), `"point"` (three) and `"pitch"` are fitted."""
        return ("axis",) if self.name == "direction" else tuple(_KINDS[self.kind].unknowns.split())

    @property
    def rows(self) -> tuple[str, ...]:
        """Rows of `MechanismRows` that are then zero."""
        return held_rows(self.kind, self.orientation)

    @property
    def n_rows(self) -> int:
        """Number of rows held."""
        return len(self.rows)

    @property
    def constant(self) -> bool:
        """Whether its rows are constant rows of the frame's Jacobian."""
        return self.kind in ("line", "plane", "space")


MECHANISM_KINDS: tuple[MechanismKind, ...] = tuple(
    MechanismKind(_OTHER_NAMES.get(name := f"{kind}{_TURNS[o][2]}", name), kind, o)
    for kind, known in _KINDS.items()
    for o in _TURNS
    if o in known.told.split()
)
KIND_BY_NAME = {kind.name: kind for kind in MECHANISM_KINDS}


def kind_of_rows(names: Iterable[str]) -> MechanismKind | None:
    """Return the kind that leaves just these rows of `MechanismRows` zero; None if there is none."""
    held = set(names)
    return next((kind for kind in MECHANISM_KINDS if set(kind.rows) == held), None)


@final
@dataclass(frozen=True, eq=False)
class Mechanism:
    """A mechanism that holds the hand; places and directions in the robot's base frame.

    Attributes:
        type: `"line"`, `"plane"`, `"hinge"`, `"ball"`, `"screw"`, `"held-orientation"` or `"other"` (a cylinder, or a
            curve).
        axis: shape (3,), unit vector: along a line, normal to a plane, along the axis of a hinge, a screw or a
            cylinder, the direction about which the hand may still turn. None for a ball, and where the hand does not
            turn at all.
        point: shape (3,) [m]: the centre of a ball, the point of an axis that is next to the hand, a point of a line
            or a plane. None for an orientation.
        radius: Distance of the hand from the axis or the centre, mean over the trajectories [m]; None where there is
            no such thing.
        pitch: Travel along the axis a radian of turning, right-handed screws positive [m/rad]; one full turn moves
            2 pi times as far. None but for screws.
        grip: `"firm"` if rows constrain the orientation of the hand, `"kept"` if the demonstrator kept its orientation
            by habit, `"loose"` if the hand turned.
        orientation: What the hand may do: `"free"`, `"about-axis"`, `"fixed"` or `"carried"` (it turns with the
            mechanism).
        uncertainty: What the error of each parameter stays below in 68 % of cases: `"axis"` [deg], `"point"` [m],
            `"radius"` [m], `"pitch"` [m/rad]; one standard deviation of a single number, the length of the error of an
            axis (two directions) or a point. It speaks of errors of the joints, those that differ from sample to sample
            and constant ones, and of what the trajectories scatter beyond these.
        arc: By how much the path turns about the axis or the centre [rad]; None where nothing turns.
        name: Which of the candidates it is, e.g. `"hinge, firm"`; `"curve"` where none of them fits.
        orientation_rms: RMS deviation of the orientation of the hand during contact, seen from the base or from what
            turns with the mechanism, the smaller one [deg]; None if it was not determined.
        relative_to: Name of the frame in which axis and point are given and the hand is seen; None for the base.
        curve: Of a hand that goes along one; None for the others.
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
    orientation_rms: float | None = None
    relative_to: str | None = None
    curve: Curve | None = None

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
        return Mechanism.from_dict, (self.to_dict(),)  # a read-only view of a dictionary cannot be pickled

    @property
    def kind(self) -> Kind:
        """What the place of the hand is held to; of a held orientation nothing, `"space"`."""
        if self.name in KIND_BY_NAME:
            return KIND_BY_NAME[self.name].kind
        own: dict[str, Kind] = {"held-orientation": "space", "other": "curve" if self.name == CURVE else "cylinder"}
        return own.get(self.type, self.type)  # type: ignore[arg-type]  # the others are called as they are

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the rows that are zero."""
        return held_rows(self.kind, self.orientation)

    @property
    def n_free(self) -> int:
        """Number of free coordinates: along the mechanism, and of the hand's own turn."""
        return 6 - len(self.rows)

    @property
    def sentence(self) -> str:
        """The mechanism in words and numbers, e.g. `"a line along (1.00, 0.00, 0.00); the hand may turn"`."""
        return f"{_KINDS[self.kind].words}{self.place}; {self.turns}"

    @property
    def noun(self) -> str:
        """Its type, or `"curve"`: in sentences."""
        return CURVE if self.kind == CURVE else self.type

    @property
    def place(self) -> str:
        """Its axis, centre, pitch and distance in words, in the robot's base frame; empty for an orientation."""
        if self.axis is None and self.grip == "firm" and self.type in ("line", "hinge", "screw"):
            return "fixed to the hand" + ("" if self.radius is None else f", {self.radius:.3f} m from its origin")
        axis, point = in_words(self.axis), in_words(self.point)
        words = {"line": f"along {axis}", "plane": f"across {axis}", "ball": f"centre {point}", "space": "", CURVE: ""}
        said = words.get(self.kind, f"axis {axis} through {point}")
        said += f" in {self.relative_to!r}" if said and self.relative_to else ""
        if self.pitch is not None:
            said += f", {1e3 * self.pitch:.2f} mm a radian"
        return said if self.radius is None else f"{said}, {self.radius:.3f} m from the hand"

    @property
    def turns(self) -> str:
        """How the hand may turn, in words."""
        around = {"plane": "its normal", "space": in_words(self.axis)}.get(self.kind, "the axis")
        slides = " and may slide along it" if self.name.startswith("sleeve") else ""
        if self.grip == "kept" and self.orientation_rms is not None:
            return f"the hand kept its orientation to {self.orientation_rms:.1f} degrees, by habit"
        return _TURNS[self.orientation][1].format(axis=around) + slides

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> Mechanism:
        """This mechanism where it stands elsewhere, p' = R p + t."""
        R = transform[:3, :3]
        axis = None if self.axis is None else R @ self.axis
        point = None if self.point is None else R @ self.point + transform[:3, 3]
        curve = None if self.curve is None else self.curve.moved(transform)
        return dataclasses.replace(self, axis=axis, point=point, curve=curve)

    def reversed(self) -> Mechanism:
        """This mechanism with the other sense of its axis, or of its curve; a pitch stays as it is."""
        axis = None if self.axis is None else -self.axis
        curve = None if self.curve is None else Curve(self.curve.points[::-1])
        return dataclasses.replace(self, axis=axis, curve=curve)

    def by_place(self) -> Mechanism:
        """This mechanism for a hand that may turn: its place alone tells how far it is."""
        return dataclasses.replace(self, orientation="free")

    def features(self, robot: Any, frame: str) -> Any:
        """Return the rows that are zero for a frame of a robot, Phi (6 - k, nv), of unit length at any distance.

        Args:
            robot: The robot.
            frame: Name of the frame.

        Raises:
            ConstraintError: The place of the mechanism is not known.
        """
        maps = import_module("manip_learn.constraint.features")  # which stand above, and say what they hold
        g, seen = self.located(), self.relative_to
        if self.curve is not None:  # a hand that turns with a curve turns at a rate that is no row's
            rows = held_rows("curve", "free" if self.orientation == "carried" else self.orientation)
            return maps.CurveRows(robot, frame, self.curve, rows, seen)
        place = {"axis": g.axis, "point": g.point, "pitch": g.pitch}
        return maps.MechanismRows(robot, frame, self.rows, **place, relative_to=seen)

    def located(self) -> Place:
        """Return the axis, a point and the pitch.

        Raises:
            ConstraintError: The kind has an axis or a point that is not known.
        """
        needed = {name.removesuffix("-across") for name in _KINDS[self.kind].unknowns.split()} - {"pitch"}
        if any(getattr(self, name) is None for name in needed) or (self.kind == CURVE and self.curve is None):
            raise ConstraintError(
                f"it is not known where the mechanism is ({self.sentence}): learn it from rows along the base's axes"
            )
        axis = Z if self.axis is None else self.axis / np.linalg.norm(self.axis)
        return Place(axis, np.zeros(3) if self.point is None else self.point, self.pitch or 0.0)

    def off(self, place: Float[np.ndarray, " 3"]) -> float:
        """Return how far a hand at a place is from where it can hold the mechanism [m]; 0 where that is not known.

        A line is held anywhere beside it: a handle runs across the drawer.
        """
        g = self.located()
        d = place - g.point
        across = d - (d @ g.axis) * g.axis
        if self.curve is not None:
            return float(np.linalg.norm(place - self.curve.at(self.curve.nearest(place[None]))[0]))
        if self.kind == "plane" and self.point is not None:
            return float(np.linalg.norm(d - across))
        if self.radius is None or self.orientation == "carried":
            return 0.0
        return abs(float(np.linalg.norm(d if self.kind == "ball" else across)) - self.radius)

    def at(self, pose: ArrayLike, within: float = 0.05) -> Chart:
        """Return the chart of a hand that took hold at a pose, where its free coordinates are 0.

        The coordinates are ways and angles along the mechanism, then the hand's own turns where it may turn.

        Args:
            pose: shape (4, 4), in the frame in which the mechanism is given.
            within: How far the hand may be off the mechanism [m].

        Raises:
            ConstraintError: The hand is farther off, no pose, or a mechanism whose place is not known.

        Example:
            >>> import numpy as np
            >>> import manip_learn as ml
            >>> hinge = ml.Mechanism("hinge", axis=(0, 0, 1), point=(0, 0, 0), orientation="carried", grip="firm")
            >>> grasp = np.eye(4)
            >>> grasp[0, 3] = 0.5
            >>> hinge.at(grasp).pose([np.pi / 2])[:3, 3].round(6)
            array([0. , 0.5, 0. ])
        """
        if (grasp := finite(pose, 4, 4)) is None:
            raise ConstraintError(f"a grasp is a pose (4, 4) of finite numbers, got {pose!r:.80}")
        g, p, none = self.located(), grasp[:3, 3], np.zeros((0, 3))
        if (off := self.off(p)) > within:
            raise ConstraintError(
                f"the hand is {1e3 * off:.3g} mm off the mechanism ({self.sentence}), {1e3 * within:.3g} mm are "
                "allowed: begin where it can hold it"
            )
        is_carried = self.orientation == "carried"
        turn, travel = none, none
        match self.kind:
            case "line" | "curve":
                travel = g.axis[None] if self.curve is None else self.curve.tangents(p[None])
            case "plane":
                travel = across(g.axis)
            case "space":
                travel = np.eye(3)
            case "hinge" | "screw":
                turn, travel = g.axis[None], g.pitch * g.axis[None]
            case "cylinder":
                turn, travel = np.outer([1.0, 0.0], g.axis), np.outer([0.0, 1.0], g.axis)
            case "ball":  # loosely held by two turns across the lever of the hand
                lever = p - g.point
                length = float(np.linalg.norm(lever))
                turn = np.eye(3) if is_carried else across(lever / length if length > 0.0 else Z)
                travel = np.zeros((len(turn), 3))
        turn = turn if len(turn) else np.zeros((len(travel), 3))
        spin = {"free": np.eye(3), "about-axis": g.axis[None]}.get(self.orientation, none)
        rest = np.zeros((len(spin), 3))
        screws = np.vstack([travel + np.cross(g.point, turn), rest]), np.vstack([turn, rest])
        return Chart(
            grasp,
            *screws,
            np.vstack([np.zeros((len(turn), 3)), spin]),
            is_carried=is_carried,
            centre=g.point,
            curve=self.curve,
            rows=self._weights,
        )

    def places(self, begin: Float[np.ndarray, " 3"], s: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n 3"]:
        """Return where a hand goes from a place, at coordinates along the mechanism: a line to draw [m].

        Args:
            begin: shape (3,) [m].
            s: shape (n, k), coordinates of `at` [m or rad].

        Raises:
            ConstraintError: It is not known where the mechanism is.
        """
        pose = np.eye(4)
        pose[:3, 3] = begin
        chart = self.by_place().at(pose, np.inf)
        return np.array([chart.pose(each)[:3, 3] for each in s])

    def _weights(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n h 6"]:
        """Return the weights of the hand's twist in the rows that are zero."""
        if self.curve is not None:
            return self.curve.weights(p)[0][:, [CURVE_ROWS.index(name) for name in self.rows]]
        return mechanism_weights(self.rows, self.located(), None).values(p)

    def to_dict(self) -> dict[str, Any]:
        """Type, axis, point, radius, pitch and uncertainty, and how the hand is held, ready for JSON."""
        values = {n: x for n in _FIELDS if (x := getattr(self, n)) is not None or n not in ("relative_to", "curve")}
        plain = {name: x.tolist() if isinstance(x, np.ndarray) else x for name, x in values.items()}
        if self.curve is not None:
            plain["curve"] = self.curve.points.tolist()
        return plain | {"uncertainty": dict(self.uncertainty), "sentence": self.sentence}

    @staticmethod
    def from_dict(described: Mapping[str, Any]) -> Mechanism:
        """What `to_dict` wrote."""
        values: dict[str, Any] = {name: described[name] for name in _FIELDS if name in described}
        if values.get("curve") is not None:
            values["curve"] = Curve(values["curve"])
        return Mechanism(**values)

    def __str__(self) -> str:
        return self.sentence


_FIELDS = tuple(field.name for field in dataclasses.fields(Mechanism))


def in_words(vector: np.ndarray | None) -> str:
    """A direction or a place with two digits; `"unknown"` for None."""
    if vector is None:
        return "unknown"
    return "(" + ", ".join(f"{x + 0.0:.2f}" for x in np.round(vector, 2)) + ")"


def mechanism_of(kind: MechanismKind, place: Place, radius: float | None, **known: Any) -> Mechanism:
    """Return the mechanism of a kind at a place, with the radius of the hand [m] and what else is known of it."""
    told = {
        "axis": place.axis if "axis" in kind.unknowns else None,
        "point": None if kind.kind == "space" else place.point,
        "pitch": place.pitch if "pitch" in kind.unknowns else None,
        "grip": "loose" if kind.orientation == "free" else "firm",
    }
    return Mechanism(kind.type, radius=radius, orientation=kind.orientation, name=kind.name, **told | known)
