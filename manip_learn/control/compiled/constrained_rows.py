"""The constrained rows of a controller and their derivative, as loops over plain numbers."""

from __future__ import annotations

import math

from manip_learn.constraint.compiled_rows import joint_weights, rows_vjp
from manip_learn.control.compiled.step_table import CHAIN, FORM
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
def mix_at(s, joints, base):
    """Row of the work space where the weights of (v, w) begin, see `compiled_rows`: behind a pose's error."""
    return base + joints + s + 2


@compiled_inside
def form_of(constants):
    """How Lambda's weights depend on the place, see `compiled_rows`."""
    return int(constants[CHAIN + 1, FORM])


@compiled_inside
def chain_vjp(constants, s, joints, weights, work, base):
    """sum_ij weights_ij dA_ij / dq_k for weights in columns of the chain, into the joints' entries GRADIENT."""
    form, at = form_of(constants), mix_at(s, joints, base)
    for j in range(joints):
        joint_weights(s, form, weights, j, work, base + j, at)
    rows_vjp(s, form, joints, constants[CHAIN + 1, LOCAL] != 0.0, work, base, at)


@compiled_inside
def vjp(constants, s, joints, weights, work, base, gradient):
    """sum_ij weights_ij dA_ij / dq_k into `gradient`, weights (s, nv) and gradient (nv,) in public columns."""
    form, at = form_of(constants), mix_at(s, joints, base)
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
def public_rows(constants, s, joints, chain_rows, first, A):
    """A (s, nv) in public columns, from rows of columns of the chain that begin at row `first`."""
    for i in range(s):
        for j in range(A.shape[1]):
            A[i, j] = 0.0
        for j in range(joints):
            column, place = places(constants, j)
            A[i, column] = chain_rows[first + i, place]
