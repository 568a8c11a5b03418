"""Published learners of constraints, written anew from their papers, for comparison on the same recordings.

- Row by row in spherical angles (Lin, Howard and Vijayakumar, 2015): `row_by_row.fit_row_by_row`, from the null-space
  part of the motion, which the separation of Towell, Howard and Vijayakumar (2010) comes before.
- Closed form (Armesto, Bosga, Ivan and Vijayakumar, Efficient Learning of Constraints and Generic Null Space Policies,
  2017; Armesto, Moura, Ivan, Erden, Sala and Vijayakumar, Constraint-aware learning of policies by demonstration,
  2018): A(q) u - b(q) = 0 is linear in the parameters of A and b, so that they are the left singular vectors of the
  stacked regressors with the smallest singular values. Here A = Lambda Phi, and b is told to be W (r* - r(q)) with an
  unknown target r* of each trajectory; or b = 0.
- Line or plane through the tip's places (the kinematic part of Subramani, Zinn and Gleicher, Inferring geometric
  constraints in human demonstrations, 2018; what practitioners do): principal axes of the places about each
  trajectory's mean. Only for b = 0 and translational rows in the base frame.

All are told the number of rows.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.linalg import orthonormal_rows


def closed_form(
    task_velocity: Float[np.ndarray, "g T p"], place: Float[np.ndarray, "g T p"], n_rows: int
) -> Float[np.ndarray, "s p"]:
    """Lambda from Lambda Phi u = W (r* - r), r* unknown and constant in a trajectory (Armesto et al., 2017 and 2018).

    Within a trajectory Lambda Phi u + W r is constant, so that (Lambda, W) has no product with the centred (Phi u, r):
    its rows are the left singular vectors of these with the smallest singular values.

    Args:
        task_velocity: Phi u of each sample.
        place: r of each sample, the coordinates whose rate is Phi u.
        n_rows: Number of rows s.
    """
    stacked = np.concatenate([task_velocity, place], axis=2)
    centred = (stacked - stacked.mean(axis=1, keepdims=True)).reshape(-1, stacked.shape[2])
    scale = np.sqrt(np.mean(centred**2, axis=0)) + np.finfo(np.float64).tiny
    rows = np.linalg.svd(centred / scale, full_matrices=False)[2][-n_rows:] / scale
    return orthonormal_rows(rows[:, : task_velocity.shape[2]])


def closed_form_held(task_velocity: Float[np.ndarray, "n p"], n_rows: int) -> Float[np.ndarray, "s p"]:
    """Lambda from Lambda Phi u = 0: the same with b = 0, the smallest left singular vectors of Phi u."""
    return np.linalg.svd(task_velocity, full_matrices=False)[2][-n_rows:]


def fit_places(places: list[np.ndarray], n_rows: int) -> Float[np.ndarray, "s p"]:
    """Rows across the line (s = p - 1) or the plane (s = p - 2) that the tip's places lie on, total least squares.

    Args:
        places: Of each trajectory, shape (T, p); they may lie on parallel lines or planes.
        n_rows: Number of rows s.
    """
    centred = np.concatenate([r - r.mean(axis=0) for r in places])
    return np.linalg.svd(centred, full_matrices=False)[2][-n_rows:]
