"""Linear algebra of constraint matrices, mostly by singular value decompositions.

Shapes: A (s, n), in general with s <= n, but no function here needs that.
"""

from __future__ import annotations

import functools
import math
import sys
from contextlib import AbstractContextManager
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from threadpoolctl import ThreadpoolController

Inverse = Literal["exact", "truncated", "damped"]
EPS = float(np.finfo(np.float64).eps)


@functools.cache
def unit(size: int) -> Float[np.ndarray, "n n"]:
    """Return the identity matrix, read-only and cached.

    Args:
        size: Number of rows n.

    Returns:
        shape (n, n).
    """
    matrix = np.eye(size)
    matrix.setflags(write=False)
    return matrix


def inverse_singular_values(
    sigma: Float[np.ndarray, " k"], shape: tuple[int, ...], inverse: Inverse = "exact"
) -> Float[np.ndarray, " k"]:
    """Return the inverse singular values 1/sigma of the pseudo-inverse A^+ = V diag(1/sigma) U^T, 0 for dropped ones.

    Args:
        sigma: Singular values (k,) of A, in descending order, in any unit.
        shape: Shape of A.
        inverse: `"exact"` inverts all singular values above the smallest normal floating-point number; `"truncated"`
            drops values below Matlab's tolerance max(size(A)) * eps(norm(A)), as the paper does.

    Returns:
        shape (k,), in the order of `sigma`.

    Raises:
        ValueError: `inverse` is another text.
    """
    out = np.zeros_like(sigma)
    if inverse == "truncated":
        keep = sigma > matlab_tolerance(sigma, shape)
    elif inverse == "exact":
        keep = sigma > np.finfo(np.float64).tiny
    else:
        raise ValueError(f"inverse must be 'exact' or 'truncated', got {inverse!r}")
    np.divide(1.0, sigma, out=out, where=keep)
    return out


def finite(values: object, *shape: int) -> np.ndarray | None:
    """Convert values to a float64 array of a given shape.

    Args:
        values: Value of any type.
        *shape: Expected shape; none for a scalar.

    Returns:
        The array; None if the values are not numbers, not finite, or of another shape.
    """
    try:
        array = np.array(values)
    except (TypeError, ValueError):
        return None
    if array.shape != shape or array.dtype.kind not in "iuf" or not np.all(np.isfinite(array)):
        return None
    return array.astype(np.float64)


def matlab_tolerance(sigma: Float[np.ndarray, " k"], shape: tuple[int, ...]) -> float:
    """Compute the tolerance of Matlab's pinv, max(size(A)) * eps(norm(A)).

    Args:
        sigma: Singular values (k,) of A, in any order.
        shape: Shape of A.

    Returns:
        Tolerance, in the unit of A.
    """
    return float(max(shape) * np.spacing(np.max(sigma, initial=0.0)))


def rank_of(sigma: Float[np.ndarray, " k"], shape: tuple[int, ...]) -> int:
    """Return the numerical rank: the number of singular values above Matlab's tolerance.

    Args:
        sigma: Singular values (k,) of A, in descending order.
        shape: Shape of A.
    """
    values = sigma.tolist()
    least = max(shape) * math.ulp(values[0]) if values else 0.0
    rank = len(values)
    while rank and not values[rank - 1] > least:
        rank -= 1
    return rank


def null_basis(A: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "n k"]:
    """Return an orthonormal basis Z of the null space of A, one column per dimension.

    Args:
        A: Matrix (s, n) of any rank, which is determined with Matlab's tolerance.

    Returns:
        shape (n, k), with orthonormal columns; k may be 0.
    """
    _, sigma, Vt = np.linalg.svd(A, full_matrices=True)
    return Vt[rank_of(sigma, A.shape) :].T


def orthonormal_rows(M: Float[np.ndarray, "*n s p"]) -> Float[np.ndarray, "*n s p"]:
    """Return the matrix with orthonormal rows that is closest to M and has the same row space (polar factor).

    Args:
        M: Matrix (s, p), or a stack of matrices (n, s, p), with independent rows.
    """
    U, _, Vt = np.linalg.svd(M, full_matrices=False)
    return U @ Vt


def pivoted_rows(M: Float[np.ndarray, "s p"]) -> Float[np.ndarray, "s p"]:
    """Return orthonormal rows that depend only on the row space of M, and not on rounding errors.

    The first row is the normalised projection of the coordinate axis nearest to the row space. The next row is found in
    the same way in the orthogonal complement of the first one, and so on (Gram-Schmidt with pivoting).

    Args:
        M: Matrix (s, p) with independent rows.

    Returns:
        shape (s, p).
    """
    rows = np.linalg.svd(M, full_matrices=False)[2]
    out, rest = np.zeros((0, M.shape[1])), rows.T @ rows
    for _ in M:
        sizes = np.round(np.diag(rest), 9)
        row = rest[int(np.argmax(sizes))]
        row = row - out.T @ (out @ row)
        out = np.concatenate([out, row[None] / np.linalg.norm(row)])
        rest = rest - np.outer(out[-1], out[-1])
    return out


def row_basis(M: Float[np.ndarray, "s p"]) -> Float[np.ndarray, "r p"]:
    """Return orthonormal rows that span the row space of M.

    Args:
        M: Matrix (s, p) of any rank, which is determined with Matlab's tolerance.

    Returns:
        shape (r, p) for a matrix of rank r.
    """
    _, sigma, Vt = np.linalg.svd(M, full_matrices=False)
    return Vt[: rank_of(sigma, M.shape)]


def complement_rows(M: Float[np.ndarray, "s p"]) -> Float[np.ndarray, "k p"]:
    """Return orthonormal rows that span the orthogonal complement of the row space of M.

    Args:
        M: Matrix (s, p) of any rank, which is determined with Matlab's tolerance.

    Returns:
        shape (k, p), with k = p minus the rank.
    """
    return null_basis(M).T


def whitener(S: Float[np.ndarray, "n n"], least: float = 1e-12) -> Float[np.ndarray, "r n"]:
    """Return a whitening matrix W, so that W S W^T = I, of a symmetric positive semidefinite matrix S.

    Args:
        S: Matrix (n, n): a sum of products, or a curvature; the unknowns may have different units.
        least: Smallest eigenvalue, relative to the largest one after scaling S to a unit diagonal, that is not a
            rounding error.

    Returns:
        shape (r, n), one row per eigenvalue that is not a rounding error; r may be 0.
    """
    size = np.sqrt(np.maximum(np.diag(S), 0.0))
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    values, vectors = np.linalg.eigh(scale[:, None] * S * scale)
    is_determined = values > least * np.max(values, initial=0.0)
    return (vectors[:, is_determined] / np.sqrt(values[is_determined])).T * scale


def row_space_angle(M1: Float[np.ndarray, "s p"], M2: Float[np.ndarray, "k p"]) -> float:
    """Return the largest principal angle between two row spaces [rad], accurate for tiny angles too.

    Args:
        M1: Matrix (s, p); dependent rows and zero rows are allowed and do not change the space.
        M2: Matrix (k, p) with the same number of columns.

    Returns:
        The angle [rad]; pi/2 if the dimensions differ, 0 if both spaces are empty.
    """
    Q1, Q2 = row_basis(M1), row_basis(M2)
    if Q1.shape != Q2.shape:
        return float(np.pi / 2)
    return float(row_space_angles(Q1[None], Q2)[0]) if len(Q1) else 0.0


def row_space_angles(stack: Float[np.ndarray, "n s p"], M: Float[np.ndarray, "s p"]) -> Float[np.ndarray, " n"]:
    """Return the largest principal angle between the row space of M and each row space of a stack [rad].

    Args:
        stack: Matrices (n, s, p) with independent rows.
        M: Matrix (s, p) with independent rows.

    Returns:
        shape (n,) [rad].
    """
    Q1, Q2 = np.linalg.qr(stack.transpose(0, 2, 1))[0].transpose(0, 2, 1), np.linalg.qr(M.T)[0].T
    shared = Q1 @ Q2.T
    cosines = np.linalg.svd(shared, compute_uv=False)
    # sines are accurate for small angles, cosines for angles near pi/2
    sines = np.linalg.svd(Q1 - shared @ Q2, compute_uv=False)
    return np.arctan2(sines[:, 0], cosines[:, -1])


def row_bases(
    columns: Float[np.ndarray, "nv s n"], size: int | None = None
) -> tuple[Float[np.ndarray, "nv k n"], Float[np.ndarray, "s s n"]]:
    """Compute bases of the row spaces of n matrices, by QR decompositions A_n^T = Q_n R_n.

    The index of the matrix is the last axis of all arrays. Householder reflections are vectorised over the matrices:
    for such small matrices, the overhead of separate LAPACK calls would exceed the arithmetic.

    Args:
        columns: Transposed matrices A_n^T (nv, s, n).
        size: Number k of columns of Q_n: s by default; nv adds the bases of the null spaces, at five times the cost.

    Returns:
        Q_n (nv, k, n) with orthonormal columns, and the upper triangular matrices R_n (s, s, n).
    """
    nv, s, n = columns.shape
    work = np.array(columns, order="C")
    reflections = []
    for j in range(min(s, nv)):
        v = work[j:, j].copy()
        norm = np.sqrt(np.sum(v * v, axis=0))
        v[0] += np.where(v[0] >= 0.0, norm, -norm)
        square = np.sum(v * v, axis=0)
        scaled = v * np.divide(2.0, square, out=np.zeros(n), where=square > 0.0)
        for k in range(j, s):
            work[j:, k] -= scaled * np.sum(v * work[j:, k], axis=0)
        reflections.append((v, scaled))
    Q = np.zeros((nv, s if size is None else size, n))
    for k in range(Q.shape[1]):
        Q[k, k] = 1.0
        for j in range(min(k, len(reflections) - 1), -1, -1):
            v, scaled = reflections[j]
            Q[j:, k] -= scaled * np.sum(v * Q[j:, k], axis=0)
    R = work[:s]
    return Q, R * np.triu(np.ones(R.shape[:2]))[:, :, None]


@functools.cache
def _libraries(with_scipy: bool) -> ThreadpoolController:
    # the search for loaded BLAS libraries takes milliseconds: run it once for NumPy's, and once more with SciPy's
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[Any]:
    """Return a context in which BLAS and LAPACK use one thread; at its end the previous number is restored.

    For matrices as small as a constraint's, a second thread costs more than it saves, and a different split of a sum
    changes its last digits. Libraries that are loaded inside the context are not limited: code that loads SciPy has to
    enter it again.
    """
    return _libraries("scipy.linalg" in sys.modules).limit(limits=1, user_api="blas")


def invert_triangles(work: Float[np.ndarray, "s s n"]) -> Float[np.ndarray, "s s n"]:
    """Invert n upper triangular matrices, whose index is the last axis, as `row_bases` returns them.

    Args:
        work: Upper triangular matrices R_n (s, s, n).

    Returns:
        The inverses (s, s, n); zeros for a singular matrix, so that its sample has no influence.
    """
    s = len(work)
    if s == 0:
        return np.zeros(work.shape)
    diagonal = np.abs(np.einsum("iin->in", work))
    usable = np.min(diagonal, axis=0) > 1e-9 * np.max(diagonal, axis=0)
    reciprocal = np.divide(1.0, np.einsum("iin->in", work), out=np.zeros(diagonal.shape), where=usable)
    out = np.zeros(work.shape)
    for j in range(s):
        out[j, j] = reciprocal[j]
        for i in range(j - 1, -1, -1):
            out[i, j] = -reciprocal[i] * np.sum(work[i, i + 1 : j + 1] * out[i + 1 : j + 1, j], axis=0)
    return out


def along_axes(rows: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "k p"]:
    """Return orthonormal rows of the same row space, each aligned with one coordinate axis as far as possible.

    Args:
        rows: Orthonormal rows (k, p).

    Returns:
        Rows (k, p), sorted by the axis of their largest entry, which is positive. The first row is aligned with the
        axis nearest to the row space, the next ones in the remaining space.
    """
    remaining, out = rows.copy(), []
    while remaining.shape[0]:
        # the unit axis with the largest share in the remaining space
        share = np.sum(remaining**2, axis=0)
        axis = int(np.argmax(share))
        direction = remaining[:, axis] / np.linalg.norm(remaining[:, axis])
        row = direction @ remaining
        # take the first of tied entries so that rounding cannot decide
        first = int(np.argmax(np.abs(row) > np.max(np.abs(row)) - 1e-6))
        out.append(row if row[first] > 0 else -row)
        remaining = null_basis(direction[None, :]).T @ remaining if remaining.shape[0] > 1 else remaining[:0]
    # sorted by the axis of the largest entry
    return np.array(sorted(out, key=lambda row: int(np.argmax(np.abs(row)))))


def manipulability_of(A: Float[np.ndarray, "s nv"]) -> float:
    """Compute the manipulability mu = sqrt(det(A A^T)), equation (4), as the product of the singular values.

    Args:
        A: Constraint matrix (s, nv).

    Returns:
        The manipulability mu; 0 if A has more rows than columns.
    """
    if A.shape[0] > A.shape[1]:
        return 0.0
    return float(np.prod(np.linalg.svd(A, compute_uv=False)))
