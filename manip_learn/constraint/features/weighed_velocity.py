"""Rows W(p) J(q): the velocity of a frame, weighed by where its origin is; one form for every mechanism."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian, PoseRows, RelativeFrameJacobian
from manip_learn.constraint.place import AXES, PlaceWeights
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot


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
        seen: dict[str, Any] = {} if relative_to is None else {"relative_to": relative_to}
        self.twist: PoseRows = (RelativeFrameJacobian if seen else FrameJacobian)(robot, frame, axes=AXES, **seen)
        self.relative_to, self._relative_to = self.twist.relative_to, relative_to

    def weights(self, p: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n r 6"], Float[np.ndarray, "n r 6 3"]]:
        """W(p) and dW/dp at n places [m]; row i of W weighs (v, w) of the frame."""
        return self.place_weights.at(p)

    def weights_at(self, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n p 6"]:
        """Weights of the rows of `twist` in these rows, at n poses of the frame."""
        return self.values(poses[:, :3, 3])

    def values(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n r 6"]:
        """W(p) at n places [m]."""
        return self.place_weights.values(p)

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Phi(q) = W(p) J(q).

        Raises:
            ConfigurationError: Wrong size or not finite.
        """
        return self.values(self.twist.placement(q)[0][None])[0] @ self.twist(q)

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Phi(q) and dPhi/dq = W dJ/dq + (dW/dp J_v) J."""
        W, dW = (x[0] for x in self.weights(self.twist.placement(q)[0][None]))
        return _product(W, dW, *self.twist.value_and_derivative(q))

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Phi at n postures, the rows of q, in bulk.

        Raises:
            ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        """
        return self.weights_at(self.twist.poses(q)) @ self.twist.batch(q)

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Phi and dPhi/dq at n postures, in bulk; errors as for `batch`."""
        W, dW = self.weights(self.twist.poses(q)[:, :3, 3])
        return _product(W, dW, *self.twist.batch_with_derivative(q))


def _product(W: np.ndarray, dW: np.ndarray, J: np.ndarray, H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return W J and W dJ/dq + (dW/dp J_v) J, of one posture or of many."""
    *many, nv, _ = H.shape
    turned = (W @ H.reshape(*many, nv * nv)).reshape(*W.shape[:-1], nv, nv)
    return W @ J, turned + J.swapaxes(-1, -2)[..., None, :, :] @ (dW @ J[..., None, :3, :])
