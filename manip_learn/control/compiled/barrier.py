"""The bound on the approach to a singularity, as loops over plain numbers."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control.compiled.bounded_step import HIGH, LOW, SLOPE
from manip_learn.control.compiled.decomposition import decompose
from manip_learn.control.compiled.near_singularity import approach_bound, smallest_gradient
from manip_learn.control.compiled.step_table import (
    ACCELERATION,
    CHAIN,
    DAMPED,
    FACTS,
    INVERSE,
    MATRICES,
    N_JOINTS,
    SMALLEST,
)
from manip_learn.control.singularity import APPROACH_RATE, BRAKING_SHARE
from manip_learn.robot.batch.compiled_kinematics import JOINTS
from manip_learn.robot.batch.kernel_cache import compiled_inside


@compiled_inside
def is_singular(sigma):
    """Whether a direction is lost; False where sigma[0] is negative: A is well-conditioned, and not decomposed yet."""
    return 0.0 <= sigma[0] and sigma[sigma.shape[0] - 1] <= SINGULAR_RATIO * sigma[0]


@compiled_inside
def barrier(constants, A, Ut, sigma, Vt, dt, u, space, work):
    """`ResolvedRateController._barrier`: whether the approach is to be bounded; the bound goes into the space."""
    s, nv = A.shape
    slope, smallest = space[SLOPE], work[FACTS, SMALLEST]
    for j in range(nv):
        slope[j] = 0.0
    if int(constants[0, INVERSE]) != DAMPED or is_singular(sigma):
        return False
    joints = int(constants[0, N_JOINTS])
    dofs = CHAIN + JOINTS + joints
    size, square, weakest = 0.0, 0.0, math.inf
    for j in range(nv):
        square += u[j] * u[j]
        weakest = min(weakest, constants[dofs + j, ACCELERATION])
        for i in range(s):
            size += A[i, j] * A[i, j]
    # |grad sigma| is about as large as A itself: no closer look where that is slow enough
    rate = min(APPROACH_RATE, 0.5 / dt) * smallest
    if square * size < min(2.0 * BRAKING_SHARE * weakest * math.sqrt(size) * smallest, rate * rate):
        return False
    if sigma[0] < 0.0:
        decompose(A, s, Ut, sigma, Vt)
    weights, gradient = np.empty((s, nv)), np.empty(nv)
    length = smallest_gradient(constants, dofs + nv, s, joints, Ut, Vt, weights, work, MATRICES + 3 * s, gradient)
    for j in range(nv):
        slope[j] = gradient[j]
    bound = approach_bound(constants, dofs, smallest, gradient, length, dt)
    space[LOW, nv], space[HIGH, nv] = -bound, math.inf
    return bound < math.inf
