"""What is drawn of a constraint: its mechanism, and at the tip directions held and free, the ellipsoid, the target."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import MechanismRows
from manip_learn.constraint.features.frame_jacobian import AXES, PoseRows
from manip_learn.constraint.features.mechanism_rows import WeighedVelocity
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.constraint.place import across
from manip_learn.constraint.shown import Intention, Shown
from manip_learn.errors import RecordingError
from manip_learn.linalg import finite, null_basis, row_basis
from manip_learn.playback.page_writer import packed
from manip_learn.playback.recorded_motion import GuidedMotion
from manip_learn.recordings.trajectory import evenly
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot

COUPLED = 0.1  # part of a learnt unit row that turns, up to which it counts as one that only moves, and the other way
SIX = np.triu_indices(3)  # xx xy xz yy yz zz of a symmetric matrix


@final
@dataclass(frozen=True, eq=False)
class HeldDirections:
    """Projectors onto directions, in the axes of `axes` (the base, if that is None).

    Each field is shape (3, 3), or (T, 3, 3) along a motion if the directions depend on the place. Directions that the
    features do not look at are neither held nor free.

    Attributes:
        axes: Frame whose axes are meant; None for the base.
        held, free: Of the frame's origin.
        held_turns, free_turns: Of its orientation.
    """

    axes: Frame | None
    held: Float[np.ndarray, "..."]
    free: Float[np.ndarray, "..."]
    held_turns: Float[np.ndarray, "..."]
    free_turns: Float[np.ndarray, "..."]


def held_directions(constraint: Constraint, places: Float[np.ndarray, "T 3"]) -> HeldDirections | None:
    """Return the directions of a constraint; None for features that are not of one frame.

    A direction is held if moving along it alone breaks the constraint, whatever the turning: the row space has the row
    (a, 0). It is free if the constraint allows to move along it, perhaps with a turn, as at a door's handle.

    Args:
        constraint: A(q).
        places: Origin of the frame along the motion, where the features see it: in the base, or in the other frame [m].
    """
    features, selection = constraint.features, constraint.selection
    if isinstance(features, PoseRows):  # the same everywhere
        W = np.eye(6)[[AXES.index(name) for name in features.row_names]]
        axes = features.frame if features.own_axes else features.relative_to
        return HeldDirections(axes, *_parts(selection @ W, W.sum(axis=0), COUPLED))
    if not isinstance(features, WeighedVelocity):
        return None
    W = features.place_weights.values(places)
    seen = np.repeat([1.0, float(np.any(W[..., 3:]))], 3)
    # a mixture was learnt, where a mechanism's rows are what they are
    tolerance = 1e-6 if isinstance(features, MechanismRows) else COUPLED
    parts = [_parts(selection @ w, seen, tolerance) for w in W]
    return HeldDirections(features.relative_to, *map(np.array, zip(*parts, strict=True)))


def _parts(
    rows: Float[np.ndarray, "s 6"], seen: Float[np.ndarray, " 6"], tolerance: float
) -> list[Float[np.ndarray, "3 3"]]:
    """Return projectors onto held and free directions, moving, then turning.

    Args:
        rows: Constrained velocities, 3 linear and 3 angular ones.
        seen: 1 for each velocity that the features look at, else 0.
        tolerance: Part of a row that turns, up to which it counts as one that only moves, and the other way.
    """
    basis, parts = row_basis(rows), []
    allowed, moving, turning = null_basis(basis), slice(0, 3), slice(3, 6)
    for part, other in ((moving, turning), (turning, moving)):
        # held are the directions of those rows that only move, or only turn
        U, sigma, _ = np.linalg.svd(basis[:, other])
        uncoupled = U[:, np.count_nonzero(sigma >= tolerance) :]
        held, free = _projector((uncoupled.T @ basis[:, part]).T), _projector(allowed[part])
        parts += [held, _projector(free @ (np.diag(seen[part]) - held))]
    return parts


def _projector(columns: Float[np.ndarray, "3 k"]) -> Float[np.ndarray, "3 3"]:
    U, sigma, _ = np.linalg.svd(columns, full_matrices=False)
    U = U[:, sigma > max(COUPLED * np.max(sigma, initial=0.0), 1e-9)]
    return U @ U.T


def constraint_marks(robot: Robot, motion: GuidedMotion, constraint: Constraint, most: int) -> dict[str, Any] | None:
    """Return the marks of a constraint along a motion; None for a constraint that is not of a single frame.

    Args:
        robot: Whose tip it is.
        motion: The motion.
        constraint: One that guides it.
        most: Largest number of times at which the ellipsoid is known.
    """
    n, learnt = constraint.provenance.get("n_constraints"), constraint
    if isinstance(n, int) and 0 < n < constraint.n_constraints:  # a task's rows follow those that were learnt
        learnt = Constraint(constraint.selection[:n], constraint.features, constraint.provenance)
    kept, features = evenly(len(motion.samples), most), constraint.features
    if not isinstance(features, PoseRows | WeighedVelocity):
        return None
    twist, q = features.twist, motion.samples.q[kept]
    places = twist.poses(q)[:, :3, 3]
    directions, ruled = (cast(HeldDirections, held_directions(c, places)) for c in (learnt, constraint))
    # H J_v J_v^T H in the axes of the directions: semi-axes are the tip's speeds along what is held, at |u| = 1, and of
    # rows that only move the singular values of A, since this is Lambda^T A A^T Lambda
    J = robot.frame_kinematics(twist.frame).jacobians(q, "world")[:, :3]
    if ruled.axes is not None:
        J = robot.frame_kinematics(ruled.axes).poses(q)[:, :3, :3].transpose(0, 2, 1) @ J
    driven = ruled.held @ J
    ellipsoid = driven @ driven.transpose(0, 2, 1)
    names = {"held": "held", "free": "free", "heldTurns": "held_turns", "freeTurns": "free_turns"}
    return {
        "tip": _place(robot, twist.frame),
        "axes": _place(robot, directions.axes),
        "times": packed(motion.samples.time[kept], "<f8"),
        **{key: packed(getattr(directions, name)[..., *SIX], "<f4") for key, name in names.items()},
        "ellipsoid": packed(ellipsoid[:, *SIX], "<f4"),
        "longest": float(np.sqrt(np.maximum(np.linalg.eigvalsh(ellipsoid), 0.0).max(initial=0.0))),  # semi-axis [m/s]
        "driven": constraint.n_constraints > learnt.n_constraints,  # along what is free, too
        "target": _target_place(robot, features, constraint.selection, motion),
    }


def ellipsoid_scale(longest: float, size: float) -> float:
    """Return the length drawn for 1 m/s: 1, 2 or 5 times a power of ten, the largest ellipsoid fits into the scene.

    Args:
        longest: Semi-axis of all ellipsoids [m/s].
        size: Room for it [m].
    """
    if longest <= 0.0:
        return 1.0
    wanted = size / longest
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(m for m in (1.0, 2.0, 5.0) if m * power <= wanted * (1.0 + 1e-9)))


def _target_place(
    robot: Robot, features: PoseRows | WeighedVelocity, selection: Float[np.ndarray, "s p"], motion: GuidedMotion
) -> dict[str, Any] | None:
    """Return the place of the target in the frame of a joint; coordinates that it lacks are those of the start."""
    target, q = motion.target, motion.samples.q[0]
    if target is None:
        return None
    point = features.twist.pose(q)[:3, 3]
    if target.shape == (4, 4):
        point = target[:3, 3]
    elif isinstance(features, WeighedVelocity):
        return None  # distances from an axis are no place
    else:
        r = features.coordinates(q)
        if target.shape == (len(selection),) != r.shape:  # along the rows: the nearest place from the start
            target = r + selection.T @ (target - selection @ r)
        known = {AXES.index(name): k for k, name in enumerate(features.row_names) if name in AXES[:3]}
        if target.shape != r.shape or not known:
            return None
        point[list(known)] = target[list(known.values())]
    return {"carrier": _place(robot, features.relative_to), "point": point.tolist()}


def _place(robot: Robot, frame: Frame | None) -> dict[str, Any] | None:
    """Return the joint that carries a frame, and the frame's pose in the joint's, row by row; None for the base."""
    if frame is None:
        return None
    placement = robot.pinocchio_model.frames[frame.index].placement.homogeneous
    return {"joint": frame.parent_joint, "placement": placement.ravel().tolist()}


# ---- the mechanism, as lines and surfaces in the robot's base frame ------------------------------------------------


@final
@dataclass(frozen=True, eq=False)
class MechanismDrawing:
    """What is drawn of a mechanism, in the robot's base frame [m].

    Attributes:
        type: E.g. `"hinge"`.
        sentence: The mechanism in words.
        lines: Polylines, each of shape (n, 3).
        patches: Corners of flat surfaces in order around them, each of shape (4, 3).
        shown: What the recordings did along it, in words; empty if that is not known.
        way: shape (n, 3), from where they began to the farthest point, or along the path on a surface.
        hold: Whether all of them began at one place.
    """

    type: str
    sentence: str
    lines: tuple[Float[np.ndarray, "_n 3"], ...]
    patches: tuple[Float[np.ndarray, "4 3"], ...]
    shown: str
    way: Float[np.ndarray, "_n 3"]
    hold: bool

    def to_dict(self) -> dict[str, Any]:
        """For the page."""
        packed_up = {name: [packed(x, "<f4") for x in getattr(self, name)] for name in ("lines", "patches")}
        return vars(self) | packed_up | {"way": packed(self.way, "<f4")}


def mechanism_drawing(
    mechanism: Mechanism | Mapping[str, Any] | None,
    held: Float[np.ndarray, "n 3"],
    shown: Shown | Intention | None = None,
) -> MechanismDrawing:
    """Lines and patches of a mechanism, as large as the motion that it held, and what was shown along it.

    What a mechanism lacks, e.g. the axis of an orientation that is held, is not drawn; its sentence is always shown.

    Args:
        mechanism: Or its dictionary, as a constraint file holds it; None where it has no name.
        held: The tip where the mechanism held it, in the base frame [m]; at least one point.
        shown: What the recordings did along it, or where they went, if that is known.

    Raises:
        RecordingError: Numbers of a wrong size or not finite.
    """
    described = mechanism.to_dict() if isinstance(mechanism, Mechanism) else dict(mechanism or {})
    # 400 characters are as many as there is room for
    kind = str(described.get("type") or "mechanism")[:400] if described or shown is None else ""
    way, hold, told = np.zeros((0, 3)), False, "" if shown is None else shown.sentence
    if isinstance(shown, Shown) and not described.get("relative_to"):
        way, hold = shown.points, shown.hold is not None
    sentence = str(described.get("sentence") or kind)[:400]
    return MechanismDrawing(kind, sentence, *_form(kind, described, held), told, way, hold)


def _form(
    kind: str, described: Mapping[str, Any], held: Float[np.ndarray, "n 3"]
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Return the lines and the patches of a mechanism; none where it lacks an axis or a place."""
    known = dict[str, Any]()
    for name, shape in {"axis": (3,), "point": (3,), "radius": (), "pitch": ()}.items():
        given = described.get(name)
        known[name] = None if given is None else finite(given, *shape)
        # [m] what is farther away than 1e9 cannot be drawn
        if given is not None and (known[name] is None or not np.all(np.abs(known[name]) < 1e9)):
            wanted = f"{'three finite numbers' if shape else 'a finite number'} below 1e+09"
            raise RecordingError(f"the mechanism's {name} must be {wanted}, got {given!r:.80}", code="mechanism")
    axis, point, radius, pitch = known["axis"], known["point"], float(known["radius"] or 0), float(known["pitch"] or 0)
    if kind == "ball" and point is not None and radius:
        return tuple(_helix(a, point, radius) for a in np.eye(3)), ()
    if kind == "ball" or axis is None or point is None or not np.any(axis):
        return (), ()
    axis = axis / np.linalg.norm(axis)
    beside, along = (held - point) @ across(axis).T, (held - point) @ axis
    if kind == "plane":  # a rectangle, its sides along the widest and the narrowest spread of the motion
        turn = np.linalg.svd(beside - beside.mean(axis=0), full_matrices=False)[2] if len(held) > 2 else np.eye(2)
        within = beside @ turn.T
        margin = _margin(float(np.ptp(within, axis=0).max()))
        (x, y), (right, top) = within.min(axis=0) - margin, within.max(axis=0) + margin
        patch = point + np.array([[x, y], [right, y], [right, top], [x, top]]) @ turn @ across(axis)
        return (np.vstack([patch, patch[:1]]),), (patch,)
    low, high = float(along.min()), float(along.max())
    reach = _margin(high - low) + 0.3 * radius
    lines = [np.array([point + (low - reach) * axis, point + (high + reach) * axis])]
    if kind == "screw" and pitch and radius:
        phase = np.arctan2(beside[0, 1], beside[0, 0]) + (low - along[0]) / pitch  # at the lowest place held
        turn = np.sign(pitch) * min((high - low) / abs(pitch), 2.0 * np.pi * 12.0)  # more turns are not told apart
        lines.append(_helix(axis, point + low * axis, radius, turn, pitch, phase))
    elif kind != "line" and radius:  # the circle of a hinge, the two rims of a cylinder
        heights = (low, high) if kind == "other" else (0.5 * (low + high),)
        lines += [_helix(axis, point + h * axis, radius) for h in heights]
    return tuple(lines), ()


def _helix(
    axis: np.ndarray, point: np.ndarray, radius: float, turn: float = 2.0 * np.pi, pitch: float = 0.0, phase: float = 0
) -> Float[np.ndarray, "n 3"]:
    """Return the circle, or the helix, of a hand that turns about an axis; it begins beside the point at a phase [rad].

    Lines of 3.75 degrees look round when they fill a screen.
    """
    angles = np.linspace(0.0, turn, max(2, round(96 * abs(turn) / (2.0 * np.pi)) + 1))[:, None]
    turned = np.hstack([np.cos(phase + angles), np.sin(phase + angles)]) @ across(axis)
    return point + radius * turned + pitch * angles * axis


def _margin(extent: float) -> float:
    return max(0.25 * extent, 0.06)  # [m] beyond a motion of that extent
