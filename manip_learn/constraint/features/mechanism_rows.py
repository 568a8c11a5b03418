"""Features relative to an axis or a centre (doors, handles, tethers, screws), and relative to a curve (rails)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap, Selected, Selection, parse_axes
from manip_learn.constraint.features.frame_jacobian import FrameJacobian, PoseRows, RelativeFrameJacobian
from manip_learn.constraint.mechanism import (
    CLEAR_SHARE,
    CURVE,
    KIND_BY_NAME,
    Match,
    Mechanism,
    MechanismKind,
    hinge_or_screw,
    kind_of_rows,
    mechanism_of,
    read_point_rows,
    read_surface_rows,
    read_twists,
)
from manip_learn.constraint.place import (
    AXES,
    AXIS_UNITS,
    CURVE_ROWS,
    DISTANCE_ROWS,
    ROTATION_ROWS,
    ROW_UNITS,
    Curve,
    CurveWeights,
    Place,
    PlaceWeights,
    mechanism_weights,
)
from manip_learn.errors import FeatureError
from manip_learn.linalg import finite, null_basis
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import skew

PlaceForm = Literal["point", "point and rotation", "twist", "surface"]
# form -> names of its rows; "xy" is the product of the distance along x and the velocity along y
FORMS: dict[str, tuple[str, ...]] = {
    "point": (*AXES[:3], "distance"),
    "point and rotation": (*AXES[:3], "distance", *AXES[3:]),
    "twist": AXES,
    "surface": (*AXES[:3], *(f"{a}{b}" for a in AXES[:3] for b in AXES[:3])),
}


class WeighedVelocity(FeatureMap):
    """Base class of features Phi(q) = W(p(q)) J(q), combinations of a frame's twist that depend on its position.

    J (6, nv) is the Jacobian of the frame along the axes of the robot's base, p (3,) the position of its origin, and W
    (p, 6) a matrix of weights. Relative to another frame, J and p are those of `RelativeFrameJacobian`.

    Attributes:
        robot: The robot.
        frame: The frame.
        relative_to: The reference frame; None for the robot's base.
        place_weights: The function W of the position.
    """

    place_weights: PlaceWeights | CurveWeights

    def __init__(self, robot: Robot, frame: str, relative_to: str | None = None):
        self.robot, self.frame, self.nv = robot, robot.frame(frame), robot.nv
        options: dict[str, Any] = {} if relative_to is None else {"relative_to": relative_to}
        self.twist: PoseRows = (RelativeFrameJacobian if options else FrameJacobian)(robot, frame, axes=AXES, **options)
        self.relative_to, self._relative_to = self.twist.relative_to, relative_to

    def weights_at(self, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n p 6"]:
        """Return W at each pose: the matrix that turns the frame's twist (6,) into the p feature rows.

        Args:
            poses: Poses (n, 4, 4) of the frame, in the base frame or in `relative_to` [m].

        Returns:
            shape (n, p, 6), for twists along the axes of the base or of `relative_to`.
        """
        return self.place_weights.values(poses[:, :3, 3])

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Return Phi(q) = W(p) J(q).

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv), in the units of `row_units` per unit of joint velocity.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.place_weights.values(self.twist.placement(q)[0][None])[0] @ self.twist(q)

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Return Phi(q) and its derivative, W dJ/dq + (dW/dp Jv) J, with the linear rows Jv of J.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            Phi (p, nv), in the units of `row_units` per unit of joint velocity, and dPhi/dq (p, nv, nv) with the
            entry [i, j, k] = d Phi_ij / d q_k.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        W, dW = (x[0] for x in self.place_weights.at(self.twist.placement(q)[0][None]))
        return _product(W, dW, *self.twist.value_and_derivative(q))

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Return Phi at n configurations, in bulk.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            shape (n, p, nv).

        Raises:
            ConfigurationError: q has the wrong size or is not finite; names the first bad row and joint.
        """
        return self.weights_at(self.twist.poses(q)) @ self.twist.batch(q)

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Return Phi and dPhi/dq at n configurations, in bulk.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            Phi (n, p, nv) and dPhi/dq (n, p, nv, nv).

        Raises:
            ConfigurationError: q has the wrong size or is not finite; names the first bad row and joint.
        """
        W, dW = self.place_weights.at(self.twist.poses(q)[:, :3, 3])
        return _product(W, dW, *self.twist.batch_with_derivative(q))


def _product(W: np.ndarray, dW: np.ndarray, J: np.ndarray, H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return W J and W dJ/dq + (dW/dp J_v) J, for one configuration or many."""
    *many, nv, _ = H.shape
    dJ = (W @ H.reshape(*many, nv * nv)).reshape(*W.shape[:-1], nv, nv)
    return W @ J, dJ + J.swapaxes(-1, -2)[..., None, :, :] @ (dW @ J[..., None, :3, :])


@final
class MechanismRows(WeighedVelocity):
    r"""Velocity of a frame relative to an axis through a point, in rows whose directions depend on the position.

    .. math::

        \Phi(q) = W(p(q)) \, J(q)

    J is the frame's Jacobian along the axes of the robot's base, p the position of its origin, v and w its linear and
    angular velocity. With the axis :math:`a`, the point c on it, :math:`v_c = v + w \times (c - p)` (the velocity of
    the hand's point that is at c), the vector x from the axis to p and its length :math:`\rho`, the rows are

    - `radial`: velocity away from the axis, :math:`(x / \rho)^T v` [m/s];
    - `axial`: velocity along the axis, :math:`a^T v`; `across-1` and `across-2`: along two fixed directions across it
      [m/s];
    - `tangential`: velocity around the axis, :math:`(a \times x / \rho)^T v` [m/s];
    - `helical`: velocity on the cylinder around the axis, across the helix of the given pitch [m/s];
    - `spherical`: velocity away from the point c [m/s];
    - `turn`: angular velocity along the axis, :math:`a^T w`; `turn-1` and `turn-2`: along the two directions across it
      [rad/s];
    - `slide`: velocity along the axis, :math:`a^T v_c`; `slide-1` and `slide-2`: :math:`v_c` along the two directions
      across it [m/s];
    - `screw`: :math:`a^T v_c - \mathrm{pitch} \; a^T w`, zero for a hand that is fixed to a screw [m/s].

    For example, a hand that is fixed to a door has zero `turn-1 turn-2 slide-1 slide-2 slide`; a hand that may turn
    about the door's handle has zero `radial axial`.

    `radius` replaces :math:`\rho` in these formulas (for `spherical`, the distance from c). All rows are then affine in
    p, so that they are combinations of `PlaceRows` with a constant Lambda. On the mechanism the values are the same; at
    another distance, `radial`, `tangential` and `spherical` are scaled with the distance, and `helical` is across the
    helix at the radius. Without `radius` the rows have unit length, except within 1e-5 m of the axis (or the centre),
    where they fade to zero. On the axis the manipulability is zero in both cases, and its gradient is finite.

    Args:
        robot: The robot.
        frame: Name of the frame, e.g. the tool's tip.
        rows: Names of the rows, each at most once; a string with spaces or a sequence.
        axis: Direction of the axis in the base frame; normalised to unit length.
        point: A point on the axis, or the centre, in the base frame [m].
        pitch: Travel along the axis per radian of rotation [m/rad], right-handed screws positive.
        radius: Distance of the hand from the axis or the centre on the mechanism [m]; None for any distance.
        relative_to: Name of the frame in which axis, point and the motion of the frame are expressed; None for the
            robot's base.

    Raises:
        UnknownNameError: The frame does not exist; lists near matches.
        FeatureError: A row name is unknown, or the axis, point, pitch or radius is invalid.
    """

    kind = "mechanism-rows"
    saved = {
        **{"frame": "frame.name", "rows": "row_names", "axis": "geometry.axis", "point": "geometry.point"},
        **{"pitch": "geometry.pitch", "radius": "radius", "relative_to": "_relative_to"},
    }

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
        self.row_names = parse_axes(rows, ROW_UNITS, "row")
        self.row_units = tuple(ROW_UNITS[n] for n in self.row_names)
        if (direction := finite(axis, 3)) is None or (place := finite(point, 3)) is None:
            what, value = ("axis", axis) if direction is None else ("point", point)
            raise FeatureError(f"the {what} must be three finite numbers, got {value!r}")
        if not np.linalg.norm(direction) > 0.0:
            raise FeatureError("the axis must not be zero")
        if not np.isfinite(pitch):
            raise FeatureError(f"the pitch must be a finite number [m/rad], not {pitch!r}")
        if radius is not None and not 0.0 < radius < np.inf:
            raise FeatureError(f"the radius must be a positive number [m], or None for any distance, not {radius!r}")
        place.setflags(write=False)
        self.geometry = Place(direction / np.linalg.norm(direction), place, float(pitch))
        self.radius = None if radius is None else float(radius)
        self.place_weights = mechanism_weights(self.row_names, self.geometry, self.radius)

    def with_rows(self, rows: Sequence[str], radius: float | None = None) -> MechanismRows:
        """Return features with other rows for the same frame, axis, point and pitch.

        Args:
            rows: Names of the rows, see `MechanismRows`.
            radius: Distance of the hand from the axis or the centre [m]; None for any distance.

        Returns:
            The new features.

        Raises:
            FeatureError: A row name is unknown or occurs twice.
        """
        return self.changed(rows=rows, radius=radius)

    def moved(self, transform: Float[np.ndarray, "4 4"], selection: Selection) -> Selected:
        """Return the features of the mechanism after a rigid motion of it, p' = R p + t.

        Args:
            transform: Homogeneous matrix (4, 4) of R and t, in the base frame [m].
            selection: Lambda (s, p).

        Returns:
            The moved features (these features if they are relative to another frame), and Lambda unchanged.
        """
        if self.relative_to is not None:
            return self, selection
        R, g = transform[:3, :3], self.geometry
        return self.changed(axis=R @ g.axis, point=R @ g.point + transform[:3, 3]), selection

    def _with_turns(self) -> MechanismRows:
        """Return these rows and all angular velocities."""
        return self.with_rows(tuple(dict.fromkeys((*self.row_names, *ROTATION_ROWS))), self.radius)

    def mechanism(self, selection: Selection, learnt: Mapping[str, Any]) -> Mechanism | None:
        """Return the mechanism whose rows Lambda selects.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            learnt: Not used.

        Returns:
            The mechanism; None if Lambda mixes rows of these features, or if no kind of mechanism has exactly the
            selected rows.
        """
        shares = np.einsum("sp,sp->p", selection, selection)
        zero_rows = {name for name, share in zip(self.row_names, shares, strict=True) if share > 0.5}
        kind = kind_of_rows(zero_rows)
        if kind is None or np.any(np.abs(shares - np.round(shares)) > CLEAR_SHARE):
            return None
        return mechanism_of(kind, self.geometry, self.radius, **self.twist.seen_from)

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return the coordinates whose rates are the rows, for features with rows `radial`, `axial` and `spherical`
        only.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p,): distance from the axis (`radial`), position along it from the point (`axial`), or distance from
            the point (`spherical`) [m].

        Raises:
            FeatureError: The features have other rows, which are not rates of coordinates.
            ConfigurationError: q has the wrong size or is not finite.
        """
        d = self.twist.placement(q)[0] - self.geometry.point
        z = float(d @ self.geometry.axis)
        distances = {"radial": np.linalg.norm(d - z * self.geometry.axis), "axial": z, "spherical": np.linalg.norm(d)}
        if not set(self.row_names) <= set(distances):
            return super().coordinates(q)
        return np.array([distances[n] for n in self.row_names])

    def coordinates_jacobian(self, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Return the derivative dr/dq of `coordinates`: the same rows without a radius.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv). None if the derivative is Phi(q), because the features have no radius or no row that depends
            on the distance.

        Raises:
            ConfigurationError: q has the wrong size or is not finite; not checked if the result is None.
        """
        if self.radius is None or not set(self.row_names) & set(DISTANCE_ROWS):
            return None
        return self._at_any_distance(q)

    @cached_property
    def _at_any_distance(self) -> MechanismRows:
        """The same rows without a radius."""
        return self.with_rows(self.row_names)


def rows_of(kind: MechanismKind, place: Place, radius: float | None, twist: PoseRows) -> Selected:
    """Return features Phi and selection Lambda of the constraint that a mechanism imposes on a hand.

    A line, a plane or a held orientation gets `FrameJacobian` rows, another mechanism `MechanismRows`. Rows of a screw
    are built without the radius: with it they would be valid for grasps at this radius only.

    Args:
        kind: Kind of the mechanism.
        place: Its axis, point and pitch, in the base frame or in the reference frame of `twist`.
        radius: Distance of the hand from the axis or the centre [m]; None if it does not apply.
        twist: Features of all six components of the hand's twist.

    Returns:
        Phi with p rows, and Lambda (s, p).
    """
    if kind.kind not in ("line", "plane", "space"):
        row_radius = radius if set(kind.rows) & set(DISTANCE_ROWS) and kind.type != "screw" else None
        geometry = {"axis": place.axis, "point": place.point, "pitch": place.pitch, "radius": row_radius}
        rows = MechanismRows(twist.robot, twist.frame.name, kind.rows, **geometry, **twist.seen_from)
        return rows, np.eye(len(kind.rows))
    # the constrained point of the hand is its origin, at any position
    rows = mechanism_weights(kind.rows, Place(place.axis, np.zeros(3)), None).values(np.zeros((1, 3)))[0]
    used = [part for part in (slice(0, 3), slice(3, 6)) if np.any(rows[:, part])]
    axes = [name for part in used for name in AXES[part]]
    return twist.changed(axes=axes), np.concatenate([rows[:, part] for part in used], axis=1)


@final
class PlaceRows(WeighedVelocity):
    r"""Velocity of a frame in rows for which the constraint of a mechanism has one Lambda at every configuration.

    The learner uses these features to find mechanisms whose axis or centre is not known. With the linear and angular
    velocity (v, w) of the frame, its origin p and a fixed point m in the middle of the motion, the forms are

    - `"point"`: v and :math:`(p - m)^T v`, the rate of half the squared distance from m. The row
      :math:`[-(c - m)^T, 1]` of Lambda keeps a hand that may turn at its distance from a point c; :math:`[n^T, 0]`
      keeps it in a plane with the normal n; a hinge has one row of each kind.
    - `"point and rotation"`: the rows of `"point"`, and w.
    - `"twist"`: the velocity :math:`v + (p - m) \times w` of the hand's point that is at m, and w. If a hand is fixed
      to a lower pair (a subgroup of SE(3)), the twists that the pair leaves free form a constant space.
    - `"surface"`: v and the nine products :math:`(p - m)_i v_j`. These describe surfaces whose normal is linear in p,
      i.e. a cylinder, and the two rows of a helix.

    The choice of m improves the conditioning only: another point gives another basis of the same rows.

    Args:
        robot: The robot.
        frame: Name of the frame, e.g. the tool's tip.
        form: Set of rows, one of the four above.
        middle: Point m (3,) in the base frame or in `relative_to` [m].
        relative_to: Name of the frame in which the middle and the motion of the frame are expressed; None for the
            robot's base.

    Raises:
        UnknownNameError: The frame does not exist; lists near matches.
        FeatureError: The form is not one of the four, or the middle is not three finite numbers.
    """

    kind = "place-rows"
    saved = {"frame": "frame.name", "form": "form", "middle": "middle", "relative_to": "_relative_to"}

    def __init__(
        self, robot: Robot, frame: str, form: PlaceForm, middle: ArrayLike = (0, 0, 0), relative_to: str | None = None
    ):
        if form not in FORMS:
            raise FeatureError(f"form must be one of {', '.join(map(repr, FORMS))}, not {form!r}")
        if (m := finite(middle, 3)) is None:
            raise FeatureError(f"the middle must be three finite numbers, got {middle!r}")
        m.setflags(write=False)
        super().__init__(robot, frame, relative_to)
        self.form, self.middle = form, m
        self.row_names = FORMS[form]
        self.row_units = tuple(AXIS_UNITS.get(name, "m^2/s") for name in self.row_names)
        constant = np.array([[name == axis for axis in AXES] for name in self.row_names], dtype=np.float64)
        by_place = np.zeros((*constant.shape, 3))
        if form == "twist":
            by_place[:3, 3:] = np.stack([skew(e) for e in np.eye(3)], axis=-1)
        elif form == "surface":
            by_place[3:, :3] = np.eye(9).reshape(9, 3, 3).transpose(0, 2, 1)
        else:
            by_place[3, :3] = np.eye(3)
        self.place_weights = PlaceWeights(constant - by_place @ m, by_place)

    def kind_of(self, selection: Selection, immovable: Selection, places: Float[np.ndarray, "n 3"]) -> Match | None:
        """Identify the mechanism that holds Lambda Phi(q) u at zero.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            immovable: Orthonormal combinations (m, p) of the rows along which this arm cannot move at all.
            places: Positions (n, 3) of the hand [m]; only used for the form `"surface"`.

        Returns:
            Kind of mechanism, and its axis and point; None if no known mechanism has these rows.
        """
        if self.form == "twist":
            return read_twists(null_basis(np.concatenate([selection, immovable])).T, self.middle)
        if self.form == "surface":
            return read_surface_rows(selection, self.middle, places)
        return read_point_rows(selection, immovable, self.middle)

    def mechanism(self, selection: Selection, learnt: Mapping[str, Any]) -> Mechanism | None:
        """Return the mechanism that constrains the rows selected by Lambda.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            learnt: Provenance of the constraint, with the uncertainty of Lambda and the recorded configurations (entry
                `"postures"`); empty if it was not learnt. Without the configurations the mechanism has no radius, and a
                screw is not found.

        Returns:
            The mechanism; None if no known mechanism has these rows.
        """
        postures = learnt.get("postures") or []
        positions = np.array([self.twist.placement(q)[0] for q in postures] or [self.middle])
        match = self.kind_of(selection, np.zeros((0, self.n_rows)), positions)
        if match is None or (match[0].name == "screw" and not postures):
            return None
        (kind, place), radius = hinge_or_screw(match, positions[0], learnt), None
        if postures and set(kind.rows) & set(DISTANCE_ROWS):
            out = positions - place.point
            out -= 0.0 if kind.type == "ball" else np.outer(out @ place.axis, place.axis)
            radius = float(np.linalg.norm(out, axis=1).mean())
        return mechanism_of(kind, place, radius, **self.twist.seen_from)

    def named(self, selection: Selection, mechanism: Mechanism | None) -> Selected:
        """Return the same constraint in rows that are named after its mechanism, see `rows_of`.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            mechanism: The mechanism that these rows describe; None if it is not known.

        Returns:
            New Phi and Lambda; these features and `selection` if the mechanism is not known.
        """
        if mechanism is None or mechanism.name not in KIND_BY_NAME:
            return self, selection
        return rows_of(KIND_BY_NAME[mechanism.name], mechanism.located(), mechanism.radius, self.twist)

    def describe(self) -> dict[str, Any]:
        """Return a dictionary of JSON values for a constraint file: frame, form, middle and names of the rows."""
        return super().describe() | {"rows": list(self.row_names)}


@final
class CurveRows(WeighedVelocity):
    r"""Velocity of a frame across and along a curve, in rows whose directions depend on the position.

    With the velocity v of the frame's origin p, the nearest point c(s) of the curve at the length s, the tangent t
    there, and two unit vectors :math:`n_1, n_2` across the curve that do not rotate about it, the rows are

    - `across-1` and `across-2`: :math:`n_i^T v`, the rate of :math:`n_i^T (p - c)` [m/s];
    - `along`: the rate of the length s, :math:`t^T v / (1 - c''^T (p - c))` [m/s];
    - `rx`, `ry`, `rz`: angular velocity along the axes of the base [rad/s].

    On a rail of any shape, `across-1` and `across-2` are zero.

    Args:
        robot: The robot.
        frame: Name of the frame, e.g. the tool's tip.
        points: Points of the curve in order, in the base frame, shape (k, 3) [m].
        rows: Names of the rows, each at most once; a string with spaces or a sequence.
        relative_to: Name of the frame in which the points and the motion of the frame are expressed; None for the
            robot's base.

    Raises:
        UnknownNameError: The frame does not exist; lists near matches.
        FeatureError: A row name is unknown, or the points do not define a curve.
    """

    kind = "curve-rows"
    saved = {"frame": "frame.name", "rows": "row_names", "points": "curve.points", "relative_to": "_relative_to"}

    def __init__(
        self,
        robot: Robot,
        frame: str,
        points: ArrayLike | Curve,
        rows: str | Sequence[str] = CURVE_ROWS[:3],
        relative_to: str | None = None,
    ):
        super().__init__(robot, frame, relative_to)
        self.row_names = parse_axes(rows, CURVE_ROWS, "row")
        self.row_units = tuple(AXIS_UNITS.get(name, "m/s") for name in self.row_names)
        self.curve = points if isinstance(points, Curve) else Curve(points)
        self.place_weights = CurveWeights(self.curve, self.row_names)

    def with_rows(self, rows: Sequence[str]) -> CurveRows:
        """Return features with other rows for the same frame and curve.

        Args:
            rows: Names of the rows, from `CURVE_ROWS`.

        Returns:
            The new features.

        Raises:
            FeatureError: A row name is unknown or occurs twice.
        """
        return self.changed(points=self.curve, rows=rows)

    def _with_turns(self) -> CurveRows:
        """Return these rows and all angular velocities."""
        return self.with_rows((*(name for name in self.row_names if name not in AXES), *AXES[3:]))

    def mechanism(self, selection: Selection, learnt: Mapping[str, Any]) -> Mechanism | None:
        """Return the curve as a mechanism if Lambda constrains the hand to it.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            learnt: Not used.

        Returns:
            The mechanism; None unless Lambda constrains exactly the two directions across the curve.
        """
        others = [not name.startswith("across") for name in self.row_names]
        if len(selection) != 2 or np.any(np.abs(selection[:, others]) > CLEAR_SHARE):
            return None
        return Mechanism("other", name=CURVE, curve=self.curve, relative_to=self._relative_to)

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return the coordinates whose rates are the rows, for features without angular rows.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p,): distances from the curve along the two directions across it (`across-1`, `across-2`), or length
            along it (`along`) [m].

        Raises:
            FeatureError: The features have angular rows, which are not rates of coordinates.
            ConfigurationError: q has the wrong size or is not finite.
        """
        if set(self.row_names) & set(AXES):
            return super().coordinates(q)
        place = self.twist.placement(q)[0]
        s = self.curve.nearest(place[None])
        across = self.curve.frame(s)[0] @ (place - self.curve.at(s)[0])
        return np.append(across, s)[[CURVE_ROWS.index(name) for name in self.row_names]]

    def moved(self, transform: Float[np.ndarray, "4 4"], selection: Selection) -> Selected:
        """Return the features of the curve after a rigid motion of it, p' = R p + t.

        Args:
            transform: Homogeneous matrix (4, 4) of R and t, in the base frame [m].
            selection: Lambda (s, p); it does not depend on the position of the curve.

        Returns:
            The features with the moved curve, or these features if the curve is given in another frame
            (`relative_to`); and `selection` unchanged.
        """
        is_fixed = self.relative_to is not None
        return self if is_fixed else self.changed(points=self.curve.moved(transform)), selection
