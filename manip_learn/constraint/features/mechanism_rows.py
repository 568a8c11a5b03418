"""Rows about an axis or a centre: the Phi(q) of doors, handles, tethers and screws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.place_fields import AT_A_DISTANCE, FIELDS, Place, mechanism_weights
from manip_learn.constraint.features.weighed_velocity import WeighedVelocity
from manip_learn.errors import FeatureError
from manip_learn.robot.robot import Robot


@final
class MechanismRows(WeighedVelocity):
    """Velocity of a frame seen from an axis through a point: rows whose direction depends on the place.

    Phi(q) = W(p(q)) J(q), with J the frame's Jacobian along the axes of the robot's base and p its origin. With the
    axis a, the point c, and rho the distance of p from the axis:

    - `radial` (x / rho).v, away from the axis; `axial` a.v; `tangential` around the axis [m/s];
    - `helical`: across the helix of the given pitch, along its cylinder [m/s];
    - `spherical`: away from the point [m/s];
    - `turn` a.w and `turn-1`, `turn-2`: angular velocity along the axis and along two directions across it [rad/s];
    - `slide` a.v_c and `slide-1`, `slide-2`: velocity of the point of the hand that is at c [m/s];
    - `screw` a.v_c - pitch a.w: zero for a hand that is fixed to a screw [m/s].

    A hand fixed to a hinge makes `turn-1 turn-2 slide-1 slide-2 slide` zero; one that may turn about a door's handle
    makes `radial axial` zero.

    With the `radius` of the mechanism all rows are affine in p, and so a constant Lambda in the rows of `PlaceRows`:
    `radial` is then (x / radius).v, and `tangential`, `helical` and `spherical` likewise. On the mechanism they are
    the same numbers; at another distance `radial`, `tangential` and `spherical` grow with it, and `helical` is that of
    the helix at the radius. Without a radius rho is the hand's own distance and the rows have unit length everywhere;
    within 1e-5 m of the axis (or the centre) they fade to zero. On the axis the manipulability is zero in either case,
    and its gradient finite.

    Args:
        robot: The robot.
        frame: Name of the frame, e.g. the tool's tip.
        rows: Names of the rows, each at most once; a string with spaces or a sequence.
        axis: Direction of the axis in the base frame; made unit length.
        point: A point on the axis, or the centre, in the base frame [m].
        pitch: Travel along the axis a radian of turning [m/rad], right-handed screws positive.
        radius: Distance of the hand from the axis or the centre on the mechanism [m]; None for any distance.

    Raises:
        UnknownNameError: No such frame; lists near matches.
        FeatureError: Unknown rows, or an axis, a point, a pitch or a radius that is no such thing.
    """

    def __init__(
        self,
        robot: Robot,
        frame: str,
        rows: str | Sequence[str],
        *,
        axis: ArrayLike = (0.0, 0.0, 1.0),
        point: ArrayLike = (0.0, 0.0, 0.0),
        pitch: float = 0.0,
        radius: float | None = None,
    ):
        super().__init__(robot, frame)
        self.row_names = _parsed(rows)
        self.row_units = tuple(FIELDS[n] for n in self.row_names)
        direction, place = _vector(axis, "axis"), _vector(point, "point")
        if not np.linalg.norm(direction) > 0.0:
            raise FeatureError("the axis has no direction: its three numbers are zero")
        if not np.isfinite(pitch):
            raise FeatureError(f"the pitch must be a finite number [m/rad], not {pitch!r}")
        if radius is not None and not 0.0 < radius < np.inf:
            raise FeatureError(f"the radius must be a positive number [m], or None for any distance, not {radius!r}")
        self.geometry = Place(direction / np.linalg.norm(direction), place, float(pitch))
        self.radius = None if radius is None else float(radius)
        self.place_weights = mechanism_weights(self.row_names, self.geometry, self.radius)

    def with_rows(self, rows: Sequence[str], radius: float | None = None) -> MechanismRows:
        """Other rows of the same mechanism, at the radius or, if that is None, at any distance."""
        g = self.geometry
        return MechanismRows(
            self.robot, self.frame.name, rows, axis=g.axis, point=g.point, pitch=g.pitch, radius=radius
        )

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Distance from the axis (`radial`) or the centre (`spherical`), place along the axis (`axial`) [m].

        Raises:
            FeatureError: Other rows are the rate of nothing.
        """
        d = self.robot.position(q, self.frame) - self.geometry.point
        z = float(d @ self.geometry.axis)
        known = {
            "radial": np.linalg.norm(d - z * self.geometry.axis),
            "axial": z,
            "spherical": np.linalg.norm(d),
        }
        if not set(self.row_names) <= set(known):
            return super().coordinates(q)
        return np.array([known[n] for n in self.row_names])

    def coordinates_jacobian(self, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Rates of the distances: rows of unit length, where those of Phi are of the radius (see `FeatureMap`)."""
        if self.radius is None or not set(self.row_names) & set(AT_A_DISTANCE):
            return None
        return self.with_rows(self.row_names)(q)

    def error_jacobian(self, target: ArrayLike, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """E with d/dt `error_to(target, q)` = -E u for a fixed target (see `FeatureMap`)."""
        return self.coordinates_jacobian(q)

    def describe(self) -> dict[str, Any]:
        """Frame, rows, axis, point, pitch and radius, as saved in a constraint file."""
        return {
            "kind": "mechanism-rows",
            "frame": self.frame.name,
            "rows": list(self.row_names),
            "units": list(self.row_units),
            "axis": self.geometry.axis.tolist(),
            "point": self.geometry.point.tolist(),
            "pitch": self.geometry.pitch,
            **({} if self.radius is None else {"radius": self.radius}),
        }

    @staticmethod
    def from_description(robot: Robot, described: Mapping[str, Any]) -> MechanismRows:
        """The feature map that `describe` wrote down."""
        return MechanismRows(
            robot,
            described["frame"],
            described["rows"],
            axis=described["axis"],
            point=described["point"],
            pitch=described["pitch"],
            radius=described.get("radius"),
        )

    def __repr__(self) -> str:
        a, c = (", ".join(f"{x:.4g}" for x in v) for v in (self.geometry.axis, self.geometry.point))
        pitch = f", pitch={self.geometry.pitch:.4g}" if self.geometry.pitch else ""
        radius = "" if self.radius is None else f", radius={self.radius:.4g}"
        place = f"axis=({a}), point=({c}){pitch}{radius}"
        return f"MechanismRows({self.robot.name!r}, frame={self.frame.name!r}, {' '.join(self.row_names)!r}, {place})"


def _parsed(rows: str | Sequence[str]) -> tuple[str, ...]:
    names = tuple(rows.replace(",", " ").split()) if isinstance(rows, str) else tuple(rows)
    unknown = [n for n in names if n not in FIELDS]
    if unknown or not names or len(set(names)) != len(names):
        reason = f"unknown row {unknown[0]!r}" if unknown else "no row" if not names else "a row is named twice"
        raise FeatureError(f"rows {rows!r}: {reason}; use any of {' '.join(FIELDS)}, each at most once")
    return names


def _vector(values: ArrayLike, what: str) -> np.ndarray:
    try:
        vector = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FeatureError(f"the {what} must be three numbers: {error}") from error
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise FeatureError(f"the {what} must be three finite numbers, got {vector.tolist()}")
    vector.setflags(write=False)
    return vector
