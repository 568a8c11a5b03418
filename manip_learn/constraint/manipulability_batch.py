"""Manipulability and its gradient at many postures; the numbers of `manipulability_measure`, in bulk.

Away from singularities mu is the volume spanned by the rows of A, read off the triangle of an orthogonalisation of the
rows, and grad mu = mu A^{+T} : dA/dq from the same triangle: errors grow with the condition number of A only. (A Gram
determinant loses twice the digits.) Postures where that would cost more than three digits go through the singular
value decomposition.
"""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability import constraint_first, gradient_of
from manip_learn.linalg import inverse_triangles_beside, row_bases
from manip_learn.robot.batch.postures import checked_postures

GRADIENT_CHUNK = 512  # postures whose dA/dq are held at a time
LEAST_LENGTH_RATIO = 1e-3  # shortest orthogonalised row over longest row of A; below it the SVD takes over


@final
class ManipulabilityBatch(NamedTuple):
    """mu and its gradient at n postures.

    Attributes:
        mu: shape (n,).
        gradient: shape (n, nv), finite; at singularities the steepest ascent, see `manipulability_gradient`.
        floor: shape (n,), the mu below which a singularity cannot be told from rounding; 0 where that is far away.
    """

    mu: Float[np.ndarray, " n"]
    gradient: Float[np.ndarray, "n nv"]
    floor: Float[np.ndarray, " n"]

    @property
    def log_gradient(self) -> Float[np.ndarray, "n nv"]:
        """Gradient of log mu, see `log_manipulability_gradient`."""
        return self.gradient / np.maximum(np.maximum(self.mu, self.floor), np.finfo(np.float64).tiny)[:, None]


def manipulability_batch(constraint: Constraint, q: ArrayLike) -> ManipulabilityBatch:
    """mu(q) and its gradient at n postures, the rows of q.

    Args:
        constraint: A(q).
        q: Configurations (nq) or joint positions (nv), one per row.

    Raises:
        ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        ConstraintError: The arguments are in another order.
    """
    features = constraint_first(constraint, q).features
    postures = np.asarray(q, dtype=np.float64)
    if constraint.robot is not None:
        checked_postures(constraint.robot, postures)  # here, where a row's number is that of the caller
    n, s, nv = len(postures), constraint.n_constraints, constraint.nv
    out = ManipulabilityBatch(np.zeros(n), np.zeros((n, nv)), np.zeros(n))
    for start in range(0, n if s <= nv else 0, GRADIENT_CHUNK):
        part = slice(start, start + GRADIENT_CHUNK)
        Phi, dPhi = features.batch_with_derivative(postures[part])
        A = constraint.selection @ Phi
        X, out.mu[part], is_ill = row_inverses(A.transpose(1, 2, 0))
        weights = np.tensordot(constraint.selection.T, X * out.mu[part], axes=1)
        out.gradient[part] = np.einsum("ijn,nijk->nk", weights, dPhi)
        for i in np.flatnonzero(is_ill):
            dA = np.tensordot(constraint.selection, dPhi[i], axes=1)
            out.mu[start + i], out.gradient[start + i], out.floor[start + i] = gradient_of(A[i], dA)
    return out


def row_inverses(
    A: Float[np.ndarray, "s nv n"],
) -> tuple[Float[np.ndarray, "s nv n"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return A^{+T}, mu, and whether they are too inaccurate to use, postures last.

    With A^T = Q R: mu = |prod R_ii| and A^{+T} = R^{-1} Q^T.
    """
    Q, R = row_bases(A.transpose(1, 0, 2))
    lengths = np.abs(np.einsum("iin->in", R))
    ill = ~(lengths.min(axis=0) > LEAST_LENGTH_RATIO * np.sqrt(np.max(np.sum(A * A, axis=1), axis=0)))
    return np.einsum("ijn,kjn->ikn", inverse_triangles_beside(R), Q), np.prod(lengths, axis=0), ill
