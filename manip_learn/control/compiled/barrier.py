"""The bound on the approach to a singularity, as loops over plain numbers."""

from __future__ import annotations

import math

from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control.compiled.constrained_rows import dofs_of, vjp
from manip_learn.control.compiled.decomposition import decompose
from manip_learn.control.compiled.near_singularity import approach_bound, outer_product, smallest_weights
from manip_learn.control.compiled.step_table import (
    ACCELERATION,
    DAMPED,
    FACTS,
    INVERSE,
    NV,
    SLOPE,
    SMALLEST,
)
from manip_learn.control.singularity import APPROACH_RATE, BRAKING_SHARE
from manip_learn.robot.batch.kernel_cache import compiled_inside


@compiled_inside
def is_singular(sigma):
    """Whether a direction is lost; False where sigma[0] is negative: A is well-conditioned, and not decomposed yet."""
    return 0.0 <= sigma[0] and sigma[sigma.shape[0] - 1] <= SINGULAR_RATIO * sigma[0]


@compiled_inside
def may_approach(constants, A, sigma, smallest, dt, u):
    """Whether the velocity u may be too fast for a singularity of A, so that a closer look is due, by `barrier`."""
    if int(constants[0, INVERSE]) != DAMPED or is_singular(sigma):
        return False
    size, square, weakest, dofs = 0.0, 0.0, math.inf, dofs_of(constants)
    for j in range(A.shape[1]):
        square += u[j] * u[j]
        weakest = min(weakest, constants[dofs + j, ACCELERATION])
        for i in range(A.shape[0]):
            size += A[i, j] * A[i, j]
    # |grad sigma| is about as large as A itself
    rate = min(APPROACH_RATE, 0.5 / dt) * smallest
    return square * size >= min(2.0 * BRAKING_SHARE * weakest * math.sqrt(size) * smallest, rate * rate)


@compiled_inside
def barrier(constants, rows, dt, space, work):
    """`ResolvedRateLaw.approach`: whether the approach is to be bounded; gradient and bound go into the space.

    The gradient that is there already, in row SLOPE, is not computed again; its first entry is NaN where it is unknown.
    """
    s, nv = rows.A.shape
    gradient, smallest = space[SLOPE, :nv], work[FACTS, SMALLEST]
    if math.isnan(gradient[0]):
        if rows.sigma[0] < 0.0 and s <= 2:
            smallest_weights(rows.A, smallest, rows.weights)
        else:
            if rows.sigma[0] < 0.0:
                decompose(rows.A, s, rows.Ut, rows.sigma, rows.Vt)
            outer_product(rows.Ut[s - 1], rows.Vt[s - 1], rows.weights)
        vjp(constants, rows.weights, work, gradient)
    return bounded_approach(constants, smallest, dt, space)


@compiled_inside
def bounded_approach(constants, smallest, dt, space):
    """Write the bound for the gradient in row SLOPE of the space, `approach_bound`; False if there is none."""
    nv = int(constants[0, NV])
    bound = approach_bound(constants, smallest, space[SLOPE, :nv], dt)
    space[SLOPE, nv] = -bound
    return bound < math.inf
