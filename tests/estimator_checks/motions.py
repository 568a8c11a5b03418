"""Small motions with known truth, on which an estimator's contract is checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from generated_motions import planar_features
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.linalg import orthonormal_rows
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory

MotionKind = Literal["held", "moved"]
DT = 0.02
# repetitions of the same arithmetic in another order [deg]
ROUNDING_DEG = 1e-5
# oblique on purpose: no axis of its own
TWO_ROWS = orthonormal_rows(np.array([[1.0, 0.2, 0.3], [-0.3, 0.9, 0.2]]))
ONE_ROW = orthonormal_rows(np.array([[0.5, 1.0, -0.4]]))


@final
@dataclass(frozen=True, eq=False)
class Motion:
    """Demonstrations and the selection matrix that they obey.

    Attributes:
        features: Phi.
        demonstrations: With velocities, without noise.
        selection: The true Lambda, shape (s, p).
    """

    features: FeatureMap
    demonstrations: Demonstrations
    selection: Float[np.ndarray, "s p"]


def planar_motion(
    kind: MotionKind,
    selection: Float[np.ndarray, "s p"] = TWO_ROWS,
    n_trajectories: int = 24,
    n_points: int = 12,
    seed: int = 0,
) -> Motion:
    """A planar arm that reaches for targets along the rows (moved), or that is pushed about while they are held.

    moved: u = A^+ Lambda (r* - r) + N (rest - q), another target each time; held: u = N pi with slow waves for pi.
    """
    features, rng = planar_features(), np.random.default_rng(seed)
    rest = np.array([0.3, -0.2, 0.4])
    trajectories = []
    for k in range(n_trajectories):
        q = np.array([0.1, 1.5, 0.2]) + 0.3 * rng.uniform(-1.0, 1.0, 3)
        target = features.coordinates(q) + rng.uniform(-1.0, 1.0, 3)
        rate, phase, size = rng.uniform(1.0, 5.0, 3), rng.uniform(0.0, 6.0, 3), rng.uniform(0.5, 1.0, 3)
        positions, velocities = np.empty((n_points, 3)), np.empty((n_points, 3))
        for i in range(n_points):
            A = selection @ features(q)
            pi, b = size * np.sin(rate * i * DT + phase), np.zeros(len(A))
            if kind == "moved":
                pi, b = rest - q, selection @ (target - features.coordinates(q))
            u = pi + np.linalg.pinv(A) @ (b - A @ pi)
            positions[i], velocities[i] = q, u
            q = q + DT * u
        trajectories.append(
            Trajectory(DT * np.arange(n_points), positions, velocities, features.robot.joint_names, f"motion {k}")
        )
    return Motion(features, Demonstrations(trajectories), selection)


def changed(trajectory: Trajectory, **fields: object) -> Trajectory:
    """A trajectory with some of `time`, `q`, `u`, `joint_names`, `name` replaced."""
    now = {name: getattr(trajectory, name) for name in ("time", "q", "u", "joint_names", "name")}
    return Trajectory(**{**now, **fields})  # type: ignore[arg-type]


def velocities(trajectory: Trajectory) -> Float[np.ndarray, "T nv"]:
    """u, which every trajectory here has; a copy that may be changed."""
    return np.array(trajectory.u, dtype=np.float64)


def mapped(demonstrations: Demonstrations, **change: object) -> Demonstrations:
    """Demonstrations in which each field named becomes the function of the trajectory that is given for it."""
    return Demonstrations(
        [changed(t, **{name: function(t) for name, function in change.items()}) for t in demonstrations]  # type: ignore[operator]
    )
