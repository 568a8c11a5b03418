"""Whether a mechanism is straight or bent: a line or a hinge, a plane or a ball, a hinge or a screw."""

from __future__ import annotations

import numpy as np

from manip_learn.constraint.mechanism_kinds import MECHANISM_KINDS, MechanismKind
from manip_learn.learning.deciding import BEYOND_CHANCE, FARTHEST_M, LEAST_BEND_M, STANDARD_ERRORS
from manip_learn.learning.mechanisms.fits import Fit, fit_candidate
from manip_learn.learning.mechanisms.refined import radius_of
from manip_learn.learning.mechanisms.residuals import QUANTITIES, Place
from manip_learn.learning.mechanisms.tip_paths import TipPaths

# what each mechanism becomes when it bends
BENT_FORMS = {
    "line": "hinge",
    "line, not turning": "hinge, not turning",
    "plane": "ball",
    "hinge": "screw",
    "hinge, firm": "screw, firm",
}


def straight_or_bent(paths: TipPaths, read: Fit) -> tuple[Fit, str]:
    """The form of a mechanism that the positions show, and its rival in words; empty if they exclude it.

    Velocities show neither the curvature of a short arc nor that a long one is none as well as positions do. The bent
    form is the answer if its radius or pitch is known to a fifth and the path leaves the straight form measurably.

    Args:
        paths: Of the hand.
        read: The mechanism that the rows show, fitted.
    """
    names = {bent: straight for straight, bent in BENT_FORMS.items()}
    name = read.candidate.name
    if name in names and not _bends(paths, straight := _fit(paths, names[name], read.place), read):
        return straight, _rival(paths, read, straight)
    if name in BENT_FORMS:
        bent = _fit(paths, BENT_FORMS[name], read.place)
        if _bends(paths, read, bent):
            return bent, ""
        return read, _rival(paths, bent, read)
    return read, ""


def _fit(paths: TipPaths, name: str, place: Place) -> Fit:
    kind = next(k for k in MECHANISM_KINDS if k.name == name)
    return fit_candidate(paths, kind, _starts(paths, kind, place))


def _starts(paths: TipPaths, kind: MechanismKind, place: Place) -> list[Place]:
    """Where the other form may be: the same axis, or the direction, the normal and the circle of the path."""
    x = paths.centred(paths.p)
    spread = np.linalg.eigh(x.T @ x)[1].T
    middle = paths.p.mean(axis=0)
    if kind.type == "line":
        return [Place(spread[2], middle)]
    if kind.type == "plane":
        return [Place(spread[0], middle)]
    if kind.type == "ball":
        square = paths.centred(np.einsum("ni,ni->n", paths.p - middle, paths.p - middle)[:, None])[:, 0]
        return [Place(place.axis, middle + 0.5 * np.linalg.lstsq(x, square, rcond=1e-9)[0])]
    if kind.type == "hinge" and place.pitch == 0.0 and kind.orientation != "carried":
        # |y|^2 - 2 c.y is constant along a circle (I. Kasa, 1976), seen along the normal of the path
        y = x @ spread[1:].T
        flat = (paths.p - middle) @ spread[1:].T
        square = paths.centred(np.einsum("ni,ni->n", flat, flat)[:, None])[:, 0]
        centre = 0.5 * np.linalg.lstsq(y, square, rcond=1e-9)[0]
        return [Place(spread[0], middle + centre @ spread[1:])]
    return [Place(place.axis, place.point)]


def _bends(paths: TipPaths, straight: Fit, bent: Fit) -> bool:
    """Whether the data show what the straight form lacks: measurable, and more than rails wobble."""
    size = _size(paths, bent)
    if size is None or ("pitch" not in bent.candidate.unknowns and size[0] > FARTHEST_M):
        return False
    rest = [
        sum(float(np.sum(f.held_out[n] ** 2)) for n in f.candidate.holds if QUANTITIES[n].unit == "m")
        for f in (straight, bent)
    ]
    return size[0] > BEYOND_CHANCE * size[1] and rest[0] - rest[1] > LEAST_BEND_M**2


def _size(paths: TipPaths, bent: Fit) -> tuple[float, float] | None:
    """Pitch [m/rad] or radius [m] with its standard deviation."""
    if "pitch" in bent.candidate.unknowns:
        index = int(np.argmax(bent.tangents[6]))
        return abs(bent.place.pitch), float(np.sqrt(bent.covariance[index, index]))
    return radius_of(paths, bent)


def _rival(paths: TipPaths, bent: Fit, straight: Fit) -> str:
    """A bent form near enough to matter, if the motion cannot exclude it."""
    size = _size(paths, bent)
    if size is None or "pitch" in bent.candidate.unknowns:
        return ""
    radius, sigma = size
    curvature = 1.0 / radius + STANDARD_ERRORS * sigma / radius**2
    if not np.isfinite(curvature) or curvature < 1.0 / FARTHEST_M:
        return ""
    return (
        f"a {bent.candidate.name} would fit as well, with more than {1.0 / curvature:.2g} m of radius: the motion is "
        f"too short to tell it from a {straight.candidate.name}; move it farther"
    )
