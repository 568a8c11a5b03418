"""Rows of a frame's Jacobian and their derivative, as loops over plain numbers."""

from __future__ import annotations

import math

from manip_learn.control.compiled.step_table import CHAIN
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
from manip_learn.robot.batch.compiled_vjp import GRADIENT, SLIDE, WEIGHTS, jacobian_vjp
from manip_learn.robot.batch.kernel_cache import compiled_inside


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
def chain_vjp(constants, rows, s, joints, weights, work, base):
    """sum_ij weights_ij dA_ij / dq_k for weights in columns of the chain, into the joints' entries GRADIENT."""
    for j in range(joints):
        for k in range(6):
            total = 0.0
            for i in range(s):
                total += weights[i, j] * constants[rows + i, k]
            work[base + j, WEIGHTS + k] = total
    jacobian_vjp(work, base, joints, constants[CHAIN + 1, LOCAL] != 0.0)


@compiled_inside
def vjp(constants, rows, s, joints, weights, work, base, gradient):
    """sum_ij weights_ij dA_ij / dq_k into `gradient`, weights (s, nv) and gradient (nv,) in public columns."""
    for k in range(gradient.shape[0]):
        gradient[k] = 0.0
    for j in range(joints):
        column, place = places(constants, j)
        for k in range(6):
            total = 0.0
            for i in range(s):
                total += weights[i, column] * constants[rows + i, k]
            work[base + place, WEIGHTS + k] = total
    jacobian_vjp(work, base, joints, constants[CHAIN + 1, LOCAL] != 0.0)
    for j in range(joints):
        column, place = places(constants, j)
        gradient[column] = work[base + place, GRADIENT]


@compiled_inside
def places(constants, j):
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
            column, place = places(constants, j)
            A[i, column] = chain_rows[first + i, place]
