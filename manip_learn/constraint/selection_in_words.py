"""What was learnt in words: what can move, what is blocked, what it looks like, how sure that is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.constraint.features.feature_map import NEGLIGIBLE_ENTRY, FeatureMap, row_in_words
from manip_learn.constraint.mechanism import CURVE, Mechanism, in_words
from manip_learn.constraint.place import AXES as TWIST
from manip_learn.constraint.reading import on_twist
from manip_learn.errors import error_in_words, listed
from manip_learn.linalg import along_axes, null_basis

_AXES, ROTATIONS = TWIST[:3], TWIST[3:]  # linear and angular rows
# of linear and of angular rows: verb -> preposition, all directions in words, and all but one
VERBS = {
    "move": ("along", "in every direction", "across it"),
    "turn": ("about", "about every axis", "about every other axis"),
}
# type of a mechanism -> what it looks like, and what it leaves free where its rows depend on the place
SHAPES = {
    "line": ("a straight line (a drawer)", "move along {axis} and cannot leave that line"),
    "plane": ("a plane (a table)", "move in the plane across {axis} and cannot leave it"),
    "hinge": ("a hinge (a door)", "move on a circle{radius} about {axle} and cannot leave it"),
    "ball": ("a ball joint (a tether)", "move on a sphere{radius} about {point} and cannot leave it"),
    "screw": ("a screw (a valve)", "move on a helix{radius} about {axle} and cannot leave it"),
    "held-orientation": ("a held orientation (a full cup)", "turn about {axis} and is blocked about every other axis"),
    "other": ("a cylinder (a sleeve on a rod)", "move on a cylinder{radius} about {axle} and cannot leave it"),
    CURVE: ("a rail that is bent", "move along a curve of {length:.2f} m from {ends} and cannot leave it"),
}
FREE_MOVES = {"line": 1, "plane": 2}  # directions that a mechanism leaves free, where they are the same everywhere
# error of the rows or of a parameter -> what it is called, and its unit
PARAMETERS = {
    "direction": ("direction", 1.0, "degrees"),
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
    inner = null_basis(selection[:, used]).T
    out = np.zeros((len(inner), selection.shape[1]))
    if len(inner):
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
    if features.twist is None:
        subject = "The motion" if features.own_axes is None else "The centre of mass"
    elif features.relative_to is not None:
        subject = f"Seen from {features.relative_to.name!r}, the tip"
    else:
        subject = "In its own axes, the tip" if features.own_axes else "The tip"
    sentences = [f"{subject} {_freedom(free[:, used], names, features, held, mechanism)}."]
    reference = getattr(features, "reference", None)
    told = said_by_rows(mechanism, features.row_names, reference, free)
    if mechanism is not None:
        place = f", {mechanism.place}" if mechanism.place and not told else ""
        turn = mechanism.grip == "kept" or (mechanism.orientation != "free" and not set(ROTATIONS) & set(names))
        other = not told and mechanism.type in FREE_MOVES and reference == "world"
        it = "The path alone looks" if other and set(_AXES) <= set(names) else "It looks"
        sentences.append(f"{it} like {looks(mechanism)}{place}{f'; {mechanism.turns}' if turn else ''}.")
    if known := known_to(uncertainty_deg, mechanism, told):
        sentences.append(f"{known[0].upper()}{known[1:]}.")
    return " ".join(sentences)


def looks(mechanism: Mechanism) -> str:
    """A mechanism by what people know: `"a straight line (a drawer)"`."""
    return SHAPES[mechanism.noun][0]


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
    moves = np.count_nonzero(np.any(on_twist(names, free)[:, :3], axis=1))
    return reference == "world" and set(_AXES) <= set(names) and moves == FREE_MOVES.get(mechanism.type)


def known_to(uncertainty_deg: float | None, mechanism: Mechanism | None = None, told: bool = False) -> str:
    """How sure each thing is, once: `"direction known to 0.001 degrees"`; empty if nothing is known of it.

    Args:
        uncertainty_deg: Of the rows [deg].
        mechanism: What holds the hand.
        told: Whether the rows say where it is: then its axis is their direction.
    """
    errors = {"direction": uncertainty_deg} | ({} if mechanism is None else dict(mechanism.uncertainty))
    if told and mechanism is not None and mechanism.type in FREE_MOVES:
        axis = errors.pop("axis", None)
        errors["direction"] = axis if uncertainty_deg is None else uncertainty_deg
    known, lost = list[str](), list[str]()
    for name, error in errors.items():
        what, scale, unit = PARAMETERS[name]
        if error is not None and unit == "degrees" and error > NOT_AN_ANGLE:
            lost.append(f"{what} not determined")
        elif error is not None:
            known.append(f"{what} {'to' if known else 'known to'} {error_in_words(scale * error, unit)}")
    return listed([*known, *lost]) if known or lost else ""


def _freedom(
    free: Float[np.ndarray, "k r"], names: list[str], features: FeatureMap, held: str, mechanism: Mechanism | None
) -> str:
    """What can move, and what is `held`, without the subject."""
    if features.geometry is not None and mechanism is not None:
        axis, point = in_words(mechanism.axis), in_words(mechanism.point)
        radius = "" if mechanism.radius is None else f" of radius {mechanism.radius:.3f} m"
        place = {"axis": axis, "point": point, "axle": f"the axis {axis} through {point}", "radius": radius}
        return f"can {SHAPES[mechanism.type][1].format(**place)}"
    if features.curve is not None:
        ends = " to ".join(in_words(end) for end in features.curve.points[[0, -1]])
        return f"can {SHAPES[CURVE][1].format(length=features.curve.length, ends=ends)}"
    if features.own_axes is None:
        ways = listed([row_in_words(row, names) for row in free]) if len(free) else ""
        return f"is free along {ways} in ({', '.join(names)}) and {held} in every other way" if ways else f"is {held}"
    moves, turns = np.split(on_twist(names, np.where(np.abs(free) < NEGLIGIBLE_ENTRY, 0.0, free)), 2, axis=1)
    if np.any(np.any(moves, axis=1) & np.any(turns, axis=1)):
        return f"can {listed(map(_way, moves, turns))}, and is {held} in every other way"
    known = np.split(np.isin(TWIST, names), 2)
    clauses = map(_clause, VERBS, (moves, turns), known, (held, held))
    return "; it ".join(clause for clause in clauses if clause)


def _way(move: Float[np.ndarray, " 3"], turn: Float[np.ndarray, " 3"]) -> str:
    """A free direction, with the proportion where it is both."""
    if np.any(move) and np.any(turn):
        return f"move along {in_words(move)} while turning about {in_words(turn)}"
    return f"move along {row_in_words(move, _AXES)}" if np.any(move) else f"turn about {row_in_words(turn, _AXES)}"


def _clause(verb: str, rows: Float[np.ndarray, "k 3"], known: Bool[np.ndarray, " 3"], held: str) -> str:
    """What can move or turn, and what of the rows that are `known` is held; empty if none is."""
    preposition, everywhere, elsewhere = VERBS[verb]
    free, n = [row for row in rows if np.any(row)], int(np.count_nonzero(known))
    if len(free) == n:
        return f"can {verb} freely" if n == 3 else f"can {verb} {preposition} {_directions(free)}" if n else ""
    where = {0: everywhere, 1: elsewhere}.get(len(free)) if n == 3 else None
    if where is None:
        rest = null_basis(np.array([*free, *np.eye(3)[~known]])).T
        where = f"{preposition} {_directions(along_axes(rest))}"
    if free:
        return f"can {verb} {preposition} {_directions(free)} and is {held} {where}"
    cannot = f"cannot {verb}" if n == 3 else f"cannot {verb} {where}"
    return cannot if held == "blocked" else f"is {held} {where}"


def _directions(vectors: Iterable[np.ndarray]) -> str:
    """Each with all of its entries, or as the one axis: `"(0.91, 0.42, 0.00) and z"`."""
    return listed(row_in_words(v, _AXES) for v in vectors)
