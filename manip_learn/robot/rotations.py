"""Fast conversions between rotation matrices and rotation vectors: a few microseconds each, for control loops; and
differences of poses.

Also the left Jacobian of SO(3) and its inverse, which give the rates of rotation vectors (J. Sola et al., "A micro Lie
theory for state estimation in robotics", equations (145) and (146)). The right Jacobian of a vector is the left
Jacobian of its negative.

(For one rotation SciPy's Rotation takes 10 times as long; Pinocchio's logarithm loses digits close to half a turn.)
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

SMALL_ANGLE = 0.1  # [rad] below it the coefficients come from their series, which are exact to 1e-15 there


def rotation_vector(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
    """Convert a rotation matrix to a rotation vector, accurate to 1e-15 at every angle.

    Args:
        R: Rotation matrix (3, 3).

    Returns:
        Rotation vector (3,), axis times angle [rad]; its length is in [0, pi].
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    # compute the quaternion from its largest part to avoid small divisors
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


def rotation_vectors(R: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """Convert many rotation matrices to rotation vectors at once, see `rotation_vector`.

    Args:
        R: Rotation matrices (n, 3, 3).

    Returns:
        Rotation vectors (n, 3) [rad].
    """
    (a, b, c), (d, e, f), (g, h, i) = R.transpose(1, 2, 0)
    x, y, z, xy, xz, yz = h - f, c - g, d - b, b + d, c + g, f + h
    # four times the quaternion (w, x, y, z) times each of its parts: the row of the largest part has no cancellation
    products = np.array(
        [
            [1.0 + a + e + i, x, y, z],
            [x, 1.0 + a - e - i, xy, xz],
            [y, xy, 1.0 + e - a - i, yz],
            [z, xz, yz, 1.0 + i - a - e],
        ]
    )
    largest = np.argmax(np.einsum("kkn->kn", products), axis=0)
    quaternion = products[largest, :, np.arange(len(R))]
    w, axis = quaternion[:, 0], quaternion[:, 1:]
    length = np.sqrt(np.einsum("nk,nk->n", axis, axis))
    angle = np.copysign(2.0 * np.arctan2(length, np.abs(w)), w)
    return axis * np.divide(angle, length, out=np.zeros(len(R)), where=length > 0.0)[:, None]


def angles_between(one: Float[np.ndarray, "3 3"], others: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Return the angle between one orientation and each of several others [rad].

    Args:
        one: Rotation matrix (3, 3).
        others: Rotation matrices (n, 3, 3).

    Returns:
        shape (n,), from 0 to pi [rad].
    """
    return np.linalg.norm(rotation_vectors(others @ one.T), axis=1)


def rotation_matrix(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Convert a rotation vector to a rotation matrix.

    Args:
        vector: Rotation vector (3,), axis times angle [rad].

    Returns:
        Rotation matrix (3, 3).
    """
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


def skew(v: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the skew-symmetric matrix [v]x, whose product with a vector u is the cross product v x u.

    Args:
        v: Vector (3,), the first factor of the cross product.

    Returns:
        shape (3, 3).
    """
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def left_jacobian(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the left Jacobian J of SO(3), which turns the rate of a rotation vector r into the angular velocity J
    dr/dt.

    The angular velocity is along the fixed axes in which r is given. Equation (145) of Sola et al., with the angle |r|
    called alpha:

        J = I + (1 - cos alpha) / alpha^2 [r]x + (alpha - sin alpha) / alpha^3 [r]x^2

    Args:
        vector: Rotation vector r (3,), axis times angle [rad].

    Returns:
        shape (3, 3), without a unit.
    """
    square = float(vector.dot(vector))
    angle = math.sqrt(square)
    if angle < SMALL_ANGLE:  # the quotients lose digits
        first = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
        second = 1.0 / 6.0 - square / 120.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))
    else:
        first, second = (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
    K = skew(vector)
    return np.eye(3) + first * K + second * K.dot(K)


def left_jacobian_inverse(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the inverse of `left_jacobian`, which turns an angular velocity into the rate of the rotation vector r.

    It is finite for angles below a full turn. Equation (146) of Sola et al., with the angle |r| called alpha:

        J^-1 = I - [r]x / 2 + (1 - (alpha / 2) cot(alpha / 2)) / alpha^2 [r]x^2

    Args:
        vector: Rotation vector r (3,), axis times angle [rad].

    Returns:
        shape (3, 3), without a unit.
    """
    x, y, z = vector.tolist()
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < SMALL_ANGLE:
        second = 1.0 / 12.0 + square / 720.0 * (1.0 + square / 42.0 * (1.0 + square / 40.0))
    else:
        half = 0.5 * angle
        second = (1.0 - half * math.cos(half) / math.sin(half)) / square
    rest = 1.0 - second * square
    a, b, c = second * x, second * y, second * z
    x2, y2, z2 = 0.5 * x, 0.5 * y, 0.5 * z
    return np.array(
        (
            (rest + a * x, a * y + z2, a * z - y2),
            (a * y - z2, rest + b * y, b * z + x2),
            (a * z + y2, b * z - x2, rest + c * z),
        )
    )


def pose_coordinates(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 6"]:
    """Return position and rotation vector of a pose.

    Args:
        pose: Homogeneous matrix (4, 4) [m].

    Returns:
        shape (6,): position [m], then rotation vector [rad], in the frame in which the pose is given.
    """
    return np.concatenate([pose[:3, 3], rotation_vector(pose[:3, :3])])


def pose_error(
    pose: Float[np.ndarray, "4 4"], goal: Float[np.ndarray, "4 4"], own_axes: bool
) -> Float[np.ndarray, " 6"]:
    """Return the displacement from a pose to a goal.

    Args:
        pose: Pose (4, 4) of a frame [m].
        goal: Goal pose (4, 4) of this frame, in the same reference frame [m].
        own_axes: True for components along the axes of the frame at `pose`, False for the axes of the reference frame.

    Returns:
        shape (6,): translation [m], then rotation vector [rad].
    """
    R = pose[:3, :3]
    error = np.concatenate([goal[:3, 3] - pose[:3, 3], rotation_vector(goal[:3, :3].dot(R.T))])
    return error.reshape(2, 3).dot(R).reshape(6) if own_axes else error


def turn_about(Q: Float[np.ndarray, "*n 3 3"], axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "*n"]:
    """Return the part of rotations about an axis; it is well determined up to half a turn.

    Args:
        Q: One rotation matrix (3, 3), or several (n, 3, 3).
        axis: Unit vector (3,), along the same axes.

    Returns:
        One angle per rotation, in [-pi, pi] [rad].
    """
    vee = np.stack([Q[..., 2, 1] - Q[..., 1, 2], Q[..., 0, 2] - Q[..., 2, 0], Q[..., 1, 0] - Q[..., 0, 1]], axis=-1)
    return np.asarray(np.arctan2(vee @ axis, np.trace(Q, axis1=-2, axis2=-1) - Q @ axis @ axis))


def shortest_turn(before: Float[np.ndarray, " 3"], after: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Return the rotation vectors of the shortest rotations from one direction to others.

    Args:
        before: Direction (3,) of any length.
        after: Direction (3,), or directions (n, 3).

    Returns:
        One rotation vector per direction, axis times angle [rad]; 0 for opposite directions.
    """
    normal = np.cross(before, after)
    sine = np.linalg.norm(normal, axis=-1, keepdims=True)
    return normal * np.arctan2(sine, (after @ before)[..., None]) / np.maximum(sine, 1e-300)
