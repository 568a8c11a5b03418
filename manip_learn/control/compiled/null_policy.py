"""Null-space policies as loops over plain numbers, away from singularities and near them; see `policies`."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control.compiled.constrained_rows import (
    chain_vjp,
    dofs_of,
    joints_at,
    leading,
    norm,
    places,
    rank_of,
    vjp,
)
from manip_learn.control.compiled.step_table import (
    LOG_ASCENT,
    LONGEST,
    NO_POLICY,
    PI,
    POLICY,
    POLICY_GAIN,
    REST,
    REST_AT,
    WRAPS,
)
from manip_learn.control.singularity import GROWTH, SEED_SPEED
from manip_learn.robot.batch.compiled_kinematics import GRADIENT
from manip_learn.robot.batch.kernel_cache import compiled_inside


@compiled_inside
def rest_velocity(constants, q, pi):
    """gain (rest - q), the short way round for joints that wrap (`JointAttractor`); zeros for no policy."""
    dofs = dofs_of(constants)
    gain = constants[0, POLICY_GAIN] if int(constants[0, POLICY]) == REST else 0.0
    for j in range(q.shape[0]):
        d = constants[dofs + j, REST_AT] - q[j]
        if constants[dofs + j, WRAPS] != 0.0:
            d -= 2.0 * math.pi * math.floor(d / (2.0 * math.pi) + 0.5)
        pi[j] = gain * d


@compiled_inside
def bounded_gain(constants, steepness, dt):
    """Factor on grad log mu of a norm: the gain, or less for the bound of `ManipulabilityAscent`."""
    gain, fastest = constants[0, POLICY_GAIN], constants[0, LONGEST]
    if fastest == math.inf:
        return gain
    ramp = dt * fastest * steepness / GROWTH
    longest = fastest / math.sqrt(1.0 + ramp * ramp)
    return gain if not gain * steepness > longest else longest / steepness


@compiled_inside
def policy_velocity(constants, q, dt, volume, X, work):
    """Write the null-space policy's velocity pi, away from singularities, into the work space.

    Manipulability ascent is equation (13), grad mu = mu A^{+T} : dA/dq, or grad log mu without the factor mu.
    """
    s, joints = X.shape
    policy, base = int(constants[0, POLICY]), joints_at(s)
    if policy == REST or policy == NO_POLICY:
        rest_velocity(constants, q, work[PI])
        return
    for j in range(q.shape[0]):
        work[PI, j] = 0.0
    chain_vjp(constants, X, work)
    scale = constants[0, POLICY_GAIN] * volume
    if policy == LOG_ASCENT:
        steepness = 0.0
        for j in range(joints):
            steepness += work[base + j, GRADIENT] * work[base + j, GRADIENT]
        scale = bounded_gain(constants, math.sqrt(steepness), dt)
    for j in range(joints):
        column, place = places(constants, j)
        work[PI, column] = scale * work[base + place, GRADIENT]


@compiled_inside
def ascent_near_singularity(constants, rows, dt, work, climb):
    """`ManipulabilityAscent.from_decomposition` into pi; Vt is complete where a direction is lost. False: Python's.

    grad log mu, or grad mu for the policy that is not logarithmic, goes into `climb`.
    """
    (s, nv), Ut, sigma, Vt, weights = rows.A.shape, rows.Ut, rows.sigma, rows.Vt, rows.weights
    smallest, edge, pi = sigma[s - 1], SINGULAR_RATIO * sigma[0], work[PI, :nv]
    logarithmic = int(constants[0, POLICY]) == LOG_ASCENT
    if logarithmic and constants[0, LONGEST] < math.inf and smallest <= edge:
        steepest_ascent(constants, Ut, sigma, Vt, weights, work, pi)
        for j in range(nv):
            pi[j] *= min(constants[0, LONGEST], SEED_SPEED)
        return True
    if smallest <= edge and (logarithmic or (s > 1 and sigma[s - 2] <= edge)):
        return False
    factors = np.empty(s)
    for i in range(s):  # grad log mu has 1 / sigma_i, grad mu the product of the others
        factors[i] = 1.0
        for k in range(s):
            if k != i and not logarithmic:
                factors[i] *= sigma[k]
        if logarithmic:
            factors[i] /= sigma[i]
    if smallest <= edge:  # steepest ascent of the cone, `manipulability._cone_ascent`
        M = np.empty((nv - s + 1, nv))
        lost_rates(constants, Ut, Vt, weights, s - 1, work, M)
        rate = factors[s - 1] * leading(M, climb)
        for j in range(nv):
            climb[j] *= rate
    else:
        outer_sum(Ut, factors, Vt, weights)
        vjp(constants, weights, work, climb)
    scale = bounded_gain(constants, norm(climb), dt) if logarithmic else constants[0, POLICY_GAIN]
    for j in range(nv):
        pi[j] = scale * climb[j]
    return True


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
