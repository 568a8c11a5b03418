"""Which directions a constraint holds and leaves free at the frame that it guides, moving and turning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian, MechanismRows, RelativeFrameJacobian
from manip_learn.constraint.features.frame_jacobian import AXES
from manip_learn.constraint.features.weighed_velocity import WeighedVelocity
from manip_learn.linalg import null_basis, row_basis
from manip_learn.robot.frame import Frame

COUPLED = 0.1  # part of a learnt unit row that turns, up to which it counts as one that only moves, and the other way
EXACT = 1e-6  # the same of a mechanism's rows


@final
@dataclass(frozen=True, eq=False)
class HeldDirections:
    """Projectors onto directions, in the axes of `axes` (the base, if that is None).

    Each field is shape (3, 3), or (T, 3, 3) along a motion if the directions depend on the place. Directions that the
    features do not look at are neither held nor free.

    Attributes:
        frame: The frame that is guided.
        axes: Frame whose axes are meant; None for the base.
        held, free: Of the frame's origin.
        held_turns, free_turns: Of its orientation.
    """

    frame: Frame
    axes: Frame | None
    held: Float[np.ndarray, "..."]
    free: Float[np.ndarray, "..."]
    held_turns: Float[np.ndarray, "..."]
    free_turns: Float[np.ndarray, "..."]


def held_directions(constraint: Constraint, places: Float[np.ndarray, "T 3"]) -> HeldDirections | None:
    """The directions of a constraint; None for features that are not of one frame.

    A direction is held if moving along it alone breaks the constraint, whatever the turning: the row space has the row
    (a, 0). It is free if the constraint allows to move along it, perhaps with a turn, as at a door's handle.

    Args:
        constraint: A(q).
        places: Origin of the frame along the motion, in the base frame [m].
    """
    features = constraint.features
    if isinstance(features, WeighedVelocity):
        W = features.weights(places)[0]
        turning = bool(np.any(W[..., 3:]))
        observed = np.eye(3), np.eye(3) if turning else np.zeros((3, 3))
        learnt = not isinstance(features, MechanismRows)  # a mixture, where a mechanism's rows are what they are
        parts = [_parts(constraint.selection @ w, observed, COUPLED if learnt else EXACT) for w in W]
        return HeldDirections(features.frame, None, *(np.array([p[k] for p in parts]) for k in range(4)))
    if not isinstance(features, FrameJacobian | RelativeFrameJacobian):
        return None
    columns = [AXES.index(name) for name in features.row_names]
    rows = np.zeros((constraint.n_constraints, 6))
    rows[:, columns] = constraint.selection
    seen = np.zeros(6)
    seen[columns] = 1.0
    axes = features.relative_to if isinstance(features, RelativeFrameJacobian) else None
    if isinstance(features, FrameJacobian) and features.reference == "local":
        axes = features.frame
    return HeldDirections(features.frame, axes, *_parts(rows, (np.diag(seen[:3]), np.diag(seen[3:])), COUPLED))


def _parts(
    rows: Float[np.ndarray, "s 6"], observed: tuple[np.ndarray, np.ndarray], tolerance: float
) -> list[Float[np.ndarray, "3 3"]]:
    """Projectors onto held and free directions, moving, then turning."""
    basis = row_basis(rows) if np.any(rows) else np.zeros((0, 6))
    held = [_pure(basis, moving, tolerance) for moving in (True, False)]
    free = []
    for part, seen, own in zip((slice(0, 3), slice(3, 6)), observed, held, strict=True):
        allowed = null_basis(basis)[part] if len(basis) else np.eye(6)[part]
        free.append(_seen(_projector(allowed), seen - own if np.any(seen) else seen))
    return [held[0], free[0], held[1], free[1]]


def _pure(basis: Float[np.ndarray, "s 6"], moving: bool, tolerance: float) -> Float[np.ndarray, "3 3"]:
    """Onto the directions of those rows that only move, or only turn."""
    own, other = (basis[:, :3], basis[:, 3:]) if moving else (basis[:, 3:], basis[:, :3])
    if not len(basis):
        return np.zeros((3, 3))
    U, sigma, _ = np.linalg.svd(other)
    coupled = np.zeros(len(U), dtype=bool)  # more rows than columns have further, zero singular values
    coupled[: len(sigma)] = sigma >= tolerance
    return _projector((U[:, ~coupled].T @ own).T)


def _projector(columns: Float[np.ndarray, "3 k"]) -> Float[np.ndarray, "3 3"]:
    if not columns.size:
        return np.zeros((3, 3))
    U, sigma, _ = np.linalg.svd(columns, full_matrices=False)
    U = U[:, sigma > max(COUPLED * sigma[0], 1e-9)]
    return U @ U.T


def _seen(allowed: Float[np.ndarray, "3 3"], seen: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Those of the directions that the features look at."""
    return _projector(allowed @ seen)
