"""`tip_limits.TipLimits` as loops over plain numbers: where frames may go, and how fast."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.control.compiled.constrained_rows import dofs_of, turn_joints
from manip_learn.control.compiled.near_singularity import approach_rate, norm
from manip_learn.control.compiled.step_table import (
    ACCELERATION,
    CHAIN,
    LENGTH,
    N_FRAMES,
    N_WALLS,
    NV,
    SLOPE,
    TIP_SPEED,
    TIPS,
)
from manip_learn.control.singularity import BRAKING_SHARE
from manip_learn.control.tip_limits import MOST_ROWS, RESERVE
from manip_learn.robot.batch.compiled_kinematics import JOINTS, SOURCE, TARGET, columns_of
from manip_learn.robot.batch.compiled_vjp import SLIDE
from manip_learn.robot.batch.kernel_cache import compiled_inside

# A frame at a posture has three rows of its Jacobian and one per wall, behind which are its bound [m/s] and whether it
# is in the program already.
LINEAR = 3


@compiled_inside
def has_tips(constants):
    """Whether the speed or the place of frames is limited."""
    return constants[CHAIN + 1, TIPS] != 0.0


@compiled_inside
def most_rows(constants):
    """Number of barrier rows that a program may have: one for a singularity, the walls, and the tangents."""
    if not has_tips(constants):
        return 1
    at = int(constants[CHAIN + 1, TIPS])
    return 1 + int(constants[at, N_FRAMES]) * (int(constants[at, N_WALLS]) + MOST_ROWS)


@compiled_inside
def tips_at(constants, q, dt, previous):
    """`TipLimits.at`: the rows of each frame (see LINEAR), then scratch; no rows where nothing is limited."""
    if not has_tips(constants):
        return np.empty((0, 0))
    at, nv = int(constants[CHAIN + 1, TIPS]), int(constants[0, NV])
    frames, walls = int(constants[at, N_FRAMES]), int(constants[at, N_WALLS])
    size, chain = LINEAR + walls, at + 1 + walls
    # no chain has more joints than the robot has
    tips = np.empty((frames * size + nv + 1, max(nv + 2, SLIDE + 3)))
    base = frames * size
    for f in range(frames):
        joints, first = int(constants[chain + 1, LENGTH]), f * size
        turn_joints(constants, chain, joints, q, tips, base)
        p0, p1, p2 = columns_of(constants, chain, joints, tips, base, SLIDE, 1, tips, base)
        for i in range(LINEAR):
            for j in range(nv):
                tips[first + i, j] = 0.0
            for j in range(joints):
                k = chain + JOINTS + j
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
    nv, dofs, braking, speed, G = int(constants[0, NV]), dofs_of(constants), 0.0, 0.0, tips[row]
    for j in range(nv):
        rate = n[0] * tips[first, j] + n[1] * tips[first + 1, j] + n[2] * tips[first + 2, j]
        G[j] = -rate
        braking += abs(rate) * constants[dofs + j, ACCELERATION]
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
    at, nv = int(constants[CHAIN + 1, TIPS]), int(constants[0, NV])
    walls = int(constants[at, N_WALLS])
    for f in range(int(constants[at, N_FRAMES])):
        first = f * (LINEAR + walls)
        for w in range(walls):
            row = first + LINEAR + w
            near = near or _along(tips, row, u, nv) < tips[row, nv]
        fast = fast or _velocity(tips, first, u, nv)[3] > constants[at, TIP_SPEED]
    return fast or near, near


@compiled_inside
def with_broken(constants, tips, u, space, rows):
    """`TipLimits.rows`: write what u breaks behind the barrier rows of the space; return the number of all of them.

    A wall enters once: what rounding lets through afterwards needs no second row.
    """
    if tips.shape[0] == 0:
        return rows
    at, nv = int(constants[CHAIN + 1, TIPS]), int(constants[0, NV])
    walls, fastest = int(constants[at, N_WALLS]), constants[at, TIP_SPEED]
    for f in range(int(constants[at, N_FRAMES])):
        first = f * (LINEAR + walls)
        for w in range(walls):
            row = first + LINEAR + w
            if tips[row, nv + 1] == 0.0 and _along(tips, row, u, nv) < tips[row, nv]:
                for j in range(nv + 1):
                    space[SLOPE + rows, j] = tips[row, j]
                tips[row, nv + 1] = 1.0
                rows += 1
        v0, v1, v2, speed = _velocity(tips, first, u, nv)
        if speed > fastest:  # the tangent where the ball of velocities was left
            for j in range(nv):
                along = v0 * tips[first, j] + v1 * tips[first + 1, j] + v2 * tips[first + 2, j]
                space[SLOPE + rows, j] = -along / speed
            space[SLOPE + rows, nv] = fastest * (RESERVE - 1.0)
            rows += 1
    return rows


@compiled_inside
def _velocity(tips, first, u, nv):
    """The velocity of the frame whose rows begin at `first`, and its norm [m/s]."""
    v0, v1, v2 = _along(tips, first, u, nv), _along(tips, first + 1, u, nv), _along(tips, first + 2, u, nv)
    return v0, v1, v2, math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)


@compiled_inside
def _along(tips, row, u, nv):
    """A row times the velocity."""
    total = 0.0
    for j in range(nv):
        total += tips[row, j] * u[j]
    return total
