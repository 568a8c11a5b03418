"""What was learnt in words: what can move, what is blocked, what it looks like, how sure that is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.constraint.features.centre_of_mass import CentreOfMass
from manip_learn.constraint.features.feature_map import NEGLIGIBLE, FeatureMap, row_in_words
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.features.relative_frame_jacobian import RelativeFrameJacobian
from manip_learn.errors import listed
from manip_learn.learning.mechanisms.mechanism import Mechanism, in_words
from manip_learn.linalg import along_axes, null_basis

AXES = ("x", "y", "z")
# verb -> preposition, rows; what else features may hold is "free along" its rows
VERBS = {"move": ("along", AXES), "turn": ("about", ("rx", "ry", "rz"))}
LOOKS = {
    "line": "a straight line (a drawer)",
    "plane": "a plane (a table)",
    "hinge": "a hinge (a door)",
    "ball": "a ball joint (a tether)",
    "screw": "a screw (a valve)",
    "held-orientation": "a held orientation (a full cup)",
    "other": "a cylinder (a sleeve on a rod)",
}
# what a mechanism leaves free whose rows depend on the place
WAYS = {
    "line": "move along {axis} and cannot leave that line",
    "plane": "move in the plane across {axis} and cannot leave it",
    "hinge": "move on a circle{radius} about the axis {axis} through {point} and cannot leave it",
    "ball": "move on a sphere{radius} about {point} and cannot leave it",
    "screw": "move on a helix{radius} about the axis {axis} through {point} and cannot leave it",
    "held-orientation": "turn about {axis} and is blocked about every other axis",
    "other": "move on a cylinder{radius} about the axis {axis} through {point} and cannot leave it",
}
# what the error of a parameter is called, and its unit
PARAMETERS = {
    "axis": ("axis", 1.0, "degrees"),
    "point": ("place", 1e3, "mm"),
    "radius": ("radius", 1e3, "mm"),
    "pitch": ("pitch", 1e3, "mm/rad"),
}
NOT_AN_ANGLE = 45.0  # [deg]: an error of a direction beyond it says that nothing determines the direction


def free_directions(selection: Float[np.ndarray, "s p"], used: Bool[np.ndarray, " p"]) -> Float[np.ndarray, "k p"]:
    """Orthonormal rows that the constraint leaves free, among the feature rows that can move at all.

    Each points so that its largest entry is positive; several are turned so that they share as few rows as possible.
    """
    out = np.zeros((0, selection.shape[1]))
    inner = null_basis(selection[:, used]).T
    if inner.shape[0]:
        out = np.zeros((inner.shape[0], selection.shape[1]))
        out[:, used] = along_axes(inner)
    return out


def describe(
    kind: str,
    free: Float[np.ndarray, "k p"],
    features: FeatureMap,
    used: Bool[np.ndarray, " p"],
    uncertainty_deg: float | None,
    mechanism: Mechanism | None = None,
) -> str:
    """What can move and what is blocked; what it looks like; how sure it is: up to three sentences."""
    names = [n for n, u in zip(features.row_names, used, strict=True) if u]
    held = "blocked" if kind == "motion-constrained" else "steered on purpose"
    sentences = [f"{_subject(features)} {_freedom(free[:, used], names, features, held, mechanism)}."]
    if mechanism is not None:
        sentences.append(
            f"It looks like {looks_like(mechanism, features.row_names, getattr(features, 'reference', None))}."
        )
    known = known_to(uncertainty_deg, mechanism)
    if known:
        sentences.append(f"{known[0].upper()}{known[1:]}.")
    return " ".join(sentences)


def looks_like(mechanism: Mechanism, names: Sequence[str], reference: str | None) -> str:
    """The mechanism in words, without what the rows of that name say already: `"a straight line (a drawer)"`.

    Args:
        mechanism: What holds the hand.
        names: Names of the feature rows.
        reference: Their frame, `"world"` or `"local"`; None for rows that have none.
    """
    words = LOOKS[mechanism.type]
    if not said_by_rows(mechanism, names, reference) and mechanism.place:
        words += f", {mechanism.place}"
    turned = mechanism.orientation != "free" and not {"rx", "ry", "rz"} & set(names)
    return f"{words}; {mechanism.turns}" if turned else words


def said_by_rows(mechanism: Mechanism, names: Sequence[str], reference: str | None) -> bool:
    """Whether what the rows leave free says already where the mechanism is; arguments as for `looks_like`."""
    straight = mechanism.type in ("line", "plane") and reference == "world" and "x" in names and "y" in names
    return reference is None or straight


def known_to(uncertainty_deg: float | None, mechanism: Mechanism | None = None) -> str:
    """How sure each thing is, once: `"direction known to 0.001 degrees"`; empty if nothing is known of it.

    Args:
        uncertainty_deg: Of the rows [deg].
        mechanism: What holds the hand; its axis is told where it is not the direction of the rows.
    """
    errors = {} if mechanism is None else dict(mechanism.uncertainty)
    straight = mechanism is not None and mechanism.type in ("line", "plane")
    axis = errors.pop("axis", None) if straight else None
    angle = axis if uncertainty_deg is None else uncertainty_deg
    known = [] if angle is None else [("direction", angle, "degrees")]
    known += [(PARAMETERS[name][0], PARAMETERS[name][1] * value, PARAMETERS[name][2]) for name, value in errors.items()]
    lost = [f"{what} not determined" for what, value, unit in known if unit == "degrees" and value > NOT_AN_ANGLE]
    sure = [(w, _amount(value, unit)) for w, value, unit in known if unit != "degrees" or value <= NOT_AN_ANGLE]
    said = [f"{what} {'to' if k else 'known to'} {amount}" for k, (what, amount) in enumerate(sure)]
    return listed([*said, *lost]) if known else ""


def _amount(value: float, unit: str) -> str:
    if value < 1e-4:  # nobody asks for more digits, and 3e-06 is no word
        return f"better than 0.0001 {unit}"
    return f"{value:.1g} {unit}" if value < 0.095 else f"{value:.2g} {unit}"


def _subject(features: FeatureMap) -> str:
    if isinstance(features, RelativeFrameJacobian):
        return f"Seen from {features.relative_to.name!r}, the tip"
    if isinstance(features, FrameJacobian):
        return "The tip" if features.reference == "world" else "In its own axes, the tip"
    if isinstance(features, MechanismRows):
        return "The tip"
    return "The centre of mass" if isinstance(features, CentreOfMass) else "The motion"


def _freedom(
    free: Float[np.ndarray, "k r"], names: list[str], features: FeatureMap, held: str, mechanism: Mechanism | None
) -> str:
    """What can move, and what is `held`, without the subject."""
    if isinstance(features, MechanismRows) and mechanism is not None:
        radius = "" if mechanism.radius is None else f" of radius {mechanism.radius:.3f} m"
        way = WAYS[mechanism.type].format(axis=in_words(mechanism.axis), point=in_words(mechanism.point), radius=radius)
        return f"can {way}"
    spatial = isinstance(features, FrameJacobian | RelativeFrameJacobian | CentreOfMass)
    parts = {verb: [n for n in names if spatial and n in rows] for verb, (_, rows) in VERBS.items()}
    shares = {verb: np.array([n in part for n in names], dtype=bool) for verb, part in parts.items()}
    if not spatial:
        return _of_rows(free, names, held)
    small = np.where(np.abs(free) < NEGLIGIBLE, 0.0, free)
    mixed = [row for row in small if all(np.any(row[share]) for share in shares.values())]
    if mixed:
        return f"can {listed(_way(row, names) for row in small)}, and is {held} in every other way"
    clauses = [
        _clause(verb, small[np.any(small[:, shares[verb]], axis=1)], names, part, held)
        for verb, part in parts.items()
        if part
    ]
    return "; it ".join(clauses)


def _of_rows(free: Float[np.ndarray, "k r"], names: list[str], held: str) -> str:
    """Of features that are not those of a frame."""
    if not len(free):
        return f"is {held} along {listed(names)}"
    return (
        f"is free along {listed(row_in_words(row, names) for row in free)} in ({', '.join(names)}) and {held} across it"
    )


def _way(row: np.ndarray, names: list[str]) -> str:
    """One direction, of both kinds if it has both: `"move along (...) while turning about (...)"`."""
    said = [f"{verb} {prep} {_direction(row, names, rows)}" for verb, (prep, rows) in VERBS.items()]
    kinds = [any(row[names.index(n)] for n in rows if n in names) for _, rows in VERBS.values()]
    return said[0] + said[1].replace("turn", " while turning", 1) if all(kinds) else said[kinds.index(True)]


def _clause(verb: str, free: Float[np.ndarray, "k r"], names: list[str], part: list[str], held: str) -> str:
    """What can move or turn, and what of it is held."""
    prep, rows = VERBS[verb]
    ways = listed(f"{_direction(row, names, rows)}" for row in free) if len(free) else ""
    if len(free) == len(part) == 3:
        return f"can {verb} freely"
    if len(free) == len(part):
        return f"can {verb} {prep} {ways}"
    if len(part) == 3 and not len(free):
        return f"cannot {verb}" if held == "blocked" else f"is {held} in every {verb}"
    inner = free[:, [names.index(n) for n in part]] if len(free) else np.zeros((0, len(part)))
    rest = along_axes(null_basis(inner).T) if len(free) else np.eye(len(part))
    blocked = f"{prep} {listed(_direction(row, part, rows) for row in rest)}"
    if not len(free):
        return f"cannot {verb} {blocked}" if held == "blocked" else f"is {held} {blocked}"
    if len(free) == 1:
        blocked = "across it" if verb == "move" else "about every other axis"
    return f"can {verb} {prep} {ways} and is {held} {blocked}"


def _direction(row: np.ndarray, names: Sequence[str], rows: Sequence[str]) -> str:
    """The entries of these rows, 0 for those that the features lack, or the one axis: `"(0.91, 0.42, 0.00)"`, `"z"`."""
    entries = np.array([row[names.index(n)] if n in names else 0.0 for n in rows])
    return row_in_words(entries, AXES)
