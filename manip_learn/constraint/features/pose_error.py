"""The error of a frame's pose, and how it changes while the frame moves.

With the pose (p, R) and the goal (p*, R*) the error is, along the axes of the base and along those of the frame,

    e = (p* - p,  log(R* R^T))        and        R^T e = (R^T (p* - p),  log(R^T R*))

The rate of a rotation vector is not the angular velocity: with a twist (v, w) along the same axes and a goal at rest

    base    d/dt e = -( v,  Jr^-1(e_rot) w )
    frame   d/dt e = -( v - e_lin x w,  Jl^-1(e_rot) w )

Jl and Jr are the left and the right Jacobian of SO(3), see `robot.rotations`. On the goal both maps are the identity.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.errors import TargetError
from manip_learn.robot.rotations import left_jacobian, left_jacobian_inverse, rotation_vector, skew

EXACT = 1e-12  # a matrix that is orthonormal to this is taken as it is
NEARLY = 1e-3  # printed with few digits: made orthonormal; beyond this it is no rotation


def pose_coordinates(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 6"]:
    """Position [m] and rotation vector [rad]."""
    return np.concatenate([pose[:3, 3], rotation_vector(pose[:3, :3])])


def coordinate_rates(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """C with d/dt `pose_coordinates` = C (v, w), the twist along the axes of the base."""
    C = np.eye(6)
    C[3:, 3:] = left_jacobian_inverse(rotation_vector(pose[:3, :3]))
    return C


def goal_rotation(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation that is meant by the upper left part of a 4 x 4 pose.

    Raises:
        TargetError: It is none.
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()  # in plain numbers: a moving goal is looked at in every step
    squares = (a * a + b * b + c * c - 1.0, d * d + e * e + f * f - 1.0, g * g + h * h + i * i - 1.0)
    off = max(map(abs, (*squares, a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i)))
    if not off < NEARLY or a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0.0:
        raise TargetError(f"the upper left 3 x 3 part of the pose is not a rotation matrix: {R.tolist()}")
    if off < EXACT:
        return R
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_matrix()


def pose_error(
    pose: Float[np.ndarray, "4 4"], goal: Float[np.ndarray, "4 4"], own_axes: bool
) -> Float[np.ndarray, " 6"]:
    """e, along the axes of the base or of the frame."""
    return placement_error(pose[:3, 3], pose[:3, :3], goal[:3, 3], goal[:3, :3], own_axes)


def placement_error(
    position: Float[np.ndarray, " 3"],
    rotation: Float[np.ndarray, "3 3"],
    goal: Float[np.ndarray, " 3"],
    goal_rotation: Float[np.ndarray, "3 3"],
    own_axes: bool,
) -> Float[np.ndarray, " 6"]:
    """The same from positions and rotations."""
    out = np.empty(6)
    turn = rotation_vector(goal_rotation.dot(rotation.T))
    if own_axes:
        out[:3], out[3:] = (goal - position).dot(rotation), turn.dot(rotation)
    else:
        out[:3], out[3:] = goal - position, turn
    return out


def error_rates(error: Float[np.ndarray, " 6"], own_axes: bool) -> Float[np.ndarray, "6 6"]:
    """M with d/dt e = -M (v, w) for a goal at rest; e and the twist along the same axes."""
    M = np.eye(6)
    if own_axes:
        M[:3, 3:] = -skew(error[:3])
    M[3:, 3:] = turn_rates(error[3:], own_axes)
    return M


def turn_rates(turn: Float[np.ndarray, " 3"], own_axes: bool) -> Float[np.ndarray, "3 3"]:
    """The part of M that turns the rotation error: Jl^-1 or Jr^-1."""
    return left_jacobian_inverse(turn if own_axes else -turn)


def carried_goal(
    here: Float[np.ndarray, " 3"], goal: Float[np.ndarray, " 3"], given: list[int], turn: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "3 3"]:
    """G with d/dt e_rot = -(Jr^-1(e_rot) - G) w, where the goal has those numbers of a rotation vector that are given
    and takes the others from the frame, so that it turns while the frame turns.

    dr/dt = Jl^-1(r) w, the goal's vector moves with the part of it that is not given, and
    G = Jl^-1(e_rot) Jl(r*) F Jl^-1(r), F = diag(0 where given, else 1).

    Args:
        here: r, the rotation vector of the frame in the base [rad].
        goal: r* [rad].
        given: Which of its three numbers are given.
        turn: e_rot.
    """
    F = np.eye(3)
    F[given] = 0.0
    return left_jacobian_inverse(turn) @ left_jacobian(goal) @ F @ left_jacobian_inverse(here)
