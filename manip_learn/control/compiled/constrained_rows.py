"""Rows of a frame's Jacobian and their derivative, as loops over plain numbers."""

from __future__ import annotations

import math

from manip_learn.control.compiled.step_table import (
    CHAIN,
    GRADIENT,
    SLIDE,
    WEIGHTS,
)
from manip_learn.robot.batch.compiled_kinematics import (
    JOINTS,
    LARGEST_ANGLE,
    LOCAL,
    OFFSET,
    PRISMATIC,
    SIGN,
    SOURCE,
    TARGET,
    sine_and_cosine,
)
from manip_learn.robot.batch.kernel_cache import compiled_inside


@compiled_inside
def six(table, k, at):
    """Six neighbouring entries of a row."""
    return table[k, at], table[k, at + 1], table[k, at + 2], table[k, at + 3], table[k, at + 4], table[k, at + 5]


@compiled_inside
def turn_joints(constants, joints, q, work, base):
    """Slide, sine and cosine of each joint, for `columns_of`."""
    for j in range(joints):
        k = CHAIN + JOINTS + j
        x = constants[CHAIN + 1, SIGN] * q[int(constants[k, SOURCE])]
        angle = constants[k, OFFSET] + (1.0 - constants[k, PRISMATIC]) * x
        work[base + j, SLIDE] = x
        if abs(angle) > LARGEST_ANGLE:
            work[base + j, SLIDE + 1], work[base + j, SLIDE + 2] = math.sin(angle), math.cos(angle)
        else:
            work[base + j, SLIDE + 1], work[base + j, SLIDE + 2] = sine_and_cosine(angle)


@compiled_inside
def jacobian_vjp(work, base, joints, local):
    """sum_ij weights_ji dJ_ij / dq_k for each joint k, base first, into the column GRADIENT of the joints' rows.

    The formulas of `robot.batch.jacobian.jacobian_vjp`.
    """
    f0 = f1 = f2 = m0 = m1 = m2 = 0.0
    for k in range(base, base + joints):  # joints above k
        v0, v1, v2, w0, w1, w2 = six(work, k, 0)
        a0, a1, a2, b0, b1, b2 = six(work, k, WEIGHTS)
        total = v0 * f0 + v1 * f1 + v2 * f2
        if local:
            total += w0 * m0 + w1 * m1 + w2 * m2
            m0 += a1 * v2 - a2 * v1 + b1 * w2 - b2 * w1
            m1 += a2 * v0 - a0 * v2 + b2 * w0 - b0 * w2
            m2 += a0 * v1 - a1 * v0 + b0 * w1 - b1 * w0
        work[k, GRADIENT] = total
        f0 += a1 * w2 - a2 * w1
        f1 += a2 * w0 - a0 * w2
        f2 += a0 * w1 - a1 * w0
    if local:
        return
    for k in range(base + joints - 1, base - 1, -1):  # joint k and those below
        v0, v1, v2, w0, w1, w2 = six(work, k, 0)
        a0, a1, a2, b0, b1, b2 = six(work, k, WEIGHTS)
        m0 += v1 * a2 - v2 * a1 + w1 * b2 - w2 * b1
        m1 += v2 * a0 - v0 * a2 + w2 * b0 - w0 * b2
        m2 += v0 * a1 - v1 * a0 + w0 * b1 - w1 * b0
        work[k, GRADIENT] += w0 * m0 + w1 * m1 + w2 * m2


@compiled_inside
def vjp(constants, rows, s, joints, weights, work, base, gradient):
    """sum_ij weights_ij dA_ij / dq_k into `gradient`, weights (s, nv) and gradient (nv,) in public columns."""
    for k in range(gradient.shape[0]):
        gradient[k] = 0.0
    for j in range(joints):
        column, place = _places(constants, j)
        for k in range(6):
            total = 0.0
            for i in range(s):
                total += weights[i, column] * constants[rows + i, k]
            work[base + place, WEIGHTS + k] = total
    jacobian_vjp(work, base, joints, constants[CHAIN + 1, LOCAL] != 0.0)
    for j in range(joints):
        column, place = _places(constants, j)
        gradient[column] = work[base + place, GRADIENT]


@compiled_inside
def _places(constants, j):
    """Public column of a joint of the chain, and its place among them, base first."""
    k = CHAIN + JOINTS + j
    return int(constants[k, SOURCE]), int(constants[k, TARGET])


@compiled_inside
def public_rows(constants, s, joints, chain_rows, first, A):
    """A (s, nv) in public columns, from rows of columns of the chain that begin at row `first`."""
    for i in range(s):
        for j in range(A.shape[1]):
            A[i, j] = 0.0
        for j in range(joints):
            column, place = _places(constants, j)
            A[i, column] = chain_rows[first + i, place]
