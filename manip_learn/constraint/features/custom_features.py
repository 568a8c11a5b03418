"""Features from the user's own functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import FeatureError
from manip_learn.robot.robot import Robot

STEP = 1e-5  # central differences: truncation h^2 meets rounding eps / h


@final
class CustomFeatures(FeatureMap):
    """Phi(q) from a function, e.g. polynomials of the state of a system that is no robot arm.

    Args:
        function: q -> Phi, shape (p, nv).
        row_names: One name a row.
        nv: Number of velocities; taken from the robot if one is given.
        derivative: q -> dPhi/dq, shape (p, nv, nv). Without it central differences are used (error about 1e-10).
        coordinates: q -> r, shape (p,), with dr/dt = Phi u; only needed for attractor tasks.
        row_units: One unit a row.
        robot: The robot that q belongs to; without one q is a plain vector of size nv.

    Raises:
        FeatureError: No size, or a function that returns the wrong shape or values that are not finite.
    """

    def __init__(
        self,
        function: Callable[[np.ndarray], ArrayLike],
        row_names: Sequence[str],
        nv: int | None = None,
        *,
        derivative: Callable[[np.ndarray], ArrayLike] | None = None,
        coordinates: Callable[[np.ndarray], ArrayLike] | None = None,
        row_units: Sequence[str] | None = None,
        robot: Robot | None = None,
    ):
        if nv is None and robot is None:
            raise FeatureError("CustomFeatures needs nv= (number of velocities) or robot=")
        if not row_names:
            raise FeatureError("CustomFeatures needs one row name for each row of Phi")
        self.robot = robot
        self.nv = int(nv) if nv is not None else robot.nv  # type: ignore[union-attr]
        self.row_names = tuple(row_names)
        self.row_units = tuple(row_units) if row_units else ("1",) * len(self.row_names)
        self._function = function
        self._derivative = derivative
        self._coordinates = coordinates

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Phi(q), checked for shape and NaN.

        Raises:
            FeatureError: Wrong shape or not finite.
        """
        return self._checked(self._function(self._state(q)), (self.n_rows, self.nv), "Phi")

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """dPhi/dq along tangent coordinates.

        Raises:
            FeatureError: Wrong shape or not finite.
        """
        state = self._state(q)
        shape = (self.n_rows, self.nv, self.nv)
        if self._derivative is not None:
            return self._checked(self._derivative(state), shape, "dPhi/dq")
        out = np.empty(shape)
        for k in range(self.nv):
            step = np.zeros(self.nv)
            step[k] = STEP
            out[:, :, k] = (self(self._moved(state, step)) - self(self._moved(state, -step))) / (2 * STEP)
        return out

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Task coordinates r(q), if they were given.

        Raises:
            FeatureError: They were not, or have the wrong shape.
        """
        if self._coordinates is None:
            return super().coordinates(q)
        return self._checked(self._coordinates(self._state(q)), (self.n_rows,), "coordinates")

    def _state(self, q: ArrayLike) -> np.ndarray:
        if self.robot is not None:
            return self.robot.configuration(q)
        return np.asarray(q, dtype=np.float64)

    def _moved(self, state: np.ndarray, step: np.ndarray) -> np.ndarray:
        return state + step if self.robot is None else self.robot.integrate(state, step)

    def _checked(self, value: ArrayLike, shape: tuple[int, ...], what: str) -> np.ndarray:
        array = np.asarray(value, dtype=np.float64)
        if array.shape != shape:
            raise FeatureError(f"{what} of {self!r} must have shape {shape}, the function returned {array.shape}")
        if not np.all(np.isfinite(array)):
            raise FeatureError(f"{what} of {self!r} is not finite: {array.tolist()}")
        return array

    def __repr__(self) -> str:
        return f"CustomFeatures(rows={' '.join(self.row_names)!r}, nv={self.nv})"
