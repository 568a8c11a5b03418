"""Rows W(p) J(q): the velocity of a frame, weighed by where its origin is; one form for every mechanism."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap, Vjp
from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian, PoseRows
from manip_learn.constraint.features.relative_frame_jacobian import RelativeFrameJacobian
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot

ON_AXIS = 1e-5  # [m] below this distance from the axis (or the centre) a direction fades to zero instead of flipping

EVERY_ROW = np.eye(6)  # the twist itself


@final
@dataclass(frozen=True, eq=False)
class PlaceWeights:
    """W(p) = T_0 + sum_k p_k T_k; row i weighs (v, w) of a frame whose origin is at p, in the base frame.

    Attributes:
        constant: T_0, shape (r, 6).
        by_place: T_k, shape (r, 6, 3).
        free: Rows whose weights of v, y = T_0 + sum_k p_k T_k, are made unit length, y / sqrt(|y|^2 + e^2) with
            e = `ON_AXIS`; with a direction b (otherwise zero) and a pitch h those of a helix about b at any distance,
            (|y|^2 b - h y) / sqrt((|y|^2 + e^2) (|y|^2 + h^2 + e^2)). By number: b and h.
    """

    constant: Float[np.ndarray, "r 6"]
    by_place: Float[np.ndarray, "r 6 3"]
    free: Mapping[int, tuple[Float[np.ndarray, " 3"], float]] = field(default_factory=dict)

    def at(self, p: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n r 6"], Float[np.ndarray, "n r 6 3"]]:
        """W(p) and dW/dp at n places [m]."""
        W = self.constant + (p @ self.by_place.reshape(-1, 3).T).reshape(len(p), -1, 6)
        dW = np.broadcast_to(self.by_place, (len(p), *self.by_place.shape))
        if self.free:
            dW = dW.copy()
        for i in self.free:
            W[:, i, :3], dW[:, i, :3] = self.unit_length(i, p)
        return W, dW

    def unit_length(
        self, i: int, p: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
        """The weights of v in a free row, and their derivative along p."""
        (b, h), Y = self.free[i], self.by_place[i, :3]
        y = self.constant[i, :3] + p @ Y.T
        s, along = (y * y).sum(1)[:, None], y @ Y
        edge, turned, rise = s + ON_AXIS**2, 1.0, 1.0
        size, df = np.sqrt(edge), Y
        if b.any():
            size, turned, rise = np.sqrt(edge * (edge + h * h)), -h, 2.0 * edge + h * h
            df = 2.0 * b[:, None] * along[:, None] - h * Y
        f = (s * b + turned * y) / size
        return f, (df - f[:, :, None] * (rise * along / size)[:, None]) / size[:, None]


class WeighedVelocity(FeatureMap):
    """Phi(q) = W(p(q)) J(q), with J the twist of a frame along the axes of the robot's base and p its origin.

    Seen from another frame, J and p are those of `RelativeFrameJacobian`, along the axes of that frame.

    Attributes:
        robot: The robot.
        frame: The frame.
        relative_to: The frame from which it is seen; None for the robot's base.
        place_weights: W.
    """

    robot: Robot
    frame: Frame
    relative_to: Frame | None
    place_weights: PlaceWeights

    def __init__(self, robot: Robot, frame: str, relative_to: str | None = None):
        self.robot, self.frame, self.nv = robot, robot.frame(frame), robot.nv
        self.twist: PoseRows = FrameJacobian(robot, frame, AXES)
        if relative_to is not None:
            self.twist = RelativeFrameJacobian(robot, frame, relative_to, AXES)
        self.relative_to = self.twist.relative_to
        self._seen = "" if relative_to is None else f", relative_to={relative_to!r}"  # in a representation

    def weights(self, p: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n r 6"], Float[np.ndarray, "n r 6 3"]]:
        """W(p) and dW/dp at n places [m]; row i of W weighs (v, w) of the frame."""
        return self.place_weights.at(p)

    def weights_at(self, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n p 6"]:
        """Weights of the rows of `twist` in these rows, at n poses of the frame."""
        return self.weights(poses[:, :3, 3])[0]

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Phi(q) = W(p) J(q).

        Raises:
            ConfigurationError: Wrong size or not finite.
        """
        return self._weights_at(q)[0] @ self.twist(q)

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """dPhi/dq, exact; entry [i, j, k] = d Phi_ij / d q_k.

        Raises:
            ConfigurationError: Wrong size or not finite.
        """
        return self.value_and_derivative(q)[1]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Phi(q) and dPhi/dq = W dJ/dq + (dW/dp J_v) J."""
        W, dW = self._weights_at(q)
        J, H = self.twist.value_and_derivative(q)
        turned = W @ H.reshape(6, -1)
        return W @ J, turned.reshape(-1, self.nv, self.nv) + J.T @ (dW @ J[:3])

    def padded(self, selection: Float[np.ndarray, "s p"]) -> Float[np.ndarray, "s k"]:
        """Lambda T_0 (6 columns) and Lambda T_k (18) of affine rows, then Lambda's shares of those of unit length."""
        place, affine = self.place_weights, selection.copy()
        free = list(place.free)
        affine[:, free] = 0.0
        numbers = np.concatenate([place.constant, place.by_place.reshape(-1, 18)], axis=1)
        return np.concatenate([affine @ numbers, selection[:, free]], axis=1)

    def value_and_vjp(self, q: ArrayLike, padded: Float[np.ndarray, "s k"]) -> tuple[Float[np.ndarray, "s nv"], Vjp]:
        """A = Lambda Phi(q), and weights -> sum_ij weights_ij dA_ij / dq_k (see `FeatureMap`)."""
        J, vjp = self.twist.value_and_vjp(q, EVERY_ROW)
        p = self.twist.placement(q)[0]  # there already
        slopes = padded[:, 6:24].reshape(-1, 6, 3)
        mix = padded[:, :6] + slopes.dot(p)
        if self.place_weights.free:
            slopes = slopes.copy()
        for share, i in zip(padded[:, 24:].T, self.place_weights.free, strict=True):
            f, df = self.place_weights.unit_length(i, p[None])
            mix[:, :3] += share[:, None] * f
            slopes[:, :3] += share[:, None, None] * df
        by_place = slopes.reshape(-1, 3)

        def weighted(weights: np.ndarray) -> np.ndarray:
            return vjp(mix.T.dot(weights)) + weights.dot(J.T).reshape(-1).dot(by_place).dot(J[:3])

        return mix.dot(J), weighted

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Phi at n postures, the rows of q, in bulk.

        Raises:
            ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        """
        return self._batch_weights(q)[0] @ self.twist.batch(q)

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Phi and dPhi/dq at n postures, in bulk; errors as for `batch`."""
        W, dW = self._batch_weights(q)
        J, H = self.twist.batch_with_derivative(q)
        n, nv = len(W), self.nv
        turned = (W @ H.reshape(n, 6, nv * nv)).reshape(n, self.n_rows, nv, nv)
        return W @ J, turned + J.transpose(0, 2, 1)[:, None] @ (dW @ J[:, None, :3])

    def _weights_at(self, q: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        W, dW = self.weights(self.twist.placement(q)[0][None])
        return W[0], dW[0]

    def _batch_weights(self, q: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        return self.weights(self.twist.poses(q)[:, :3, 3])
