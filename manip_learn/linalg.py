"""Linear algebra of constraint matrices, all from one singular value decomposition.

Shapes: A (s, n) with s <= n in general, but nothing here needs it.
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
    """The unit matrix, not to be written to."""
    matrix = np.eye(size)
    matrix.setflags(write=False)
    return matrix


def inverse_singular_values(
    sigma: Float[np.ndarray, " k"], shape: tuple[int, ...], inverse: Inverse = "exact"
) -> Float[np.ndarray, " k"]:
    """1/sigma in the chosen sense, so that A^+ = V diag(1/sigma) U^T.

    Args:
        sigma: Singular values of A, in falling order.
        shape: Of A.
        inverse: `"exact"` inverts every singular value above the smallest normal number, however small;
            `"truncated"` drops those below Matlab's tolerance max(size(A)) * eps(norm(A)), as the paper does.
    """
    out = np.zeros_like(sigma)
    if inverse == "truncated":
        keep = sigma > matlab_tolerance(sigma, shape)
    elif inverse == "exact":
        keep = sigma > np.finfo(np.float64).tiny
    else:
        raise ValueError(f"inverse must be 'exact' or 'truncated', not {inverse!r}")
    np.divide(1.0, sigma, out=out, where=keep)
    return out


def finite(values: object, *shape: int) -> np.ndarray | None:
    """The values as a float64 array of that shape; None if they are no numbers, not finite, or of another shape."""
    try:
        array = np.array(values)
    except (TypeError, ValueError):
        return None
    if array.shape != shape or array.dtype.kind not in "iuf" or not np.all(np.isfinite(array)):
        return None
    return array.astype(np.float64)


def matlab_tolerance(sigma: Float[np.ndarray, " k"], shape: tuple[int, ...]) -> float:
    """Matlab's pinv tolerance max(size(A)) * eps(norm(A))."""
    return float(max(shape) * np.spacing(np.max(sigma, initial=0.0)))


def rank_of(sigma: Float[np.ndarray, " k"], shape: tuple[int, ...]) -> int:
    """Number of singular values, in falling order, above Matlab's tolerance."""
    values = sigma.tolist()
    least = max(shape) * math.ulp(values[0]) if values else 0.0
    rank = len(values)
    while rank and not values[rank - 1] > least:
        rank -= 1
    return rank


def null_basis(A: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "n k"]:
    """Orthonormal basis Z of the null space of A (numerical rank by Matlab's tolerance)."""
    _, sigma, Vt = np.linalg.svd(A, full_matrices=True)
    return Vt[rank_of(sigma, A.shape) :].T


def orthonormal_rows(M: Float[np.ndarray, "*n s p"]) -> Float[np.ndarray, "*n s p"]:
    """Return the matrix with orthonormal rows closest to M (polar factor), of each matrix of a stack.

    It keeps the row space, and the rows where it can. The rows of M must be independent.
    """
    U, _, Vt = np.linalg.svd(M, full_matrices=False)
    return U @ Vt


def pivoted_rows(M: Float[np.ndarray, "s p"]) -> Float[np.ndarray, "s p"]:
    """Return orthonormal rows that depend on nothing but the row space of M, on any machine.

    The first is the projection of the axis that lies nearest to the row space, the next that of the axis that lies
    nearest to what is left, and so on (Gram and Schmidt with pivoting). The rows of M must be independent.
    """
    rows = np.linalg.svd(M, full_matrices=False)[2]
    out, left = np.zeros((0, M.shape[1])), rows.T @ rows
    for _ in M:
        sizes = np.round(np.diag(left), 9)
        row = left[int(np.argmax(sizes))]
        row = row - out.T @ (out @ row)
        out = np.concatenate([out, row[None] / np.linalg.norm(row)])
        left = left - np.outer(out[-1], out[-1])
    return out


def row_basis(M: Float[np.ndarray, "s p"]) -> Float[np.ndarray, "r p"]:
    """Orthonormal rows that span the row space of M (numerical rank by Matlab's tolerance)."""
    _, sigma, Vt = np.linalg.svd(M, full_matrices=False)
    return Vt[: rank_of(sigma, M.shape)]


def complement_rows(M: Float[np.ndarray, "s p"]) -> Float[np.ndarray, "k p"]:
    """Orthonormal rows that span the orthogonal complement of the row space of M."""
    return null_basis(M).T


def whitener(S: Float[np.ndarray, "n n"], least: float = 1e-12) -> Float[np.ndarray, "r n"]:
    """W with W S W^T = I over what a symmetric S >= 0 determines; no rows if that is nothing.

    Args:
        S: Sum of products, or curvature; the unknowns may be in different units.
        least: Eigenvalue over the largest, each unknown scaled to its own size, below which a direction is rounding.
    """
    size = np.sqrt(np.maximum(np.diag(S), 0.0))
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    values, vectors = np.linalg.eigh(scale[:, None] * S * scale)
    kept = values > least * np.max(values, initial=0.0)
    return (vectors[:, kept] / np.sqrt(values[kept])).T * scale


def row_space_angle(M1: Float[np.ndarray, "s p"], M2: Float[np.ndarray, "k p"]) -> float:
    """Largest principal angle [rad] between two row spaces, accurate for tiny angles too; pi/2 if dimensions differ.

    Rows may depend on each other or be zero: they add nothing to the space.
    """
    Q1, Q2 = row_basis(M1), row_basis(M2)
    if Q1.shape != Q2.shape:
        return float(np.pi / 2)
    return float(row_space_angles(Q1[None], Q2)[0]) if len(Q1) else 0.0


def row_space_angles(stack: Float[np.ndarray, "n s p"], M: Float[np.ndarray, "s p"]) -> Float[np.ndarray, " n"]:
    """Largest principal angle [rad] between the row space of M and each of a stack; all rows must be independent."""
    Q1, Q2 = np.linalg.qr(stack.transpose(0, 2, 1))[0].transpose(0, 2, 1), np.linalg.qr(M.T)[0].T
    shared = Q1 @ Q2.T
    cosines = np.linalg.svd(shared, compute_uv=False)
    # both together are accurate for tiny angles and for right ones
    sines = np.linalg.svd(Q1 - shared @ Q2, compute_uv=False)
    return np.arctan2(sines[:, 0], cosines[:, -1])


def batch_row_spaces(A: Float[np.ndarray, "n s nv"]) -> tuple[Float[np.ndarray, "n nv nv"], Float[np.ndarray, "n s s"]]:
    """A_n^T = Q_n[:, :s] R_n for a stack of matrices, see `row_bases`: bases of row and null spaces.

    The null basis is Z_n = Q_n[:, s:], the pseudo-inverse A_n^+ = Q_n[:, :s] R_n^{-T}.
    """
    Q, R = row_bases(A.transpose(2, 1, 0), A.shape[2])
    return np.ascontiguousarray(Q.transpose(2, 0, 1)), np.ascontiguousarray(R.transpose(2, 0, 1))


def row_bases(
    columns: Float[np.ndarray, "nv s n"], size: int | None = None
) -> tuple[Float[np.ndarray, "nv k n"], Float[np.ndarray, "s s n"]]:
    """A_n^T = Q_n R_n with the matrices side by side in the last axis: bases of the row spaces.

    By Householder reflections, vectorised over the matrices, where a LAPACK call for each would cost more in calls than
    in arithmetic.

    Args:
        columns: A_n^T.
        size: Number of columns of Q_n: s by default; nv for the null bases behind them, at five times the cost.
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
    # looking for the loaded BLAS libraries takes milliseconds: once for NumPy's, and once more when SciPy's is there
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[Any]:
    """A context in which BLAS and LAPACK use one thread; the number set before is restored at its end.

    On matrices as small as a constraint's a second thread costs more than it brings, and sums that are split
    differently differ in their last digits. What is loaded within it is not limited: what loads SciPy enters it again.
    """
    return _libraries("scipy.linalg" in sys.modules).limit(limits=1, user_api="blas")


def inverse_triangles_beside(work: Float[np.ndarray, "s s n"]) -> Float[np.ndarray, "s s n"]:
    """Inverses of upper triangles that lie side by side in the last axis, as `row_bases` has them.

    Zero where a sample's constraint loses rank, so that it has no say.
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
    """Orthonormal rows of the same space, turned towards single axes one after the other, largest first."""
    remaining, out = rows.copy(), []
    while remaining.shape[0]:
        # the unit axis that lies deepest in what remains
        share = np.sum(remaining**2, axis=0)
        axis = int(np.argmax(share))
        direction = remaining[:, axis] / np.linalg.norm(remaining[:, axis])
        row = direction @ remaining
        # the first of the largest entries, of which rounding does not decide
        first = int(np.argmax(np.abs(row) > np.max(np.abs(row)) - 1e-6))
        out.append(row if row[first] > 0 else -row)
        remaining = null_basis(direction[None, :]).T @ remaining if remaining.shape[0] > 1 else remaining[:0]
    # in the order of the axes that they point along most
    return np.array(sorted(out, key=lambda row: int(np.argmax(np.abs(row)))))


def manipulability_of(A: Float[np.ndarray, "s nv"]) -> float:
    """mu of a constraint matrix; 0 if it has more rows than columns."""
    if A.shape[0] > A.shape[1]:
        return 0.0
    return float(np.prod(np.linalg.svd(A, compute_uv=False)))
