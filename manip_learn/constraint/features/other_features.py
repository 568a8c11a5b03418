"""Features that are no rows of one frame: the centre of mass, the user's own functions, several maps stacked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import ErrorAndRate, FeatureMap, parse_axes
from manip_learn.constraint.features.frame_jacobian import FrameJacobian, RelativeFrameJacobian
from manip_learn.constraint.features.mechanism_rows import CurveRows, MechanismRows, PlaceRows
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

    kind, saved, own_axes = "centre-of-mass", {"axes": "row_names"}, False

    def __init__(self, robot: Robot, axes: str | Sequence[str] = "xyz"):
        self.robot, self.nv, self.row_names = robot, robot.nv, parse_axes(axes)
        if any(n not in "xyz" for n in self.row_names):
            raise FeatureError(f"the centre of mass has the axes x y z only, not {axes!r}")
        if robot.mass <= 0.0:
            raise FeatureError(f"robot {robot.name!r} has no mass: its URDF gives no inertias")
        self.row_units = ("m/s",) * len(self.row_names)
        self._rows = ["xyz".index(n) for n in self.row_names]

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Return Phi(q), rows of the centre of mass's Jacobian [m/s a joint velocity]."""
        return self.value_and_derivative(q)[0]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Return Phi(q) and dPhi/dq in one pass."""
        J, H = self.robot.centre_of_mass_jacobian_and_derivative(q)
        return J[self._rows], H[self._rows]

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return the centre of mass in the base frame [m], the chosen rows."""
        return self.robot.centre_of_mass(q)[self._rows]


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
        self.robot, self.nv = robot, robot.nv if nv is None else int(nv)  # type: ignore[union-attr]
        self.row_names = tuple(row_names)
        self.row_units = tuple(row_units) if row_units else ("1",) * len(self.row_names)
        self._function, self._derivative, self._coordinates = function, derivative, coordinates
        self._state = partial(np.asarray, dtype=np.float64) if robot is None else robot.configuration
        self._moved = np.add if robot is None else robot.integrate

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Return Phi(q), checked for shape and NaN.

        Raises:
            FeatureError: Wrong shape or not finite.
        """
        return self._checked(self._function(self._state(q)), (self.n_rows, self.nv), "Phi")

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """Return dPhi/dq along tangent coordinates.

        Raises:
            FeatureError: Wrong shape or not finite.
        """
        state = self._state(q)
        if self._derivative is not None:
            return self._checked(self._derivative(state), (self.n_rows, self.nv, self.nv), "dPhi/dq")
        h = 1e-5  # of central differences: truncation h^2 meets rounding eps / h
        rises = [self(self._moved(state, step)) - self(self._moved(state, -step)) for step in h * np.eye(self.nv)]
        return np.stack(rises, axis=-1) / (2 * h)

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return task coordinates r(q), if they were given.

        Raises:
            FeatureError: They were not, or have the wrong shape.
        """
        if self._coordinates is None:
            return super().coordinates(q)
        return self._checked(self._coordinates(self._state(q)), (self.n_rows,), "coordinates")

    def _checked(self, value: ArrayLike, shape: tuple[int, ...], what: str) -> np.ndarray:
        array = np.asarray(value, dtype=np.float64)
        if array.shape != shape:
            raise FeatureError(f"{what} of {self!r} must have shape {shape}, the function returned {array.shape}")
        if not np.all(np.isfinite(array)):
            raise FeatureError(f"{what} of {self!r} is not finite: {array.tolist()}")
        return array

    def __repr__(self) -> str:
        return f"CustomFeatures(rows={' '.join(self.row_names)!r}, nv={self.nv})"


@final
class Stacked(FeatureMap):
    """Rows of several feature maps of one robot, in order: two hands, a hand and an elbow, ...

    Args:
        parts: At least one feature map; all act on the same velocities.

    Raises:
        FeatureError: None given, or sizes differ.
    """

    kind = "stacked"

    def __init__(self, parts: Sequence[FeatureMap]):
        self.parts = tuple(parts)
        sizes = {part.nv for part in self.parts}
        if len(sizes) != 1:
            raise FeatureError(f"stacked feature maps must act on one robot's velocities: nv is {sorted(sizes)}")
        robots = [part.robot for part in self.parts if part.robot is not None]
        if any(r.fingerprint != robots[0].fingerprint for r in robots):
            raise FeatureError(f"stacked feature maps must share one robot, got {[r.name for r in robots]}")
        self.robot, self.nv = robots[0] if robots else None, sizes.pop()
        self.row_names = tuple(f"{i}.{n}" for i, part in enumerate(self.parts) for n in part.row_names)
        self.row_units = tuple(u for part in self.parts for u in part.row_units)

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Return Phi(q), the parts' rows in order."""
        return np.concatenate([part(q) for part in self.parts])

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """Return dPhi/dq, the parts' derivatives in order."""
        return np.concatenate([part.derivative(q) for part in self.parts])

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Return Phi at many configurations, each part in its own fast way."""
        return np.concatenate([part.batch(q) for part in self.parts], axis=1)

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return task coordinates of all parts."""
        return np.concatenate([part.coordinates(q) for part in self.parts])

    def coordinates_jacobian(self, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Return rates of the coordinates, part by part."""
        return self._stack([part.coordinates_jacobian(q) for part in self.parts], q)

    def error_and_jacobian(self, target: ArrayLike, q: ArrayLike) -> ErrorAndRate:
        """Return the displacement to a target and E, part by part (see the parts)."""
        goals = np.split(self._goal(target), np.cumsum([part.n_rows for part in self.parts])[:-1])
        both = [part.error_and_jacobian(own, q) for part, own in zip(self.parts, goals, strict=True)]
        return np.concatenate([e for e, _ in both]), self._stack([E for _, E in both], q)

    def _stack(self, blocks: list[Float[np.ndarray, "k nv"] | None], q: ArrayLike) -> np.ndarray | None:
        if all(block is None for block in blocks):
            return None
        return np.concatenate([p(q) if b is None else b for p, b in zip(self.parts, blocks, strict=True)])

    def describe(self) -> dict[str, Any]:
        """Return the parts, as saved in a constraint file."""
        return {"kind": self.kind, "parts": [part.describe() for part in self.parts]}

    def __repr__(self) -> str:
        return f"Stacked([{', '.join(map(repr, self.parts))}])"


def described_features(described: Mapping[str, Any], robot: Robot) -> FeatureMap:
    """Return the feature map that `describe` wrote down, for the robot that it belongs to.

    Args:
        described: What `describe` returned.
        robot: The robot.

    Raises:
        FeatureError: A kind that this version does not know, or settings that this robot does not have.
    """
    kind = described["kind"]
    if kind == Stacked.kind:
        return Stacked([described_features(part, robot) for part in described["parts"]])
    made = (FrameJacobian, RelativeFrameJacobian, CentreOfMass, MechanismRows, CurveRows, PlaceRows)
    make: Any = next((features for features in made if features.kind == kind), None)
    if make is None:
        raise FeatureError(f"unknown kind of features {kind!r}: this file comes from a newer version")
    optional = {name for name in ("relative_to", "radius") if described.get(name) is None}
    return make(robot, **{name: described[name] for name in make.saved if name not in optional})
