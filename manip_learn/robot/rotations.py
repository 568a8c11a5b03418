"""Rotation matrices and rotation vectors of single poses, in plain numbers: a few microseconds, many times per second.

(SciPy's Rotation takes ten times as long for one; Pinocchio's logarithm loses digits close to half a turn.)
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float


def rotation_vector(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
    """Axis times angle [rad] of a rotation matrix, angle in [0, pi]; accurate to 1e-15 at every angle."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    # the quaternion by its largest part, so that nothing is divided by something small
    parts = (a + e + i, a - e - i, e - a - i, i - a - e)
    largest = parts.index(max(parts))
    if largest == 0:
        w, x, y, z = 1.0 + parts[0], h - f, c - g, d - b
    elif largest == 1:
        w, x, y, z = h - f, 1.0 + parts[1], b + d, c + g
    elif largest == 2:
        w, x, y, z = c - g, b + d, 1.0 + parts[2], f + h
    else:
        w, x, y, z = d - b, c + g, f + h, 1.0 + parts[3]
    length = math.hypot(x, y, z)
    if length == 0.0:
        return np.zeros(3)
    scale = 2.0 * math.atan2(length, abs(w)) / length
    if w < 0.0:
        scale = -scale
    return np.array([scale * x, scale * y, scale * z])


def rotation_matrix(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of axis times angle [rad]."""
    x, y, z = vector.tolist()
    angle = math.hypot(x, y, z)
    half = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.5
    w, x, y, z = math.cos(0.5 * angle), half * x, half * y, half * z
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )
