"""Uncertainty of a row space by bootstrap over trajectories."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.learning.samples import Samples
from manip_learn.linalg import complement_rows, orthonormal_rows, row_space_angle


def bootstrap_angle_deg(
    samples: Samples,
    Lambda: Float[np.ndarray, "s r"],
    gradients: Float[np.ndarray, "g m"],
    hessians: Float[np.ndarray, "g m m"],
    rng: np.random.Generator,
    repetitions: int = 200,
    quantile: float = 0.68,
) -> float | None:
    """Angle [deg] within which a share of the repetitions keeps the row space of Lambda.

    Each repetition draws trajectories with replacement and takes one Gauss-Newton step from the optimum with their
    gradients and Hessians; trajectories are the unit because samples of one trajectory are not independent.

    Returns:
        The angle; None with fewer than two trajectories or no freedom.
    """
    n_groups, m = gradients.shape
    if n_groups < 2 or m == 0:
        return None
    s, r = Lambda.shape
    weights = rng.multinomial(n_groups, np.full(n_groups, 1.0 / n_groups), size=repetitions).astype(np.float64)
    H = np.einsum("bg,gij->bij", weights, hessians, optimize=True)
    g = weights @ gradients
    scale = np.trace(hessians.sum(axis=0)) / m
    steps = -np.linalg.solve(H + 1e-12 * scale * np.eye(m), g[:, :, None])[:, :, 0]
    perp, selection = complement_rows(Lambda), samples.selection(Lambda)
    angles = []
    for step in steps:
        moved = orthonormal_rows(Lambda + step.reshape(s, r - s) @ perp)
        angles.append(row_space_angle(samples.selection(moved), selection))
    return float(np.degrees(np.quantile(angles, quantile)))
