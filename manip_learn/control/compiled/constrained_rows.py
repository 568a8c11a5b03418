"""The constrained rows of a controller and their derivative, as loops over plain numbers."""

from __future__ import annotations

import math

from manip_learn.constraint.compiled_rows import joint_weights, rows_vjp
from manip_learn.control.compiled.step_table import CHAIN, FORM, MATRICES, N_JOINTS
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
from manip_learn.robot.batch.compiled_vjp import GRADIENT, SLIDE
from manip_learn.robot.batch.kernel_cache import compiled_inside


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
    return int(constants[CHAIN + 1, FORM])


@compiled_inside
def dofs_of(constants):
    """Row where the degrees of freedom begin."""
    return CHAIN + JOINTS + int(constants[0, N_JOINTS])


@compiled_inside
def joints_at(s):
    """Row of the work space where the joints of the chain begin."""
    return MATRICES + 3 * s


@compiled_inside
def chain_vjp(constants, weights, work):
    """sum_ij weights_ij dA_ij / dq_k for weights in columns of the chain, into the joints' entries GRADIENT."""
    s, joints = weights.shape
    form, at, base = form_of(constants), mix_at(s, joints), joints_at(s)
    for j in range(joints):
        joint_weights(s, form, weights, j, work, base + j, at)
    rows_vjp(s, form, joints, constants[CHAIN + 1, LOCAL] != 0.0, work, base, at)


@compiled_inside
def vjp(constants, weights, work, gradient):
    """sum_ij weights_ij dA_ij / dq_k into `gradient`, weights (s, nv) and gradient (nv,) in public columns."""
    s, joints = weights.shape[0], int(constants[0, N_JOINTS])
    form, at, base = form_of(constants), mix_at(s, joints), joints_at(s)
    for k in range(gradient.shape[0]):
        gradient[k] = 0.0
    for j in range(joints):
        column, place = places(constants, j)
        joint_weights(s, form, weights, column, work, base + place, at)
    rows_vjp(s, form, joints, constants[CHAIN + 1, LOCAL] != 0.0, work, base, at)
    for j in range(joints):
        column, place = places(constants, j)
        gradient[column] = work[base + place, GRADIENT]


@compiled_inside
def places(constants, j):
    """Public column of a joint of the chain, and its place among them, base first."""
    k = CHAIN + JOINTS + j
    return int(constants[k, SOURCE]), int(constants[k, TARGET])


@compiled_inside
def public_rows(constants, work, A):
    """A (s, nv) in public columns, from those of the chain in the work space."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            A[i, j] = 0.0
        for j in range(int(constants[0, N_JOINTS])):
            column, place = places(constants, j)
            A[i, column] = work[MATRICES + i, place]


@compiled_inside
def chain_rows(weights, first, s, joints, work):
    """Weights, from row `first` on, times the Jacobian in columns of the chain, into the rows of `work` for A."""
    base = joints_at(s)
    for i in range(s):
        for j in range(joints):
            # the joint that moves column j, as many as there are from the base
            total = 0.0
            for k in range(6):
                total += weights[first + i, k] * work[base + j, k]
            work[MATRICES + i, j] = total
