"""Features that are not rows of one frame: centre of mass, user functions, and several stacked maps."""

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
        axes: Rows to include, any of `x y z`: a string with spaces or a sequence.

    Raises:
        FeatureError: The axes are unknown, or the robot has no mass.
    """

    kind, saved, own_axes = "centre-of-mass", {"axes": "row_names"}, False

    def __init__(self, robot: Robot, axes: str | Sequence[str] = "xyz"):
        self.robot, self.nv, self.row_names = robot, robot.nv, parse_axes(axes)
        if any(n not in "xyz" for n in self.row_names):
            raise FeatureError(f"the axes of the centre of mass must be x, y or z, got {axes!r}")
        if robot.mass <= 0.0:
            raise FeatureError(f"robot {robot.name!r} has no mass: its URDF gives no inertias")
        self.row_units = ("m/s",) * len(self.row_names)
        self._rows = ["xyz".index(n) for n in self.row_names]

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Return Phi(q), rows of the centre-of-mass Jacobian.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv) [m/s per unit joint velocity].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.value_and_derivative(q)[0]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Return Phi(q) and dPhi/dq in one pass.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            Phi (p, nv), in the units of `row_units` per unit of joint velocity, and dPhi/dq (p, nv, nv) with the
            entry [i, j, k] = d Phi_ij / d q_k.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        J, H = self.robot.centre_of_mass_jacobian_and_derivative(q)
        return J[self._rows], H[self._rows]

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return the position of the centre of mass along the selected axes.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p,), base frame [m].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.robot.centre_of_mass(q)[self._rows]


@final
class CustomFeatures(FeatureMap):
    """Features Phi(q) from a Python function of yours, e.g. polynomials of the state of a system that is no robot arm.

    They cannot be saved to a file.

    Args:
        function: Function from q to Phi(q), shape (p, nv). It gets a configuration (nq,) of `robot`, or the vector that
            the caller passed if there is no robot.
        row_names: One name per row.
        nv: Number of velocities; None for the number of `robot`.
        derivative: Function from q to dPhi/dq, shape (p, nv, nv). None: central differences are used (error about
            1e-10).
        coordinates: Function from q to the task coordinates r (p,), whose rate must be Phi(q) u. Only needed for
            attractor tasks.
        row_units: One unit per row; default: `"1"` for all.
        robot: The robot whose configuration q is. None: q is a plain vector of size nv.

    Raises:
        FeatureError: Neither `nv` nor `robot` is given, or there is no row name; at an evaluation: a function returns
            the wrong shape or values that are not finite.
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

        Args:
            q: State (nv,), or a configuration of the robot.

        Returns:
            shape (p, nv), in the units of `row_units` per unit of velocity.

        Raises:
            FeatureError: The passed function returned the wrong shape or values that are not finite.
            ConfigurationError: q has the wrong size for the robot or is not finite; not checked without a robot.
        """
        return self._checked(self._function(self._state(q)), (self.n_rows, self.nv), "Phi")

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """Return the derivative dPhi/dq.

        Args:
            q: State (nv,), or a configuration of the robot.

        Returns:
            shape (p, nv, nv), by central differences if no derivative was passed to the constructor.

        Raises:
            FeatureError: The passed function returned the wrong shape or values that are not finite.
            ConfigurationError: q has the wrong size for the robot or is not finite; not checked without a robot.
        """
        state = self._state(q)
        if self._derivative is not None:
            return self._checked(self._derivative(state), (self.n_rows, self.nv, self.nv), "dPhi/dq")
        h = 1e-5  # step of the central differences: balances truncation h^2 against rounding eps / h
        rises = [self(self._moved(state, step)) - self(self._moved(state, -step)) for step in h * np.eye(self.nv)]
        return np.stack(rises, axis=-1) / (2 * h)

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return the task coordinates r(q) from the function `coordinates` of the constructor.

        Args:
            q: State (nv,), or a configuration of the robot.

        Returns:
            shape (p,), one coordinate per row.

        Raises:
            FeatureError: The constructor got no such function, or the function returned the wrong shape or values that
                are not finite.
            ConfigurationError: q has the wrong size for the robot or is not finite; not checked without a robot.
        """
        if self._coordinates is None:
            return super().coordinates(q)
        return self._checked(self._coordinates(self._state(q)), (self.n_rows,), "coordinates")

    def _checked(self, value: ArrayLike, shape: tuple[int, ...], what: str) -> np.ndarray:
        """Return a function's value as an array of a shape.

        Raises:
            FeatureError: Wrong shape or not finite.
        """
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
    """Rows of several feature maps of one robot, one map after another, e.g. of a hand and an elbow.

    Args:
        parts: Feature maps, at least one; all must have the same number of velocities nv.

    Raises:
        FeatureError: No feature map is given, or their numbers of velocities differ.
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
        """Return Phi(q), the parts' rows in order.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv), p summed over the parts, in the units of `row_units` per unit of joint velocity.

        Raises:
            ConfigurationError: q has the wrong size for the robot or is not finite.
        """
        return np.concatenate([part(q) for part in self.parts])

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """Return the derivative dPhi/dq.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv, nv), with the rows of the parts in order.

        Raises:
            ConfigurationError: q has the wrong size for the robot or is not finite.
        """
        return np.concatenate([part.derivative(q) for part in self.parts])

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Return Phi at n configurations, with the rows of the parts in order.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            shape (n, p, nv).

        Raises:
            ConfigurationError: q has the wrong size for the robot or is not finite.
        """
        return np.concatenate([part.batch(q) for part in self.parts], axis=1)

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return the task coordinates r(q) of all parts.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p,), one coordinate per row, in the units of the parts.

        Raises:
            FeatureError: A part has no coordinates.
            ConfigurationError: q has the wrong size for the robot or is not finite.
        """
        return np.concatenate([part.coordinates(q) for part in self.parts])

    def coordinates_jacobian(self, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Return the derivative dr/dq of the task coordinates of all parts.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv); None if the derivative is Phi(q) for all parts.
        """
        return self._stack([part.coordinates_jacobian(q) for part in self.parts], q)

    def error_and_jacobian(self, target: ArrayLike, q: ArrayLike) -> ErrorAndRate:
        """Return the displacement e to a target and the matrix E of its rate, see `FeatureMap.error_and_jacobian`.

        Args:
            target: Task coordinates (p,) in the order of the rows.
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            e (p,) and E (p, nv); None instead of E if it is Phi(q) for all parts.

        Raises:
            TargetError: The target has the wrong size or is not finite.
            FeatureError: A part has no coordinates.
        """
        goals = np.split(self._goal(target), np.cumsum([part.n_rows for part in self.parts])[:-1])
        both = [part.error_and_jacobian(goal, q) for part, goal in zip(self.parts, goals, strict=True)]
        return np.concatenate([e for e, _ in both]), self._stack([E for _, E in both], q)

    def _stack(self, blocks: list[Float[np.ndarray, "k nv"] | None], q: ArrayLike) -> np.ndarray | None:
        """Return the parts' blocks in order, with Phi(q) for None; None if all are None."""
        if all(block is None for block in blocks):
            return None
        return np.concatenate([p(q) if b is None else b for p, b in zip(self.parts, blocks, strict=True)])

    def describe(self) -> dict[str, Any]:
        """Return a dictionary of JSON values that describes the parts, as in a constraint file.

        Raises:
            FeatureError: A part is made of Python functions, which cannot be saved.
        """
        return {"kind": self.kind, "parts": [part.describe() for part in self.parts]}

    def __repr__(self) -> str:
        return f"Stacked([{', '.join(map(repr, self.parts))}])"


def described_features(described: Mapping[str, Any], robot: Robot) -> FeatureMap:
    """Build a feature map from its description in a constraint file.

    Args:
        described: The output of `FeatureMap.describe`.
        robot: The robot.

    Returns:
        The feature map.

    Raises:
        FeatureError: This version does not know the kind of features, or the arguments do not fit this robot.
    """
    kind = described["kind"]
    if kind == Stacked.kind:
        return Stacked([described_features(part, robot) for part in described["parts"]])
    classes = (FrameJacobian, RelativeFrameJacobian, CentreOfMass, MechanismRows, CurveRows, PlaceRows)
    make: Any = next((features for features in classes if features.kind == kind), None)
    if make is None:
        raise FeatureError(f"unknown kind of features {kind!r}: this file comes from a newer version")
    optional = {name for name in ("relative_to", "radius") if described.get(name) is None}
    return make(robot, **{name: described[name] for name in make.saved if name not in optional})
