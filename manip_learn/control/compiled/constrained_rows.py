"""The constrained rows, their inverse, their derivative and their decomposition, as loops over plain numbers."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.compiled_rows import dot, joint_weights, orthogonalised, rows_vjp, solve_transposed
from manip_learn.constraint.small_matrices import LEAST_SINGULAR_RATIO
from manip_learn.control.compiled import step_table as table
from manip_learn.robot.batch.compiled_kinematics import (
    GRADIENT,
    JOINTS,
    LARGEST_ANGLE,
    LOCAL,
    OFFSET,
    PRISMATIC,
    SIGN,
    SLIDE,
    SOURCE,
    TARGET,
    sine_and_cosine,
)
from manip_learn.robot.batch.kernel_cache import compiled_inside

SWEEPS = 30  # of Jacobi rotations; six are usual
# cosine between two rows from which on they count as orthogonal: the rounding of their product
ORTHOGONAL = 2e-15

EIGEN_SWEEPS = 8  # of Jacobi rotations of a square matrix: converged to the last bit for six rows
NEGLIGIBLE = 1e-32  # square of a cosine between two rows that no longer changes the eigenvalues


@compiled_inside
def turn_joints(constants, chain, joints, q, work, base):
    """Slide, sine and cosine of each joint of the chain whose table begins at row `chain`, for `columns_of`."""
    for j in range(joints):
        k = chain + JOINTS + j
        x = constants[chain + 1, SIGN] * q[int(constants[k, SOURCE])]
        angle = constants[k, OFFSET] + (1.0 - constants[k, PRISMATIC]) * x
        work[base + j, SLIDE] = x
        if abs(angle) > LARGEST_ANGLE:
            work[base + j, SLIDE + 1], work[base + j, SLIDE + 2] = math.sin(angle), math.cos(angle)
        else:
            work[base + j, SLIDE + 1], work[base + j, SLIDE + 2] = sine_and_cosine(angle)


@compiled_inside
def mix_at(s, joints):
    """Row of the work space where the weights of (v, w) begin, see `compiled_rows`: behind a pose's error."""
    return joints_at(s) + joints + s + 2


@compiled_inside
def form_of(constants):
    """How Lambda's weights depend on the place, see `compiled_rows`."""
    return int(constants[table.CHAIN + 1, table.FORM])


@compiled_inside
def sizes_of(constants):
    """Numbers of joints of the chain, degrees of freedom and rows of A."""
    return int(constants[0, table.N_JOINTS]), int(constants[0, table.NV]), int(constants[0, table.N_CONSTRAINTS])


@compiled_inside
def dofs_of(constants):
    """Row where the degrees of freedom begin."""
    return table.CHAIN + JOINTS + int(constants[0, table.N_JOINTS])


@compiled_inside
def joints_at(s):
    """Row of the work space where the joints of the chain begin."""
    return table.MATRICES + 3 * s


@compiled_inside
def chain_vjp(constants, weights, work):
    """sum_ij weights_ij dA_ij / dq_k for weights in columns of the chain, into the joints' entries GRADIENT."""
    s, joints = weights.shape
    form, at, base = form_of(constants), mix_at(s, joints), joints_at(s)
    for j in range(joints):
        joint_weights(s, form, weights, j, work, base + j, at)
    rows_vjp(s, form, joints, constants[table.CHAIN + 1, LOCAL] != 0.0, work, base, at)


@compiled_inside
def vjp(constants, weights, work, gradient):
    """sum_ij weights_ij dA_ij / dq_k into `gradient`, weights (s, nv) and gradient (nv,) in public columns."""
    s, joints = weights.shape[0], int(constants[0, table.N_JOINTS])
    form, at, base = form_of(constants), mix_at(s, joints), joints_at(s)
    gradient[:] = 0.0
    for j in range(joints):
        column, place = places(constants, j)
        joint_weights(s, form, weights, column, work, base + place, at)
    rows_vjp(s, form, joints, constants[table.CHAIN + 1, LOCAL] != 0.0, work, base, at)
    for j in range(joints):
        column, place = places(constants, j)
        gradient[column] = work[base + place, GRADIENT]


@compiled_inside
def places(constants, j):
    """Public column of a joint of the chain, and its place among them, base first."""
    k = table.CHAIN + JOINTS + j
    return int(constants[k, SOURCE]), int(constants[k, TARGET])


@compiled_inside
def public_rows(constants, work, A):
    """A (s, nv) in public columns, from those of the chain in the work space."""
    A[:] = 0.0
    for j in range(int(constants[0, table.N_JOINTS])):
        column, place = places(constants, j)
        for i in range(A.shape[0]):
            A[i, column] = work[table.MATRICES + i, place]


@compiled_inside
def chain_rows(weights, first, s, joints, work):
    """Weights, from row `first` on, times the Jacobian in columns of the chain, into the rows of `work` for A."""
    base = joints_at(s)
    for i in range(s):
        for j in range(joints):
            work[table.MATRICES + i, j] = dot(weights[first + i, :6], work[base + j])


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
    for _ in range(EIGEN_SWEEPS):
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
    for i in range(A.shape[0]):
        for j in range(i + 1):
            G[i, j] = G[j, i] = dot(A[i], A[j])
        for k in range(A.shape[1]):
            X[i, k] = A[i, k]
    volume, shortest = orthogonalised(X, L)
    if not shortest > 0.0:
        return 0.0, 0.0
    smallest, largest = smallest_and_largest(G, L)
    if not smallest > LEAST_SINGULAR_RATIO * LEAST_SINGULAR_RATIO * largest:
        return 0.0, 0.0
    solve_transposed(L, X)
    return volume, math.sqrt(smallest)


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
    Vt[:rows] = A
    Ut[:] = 0.0
    for i in range(rows):
        Ut[i, i] = 1.0
    for _ in range(SWEEPS):
        turned = False
        for i in range(rows - 1):
            for j in range(i + 1, rows):
                turned = _orthogonalise(Vt, Ut, i, j) or turned
        if not turned:
            break
    for i in range(rows):
        sigma[i] = norm(Vt[i])
    order = np.argsort(-sigma, kind="mergesort")
    sigma[:], Ut[:], Vt[:rows] = sigma[order], Ut[order], Vt[order]
    for i in range(rows):
        Vt[i] *= 1.0 / sigma[i] if sigma[i] > 0.0 else 0.0


@compiled_inside
def _orthogonalise(Vt, Ut, i, j):
    """Turn two rows until they are orthogonal; False if they are."""
    a, b, c = dot(Vt[i], Vt[i]), dot(Vt[j], Vt[j]), dot(Vt[i], Vt[j])
    if abs(c) <= ORTHOGONAL * math.sqrt(a) * math.sqrt(b):
        return False
    zeta = 0.5 * (b - a) / c
    t = math.copysign(1.0, zeta) / (abs(zeta) + math.hypot(1.0, zeta))
    cosine = 1.0 / math.sqrt(1.0 + t * t)
    sine = cosine * t
    _turn(Vt[i], Vt[j], cosine, sine)
    _turn(Ut[i], Ut[j], cosine, sine)
    return True


@compiled_inside
def _turn(x, y, cosine, sine):
    for k in range(x.shape[0]):
        x[k], y[k] = cosine * x[k] - sine * y[k], sine * x[k] + cosine * y[k]


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
def row_space(A, Vt, scratch):
    """Orthonormal rows that span those of a well-conditioned A (s, n), into the first rows of Vt; scratch (s, s)."""
    Vt[: A.shape[0]] = A
    orthogonalised(Vt[: A.shape[0]], scratch)


@compiled_inside
def leading(M, direction):
    """Largest singular value of M (rows, columns); its right singular vector, largest entry positive: `direction`."""
    rows = M.shape[0]
    Ut, sigma, Vt = np.empty((rows, rows)), np.empty(rows), np.empty(M.shape)
    decompose(M, rows, Ut, sigma, Vt)
    direction[:] = math.copysign(1.0, Vt[0, np.argmax(np.abs(Vt[0]))]) * Vt[0]
    return sigma[0]


@compiled_inside
def norm(x):
    """Euclidean norm."""
    return math.sqrt(dot(x, x))


@compiled_inside
def rank_of(sigma, least):
    """Number of singular values above `least`."""
    rank = 0
    for i in range(sigma.shape[0]):
        rank += 1 if sigma[i] > least else 0
    return rank


@compiled_inside
def truncation(sigma, size):
    """Matlab's tolerance, `linalg.matlab_tolerance`, for the larger side of a matrix."""
    _, exponent = math.frexp(sigma[0])
    return size * math.ldexp(1.0, exponent - 53)
