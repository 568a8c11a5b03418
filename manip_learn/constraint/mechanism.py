"""Mechanisms that constrain the end effector: a line, a plane, a hinge, a ball, a screw, an orientation, a curve.

A mechanism is described by its kind, the remaining freedom of the hand's orientation, and its axis and point. These
determine which feature rows are zero, and the coordinates of a grasped hand along the mechanism (`Mechanism.at`), from
which motions, drawings and sentences are computed.

The lower pairs of kinematics are subgroups of SE(3): the motions that a pair leaves free form a constant space of
twists. The kind, the axis and the pitch of a mechanism can therefore be computed from Lambda alone.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.place import AXES, CURVE_ROWS, Chart, Curve, CurveWeights, Place, across, mechanism_weights
from manip_learn.errors import ConstraintError, error_in_words, listed
from manip_learn.linalg import finite
from manip_learn.robot.rotations import skew

Kind = Literal["line", "plane", "space", "hinge", "screw", "cylinder", "ball", "curve"]
MechanismType = Literal["line", "plane", "hinge", "ball", "screw", "held-orientation", "other"]
Orientation = Literal["free", "about-axis", "fixed", "carried"]
Grip = Literal["firm", "kept", "loose"]
_ABOUT, _FIRM, _AXLE = "turn-1 turn-2", "turn-1 turn-2 slide-1 slide-2", "axis point-across"


class _Kind(NamedTuple):
    """Properties shared by all mechanisms of a kind.

    Attributes:
        words: Beginning of its sentence.
        unknowns: Fitted parameters.
        place: Rows that constrain the hand's position.
        carried: All rows if the hand turns with the mechanism; empty if this is no separate case.
        learnable: Orientations (of the hand) that the learner distinguishes.
        turns, travels: Directions of the rotations, then of the translations among its free coordinates: `"axis"`, the
            two `"across"` it, or `"all"`.
    """

    words: str
    unknowns: str
    place: str
    carried: str
    learnable: str
    turns: str
    travels: str


_KINDS: dict[Kind, _Kind] = {
    "plane": _Kind("a plane ", "axis", "axial", "", "free about-axis fixed", "", "across"),
    "line": _Kind("a line ", "axis", "across-1 across-2", "", "free fixed", "", "axis"),
    "hinge": _Kind("a hinge: ", _AXLE, "radial axial", f"{_FIRM} slide", "free about-axis fixed carried", "axis", ""),
    "ball": _Kind("a ball: ", "point", "spherical", "slide-1 slide-2 slide", "free carried", "all", ""),
    "cylinder": _Kind("a cylinder: ", _AXLE, "radial", _FIRM, "free carried", "axis", "axis"),
    "screw": _Kind("a screw: ", f"{_AXLE} pitch", "radial helical", f"{_FIRM} screw", "free carried", "axis", ""),
    "space": _Kind("a held orientation", "", "", "", "about-axis fixed", "", "all"),
    "curve": _Kind("a curve", "", "across-1 across-2", "", "", "", "axis"),
}
_NOUNS: dict[Kind, str] = {"space": "held-orientation", "cylinder": "other"}  # kinds with another name in reports
# per orientation: rows that constrain the rotation of the hand, the words for it, and the suffix of the name
_TURNS: dict[Orientation, tuple[str, str, str]] = {
    "free": ("", "the hand may turn", ""),
    "about-axis": (_ABOUT, "the hand may turn about {axis} only", ", turning"),
    "fixed": (f"{_ABOUT} turn", "the hand does not turn", ", not turning"),
    "carried": (f"{_ABOUT} turn", "the hand turns with it", ", firm"),
}
_OTHER_NAMES = {"cylinder, firm": "sleeve, firm", "space, turning": "direction", "space, not turning": "orientation"}
CURVE = "curve"  # name of a guide of any shape, which is not a lower pair
# kind -> its appearance, and its free motion for rows that depend on the position
SHAPES: dict[Kind, tuple[str, str]] = {
    "line": ("a straight line (a drawer)", "move along {axis} and cannot leave that line"),
    "plane": ("a plane (a table)", "move in the plane across {axis} and cannot leave it"),
    "hinge": ("a hinge (a door)", "move on a circle{radius} about {axle} and cannot leave it"),
    "ball": ("a ball joint (a tether)", "move on a sphere{radius} about {point} and cannot leave it"),
    "screw": ("a screw (a valve)", "move on a helix{radius} about {axle} and cannot leave it"),
    "space": ("a held orientation (a full cup)", "turn about {axis} and is blocked about every other axis"),
    "cylinder": ("a cylinder (a sleeve on a rod)", "move on a cylinder{radius} about {axle} and cannot leave it"),
    "curve": ("a rail that is bent", "move along it and cannot leave it"),
}
Z = np.array([0.0, 0.0, 1.0])  # default axis
CLEAR_SHARE = 0.1  # largest leakage of a row of `MechanismRows` that counts as held or free: see `MIXED`
# [m] distance from an axis below which the hand's position does not determine its angle: an arm with 1 mm accuracy
# gives the angle to a fifth of a radian there, and the orientation gives it more precisely
ON_THE_AXIS = 5e-3
GRIP = 0.02  # [m] largest distance of a hand on a mechanism: people grasp a handle up to a finger's breadth off
# a row counts as pure translation or pure rotation if its other part is below this share: a row of a learnt Lambda
# leaks by its uncertainty, 1e-2 at 0.6 degrees, and a row that really mixes the two does so by 0.3 or more
MIXED = 0.2
# [m/rad] a screw with a smaller pitch counts as a hinge: a tenth of the finest common thread (M6, 1 mm per turn,
# 0.16 mm/rad)
LEAST_PITCH = 1.6e-5
NEGLIGIBLE_ENTRY = 5e-3  # entries of a unit vector below this are printed as 0: half of the second digit


@final
@dataclass(frozen=True)
class MechanismKind:
    """Kind of mechanism that may constrain the end effector.

    Attributes:
        name: Unique name, e.g. `"hinge, firm"`.
        kind: Surface or curve that constrains the position of the hand, e.g. `"hinge"`.
        orientation: Freedom of the hand's orientation: it turns freely (`"free"`), about the mechanism's axis only
            (`"about-axis"`), not at all (`"fixed"`), or with the mechanism (`"carried"`).
        type: Type in a report, see `Mechanism`.
        unknowns: Parameters to fit, among `"axis"`, `"point-across"` (a point of the axis, two numbers), `"point"`
            (three numbers) and `"pitch"`.
        rows: Names of the rows of `MechanismRows`, or of `CurveRows`, that this mechanism holds at zero.
    """

    name: str
    kind: Kind
    orientation: Orientation
    type: MechanismType
    unknowns: tuple[str, ...]
    rows: tuple[str, ...]


def _kind(kind: Kind, orientation: Orientation) -> MechanismKind:
    """Return the kind of mechanism with an orientation of the hand."""
    spec, (turning, _, suffix) = _KINDS[kind], _TURNS[orientation]
    names = (orientation == "carried" and spec.carried) or f"{spec.place} {turning}"
    turns = zip(_TURNS["fixed"][0].split(), CURVE_ROWS[3:], strict=True)  # for a curve, about the base's axes
    renamed = dict[str, str](turns) if kind == CURVE else {}
    name = _OTHER_NAMES.get(f"{kind}{suffix}", f"{kind}{suffix}")
    unknowns = "axis" if name == "direction" else spec.unknowns
    rows = tuple(renamed.get(row, row) for row in names.split())
    noun: Any = "other" if kind == CURVE else _NOUNS.get(kind, kind)
    return MechanismKind(name, kind, orientation, noun, tuple(unknowns.split()), rows)


KINDS = {(kind, orientation): _kind(kind, orientation) for kind in _KINDS for orientation in _TURNS}
# kinds that the learner distinguishes
MECHANISM_KINDS = tuple(kind for kind in KINDS.values() if kind.orientation in _KINDS[kind.kind].learnable.split())
KIND_BY_NAME = {kind.name: kind for kind in MECHANISM_KINDS}
Match = tuple[MechanismKind, Place]  # kind and place of a mechanism that fits some rows
Rows = Float[np.ndarray, "_ k"]


def kind_of_rows(names: Iterable[str]) -> MechanismKind | None:
    """Return the kind of mechanism that holds exactly these rows at zero.

    Args:
        names: Names of rows of `MechanismRows` or `CurveRows`, in any order.

    Returns:
        The kind; None if no kind has exactly these rows.
    """
    zero_rows = set(names)
    return next((kind for kind in MECHANISM_KINDS if set(kind.rows) == zero_rows), None)


def plain(record: Any, digits: int | None = None) -> dict[str, Any]:
    """Return the fields of a dataclass as numbers, lists and dictionaries, ready for JSON.

    Args:
        record: Instance of a dataclass.
        digits: Decimals to which arrays are rounded; None for no rounding.

    Returns:
        Dictionary from field name to value.
    """
    values = {each.name: getattr(record, each.name) for each in dataclasses.fields(record) if each.init}
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            values[name] = (value if digits is None else np.round(value, digits)).tolist()
        elif isinstance(value, Curve):
            values[name] = value.points.tolist()
        elif isinstance(value, Mechanism):
            values[name] = value.to_dict()
    return values


def from_plain(make: Any, content: Mapping[str, Any]) -> Any:
    """Build an instance of a dataclass from the output of `plain`; entries that are not fields are ignored.

    Args:
        make: The class.
        content: The output of `plain`.

    Returns:
        An instance of the dataclass.
    """
    values = {each.name: content[each.name] for each in dataclasses.fields(make) if each.init and each.name in content}
    for name, value in values.items():
        if isinstance(value, list):
            values[name] = Curve(value) if name == "curve" else np.array(value, dtype=np.float64)
        elif name == "mechanism":
            values[name] = from_plain(Mechanism, value)
    return make(**values)


@final
@dataclass(frozen=True, eq=False)
class Mechanism:
    """Mechanism that constrains the end effector; positions and directions in the robot's base frame.

    Attributes:
        type: `"line"`, `"plane"`, `"hinge"`, `"ball"`, `"screw"`, `"held-orientation"` or `"other"` (a cylinder, or a
            curve).
        axis: shape (3,), unit vector: along a line, normal to a plane, or along the axis of a hinge, a screw or a
            cylinder; for a held orientation, the direction about which the hand may still turn. None for a ball, and
            for a held orientation without such a direction.
        point: shape (3,) [m]: the centre of a ball, the point of an axis nearest to the hand, or a point of a line or a
            plane. None for a held orientation.
        radius: Distance of the hand from the axis or the centre, mean over the trajectories [m]; None if it does not
            apply.
        pitch: Travel along the axis per radian of rotation, right-handed screws positive [m/rad]; one full turn moves 2
            pi times as far. None except for screws.
        grip: `"firm"` if the mechanism constrains the orientation of the hand, `"kept"` if it does not but the
            demonstrator kept the orientation by habit, `"loose"` if the hand turned freely.
        orientation: Freedom of the hand's orientation: `"free"`, `"about-axis"`, `"fixed"` or `"carried"` (it turns
            with the mechanism).
        uncertainty: Parameter -> bound of its error that holds with 68 % probability: `"axis"` [deg], `"point"` [m],
            `"radius"` [m], `"pitch"` [m/rad]. For a number this is one standard deviation; for an axis or a point it
            bounds the size of the error. Covered are joint errors (noise and constant offsets) and the remaining
            scatter of the trajectories.
        arc: Angle of the path about the axis or the centre [rad]; None if the mechanism has no rotation.
        name: Name of the `MechanismKind`, e.g. `"hinge, firm"`; `"curve"` if none of the lower pairs fits.
        orientation_rms: RMS deviation of the hand's orientation during contact, relative to the base or to the part
            that turns with the mechanism, the smaller one [deg]; None if it was not determined.
        relative_to: Name of the frame of axis, point and the hand's poses; None for the base.
        curve: The guide curve of kind `"curve"`; None for other kinds.
        kind: Surface or curve that constrains the position of the hand; `"space"` for a held orientation, which leaves
            the position free.
        in_fingers: True for a sleeve on a rod that the hand grasps on the axis itself, so that the fingers turn about
            it.
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
    kind: Kind = field(init=False, repr=False)
    in_fingers: bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for what in ("axis", "point"):
            vector = getattr(self, what)
            if vector is not None:
                vector = np.array(vector, dtype=np.float64)
                vector.setflags(write=False)
                object.__setattr__(self, what, vector)
        object.__setattr__(self, "uncertainty", MappingProxyType(dict(self.uncertainty)))
        kinds = {"held-orientation": "space", "other": CURVE if self.name == CURVE else "cylinder"}
        kind = KIND_BY_NAME[self.name].kind if self.name in KIND_BY_NAME else kinds.get(self.type, self.type)
        object.__setattr__(self, "kind", kind)
        is_sleeve = kind == "cylinder" and self.orientation == "carried"
        object.__setattr__(self, "in_fingers", is_sleeve and (self.radius or 1.0) < ON_THE_AXIS)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mechanism) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.type, self.name))

    def __reduce__(self):
        return Mechanism.from_dict, (self.to_dict(),)  # a read-only view of a dictionary cannot be pickled

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the feature rows that the mechanism holds at zero, see `MechanismRows` and `CurveRows`."""
        return KINDS[self.kind, self.orientation].rows

    @property
    def n_free(self) -> int:
        """Number of free coordinates: motions along the mechanism, plus rotations of the hand that it leaves free."""
        return 6 - len(self.rows)

    @property
    def sentence(self) -> str:
        """The mechanism in words and numbers, e.g. `"a line along (1.00, 0.00, 0.00); the hand may turn"`."""
        return f"{_KINDS[self.kind].words}{self.place}; {self.turns}"

    @property
    def noun(self) -> str:
        """Type of the mechanism as a noun for sentences, e.g. `"hinge"`, `"held-orientation"` or `"curve"`."""
        return _NOUNS.get(self.kind, self.kind)

    @property
    def place(self) -> str:
        """Axis, centre, pitch and distance from the hand as text; empty for a held orientation and for a curve."""
        if self.axis is None and self.grip == "firm" and self.type in ("line", "hinge", "screw"):
            return "fixed to the hand" + ("" if self.radius is None else f", {self.radius:.3f} m from its origin")
        axis, point = format_vector(self.axis), format_vector(self.point)
        words = {"line": f"along {axis}", "plane": f"across {axis}", "ball": f"centre {point}", "space": "", CURVE: ""}
        text = words.get(self.kind, f"axis {axis} through {point}")
        text += f" in {self.relative_to!r}" if text and self.relative_to else ""
        text += "" if self.pitch is None else f", {1e3 * self.pitch:.2f} mm a radian"
        return text if self.radius is None else f"{text}, {self.radius:.3f} m from the hand"

    @property
    def turns(self) -> str:
        """Freedom of the hand's orientation in words, e.g. `"the hand may turn"`."""
        if self.grip == "kept" and self.orientation_rms is not None:
            return f"the hand kept its orientation to {self.orientation_rms:.1f} degrees, by habit"
        around = {"plane": "its normal", "space": format_vector(self.axis)}.get(self.kind, "the axis")
        slides = " and may slide along it" if self.name.startswith("sleeve") else ""
        return _TURNS[self.orientation][1].format(axis=around) + slides

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> Mechanism:
        """Return this mechanism after a rigid motion of it, p' = R p + t.

        Args:
            transform: Homogeneous matrix (4, 4) of R and t, in the frame of axis and point [m].

        Returns:
            The moved mechanism.
        """
        R = transform[:3, :3]
        axis = None if self.axis is None else R @ self.axis
        point = None if self.point is None else R @ self.point + transform[:3, 3]
        curve = None if self.curve is None else self.curve.moved(transform)
        return dataclasses.replace(self, axis=axis, point=point, curve=curve)

    def reversed(self) -> Mechanism:
        """Return this mechanism with its axis, or its curve, in the opposite direction; the pitch does not change."""
        curve = None if self.curve is None else Curve(self.curve.points[::-1])
        return dataclasses.replace(self, axis=None if self.axis is None else -self.axis, curve=curve)

    def by_place(self) -> Mechanism:
        """Return this mechanism with a free orientation, so that coordinates depend on the hand's position alone."""
        return dataclasses.replace(self, orientation="free")

    def features(self, robot: Any, frame: str) -> Any:
        """Return features whose rows this mechanism holds at zero, for a frame of a robot; the rows have unit length.

        Args:
            robot: The robot.
            frame: Name of the frame.

        Returns:
            Feature map Phi with 6 - k rows, where k is the number of free coordinates: `MechanismRows`, or `CurveRows`
            for a curve.

        Raises:
            ConstraintError: The axis or point of the mechanism is not known.
            UnknownNameError: The robot has no such frame.
        """
        maps = import_module("manip_learn.constraint.features.mechanism_rows")  # which imports this module
        g, reference = self.located(), self.relative_to
        if self.curve is not None:  # no row describes the rotation rate of a hand that turns with a curve
            rows = KINDS["curve", "free" if self.orientation == "carried" else self.orientation].rows
            return maps.CurveRows(robot, frame, self.curve, rows, reference)
        place = {"axis": g.axis, "point": g.point, "pitch": g.pitch}
        return maps.MechanismRows(robot, frame, self.rows, **place, relative_to=reference)

    def located(self) -> Place:
        """Return the axis (unit vector), point [m] and pitch [m/rad] of the mechanism.

        Defaults replace a parameter that the kind does not have: the z axis, the origin, and the pitch 0.

        Raises:
            ConstraintError: The kind has an axis or a point that is not known.
        """
        needed = {name.removesuffix("-across") for name in _KINDS[self.kind].unknowns.split()} - {"pitch"}
        if any(getattr(self, name) is None for name in needed) or (self.kind == CURVE and self.curve is None):
            problem = f"the place of the mechanism is not known ({self.sentence})"
            raise ConstraintError(f"{problem}: learn it from rows along the base's axes")
        axis = Z if self.axis is None else self.axis / np.linalg.norm(self.axis)
        return Place(axis, np.zeros(3) if self.point is None else self.point, self.pitch or 0.0)

    def at(self, pose: ArrayLike, within: float = 0.05) -> Chart:
        """Return coordinates of the hand along the mechanism, relative to a grasp pose.

        The coordinates are distances [m] and angles [rad] along the mechanism, then angles of rotations of the hand
        alone if it may turn. They are 0 at the grasp pose.

        Args:
            pose: Grasp pose (4, 4) of the hand, in the frame of axis and point [m].
            within: Largest allowed deviation of the hand [m]: from the curve, the plane, or the `radius` about the axis
                or the centre. Not checked for a line, for a plane without a point, or about an axis or a centre if the
                orientation is `"carried"` or the radius is not known: the hand may then hold the fixture anywhere.

        Returns:
            A `Chart`, which converts coordinates to poses of the hand and back.

        Raises:
            ConstraintError: The deviation is larger than `within`, the pose is not (4, 4) finite numbers, or the axis
                or point of the mechanism is not known.

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
            raise ConstraintError(f"expected a grasp pose (4, 4) of finite numbers, got {pose!r:.80}")
        g, p, spec, is_carried = self.located(), grasp[:3, 3], _KINDS[self.kind], self.orientation == "carried"
        lever, deviation = p - g.point, 0.0
        radial = lever - (lever @ g.axis) * g.axis
        if self.curve is not None:
            deviation = float(np.linalg.norm(p - self.curve.at(self.curve.nearest(p[None]))[0]))
        elif self.kind == "plane" and self.point is not None:
            deviation = float(np.linalg.norm(lever - radial))
        elif self.radius is not None and not is_carried:
            deviation = abs(float(np.linalg.norm(lever if self.kind == "ball" else radial)) - self.radius)
        if deviation > within:
            problem = f"the hand is {1e3 * deviation:.3g} mm off the mechanism ({self.sentence})"
            raise ConstraintError(f"{problem}, {1e3 * within:.3g} mm are allowed: start at a pose on the mechanism")
        axis = g.axis[None] if self.curve is None else self.curve.tangents_at(self.curve.nearest(p[None]))
        directions = {"": np.zeros((0, 3)), "axis": axis, "across": across(g.axis), "all": np.eye(3)}
        turn, travel = directions[spec.turns], directions[spec.travels]
        if self.kind == "ball" and not is_carried:  # a loose grip: two rotations across the lever of the hand
            length = float(np.linalg.norm(lever))
            turn = across(lever / length if length > 0.0 else Z)
        spin = {"free": np.eye(3), "about-axis": g.axis[None]}.get(self.orientation, np.zeros((0, 3)))
        still, rest = np.zeros((len(turn) + len(travel), 3)), np.zeros((len(spin), 3))
        turns = np.vstack([turn, np.zeros_like(travel)])
        pitch = g.pitch if self.kind in ("hinge", "screw") else 0.0
        moves = np.vstack([pitch * turn, travel]) + np.cross(g.point, turns)
        half_hand = 0.1  # [m] from an axis in the hand: half its length, also used for the rotations of a path
        sizes = (half_hand if self.in_fingers else self.radius or 1.0, 1.0) if self.kind == "cylinder" else (1.0,)
        screws = np.vstack([moves, rest]), np.vstack([turns, rest]), np.vstack([still, spin])
        options: dict[str, Any] = {"centre": g.point, "curve": self.curve, "rows": self._weights, "sizes": sizes}
        return Chart(grasp, *screws, is_carried=is_carried, **options)

    def places(self, begin: Float[np.ndarray, " 3"], s: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n 3"]:
        """Return positions of the hand along the mechanism, e.g. to draw them as a line.

        Args:
            begin: Position (3,) of the hand at coordinates 0, in the frame of axis and point [m].
            s: Coordinates (n, k) along the mechanism, as defined by `at` [m or rad].

        Returns:
            Positions (n, 3) [m].

        Raises:
            ConstraintError: The axis or point of the mechanism is not known.
        """
        pose = np.eye(4)
        pose[:3, 3] = begin
        chart = self.by_place().at(pose, np.inf)
        return np.array([chart.pose(each)[:3, 3] for each in s])

    def _weights(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n h 6"]:
        """Return the weights of the hand's twist in the rows that are zero."""
        curve, rows = self.curve, self.rows
        weights = mechanism_weights(rows, self.located(), None) if curve is None else CurveWeights(curve, rows)
        return weights.values(p)

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary of JSON values: the attributes, and the mechanism as a sentence."""
        values = plain(self) | {"uncertainty": dict(self.uncertainty), "sentence": self.sentence}
        return {n: x for n, x in values.items() if x is not None or n not in ("relative_to", "curve")}

    @staticmethod
    def from_dict(described: Mapping[str, Any]) -> Mechanism:
        """Build a mechanism from the output of `to_dict`.

        Args:
            described: The output of `to_dict`.

        Returns:
            The mechanism.
        """
        return from_plain(Mechanism, described)

    def __str__(self) -> str:
        return self.sentence


def format_vector(vector: np.ndarray | None, names: Sequence[str] = ()) -> str:
    """Return a vector as text with two decimals, or `"unknown"` for None.

    Args:
        vector: A direction, a position, or a combination of rows, shape (n,); None if unknown.
        names: Names of its entries: a vector with a single significant entry is printed as the name of that entry.
            Default: the vector is always printed as numbers.

    Returns:
        For example `"(0.91, 0.42, 0.00)"`, or `"z"`.
    """
    if vector is None:
        return "unknown"
    counts = np.abs(vector) >= NEGLIGIBLE_ENTRY
    if names and np.count_nonzero(counts) == 1:
        return names[int(np.argmax(counts))]
    return "(" + ", ".join(f"{x + 0.0:.2f}" for x in np.round(vector, 2)) + ")"


def describe_uncertainty(
    uncertainty_deg: float | None, mechanism: Mechanism | None = None, is_stated: bool = False
) -> str:
    """Return the uncertainties of a constraint and its mechanism as text, e.g. `"direction known to 0.001 degrees"`.

    Args:
        uncertainty_deg: Uncertainty of the rows [deg]; None if unknown.
        mechanism: Mechanism with the uncertainties of its parameters; None for rows alone.
        is_stated: True if the text before has named the direction of the rows as the mechanism's axis (a line or
            plane): the two uncertainties are then given as one.

    Returns:
        The text; empty if no uncertainty is known.
    """
    errors = {"direction": uncertainty_deg} | ({} if mechanism is None else dict(mechanism.uncertainty))
    if is_stated and mechanism is not None and mechanism.type in ("line", "plane"):  # the axis is the rows' direction
        axis = errors.pop("axis", None)
        errors["direction"] = axis if uncertainty_deg is None else uncertainty_deg
    units = {"direction": "degrees", "axis": "degrees", "point": "mm", "radius": "mm", "pitch": "mm/rad"}
    determined, undetermined = list[str](), list[str]()
    for name, error in errors.items():
        label, unit = "place" if name == "point" else name, units[name]
        if error is not None and unit == "degrees" and error > 45.0:  # an undetermined direction
            undetermined.append(f"{label} not determined")
        elif error is not None:
            size = error_in_words(error if unit == "degrees" else 1e3 * error, unit)
            determined.append(f"{label} {'to' if determined else 'known to'} {size}")
    return listed([*determined, *undetermined]) if determined or undetermined else ""


def mechanism_of(kind: MechanismKind, place: Place, radius: float | None, **known: Any) -> Mechanism:
    """Build a mechanism from its kind, axis and point.

    Args:
        kind: Kind of the mechanism.
        place: Its axis, point and pitch; parameters that the kind does not have are ignored.
        radius: Distance of the hand from the axis or the centre [m]; None if it does not apply.
        known: Other attributes of `Mechanism`, which override the values from `kind` and `place`.

    Returns:
        The mechanism.
    """
    attributes = {
        "axis": place.axis if "axis" in kind.unknowns else None,
        "point": None if kind.kind == "space" else place.point,
        "pitch": place.pitch if "pitch" in kind.unknowns else None,
        "grip": "loose" if kind.orientation == "free" else "firm",
    }
    return Mechanism(kind.type, radius=radius, orientation=kind.orientation, name=kind.name, **attributes | known)


def embed_rows(names: Sequence[str], rows: np.ndarray, *, distance: bool = False) -> Rows:
    """Expand coefficients of some components of a twist (v, w) to coefficients of all six components.

    Args:
        names: Names of the k columns of `rows`, among x y z rx ry rz.
        rows: Coefficients (r, k).
        distance: True to insert a column of zeros after z, for rows of [v; (p - m).v; w] as in the form
            `"point and rotation"` of `PlaceRows`.

    Returns:
        shape (r, 6), or (r, 7) with the inserted column. Missing components have the coefficient 0.
    """
    out = np.zeros((len(rows), len(AXES) + distance))
    out[:, [AXES.index(name) + (distance and AXES.index(name) > 2) for name in names]] = rows
    return out


def read_point_rows(
    selection: Rows, immovable: Rows, middle: Float[np.ndarray, " 3"], *, aligned: bool = True
) -> Match | None:
    """Identify the mechanism of a point of the hand, and the freedom of the hand's orientation.

    Rows are combinations of the velocities [v; (p - m).v; w] with the linear velocity v at the hand's origin p, the
    angular velocity w, and a fixed point m, see `PlaceRows`. Combinations that the arm cannot move also constrain the
    point, but they give no evidence for the orientation.

    Args:
        selection: Combinations (s, k) that the mechanism holds at zero, k = 4 without and 7 with the angular velocity.
        immovable: Combinations (m, k) that this arm cannot move.
        middle: Point m (3,), base frame [m].
        aligned: If the hand may turn about one axis only: True to require that it is the axis of the mechanism.

    Returns:
        Kind of mechanism, and its axis and point; None if no known mechanism has these rows.
    """
    position, turning = np.concatenate([selection, immovable])[:, :4], selection[:, 4:]
    sizes = [np.linalg.svd(block, compute_uv=False) if block.size else np.zeros(0) for block in (position, turning)]
    n_held, turns = (int(np.count_nonzero(each > 0.5)) for each in sizes)
    each = np.concatenate(sizes)  # 1 for rows within these columns, 0 for the others
    is_mixed = np.any((each > MIXED) & (each < np.sqrt(1.0 - MIXED**2)))
    if is_mixed or turns == 1 or (n_held > 2 and turns != 2):
        return None
    free = np.linalg.svd(turning)[2][2] if turns == 2 else Z
    if n_held > 2:  # the position is fixed and the hand turns about an axis through it: a knob
        return KINDS["hinge", "carried"], Place(free, middle)
    rows = np.linalg.svd(position)[2][:n_held]
    normals, distances = rows[:, :3], rows[:, 3]
    # an axis or a centre beyond 5 m counts as infinitely far here: the fit to positions determines its distance
    is_far = float(np.linalg.norm(distances)) < 1.0 / 5.0
    axis = free if n_held == 0 else normals[0]
    if n_held == 2:
        axis = np.cross(*normals) if is_far else distances[1] * normals[0] - distances[0] * normals[1]
    point = middle if is_far else middle - distances @ normals / float(distances @ distances)
    place = Place(axis / np.linalg.norm(axis), point)
    name = ("space", "plane" if is_far else "ball", "line" if is_far else "hinge")[n_held]
    kind = KINDS[name, {0: "free", 2: "about-axis", 3: "fixed"}[turns]]
    is_tilted = aligned and turns == 2 and abs(float(free @ place.axis)) < 1.0 - MIXED
    return None if kind not in MECHANISM_KINDS or is_tilted else (kind, place)


def read_twists(free: Float[np.ndarray, "k 6"], middle: Float[np.ndarray, " 3"]) -> Match | None:
    """Identify the mechanism that leaves a space of twists (v, w) of the hand free.

    Args:
        free: Basis (k, 6) of the free twists, along the base's axes; v is the velocity of the hand's point at `middle`.
        middle: Fixed point (3,), base frame [m].

    Returns:
        Kind of mechanism, and its axis and point; None if no known mechanism leaves these twists free.
    """
    U, turning, axes = np.linalg.svd(free[:, 3:])
    turns, axis = int(np.count_nonzero(turning > MIXED)), axes[0]
    spun, slides = U.T[:turns] @ free, (U.T[turns:] @ free)[:, :3]
    match turns, len(free):
        case 0, 1:
            return KINDS["line", "fixed"], Place(free[0, :3] / np.linalg.norm(free[0, :3]), middle)
        case 0, 2:
            return KINDS["plane", "fixed"], Place(np.cross(*slides) / np.linalg.norm(np.cross(*slides)), middle)
        case 0, 3:
            return KINDS["space", "fixed"], Place(Z, middle)
        case 1, (1 | 2):
            across = spun[0, :3] / (spun[0, 3:] @ axis)
            foot = middle + np.cross(axis, across)
            if len(slides) == 0:
                return KINDS["screw", "carried"], Place(axis, foot, float(across @ axis))
            if np.linalg.norm(np.cross(slides[0], axis)) < MIXED * np.linalg.norm(slides[0]):
                return KINDS["cylinder", "carried"], Place(axis, foot)
        case 1, 3 if np.max(np.abs(slides @ axis)) < MIXED:
            return KINDS["plane", "about-axis"], Place(axis, middle)
        case 1, 4:
            return KINDS["space", "about-axis"], Place(axis, middle)
        case 3, 3:  # v_i = w_i x (m - c) for all three
            levers = np.concatenate([skew(x) for x in spun[:, 3:]])
            offset = np.linalg.lstsq(levers, spun[:, :3].reshape(-1), rcond=None)[0]
            return KINDS["ball", "carried"], Place(Z, middle - offset)
    return None


def read_surface_rows(selection: Rows, middle: Float[np.ndarray, " 3"], p: Float[np.ndarray, "N 3"]) -> Match | None:
    r"""Identify a cylinder or a helix from rows of the form `"surface"` of `PlaceRows`.

    Each row is :math:`n^T v + \sum_{ij} B_{ij} (p - m)_i v_j`, with the linear velocity v at the hand's origin p and a
    fixed point m. For an axis :math:`a`, a cylinder has :math:`B = I - a a^T`, and the second row of a helix
    :math:`B = [a]_\times`, up to a factor.

    Args:
        selection: Rows (s, 12): n, then the nine entries of B.
        middle: Point m (3,), base frame [m].
        p: Positions (N, 3) of the hand, base frame [m].

    Returns:
        Kind of mechanism, and its axis, point and pitch; None if the rows are neither.
    """
    n, B = selection[:, :3], selection[:, 3:].reshape(-1, 3, 3)
    antisymmetric = 0.5 * (B - B.transpose(0, 2, 1)).reshape(len(B), -1)
    U, sizes, _ = np.linalg.svd(antisymmetric)
    side = U[:, -1]
    C, foot = np.tensordot(side, B, axes=1), side @ n
    values, vectors = np.linalg.eigh(0.5 * (C + C.T))
    order = np.argsort(np.abs(values))
    along, one, other = values[order]
    if abs(along) >= MIXED * abs(one) or abs(one - other) > MIXED * abs(other):
        return None
    axis, size = vectors[:, order[0]], 0.5 * float(one + other)
    point = middle - (foot - (foot @ axis) * axis) / size
    if len(selection) == 1:
        return KINDS["cylinder", "free"], Place(axis, point)
    if len(selection) != 2 or sizes[0] < MIXED:
        return None
    # the other row is the helical one, rho^2 a - h a x (p - c)
    T = np.tensordot(U[:, 0], B, axes=1)
    turn = 0.5 * np.array([T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]])
    square = float(np.mean(np.sum(np.cross(p - point, axis) ** 2, axis=1)))
    return KINDS["screw", "free"], Place(axis, point, square * float(turn @ axis) / float(U[:, 0] @ n @ axis))


def hinge_or_screw(read: Match, hand: Float[np.ndarray, " 3"], learnt: Mapping[str, Any]) -> Match:
    """Replace a screw with a firm grip by a hinge if its pitch is not significantly different from zero.

    The pitch must exceed three standard deviations, which follow from the uncertainty of the rows of Lambda.

    Args:
        read: Kind of mechanism, and its axis, point and pitch.
        hand: Position (3,) of the hand [m].
        learnt: Provenance of the constraint, with the uncertainty of its rows [deg]; empty if it was not learnt.

    Returns:
        `read`, or a hinge with the same axis and point.
    """
    kind, place = read
    angle, radius = learnt.get("uncertainty_deg"), float(np.linalg.norm(place.point - hand))
    spread = math.radians(angle) if isinstance(angle, int | float) else 0.0
    travels = abs(place.pitch) >= max(LEAST_PITCH, 3.0 * spread * math.hypot(1.0, radius))
    return read if travels or kind != KINDS["screw", "carried"] else (KINDS["hinge", "carried"], place)


def fitted_mechanism(read: Mechanism, learnt: Mapping[str, Any]) -> Mechanism:
    """Return the mechanism that the learner fitted to positions, if it agrees with the one identified from Lambda.

    Args:
        read: The mechanism identified from Lambda.
        learnt: Provenance of the constraint, with the fitted mechanism; empty if it was not learnt.

    Returns:
        The fitted mechanism, with its uncertainty; `read` if there is none or the two differ in type, orientation or,
        by more than about one degree, in the axis.
    """
    try:
        fitted = Mechanism.from_dict(learnt["mechanism"])
    except (KeyError, TypeError, ValueError):
        return read  # missing, damaged or from another version: use the one read from Lambda
    same = fitted.type == read.type and (fitted.orientation == read.orientation or "whole" in learnt)
    if same and fitted.axis is not None and read.axis is not None:  # equal within one degree
        same = fitted.axis.shape == (3,) and abs(float(fitted.axis @ read.axis)) > 0.9998 * np.linalg.norm(fitted.axis)
    return fitted if same else read
