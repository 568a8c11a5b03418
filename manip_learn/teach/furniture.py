"""Furniture of the teaching page as boxes: a chest and a cupboard.

Frames are those of the handle where it is shut: x right or away from the hinge, y the way it opens, z up or the axis
about which it opens, right-handed.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

UPRIGHT = 0.98  # cosine of the tilt up to which a chest stands on the floor
BOARD, STANDOFF = 0.016, 0.045  # thickness of a board, and of the hand in front of it [m]
_FRONT, BODY, HANDLE = "front", "body", "handle"
Board = tuple[float, float, float, float, float, float, str]  # centre x, y, z, size x, y, z [m], and what it is


def facing(out: Float[np.ndarray, " 3"], handle: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a handle that moves along a direction, upright unless that is vertical."""
    up = np.array([0.0, 0.0, 1.0]) if abs(out[2]) < UPRIGHT else np.array([1.0, 0.0, 0.0])
    right = np.cross(out, up) / np.linalg.norm(np.cross(out, up))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([right, out, np.cross(right, out)]), handle
    return pose


def hinged(
    out: Float[np.ndarray, " 3"], axis: Float[np.ndarray, " 3"], handle: Float[np.ndarray, " 3"], radius: float
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, " 3"]]:
    """Pose of a handle that turns about an axis, and where that is in its frame; the leaf reaches to the axis.

    Args:
        out: shape (3,), the way in which it opens, square to the axis.
        axis: shape (3,), unit vector.
        handle: shape (3,), its place [m].
        radius: From the axis to the handle [m].
    """
    right, sine = np.cross(out, axis), min(0.03 / radius, 0.5)  # [m] from the leaf to the handle
    cosine = float(np.sqrt(1.0 - sine**2))
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([cosine * right - sine * out, sine * right + cosine * out, axis])
    pose[:3, 3] = handle
    return pose, np.array([-cosine * radius, -sine * radius, 0.0])


def drawer_boards(travel: float, pose: Float[np.ndarray, "4 4"]) -> tuple[tuple[Board, ...], tuple[Board, ...]]:
    """A chest, on the floor if it is upright, and its drawer, deep enough to be pulled so far."""
    width, depth = float(np.clip(1.2 * travel, 0.26, 0.5)), travel + 0.08
    height = 0.42 * width
    inner, face = width - 4.0 * BOARD, -STANDOFF
    low = 0.5 * BOARD - 0.4 * height
    bar = 0.36 * width  # across, at which the hand is
    feet = ((x * 0.42 * bar, -0.5 * STANDOFF, 0.0, 0.01, STANDOFF, 0.01, HANDLE) for x in (-1.0, 1.0))
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
    """A cupboard and its door, from the axis to a little beyond the handle."""
    left, face = float(pivot[0]), float(pivot[1])
    right, half = -0.18 * left + 0.03, float(np.clip(-0.7 * left, 0.14, 0.4))
    bar = 0.35 * half
    feet = ((0.0, 0.5 * face, z * 0.8 * bar, 0.01, -face, 0.01, HANDLE) for z in (-1.0, 1.0))
    leaf = (0.5 * (left + right), face - 0.5 * BOARD, 0.0, right - left, BOARD, 2.0 * half, _FRONT)
    case = _case(left, right, -half, half, 0.05 - 0.5 * left, face - BOARD)
    hinge = (left, face, 0.0, 0.016, 0.016, 2.0 * half, HANDLE)
    return (*case, hinge), (leaf, (0.0, 0.0, 0.0, 0.014, 0.014, 2.0 * bar, HANDLE), *feet)


def _case(left: float, right: float, low: float, high: float, depth: float, front: float) -> tuple[Board, ...]:
    """Five boards that are open in front, around an inner box [m]."""
    x, z, y = 0.5 * (left + right), 0.5 * (low + high), front - 0.5 * depth
    wide, tall = right - left + 2.0 * BOARD, high - low
    return (
        *((x, y, end, wide, depth, BOARD, BODY) for end in (low - 0.5 * BOARD, high + 0.5 * BOARD)),
        *((end, y, z, BOARD, depth, tall, BODY) for end in (left - 0.5 * BOARD, right + 0.5 * BOARD)),
        (x, front - depth + 0.5 * BOARD, z, wide, BOARD, tall, BODY),
    )
