"""One control step as loops over plain numbers: the law of `controller` away from singularities and position limits.

numba compiles these functions (the optional extra `fast`); without it they are plain Python, the same function objects.
Postures where `linalg.row_inverse` would refuse are handed back to Python, so that singularities and null-space
saturation are treated in one place.
"""

from __future__ import annotations

import math

from manip_learn.control.approach import APPROACH_RATE
from manip_learn.control.approach import BRAKING_SHARE as LIMIT_BRAKING_SHARE
from manip_learn.control.kernel_linalg import row_inverse
from manip_learn.control.singularity import APPROACH_RATE as SINGULAR_RATE
from manip_learn.control.singularity import BRAKING_SHARE, STABLE_SLOPE
from manip_learn.control.status import STATUSES, Status
from manip_learn.robot.batch.compiled_kinematics import (
    JOINTS,
    LARGEST_ANGLE,
    LOCAL,
    OFFSET,
    PRISMATIC,
    SIGN,
    SOURCE,
    columns_of,
    sine_and_cosine,
)
from manip_learn.robot.batch.kernel_cache import compiled

REFUSED = -1  # too close to a singularity, at a position limit, or not finite: Python decides
OK = STATUSES.index(Status.OK)  # all other statuses are Python's
NO_POLICY, ASCENT, LOG_ASCENT, REST = 0, 1, 2, 3

# The constants of a controller are one table of twelve columns: this row, the chain's table, one row per degree of
# freedom (velocity limit, lower, upper, rest posture, whether it wraps, acceleration limit), and one per row of Lambda
# (padded to six).
N_JOINTS, NV, N_CONSTRAINTS, POLICY, POLICY_GAIN, DAMPS, THRESHOLD, LIMITS, REACHES, GAIN, MAX_SPEED, LONGEST = range(
    12
)
CHAIN = 1
TARGET_POINT = 6  # column of the chain's second row, after the tool's position, sign and reference
LIMIT, LOWER, UPPER, REST_AT, WRAPS, ACCELERATION = range(6)

# Rows of the results: three parts of the command, b, and numbers; the rows after that are scratch.
VELOCITY, TASK_PART, NULL_PART, TASK_VELOCITY, FACTS, PI, MATRICES = range(7)
MU, SMALLEST, ERROR = range(3)
# columns of a joint's row of scratch, after (v, w) and the origin
WEIGHTS, SLIDE, GRADIENT = 9, 15, 18
LEAST_WIDTH = 19


@compiled
def jacobian_vjp(work, base, joints, local):
    """sum_ij weights_ji dJ_ij / dq_k for each joint k, base first, into the column GRADIENT of the joints' rows.

    The formulas of `robot.batch.jacobian.jacobian_vjp`.
    """
    f0 = f1 = f2 = m0 = m1 = m2 = 0.0
    for k in range(base, base + joints):  # joints above k
        v0, v1, v2, w0, w1, w2 = six(work, k, 0)
        a0, a1, a2, b0, b1, b2 = six(work, k, WEIGHTS)
        total = v0 * f0 + v1 * f1 + v2 * f2
        if local:
            total += w0 * m0 + w1 * m1 + w2 * m2
            m0 += a1 * v2 - a2 * v1 + b1 * w2 - b2 * w1
            m1 += a2 * v0 - a0 * v2 + b2 * w0 - b0 * w2
            m2 += a0 * v1 - a1 * v0 + b0 * w1 - b1 * w0
        work[k, GRADIENT] = total
        f0 += a1 * w2 - a2 * w1
        f1 += a2 * w0 - a0 * w2
        f2 += a0 * w1 - a1 * w0
    if local:
        return
    for k in range(base + joints - 1, base - 1, -1):  # joint k and those below
        v0, v1, v2, w0, w1, w2 = six(work, k, 0)
        a0, a1, a2, b0, b1, b2 = six(work, k, WEIGHTS)
        m0 += v1 * a2 - v2 * a1 + w1 * b2 - w2 * b1
        m1 += v2 * a0 - v0 * a2 + w2 * b0 - w0 * b2
        m2 += v0 * a1 - v1 * a0 + w0 * b1 - w1 * b0
        work[k, GRADIENT] += w0 * m0 + w1 * m1 + w2 * m2


@compiled
def six(table, k, at):
    """Six neighbouring entries of a row."""
    return table[k, at], table[k, at + 1], table[k, at + 2], table[k, at + 3], table[k, at + 4], table[k, at + 5]


@compiled
def allowed_speed(distance, velocity, acceleration, dt):
    """Fastest approach to a position limit with a deceleration, as `limits.Limits`."""
    rate = min(APPROACH_RATE, 0.5 / dt)
    half = 0.5 * acceleration * dt
    joined = acceleration / rate - half
    linear = joined / rate
    if distance <= linear:
        return min(rate * distance, velocity)
    offset = linear - joined * (joined + acceleration * dt) / (2.0 * acceleration)
    return min(math.sqrt(half * half + 2.0 * acceleration * (distance - offset)) - half, velocity)


@compiled
def admitted(constants, dofs, nv, q, dt, u, previous):
    """Whether `Limits.bounds` admit the velocity u; `previous` is NaN where no acceleration is bounded."""
    for j in range(nv):
        k = dofs + j
        v, a = constants[k, LIMIT], constants[k, ACCELERATION]
        above, below = constants[k, UPPER] - q[j], q[j] - constants[k, LOWER]
        if above < 0.0 or below < 0.0:
            return False
        distance = above if u[j] > 0.0 else below
        if abs(u[j]) > allowed_speed(distance, v, LIMIT_BRAKING_SHARE * a, dt) or abs(u[j] - previous[j]) > a * dt:
            return False
    return True


@compiled
def turn_joints(constants, joints, q, out, base):
    """Slide, sine and cosine of each joint, for `columns_of`."""
    for j in range(joints):
        k = CHAIN + JOINTS + j
        x = constants[CHAIN + 1, SIGN] * q[int(constants[k, SOURCE])]
        angle = constants[k, OFFSET] + (1.0 - constants[k, PRISMATIC]) * x
        out[base + j, SLIDE] = x
        if abs(angle) > LARGEST_ANGLE:
            out[base + j, SLIDE + 1], out[base + j, SLIDE + 2] = math.sin(angle), math.cos(angle)
        else:
            out[base + j, SLIDE + 1], out[base + j, SLIDE + 2] = sine_and_cosine(angle)


@compiled
def task_velocity(constants, rows, s, p0, p1, p2, out):
    """Write the task velocity b = gain Lambda (r* - r(q)), norm at most max_speed, into `out`; return the error."""
    error = 0.0
    if constants[0, REACHES] == 0.0:
        for i in range(s):
            out[TASK_VELOCITY, i] = 0.0
        return error
    at = CHAIN + 1
    d0, d1 = constants[at, TARGET_POINT] - p0, constants[at, TARGET_POINT + 1] - p1
    d2 = constants[at, TARGET_POINT + 2] - p2
    for i in range(s):
        b = constants[rows + i, 0] * d0 + constants[rows + i, 1] * d1 + constants[rows + i, 2] * d2
        out[TASK_VELOCITY, i] = b
        error += b * b
    error = math.sqrt(error)
    gain, fastest = constants[0, GAIN], constants[0, MAX_SPEED]
    if gain * error > fastest:
        gain *= fastest / (gain * error)
    for i in range(s):
        out[TASK_VELOCITY, i] *= gain
    return error


@compiled
def policy_velocity(constants, dofs, rows, nv, joints, s, q, dt, volume, X, out, base):
    """Write the null-space policy's velocity pi, away from singularities, into `out`.

    Manipulability ascent is equation (13), grad mu = mu A^{+T} : dA/dq, or grad log mu without the factor mu.
    """
    policy, gain = int(constants[0, POLICY]), constants[0, POLICY_GAIN]
    for j in range(nv):
        out[PI, j] = 0.0
    if policy == REST:
        for j in range(nv):
            d = constants[dofs + j, REST_AT] - q[j]
            if constants[dofs + j, WRAPS] != 0.0:
                d -= 2.0 * math.pi * math.floor(d / (2.0 * math.pi) + 0.5)
            out[PI, j] = gain * d
    elif policy != NO_POLICY:
        for j in range(joints):
            for k in range(6):
                total = 0.0
                for i in range(s):
                    total += X[i, j] * constants[rows + i, k]
                out[base + j, WEIGHTS + k] = total
        jacobian_vjp(out, base, joints, constants[CHAIN + 1, LOCAL] != 0.0)
        scale = gain * volume
        if policy == LOG_ASCENT:
            steepness = 0.0
            for j in range(joints):
                steepness += out[base + j, GRADIENT] * out[base + j, GRADIENT]
            steepness = math.sqrt(steepness)
            fastest = constants[0, LONGEST]
            ramp = dt * fastest * steepness / STABLE_SLOPE
            longest = fastest / math.sqrt(1.0 + ramp * ramp)
            scale = gain if not gain * steepness > longest else longest / steepness
        for j in range(joints):
            k = CHAIN + JOINTS + j
            out[PI, int(constants[k, SOURCE])] = scale * out[base + int(constants[k, 1]), GRADIENT]


@compiled
def control_step(constants, q, dt, previous, out):
    """Write one command, u = A^+ b + N pi, into the rows of `out`; return its status, or REFUSED."""
    joints, nv, s = int(constants[0, N_JOINTS]), int(constants[0, NV]), int(constants[0, N_CONSTRAINTS])
    for j in range(nv):
        if not math.isfinite(q[j]):
            return REFUSED
    dofs = CHAIN + JOINTS + joints
    rows, base = dofs + nv, MATRICES + 3 * s
    turn_joints(constants, joints, q, out, base)
    p0, p1, p2 = columns_of(constants, CHAIN, joints, out, base, SLIDE, 1, out, base)
    A, X = out[MATRICES : MATRICES + s, :joints], out[MATRICES + s : MATRICES + 2 * s, :joints]
    for i in range(s):
        for j in range(joints):
            # the joint that moves column j, as many as there are from the base
            total = 0.0
            for k in range(6):
                total += constants[rows + i, k] * out[base + j, k]
            A[i, j] = total
    squares = out[MATRICES + 2 * s : MATRICES + 3 * s]
    volume, smallest = row_inverse(A, X, squares[:, :s], squares[:, s : 2 * s])
    if volume == 0.0 or (constants[0, DAMPS] != 0.0 and smallest < constants[0, THRESHOLD]):
        return REFUSED
    out[FACTS, ERROR] = task_velocity(constants, rows, s, p0, p1, p2, out)
    policy_velocity(constants, dofs, rows, nv, joints, s, q, dt, volume, X, out, base)
    for j in range(nv):
        out[TASK_PART, j] = 0.0
        out[NULL_PART, j] = out[PI, j]
    for i in range(s):
        along = 0.0
        for j in range(joints):
            k = CHAIN + JOINTS + j
            along += A[i, int(constants[k, 1])] * out[PI, int(constants[k, SOURCE])]
        for j in range(joints):
            k = CHAIN + JOINTS + j
            x, column = X[i, int(constants[k, 1])], int(constants[k, SOURCE])
            out[TASK_PART, column] += out[TASK_VELOCITY, i] * x
            out[NULL_PART, column] -= along * x
    size = 0.0
    for i in range(s):
        for j in range(joints):
            size += A[i, j] * A[i, j]
    out[FACTS, MU], out[FACTS, SMALLEST] = volume, smallest
    return limited(constants, dofs, nv, q, dt, previous, smallest, size, out)


@compiled
def limited(constants, dofs, nv, q, dt, previous, smallest, size, out):
    """The sum of the two parts, if no limit changes it; see `ResolvedRateController`."""
    square, weakest = 0.0, math.inf
    for j in range(nv):
        u = out[TASK_PART, j] + out[NULL_PART, j]
        out[VELOCITY, j] = u
        square += u * u
        weakest = min(weakest, constants[dofs + j, ACCELERATION])
    if not math.isfinite(square):
        return REFUSED
    if constants[0, LIMITS] == 0.0:
        return OK
    rate = min(SINGULAR_RATE, 0.5 / dt) * smallest
    if constants[0, DAMPS] != 0.0:
        # too fast to stop at a singularity? Python takes a closer look
        if square * size >= min(2.0 * BRAKING_SHARE * weakest * math.sqrt(size) * smallest, rate * rate):
            return REFUSED
    return OK if admitted(constants, dofs, nv, q, dt, out[VELOCITY], previous) else REFUSED


@compiled
def rollout(constants, first, dt, rk4, q, u, mu, error, code, out, point, slope, previous):
    """`integration.next_posture` from row `first` of q (T, nv) on; returns the row that Python must do, or T.

    `previous` is the velocity before row `first`, NaN for every step where no acceleration is bounded.
    """
    nv, steps = q.shape[1], q.shape[0]
    for i in range(first, steps):
        for j in range(nv):
            point[j], slope[j] = q[i, j], 0.0
        for stage in range(4 if rk4 and i + 1 < steps else 1):
            if stage > 0:
                length = dt if stage == 3 else 0.5 * dt
                for j in range(nv):
                    point[j] = q[i, j] + length * out[VELOCITY, j]
            done = control_step(constants, point, dt, previous, out)
            if done == REFUSED:
                return i
            if stage == 0:
                code[i], mu[i], error[i] = done, out[FACTS, MU], out[FACTS, ERROR]
                for j in range(nv):
                    u[i, j] = out[VELOCITY, j]
                    if not math.isnan(previous[j]):
                        previous[j] = u[i, j]
            weight = 2.0 if stage == 1 or stage == 2 else 1.0
            for j in range(nv):
                slope[j] += weight * out[VELOCITY, j]
        if i + 1 < steps:
            factor = dt / 6.0 if rk4 else dt
            for j in range(nv):
                q[i + 1, j] = q[i, j] + factor * slope[j]
    return steps


def results_shape(joints: int, nv: int, s: int) -> tuple[int, int]:
    """Shape of the array that `control_step` writes its results and its scratch into."""
    return MATRICES + 3 * s + joints, max(LEAST_WIDTH, nv, 2 * s)
