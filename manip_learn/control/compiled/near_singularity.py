"""The law and the way out near a singularity, as loops over plain numbers; see `singularity` and `controller`."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control.compiled.constrained_rows import dofs_of, vjp
from manip_learn.control.compiled.decomposition import leading
from manip_learn.control.compiled.step_table import (
    ACCELERATION,
    DAMPED,
    EXACT,
    INVERSE,
    THRESHOLD,
)
from manip_learn.control.singularity import (
    APPROACH_RATE,
    BRAKING_SHARE,
    CROSSING_SPEED,
    ESCAPE_SPEED,
    FULLY_PRESSING,
    GROWTH,
    SEED_SHARE,
    SEED_SPEED,
    STABLE_SLOPE,
)
from manip_learn.robot.batch.kernel_cache import compiled_inside


@compiled_inside
def truncation(sigma, size):
    """Matlab's tolerance, `linalg.matlab_tolerance`, for the larger side of a matrix."""
    _, exponent = math.frexp(sigma[0])
    return size * math.ldexp(1.0, exponent - 53)


@compiled_inside
def rank_of(sigma, least):
    """Number of singular values above `least`."""
    rank = 0
    for i in range(sigma.shape[0]):
        rank += 1 if sigma[i] > least else 0
    return rank


@compiled_inside
def task_part(constants, sigma, along, damping, Vt, task):
    """A^+ b = V diag(g) U^T b, where g is 1 / sigma in the controller's sense (`linalg.inverse_singular_values`)."""
    inverse, threshold = int(constants[0, INVERSE]), constants[0, THRESHOLD]
    least = math.ldexp(1.0, -1022) if inverse == EXACT else truncation(sigma, Vt.shape[1])
    for j in range(Vt.shape[1]):
        task[j] = 0.0
    for i in range(sigma.shape[0]):
        x, gain = sigma[i], 0.0
        if inverse == DAMPED:
            ratio = min(x / threshold, 1.0)
            damped = damping * (1.0 - ratio * ratio)
            square = x * x + damped * damped
            gain = x / square if square > 0.0 else 0.0
        elif x > least:
            gain = 1.0 / x
        for j in range(Vt.shape[1]):
            task[j] += gain * along[i] * Vt[i, j]


@compiled_inside
def outer_product(u, v, weights):
    """weights = u v^T; for u_min and v_min those of the gradient of the smallest singular value."""
    for i in range(u.shape[0]):
        for j in range(v.shape[0]):
            weights[i, j] = u[i] * v[j]


@compiled_inside
def smallest_weights(A, smallest, weights):
    """u_min v_min^T of one or two well-conditioned rows, from A A^T (`singularity.smallest_gradient_of`)."""
    nv = A.shape[1]
    if A.shape[0] == 1:
        for j in range(nv):
            weights[0, j] = A[0, j] / smallest
        return
    a = b = c = 0.0
    for j in range(nv):
        a += A[0, j] * A[0, j]
        b += A[0, j] * A[1, j]
        c += A[1, j] * A[1, j]
    half = 0.5 * (a - c)
    radius = math.hypot(half, b)
    first, second, both = (radius - half, radius + half, -b) if radius > 0.0 else (1.0, 0.0, 0.0)
    scale = 1.0 / ((2.0 * radius if radius > 0.0 else 1.0) * smallest)
    for j in range(nv):
        weights[0, j] = scale * (first * A[0, j] + both * A[1, j])
        weights[1, j] = scale * (both * A[0, j] + second * A[1, j])


@compiled_inside
def norm(x):
    """Euclidean norm."""
    square = 0.0
    for k in range(x.shape[0]):
        square += x[k] * x[k]
    return math.sqrt(square)


@compiled_inside
def stable_damping(constants, rows, along, dt, row, work):
    """`singularity.stable_damping`; `row` (nv,) is scratch."""
    Ut, sigma, weights = rows.Ut, rows.sigma, rows.weights
    (s, nv), threshold, pressing, square = weights.shape, constants[0, THRESHOLD], False, 0.0
    for i in range(s):
        pressing = pressing or (sigma[i] < threshold and along[i] != 0.0)
    if not pressing:
        return 0.0
    for j in range(nv):
        for r in range(s):
            for k in range(nv):
                weights[r, k] = 0.0
            for i in range(s):
                if sigma[i] < threshold:
                    weights[r, j] += along[i] * Ut[i, r]
        vjp(constants, weights, work, row)
        for k in range(nv):
            square += row[k] * row[k]
    return math.sqrt(dt * math.sqrt(square) / (2.0 * STABLE_SLOPE))


@compiled_inside
def pressed_damping(damping, stable, slope, length, task):
    """`singularity.pressed_damping`, `length` the norm of the slope."""
    size, pressing = length * norm(task), 0.0
    for j in range(slope.shape[0]):
        pressing -= slope[j] * task[j]
    pressing = pressing / size if size > 0.0 else 0.0
    share = min(1.0, max(0.0, pressing / FULLY_PRESSING))
    return math.sqrt((1.0 - share) * damping * damping + share * stable * stable)


@compiled_inside
def approach_bound(constants, smallest, slope, dt):
    """`singularity.approach_bound`."""
    length = norm(slope)
    if length == 0.0:
        return math.inf
    return length * CROSSING_SPEED + approach_rate(constants, smallest, slope, length, dt)


@compiled_inside
def approach_rate(constants, distance, slope, length, dt):
    """`singularity.approach_rate`, `length` the norm of the slope."""
    rate, usable, dofs = min(APPROACH_RATE, 0.5 / dt), math.inf, dofs_of(constants)
    if length == 0.0:
        return rate * distance
    for j in range(slope.shape[0]):
        usable = min(usable, constants[dofs + j, ACCELERATION] / max(abs(slope[j]), 1e-12 * length))
    deceleration = BRAKING_SHARE * length * length * usable
    return min(rate * distance, math.sqrt(2.0 * deceleration * max(distance, 0.0)))


@compiled_inside
def seed_speed(smallest, width):
    """Speed that starts the motion out of a singularity."""
    return SEED_SPEED * max(0.0, 1.0 - smallest / (SEED_SHARE * width))


@compiled_inside
def escape_velocity(sigma, Vt, dt, width, climb, steepness, escape):
    """`singularity.escape_velocity` beside a singularity, into `escape`.

    Args:
        sigma: Singular values.
        Vt: Right singular vectors.
        dt: Time for which the velocity is held [s].
        width: Singular value at which it ends.
        climb: grad log mu.
        steepness: Norm of the gradient of the smallest singular value, where that is below `width`.
        escape: Written.
    """
    s, nv = sigma.shape[0], Vt.shape[1]
    smallest, share, others = sigma[s - 1], 0.0, 0.0
    for j in range(nv):
        escape[j] = 0.0
    if smallest >= width:
        return
    for i in range(s):
        ratio = sigma[i] / width
        share = max(0.0, 1.0 - ratio * ratio)
        share *= share
        along = 0.0
        for j in range(nv):
            along += Vt[i, j] * climb[j]
        others += (1.0 - share) * along * (1.0 - share) * along
        for j in range(nv):
            escape[j] += share * along * Vt[i, j]
    ramp = dt * ESCAPE_SPEED * steepness / GROWTH
    speed = max(seed_speed(smallest, width), ESCAPE_SPEED * share * smallest / math.hypot(smallest, ramp))
    ratio = smallest / width
    length = math.hypot(norm(escape), dt * speed * others / STABLE_SLOPE * ratio * ratio)
    if length > 0.0:
        for j in range(nv):
            escape[j] *= speed / length


@compiled_inside
def outer_sum(Ut, factors, Vt, weights):
    """weights = sum_i factors_i u_i v_i^T."""
    s, nv = weights.shape
    for r in range(s):
        for j in range(nv):
            total = 0.0
            for i in range(s):
                total += factors[i] * Ut[i, r] * Vt[i, j]
            weights[r, j] = total


@compiled_inside
def lost_rates(constants, Ut, Vt, weights, first, work, M):
    """M, the rates of u_i^T A v_k, i and k from `first` on, one pair a row (`steepest_ascent`)."""
    (s, nv), row = weights.shape, 0
    for i in range(first, s):
        for k in range(first, nv):
            for r in range(s):
                for j in range(nv):
                    weights[r, j] = Ut[i, r] * Vt[k, j]
            vjp(constants, weights, work, M[row])
            row += 1


@compiled_inside
def steepest_ascent(constants, Ut, sigma, Vt, weights, work, direction):
    """`singularity.steepest_ascent` into `direction`: how the lost singular values grow fastest."""
    (s, nv), rank = weights.shape, rank_of(sigma, SINGULAR_RATIO * sigma[0])
    k = nv - rank
    M, inside, along = np.empty(((s - rank) * k, nv)), np.empty(((s - rank) * k, k)), np.empty(k)
    lost_rates(constants, Ut, Vt, weights, rank, work, M)
    square = 0.0
    for i in range(M.shape[0]):
        for c in range(k):
            total = 0.0
            for j in range(nv):
                total += M[i, j] * Vt[rank + c, j]
            inside[i, c] = total
        for j in range(nv):
            square += M[i, j] * M[i, j]
            direction[j] = 0.0
    if square == 0.0:
        return
    # the largest rate of all is at most the root of `square`, and seldom less than half of it
    if leading(inside, along) > 1e-6 * math.sqrt(square):
        for c in range(k):
            for j in range(nv):
                direction[j] += along[c] * Vt[rank + c, j]
    else:
        leading(M, direction)
    largest = 0
    for j in range(nv):
        if abs(direction[j]) > abs(direction[largest]):
            largest = j
    if direction[largest] < 0.0:
        for j in range(nv):
            direction[j] = -direction[j]
