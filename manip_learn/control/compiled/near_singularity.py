"""Null-space policies, and the law near a singularity, the way out of it and the bound on its approach, as loops.

See `policies`, `singularity` and `ResolvedRateLaw`.
"""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.compiled_rows import add, dot
from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control import singularity
from manip_learn.control.compiled import step_table as table
from manip_learn.control.compiled.constrained_rows import (
    chain_rows,
    chain_vjp,
    complete,
    decompose,
    dofs_of,
    joints_at,
    leading,
    norm,
    places,
    public_rows,
    rank_of,
    truncation,
    vjp,
)
from manip_learn.control.compiled.limits import approach_rate, turn_to_freer_sense
from manip_learn.control.singularity import (
    CROSSING_SPEED,
    ESCAPE_SPEED,
    FULLY_PRESSING,
    GROWTH,
    NOTHING,
    SEED_SPEED,
    STABLE_SLOPE,
)
from manip_learn.robot.batch.compiled_kinematics import GRADIENT
from manip_learn.robot.batch.kernel_cache import compiled_inside

is_fast, seed_speed = compiled_inside(singularity.is_fast), compiled_inside(singularity.seed_speed)


@compiled_inside
def rest_velocity(constants, q, pi):
    """gain (rest - q), the short way round for joints that wrap (`JointAttractor`); zeros for no policy."""
    dofs = dofs_of(constants)
    gain = constants[0, table.POLICY_GAIN] if int(constants[0, table.POLICY]) == table.REST else 0.0
    for j in range(q.shape[0]):
        d = constants[dofs + j, table.REST_AT] - q[j]
        if constants[dofs + j, table.WRAPS] != 0.0:
            d -= 2.0 * math.pi * math.floor(d / (2.0 * math.pi) + 0.5)
        pi[j] = gain * d


@compiled_inside
def bounded_gain(constants, steepness, dt):
    """Factor on grad log mu of a norm: the gain, or less for the bound of `ManipulabilityAscent`."""
    gain, fastest = constants[0, table.POLICY_GAIN], constants[0, table.LONGEST]
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
    policy, base = int(constants[0, table.POLICY]), joints_at(s)
    if policy == table.REST or policy == table.NO_POLICY:
        rest_velocity(constants, q, work[table.PI])
        return
    work[table.PI] = 0.0
    chain_vjp(constants, X, work)
    scale = constants[0, table.POLICY_GAIN] * volume
    if policy == table.LOG_ASCENT:
        steepness = 0.0
        for j in range(joints):
            steepness += work[base + j, GRADIENT] * work[base + j, GRADIENT]
        scale = bounded_gain(constants, math.sqrt(steepness), dt)
    for j in range(joints):
        column, place = places(constants, j)
        work[table.PI, column] = scale * work[base + place, GRADIENT]


@compiled_inside
def ascent_near_singularity(constants, rows, dt, work, climb):
    """`ManipulabilityAscent.from_decomposition` into pi; Vt is complete where a direction is lost. False: Python's.

    grad log mu, or grad mu for the policy that is not logarithmic, goes into `climb`.
    """
    (s, nv), Ut, sigma, Vt, weights = rows.A.shape, rows.Ut, rows.sigma, rows.Vt, rows.weights
    smallest, edge, pi = sigma[s - 1], SINGULAR_RATIO * sigma[0], work[table.PI, :nv]
    logarithmic = int(constants[0, table.POLICY]) == table.LOG_ASCENT
    if logarithmic and constants[0, table.LONGEST] < math.inf and smallest <= edge:
        steepest_ascent(constants, Ut, sigma, Vt, weights, work, pi)
        pi *= min(constants[0, table.LONGEST], SEED_SPEED)
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
        climb *= factors[s - 1] * leading(M, climb)
    else:
        outer_sum(Ut, factors, Vt, weights)
        vjp(constants, weights, work, climb)
    scale = bounded_gain(constants, norm(climb), dt) if logarithmic else constants[0, table.POLICY_GAIN]
    pi[:] = scale * climb
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
            inside[i, c] = dot(M[i], Vt[rank + c])
        square += dot(M[i], M[i])
    direction[:] = 0.0
    if square == 0.0:
        return
    # the largest rate of all is at most the root of `square`, and seldom less than half of it
    if leading(inside, along) > 1e-6 * math.sqrt(square):
        for c in range(k):
            add(direction, along[c], Vt[rank + c])
    else:
        leading(M, direction)
    direction *= math.copysign(1.0, direction[np.argmax(np.abs(direction))])


@compiled_inside
def lost_rates(constants, Ut, Vt, weights, first, work, M):
    """M, the rates of u_i^T A v_k, i and k from `first` on, one pair a row (`steepest_ascent`)."""
    (s, nv), row = weights.shape, 0
    for i in range(first, s):
        for k in range(first, nv):
            weights[:] = np.outer(Ut[i], Vt[k])
            vjp(constants, weights, work, M[row])
            row += 1


@compiled_inside
def singular_parts(step, rows, slope):
    """Write the law near a singularity, `ResolvedRateLaw._near_singularity`, and the rank; False: Python's.

    The gradient of the smallest singular value goes into `slope` where it is needed.
    """
    constants, parts, facts, sigma, Vt = step.constants, step.parts, step.work[table.FACTS], rows.sigma, rows.Vt
    (s, nv), Ut, weights, width = rows.A.shape, rows.Ut, rows.weights, constants[1, table.ESCAPE_WIDTH]
    along, climb, row, pi = np.empty(s), np.empty(nv), np.empty(nv), step.work[table.PI, :nv]
    decompose(rows.A, s, Ut, sigma, Vt)
    singular, posed = sigma[s - 1] <= SINGULAR_RATIO * sigma[0], constants[0, table.TASK] == table.POSE
    facts[table.RANK] = rank_of(sigma, truncation(sigma, nv))
    if singular:
        if int(constants[0, table.INVERSE]) == table.EXACT:
            return False
        complete(Vt, rank_of(sigma, 0.0))
    facts[table.SMALLEST] = sigma[s - 1]
    for i in range(s):
        along[i] = dot(Ut[i], parts[table.TASK_VELOCITY])
    if not posed:  # mu and the policy are those of A, and known
        facts[table.MU] = np.prod(sigma)
        if not _policy(constants, step.q, step.dt, rows, step.work, climb):
            return False
    task_part(constants, sigma, along, constants[1, table.DAMPING], Vt, parts[table.TASK_PART])
    pressed = 0.0
    if int(constants[0, table.INVERSE]) == table.DAMPED and constants[0, table.LIMITS] != 0.0 and not singular:
        pressed = stable_damping(constants, rows, along, step.dt, row, step.work)
    if pressed <= constants[1, table.DAMPING]:
        pressed = 0.0
    escapes = not posed and constants[1, table.ESCAPES] != 0.0
    if pressed > 0.0 or (not singular and escapes and sigma[s - 1] < width):
        weights[:] = np.outer(Ut[s - 1], Vt[s - 1])
        vjp(constants, weights, step.work, slope)
    if pressed > 0.0:
        damping = pressed_damping(constants[1, table.DAMPING], pressed, slope, norm(slope), parts[table.TASK_PART])
        task_part(constants, sigma, along, damping, Vt, parts[table.TASK_PART])
    _null_part(Vt, int(facts[table.RANK]), pi, parts[table.NULL_PART])
    if escapes:  # `singularity.with_seed`
        speed, seed = norm(parts[table.NULL_PART]), seed_speed(sigma[s - 1], width)
        if NOTHING * norm(pi) < speed < seed:
            parts[table.NULL_PART] *= seed / speed
    parts[table.VELOCITY] = parts[table.TASK_PART] + parts[table.NULL_PART]
    if escapes:
        facts[table.HAS_ESCAPE] = 1.0
        if singular:  # the policy has taken the steepest ascent already
            _leave(constants, step.q, sigma, pi, parts)
        else:
            escape_velocity(sigma, Vt, step.dt, width, climb, norm(slope), parts[table.ESCAPE_PART])
        parts[table.VELOCITY] += parts[table.ESCAPE_PART]
    return math.isfinite(np.sum(parts[table.VELOCITY]))


@compiled_inside
def _leave(constants, q, sigma, pi, parts):
    """Write the velocity out of a singularity, along pi; N pi turns with it where a joint limit is in the way."""
    escape = parts[table.ESCAPE_PART]
    seed = seed_speed(sigma[sigma.shape[0] - 1], constants[1, table.ESCAPE_WIDTH])
    escape[:] = seed / min(constants[0, table.LONGEST], SEED_SPEED) * pi
    if constants[0, table.LIMITS] != 0.0:
        # mu rises in both directions out of a singularity: a limit in one of them is no reason to stay
        turn_to_freer_sense(constants, q, escape)
    if dot(escape, pi) < 0.0:
        parts[table.NULL_PART] *= -1.0


@compiled_inside
def posed_policy(constants, q, dt, rows, work):
    """The policy of an ill-conditioned A beside a pose's error, `ResolvedRateLaw._of_error_rows`, then the error's rows
    in the place of A; False: Python's.
    """
    s, nv = rows.A.shape
    joints, sigma = int(constants[0, table.N_JOINTS]), rows.sigma
    decompose(rows.A, s, rows.Ut, sigma, rows.Vt)
    if sigma[s - 1] <= SINGULAR_RATIO * sigma[0]:
        complete(rows.Vt, rank_of(sigma, 0.0))
    work[table.FACTS, table.MU] = np.prod(sigma)
    if not _policy(constants, q, dt, rows, work, np.empty(nv)):
        return False
    chain_rows(work, joints_at(s) + joints + 1, s, joints, work)
    public_rows(constants, work, rows.A)
    return True


@compiled_inside
def _policy(constants, q, dt, rows, work, climb):
    """The null-space policy's velocity, and grad log mu of an ascent into `climb`; False: Python's."""
    policy = int(constants[0, table.POLICY])
    if policy == table.ASCENT or policy == table.LOG_ASCENT:
        return ascent_near_singularity(constants, rows, dt, work, climb)
    rest_velocity(constants, q, work[table.PI])
    return True


@compiled_inside
def _null_part(Vt, rank, pi, null):
    """N pi, pi less its parts along the rows of A."""
    null[:] = pi
    for i in range(rank):
        add(null, -dot(Vt[i], null), Vt[i])


@compiled_inside
def task_part(constants, sigma, along, damping, Vt, task):
    """A^+ b = V diag(g) U^T b, where g is 1 / sigma in the controller's sense (`linalg.inverse_singular_values`)."""
    inverse, threshold = int(constants[0, table.INVERSE]), constants[0, table.THRESHOLD]
    least = math.ldexp(1.0, -1022) if inverse == table.EXACT else truncation(sigma, Vt.shape[1])
    task[:] = 0.0
    for i in range(sigma.shape[0]):
        x, gain = sigma[i], 0.0
        if inverse == table.DAMPED:
            ratio = min(x / threshold, 1.0)
            damped = damping * (1.0 - ratio * ratio)
            square = x * x + damped * damped
            gain = x / square if square > 0.0 else 0.0
        elif x > least:
            gain = 1.0 / x
        add(task, gain * along[i], Vt[i])


@compiled_inside
def smallest_weights(A, smallest, weights):
    """u_min v_min^T of one or two well-conditioned rows, from A A^T (`singularity.smallest_gradient_of`)."""
    nv = A.shape[1]
    if A.shape[0] == 1:
        for j in range(nv):
            weights[0, j] = A[0, j] / smallest
        return
    a, b, c = dot(A[0], A[0]), dot(A[0], A[1]), dot(A[1], A[1])
    half = 0.5 * (a - c)
    radius = math.hypot(half, b)
    first, second, both = (radius - half, radius + half, -b) if radius > 0.0 else (1.0, 0.0, 0.0)
    scale = 1.0 / ((2.0 * radius if radius > 0.0 else 1.0) * smallest)
    for j in range(nv):
        weights[0, j] = scale * (first * A[0, j] + both * A[1, j])
        weights[1, j] = scale * (both * A[0, j] + second * A[1, j])


@compiled_inside
def stable_damping(constants, rows, along, dt, row, work):
    """`singularity.stable_damping`; `row` (nv,) is scratch."""
    Ut, sigma, weights = rows.Ut, rows.sigma, rows.weights
    (s, nv), square, lost = weights.shape, 0.0, np.zeros(Ut.shape[0])
    for i in range(s):
        if sigma[i] < constants[0, table.THRESHOLD]:
            add(lost, along[i], Ut[i])
    if not lost.any():
        return 0.0
    for j in range(nv):
        weights[:] = 0.0
        weights[:, j] = lost
        vjp(constants, weights, work, row)
        square += dot(row, row)
    return math.sqrt(dt * math.sqrt(square) / (2.0 * STABLE_SLOPE))


@compiled_inside
def pressed_damping(damping, stable, slope, length, task):
    """`singularity.pressed_damping`, `length` the norm of the slope."""
    size = length * norm(task)
    pressing = -dot(slope, task) / size if size > 0.0 else 0.0
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
def escape_velocity(sigma, Vt, dt, width, climb, steepness, escape):
    """`singularity.escape_velocity` beside a singularity: climb is grad log mu, steepness |grad sigma_min|."""
    s, share, others = sigma.shape[0], 0.0, 0.0
    smallest = sigma[s - 1]
    escape[:] = 0.0
    if smallest >= width:
        return
    for i in range(s):
        ratio = sigma[i] / width
        share = max(0.0, 1.0 - ratio * ratio)
        share *= share
        along = dot(Vt[i], climb)
        others += (1.0 - share) * along * (1.0 - share) * along
        add(escape, share * along, Vt[i])
    ramp = dt * ESCAPE_SPEED * steepness / GROWTH
    speed = max(seed_speed(smallest, width), ESCAPE_SPEED * share * smallest / math.hypot(smallest, ramp))
    ratio = smallest / width
    length = math.hypot(norm(escape), dt * speed * others / STABLE_SLOPE * ratio * ratio)
    if length > 0.0:
        escape *= speed / length


@compiled_inside
def is_singular(sigma):
    """Whether a direction is lost; False where sigma[0] is negative: A is well-conditioned, and not decomposed yet."""
    return 0.0 <= sigma[0] and sigma[sigma.shape[0] - 1] <= SINGULAR_RATIO * sigma[0]


@compiled_inside
def may_approach(constants, A, sigma, smallest, dt, u):
    """Whether the velocity u may be too fast for a singularity of A, so that a closer look is due, by `barrier`."""
    if int(constants[0, table.INVERSE]) != table.DAMPED or is_singular(sigma):
        return False
    size, weakest, dofs = 0.0, math.inf, dofs_of(constants)
    for j in range(A.shape[1]):
        weakest = min(weakest, constants[dofs + j, table.ACCELERATION])
    for i in range(A.shape[0]):
        size += dot(A[i], A[i])
    return is_fast(dot(u, u), size, weakest, smallest, dt)


@compiled_inside
def barrier(constants, rows, dt, space, work):
    """`ResolvedRateLaw.approach`: whether the approach is to be bounded; gradient and bound go into the space.

    The gradient that is there already, in row SLOPE, is not computed again; its first entry is NaN where it is unknown.
    """
    s, nv = rows.A.shape
    gradient, smallest = space[table.SLOPE, :nv], work[table.FACTS, table.SMALLEST]
    if math.isnan(gradient[0]):
        if rows.sigma[0] < 0.0 and s <= 2:
            smallest_weights(rows.A, smallest, rows.weights)
        else:
            if rows.sigma[0] < 0.0:
                decompose(rows.A, s, rows.Ut, rows.sigma, rows.Vt)
            rows.weights[:] = np.outer(rows.Ut[s - 1], rows.Vt[s - 1])
        vjp(constants, rows.weights, work, gradient)
    return bounded_approach(constants, smallest, dt, space)


@compiled_inside
def bounded_approach(constants, smallest, dt, space):
    """Write the bound for the gradient in row SLOPE of the space, `approach_bound`; False if there is none."""
    nv = int(constants[0, table.NV])
    bound = approach_bound(constants, smallest, space[table.SLOPE, :nv], dt)
    space[table.SLOPE, nv] = -bound
    return bound < math.inf
