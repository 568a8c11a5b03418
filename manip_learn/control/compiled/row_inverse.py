"""`small_matrices.row_inverse` as loops over plain numbers, for few rows; compiled where numba is installed."""

from __future__ import annotations

import math

from manip_learn.constraint.small_matrices import LEAST_SINGULAR_RATIO
from manip_learn.robot.batch.kernel_cache import compiled_inside

SWEEPS = 8  # of Jacobi rotations: converged to the last bit for six rows
NEGLIGIBLE = 1e-32  # square of a cosine between two rows that no longer changes the eigenvalues


@compiled_inside
def smallest_and_largest(G, L):
    """Smallest and largest eigenvalue of a symmetric matrix G (s, s), with Cholesky's factor L; G is destroyed."""
    s = G.shape[0]
    if s == 1:
        return G[0, 0], G[0, 0]
    if s == 2:
        largest = 0.5 * (G[0, 0] + G[1, 1]) + math.hypot(0.5 * (G[0, 0] - G[1, 1]), G[0, 1])
        volume = L[0, 0] * L[1, 1]
        return volume * volume / largest, largest
    for _ in range(SWEEPS):
        turned = False
        for i in range(s - 1):
            for j in range(i + 1, s):
                if G[i, j] * G[i, j] > NEGLIGIBLE * G[i, i] * G[j, j]:
                    turned = True
                    theta = 0.5 * (G[j, j] - G[i, i]) / G[i, j]
                    t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
                    c = 1.0 / math.sqrt(t * t + 1.0)
                    d = t * c
                    for k in range(s):
                        G[k, i], G[k, j] = c * G[k, i] - d * G[k, j], d * G[k, i] + c * G[k, j]
                    for k in range(s):
                        G[i, k], G[j, k] = c * G[i, k] - d * G[j, k], d * G[i, k] + c * G[j, k]
        if not turned:
            break
    smallest = largest = G[0, 0]
    for i in range(1, s):
        smallest, largest = min(smallest, G[i, i]), max(largest, G[i, i])
    return smallest, largest


@compiled_inside
def row_inverse(A, X, G, L):
    """X = A^{+T} (s, n); returns the volume and the smallest singular value, or zeros if A is ill-conditioned."""
    s, n = A.shape
    for i in range(s):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += A[i, k] * A[j, k]
            G[i, j] = G[j, i] = total
    volume = 1.0
    for i in range(s):
        for j in range(i + 1):
            total = G[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = total / L[j, j]
            elif total > 0.0:
                L[i, i] = math.sqrt(total)
                volume *= L[i, i]
            else:
                return 0.0, 0.0
    smallest, largest = smallest_and_largest(G, L)
    if not smallest > LEAST_SINGULAR_RATIO * LEAST_SINGULAR_RATIO * largest:
        return 0.0, 0.0
    for i in range(s):
        for k in range(n):
            X[i, k] = A[i, k]
        for j in range(i):
            for k in range(n):
                X[i, k] -= L[i, j] * X[j, k]
        factor = 1.0 / L[i, i]
        for k in range(n):
            X[i, k] *= factor
    for i in range(s - 1, -1, -1):
        for j in range(i + 1, s):
            for k in range(n):
                X[i, k] -= L[j, i] * X[j, k]
        factor = 1.0 / L[i, i]
        for k in range(n):
            X[i, k] *= factor
    return volume, math.sqrt(smallest)
