"""The law and the way out near a singularity, as loops over plain numbers; see `singularity` and `controller`."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control.compiled.constrained_rows import vjp
from manip_learn.control.compiled.decomposition import leading
from manip_learn.control.compiled.step_table import ACCELERATION, DAMPED, EXACT, INVERSE, THRESHOLD
from manip_learn.control.singularity import (
    APPROACH_RATE,
    BRAKING_SHARE,
    CROSSING_SPEED,
    ESCAPE_SPEED,
    FULLY_PRESSING,
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
    """V diag(g) U^T b, where g is 1 / sigma in the controller's sense (`linalg.inverse_singular_values`)."""
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
def smallest_gradient(constants, rows, s, joints, Ut, Vt, weights, work, base, gradient):
    """d sigma_min / dq = u_min^T (dA / dq) v_min into `gradient`; returns its length."""
    for i in range(s):
        for j in range(Vt.shape[1]):
            weights[i, j] = Ut[s - 1, i] * Vt[s - 1, j]
    vjp(constants, rows, s, joints, weights, work, base, gradient)
    return norm(gradient)


@compiled_inside
def norm(x):
    """Euclidean norm."""
    square = 0.0
    for k in range(x.shape[0]):
        square += x[k] * x[k]
    return math.sqrt(square)


@compiled_inside
def stable_damping(sigma, along, threshold, dt):
    """`singularity.stable_damping`."""
    beta = 0.0
    for i in range(sigma.shape[0]):
        if sigma[i] < threshold:
            beta = max(beta, abs(along[i]))
    return math.sqrt(beta * sigma[0] * dt / (2.0 * STABLE_SLOPE))


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
def approach_bound(constants, dofs, smallest, slope, length, dt):
    """`singularity.approach_bound`, `length` the norm of the slope."""
    if length == 0.0:
        return math.inf
    usable = math.inf
    for j in range(slope.shape[0]):
        usable = min(usable, constants[dofs + j, ACCELERATION] / max(abs(slope[j]), 1e-12 * length))
    deceleration = BRAKING_SHARE * length * length * usable
    rate = min(APPROACH_RATE, 0.5 / dt)
    return length * CROSSING_SPEED + min(rate * smallest, math.sqrt(2.0 * deceleration * smallest))


@compiled_inside
def seed_speed(smallest, width):
    """Speed that starts the motion out of a singularity."""
    return SEED_SPEED * max(0.0, 1.0 - smallest / (SEED_SHARE * width))


@compiled_inside
def escape_velocity(constants, rows, s, joints, Ut, sigma, Vt, dt, width, weights, work, base, escape):
    """`singularity.escape_velocity` beside a singularity, into `escape`."""
    nv, smallest = Vt.shape[1], sigma[s - 1]
    for j in range(nv):
        escape[j] = 0.0
    if smallest >= width:
        return
    seed = seed_speed(smallest, width)
    slope, ascent, inverse = np.empty(nv), np.empty(nv), np.empty(s)
    length = smallest_gradient(constants, rows, s, joints, Ut, Vt, weights, work, base, slope)
    for i in range(s):
        inverse[i] = 1.0 / sigma[i]
    outer_sum(Ut, inverse, Vt, s, weights)
    vjp(constants, rows, s, joints, weights, work, base, ascent)
    share = 0.0
    for i in range(s):
        ratio = sigma[i] / width
        share = max(0.0, 1.0 - ratio * ratio)
        share *= share
        along = 0.0
        for j in range(nv):
            along += Vt[i, j] * ascent[j]
        for j in range(nv):
            escape[j] += share * along * Vt[i, j]
    size = norm(escape)
    if size == 0.0:
        return
    ramp = dt * ESCAPE_SPEED * length / STABLE_SLOPE
    speed = ESCAPE_SPEED * share * smallest / math.hypot(smallest, ramp)
    for j in range(nv):
        escape[j] *= max(speed, seed) / size


@compiled_inside
def outer_sum(Ut, factors, Vt, s, weights):
    """weights = sum_i factors_i u_i v_i^T."""
    for r in range(s):
        for j in range(Vt.shape[1]):
            total = 0.0
            for i in range(s):
                total += factors[i] * Ut[i, r] * Vt[i, j]
            weights[r, j] = total


@compiled_inside
def lost_rates(constants, rows, s, joints, Ut, first, Vt, null, weights, work, base, M):
    """M, the rates of u_i^T A v_k, i from `first` on and k from `null` on, one pair a row (`steepest_ascent`)."""
    nv, row = Vt.shape[1], 0
    for i in range(first, s):
        for k in range(null, nv):
            for r in range(s):
                for j in range(nv):
                    weights[r, j] = Ut[i, r] * Vt[k, j]
            vjp(constants, rows, s, joints, weights, work, base, M[row])
            row += 1


@compiled_inside
def steepest_ascent(constants, rows, s, joints, Ut, sigma, Vt, weights, work, base, direction):
    """`singularity.steepest_ascent` into `direction`: how the lost singular values grow fastest."""
    nv, rank = Vt.shape[1], rank_of(sigma, SINGULAR_RATIO * sigma[0])
    k = nv - rank
    M, inside, along = np.empty(((s - rank) * k, nv)), np.empty(((s - rank) * k, k)), np.empty(k)
    lost_rates(constants, rows, s, joints, Ut, rank, Vt, rank, weights, work, base, M)
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
