"""Jacobian columns of a chain at many postures, their derivative, and its vector-Jacobian product.

Arrays are (3, joints, n): component, joint (base first), posture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.robot.batch.chain import ChainColumns

AFTER = ((1, 2), (2, 0), (0, 1))  # (a x b)_r = a_i b_j - a_j b_i with i, j = AFTER[r]


@final
class ChainMotion:
    """Columns (v_j, w_j) of a frame's Jacobian: (w_j x lever_j, w_j) if joint j turns, (axis, 0) if it slides.

    Args:
        axis: Unit axes of the joints, along the base axes or the frame's own; may be overwritten.
        lever: From the joint to the frame's origin [m].
        prismatic: Which joints slide.
        reference: `"world"` or `"local"`: along which axes.

    Attributes:
        w: Angular columns.
        reference: As given.
    """

    def __init__(
        self,
        axis: Float[np.ndarray, "3 j n"],
        lever: Float[np.ndarray, "3 j n"],
        prismatic: Bool[np.ndarray, " j"],
        reference: str,
    ):
        self.w = axis
        self.reference = reference
        self._lever = lever
        self._sliding = np.flatnonzero(prismatic)
        self._slides = axis[:, self._sliding]  # a copy
        self._v: np.ndarray | None = None
        if self._sliding.size:
            self.w[:, self._sliding] = 0.0

    def write_linear(self, r: int, out: Float[np.ndarray, "j n"], work: Float[np.ndarray, "j n"]) -> None:
        """Component r of the linear columns."""
        cross_row(self.w, self._lever, r, out, work)
        if self._sliding.size:
            out[self._sliding] = self._slides[r]

    @property
    def v(self) -> Float[np.ndarray, "3 j n"]:
        """Linear columns."""
        if self._v is None:
            self._v = np.empty(self.w.shape)
            work = np.empty(self.w.shape[1:])
            for r in range(3):
                self.write_linear(r, self._v[r], work)
        return self._v


def write_jacobian(
    motion: ChainMotion, rows: Sequence[int], columns: ChainColumns, out: Float[np.ndarray, "p nv n"]
) -> None:
    """Rows (0 .. 5: x y z rx ry rz) of the Jacobian into public columns."""
    joints, n = motion.w.shape[1:]
    work = np.empty((2, joints, n))
    for target, row in zip(out, rows, strict=True):
        if row >= 3:
            columns.scatter(motion.w[row - 3], target)
            continue
        direct = columns.view(target)
        motion.write_linear(row, work[0] if direct is None else direct, work[1])
        if direct is None:
            columns.scatter(work[0], target)


def write_derivative(
    motion: ChainMotion, rows: Sequence[int], columns: ChainColumns, out: Float[np.ndarray, "p nv nv n"]
) -> None:
    """Rows of dJ/dq into public columns: entry [r, i, k] = d J_ri / d q_k (see `kinematic_hessian.closed_form`)."""
    joints, n = motion.w.shape[1:]
    block = np.empty((1, joints, joints, n))
    write = _write_world if motion.reference == "world" else _write_local
    for position, row in enumerate(rows):
        write(motion, row, block[0])
        columns.scatter_pairs(block, out[position : position + 1])


def _write_world(motion: ChainMotion, row: int, out: np.ndarray) -> None:
    w, joints, r = motion.w, motion.w.shape[1], row % 3
    lower_column = motion.v if row < 3 else w
    work = np.empty(out.shape[1:])
    for k in range(joints):
        # w_k x v_i for every joint i from k on
        cross_row(w[:, k, None], lower_column[:, k:], r, out[k:, k], work[k:])
        # the joint above turns the velocity that the lower one gives, whichever of the two the derivative is along
        out[k, k:] = out[k:, k] if row < 3 else 0.0


def _write_local(motion: ChainMotion, row: int, out: np.ndarray) -> None:
    w, joints, r = motion.w, motion.w.shape[1], row % 3
    v = motion.v if row < 3 else w
    work = np.empty(out.shape[1:])
    i, j = AFTER[r]
    for k in range(joints):
        block = out[k, k + 1 :]
        cross_row(w[:, k, None], v[:, k + 1 :], r, block, work[k + 1 :])
        if row < 3:
            block += np.multiply(v[i, k], w[j, k + 1 :], out=work[k + 1 :])
            block -= np.multiply(v[j, k], w[i, k + 1 :], out=work[k + 1 :])
        out[k:, k] = 0.0


def jacobian_vjp(motion: ChainMotion, weights: Float[np.ndarray, "6 j n"]) -> Float[np.ndarray, "j n"]:
    """sum_ri weights_ri dJ_ri / dq_k for each joint k, in time linear in the joints and without dJ/dq.

    The sums over the joints below or above k are running sums of cross products.
    """
    w, v, cv, cw = motion.w, motion.v, weights[:3], weights[3:]
    out = np.zeros(w.shape[1:])
    if motion.reference == "world":
        moment = np.cumsum((cross(v, cv) + cross(w, cw))[:, ::-1], axis=1)[:, ::-1]
        force = np.cumsum(cross(cv, w), axis=1)
        out += np.sum(w * moment, axis=0)
        out[1:] += np.sum(v[:, 1:] * force[:, :-1], axis=0)
        return out
    force = np.cumsum(cross(cv, w), axis=1)[:, :-1]
    moment = np.cumsum(cross(cv, v) + cross(cw, w), axis=1)[:, :-1]
    out[1:] = np.sum(v[:, 1:] * force + w[:, 1:] * moment, axis=0)
    return out


def cross_row(a: np.ndarray, b: np.ndarray, r: int, out: np.ndarray, work: np.ndarray) -> None:
    """Component r of a x b, for arrays (3, ...) that broadcast against each other."""
    i, j = AFTER[r]
    np.multiply(a[i], b[j], out=out)
    out -= np.multiply(a[j], b[i], out=work)


def cross(a: Float[np.ndarray, "3 j n"], b: Float[np.ndarray, "3 j n"]) -> Float[np.ndarray, "3 j n"]:
    """A x b over the first axis."""
    return np.stack([a[i] * b[j] - a[j] * b[i] for i, j in AFTER])
