"""Decompositions of one matrix as small as a constraint's, by LAPACK without NumPy's wrapping, which takes longer.

Apart from `linalg`, because SciPy takes as long to load as NumPy and Pinocchio together and most of learning needs none
of it.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dgesdd, dposv, dsyev  # pyright: ignore[reportAttributeAccessIssue]

LEAST_SINGULAR_RATIO = 0.04  # smallest over largest singular value of A for which A A^T may be inverted


def svd(
    A: Float[np.ndarray, "s n"],
) -> tuple[Float[np.ndarray, "s s"], Float[np.ndarray, " k"], Float[np.ndarray, "n n"]]:
    """U, the singular values, and V^T, all square: LAPACK's dgesdd without NumPy's wrapping, which takes longer than
    the decomposition of a matrix as small as a constraint's.
    """
    U, sigma, Vt, failed = dgesdd(A)
    if failed:
        return np.linalg.svd(A, full_matrices=True)
    return U, sigma, Vt


def row_inverse(A: Float[np.ndarray, "s n"]) -> tuple[Float[np.ndarray, "s n"], float, float] | None:
    """A^{+T} = (A A^T)^-1 A, by Cholesky's factors of A A^T, in half the time of a singular value decomposition.

    With it come the volume sqrt(det(A A^T)), which is the product of the singular values, and the smallest of them.
    None if A is too ill-conditioned: errors grow with the square of its condition number here, so that 1e-12 holds up
    to a condition number of 1 / LEAST_SINGULAR_RATIO only. The rest needs the singular value decomposition.
    """
    s = A.shape[0]
    if s > A.shape[1]:
        return None
    G = A.dot(A.T)
    if s == 2:  # in plain numbers, faster than LAPACK's calls
        (a, b), (_, c) = G.tolist()
        square, largest = a * c - b * b, 0.5 * (a + c) + math.hypot(0.5 * (a - c), b)
        # the smallest eigenvalue is the quotient, not the difference, which cancels
        if not square > LEAST_SINGULAR_RATIO**2 * largest * largest:
            return None
        inverse = np.array(((c / square, -b / square), (-b / square, a / square)))
        return inverse.dot(A), math.sqrt(square), math.sqrt(square / largest)
    L, X, failed = dposv(G, A)
    if failed:
        return None
    volume = math.prod(L.diagonal().tolist())
    if s == 1:
        return X, volume, volume
    values, _, failed = dsyev(G, compute_v=0)
    smallest, largest = float(values[0]), float(values[-1])
    if failed or not smallest > LEAST_SINGULAR_RATIO**2 * largest:
        return None
    return X, volume, math.sqrt(smallest)
