"""The bound on the approach to a singularity, as loops over plain numbers."""

from __future__ import annotations

import math

from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control.compiled.constrained_rows import vjp
from manip_learn.control.compiled.decomposition import decompose
from manip_learn.control.compiled.near_singularity import approach_bound, norm, outer_product, smallest_weights
from manip_learn.control.compiled.step_table import (
    ACCELERATION,
    CHAIN,
    DAMPED,
    FACTS,
    INVERSE,
    MATRICES,
    N_JOINTS,
    NV,
    SLOPE,
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
def barrier(constants, A, Ut, sigma, Vt, weights, dt, u, space, work):
    """`ResolvedRateLaw.approach`: whether the approach is to be bounded; gradient and bound go into the space.

    The gradient that is there already, in row SLOPE, is not computed again; its first entry is NaN where it is unknown.
    """
    s, nv = A.shape
    gradient, smallest = space[SLOPE, :nv], work[FACTS, SMALLEST]
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
    if math.isnan(gradient[0]):
        if sigma[0] < 0.0 and s <= 2:
            smallest_weights(A, smallest, weights)
        else:
            if sigma[0] < 0.0:
                decompose(A, s, Ut, sigma, Vt)
            outer_product(Ut[s - 1], Vt[s - 1], weights)
        vjp(constants, s, joints, weights, work, MATRICES + 3 * s, gradient)
    return bounded_approach(constants, smallest, dt, space)


@compiled_inside
def bounded_approach(constants, smallest, dt, space):
    """Write the bound for the gradient in row SLOPE of the space, `approach_bound`; False if there is none."""
    nv = int(constants[0, NV])
    dofs, gradient = CHAIN + JOINTS + int(constants[0, N_JOINTS]), space[SLOPE, :nv]
    bound = approach_bound(constants, dofs, smallest, gradient, norm(gradient), dt)
    space[SLOPE, nv] = -bound
    return bound < math.inf
