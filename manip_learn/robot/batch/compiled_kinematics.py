"""Compiled kernels of batch kinematics (the optional extra `fast`); the same numbers as the NumPy ones to 1e-12.

For where `import numba` works. The machine code is cached on disk, so it is compiled once per machine.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int

from manip_learn.robot.batch.chain import Chain
from manip_learn.robot.batch.kernel_cache import compiled, compiled_inside

WIDTH = 12  # columns of the table
JOINTS = 2  # rows before those of the joints
# columns of a joint's row
SOURCE, TARGET, PRISMATIC, OFFSET, TILT_COS, TILT_SIN, SHIFT = 0, 1, 2, 3, 4, 5, 6
# columns of the second row, after the tool's position
SIGN, LOCAL = 3, 4
# columns of the work space behind a joint's (v, w) and origin
WEIGHTS, SLIDE, GRADIENT = 9, 15, 18
ORIGIN = 6  # column of the work space behind a joint's (v, w)
END_ORIGIN, END_WIDTH = 9, 12  # of the work space's row behind the joints': rotation, then origin of the chain's end

LARGEST_ANGLE = 1e5  # [rad] beyond it the three-part reduction below loses digits
# pi/2 in three parts of 33 bits, so that n * part is exact for the n that LARGEST_ANGLE allows
_TWO_OVER_PI = 0.6366197723675814
_PART_1 = 1.5707963267341256  # 33 bits
_PART_2 = 6.077100506303966e-11  # the next 33
_PART_3 = 2.0222662487959506e-21  # and the rest
LANES = 128  # postures per block: slides, sines and cosines of its joints stay in the first-level cache


def chain_table(chain: Chain, public: Int[np.ndarray, " j"], reference: str) -> Float[np.ndarray, "rows 12"]:
    """The chain that `columns_of` reads, seen from the frame (`Chain.reversed`) for columns along its own axes.

    Args:
        chain: The chain, base first.
        public: Column of the postures that moves each joint.
        reference: `"world"` or `"local"`.
    """
    local = reference == "local"
    walked = chain.reversed() if local else chain
    order = np.arange(chain.size)[:: -1 if local else 1]
    table = np.zeros((JOINTS + chain.size, WIDTH))
    table[0, :9], table[0, 9:] = walked.start_rotation.reshape(-1), walked.start_position
    table[1, :3], table[1, SIGN], table[1, LOCAL] = chain.tool_position, -1.0 if local else 1.0, local
    joints = table[JOINTS:]
    joints[:, SOURCE], joints[:, TARGET], joints[:, PRISMATIC] = public[order], order, walked.prismatic
    joints[:, OFFSET], joints[:, TILT_COS], joints[:, TILT_SIN] = walked.offset, walked.tilt_cos, walked.tilt_sin
    joints[:, SHIFT : SHIFT + 3] = walked.shift
    return table


@compiled
def sine_and_cosine(angle):
    """Sine and cosine [rad] to 1 ulp, |angle| <= LARGEST_ANGLE; free of branches, so that loops over it vectorise."""
    n = math.floor(angle * _TWO_OVER_PI + 0.5)
    r = ((angle - n * _PART_1) - n * _PART_2) - n * _PART_3
    z = r * r
    # minimax polynomials on [-pi/4, pi/4]
    a = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
    a = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * a)
    s = r + r * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * a))
    a = -2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11)
    a = -1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + z * a)
    c = 1.0 - 0.5 * z + z * z * (4.16666666666666019037e-02 + z * a)
    quarter = n - 4.0 * math.floor(n * 0.25)
    swap = quarter == 1.0 or quarter == 3.0
    a, b = (c, s) if swap else (s, c)
    return (-a if quarter >= 2.0 else a), (-b if (quarter == 1.0 or quarter == 2.0) else b)


@compiled
def columns_of(table, at, joints, turns, row, m, stride, work, base):
    """Jacobian columns of one posture; returns the frame's position (0 where columns are along its own axes).

    Args:
        table: Holds a chain's table from row `at` on.
        at: See `table`.
        joints: Number of joints.
        turns: Holds each joint's slide, sine and cosine, walked in the chain's order, in the rows from `row` on and the
            columns m, m + stride, m + 2 stride.
        row: See `turns`.
        m: See `turns`.
        stride: See `turns`.
        work: (v, w) of each joint goes into the rows from `base` on, base first, columns 0 to 5; the next three
            columns are scratch. The row behind them takes the end of the chain as it is walked, without the tool: nine
            numbers of its rotation, three of its origin.
        base: See `work`.
    """
    x0, y0, z0 = table[at, 0], table[at, 1], table[at, 2]
    x1, y1, z1 = table[at, 3], table[at, 4], table[at, 5]
    x2, y2, z2 = table[at, 6], table[at, 7], table[at, 8]
    p0, p1, p2 = table[at, 9], table[at, 10], table[at, 11]
    first = at + JOINTS
    for j in range(joints):
        k = first + j
        if j > 0:
            a, b, c = table[k, SHIFT], table[k, SHIFT + 1], table[k, SHIFT + 2]
            p0 += x0 * a + y0 * b + z0 * c
            p1 += x1 * a + y1 * b + z1 * c
            p2 += x2 * a + y2 * b + z2 * c
            c, s = table[k, TILT_COS], table[k, TILT_SIN]
            y0, z0 = c * y0 + s * z0, c * z0 - s * y0
            y1, z1 = c * y1 + s * z1, c * z1 - s * y1
            y2, z2 = c * y2 + s * z2, c * z2 - s * y2
        if table[k, PRISMATIC] != 0.0:
            d = turns[row + j, m]
            p0 += z0 * d
            p1 += z1 * d
            p2 += z2 * d
        i = base + int(table[k, TARGET])
        work[i, 3], work[i, 4], work[i, 5] = z0, z1, z2
        work[i, ORIGIN], work[i, ORIGIN + 1], work[i, ORIGIN + 2] = p0, p1, p2
        s, c = turns[row + j, m + stride], turns[row + j, m + 2 * stride]
        x0, y0 = c * x0 + s * y0, c * y0 - s * x0
        x1, y1 = c * x1 + s * y1, c * y1 - s * x1
        x2, y2 = c * x2 + s * y2, c * y2 - s * x2
    end = work[base + joints]
    end[0], end[1], end[2], end[3], end[4], end[5], end[6], end[7], end[8] = x0, y0, z0, x1, y1, z1, x2, y2, z2
    end[END_ORIGIN], end[END_ORIGIN + 1], end[END_ORIGIN + 2] = p0, p1, p2
    if table[at + 1, LOCAL] != 0.0:
        p0 = p1 = p2 = 0.0
    else:
        a, b, c = table[at + 1, 0], table[at + 1, 1], table[at + 1, 2]
        p0 += x0 * a + y0 * b + z0 * c
        p1 += x1 * a + y1 * b + z1 * c
        p2 += x2 * a + y2 * b + z2 * c
    for j in range(joints):
        i = base + int(table[first + j, TARGET])
        z0, z1, z2 = work[i, 3], work[i, 4], work[i, 5]
        if table[first + j, PRISMATIC] != 0.0:
            work[i, 0], work[i, 1], work[i, 2] = z0, z1, z2
            work[i, 3] = work[i, 4] = work[i, 5] = 0.0
        else:
            d0, d1, d2 = p0 - work[i, ORIGIN], p1 - work[i, ORIGIN + 1], p2 - work[i, ORIGIN + 2]
            work[i, 0] = z1 * d2 - z2 * d1
            work[i, 1] = z2 * d0 - z0 * d2
            work[i, 2] = z0 * d1 - z1 * d0
    return p0, p1, p2


@compiled
def joint_turns(table, postures, first, size, turns, angle):
    """Slide, sine and cosine of each joint for a block of postures, as `columns_of` reads them."""
    for j in range(turns.shape[0]):
        k = JOINTS + j
        source, sign, offset = int(table[k, SOURCE]), table[1, SIGN], table[k, OFFSET]
        moving = 1.0 - table[k, PRISMATIC]
        largest = 0.0
        for m in range(size):
            x = sign * postures[first + m, source]
            turns[j, m] = x
            angle[m] = moving * x + offset
            largest = max(largest, abs(angle[m]))
        if largest > LARGEST_ANGLE:
            for m in range(size):
                turns[j, m + LANES], turns[j, m + 2 * LANES] = math.sin(angle[m]), math.cos(angle[m])
        else:
            for m in range(size):
                turns[j, m + LANES], turns[j, m + 2 * LANES] = sine_and_cosine(angle[m])


@compiled
def derivative_of(work, local, out):
    """dJ/dq of one posture, base first, into `out` (6, joints, joints): [r, i, k] = d J_ri / d q_k."""
    joints = out.shape[1]
    for i in range(joints):
        b0, b1, b2, b3, b4, b5 = work[i, 0], work[i, 1], work[i, 2], work[i, 3], work[i, 4], work[i, 5]
        for k in range(i + 1):
            a0, a1, a2, a3, a4, a5 = work[k, 0], work[k, 1], work[k, 2], work[k, 3], work[k, 4], work[k, 5]
            # w_k x v_i and w_k x w_i: the joint above turns what the lower one gives
            v0, v1, v2 = a4 * b2 - a5 * b1, a5 * b0 - a3 * b2, a3 * b1 - a4 * b0
            w0, w1, w2 = a4 * b5 - a5 * b4, a5 * b3 - a3 * b5, a3 * b4 - a4 * b3
            if local:
                v0 += a1 * b5 - a2 * b4
                v1 += a2 * b3 - a0 * b5
                v2 += a0 * b4 - a1 * b3
                out[0, i, k] = out[1, i, k] = out[2, i, k] = out[3, i, k] = out[4, i, k] = out[5, i, k] = 0.0
                out[3, k, i], out[4, k, i], out[5, k, i] = w0, w1, w2
                if i == k:
                    v0 = v1 = v2 = 0.0
            else:
                out[0, i, k], out[1, i, k], out[2, i, k] = v0, v1, v2
                out[3, k, i] = out[4, k, i] = out[5, k, i] = 0.0
                out[3, i, k], out[4, i, k], out[5, i, k] = w0, w1, w2
            out[0, k, i], out[1, k, i], out[2, k, i] = v0, v1, v2


@compiled
def jacobians(table, postures, rows, public, out, derivative):
    """Rows of J (n, p, nv), and of dJ/dq (n, p, nv, nv) unless that has no entries, into public columns."""
    joints, local = public.shape[0], table[1, LOCAL] != 0.0
    turns, angle, work = np.empty((joints, 3 * LANES)), np.empty(LANES), np.empty((joints + 1, END_WIDTH))
    block = np.empty((6, joints, joints))
    for first in range(0, postures.shape[0], LANES):
        size = min(LANES, postures.shape[0] - first)
        joint_turns(table, postures, first, size, turns, angle)
        for m in range(size):
            columns_of(table, 0, joints, turns, 0, m, LANES, work, 0)
            for i in range(rows.shape[0]):
                for j in range(joints):
                    out[first + m, i, public[j]] = work[j, rows[i]]
            if derivative.shape[0] == 0:
                continue
            derivative_of(work, local, block)
            for i in range(rows.shape[0]):
                source, target = block[rows[i]], derivative[first + m, i]
                for j in range(joints):
                    line = target[public[j]]
                    for k in range(joints):
                        line[public[k]] = source[j, k]


@compiled_inside
def six(table, k, at):
    """Six neighbouring entries of a row."""
    return table[k, at], table[k, at + 1], table[k, at + 2], table[k, at + 3], table[k, at + 4], table[k, at + 5]


@compiled_inside
def jacobian_vjp(work, base, joints, local):
    """sum_ij weights_ji dJ_ij / dq_k for each joint k, base first, into the column GRADIENT of the joints' rows.

    The formulas of `robot.batch.chain.jacobian_vjp`.
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
