"""A reference: Lambda row by row in spherical coordinates, after Lin, Howard and Vijayakumar (2015).

Each new row is the unit vector, orthogonal to the rows before, that lowers equation (10) of the rows so far most; its
spherical angles are found by Levenberg-Marquardt from several starts. It is here for comparison with
`learning.estimators.null_space.fit_null_space`, which moves all rows at once.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from manip_learn.learning.samples import Samples
from manip_learn.linalg import batch_row_spaces, complement_rows

STARTS_AN_ANGLE = 3
TOLERANCE = 1e-15


def fit_row_by_row(samples: Samples, n_rows: int) -> Float[np.ndarray, "s r"]:
    """Lambda in whitened coordinates, one row after the other.

    Args:
        samples: The velocities of these samples are null-space motion.
        n_rows: Number of rows s.
    """
    Phi = np.concatenate([block.Phi for block in samples.blocks()])
    w = samples.u
    Lambda = np.zeros((0, samples.n_rows))
    for _ in range(n_rows):
        # the new row lives in the complement of the others: a unit vector there is a point on a smaller sphere
        frame = complement_rows(Lambda) if len(Lambda) else np.eye(samples.n_rows)
        Lambda = np.concatenate([Lambda, _best_row(_beside(Phi, Lambda), w, frame)[None]])
    return Lambda


def unit_vector(angles: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k+1"]:
    """The point of the unit sphere with these spherical angles [rad]."""
    sines = np.concatenate([[1.0], np.cumprod(np.sin(angles))])
    return sines * np.append(np.cos(angles), 1.0)


def _best_row(Phi: np.ndarray, w: np.ndarray, frame: np.ndarray) -> Float[np.ndarray, " r"]:
    k = len(frame) - 1
    if k == 0:
        return frame[0]
    rows = np.einsum("kr,nrv->nkv", frame, Phi, optimize=True)

    def residuals(angles: np.ndarray) -> np.ndarray:
        # what the new row adds to |A^+ A w|^2: the part of w along the row, beside the rows before
        a = np.einsum("k,nkv->nv", unit_vector(angles), rows)
        return np.einsum("nv,nv->n", a, w) / np.linalg.norm(a, axis=1)

    fits = [
        least_squares(residuals, start, method="lm", xtol=TOLERANCE, ftol=TOLERANCE, gtol=TOLERANCE)
        for start in _starts(k)
    ]
    best = min(fits, key=lambda fit: fit.cost)
    return unit_vector(best.x) @ frame


def _beside(Phi: np.ndarray, Lambda: np.ndarray) -> Float[np.ndarray, "n r v"]:
    """Phi N: what is left of each row of Phi in the null space of the rows so far."""
    s = len(Lambda)
    if s == 0:
        return Phi
    Q, _ = batch_row_spaces(np.einsum("sr,nrv->nsv", Lambda, Phi, optimize=True))
    along = Q[:, :, :s]
    return Phi - np.einsum("nrv,nvs,nws->nrw", Phi, along, along, optimize=True)


def _starts(k: int) -> list[np.ndarray]:
    """Angles spread over the half sphere: a grid where it is small, its diagonals where it is not."""
    values = np.pi * (np.arange(STARTS_AN_ANGLE) + 0.5) / STARTS_AN_ANGLE
    if k <= 2:
        return [np.array(point) for point in np.stack(np.meshgrid(*[values] * k), -1).reshape(-1, k)]
    return [np.roll(np.resize(values, k), shift) for shift in range(STARTS_AN_ANGLE)]
