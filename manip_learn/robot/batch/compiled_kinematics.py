"""Compiled kernels of batch kinematics (the optional extra `fast`); the same numbers as the NumPy ones to 1e-12.

For where `import numba` works. The machine code is cached on disk, so it is compiled once a machine.
"""

from __future__ import annotations

import math

import numpy as np

from manip_learn.robot.batch.compiled_chain import (
    JOINTS,
    LARGEST_ANGLE,
    LOCAL,
    OFFSET,
    PRISMATIC,
    SIGN,
    SOURCE,
    columns_of,
    sine_and_cosine,
)
from manip_learn.robot.batch.kernel_cache import compiled

LANES = 128  # postures a block: slides, sines and cosines of its joints stay in the first-level cache


@compiled
def joint_turns(table, postures, first, size, turns, angle):
    """Slide, sine and cosine of each joint for a block of postures, as `columns_of` reads them."""
    for j in range(turns.shape[0]):
        k = JOINTS + j
        source, sign, offset = int(table[k, SOURCE]), table[1, SIGN], table[k, OFFSET]
        moving = 1.0 - table[k, PRISMATIC]
        largest = 0.0
        for m in range(size):
            x = sign * postures[first + m, source]
            turns[j, m] = x
            angle[m] = moving * x + offset
            largest = max(largest, abs(angle[m]))
        if largest > LARGEST_ANGLE:
            for m in range(size):
                turns[j, m + LANES], turns[j, m + 2 * LANES] = math.sin(angle[m]), math.cos(angle[m])
        else:
            for m in range(size):
                turns[j, m + LANES], turns[j, m + 2 * LANES] = sine_and_cosine(angle[m])


@compiled
def jacobians(table, postures, rows, public, out):
    """Rows of the Jacobians into the public columns of `out` (n, p, nv)."""
    joints = public.shape[0]
    turns, angle, work = np.empty((joints, 3 * LANES)), np.empty(LANES), np.empty((joints, 9))
    for first in range(0, postures.shape[0], LANES):
        size = min(LANES, postures.shape[0] - first)
        joint_turns(table, postures, first, size, turns, angle)
        for m in range(size):
            columns_of(table, 0, joints, turns, 0, m, LANES, work, 0)
            for i in range(rows.shape[0]):
                for j in range(joints):
                    out[first + m, i, public[j]] = work[j, rows[i]]


@compiled
def derivative_of(work, local, out):
    """dJ/dq of one posture, base first, into `out` (6, joints, joints): [r, i, k] = d J_ri / d q_k."""
    joints = work.shape[0]
    for i in range(joints):
        b0, b1, b2, b3, b4, b5 = work[i, 0], work[i, 1], work[i, 2], work[i, 3], work[i, 4], work[i, 5]
        for k in range(i + 1):
            a0, a1, a2, a3, a4, a5 = work[k, 0], work[k, 1], work[k, 2], work[k, 3], work[k, 4], work[k, 5]
            # w_k x v_i and w_k x w_i: the joint above turns what the lower one gives
            v0, v1, v2 = a4 * b2 - a5 * b1, a5 * b0 - a3 * b2, a3 * b1 - a4 * b0
            w0, w1, w2 = a4 * b5 - a5 * b4, a5 * b3 - a3 * b5, a3 * b4 - a4 * b3
            if local:
                v0 += a1 * b5 - a2 * b4
                v1 += a2 * b3 - a0 * b5
                v2 += a0 * b4 - a1 * b3
                out[0, i, k] = out[1, i, k] = out[2, i, k] = out[3, i, k] = out[4, i, k] = out[5, i, k] = 0.0
                out[3, k, i], out[4, k, i], out[5, k, i] = w0, w1, w2
                if i == k:
                    v0 = v1 = v2 = 0.0
            else:
                out[0, i, k], out[1, i, k], out[2, i, k] = v0, v1, v2
                out[3, k, i] = out[4, k, i] = out[5, k, i] = 0.0
                out[3, i, k], out[4, i, k], out[5, i, k] = w0, w1, w2
            out[0, k, i], out[1, k, i], out[2, k, i] = v0, v1, v2


@compiled
def jacobians_and_derivatives(table, postures, rows, public, out, derivative):
    """Rows of J (n, p, nv) and dJ/dq (n, p, nv, nv) into public columns."""
    joints, local = public.shape[0], table[1, LOCAL] != 0.0
    turns, angle, work = np.empty((joints, 3 * LANES)), np.empty(LANES), np.empty((joints, 9))
    block = np.empty((6, joints, joints))
    for first in range(0, postures.shape[0], LANES):
        size = min(LANES, postures.shape[0] - first)
        joint_turns(table, postures, first, size, turns, angle)
        for m in range(size):
            columns_of(table, 0, joints, turns, 0, m, LANES, work, 0)
            derivative_of(work, local, block)
            for i in range(rows.shape[0]):
                source, target = block[rows[i]], derivative[first + m, i]
                for j in range(joints):
                    out[first + m, i, public[j]] = work[j, rows[i]]
                    line = target[public[j]]
                    for k in range(joints):
                        line[public[k]] = source[j, k]
