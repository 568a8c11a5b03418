"""Lambda Phi(q) = (T_0 + sum_k p_k T_k) J(q) of one frame, its derivative and its manipulability, as loops.

The one compiled form (the optional extra `fast`) of every constraint on a frame: rows of its Jacobian, whose weights
are constant, and those whose weights change with the place p of its origin (`PlaceWeights`).
"""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.features.weighed_velocity import FREE, FREE_ROWS, ON_AXIS, SLOPES, WIDTH
from manip_learn.robot.batch.compiled_kinematics import (
    GRADIENT,
    LANES,
    LOCAL,
    WEIGHTS,
    columns_of,
    jacobian_vjp,
    joint_turns,
)
from manip_learn.robot.batch.kernel_cache import compiled, compiled_inside

# columns of a row of Lambda in the work space, behind its six weights: their slopes along p, and scratch
SLOPE, MOVED, MIX_WIDTH = 6, 24, 30
CONSTANT = 0  # rows whose weights do not change; otherwise one more than the number of rows of unit length


@compiled_inside
def mix_rows(table, rows, s, form, p0, p1, p2, work, at):
    """Weights of (v, w), and their slopes, into the s rows of `work` from `at` on; the row behind them is scratch.

    `table` holds Lambda from row `rows` on, behind it what `PlaceWeights.table` has.
    """
    for i in range(s):
        row = work[at + i]
        for c in range(6):
            row[c] = table[rows + i, c]
        if form == CONSTANT:
            continue
        first = rows + s + SLOPES * i
        for c in range(6):
            k, at_c = first + (3 * c) // WIDTH, (3 * c) % WIDTH
            a, b, d = table[k, at_c], table[k, at_c + 1], table[k, at_c + 2]
            row[c] += a * p0 + b * p1 + d * p2
            row[SLOPE + 3 * c], row[SLOPE + 3 * c + 1], row[SLOPE + 3 * c + 2] = a, b, d
            row[MOVED + c] = 0.0
    for k in range(form - 1):
        _free_row(table, rows + s * (1 + SLOPES) + FREE_ROWS * k, p0, p1, p2, work[at + s])
        for i in range(s):
            share = table[rows + i, FREE + k]
            for c in range(3):
                work[at + i, c] += share * work[at + s, c]
            for c in range(9):
                work[at + i, SLOPE + c] += share * work[at + s, SLOPE + c]


@compiled_inside
def _free_row(table, k, p0, p1, p2, out):
    """Weights of v made unit length and their slopes, as in `PlaceWeights.at`."""
    s, edge, h = 0.0, ON_AXIS * ON_AXIS, table[k + 1, 3]
    for c in range(3):
        at = 3 + 3 * c
        out[c] = table[k, c] + table[k, at] * p0 + table[k, at + 1] * p1 + table[k, at + 2] * p2
        s += out[c] * out[c]
    lift = table[k + 1, 0] != 0.0 or table[k + 1, 1] != 0.0 or table[k + 1, 2] != 0.0
    more = s + h * h + edge if lift else 1.0
    size, turned = math.sqrt((s + edge) * more), -h if lift else 1.0
    steep = (more + s + edge if lift else more) / size
    for d in range(3):
        along = 0.0
        for c in range(3):
            along += out[c] * table[k, 3 + 3 * c + d]
        for c in range(3):
            b = table[k + 1, c]
            f = (s * b + turned * out[c]) / size
            out[SLOPE + 3 * c + d] = (2.0 * b * along + turned * table[k, 3 + 3 * c + d] - f * steep * along) / size
    for c in range(3):
        out[c] = (s * table[k + 1, c] + turned * out[c]) / size


@compiled_inside
def joint_weights(s, form, weights, column, work, joint, at):
    """Weights of one joint's (v, w), from those of a column of A (s, _)."""
    for k in range(6):
        total = 0.0
        for i in range(s):
            total += weights[i, column] * work[at + i, k]
        work[joint, WEIGHTS + k] = total
    if form != CONSTANT:
        for i in range(s):
            for k in range(6):
                work[at + i, MOVED + k] += weights[i, column] * work[joint, k]


@compiled_inside
def rows_vjp(s, form, joints, local, work, base, at):
    """sum_ij weights_ij dA_ij / dq_k into the joints' entries GRADIENT, after `joint_weights` of every joint."""
    jacobian_vjp(work, base, joints, local)
    if form == CONSTANT:
        return
    t0 = t1 = t2 = 0.0
    for i in range(s):
        row = work[at + i]
        for c in range(6):
            t0 += row[MOVED + c] * row[SLOPE + 3 * c]
            t1 += row[MOVED + c] * row[SLOPE + 3 * c + 1]
            t2 += row[MOVED + c] * row[SLOPE + 3 * c + 2]
            row[MOVED + c] = 0.0
    for k in range(base, base + joints):
        work[k, GRADIENT] += t0 * work[k, 0] + t1 * work[k, 1] + t2 * work[k, 2]


@compiled_inside
def dot(x, y):
    """Sum of the products of the entries of x with those of y, which may be longer."""
    total = 0.0
    for k in range(x.shape[0]):
        total += x[k] * y[k]
    return total


@compiled_inside
def add(y, factor, x):
    """y += factor x, x as long as y or longer."""
    for k in range(y.shape[0]):
        y[k] += factor * x[k]


@compiled_inside
def orthogonalised(Q, L):
    """A = L Q, row by row; returns mu = prod L_ii and the shortest L_ii. Q holds A at first."""
    volume, shortest = 1.0, math.inf
    for i in range(Q.shape[0]):
        for j in range(i):
            L[i, j] = dot(Q[j], Q[i])
            add(Q[i], -L[i, j], Q[j])
        L[i, i] = length = math.sqrt(dot(Q[i], Q[i]))
        shortest = min(shortest, length)
        volume *= length
        if length > 0.0:
            factor = 1.0 / length
            for k in range(Q.shape[1]):
                Q[i, k] *= factor
    return volume, shortest


@compiled_inside
def solve_transposed(L, Q):
    """Row i of Q becomes row i of L^{-T} Q."""
    s, joints = Q.shape
    for i in range(s - 1, -1, -1):
        for j in range(i + 1, s):
            add(Q[i], -L[j, i], Q[j])
        factor = 1.0 / L[i, i]
        for k in range(joints):
            Q[i, k] *= factor


@compiled
def manipulability_and_gradient(table, postures, selection, s, form, public, least, mu, ill, gradient):
    """mu, whether the answer is too inaccurate to use, and grad mu = mu A^{+T} : dA/dq in the public columns.

    Args:
        table: The chain, see `chain_table`.
        postures: Joint positions, shape (n, nv).
        selection: Lambda's table, see `compiled_form`.
        s: Number of rows of Lambda.
        form: See `compiled_form`.
        public: Public column of each joint of the chain, base first.
        least: Shortest orthogonalised row, relative to the longest row of A, that is accurate enough.
        mu: shape (n,), written.
        ill: shape (n,), written; the gradient is left alone there.
        gradient: shape (n, nv), written in the public columns.
    """
    joints, at = public.shape[0], public.shape[0] + 1
    turns, angle, work = np.empty((joints, 3 * LANES)), np.empty(LANES), np.empty((at + s + 1, MIX_WIDTH))
    Q, L, local = np.empty((s, joints)), np.empty((s, s)), table[1, LOCAL] != 0.0
    for first in range(0, postures.shape[0], LANES):
        size = min(LANES, postures.shape[0] - first)
        joint_turns(table, postures, first, size, turns, angle)
        for m in range(size):
            p0, p1, p2 = columns_of(table, 0, joints, turns, 0, m, LANES, work, 0)
            mix_rows(selection, 0, s, form, p0, p1, p2, work, at)
            longest = 0.0
            for i in range(s):
                for j in range(joints):
                    Q[i, j] = dot(work[at + i, :6], work[j])
                longest = max(longest, dot(Q[i], Q[i]))
            volume, shortest = orthogonalised(Q, L)
            mu[first + m] = volume
            ill[first + m] = not shortest > least * math.sqrt(longest)
            if ill[first + m]:
                continue
            solve_transposed(L, Q)
            for j in range(joints):
                joint_weights(s, form, Q, j, work, j, at)
            rows_vjp(s, form, joints, local, work, 0, at)
            for j in range(joints):
                gradient[first + m, public[j]] = volume * work[j, GRADIENT]
