"""Compiled kernels of batch kinematics (the optional extra `fast`); the same numbers as the NumPy ones to 1e-12.

Imported only where numba is installed. The machine code is cached on disk, so it is compiled once a machine.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from manip_learn.robot.chain import Chain

LANES = 128  # postures a block: its angles, sines and cosines stay in the first-level cache
LARGEST_ANGLE = 1e5  # [rad] beyond it the three-part reduction below loses digits

# pi/2 in three parts of 33 bits, so that n * part is exact for the n that LARGEST_ANGLE allows
_TWO_OVER_PI = 0.6366197723675814
_PART_1 = 1.5707963267341256
_PART_2 = 6.077100506303966e-11
_PART_3 = 2.0222662487959506e-21

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def sine_and_cosine(angle, sine, cosine):
    """Sine and cosine of each entry [rad], to 1 ulp; the loop is free of branches, so it vectorises."""
    largest = 0.0
    for i in range(angle.shape[0]):
        largest = max(largest, abs(angle[i]))
    if largest > LARGEST_ANGLE:
        for i in range(angle.shape[0]):
            sine[i], cosine[i] = math.sin(angle[i]), math.cos(angle[i])
        return
    for i in range(angle.shape[0]):
        n = math.floor(angle[i] * _TWO_OVER_PI + 0.5)
        r = ((angle[i] - n * _PART_1) - n * _PART_2) - n * _PART_3
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
        sine[i] = -a if quarter >= 2.0 else a
        cosine[i] = -b if (quarter == 1.0 or quarter == 2.0) else b


class KernelChain(NamedTuple):
    """A `Chain` as the kernels read it; seen from the frame (`Chain.reversed`) if `local`.

    Attributes:
        sources: Column of the postures that moves each joint, in the chain's order.
        targets: Place of each joint counted from the base.
        sign: -1 if joints are walked from the frame to the base.
        local: Columns along the frame's own axes, else along the base's.
        tool: Origin of the frame in the last joint's frame [m]; unused if local.
    """

    sources: np.ndarray
    targets: np.ndarray
    sign: float
    local: bool
    prismatic: np.ndarray
    offset: np.ndarray
    start_rotation: np.ndarray
    start_position: np.ndarray
    tilt_cos: np.ndarray
    tilt_sin: np.ndarray
    shift: np.ndarray
    tool: np.ndarray


def kernel_chain(chain: Chain, sources: np.ndarray, reference: str) -> KernelChain:
    """What the kernels need of a chain whose joints, base first, are moved by those columns of the postures."""
    local = reference == "local"
    walked = chain.reversed() if local else chain
    order = np.arange(chain.size)[:: -1 if local else 1].copy()
    return KernelChain(
        sources=np.ascontiguousarray(sources[order]),
        targets=order,
        sign=-1.0 if local else 1.0,
        local=local,
        prismatic=walked.prismatic,
        offset=np.ascontiguousarray(walked.offset),
        start_rotation=np.ascontiguousarray(walked.start_rotation),
        start_position=np.ascontiguousarray(walked.start_position),
        tilt_cos=np.ascontiguousarray(walked.tilt_cos),
        tilt_sin=np.ascontiguousarray(walked.tilt_sin),
        shift=np.ascontiguousarray(walked.shift),
        tool=np.ascontiguousarray(chain.tool_position),
    )


@_compiled
def joint_turns(chain, postures, first, size, slide, sine, cosine, angle):
    """Sine, cosine and slide of each joint, walked in the chain's order, for a block of postures."""
    for j in range(chain.sources.shape[0]):
        for m in range(size):
            x = chain.sign * postures[first + m, chain.sources[j]]
            slide[j, m] = x
            angle[m] = chain.offset[j] if chain.prismatic[j] else x + chain.offset[j]
        sine_and_cosine(angle[:size], sine[j], cosine[j])


@_compiled
def columns_of(chain, m, slide, sine, cosine, origin, columns):
    """Jacobian columns (v, w) of one posture, base first, into `columns` (joints, 6)."""
    R, p = chain.start_rotation, chain.start_position
    x0, x1, x2 = R[0, 0], R[1, 0], R[2, 0]
    y0, y1, y2 = R[0, 1], R[1, 1], R[2, 1]
    z0, z1, z2 = R[0, 2], R[1, 2], R[2, 2]
    p0, p1, p2 = p[0], p[1], p[2]
    joints = chain.sources.shape[0]
    for j in range(joints):
        if j > 0:
            a, b, c = chain.shift[j, 0], chain.shift[j, 1], chain.shift[j, 2]
            p0 += x0 * a + y0 * b + z0 * c
            p1 += x1 * a + y1 * b + z1 * c
            p2 += x2 * a + y2 * b + z2 * c
            c, s = chain.tilt_cos[j], chain.tilt_sin[j]
            y0, z0 = c * y0 + s * z0, c * z0 - s * y0
            y1, z1 = c * y1 + s * z1, c * z1 - s * y1
            y2, z2 = c * y2 + s * z2, c * z2 - s * y2
        if chain.prismatic[j]:
            d = slide[j, m]
            p0 += z0 * d
            p1 += z1 * d
            p2 += z2 * d
        target = columns[chain.targets[j]]
        target[3], target[4], target[5] = z0, z1, z2
        origin[j, 0], origin[j, 1], origin[j, 2] = p0, p1, p2
        c, s = cosine[j, m], sine[j, m]
        x0, y0 = c * x0 + s * y0, c * y0 - s * x0
        x1, y1 = c * x1 + s * y1, c * y1 - s * x1
        x2, y2 = c * x2 + s * y2, c * y2 - s * x2
    if chain.local:
        p0 = p1 = p2 = 0.0
    else:
        a, b, c = chain.tool[0], chain.tool[1], chain.tool[2]
        p0 += x0 * a + y0 * b + z0 * c
        p1 += x1 * a + y1 * b + z1 * c
        p2 += x2 * a + y2 * b + z2 * c
    for j in range(joints):
        target = columns[chain.targets[j]]
        z0, z1, z2 = target[3], target[4], target[5]
        if chain.prismatic[j]:
            target[0], target[1], target[2] = z0, z1, z2
            target[3] = target[4] = target[5] = 0.0
        else:
            d0, d1, d2 = p0 - origin[j, 0], p1 - origin[j, 1], p2 - origin[j, 2]
            target[0] = z1 * d2 - z2 * d1
            target[1] = z2 * d0 - z0 * d2
            target[2] = z0 * d1 - z1 * d0


@_compiled
def jacobians(chain, postures, rows, public, out):
    """Rows of the Jacobians into the public columns of `out` (n, p, nv)."""
    joints = chain.sources.shape[0]
    slide, sine, cosine = np.empty((joints, LANES)), np.empty((joints, LANES)), np.empty((joints, LANES))
    angle, origin, columns = np.empty(LANES), np.empty((joints, 3)), np.empty((joints, 6))
    for first in range(0, postures.shape[0], LANES):
        size = min(LANES, postures.shape[0] - first)
        joint_turns(chain, postures, first, size, slide, sine, cosine, angle)
        for m in range(size):
            columns_of(chain, m, slide, sine, cosine, origin, columns)
            for i in range(rows.shape[0]):
                for j in range(joints):
                    out[first + m, i, public[j]] = columns[j, rows[i]]


@_compiled
def derivative_of(columns, local, out):
    """dJ/dq of one posture, base first, into `out` (6, joints, joints): [r, i, k] = d J_ri / d q_k."""
    joints = columns.shape[0]
    for i in range(joints):
        b = columns[i]
        b0, b1, b2, b3, b4, b5 = b[0], b[1], b[2], b[3], b[4], b[5]
        for k in range(i + 1):
            a = columns[k]
            a0, a1, a2, a3, a4, a5 = a[0], a[1], a[2], a[3], a[4], a[5]
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


@_compiled
def jacobians_and_derivatives(chain, postures, rows, public, out, derivative):
    """Rows of J (n, p, nv) and dJ/dq (n, p, nv, nv) into public columns."""
    joints = chain.sources.shape[0]
    slide, sine, cosine = np.empty((joints, LANES)), np.empty((joints, LANES)), np.empty((joints, LANES))
    angle, origin, columns = np.empty(LANES), np.empty((joints, 3)), np.empty((joints, 6))
    block = np.empty((6, joints, joints))
    for first in range(0, postures.shape[0], LANES):
        size = min(LANES, postures.shape[0] - first)
        joint_turns(chain, postures, first, size, slide, sine, cosine, angle)
        for m in range(size):
            columns_of(chain, m, slide, sine, cosine, origin, columns)
            derivative_of(columns, chain.local, block)
            for i in range(rows.shape[0]):
                source, target = block[rows[i]], derivative[first + m, i]
                for j in range(joints):
                    out[first + m, i, public[j]] = columns[j, rows[i]]
                    line = target[public[j]]
                    for k in range(joints):
                        line[public[k]] = source[j, k]
