"""`limits.Limits` as loops over plain numbers: bounds on the next velocity, and what they do to it."""

from __future__ import annotations

import math

from manip_learn.control.approach import APPROACH_RATE, BRAKING_SHARE, RETURN_SPEED
from manip_learn.control.compiled.constrained_rows import dofs_of
from manip_learn.control.compiled.step_table import (
    ACCELERATION,
    FOUND,
    HIGH,
    HIGH_CAUSE,
    LIMIT,
    LOW,
    LOW_CAUSE,
    LOWER,
    NULL_PART,
    TASK_PART,
    UPPER,
)
from manip_learn.control.limits import ACCELERATION as BY_ACCELERATION
from manip_learn.control.limits import AT_BOUND, ROOM_TO_LEAVE
from manip_learn.control.limits import OUTSIDE as LEAST_OUTSIDE
from manip_learn.control.limits import POSITION as BY_POSITION
from manip_learn.control.limits import VELOCITY as BY_VELOCITY
from manip_learn.robot.batch.kernel_cache import compiled_inside


@compiled_inside
def allowed_speed(distance, velocity, acceleration, dt):
    """Fastest approach to a position limit with a deceleration, as `Approach`; negative outside it."""
    rate = min(APPROACH_RATE, 0.5 / dt)
    half = 0.5 * acceleration * dt
    joined = acceleration / rate - half
    linear = joined / rate
    if distance <= linear:
        return min(max(rate * distance, -RETURN_SPEED * min(velocity, 1e6)), velocity)
    offset = linear - joined * (joined + acceleration * dt) / (2.0 * acceleration)
    return min(math.sqrt(half * half + 2.0 * acceleration * (distance - offset)) - half, velocity)


@compiled_inside
def admitted(constants, q, dt, u, previous):
    """Whether `Limits.bounds` admit the velocity u; `previous` is NaN where no acceleration is bounded.

    `allowed_speed` with the squares of both sides, which needs neither its root nor its divisions.
    """
    rate, dofs = min(APPROACH_RATE, 0.5 / dt), dofs_of(constants)
    period = 1.0 / rate
    for j in range(q.shape[0]):
        k = dofs + j
        v, a, speed = constants[k, LIMIT], constants[k, ACCELERATION], abs(u[j])
        above, below = constants[k, UPPER] - q[j], q[j] - constants[k, LOWER]
        if above < 0.0 or below < 0.0:
            return False
        if speed > v or abs(u[j] - previous[j]) > a * dt:
            return False
        distance = above if u[j] > 0.0 else below
        a *= BRAKING_SHARE
        half = 0.5 * a * dt
        joined = a * period - half
        beyond = distance - joined * period
        if beyond <= 0.0:
            if speed > rate * distance:
                return False
        elif speed * (speed + 2.0 * half) > 2.0 * a * beyond + joined * (joined + a * dt):
            return False
    return True


@compiled_inside
def bounds_of(constants, q, dt, previous, space):
    """`Limits.bounds`: write the lowest and highest velocities and their causes; return how far a joint is outside."""
    outside, dofs = 0.0, dofs_of(constants)
    for j in range(q.shape[0]):
        k = dofs + j
        v, a = constants[k, LIMIT], constants[k, ACCELERATION]
        above, below = constants[k, UPPER] - q[j], q[j] - constants[k, LOWER]
        bottom, top, bottom_cause, top_cause = -v, v, BY_VELOCITY, BY_VELOCITY
        fastest = allowed_speed(above, v, BRAKING_SHARE * a, dt)
        if fastest < v:
            top, top_cause = fastest, BY_POSITION
        fastest = allowed_speed(below, v, BRAKING_SHARE * a, dt)
        if fastest < v:
            bottom, bottom_cause = -fastest, BY_POSITION
        outside = max(outside, -below, -above)
        if not math.isnan(previous[j]):
            slowest, fastest = previous[j] - a * dt, previous[j] + a * dt
            if slowest > bottom:
                bottom, bottom_cause = slowest, BY_ACCELERATION
            if fastest < top:
                top, top_cause = fastest, BY_ACCELERATION
            if bottom > top:  # too fast, or too far, for what the acceleration limit allows: it has precedence
                bottom = slowest if top < slowest else fastest
                top = bottom
        space[LOW, j], space[HIGH, j] = bottom, top
        space[LOW_CAUSE, j], space[HIGH_CAUSE, j] = bottom_cause, top_cause
    return outside if outside > LEAST_OUTSIDE else 0.0


@compiled_inside
def within(u, space, nv, tolerance):
    """Whether a velocity is within the bounds, but for a tolerance."""
    for j in range(nv):
        if not space[LOW, j] - tolerance <= u[j] <= space[HIGH, j] + tolerance:
            return False
    return True


@compiled_inside
def binding(parts, space):
    """The joint at a bound that task and null part exceed most, and the limit that sets it; (-1, -1) if none."""
    joint, cause, most = -1, -1.0, 0.0
    u, low, high = space[FOUND], space[LOW], space[HIGH]
    for j in range(parts.shape[1]):
        tolerance, wish = AT_BOUND * (1.0 + abs(u[j])), parts[TASK_PART, j] + parts[NULL_PART, j]
        if u[j] >= high[j] - tolerance and wish - high[j] > most:
            joint, cause, most = j, space[HIGH_CAUSE, j], wish - high[j]
        elif u[j] <= low[j] + tolerance and low[j] - wish > most:
            joint, cause, most = j, space[LOW_CAUSE, j], low[j] - wish
    return joint, cause


@compiled_inside
def turn_to_freer_sense(constants, q, direction):
    """Turn a direction round where position limits leave its opposite more room, as `Limits.freer_sense`."""
    nv, dofs, fastest = q.shape[0], dofs_of(constants), 0.0
    for j in range(nv):
        fastest = max(fastest, abs(direction[j]))
    if fastest == 0.0:
        return
    ahead = behind = math.inf
    for j in range(nv):
        speed = abs(direction[j])
        if speed > 1e-3 * fastest:
            up, down = constants[dofs + j, UPPER] - q[j], q[j] - constants[dofs + j, LOWER]
            if direction[j] < 0.0:
                up, down = down, up
            ahead, behind = min(ahead, up / speed), min(behind, down / speed)
    if ahead < min(behind, ROOM_TO_LEAVE / fastest):
        for j in range(nv):
            direction[j] = -direction[j]
