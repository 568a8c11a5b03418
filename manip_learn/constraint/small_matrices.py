"""Decompositions of one matrix as small as a constraint's, by LAPACK without NumPy's wrapping, which takes longer.

Apart from `linalg`, because SciPy takes as long to load as NumPy and Pinocchio together and most of learning needs none
of it.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dgesdd  # pyright: ignore[reportAttributeAccessIssue]

LEAST_SINGULAR_RATIO = 0.04  # smallest over largest singular value of A that is taken as well-conditioned


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
    """A^{+T}, the product of the singular values, and the smallest of them; None of an ill-conditioned A."""
    U, sigma, Vt = svd(A)
    if A.shape[0] > A.shape[1] or not sigma[-1] > LEAST_SINGULAR_RATIO * sigma[0]:
        return None
    return (U / sigma).dot(Vt[: len(sigma)]), math.prod(sigma.tolist()), float(sigma[-1])
