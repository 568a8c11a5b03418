"""The mechanisms that are tried: what each holds, what of it is unknown, and the rows that are then zero."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

MechanismType = Literal["line", "plane", "hinge", "ball", "screw", "held-orientation", "other"]
Orientation = Literal["free", "about-axis", "fixed", "carried"]


@final
@dataclass(frozen=True)
class MechanismKind:
    """A mechanism that may hold the hand.

    Attributes:
        name: Unique name.
        type: What it is called in a report.
        orientation: What the hand may do: turn as it likes (`"free"`), turn about the mechanism's axis only
            (`"about-axis"`), not turn at all (`"fixed"`), or it turns with the mechanism (`"carried"`).
        holds: Names of the quantities that are constant (see `QUANTITIES` of the learner).
        unknowns: Which of `"axis"`, `"point-across"` (two numbers), `"point"` (three) and `"pitch"` are fitted.
        rows: Rows of `MechanismRows` that are then zero.
    """

    name: str
    type: MechanismType
    orientation: Orientation
    holds: tuple[str, ...]
    unknowns: tuple[str, ...]
    rows: tuple[str, ...]

    @property
    def n_rows(self) -> int:
        """Number of rows held."""
        return len(self.rows)

    @property
    def n_unknowns(self) -> int:
        """Number of shared parameters."""
        return sum({"axis": 2, "point-across": 2, "point": 3, "pitch": 1}[name] for name in self.unknowns)

    @property
    def constant(self) -> bool:
        """Whether its rows are constant rows of the frame's Jacobian."""
        return self.type in ("line", "plane", "held-orientation")


_ABOUT = ("turn-1", "turn-2")
TURNING = ("turn-1", "turn-2", "turn")  # the rows that make up an angular velocity
_AXIS, _AXLE = ("axis",), ("axis", "point-across")
MECHANISM_KINDS: tuple[MechanismKind, ...] = (
    MechanismKind("plane", "plane", "free", ("height",), _AXIS, ("axial",)),
    MechanismKind("plane, turning", "plane", "about-axis", ("height", "axis-in-hand"), _AXIS, ("axial", *_ABOUT)),
    MechanismKind("plane, not turning", "plane", "fixed", ("height", "orientation"), _AXIS, ("axial", *TURNING)),
    MechanismKind("line", "line", "free", ("across-line",), _AXIS, ("slide-1", "slide-2")),
    MechanismKind(
        "line, not turning", "line", "fixed", ("across-line", "orientation"), _AXIS, ("slide-1", "slide-2", *TURNING)
    ),
    MechanismKind("hinge", "hinge", "free", ("radius", "height"), _AXLE, ("radial", "axial")),
    MechanismKind(
        "hinge, turning",
        "hinge",
        "about-axis",
        ("radius", "height", "axis-in-hand"),
        _AXLE,
        ("radial", "axial", *_ABOUT),
    ),
    MechanismKind(
        "hinge, not turning",
        "hinge",
        "fixed",
        ("radius", "height", "orientation"),
        _AXLE,
        ("radial", "axial", *TURNING),
    ),
    MechanismKind(
        "hinge, firm",
        "hinge",
        "carried",
        ("axis-in-hand", "point-in-hand"),
        _AXLE,
        (*_ABOUT, "slide-1", "slide-2", "slide"),
    ),
    MechanismKind("ball", "ball", "free", ("distance",), ("point",), ("spherical",)),
    MechanismKind("ball, firm", "ball", "carried", ("point-in-hand",), ("point",), ("slide-1", "slide-2", "slide")),
    MechanismKind("cylinder", "other", "free", ("radius",), _AXLE, ("radial",)),
    MechanismKind(
        "sleeve, firm",
        "other",
        "carried",
        ("axis-in-hand", "axis-line-in-hand"),
        _AXLE,
        (*_ABOUT, "slide-1", "slide-2"),
    ),
    MechanismKind("screw", "screw", "free", ("radius", "thread"), (*_AXLE, "pitch"), ("radial", "helical")),
    MechanismKind(
        "screw, firm",
        "screw",
        "carried",
        ("axis-in-hand", "screw-in-hand"),
        (*_AXLE, "pitch"),
        (*_ABOUT, "slide-1", "slide-2", "screw"),
    ),
    MechanismKind("direction", "held-orientation", "about-axis", ("axis-in-hand",), _AXIS, _ABOUT),
    MechanismKind("orientation", "held-orientation", "fixed", ("orientation",), (), TURNING),
)
