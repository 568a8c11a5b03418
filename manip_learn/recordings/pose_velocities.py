"""Twist of a recorded pose: smoothed on the rotation group, in the frame of the moving thing itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from manip_learn.recordings.local_fit import local_fit, local_weights

WINDOWS_AT_A_TIME = 2048  # relative rotations in memory


def smooth_pose(
    time: Float[np.ndarray, " T"],
    position: Float[np.ndarray, "T 3"],
    rotation: Any,
    half_width: int,
    degree: int,
) -> tuple[Float[np.ndarray, "N 6"], Float[np.ndarray, "N 6"]]:
    """Pose and LOCAL twist at the centre of each window of 2 half_width + 1 samples.

    Positions are fitted by polynomials in the world's axes; rotations by polynomials of v(t) = log(R_c^T R(t)), R_c the
    sample in the centre. With R = R_c exp(v) and the right Jacobian J_r of the rotation group, the twist in the axes of
    the thing is (R^T dp/dt, J_r(v) dv/dt), the velocity of a free-flyer joint in Pinocchio.

    Args:
        time: Increasing [s].
        position: Of the thing in the world [m].
        rotation: Its orientations, a SciPy `Rotation`, which is not loaded before it is needed.
        half_width: Half width of the windows [samples].
        degree: Of the polynomials.

    Returns:
        Position [m] and rotation vector [rad]; linear [m/s] and angular velocity [rad/s], in the axes of the thing.
    """
    p, dp = local_fit(time, position, half_width, degree)
    weights, n, width = local_weights(time, half_width, degree), len(p), 2 * half_width + 1
    v, dv = np.empty((n, 3)), np.empty((n, 3))
    for start in range(0, n, WINDOWS_AT_A_TIME):
        first = np.arange(start, min(n, start + WINDOWS_AT_A_TIME))
        samples = (first[:, None] + np.arange(width)).ravel()
        centre = rotation[np.repeat(first + half_width, width)]
        relative = (centre.inv() * rotation[samples]).as_rotvec().reshape(len(first), width, 3)
        v[first], dv[first] = np.einsum("ndw,nwj->dnj", weights[first, :2], relative)
    from scipy.spatial.transform import Rotation

    smooth = rotation[half_width : half_width + n] * Rotation.from_rotvec(v)
    linear = smooth.inv().apply(dp)
    return np.hstack([p, smooth.as_rotvec()]), np.hstack([linear, _right_jacobian(v, dv)])


def _right_jacobian(v: Float[np.ndarray, "N 3"], dv: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """J_r(v) dv = dv - (1 - cos a)/a^2 v x dv + (a - sin a)/a^3 v x (v x dv), a = |v|."""
    a = np.linalg.norm(v, axis=1, keepdims=True)
    small = a < 1e-4  # where the quotients lose their digits
    safe = np.where(small, 1.0, a)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    once = np.cross(v, dv)
    return dv - first * once + second * np.cross(v, once)


def continuous_rotation_vectors(vectors: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """The same rotations, each by the rotation vector nearest to the one before: full turns are added."""
    out = np.array(vectors)
    for i in range(1, len(out)):
        before, angle = out[i - 1], float(np.linalg.norm(out[i]))
        axis = out[i] / angle if angle > 1e-12 else before / max(float(np.linalg.norm(before)), 1e-12)
        turns = np.round((before @ axis - angle) / (2.0 * np.pi))
        if turns != 0.0:
            out[i] = (angle + 2.0 * np.pi * turns) * axis
    return out
