"""Rows in which every mechanism is constant: Phi(q) = (T_0 + sum_k p_k T_k) J(q)."""

from __future__ import annotations

from typing import Any, Literal, final, get_args

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.constraint.features.frame_jacobian import AXES
from manip_learn.constraint.features.weighed_velocity import PlaceWeights, WeighedVelocity
from manip_learn.errors import FeatureError
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import skew

PlaceForm = Literal["point", "point and rotation", "twist", "surface"]


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

    Raises:
        UnknownNameError: No such frame; lists near matches.
        FeatureError: Another form, or a middle that is no place.
    """

    def __init__(self, robot: Robot, frame: str, form: PlaceForm, middle: ArrayLike = (0.0, 0.0, 0.0)):
        if form not in get_args(PlaceForm):
            raise FeatureError(f"form must be one of {', '.join(map(repr, get_args(PlaceForm)))}, not {form!r}")
        m = np.array(middle, dtype=np.float64)
        if m.shape != (3,) or not np.all(np.isfinite(m)):
            raise FeatureError(f"the middle must be three finite numbers [m], got {m.tolist()}")
        super().__init__(robot, frame)
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
            "rows": list(self.row_names),
            "units": list(self.row_units),
            "form": self.form,
            "middle": self.middle.tolist(),
        }

    def __repr__(self) -> str:
        m = ", ".join(f"{x:.4g}" for x in self.middle)
        return f"PlaceRows({self.robot.name!r}, frame={self.frame.name!r}, {self.form!r}, middle=({m}))"
