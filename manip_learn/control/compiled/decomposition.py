"""Singular value decomposition of small matrices, as loops over plain numbers."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.robot.batch.kernel_cache import compiled_inside

SWEEPS = 30  # of Jacobi rotations; six are usual
# cosine between two rows from which on they count as orthogonal: the rounding of their product
ORTHOGONAL = 2e-15


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
        for k in range(rows):
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
    """Fill the rows of a square Vt from `known` on, so that all of them are orthonormal."""
    n = Vt.shape[0]
    for i in range(known, n):
        best, most = 0, -1.0  # the unit vector that is farthest from the rows so far
        for j in range(n):
            rest = 1.0
            for c in range(i):
                rest -= Vt[c, j] * Vt[c, j]
            if rest > most:
                best, most = j, rest
        for k in range(n):
            Vt[i, k] = 1.0 if k == best else 0.0
        _orthonormal_row(Vt, i)


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

    Of two opposite vectors the one whose largest entry is positive.
    """
    rows, n = M.shape
    Ut, sigma, Vt = np.empty((rows, rows)), np.empty(rows), np.empty((rows, n))
    decompose(M, rows, Ut, sigma, Vt)
    largest = 0
    for k in range(n):
        if abs(Vt[0, k]) > abs(Vt[0, largest]):
            largest = k
    sign = -1.0 if Vt[0, largest] < 0.0 else 1.0
    for k in range(n):
        direction[k] = sign * Vt[0, k]
    return sigma[0]
