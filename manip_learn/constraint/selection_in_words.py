"""What was learnt in words: what can move, what is blocked, what it looks like, how sure that is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.constraint.features.curve_rows import CurveRows
from manip_learn.constraint.features.feature_map import NEGLIGIBLE_ENTRY, FeatureMap, row_in_words
from manip_learn.constraint.features.frame_jacobian import AXES as TWIST
from manip_learn.constraint.features.frame_jacobian import PoseRows
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.features.other_features import CentreOfMass
from manip_learn.constraint.mechanism import CURVE, Mechanism, in_words
from manip_learn.errors import error_in_words, listed
from manip_learn.linalg import along_axes, null_basis

_AXES, ROTATIONS = TWIST[:3], TWIST[3:]  # linear and angular rows
# verb -> preposition, rows, all of them in words, and all but one direction
VERBS = {
    "move": ("along", _AXES, "in every direction", "across it"),
    "turn": ("about", ROTATIONS, "about every axis", "about every other axis"),
}
_LOOKS = {
    "line": "a straight line (a drawer)",
    "plane": "a plane (a table)",
    "hinge": "a hinge (a door)",
    "ball": "a ball joint (a tether)",
    "screw": "a screw (a valve)",
    "held-orientation": "a held orientation (a full cup)",
    "other": "a cylinder (a sleeve on a rod)",
    CURVE: "a rail that is bent",
}
FREE_MOVES = {"line": 1, "plane": 2}  # directions that a mechanism leaves free, where they are the same everywhere
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
    if (other := getattr(features, "relative_to", None)) is not None:
        subject = f"Seen from {other.name!r}, the tip"
    elif getattr(features, "own_axes", False):
        subject = "In its own axes, the tip"
    elif features.twist is not None:
        subject = "The tip"
    else:
        subject = "The centre of mass" if isinstance(features, CentreOfMass) else "The motion"
    sentences = [f"{subject} {_freedom(free[:, used], names, features, held, mechanism)}."]
    told = said_by_rows(mechanism, features.row_names, getattr(features, "reference", None), free)
    if mechanism is not None:
        words = looks(mechanism)
        if not told and mechanism.place:
            words += f", {mechanism.place}"
        if mechanism.grip == "kept" or (mechanism.orientation != "free" and not set(ROTATIONS) & set(names)):
            words += f"; {mechanism.turns}"
        other = not told and mechanism.type in FREE_MOVES and getattr(features, "reference", None) == "world"
        sentences.append(
            f"{'The path alone looks' if other and set(_AXES) <= set(names) else 'It looks'} like {words}."
        )
    known = known_to(uncertainty_deg, mechanism, told)
    if known:
        sentences.append(f"{known[0].upper()}{known[1:]}.")
    return " ".join(sentences)


def looks(mechanism: Mechanism) -> str:
    """A mechanism by what people know: `"a straight line (a drawer)"`."""
    return _LOOKS[CURVE if mechanism.name == CURVE else mechanism.type]


def said_by_rows(
    mechanism: Mechanism | None, names: Sequence[str], reference: str | None, free: Float[np.ndarray, "k p"]
) -> bool:
    """Whether what the rows leave free says already where the mechanism is.

    Args:
        mechanism: What holds the hand.
        names: Names of the feature rows.
        reference: Their frame, `"world"` or `"local"`; None for rows of the mechanism itself.
        free: What they leave free.
    """
    if mechanism is None or reference is None:
        return mechanism is not None
    moves = sum(bool(np.any(_entries(row, names, _AXES))) for row in free)
    return reference == "world" and set(_AXES) <= set(names) and moves == FREE_MOVES.get(mechanism.type)


def known_to(uncertainty_deg: float | None, mechanism: Mechanism | None = None, told: bool = False) -> str:
    """How sure each thing is, once: `"direction known to 0.001 degrees"`; empty if nothing is known of it.

    Args:
        uncertainty_deg: Of the rows [deg].
        mechanism: What holds the hand.
        told: Whether the rows say where it is: then its axis is their direction.
    """
    errors = {} if mechanism is None else dict(mechanism.uncertainty)
    straight = told and mechanism is not None and mechanism.type in FREE_MOVES
    axis = errors.pop("axis", None) if straight else None
    angle = axis if uncertainty_deg is None else uncertainty_deg
    known = [] if angle is None else [("direction", angle, "degrees")]
    known += [(PARAMETERS[name][0], PARAMETERS[name][1] * value, PARAMETERS[name][2]) for name, value in errors.items()]
    lost = [f"{what} not determined" for what, value, unit in known if unit == "degrees" and value > NOT_AN_ANGLE]
    sure = [(w, error_in_words(value, unit)) for w, value, unit in known if unit != "degrees" or value <= NOT_AN_ANGLE]
    said = [f"{what} {'to' if k else 'known to'} {amount}" for k, (what, amount) in enumerate(sure)]
    return listed([*said, *lost]) if known else ""


def _freedom(
    free: Float[np.ndarray, "k r"], names: list[str], features: FeatureMap, held: str, mechanism: Mechanism | None
) -> str:
    """What can move, and what is `held`, without the subject."""
    if isinstance(features, MechanismRows) and mechanism is not None:
        radius = "" if mechanism.radius is None else f" of radius {mechanism.radius:.3f} m"
        way = WAYS[mechanism.type].format(axis=in_words(mechanism.axis), point=in_words(mechanism.point), radius=radius)
        return f"can {way}"
    if isinstance(features, CurveRows):
        ends = " to ".join(in_words(end) for end in features.curve.points[[0, -1]])
        return f"can move along a curve of {features.curve.length:.2f} m from {ends} and cannot leave it"
    if not isinstance(features, PoseRows | CentreOfMass):
        ways = listed([row_in_words(row, names) for row in free]) if len(free) else ""
        return f"is free along {ways} in ({', '.join(names)}) and {held} in every other way" if ways else f"is {held}"
    small = np.where(np.abs(free) < NEGLIGIBLE_ENTRY, 0.0, free)
    parts = {verb: [_entries(row, names, rows) for row in small] for verb, (_, rows, *_) in VERBS.items()}
    if any(np.any(move) and np.any(turn) for move, turn in zip(*parts.values(), strict=True)):
        ways = []  # each direction, with the proportion if it has both kinds
        for move, turn in zip(*parts.values(), strict=True):
            if np.any(move) and np.any(turn):
                ways.append(f"move along {in_words(move)} while turning about {in_words(turn)}")
            else:
                verb, row = ("move along", move) if np.any(move) else ("turn about", turn)
                ways.append(f"{verb} {row_in_words(row, _AXES)}")
        return f"can {listed(ways)}, and is {held} in every other way"
    known = {verb: np.array([n in names for n in rows]) for verb, (_, rows, *_) in VERBS.items()}
    clauses = [_clause(verb, [x for x in parts[verb] if np.any(x)], known[verb], held) for verb in VERBS]
    return "; it ".join(clause for clause in clauses if clause)


def _entries(row: np.ndarray, names: Sequence[str], rows: Sequence[str]) -> Float[np.ndarray, " 3"]:
    """The entries of these rows, 0 for those that the features lack."""
    return np.array([row[names.index(n)] if n in names else 0.0 for n in rows])


def _clause(verb: str, free: list[np.ndarray], known: Bool[np.ndarray, " 3"], held: str) -> str:
    """What can move or turn, and what of the rows that are `known` is held; empty if none is."""
    preposition, _, everywhere, elsewhere = VERBS[verb]
    n = int(np.count_nonzero(known))
    if len(free) == n:
        return f"can {verb} freely" if n == 3 else f"can {verb} {preposition} {_directions(free)}" if n else ""
    if n == 3 and not free:
        return f"cannot {verb}" if held == "blocked" else f"is {held} {everywhere}"
    rest = along_axes(null_basis(np.array([*free, *np.eye(3)[~known]])).T)
    blocked = f"{preposition} {_directions(rest)}"
    if not free:
        return f"cannot {verb} {blocked}" if held == "blocked" else f"is {held} {blocked}"
    blocked = elsewhere if n == 3 and len(free) == 1 else blocked
    return f"can {verb} {preposition} {_directions(free)} and is {held} {blocked}"


def _directions(vectors: Iterable[np.ndarray]) -> str:
    """Each with all of its entries, or as the one axis: `"(0.91, 0.42, 0.00) and z"`."""
    return listed(row_in_words(v, _AXES) for v in vectors)
