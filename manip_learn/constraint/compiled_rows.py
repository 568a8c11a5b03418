"""Lambda Phi(q) = (T_0 + sum_k p_k T_k) J(q) of one frame and its derivative, as loops over plain numbers.

The one compiled form of every constraint on a frame: rows of its Jacobian, whose weights are constant, and those whose
weights change with the place p of its origin (`PlaceWeights`).
"""

from __future__ import annotations

import math

from manip_learn.constraint.features.weighed_velocity import FREE, FREE_ROWS, ON_AXIS, SLOPES, WIDTH
from manip_learn.robot.batch.compiled_kinematics import GRADIENT, WEIGHTS, jacobian_vjp
from manip_learn.robot.batch.kernel_cache import compiled_inside

# columns of a row of Lambda in the work space, behind its six weights: their slopes along p, and scratch
SLOPE, MOVED, MIX_WIDTH = 6, 24, 30
CONSTANT = 0  # rows whose weights do not change; otherwise one more than the number of rows of unit length


@compiled_inside
def mix_rows(table, rows, s, form, p0, p1, p2, work, at):
    """Weights of (v, w), and their slopes, into the s rows of `work` from `at` on; the row behind them is scratch.

    `table` holds Lambda from row `rows` on, behind it what `PlaceWeights.table` has.
    """
    for i in range(s):
        row = work[at + i]
        for c in range(6):
            row[c] = table[rows + i, c]
        if form == CONSTANT:
            continue
        first = rows + s + SLOPES * i
        for c in range(6):
            k, at_c = first + (3 * c) // WIDTH, (3 * c) % WIDTH
            a, b, d = table[k, at_c], table[k, at_c + 1], table[k, at_c + 2]
            row[c] += a * p0 + b * p1 + d * p2
            row[SLOPE + 3 * c], row[SLOPE + 3 * c + 1], row[SLOPE + 3 * c + 2] = a, b, d
            row[MOVED + c] = 0.0
    for k in range(form - 1):
        _free_row(table, rows + s * (1 + SLOPES) + FREE_ROWS * k, p0, p1, p2, work[at + s])
        for i in range(s):
            share = table[rows + i, FREE + k]
            for c in range(3):
                work[at + i, c] += share * work[at + s, c]
            for c in range(9):
                work[at + i, SLOPE + c] += share * work[at + s, SLOPE + c]


@compiled_inside
def _free_row(table, k, p0, p1, p2, out):
    """Weights of v made unit length and their slopes, as in `PlaceWeights.at`."""
    s, edge, h = 0.0, ON_AXIS * ON_AXIS, table[k + 1, 3]
    for c in range(3):
        at = 3 + 3 * c
        out[c] = table[k, c] + table[k, at] * p0 + table[k, at + 1] * p1 + table[k, at + 2] * p2
        s += out[c] * out[c]
    lift = table[k + 1, 0] != 0.0 or table[k + 1, 1] != 0.0 or table[k + 1, 2] != 0.0
    more = s + h * h + edge if lift else 1.0
    size, turned = math.sqrt((s + edge) * more), -h if lift else 1.0
    steep = (more + s + edge if lift else more) / size
    for d in range(3):
        along = 0.0
        for c in range(3):
            along += out[c] * table[k, 3 + 3 * c + d]
        for c in range(3):
            b = table[k + 1, c]
            f = (s * b + turned * out[c]) / size
            out[SLOPE + 3 * c + d] = (2.0 * b * along + turned * table[k, 3 + 3 * c + d] - f * steep * along) / size
    for c in range(3):
        out[c] = (s * table[k + 1, c] + turned * out[c]) / size


@compiled_inside
def joint_weights(s, form, weights, column, work, joint, at):
    """Weights of one joint's (v, w), from those of a column of A (s, _)."""
    for k in range(6):
        total = 0.0
        for i in range(s):
            total += weights[i, column] * work[at + i, k]
        work[joint, WEIGHTS + k] = total
    if form != CONSTANT:
        for i in range(s):
            for k in range(6):
                work[at + i, MOVED + k] += weights[i, column] * work[joint, k]


@compiled_inside
def rows_vjp(s, form, joints, local, work, base, at):
    """sum_ij weights_ij dA_ij / dq_k into the joints' entries GRADIENT, after `joint_weights` of every joint."""
    jacobian_vjp(work, base, joints, local)
    if form == CONSTANT:
        return
    t0 = t1 = t2 = 0.0
    for i in range(s):
        row = work[at + i]
        for c in range(6):
            t0 += row[MOVED + c] * row[SLOPE + 3 * c]
            t1 += row[MOVED + c] * row[SLOPE + 3 * c + 1]
            t2 += row[MOVED + c] * row[SLOPE + 3 * c + 2]
            row[MOVED + c] = 0.0
    for k in range(base, base + joints):
        work[k, GRADIENT] += t0 * work[k, 0] + t1 * work[k, 1] + t2 * work[k, 2]
