"""`limits.Limits` and `tip_limits.TipLimits` as loops over plain numbers: bounds on the next velocity."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.constraint.compiled_rows import dot
from manip_learn.control import limits, singularity
from manip_learn.control.compiled import step_table as table
from manip_learn.control.compiled.constrained_rows import dofs_of, norm, turn_joints
from manip_learn.control.limits import AT_BOUND, MOST_ROWS, RESERVE, ROOM_TO_LEAVE
from manip_learn.control.singularity import APPROACH_RATE, BRAKING_SHARE
from manip_learn.robot.batch.compiled_kinematics import JOINTS, SLIDE, SOURCE, TARGET, columns_of
from manip_learn.robot.batch.kernel_cache import compiled_inside

# A frame at a posture has three rows of its Jacobian and one per wall, behind which are its bound [m/s] and whether it
# is in the program already.
LINEAR = 3


approach_of, approach_speed = compiled_inside(limits.approach_of), compiled_inside(limits.approach_speed)
braking_rate = compiled_inside(singularity.braking_rate)


@compiled_inside
def admitted(constants, q, dt, u, previous):
    """Whether `Limits.bounds` admit the velocity u; `previous` is NaN where no acceleration is bounded.

    `approach_speed` with the squares of both sides, which needs neither its root nor its divisions.
    """
    rate, dofs = min(APPROACH_RATE, 0.5 / dt), dofs_of(constants)
    period = 1.0 / rate
    for j in range(q.shape[0]):
        k = dofs + j
        v, a, speed = constants[k, table.LIMIT], constants[k, table.ACCELERATION], abs(u[j])
        above, below = constants[k, table.UPPER] - q[j], q[j] - constants[k, table.LOWER]
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
        v, a = constants[k, table.LIMIT], constants[k, table.ACCELERATION]
        above, below = constants[k, table.UPPER] - q[j], q[j] - constants[k, table.LOWER]
        bottom, top, bottom_cause, top_cause = -v, v, limits.VELOCITY, limits.VELOCITY
        approach = approach_of(v, a, dt)
        fastest = approach_speed(approach, above)
        if fastest < v:
            top, top_cause = fastest, limits.POSITION
        fastest = approach_speed(approach, below)
        if fastest < v:
            bottom, bottom_cause = -fastest, limits.POSITION
        outside = max(outside, -below, -above)
        if not math.isnan(previous[j]):
            slowest, fastest = previous[j] - a * dt, previous[j] + a * dt
            if slowest > bottom:
                bottom, bottom_cause = slowest, limits.ACCELERATION
            if fastest < top:
                top, top_cause = fastest, limits.ACCELERATION
            if bottom > top:  # too fast, or too far, for what the acceleration limit allows: it has precedence
                bottom = slowest if top < slowest else fastest
                top = bottom
        space[table.LOW, j], space[table.HIGH, j] = bottom, top
        space[table.LOW_CAUSE, j], space[table.HIGH_CAUSE, j] = bottom_cause, top_cause
    return outside if outside > limits.OUTSIDE else 0.0


@compiled_inside
def within(u, space, nv, tolerance):
    """Whether a velocity is within the bounds, but for a tolerance."""
    for j in range(nv):
        if not space[table.LOW, j] - tolerance <= u[j] <= space[table.HIGH, j] + tolerance:
            return False
    return True


@compiled_inside
def binding(parts, space):
    """The joint at a bound that task and null part exceed most, and the limit that sets it; (-1, -1) if none."""
    joint, cause, most = -1, -1.0, 0.0
    u, low, high = space[table.FOUND], space[table.LOW], space[table.HIGH]
    for j in range(parts.shape[1]):
        tolerance, wish = AT_BOUND * (1.0 + abs(u[j])), parts[table.TASK_PART, j] + parts[table.NULL_PART, j]
        if u[j] >= high[j] - tolerance and wish - high[j] > most:
            joint, cause, most = j, space[table.HIGH_CAUSE, j], wish - high[j]
        elif u[j] <= low[j] + tolerance and low[j] - wish > most:
            joint, cause, most = j, space[table.LOW_CAUSE, j], low[j] - wish
    return joint, cause


@compiled_inside
def turn_to_freer_sense(constants, q, direction):
    """Turn a direction round where position limits leave its opposite more room, as `Limits.freer_sense`."""
    dofs, fastest = dofs_of(constants), np.abs(direction).max()
    ahead = behind = math.inf
    for j in range(q.shape[0]):
        speed = abs(direction[j])
        if speed > 1e-3 * fastest:
            up, down = constants[dofs + j, table.UPPER] - q[j], q[j] - constants[dofs + j, table.LOWER]
            if direction[j] < 0.0:
                up, down = down, up
            ahead, behind = min(ahead, up / speed), min(behind, down / speed)
    if fastest > 0.0 and ahead < min(behind, ROOM_TO_LEAVE / fastest):
        direction *= -1.0


@compiled_inside
def approach_rate(constants, distance, slope, length, dt):
    """`singularity.approach_rate`, `length` the norm of the slope."""
    usable, dofs = math.inf, dofs_of(constants)
    for j in range(slope.shape[0]):
        usable = min(usable, constants[dofs + j, table.ACCELERATION] / max(abs(slope[j]), 1e-12 * length))
    return braking_rate(distance, BRAKING_SHARE * length * length * usable if length > 0.0 else math.inf, dt)


@compiled_inside
def has_tips(constants):
    """Whether the speed or the place of frames is limited."""
    return constants[table.CHAIN + 1, table.TIPS] != 0.0


@compiled_inside
def most_rows(constants):
    """Number of barrier rows that a program may have: one for a singularity, the walls, and the tangents."""
    if not has_tips(constants):
        return 1
    at = int(constants[table.CHAIN + 1, table.TIPS])
    return 1 + int(constants[at, table.N_FRAMES]) * (int(constants[at, table.N_WALLS]) + MOST_ROWS)


@compiled_inside
def tips_at(constants, q, dt, previous):
    """`TipLimits.at`: the rows of each frame (see LINEAR), then scratch; no rows where nothing is limited."""
    if not has_tips(constants):
        return np.empty((0, 0))
    at, nv = int(constants[table.CHAIN + 1, table.TIPS]), int(constants[0, table.NV])
    frames, walls = int(constants[at, table.N_FRAMES]), int(constants[at, table.N_WALLS])
    size, chain = LINEAR + walls, at + 1 + walls
    # no chain has more joints than the robot has
    tips = np.empty((frames * size + nv + 1, max(nv + 2, SLIDE + 3)))
    base = frames * size
    for f in range(frames):
        joints, first = int(constants[chain + 1, table.LENGTH]), f * size
        turn_joints(constants, chain, joints, q, tips, base)
        p0, p1, p2 = columns_of(constants, chain, joints, tips, base, SLIDE, 1, tips, base)
        tips[first : first + LINEAR] = 0.0
        for j in range(joints):
            k = chain + JOINTS + j
            for i in range(LINEAR):
                tips[first + i, int(constants[k, SOURCE])] = tips[base + int(constants[k, TARGET]), i]
        for w in range(walls):
            n, row = constants[at + 1 + w], first + LINEAR + w
            tips[row, nv] = n[3] - n[0] * p0 - n[1] * p1 - n[2] * p2
            _wall_row(constants, n, dt, previous, tips, first, row)
        chain += JOINTS + joints
    return tips


@compiled_inside
def _wall_row(constants, n, dt, previous, tips, first, row):
    """Minus the rate at which a frame approaches a wall, per unit of joint velocity, and minus the rate allowed.

    The latter takes the place of the distance from the wall [m].
    """
    nv, dofs, braking, speed, G = int(constants[0, table.NV]), dofs_of(constants), 0.0, 0.0, tips[row]
    for j in range(nv):
        rate = n[0] * tips[first, j] + n[1] * tips[first + 1, j] + n[2] * tips[first + 2, j]
        G[j] = -rate
        braking += abs(rate) * constants[dofs + j, table.ACCELERATION]
        speed += rate * previous[j]
    G[nv], G[nv + 1] = -approach_rate(constants, G[nv], G[:nv], norm(G[:nv]), dt), 0.0
    if not math.isnan(speed):
        G[nv] = min(G[nv], BRAKING_SHARE * dt * braking - speed)


@compiled_inside
def breaks(constants, tips, u):
    """Whether the velocity u breaks a limit of the frames, and whether it approaches a wall too fast."""
    fast = near = False
    if tips.shape[0] == 0:
        return fast, near
    at, nv = int(constants[table.CHAIN + 1, table.TIPS]), int(constants[0, table.NV])
    walls = int(constants[at, table.N_WALLS])
    for f in range(int(constants[at, table.N_FRAMES])):
        first = f * (LINEAR + walls)
        for w in range(walls):
            row = first + LINEAR + w
            near = near or dot(u, tips[row]) < tips[row, nv]
        fast = fast or _velocity(tips, first, u)[3] > constants[at, table.TIP_SPEED]
    return fast or near, near


@compiled_inside
def with_broken(constants, tips, u, space, rows):
    """`TipLimits.rows`: write what u breaks behind the barrier rows of the space; return the number of all of them.

    A wall enters once: what rounding lets through afterwards needs no second row.
    """
    if tips.shape[0] == 0:
        return rows
    at, nv = int(constants[table.CHAIN + 1, table.TIPS]), int(constants[0, table.NV])
    walls, fastest = int(constants[at, table.N_WALLS]), constants[at, table.TIP_SPEED]
    for f in range(int(constants[at, table.N_FRAMES])):
        first = f * (LINEAR + walls)
        for w in range(walls):
            row = first + LINEAR + w
            if tips[row, nv + 1] == 0.0 and dot(u, tips[row]) < tips[row, nv]:
                space[table.SLOPE + rows, : nv + 1] = tips[row, : nv + 1]
                tips[row, nv + 1] = 1.0
                rows += 1
        v0, v1, v2, speed = _velocity(tips, first, u)
        if speed > fastest:  # the tangent where the ball of velocities was left
            for j in range(nv):
                along = v0 * tips[first, j] + v1 * tips[first + 1, j] + v2 * tips[first + 2, j]
                space[table.SLOPE + rows, j] = -along / speed
            space[table.SLOPE + rows, nv] = fastest * (RESERVE - 1.0)
            rows += 1
    return rows


@compiled_inside
def _velocity(tips, first, u):
    """The velocity of the frame whose rows begin at `first`, and its norm [m/s]."""
    v0, v1, v2 = dot(u, tips[first]), dot(u, tips[first + 1]), dot(u, tips[first + 2])
    return v0, v1, v2, math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
