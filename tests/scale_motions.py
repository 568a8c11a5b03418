"""Many samples of motion with known truth, made in bulk: for the tests and benchmarks of learning at scale."""

from __future__ import annotations

import numpy as np

from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.linalg import orthonormal_rows
from manip_learn.recordings.trajectory import Demonstrations, Trajectory

DT = 0.02
TWO = orthonormal_rows(np.array([[1.0, 0.2, 0.3], [-0.3, 0.9, 0.2]]))  # oblique, of three features


def motions(
    features: FrameJacobian,
    selection: np.ndarray,
    rng: np.random.Generator,
    n_trajectories: int,
    n_points: int = 100,
    noise: float = 0.0,
    held: bool = False,
) -> Demonstrations:
    """u = A^+ b + N pi with b towards a target and pi towards a rest posture; `held`: b = 0, and pi is pushed about."""
    nv, robot = features.nv, features.robot
    rest = np.full(nv, 0.2)
    push, target = rng.standard_normal((n_trajectories, nv)), rng.uniform(-1, 1, (n_trajectories, len(selection)))
    q = rng.uniform(-1.2, 1.2, (n_trajectories, nv))
    positions, velocities = np.empty((2, n_trajectories, n_points, nv))
    for t in range(n_points):
        A = np.einsum("sp,npv->nsv", selection, features.batch(q))
        gram = A @ A.transpose(0, 2, 1) + 1e-4 * np.eye(len(selection))
        pi = rest - q + (push * np.cos(0.3 * t) if held else 0.0)
        task = np.zeros_like(target) if held else 0.3 * target * np.exp(-t * DT)
        exact = np.linalg.pinv(A)
        w = pi - np.einsum("nvs,nsw,nw->nv", exact, A, pi)
        # damped in the task part only, which may be anything: no bursts near singularities
        u = w + np.einsum("nsv,ns->nv", A, np.linalg.solve(gram, task[:, :, None])[:, :, 0])
        positions[:, t] = q
        velocities[:, t] = u + noise * np.sqrt(np.mean(u**2)) * rng.standard_normal(u.shape)
        q = q + DT * u
    time = DT * np.arange(n_points)
    pairs = zip(positions, velocities, strict=True)
    return Demonstrations(
        [Trajectory(time, a, b, robot.joint_names, f"motion {i}", exact=True) for i, (a, b) in enumerate(pairs)]
    )
