"""Rows W(p) J(q): the velocity of a frame, weighed by where its origin is."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap, Vjp, Weigh
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.frame import Frame
from manip_learn.robot.robot import Robot


class WeighedVelocity(FeatureMap):
    """Phi(q) = W(p(q)) J(q), with J the frame's Jacobian along the axes of the robot's base and p its origin.

    Attributes:
        robot: The robot.
        frame: The frame.
    """

    robot: Robot
    frame: Frame

    @abstractmethod
    def weights(self, p: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n r 6"], Float[np.ndarray, "n r 6 3"]]:
        """W(p) and dW/dp at n places [m]; row i of W weighs (v, w) of the frame."""

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Phi(q) = W(p) J(q).

        Raises:
            ConfigurationError: Wrong size or not finite.
        """
        return self._weights_at(q)[0] @ self.robot.jacobian(q, self.frame, "world")

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """dPhi/dq, exact; entry [i, j, k] = d Phi_ij / d q_k.

        Raises:
            ConfigurationError: Wrong size or not finite.
        """
        return self.value_and_derivative(q)[1]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Phi(q) and dPhi/dq = W dJ/dq + (dW/dp J_v) J."""
        W, dW = self._weights_at(q)
        J, H = self.robot.jacobian_and_derivative(q, self.frame, "world")
        turned = W @ H.reshape(6, -1)
        return W @ J, turned.reshape(-1, self.nv, self.nv) + J.T @ (dW @ J[:3])

    def value_and_vjp(self, q: ArrayLike, padded: Float[np.ndarray, "s p"]) -> tuple[Float[np.ndarray, "s nv"], Vjp]:
        """A = Lambda Phi(q), and weights -> sum_ij weights_ij dA_ij / dq_k (see `FeatureMap`)."""
        W, dW = self._weights_at(q)
        mix = padded.dot(W)
        A, vjp = self.robot.weighted_jacobian_vjp(q, self.frame, "world", mix)
        J = self.robot.jacobian(q, self.frame, "world").copy()  # may be a view of data that later calls overwrite
        by_place = padded.dot(dW.reshape(len(W), -1)).reshape(-1, 3)

        def weighted(weights_of_A: np.ndarray) -> np.ndarray:
            return vjp(weights_of_A) + weights_of_A.dot(J.T).reshape(-1).dot(by_place).dot(J[:3])

        return A, weighted

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Phi at n postures, the rows of q, in bulk.

        Raises:
            ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        """
        J = batch_kinematics(self.robot, self.frame).jacobian(q, "world")
        return self._batch_weights(q)[0] @ J

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Phi and dPhi/dq at n postures, in bulk; errors as for `batch`."""
        W, dW = self._batch_weights(q)
        J, H = batch_kinematics(self.robot, self.frame).jacobian_and_derivative(q, "world")
        n, nv = len(W), self.nv
        turned = (W @ H.reshape(n, 6, nv * nv)).reshape(n, self.n_rows, nv, nv)
        return W @ J, turned + J.transpose(0, 2, 1)[:, None] @ (dW @ J[:, None, :3])

    def batch_vjp(self, q: ArrayLike, weigh: Weigh) -> Float[np.ndarray, "n nv"]:
        """sum_ij weights_ij dPhi_ij / dq_k at n postures without forming dPhi/dq (see `FeatureMap`)."""
        W, dW = self._batch_weights(q)
        by_place = np.zeros((len(W), self.nv))

        def weigh_twist(J: np.ndarray, part: slice) -> np.ndarray:
            # (6, nv, m) with the postures last: the weights of Phi become weights of J, and the rest is kept aside
            J_n = J.transpose(2, 0, 1)
            weights_n = weigh((W[part] @ J_n).transpose(1, 2, 0), part).transpose(2, 0, 1)
            along = weights_n @ J_n.transpose(0, 2, 1)
            by_place[part] = np.einsum("nim,nimd,ndk->nk", along, dW[part], J_n[:, :3], optimize=True)
            return (W[part].transpose(0, 2, 1) @ weights_n).transpose(1, 2, 0)

        return batch_kinematics(self.robot, self.frame).vjp(q, weigh_twist, "world") + by_place

    def _weights_at(self, q: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        W, dW = self.weights(self.robot.position(q, self.frame)[None])
        return W[0], dW[0]

    def _batch_weights(self, q: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        return self.weights(batch_kinematics(self.robot, self.frame).pose(q)[:, :3, 3])
