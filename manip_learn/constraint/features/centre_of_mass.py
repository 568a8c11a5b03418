"""Rows of the centre of mass's Jacobian as features: for balance, legged and dual-arm robots."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import parse_axes
from manip_learn.errors import FeatureError
from manip_learn.robot.robot import Robot


@final
class CentreOfMass(FeatureMap):
    """Velocity of the centre of mass [m/s] along the axes of the robot's base.

    Args:
        robot: The robot; its URDF needs inertias.
        axes: Any of `x y z`.

    Raises:
        FeatureError: Unknown axes, or a robot without mass.
    """

    def __init__(self, robot: Robot, axes: str = "xyz"):
        self.robot = robot
        self.row_names = parse_axes(axes)
        if any(n not in "xyz" for n in self.row_names):
            raise FeatureError(f"the centre of mass has the axes x y z only, not {axes!r}")
        if robot.mass <= 0.0:
            raise FeatureError(f"robot {robot.name!r} has no mass: its URDF gives no inertias")
        self.row_units = ("m/s",) * len(self.row_names)
        self.nv = robot.nv
        self._rows = ["xyz".index(n) for n in self.row_names]

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Phi(q): rows of the centre of mass's Jacobian [m/s a joint velocity]."""
        return self.value_and_derivative(q)[0]

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """dPhi/dq, exact."""
        return self.value_and_derivative(q)[1]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Phi(q) and dPhi/dq in one pass."""
        J, H = self.robot.centre_of_mass_jacobian_and_derivative(q)
        return J[self._rows], H[self._rows]

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Centre of mass in the base frame [m], the chosen rows."""
        return self.robot.centre_of_mass(q)[self._rows]

    def describe(self) -> dict[str, Any]:
        """Axes, as saved in a constraint file."""
        return {"kind": "centre-of-mass", "axes": list(self.row_names), "units": list(self.row_units)}

    def __repr__(self) -> str:
        return f"CentreOfMass({self.robot.name!r}, axes={' '.join(self.row_names)!r})"
