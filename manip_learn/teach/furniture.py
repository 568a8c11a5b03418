"""Furniture of the teaching page as boxes: a chest and a cupboard.

Boxes are in the frame of the handle when the furniture is closed. It is right-handed: x points right or away from the
hinge, y in the opening direction, and z up or along the axis of the hinge.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

UPRIGHT = 0.98  # cosine of the largest tilt of a chest that stands on the floor
BOARD = 0.016  # [m] thickness of a board
_FRONT, BODY, HANDLE = "front", "body", "handle"
Board = tuple[float, float, float, float, float, float, str]  # centre x, y, z, size x, y, z [m], and its part


def facing(out: Float[np.ndarray, " 3"], handle: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a handle in the base frame: y along `out`, z up, x to complete a right-handed frame.

    "Up" means as close as possible to the base's z axis; if `out` is nearly vertical, to the base's x axis.

    Args:
        out: shape (3,), unit vector of the opening direction, in the base frame.
        handle: shape (3,), position of the handle in the base frame [m].

    Returns:
        Homogeneous matrix (4, 4) [m].
    """
    up = np.array([0.0, 0.0, 1.0]) if abs(out[2]) < UPRIGHT else np.array([1.0, 0.0, 0.0])
    right = np.cross(out, up) / np.linalg.norm(np.cross(out, up))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([right, out, np.cross(right, out)]), handle
    return pose


def hinged(
    out: Float[np.ndarray, " 3"], axis: Float[np.ndarray, " 3"], handle: Float[np.ndarray, " 3"], radius: float
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, " 3"]]:
    """Return the pose of a door's handle that turns about an axis.

    Args:
        out: shape (3,), unit vector of the opening direction, perpendicular to the axis, in the base frame.
        axis: shape (3,), unit vector in the base frame.
        handle: shape (3,), position of the handle in the base frame [m].
        radius: Distance from the axis to the handle [m].

    Returns:
        Pose of the handle in the base frame [m], and the position of the axis in the handle's frame [m].
    """
    right, sine = np.cross(out, axis), min(0.03 / radius, 0.5)  # the handle is 0.03 m in front of the leaf
    cosine = float(np.sqrt(1.0 - sine**2))
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([cosine * right - sine * out, sine * right + cosine * out, axis])
    pose[:3, 3] = handle
    return pose, np.array([-cosine * radius, -sine * radius, 0.0])


def drawer_boards(travel: float, pose: Float[np.ndarray, "4 4"]) -> tuple[tuple[Board, ...], tuple[Board, ...]]:
    """Return the boxes of a chest and of its drawer, which is deep enough for its travel.

    An upright chest stands on the floor.

    Args:
        travel: Travel of the drawer [m].
        pose: shape (4, 4), pose of the handle in the base frame [m].

    Returns:
        Boxes of the chest, and boxes of the drawer, in the handle's frame.
    """
    width, depth = float(np.clip(1.2 * travel, 0.26, 0.5)), travel + 0.08
    height = 0.42 * width
    inner, face = width - 4.0 * BOARD, -0.045  # [m] room for the hand between the bar and the front
    low = 0.5 * BOARD - 0.4 * height
    bar = 0.36 * width  # length of the bar that the hand holds
    feet = ((x * 0.42 * bar, 0.5 * face, 0.0, 0.01, -face, 0.01, HANDLE) for x in (-1.0, 1.0))
    sides = (-0.5 * (inner - BOARD), 0.5 * (inner - BOARD))
    moving = (
        (0.0, 0.0, 0.0, bar, 0.014, 0.014, HANDLE),
        *feet,
        (0.0, face - 0.5 * BOARD, 0.0, width, BOARD, height, _FRONT),
        (0.0, face - 0.5 * depth, low, inner, depth - BOARD, BOARD, BODY),
        *((x, face - 0.5 * depth, 0.0, BOARD, depth - BOARD, 0.8 * height, BODY) for x in sides),
        (0.0, face - depth, 0.0, inner, BOARD, 0.8 * height, BODY),
    )
    chest = _case(-0.5 * width, 0.5 * width, -0.5 * height, 0.5 * height, depth + BOARD, face - BOARD)
    below = float(pose[2, 3]) - 0.5 * height - BOARD
    if pose[2, 2] > UPRIGHT and below > 0.05:
        back = face - 1.5 * BOARD - 0.5 * depth
        chest += ((0.0, back, -0.5 * height - BOARD - 0.5 * below, width + 2.0 * BOARD, depth + BOARD, below, BODY),)
    return chest, moving


def door_boards(pivot: Float[np.ndarray, " 3"]) -> tuple[tuple[Board, ...], tuple[Board, ...]]:
    """Return the boxes of a cupboard and of its door, which reaches from the axis to a little beyond the handle.

    Args:
        pivot: shape (3,), position of the axis in the handle's frame [m].

    Returns:
        Boxes of the cupboard, and boxes of the door, in the handle's frame.
    """
    hinge_x, face = float(pivot[0]), float(pivot[1])
    right, half = -0.18 * hinge_x + 0.03, float(np.clip(-0.7 * hinge_x, 0.14, 0.4))
    bar = 0.35 * half
    feet = ((0.0, 0.5 * face, z * 0.8 * bar, 0.01, -face, 0.01, HANDLE) for z in (-1.0, 1.0))
    leaf = (0.5 * (hinge_x + right), face - 0.5 * BOARD, 0.0, right - hinge_x, BOARD, 2.0 * half, _FRONT)
    case = _case(hinge_x, right, -half, half, 0.05 - 0.5 * hinge_x, face - BOARD)
    hinge = (hinge_x, face, 0.0, 0.016, 0.016, 2.0 * half, HANDLE)
    return (*case, hinge), (leaf, (0.0, 0.0, 0.0, 0.014, 0.014, 2.0 * bar, HANDLE), *feet)


def _case(left: float, right: float, low: float, high: float, depth: float, front: float) -> tuple[Board, ...]:
    """Return five boards around an inner box that is open in front [m]."""
    x, z, y = 0.5 * (left + right), 0.5 * (low + high), front - 0.5 * depth
    wide, tall = right - left + 2.0 * BOARD, high - low
    return (
        *((x, y, end, wide, depth, BOARD, BODY) for end in (low - 0.5 * BOARD, high + 0.5 * BOARD)),
        *((end, y, z, BOARD, depth, tall, BODY) for end in (left - 0.5 * BOARD, right + 0.5 * BOARD)),
        (x, front - depth + 0.5 * BOARD, z, wide, BOARD, tall, BODY),
    )
