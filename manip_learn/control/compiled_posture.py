"""Rows, task velocity and policy of one posture, as loops over plain numbers: what the compiled law is handed."""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.compiled_rows import MIX_WIDTH, joint_weights, mix_rows, rows_vjp
from manip_learn.robot.batch.compiled_kinematics import (
    END_ORIGIN,
    JOINTS,
    LARGEST_ANGLE,
    LOCAL,
    OFFSET,
    PRISMATIC,
    SIGN,
    SOURCE,
    TARGET,
    columns_of,
    sine_and_cosine,
)
from manip_learn.robot.batch.compiled_vjp import GRADIENT, SLIDE, six
from manip_learn.robot.batch.kernel_cache import compiled_inside
from manip_learn.robot.rotations import SMALL_ANGLE

HOLD, POINT, POSE = range(3)  # kinds of tasks


@final
class FrameRows(NamedTuple):
    """The rows of a constraint on one frame.

    Attributes:
        chain: Table of the chain of joints, `compiled_kinematics.chain_table`.
        weights: Table of Lambda, `weighed_velocity.compiled_form`.
        form: How Lambda's weights depend on the place, see `compiled_rows`.
        s: Number of rows.
        nv: Number of degrees of freedom.
    """

    chain: Float[np.ndarray, "rows 12"]
    weights: Float[np.ndarray, "k 12"]
    form: int
    s: int
    nv: int


@final
class Reach(NamedTuple):
    """A task, `Hold` or `PointAttractor`.

    Attributes:
        kind: HOLD, POINT or POSE.
        gain: [1/s].
        max_speed: Largest norm of b; inf for no bound.
        place: Where the frame is to arrive [m], in the frame in which the chain is walked.
        turn: Its rotation there.
    """

    kind: int
    gain: float
    max_speed: float
    place: Float[np.ndarray, "3"]
    turn: Float[np.ndarray, "3 3"]


@final
class Rest(NamedTuple):
    """A policy, `JointAttractor`, or none with a gain of 0.

    Attributes:
        gain: [1/s].
        positions: [rad or m].
        wraps: Which joints go the short way round.
    """

    gain: float
    positions: Float[np.ndarray, " nv"]
    wraps: Float[np.ndarray, " nv"]


@final
class Motion(NamedTuple):
    """A posture of the chain: what the vector-Jacobian product of its rows is made from.

    Attributes:
        rows: The rows.
        work: (v, w) of the joints, the chain's end, the rows of a pose's error, and the weights of (v, w).
    """

    rows: FrameRows
    work: Float[np.ndarray, "m 30"]


@compiled_inside
def work_space(rows):
    """For `posture`."""
    return np.empty((joints_of(rows) + 2 * rows.s + 3, MIX_WIDTH))


@compiled_inside
def joints_of(rows):
    """Number of joints of the chain."""
    return rows.chain.shape[0] - JOINTS


@compiled_inside
def mixed_at(rows):
    """Row of the work space where the weights of (v, w) begin, see `compiled_rows`: behind a pose's error."""
    return joints_of(rows) + rows.s + 2


@compiled_inside
def places(chain, j):
    """Public column of a joint of the chain, and its place among them, base first."""
    return int(chain[JOINTS + j, SOURCE]), int(chain[JOINTS + j, TARGET])


@compiled_inside
def posture(rows, reach, q, work):
    """A, the rows whose velocity b is, b, and the task's error; `work` is filled."""
    chain, s, joints = rows.chain, rows.s, joints_of(rows)
    for j in range(joints):
        k = JOINTS + j
        x = chain[1, SIGN] * q[int(chain[k, SOURCE])]
        angle = chain[k, OFFSET] + (1.0 - chain[k, PRISMATIC]) * x
        work[j, SLIDE] = x
        if abs(angle) > LARGEST_ANGLE:
            work[j, SLIDE + 1], work[j, SLIDE + 2] = math.sin(angle), math.cos(angle)
        else:
            work[j, SLIDE + 1], work[j, SLIDE + 2] = sine_and_cosine(angle)
    p0, p1, p2 = columns_of(chain, 0, joints, work, 0, SLIDE, 1, work, 0)
    mix = mixed_at(rows)
    mix_rows(rows.weights, 0, s, rows.form, p0, p1, p2, work, mix)
    A, b, error = weighed(rows, work, mix), np.zeros(s), 0.0
    if reach.kind == POSE:
        error = pose_velocity(rows, reach, p0, p1, p2, work, b)
        return A, weighed(rows, work, joints + 1), b, error
    if reach.kind == POINT:
        d0, d1, d2 = reach.place[0] - p0, reach.place[1] - p1, reach.place[2] - p2
        for i in range(s):
            b[i] = rows.weights[i, 0] * d0 + rows.weights[i, 1] * d1 + rows.weights[i, 2] * d2
        error = attracted(reach, b)
    return A, A, b, error


@compiled_inside
def weighed(rows, work, at):
    """Weights of (v, w), in the s rows of the work space from `at` on, times the Jacobian, in public columns."""
    A = np.zeros((rows.s, rows.nv))
    for j in range(joints_of(rows)):
        column, place = places(rows.chain, j)
        for i in range(rows.s):
            for k in range(6):
                A[i, column] += work[at + i, k] * work[place, k]
    return A


@compiled_inside
def product(motion, weights, first, out):
    """sum_ij weights_ij dA_ij / dq_k into `out`; weights (s, nv) in public columns from `first` on."""
    rows, work = motion.rows, motion.work
    s, form, joints, mix = rows.s, rows.form, joints_of(rows), mixed_at(rows)
    for j in range(joints):
        column, place = places(rows.chain, j)
        joint_weights(s, form, weights, first + column, work, place, mix)
    rows_vjp(s, form, joints, rows.chain[1, LOCAL] != 0.0, work, 0, mix)
    for j in range(joints):
        column, place = places(rows.chain, j)
        out[column] = work[place, GRADIENT]


@compiled_inside
def gradient(motion, weights):
    """`weighted_vjp.gradient`."""
    out = np.zeros(motion.rows.nv)
    product(motion, weights, 0, out)
    return out


@compiled_inside
def vjps(motion, weights, number):
    """`weighted_vjp.vjps`."""
    nv = motion.rows.nv
    out = np.zeros((number, nv))
    for i in range(number):
        product(motion, weights, nv * i, out[i])
    return out


@compiled_inside
def rest_velocity(rest, q):
    """gain (rest - q), the short way round for joints that wrap."""
    pi = np.zeros(q.shape[0])
    if rest.gain != 0.0:
        for j in range(q.shape[0]):
            d = rest.positions[j] - q[j]
            if rest.wraps[j] != 0.0:
                d -= 2.0 * math.pi * math.floor(d / (2.0 * math.pi) + 0.5)
            pi[j] = rest.gain * d
    return pi


@compiled_inside
def attracted(reach, b):
    """Scale a displacement to the task's velocity, norm at most max_speed; return its own norm."""
    error = 0.0
    for i in range(b.shape[0]):
        error += b[i] * b[i]
    error, gain = math.sqrt(error), reach.gain
    if gain * error > reach.max_speed:
        gain *= reach.max_speed / (gain * error)
    for i in range(b.shape[0]):
        b[i] *= gain
    return error


@compiled_inside
def pose_velocity(rows, reach, p0, p1, p2, work, b):
    """Write b = gain Lambda e, norm at most max_speed, and return |Lambda e|; see `features.pose_error`.

    The s rows of the work space behind the chain's end take Lambda M, with d/dt e = -M (v, w), for the rows
    E = Lambda M J of the error.
    """
    own_axes, at = rows.chain[1, LOCAL] != 0.0, joints_of(rows)
    e0, e1, e2 = place_error(reach.place, own_axes, p0, p1, p2, work[at])
    r0, r1, r2 = turn_error(reach.turn, own_axes, work[at], work[at + 1 + rows.s])
    sign = 1.0 if own_axes else -1.0
    for i in range(rows.s):
        x, y, z, u, v, w = six(rows.weights, i, 0)
        b[i] = x * e0 + y * e1 + z * e2 + u * r0 + v * r1 + w * r2
        u, v, w = turned_row(u, v, w, sign * r0, sign * r1, sign * r2)
        if own_axes:  # the frame turns under the displacement: less Lambda_lin [e_lin]x
            u, v, w = u + e1 * z - e2 * y, v + e2 * x - e0 * z, w + e0 * y - e1 * x
        row = work[at + 1 + i]
        row[0], row[1], row[2], row[3], row[4], row[5] = x, y, z, u, v, w
    return attracted(reach, b)


@compiled_inside
def place_error(place, own_axes, p0, p1, p2, end):
    """p* - p, along the axes of the base or of the frame, from which the chain is walked then."""
    t0, t1, t2 = place[0], place[1], place[2]
    if not own_axes:
        return t0 - p0, t1 - p1, t2 - p2
    return (
        end[END_ORIGIN] + end[0] * t0 + end[1] * t1 + end[2] * t2,
        end[END_ORIGIN + 1] + end[3] * t0 + end[4] * t1 + end[5] * t2,
        end[END_ORIGIN + 2] + end[6] * t0 + end[7] * t1 + end[8] * t2,
    )


@compiled_inside
def turn_error(turn, own_axes, end, work):
    """log(R* R^T) = log(G X^T), or log(R^T R*) = log(X G), from the rotation X at the end of the chain."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                if own_axes:
                    total += end[3 * i + k] * turn[k, j]
                else:
                    total += turn[i, k] * end[3 * j + k]
            work[3 * i + j] = total
    return rotation_vector(work)


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
