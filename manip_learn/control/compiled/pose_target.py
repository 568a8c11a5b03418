"""A target with a rotation, or along the frame's own axes, as loops over plain numbers: see `features.pose_error`."""

from __future__ import annotations

import math

from manip_learn.control.compiled.step_table import (
    CHAIN,
    GAIN,
    GOAL,
    MAX_SPEED,
    TARGET_POINT,
)
from manip_learn.robot.batch.compiled_kinematics import END_ORIGIN, LOCAL
from manip_learn.robot.batch.compiled_vjp import six
from manip_learn.robot.batch.kernel_cache import compiled_inside
from manip_learn.robot.rotations import SMALL_ANGLE


@compiled_inside
def pose_velocity(constants, first, s, place, work, at, b):
    """Write b = gain Lambda e, norm at most max_speed, and return |Lambda e|.

    The s rows of Lambda's table begin at row `first`. As many rows of scratch behind row `at`, which holds the end of
    the chain (`columns_of`), take Lambda M, with d/dt e = -M (v, w), for the rows E = Lambda M J of the error; the next
    one is scratch.
    """
    own_axes = constants[CHAIN + 1, LOCAL] != 0.0
    e0, e1, e2 = place_error(constants, own_axes, place, work[at])
    r0, r1, r2 = turn_error(constants, own_axes, work[at], work[at + 1 + s])
    sign = 1.0 if own_axes else -1.0
    for i in range(s):
        x, y, z, u, v, w = six(constants, first + i, 0)
        b[i] = x * e0 + y * e1 + z * e2 + u * r0 + v * r1 + w * r2
        u, v, w = turned_row(u, v, w, sign * r0, sign * r1, sign * r2)
        if own_axes:  # the frame turns under the displacement: less Lambda_lin [e_lin]x
            u, v, w = u + e1 * z - e2 * y, v + e2 * x - e0 * z, w + e0 * y - e1 * x
        row = work[at + 1 + i]
        row[0], row[1], row[2], row[3], row[4], row[5] = x, y, z, u, v, w
    return attracted(constants, s, b)


@compiled_inside
def attracted(constants, s, b):
    """Scale a displacement to the task's velocity, norm at most max_speed; return its own norm."""
    error = 0.0
    for i in range(s):
        error += b[i] * b[i]
    error = math.sqrt(error)
    gain, fastest = constants[0, GAIN], constants[0, MAX_SPEED]
    if gain * error > fastest:
        gain *= fastest / (gain * error)
    for i in range(s):
        b[i] *= gain
    return error


@compiled_inside
def place_error(constants, own_axes, p, end):
    """p* - p, along the axes of the base or of the frame, from which the chain is walked then."""
    k = CHAIN + 1
    t0, t1, t2 = constants[k, TARGET_POINT], constants[k, TARGET_POINT + 1], constants[k, TARGET_POINT + 2]
    if not own_axes:
        return t0 - p[0], t1 - p[1], t2 - p[2]
    return (
        end[END_ORIGIN] + end[0] * t0 + end[1] * t1 + end[2] * t2,
        end[END_ORIGIN + 1] + end[3] * t0 + end[4] * t1 + end[5] * t2,
        end[END_ORIGIN + 2] + end[6] * t0 + end[7] * t1 + end[8] * t2,
    )


@compiled_inside
def turn_error(constants, own_axes, end, product):
    """log(R* R^T) = log(G X^T), or log(R^T R*) = log(X G), from the rotation X at the end of the chain."""
    goal = constants[1]
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                if own_axes:
                    total += end[3 * i + k] * goal[GOAL + 3 * k + j]
                else:
                    total += goal[GOAL + 3 * i + k] * end[3 * j + k]
            product[3 * i + j] = total
    return rotation_vector(product)


@compiled_inside
def rotation_vector(R):
    """`rotations.rotation_vector` of a matrix whose rows follow each other."""
    a, b, c, d, e, f, g, h, i = R[0], R[1], R[2], R[3], R[4], R[5], R[6], R[7], R[8]
    # the quaternion by its largest part, so that nothing is divided by something small
    trace, p, q, r = a + e + i, a - e - i, e - a - i, i - a - e
    if trace >= p and trace >= q and trace >= r:
        w, x, y, z = 1.0 + trace, h - f, c - g, d - b
    elif p >= q and p >= r:
        w, x, y, z = h - f, 1.0 + p, b + d, c + g
    elif q >= r:
        w, x, y, z = c - g, b + d, 1.0 + q, f + h
    else:
        w, x, y, z = d - b, c + g, f + h, 1.0 + r
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 0.0, 0.0, 0.0
    scale = 2.0 * math.atan2(length, abs(w)) / length
    if w < 0.0:
        scale = -scale
    return scale * x, scale * y, scale * z


@compiled_inside
def turned_row(a, b, c, x, y, z):
    """The row (a, b, c) times the inverse of the left Jacobian of (x, y, z), `rotations.left_jacobian_inverse`."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < SMALL_ANGLE:
        second = 1.0 / 12.0 + square / 720.0 * (1.0 + square / 42.0 * (1.0 + square / 40.0))
    else:
        half = 0.5 * angle
        second = (1.0 - half * math.cos(half) / math.sin(half)) / square
    rest, along = 1.0 - second * square, second * (a * x + b * y + c * z)
    return (
        rest * a + along * x - 0.5 * (b * z - c * y),
        rest * b + along * y - 0.5 * (c * x - a * z),
        rest * c + along * z - 0.5 * (a * y - b * x),
    )
