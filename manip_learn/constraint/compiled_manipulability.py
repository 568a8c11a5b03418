"""Manipulability and its gradient of many postures as loops over plain numbers (the optional extra `fast`)."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.compiled_rows import MIX_WIDTH, joint_weights, mix_rows, rows_vjp
from manip_learn.robot.batch.compiled_kinematics import GRADIENT, LANES, LOCAL, columns_of, joint_turns
from manip_learn.robot.batch.kernel_cache import compiled, compiled_inside


@compiled_inside
def orthogonalised(Q, L):
    """A = L Q, row by row; returns mu = prod L_ii and the shortest L_ii. Q holds A at first."""
    s, joints = Q.shape
    volume, shortest = 1.0, math.inf
    for i in range(s):
        for j in range(i):
            total = 0.0
            for k in range(joints):
                total += Q[i, k] * Q[j, k]
            L[i, j] = total
            for k in range(joints):
                Q[i, k] -= total * Q[j, k]
        square = 0.0
        for k in range(joints):
            square += Q[i, k] * Q[i, k]
        length = math.sqrt(square)
        L[i, i] = length
        shortest = min(shortest, length)
        volume *= length
        if length > 0.0:
            for k in range(joints):
                Q[i, k] /= length
    return volume, shortest


@compiled_inside
def solve_transposed(L, Q):
    """Row i of Q becomes row i of L^{-T} Q."""
    s, joints = Q.shape
    for i in range(s - 1, -1, -1):
        for j in range(i + 1, s):
            for k in range(joints):
                Q[i, k] -= L[j, i] * Q[j, k]
        for k in range(joints):
            Q[i, k] /= L[i, i]


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
                square = 0.0
                for j in range(joints):
                    total = 0.0
                    for k in range(6):
                        total += work[at + i, k] * work[j, k]
                    Q[i, j] = total
                    square += total * total
                longest = max(longest, square)
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
