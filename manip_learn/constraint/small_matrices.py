"""Products and decompositions of one matrix as small as a constraint's, without NumPy's wrapping, which takes longer.

What the control law is written in: `compiled_matrices` has the same for its compiled form. Apart from `linalg`, because
SciPy takes as long to load as NumPy and Pinocchio together and most of learning needs none of it.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dgesdd, dposv, dsyev  # pyright: ignore[reportAttributeAccessIssue]

dot = np.ndarray.dot
put = np.copyto
LEAST_SINGULAR_RATIO = 0.04  # smallest over largest singular value of A for which A A^T may be inverted


@cache
def unit(size: int) -> Float[np.ndarray, "n n"]:
    """The unit matrix, not to be written to."""
    matrix = np.eye(size)
    matrix.setflags(write=False)
    return matrix


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


def leading(M: Float[np.ndarray, "r n"]) -> tuple[float, Float[np.ndarray, " n"]]:
    """Largest singular value, and its right singular vector: of the two the one whose largest entry is positive."""
    squares, vectors, failed = dsyev(dot(M.T, M))
    direction = vectors[:, -1] if not failed else svd(M)[2][0]
    values = direction.tolist()
    image = dot(M, direction)
    return math.sqrt(dot(image, image)), -direction if max(values) < -min(values) else direction


def row_inverse(A: Float[np.ndarray, "s n"]) -> tuple[Float[np.ndarray, "s n"], float, float]:
    """A^{+T} = (A A^T)^-1 A, by Cholesky's factors of A A^T, in half the time of a singular value decomposition.

    With it come the volume sqrt(det(A A^T)), which is the product of the singular values, and the smallest of them.
    Both are 0, and the matrix means nothing, if A is too ill-conditioned: errors grow with the square of its condition
    number here, so that 1e-12 holds up to a condition number of 1 / LEAST_SINGULAR_RATIO only. The rest needs the
    singular value decomposition.
    """
    s = A.shape[0]
    if s > A.shape[1]:
        return A, 0.0, 0.0
    G = A.dot(A.T)
    if s == 2:  # in plain numbers, faster than LAPACK's calls
        (a, b), (_, c) = G.tolist()
        square, largest = a * c - b * b, 0.5 * (a + c) + math.hypot(0.5 * (a - c), b)
        # the smallest eigenvalue is the quotient, not the difference, which cancels
        if not square > LEAST_SINGULAR_RATIO**2 * largest * largest:
            return A, 0.0, 0.0
        inverse = np.array(((c / square, -b / square), (-b / square, a / square)))
        return inverse.dot(A), math.sqrt(square), math.sqrt(square / largest)
    L, X, failed = dposv(G, A)
    if failed:
        return A, 0.0, 0.0
    volume = math.prod(L.diagonal().tolist())
    if s == 1:
        return X, volume, volume
    values, _, failed = dsyev(G, compute_v=0)
    smallest, largest = float(values[0]), float(values[-1])
    if failed or not smallest > LEAST_SINGULAR_RATIO**2 * largest:
        return A, 0.0, 0.0
    return X, volume, math.sqrt(smallest)


def complement(A: Float[np.ndarray, "s n"], X: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "k n"]:
    """N = I - A^+ A from X = A^{+T}; where compiled, Z^T with Z Z^T = N: fewer rows, but more work in NumPy."""
    return unit(A.shape[1]) - dot(A.T, X)
