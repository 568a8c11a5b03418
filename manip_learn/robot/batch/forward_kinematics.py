"""Axes and origins of a chain's joints at many postures, one array per component (structure of arrays).

Arrays are (3, n) or (3, joints, n) with the postures last, so that every NumPy call runs over contiguous memory that
fits into the second-level cache.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.robot.batch.chain import Chain


@final
@dataclass(frozen=True)
class SweepBuffers:
    """Memory of one chunk, used again for the next; belongs to one call, so that threads never share it.

    Attributes:
        axis: shape (3, joints, n), unit axis of each joint.
        origin: shape (3, joints, n) [m], origin of each joint's frame.
        scratch: shape (6, 3, n).
        work: shape (2, 3, n), free after a sweep.
    """

    axis: Float[np.ndarray, "3 j n"]
    origin: Float[np.ndarray, "3 j n"]
    scratch: Float[np.ndarray, "6 3 n"]
    work: Float[np.ndarray, "2 3 n"]

    @staticmethod
    def of(joints: int, n: int) -> SweepBuffers:
        """Memory for a chain of that many joints and chunks of n postures."""
        return SweepBuffers(
            np.empty((3, joints, n)), np.empty((3, joints, n)), np.empty((6, 3, n)), np.empty((2, 3, n))
        )

    def first(self, n: int) -> SweepBuffers:
        """The part for a last, smaller chunk."""
        return SweepBuffers(self.axis[..., :n], self.origin[..., :n], self.scratch[..., :n], self.work[..., :n])


@final
@dataclass(frozen=True)
class Tip:
    """Pose of the last joint's frame after its motion; columns of the rotation and the origin, each (3, n)."""

    x: Float[np.ndarray, "3 n"]
    y: Float[np.ndarray, "3 n"]
    z: Float[np.ndarray, "3 n"]
    origin: Float[np.ndarray, "3 n"]


def sweep(chain: Chain, position: Float[np.ndarray, "j n"], buffers: SweepBuffers) -> Tip:
    """Fill `buffers.axis` and `buffers.origin`, base first, and return the pose at the end of the chain.

    Args:
        chain: The chain.
        position: Joint positions [rad or m] in the chain's order, offsets not yet added.
        buffers: Overwritten; the returned tip points into it.
    """
    axis, origin = buffers.axis, buffers.origin
    x_now, x_next, y_now, y_next, y_tilted, work = buffers.scratch
    angle = position + chain.offset[:, None]
    if chain.prismatic.any():
        angle[chain.prismatic] = chain.offset[chain.prismatic, None]
    cos, sin = np.cos(angle), np.sin(angle)

    x, y, z = (column[:, None] for column in chain.start_rotation.T)
    for i in range(chain.size):
        p, w = origin[:, i], axis[:, i]
        if i == 0:
            p[...], w[...] = chain.start_position[:, None], z
        else:
            _shift(origin[:, i - 1], x, y, z, chain.shift[i], p, work)
            y = _tilt(y, z, chain.tilt_cos[i], chain.tilt_sin[i], w, y_tilted, work)
        z = w
        if chain.prismatic[i]:
            p += np.multiply(z, position[i], out=work)
        np.multiply(x, cos[i], out=x_next)
        x_next += np.multiply(y, sin[i], out=work)
        np.multiply(y, cos[i], out=y_next)
        y_next -= np.multiply(x, sin[i], out=work)
        x, y = x_next, y_next
        x_now, x_next, y_now, y_next = x_next, x_now, y_next, y_now
    return Tip(x, y, z, origin[:, -1])


def tip_position(
    tip: Tip, offset: Float[np.ndarray, " 3"], work: Float[np.ndarray, "2 3 n"]
) -> Float[np.ndarray, "3 n"]:
    """Where a point fixed to the last joint's frame is [m]."""
    out = work[0]
    _shift(tip.origin, tip.x, tip.y, tip.z, offset, out, work[1])
    return out


def _shift(
    p: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray, t: np.ndarray, out: np.ndarray, work: np.ndarray
) -> None:
    """Out = p + [x y z] t, leaving out the zeros of t."""
    start = p
    for column, length in ((x, t[0]), (y, t[1]), (z, t[2])):
        if length != 0.0:
            np.add(start, np.multiply(column, length, out=work), out=out)
            start = out
    if start is p:
        out[...] = p


def _tilt(
    y: np.ndarray, z: np.ndarray, c: float, s: float, z_out: np.ndarray, y_out: np.ndarray, work: np.ndarray
) -> np.ndarray:
    """Turn (y, z) about x: z goes into `z_out`, the new y comes back. Right angles cost no multiplication."""
    if c == 1.0 and s == 0.0:  # a tilt of 1e-9 has a cosine of 1, too
        z_out[...] = z
        return y
    if c == 0.0 and s == 1.0:
        np.negative(y, out=z_out)
        return z
    np.multiply(z, c, out=z_out)
    z_out -= np.multiply(y, s, out=work)
    np.multiply(y, c, out=y_out)
    y_out += np.multiply(z, s, out=work)
    return y_out
