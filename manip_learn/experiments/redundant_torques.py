"""Torques as actions: a four-joint arm whose task asks for accelerations of its tip.

The tip accelerates by J M^-1 tau and by what gravity, springs and speed do; the task asks for the first part along its
rows, A(q) tau = b with A = Lambda Phi(q), Phi = J M^-1. More actuators than task directions: the rest of tau is free.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.custom_features import CustomFeatures
from manip_learn.experiments.curve_constraint import with_noise
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory

LENGTHS = np.array([0.5, 0.5, 0.4, 0.3])  # [m]
MASSES = np.array([3.0, 2.0, 1.5, 1.0])  # at the end of each link [kg]
ROTORS = 0.05  # inertia of each drive [kg m^2]
REST = np.array([0.4, 0.6, 0.5, 0.4])  # [rad]
STIFFNESS, DAMPING = 6.0, 2.0  # of the free part [N m/rad], of the joints [N m s/rad]
NAMES = ("torque1", "torque2", "torque3", "torque4")
TORQUE_TASKS = {
    "tip accelerates along x and y": np.eye(3)[:2],
    "tip accelerates along 30 degrees": np.array([[np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0]]),
}
DEMONSTRATIONS, SAMPLES, STEP, EVERY = 40, 25, 0.002, 10  # recorded every 20 ms


@cache
def torque_features() -> CustomFeatures:
    """Phi = J M^-1: acceleration of the tip along x, y and of its heading a torque [m/s^2 or rad/s^2, a N m]."""
    return CustomFeatures(lambda q: tip_jacobian(q) @ np.linalg.inv(inertia(q)), ("x", "y", "heading"), nv=4)


def jacobians(q: ArrayLike) -> Float[np.ndarray, "4 2 4"]:
    """Of the end of each link."""
    angles = np.cumsum(np.asarray(q, dtype=np.float64))
    columns = LENGTHS * np.array([-np.sin(angles), np.cos(angles)])  # what link i adds, (2, 4)
    out = np.zeros((4, 2, 4))
    for k in range(4):
        for j in range(k + 1):
            out[k, :, j] = columns[:, j : k + 1].sum(axis=1)
    return out


def tip_jacobian(q: ArrayLike) -> Float[np.ndarray, "3 4"]:
    """Of the tip, with the row of its heading."""
    return np.concatenate([jacobians(q)[-1], np.ones((1, 4))])


def inertia(q: ArrayLike) -> Float[np.ndarray, "4 4"]:
    """M(q) [kg m^2]."""
    J = jacobians(q)
    return np.einsum("k,kai,kaj->ij", MASSES, J, J) + ROTORS * np.eye(4)


def speed_torques(q: Float[np.ndarray, " 4"], dq: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " 4"]:
    """Coriolis and centrifugal torques, sum_k m_k J_k^T (dJ_k/dt dq) [N m]."""
    angles, rates = np.cumsum(q), np.cumsum(dq)
    pulls = -LENGTHS * rates**2 * np.array([np.cos(angles), np.sin(angles)])
    return np.einsum("k,kai,ak->i", MASSES, jacobians(q), np.cumsum(pulls, axis=1))


def torque_demonstrations(
    task: str, noise: float, rng: np.random.Generator
) -> tuple[Demonstrations, Float[np.ndarray, "s 3"]]:
    """Reaching by torques, tau = A^+ b + N pi with pi = -K (q - rest); b pulls to a target and damps; and Lambda."""
    Lambda = TORQUE_TASKS[task]
    trajectories = []
    for i in range(DEMONSTRATIONS):
        q, dq = REST + 0.5 * rng.standard_normal(4), np.zeros(4)
        target = rng.uniform([0.2, -0.2, 0.5], [1.2, 1.2, 2.5])
        postures, torques = [], []
        for step in range(SAMPLES * EVERY):
            J, M = tip_jacobian(q), inertia(q)
            A = Lambda @ np.linalg.solve(M, J.T).T
            angles = np.cumsum(q)
            r = np.array([LENGTHS @ np.cos(angles), LENGTHS @ np.sin(angles), angles[-1]])
            b = Lambda @ (8.0 * (target - r) - 4.0 * (J @ dq))
            inverse = np.linalg.pinv(A)
            pi = -STIFFNESS * (q - REST)
            tau = inverse @ b + pi - inverse @ (A @ pi)
            if step % EVERY == 0:
                postures.append(q)
                torques.append(tau)
            dq = dq + STEP * np.linalg.solve(M, tau - speed_torques(q, dq) - DAMPING * dq)
            q = q + STEP * dq
        u = with_noise(np.array(torques), noise, rng)
        time = STEP * EVERY * np.arange(SAMPLES)
        trajectories.append(Trajectory(time, np.array(postures), u, NAMES, f"reach {i}"))
    return Demonstrations(trajectories), Lambda
