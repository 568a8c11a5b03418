"""The vector-Jacobian product of a chain's Jacobian, as loops over plain numbers; compiled where numba is installed."""

from __future__ import annotations

from manip_learn.robot.batch.kernel_cache import compiled_inside

# columns of a joint's row of scratch, after (v, w) and the origin
WEIGHTS, SLIDE, GRADIENT = 9, 15, 18


@compiled_inside
def six(table, k, at):
    """Six neighbouring entries of a row."""
    return table[k, at], table[k, at + 1], table[k, at + 2], table[k, at + 3], table[k, at + 4], table[k, at + 5]


@compiled_inside
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
