"""Vector-Jacobian products of A(q) = Lambda J(q), one or many at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import numpy as np
from jaxtyping import Float


@final
class WeightedVjp:
    """weights (s, nv) -> sum_ij weights_ij dA_ij / dq_k, from dJ/dq in Pinocchio's order.

    Args:
        by_joint: shape (n, 6 n), the derivative along each joint of the model; entry [k, 6 i + j] is dJ_ji / dq_k.
        selection: Lambda.
        columns: Which of the robot's joints those of the model are; None for all of them.
        lift: Velocities of the model's joints from those of the robot's; None where they are the same.
        nv: Number of the robot's joints.
    """

    __slots__ = ("_by_joint", "_columns", "_lift", "_nv", "_selection")

    def __init__(
        self,
        by_joint: Float[np.ndarray, "n m"],
        selection: Float[np.ndarray, "s 6"],
        columns: Any,
        lift: Float[np.ndarray, "n nv"] | None,
        nv: int,
    ):
        self._by_joint, self._selection, self._columns, self._lift, self._nv = by_joint, selection, columns, lift, nv

    def __call__(self, weights: Float[np.ndarray, "s nv"]) -> Float[np.ndarray, " nv"]:
        """The product."""
        lift, columns = self._lift, self._columns
        if lift is not None:
            return self._by_joint.dot(lift.dot(weights.T).dot(self._selection).reshape(-1)).dot(lift)
        if columns is None:
            return self._by_joint.dot(weights.T.dot(self._selection).reshape(-1))
        out = np.zeros(self._nv)
        out[columns] = self._by_joint.dot(weights.T[columns].dot(self._selection).reshape(-1))
        return out

    def many(self, weights: Float[np.ndarray, "s m"]) -> Float[np.ndarray, "k nv"]:
        """The products of matrices that stand side by side, one row for each, in one go."""
        selection, by_joint, lift, columns = self._selection, self._by_joint, self._lift, self._columns
        if lift is None and columns is None:
            return weights.T.dot(selection).reshape(-1, by_joint.shape[1]).dot(by_joint.T)
        nv = self._nv
        stack = weights.T.reshape(-1, nv, weights.shape[0])
        stack = stack[:, columns] if lift is None else np.matmul(lift, stack)
        rows = stack.dot(selection).reshape(stack.shape[0], -1).dot(by_joint.T)
        if lift is not None:
            return rows.dot(lift)
        out = np.zeros((rows.shape[0], nv))
        out[:, columns] = rows
        return out


def gradient(
    vjp: Callable[[Float[np.ndarray, "s nv"]], Float[np.ndarray, " nv"]], weights: Float[np.ndarray, "s nv"]
) -> Float[np.ndarray, " nv"]:
    """The vector-Jacobian product, as the control law calls it: compiled, it has arrays in the place of `vjp`."""
    return vjp(weights)


def vjps(
    vjp: Callable[[Float[np.ndarray, "s nv"]], Float[np.ndarray, " nv"]],
    weights: Float[np.ndarray, "s m"],
    number: int,
) -> Float[np.ndarray, "number nv"]:
    """The vector-Jacobian products of matrices that stand side by side, in one go where that is known."""
    if isinstance(vjp, WeightedVjp):
        return vjp.many(weights)
    return np.array([vjp(matrix) for matrix in np.split(weights, number, axis=1)])
