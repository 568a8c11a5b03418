"""What is drawn of a constraint at the tip: directions held and free, the task's ellipsoid, the target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import MechanismRows
from manip_learn.constraint.features.frame_jacobian import AXES, PoseRows
from manip_learn.constraint.features.mechanism_rows import WeighedVelocity
from manip_learn.linalg import null_basis, row_basis
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
