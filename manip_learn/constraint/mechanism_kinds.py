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
    def constant(self) -> bool:
        """Whether its rows are constant rows of the frame's Jacobian."""
        return self.type in ("line", "plane", "held-orientation")


TURNING = ("turn-1", "turn-2", "turn")  # the rows that make up an angular velocity
_ABOUT, _AXLE = "turn-1 turn-2", "axis point-across"
# name, type, orientation, what is constant, what is fitted, rows
_TABLE: tuple[tuple[str, MechanismType, Orientation, str, str, str], ...] = (
    ("plane", "plane", "free", "height", "axis", "axial"),
    ("plane, turning", "plane", "about-axis", "height axis-in-hand", "axis", f"axial {_ABOUT}"),
    ("plane, not turning", "plane", "fixed", "height orientation", "axis", f"axial {_ABOUT} turn"),
    ("line", "line", "free", "across-line", "axis", "slide-1 slide-2"),
    ("line, not turning", "line", "fixed", "across-line orientation", "axis", f"slide-1 slide-2 {_ABOUT} turn"),
    ("hinge", "hinge", "free", "radius height", _AXLE, "radial axial"),
    ("hinge, turning", "hinge", "about-axis", "radius height axis-in-hand", _AXLE, f"radial axial {_ABOUT}"),
    ("hinge, not turning", "hinge", "fixed", "radius height orientation", _AXLE, f"radial axial {_ABOUT} turn"),
    ("hinge, firm", "hinge", "carried", "axis-in-hand point-in-hand", _AXLE, f"{_ABOUT} slide-1 slide-2 slide"),
    ("ball", "ball", "free", "distance", "point", "spherical"),
    ("ball, firm", "ball", "carried", "point-in-hand", "point", "slide-1 slide-2 slide"),
    ("cylinder", "other", "free", "radius", _AXLE, "radial"),
    ("sleeve, firm", "other", "carried", "axis-in-hand axis-line-in-hand", _AXLE, f"{_ABOUT} slide-1 slide-2"),
    ("screw", "screw", "free", "radius thread", f"{_AXLE} pitch", "radial helical"),
    (
        "screw, firm",
        "screw",
        "carried",
        "axis-in-hand screw-in-hand",
        f"{_AXLE} pitch",
        f"{_ABOUT} slide-1 slide-2 screw",
    ),
    ("direction", "held-orientation", "about-axis", "axis-in-hand", "axis", _ABOUT),
    ("orientation", "held-orientation", "fixed", "orientation", "", f"{_ABOUT} turn"),
)
MECHANISM_KINDS: tuple[MechanismKind, ...] = tuple(
    MechanismKind(*row[:3], *(tuple(words.split()) for words in row[3:])) for row in _TABLE
)
