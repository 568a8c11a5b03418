"""Whether a mechanism is straight or bent: a line or a hinge, a plane or a ball, a hinge or a screw."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.mechanism_kinds import MECHANISM_KINDS, MechanismKind
from manip_learn.learning.deciding import BEYOND_CHANCE, FARTHEST_M, LEAST_BEND_M, STANDARD_ERRORS
from manip_learn.learning.mechanisms.place_fit import PlaceFit, fit_place
from manip_learn.learning.mechanisms.quantities import QUANTITIES, Place
from manip_learn.learning.mechanisms.tip_paths import TipPaths

# what each mechanism becomes when it bends
BENT_FORMS = {
    "line": "hinge",
    "line, not turning": "hinge, not turning",
    "plane": "ball",
    "hinge": "screw",
    "hinge, firm": "screw, firm",
}


def straight_or_bent(read: PlaceFit) -> tuple[PlaceFit, str]:
    """The form of a mechanism that the positions show, and its rival in words; empty if they exclude it.

    Velocities show neither the curvature of a short arc nor that a long one is none as well as positions do. The bent
    form is the answer if its radius or pitch is known to a fifth and the path leaves the straight form measurably.

    Args:
        read: The mechanism that the rows show, fitted.
    """
    straight_forms = {bent: straight for straight, bent in BENT_FORMS.items()}
    name = read.kind.name
    if name in straight_forms and not _bends(read, straight := _fit(read, straight_forms[name])):
        return straight, _rival(read, straight)
    if name in BENT_FORMS:
        bent = _fit(read, BENT_FORMS[name])
        return (bent, "") if _bends(bent, read, _fit(read, name)) else (read, _rival(bent, read))
    return read, ""


def _fit(read: PlaceFit, name: str) -> PlaceFit:
    kind = next(k for k in MECHANISM_KINDS if k.name == name)
    return fit_place(read.paths, kind, _start(read.paths, kind, read.place))


def _start(paths: TipPaths, kind: MechanismKind, place: Place) -> Place:
    """Where the other form may be: the same axis, or the direction, the normal and the circle of the path."""
    x = paths.centred(paths.p)
    spread, middle = np.linalg.eigh(x.T @ x)[1].T, paths.p.mean(axis=0)
    if kind.type == "line":
        return Place(spread[2], middle)
    if kind.type == "plane":
        return Place(spread[0], middle)
    if kind.type == "ball":
        return Place(place.axis, _centre(paths, np.eye(3)))
    if kind.type == "hinge" and place.pitch == 0.0 and kind.orientation != "carried":
        return Place(spread[0], _centre(paths, spread[1:]))  # a circle seen along the normal of the path
    return Place(place.axis, place.point)


def _centre(paths: TipPaths, base: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " 3"]:
    """|y|^2 - 2 c.y is constant along a circle or on a sphere about c (I. Kasa, 1976), y in an orthonormal base."""
    middle = paths.p.mean(axis=0)
    y = (paths.p - middle) @ base.T
    square = paths.centred(np.sum(y * y, axis=1, keepdims=True))[:, 0]
    return middle + 0.5 * np.linalg.lstsq(paths.centred(y), square, rcond=1e-9)[0] @ base


def _bends(bent: PlaceFit, *straight: PlaceFit) -> bool:
    """Whether the data show what the straight form lacks, wherever that is: measurable, and more than rails wobble."""
    if bent.size is None or ("pitch" not in bent.kind.unknowns and bent.size[0] > FARTHEST_M):
        return False
    size, sigma = bent.size
    return size > BEYOND_CHANCE * sigma and min(map(_rest, straight)) - _rest(bent) > LEAST_BEND_M**2


def _rest(fit: PlaceFit) -> float:
    """Mean square of what the form leaves of the positions [m^2]."""
    return sum(float(np.sum(fit.held_out[n] ** 2)) for n in fit.kind.holds if QUANTITIES[n].unit == "m")


def _rival(bent: PlaceFit, straight: PlaceFit) -> str:
    """A bent form near enough to matter, if the motion cannot exclude it."""
    if bent.size is None or "pitch" in bent.kind.unknowns:
        return ""
    radius, sigma = bent.size
    curvature = 1.0 / radius + STANDARD_ERRORS * sigma / radius**2
    if not np.isfinite(curvature) or curvature < 1.0 / FARTHEST_M:
        return ""
    return (
        f"a {bent.kind.name} would fit as well, with more than {1.0 / curvature:.2g} m of radius: the motion is "
        f"too short to tell it from a {straight.kind.name}; move it farther"
    )
