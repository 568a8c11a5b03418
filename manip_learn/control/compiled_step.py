"""The law compiled: numba makes machine code of the source that NumPy runs, and the loops of a rollout about it."""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn import linalg
from manip_learn.constraint import compiled_matrices, manipulability, small_matrices
from manip_learn.constraint.compiled_matrices import dot, row_inverse
from manip_learn.control import (
    bounded_velocity,
    compiled_posture,
    limits,
    outcome,
    polytope_projection,
    resolved_rate_law,
    singularity,
)
from manip_learn.control.compiled_posture import (
    POSE,
    FrameRows,
    Motion,
    Reach,
    Rest,
    posture,
    product,
    rest_velocity,
    work_space,
)
from manip_learn.control.limits import LimitTable
from manip_learn.control.outcome import (
    ESCAPE_PART,
    NULL_PART,
    OK,
    STALLED,
    TASK_PART,
    TASK_VELOCITY,
    VELOCITY,
)
from manip_learn.control.resolved_rate_law import DAMPED, EXACT, Asked, LawSettings
from manip_learn.robot import weighted_vjp
from manip_learn.robot.batch.compiled_kinematics import JOINTS, WIDTH
from manip_learn.robot.batch.kernel_cache import compiled, compiled_inside, compiled_with_caller, twins

REFUSED = -1  # Python decides: what is not finite, and lost directions that "exact" inverts


@compiled_inside
def project(x, C, low, high, by_library):
    """`polytope_projection.project` without a library."""
    return project_by_active_set(x, C, low, high)


_LAW = twins(
    (linalg, manipulability, limits, singularity, polytope_projection, bounded_velocity, resolved_rate_law, outcome),
    {
        small_matrices.dot: compiled_matrices.dot,
        small_matrices.put: compiled_matrices.put,
        small_matrices.unit: compiled_matrices.unit,
        small_matrices.complement: compiled_matrices.complement,
        small_matrices.svd: compiled_matrices.svd,
        small_matrices.row_inverse: compiled_matrices.row_inverse,
        small_matrices.leading: compiled_matrices.leading,
        weighted_vjp.gradient: compiled_posture.gradient,
        weighted_vjp.vjps: compiled_posture.vjps,
        polytope_projection.project: project,
    },
)
project_by_active_set = _LAW[polytope_projection.project_by_active_set]
limit_table, keeps, slide_after = _LAW[limits.limit_table], _LAW[limits.keeps], _LAW[outcome.slide_after]
position_bounds, bound_changes = _LAW[limits.position_bounds], _LAW[limits.bound_changes]
approach_bound, ascent_gain = _LAW[singularity.approach_bound], _LAW[singularity.ascent_gain]
smallest_gradient_of, is_slow = _LAW[singularity.smallest_gradient_of], _LAW[resolved_rate_law.is_slow]
is_regular = _LAW[resolved_rate_law.is_regular]
regular_law = _LAW[resolved_rate_law.regular_law]
law_at, approach = _LAW[resolved_rate_law.law_at], _LAW[resolved_rate_law.approach]
barrier_of, within_limits, plain_outcome = (
    _LAW[f] for f in (outcome.barrier_of, outcome.within_limits, outcome.plain_outcome)
)


@final
class Constants(NamedTuple):
    """All that a compiled controller is made of; arrays in one, as each that is handed over takes a while.

    Attributes:
        settings: Of the law.
        form: Of `FrameRows`.
        s: Number of rows.
        nv: Number of degrees of freedom.
        joints: Number of joints of the chain.
        kind: Of `Reach`.
        gain: Of `Reach`.
        max_speed: Of `Reach`.
        rest_gain: Of `Rest`.
        dt: Usual length of a step [s].
        weakest: Smallest acceleration limit.
        numbers: The chain's table, Lambda's, the arrays of `LimitTable`, positions at rest and which of them wrap, the
            target's place and rotation.
    """

    settings: LawSettings
    form: int
    s: int
    nv: int
    joints: int
    kind: int
    gain: float
    max_speed: float
    rest_gain: float
    dt: float
    weakest: float
    numbers: Float[np.ndarray, " n"]


@compiled_inside
def unpacked(constants, dt):
    """The rows, the task, the policy and the limits for steps of dt [s]."""
    c, nv, at = constants, constants.nv, WIDTH * (JOINTS + constants.joints)
    x = c.numbers
    behind = x.shape[0] - 9 * nv - 12
    chain, weights = x[:at].reshape((-1, WIDTH)), x[at:behind].reshape((-1, WIDTH))
    n = x[behind : behind + 9 * nv].reshape((9, nv))
    target = x[behind + 9 * nv :]
    limits = LimitTable(n[0], n[1], n[2], n[3], n[4], n[5], n[6], c.weakest, c.dt)
    if dt != c.dt:
        limits = limit_table(n[0], n[1], n[2], n[3], dt)
    return (
        FrameRows(chain, weights, c.form, c.s, nv),
        Reach(c.kind, c.gain, c.max_speed, target[:3], target[3:].reshape((3, 3))),
        Rest(c.rest_gain, n[7], n[8]),
        limits,
    )


@compiled_inside
def bounds_at(table, q, previous, known):
    """`Limits.bounds`."""
    bounds = position_bounds(table, q, table.velocity)
    return bound_changes(bounds, previous, table.acceleration, table.dt) if known else bounds


@compiled_with_caller
def free_step(settings, table, asked, previous, motion, inverse, parts):
    """The law of a well-conditioned A where nothing limits it, as in most steps, in loops over plain numbers.

    `regular_law` and `plain_outcome` give the same in arrays, in twice the time. `asked.pi` is what it says afterwards,
    also for a policy that climbs mu.

    Returns:
        Whether that is so, and the command is written; the bound on the approach to a singularity, and the gradient of
        the smallest singular value where there is one.
    """
    A, pi, (X, mu, smallest) = asked.A, asked.pi, inverse
    s, nv = A.shape
    if settings.climbs:
        square = 0.0
        product(motion, X, 0, pi)
        for j in range(nv):
            square += pi[j] * pi[j]
        gain = ascent_gain(settings.ascent, square, mu, table.dt)
        for j in range(nv):
            pi[j] *= gain
    size = speed = 0.0
    for j in range(nv):
        parts[TASK_PART, j], parts[NULL_PART, j] = 0.0, pi[j]
    for i in range(s):
        along = 0.0
        for j in range(nv):
            along += A[i, j] * pi[j]
            size += A[i, j] * A[i, j]
        for j in range(nv):
            parts[TASK_PART, j] += asked.b[i] * X[i, j]
            parts[NULL_PART, j] -= along * X[i, j]
    for j in range(nv):
        parts[VELOCITY, j] = parts[TASK_PART, j] + parts[NULL_PART, j]
        speed += parts[VELOCITY, j] * parts[VELOCITY, j]
    bound, slope = math.inf, pi
    if settings.inverse == DAMPED and settings.limited and not is_slow(table, smallest, speed, size):
        slope = smallest_gradient_of(A, X, mu, smallest, motion)
        bound = approach_bound(smallest, slope, table.acceleration, table.dt)
    known = not math.isnan(previous[0])
    slow = bound == math.inf or -dot(slope, parts[VELOCITY]) <= bound
    free = slow and (not settings.limited or keeps(table, asked.q, parts[VELOCITY], previous, known))
    return free and math.isfinite(speed), bound, slope


@compiled_with_caller
def control_step(settings, arm, q, previous, slide, parts, work):
    """Write one command, u = A^+ b + N pi within the limits; return its status, or REFUSED, and its numbers.

    Args:
        settings: Of the law.
        arm: See `unpacked`.
        q: Joint positions [rad or m].
        previous: Velocity in the step before [rad/s or m/s], NaN where no acceleration is bounded.
        slide: See `ResolvedRateController`.
        parts: The velocity, its parts and b, in its rows.
        work: Scratch, `work_space`.

    Returns:
        Status, mu, smallest singular value, scales of the task and of the null-space part, progress, outside, limiting
        joint, whether there is a velocity out of a singularity, and the task's error.
    """
    rows, reach, rest, table = arm
    A, E, b, error = posture(rows, reach, q, work)
    motion, pi, own = Motion(rows, work), rest_velocity(rest, q), reach.kind != POSE
    for i in range(b.shape[0]):
        parts[TASK_VELOCITY, i] = b[i]
    asked = Asked(A, E, own, b, pi, q, table.dt)
    X, mu, smallest = row_inverse(A)
    regular, bound, slope = own and is_regular(settings, mu, smallest), math.inf, pi
    if regular:
        free, bound, slope = free_step(settings, table, asked, previous, motion, (X, mu, smallest), parts)
        if free:
            return OK, mu, smallest, 1.0, 1.0, 1.0, 0.0, -1, False, error
        law = regular_law(asked, pi, X, mu, smallest)
    else:
        law = law_at(settings, table, asked, motion)
    velocity = law.desired.task + law.desired.null + law.desired.escape
    total = 0.0
    for j in range(q.shape[0]):
        total += velocity[j]
    code = OK
    if not math.isfinite(total) or (law.singular and settings.inverse == EXACT):
        code = REFUSED
    if not regular:
        near, slope = approach(settings, table, law, motion, velocity)
        bound = approach_bound(law.smallest, slope, table.acceleration, table.dt) if near else math.inf
    known = not math.isnan(previous[0])
    plain = code == REFUSED or not settings.limited
    if plain or (-dot(slope, velocity) <= bound and keeps(table, q, velocity, previous, known)):
        found = plain_outcome(settings, law, velocity, 0.0)
    else:
        G, least = barrier_of(slope, bound)
        found = within_limits(settings, table, law, bounds_at(table, q, previous, known), slide, G, least)
    for j in range(q.shape[0]):
        parts[VELOCITY, j], parts[TASK_PART, j], parts[NULL_PART, j] = found.velocity[j], found.task[j], found.null[j]
        parts[ESCAPE_PART, j] = found.escape[j]
    scales, told = (found.task_scale, found.null_scale), (found.progress, found.outside, found.joint)
    return (REFUSED if code == REFUSED else found.code, law.mu, law.smallest, *scales, *told, law.escapes, error)


@compiled
def commands(constants, q, dt, rk4, first, previous, slide, parts, u, mu, error, code):
    """Commands from row `first` of q (T, nv) on; with room in `code`, a rollout that writes the rows behind it.

    Args:
        constants: Of the controller.
        q: Joint positions [rad or m].
        dt: Length of a step [s].
        rk4: Whether steps are of the classic Runge-Kutta scheme, and not of Euler's.
        first: See above.
        previous: Velocity in the step before [rad/s or m/s], NaN where no acceleration is bounded; a rollout that
            bounds them keeps it.
        slide: See `ResolvedRateController`.
        parts: The last command's velocity, its parts and b, in its rows.
        u: Velocities (T, nv).
        mu: Their manipulabilities (T,).
        error: Their task's errors (T,).
        code: Their statuses (T,), or nothing where one command is all that is asked for.

    Returns:
        The row that Python must do, or T; `slide`, and what `control_step` returns of the last command.
    """
    steps, nv = q.shape
    arm = unpacked(constants, dt)
    work, point, slope = work_space(arm[0]), np.empty(nv), np.empty(nv)
    bounded, recorded = not math.isnan(previous[0]), code.shape[0] > 0
    found = REFUSED, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1, False, 0.0
    for i in range(first, steps):
        finite = 0.0
        for j in range(nv):
            point[j], slope[j] = q[i, j], 0.0
            finite += q[i, j]
        if not math.isfinite(finite):
            return (i, slide, *found)
        for stage in range(4 if rk4 and i + 1 < steps else 1):
            if stage > 0:
                length = dt if stage == 3 else 0.5 * dt
                for j in range(nv):
                    point[j] = q[i, j] + length * parts[VELOCITY, j]
            found = control_step(constants.settings, arm, point, previous, slide, parts, work)
            if found[0] == REFUSED:
                return (i, slide, *found)
            if stage == 0 and recorded:
                code[i], mu[i], error[i] = found[0], found[1], found[9]
                for j in range(nv):
                    u[i, j] = parts[VELOCITY, j]
                    if bounded:
                        previous[j] = u[i, j]
                if bounded:
                    slide = slide_after(slide, found[0] == STALLED, found[5], dt)
            weight = 2.0 if stage == 1 or stage == 2 else 1.0
            for j in range(nv):
                slope[j] += weight * parts[VELOCITY, j]
        if i + 1 < steps:
            factor = dt / 6.0 if rk4 else dt
            for j in range(nv):
                q[i + 1, j] = q[i, j] + factor * slope[j]
    return (steps, slide, *found)


@compiled
def bounded_law(settings, table, law, q, previous, known, slide, bound):
    """Bring a law that Python has computed within the limits: the outcome.

    Args:
        settings: Of the law.
        table: Limits, for steps of the length asked for.
        law: Of this posture.
        q: Joint positions [rad or m].
        previous: Velocity in the step before [rad/s or m/s].
        known: Whether there is one.
        slide: See `ResolvedRateController`.
        bound: On the approach to a singularity, against the law's slope; inf for none.
    """
    G, least = barrier_of(law.slope, bound)
    return within_limits(settings, table, law, bounds_at(table, q, previous, known), slide, G, least)
