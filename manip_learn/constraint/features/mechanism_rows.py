"""Rows about an axis or a centre: the Phi(q) of doors, handles, tethers and screws."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, Literal, final, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import parsed_rows
from manip_learn.constraint.features.frame_jacobian import AXES
from manip_learn.constraint.features.weighed_velocity import WeighedVelocity
from manip_learn.constraint.place import AT_A_DISTANCE, ROW_UNITS, Place, PlaceWeights, mechanism_weights
from manip_learn.errors import FeatureError
from manip_learn.linalg import finite
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import skew

PlaceForm = Literal["point", "point and rotation", "twist", "surface"]


@final
class MechanismRows(WeighedVelocity):
    """Velocity of a frame seen from an axis through a point: rows whose direction depends on the place.

    Phi(q) = W(p(q)) J(q), with J the frame's Jacobian along the axes of the robot's base and p its origin. With the
    axis a, the point c, and rho the distance of p from the axis:

    - `radial` (x / rho).v, away from the axis; `axial` a.v; `tangential` around the axis [m/s];
    - `across-1`, `across-2`: along two fixed directions across the axis [m/s];
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
        relative_to: Frame from which the hand is seen, and in which axis and point are given; None for the base.

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
        relative_to: str | None = None,
    ):
        super().__init__(robot, frame, relative_to)
        self.row_names = parsed_rows(rows, ROW_UNITS, "row")
        self.row_units = tuple(ROW_UNITS[n] for n in self.row_names)
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
        place: dict[str, Any] = {"axis": g.axis, "point": g.point, "pitch": g.pitch, **self.twist.seen_from}
        return MechanismRows(self.robot, self.frame.name, rows, **place, radius=radius)

    def about(self, place: Place) -> MechanismRows:
        """The same rows of a mechanism that is elsewhere."""
        out = copy(self)
        out.geometry, out.place_weights = place, mechanism_weights(self.row_names, place, self.radius)
        return out

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> MechanismRows:
        """The same rows of a mechanism that stands elsewhere, p' = R p + t."""
        return self.about(self.geometry.at(transform))

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Distance from the axis (`radial`) or the centre (`spherical`), place along the axis (`axial`) [m].

        Raises:
            FeatureError: Other rows are the rate of nothing.
        """
        d = self.twist.placement(q)[0] - self.geometry.point
        z = float(d @ self.geometry.axis)
        known = {"radial": np.linalg.norm(d - z * self.geometry.axis), "axial": z, "spherical": np.linalg.norm(d)}
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
            **self.twist.seen_from,
            "rows": list(self.row_names),
            "units": list(self.row_units),
            "axis": self.geometry.axis.tolist(),
            "point": self.geometry.point.tolist(),
            "pitch": self.geometry.pitch,
            **({} if self.radius is None else {"radius": self.radius}),
        }

    def __repr__(self) -> str:
        a, c = (", ".join(f"{x:.4g}" for x in v) for v in (self.geometry.axis, self.geometry.point))
        pitch = f", pitch={self.geometry.pitch:.4g}" if self.geometry.pitch else ""
        radius = "" if self.radius is None else f", radius={self.radius:.4g}"
        place = f"axis=({a}), point=({c}){pitch}{radius}{self._seen}"
        return f"MechanismRows({self.robot.name!r}, frame={self.frame.name!r}, {' '.join(self.row_names)!r}, {place})"


def _vector(values: ArrayLike, what: str) -> np.ndarray:
    vector = finite(values, 3)
    if vector is None:
        raise FeatureError(f"the {what} must be three finite numbers, got {values!r}")
    vector.setflags(write=False)
    return vector


@final
class PlaceRows(WeighedVelocity):
    """Velocity of a frame in rows in which a mechanism is a constant Lambda, whatever the posture.

    With (v, w) the velocity of the frame, p its origin and m a fixed point in the middle of the motion:

    - `"point"`: v and the rate (p - m).v of half the squared distance from m. A hand that may turn keeps its distance
      from a point c by the row [-(c - m)^T, 1]; a plane is [n^T, 0], a hinge is a row of either kind.
    - `"point and rotation"`: the same, and w.
    - `"twist"`: the velocity v + (p - m) x w of the point of the hand that is at m, and w. What a lower pair (a
      subgroup of SE(3)) leaves free to a hand that is fixed to it is a constant space of such twists.

    - `"surface"`: v and the nine products (p - m)_i v_j. The normal of a surface of second order is linear in p: a
      cylinder's side, and the two rows of a helix.

    m only conditions the numbers: another one is another basis of the same rows.

    Args:
        robot: The robot.
        frame: Name of the frame, e.g. the tool's tip.
        form: Which rows.
        middle: m in the base frame [m].
        relative_to: Frame from which the hand is seen, and in which the middle is given; None for the base.

    Raises:
        UnknownNameError: No such frame; lists near matches.
        FeatureError: Another form, or a middle that is no place.
    """

    def __init__(
        self,
        robot: Robot,
        frame: str,
        form: PlaceForm,
        middle: ArrayLike = (0.0, 0.0, 0.0),
        relative_to: str | None = None,
    ):
        if form not in get_args(PlaceForm):
            raise FeatureError(f"form must be one of {', '.join(map(repr, get_args(PlaceForm)))}, not {form!r}")
        m = _vector(middle, "middle")
        super().__init__(robot, frame, relative_to)
        self.form, self.middle = form, m
        unit, none = np.eye(3), np.zeros((3, 3))
        if form == "twist":
            self.row_names, self.row_units = AXES, ("m/s",) * 3 + ("rad/s",) * 3
            constant = np.block([[unit, -skew(m)], [none, unit]])
            by_place = np.stack([np.block([[none, skew(e)], [none, none]]) for e in unit], axis=-1)
        elif form == "surface":
            products = tuple(f"{a}{b}" for a in AXES[:3] for b in AXES[:3])
            self.row_names, self.row_units = (*AXES[:3], *products), ("m/s",) * 3 + ("m^2/s",) * 9
            constant = np.concatenate([np.eye(3, 6), *(-m[i] * np.eye(3, 6) for i in range(3))])
            by_place = np.concatenate([np.zeros((3, 6, 3)), *(np.eye(3, 6)[:, :, None] * e for e in unit)])
        else:
            turns = AXES[3:] if form == "point and rotation" else ()
            self.row_names = (*AXES[:3], "distance", *turns)
            self.row_units = ("m/s",) * 3 + ("m^2/s",) + ("rad/s",) * len(turns)
            rows = 4 + len(turns)
            constant = np.block([[unit, none], [-m[None], np.zeros((1, 3))], [none, unit]])[:rows]
            by_place = np.zeros((rows, 6, 3))
            by_place[3, :3] = unit
        self.place_weights = PlaceWeights(constant, by_place)

    def describe(self) -> dict[str, Any]:
        """Frame, form and middle, as saved in a constraint file."""
        return {
            "kind": "place-rows",
            "frame": self.frame.name,
            **self.twist.seen_from,
            "rows": list(self.row_names),
            "units": list(self.row_units),
            "form": self.form,
            "middle": self.middle.tolist(),
        }

    def __repr__(self) -> str:
        m = ", ".join(f"{x:.4g}" for x in self.middle)
        return f"PlaceRows({self.robot.name!r}, frame={self.frame.name!r}, {self.form!r}, middle=({m}){self._seen})"
