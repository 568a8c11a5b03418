"""Singular value decomposition of small matrices, as loops over plain numbers."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.robot.batch.kernel_cache import compiled_inside

SWEEPS = 30  # of Jacobi rotations; six are usual
# cosine between two rows from which on they count as orthogonal: the rounding of their product
ORTHOGONAL = 2e-15
SQUARINGS = 40  # of a Gram matrix; eight are usual
RANK_ONE = 4e-16  # share of the square of a Gram matrix that is not of rank one any more


@compiled_inside
def decompose(A, rows, Ut, sigma, Vt):
    """A = sum_i sigma_i u_i v_i^T, u_i and v_i in the rows of Ut and the first `rows` rows of Vt, largest first.

    One-sided Jacobi rotations (Hestenes, "Inversion of matrices by biorthogonalization and related results", 1958):
    accurate for tiny singular values too. Where one is exactly 0, its row of Vt is zero.

    Args:
        A: shape (rows, columns).
        rows: Number of rows.
        Ut: shape (rows, rows).
        sigma: shape (rows,).
        Vt: shape (rows or more, columns).
    """
    for i in range(rows):
        for k in range(A.shape[1]):
            Vt[i, k] = A[i, k]
        for k in range(Ut.shape[1]):
            Ut[i, k] = 1.0 if i == k else 0.0
    for _ in range(SWEEPS):
        turned = False
        for i in range(rows - 1):
            for j in range(i + 1, rows):
                turned = _orthogonalise(Vt, Ut, i, j) or turned
        if not turned:
            break
    for i in range(rows):
        square = 0.0
        for k in range(A.shape[1]):
            square += Vt[i, k] * Vt[i, k]
        sigma[i] = math.sqrt(square)
    _sort(rows, Ut, sigma, Vt)
    for i in range(rows):
        factor = 1.0 / sigma[i] if sigma[i] > 0.0 else 0.0
        for k in range(A.shape[1]):
            Vt[i, k] *= factor


@compiled_inside
def _orthogonalise(Vt, Ut, i, j):
    """Turn two rows until they are orthogonal; False if they are."""
    a = b = c = 0.0
    for k in range(Vt.shape[1]):
        x, y = Vt[i, k], Vt[j, k]
        a += x * x
        b += y * y
        c += x * y
    if abs(c) <= ORTHOGONAL * math.sqrt(a) * math.sqrt(b):
        return False
    zeta = 0.5 * (b - a) / c
    t = math.copysign(1.0, zeta) / (abs(zeta) + math.hypot(1.0, zeta))
    cosine = 1.0 / math.sqrt(1.0 + t * t)
    sine = cosine * t
    for k in range(Vt.shape[1]):
        x, y = Vt[i, k], Vt[j, k]
        Vt[i, k], Vt[j, k] = cosine * x - sine * y, sine * x + cosine * y
    for k in range(Ut.shape[1]):
        x, y = Ut[i, k], Ut[j, k]
        Ut[i, k], Ut[j, k] = cosine * x - sine * y, sine * x + cosine * y
    return True


@compiled_inside
def _sort(rows, Ut, sigma, Vt):
    for i in range(rows - 1):
        best = i
        for j in range(i + 1, rows):
            if sigma[j] > sigma[best]:
                best = j
        if best != i:
            sigma[i], sigma[best] = sigma[best], sigma[i]
            for k in range(Vt.shape[1]):
                Vt[i, k], Vt[best, k] = Vt[best, k], Vt[i, k]
            for k in range(rows):
                Ut[i, k], Ut[best, k] = Ut[best, k], Ut[i, k]


@compiled_inside
def complete(Vt, known):
    """Fill the rows of a square Vt from `known` on, so that all of them are orthonormal, by Householder reflections."""
    n = Vt.shape[0]
    mirrors = Vt[:known].copy()
    for i in range(known):
        x, square = mirrors[i], 0.0
        for k in range(i, n):
            square += x[k] * x[k]
        length = math.sqrt(square)
        # x - alpha e_i with the sign that does not cancel, to the length of the root of 2
        factor = 1.0 / math.sqrt(length * (length + abs(x[i])))
        x[i] += math.copysign(length, x[i])
        for k in range(i, n):
            x[k] *= factor
        for j in range(i + 1, known):
            _reflect(x, mirrors[j], i)
    for j in range(known, n):
        for k in range(n):
            Vt[j, k] = 1.0 if k == j else 0.0
        for i in range(known - 1, -1, -1):
            _reflect(mirrors[i], Vt[j], i)


@compiled_inside
def _reflect(mirror, y, first):
    """y - m (m^T y), m of the length root of 2, zero before its entry `first`."""
    along = 0.0
    for k in range(first, y.shape[0]):
        along += mirror[k] * y[k]
    for k in range(first, y.shape[0]):
        y[k] -= along * mirror[k]


@compiled_inside
def row_space(A, rows, Vt):
    """Orthonormal rows that span those of a well-conditioned A, into the first rows of Vt."""
    for i in range(rows):
        for k in range(A.shape[1]):
            Vt[i, k] = A[i, k]
        _orthonormal_row(Vt, i)


@compiled_inside
def _orthonormal_row(Vt, i):
    """Row i less its parts along the rows before it (twice is enough), with length 1."""
    for _ in range(2):
        for c in range(i):
            along = 0.0
            for k in range(Vt.shape[1]):
                along += Vt[c, k] * Vt[i, k]
            for k in range(Vt.shape[1]):
                Vt[i, k] -= along * Vt[c, k]
    square = 0.0
    for k in range(Vt.shape[1]):
        square += Vt[i, k] * Vt[i, k]
    factor = 1.0 / math.sqrt(square)
    for k in range(Vt.shape[1]):
        Vt[i, k] *= factor


@compiled_inside
def leading(M, direction):
    """Largest singular value of M (rows, columns); its right singular vector goes into `direction`, one sign of it.

    Of two opposite vectors the one whose largest entry is positive. M^T M is squared until it is of rank one, so that
    its columns are multiples of the vector.
    """
    n = M.shape[1]
    G, H = np.empty((n, n)), np.empty((n, n))
    _gram(M, G)
    for _ in range(SQUARINGS):
        trace, best = 0.0, 0
        for i in range(n):
            trace += G[i, i]
            best = i if G[i, i] > G[best, best] else best
        if not trace > 0.0:
            direction[:] = 0.0
            return 0.0
        square, factor = 0.0, 1.0 / trace
        for i in range(n):
            for j in range(n):
                G[i, j] *= factor
                square += G[i, j] * G[i, j]
        if square > 1.0 - RANK_ONE:
            break
        _gram(G, H)
        G, H = H, G
    return _image(M, G[best], direction)


@compiled_inside
def _gram(M, G):
    """G = M^T M."""
    n = M.shape[1]
    G[:] = 0.0
    for r in range(M.shape[0]):
        for i in range(n):
            for j in range(n):
                G[i, j] += M[r, i] * M[r, j]


@compiled_inside
def _image(M, vector, direction):
    """|M x| for x = vector / |vector|, which goes into `direction` with its largest entry positive."""
    n, square, largest = M.shape[1], 0.0, 0
    for k in range(n):
        square += vector[k] * vector[k]
        largest = k if abs(vector[k]) > abs(vector[largest]) else largest
    factor = math.copysign(1.0 / math.sqrt(square), vector[largest])
    for k in range(n):
        direction[k] = factor * vector[k]
    square = 0.0
    for r in range(M.shape[0]):
        along = 0.0
        for k in range(n):
            along += M[r, k] * direction[k]
        square += along * along
    return math.sqrt(square)
