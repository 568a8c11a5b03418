"""Rows across and along a curve in space: the Phi(q) of a rail of any shape, with the frame that moves along it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.curve import CURVE_ROWS, Curve
from manip_learn.constraint.features.feature_map import FeatureMap, parsed_rows
from manip_learn.constraint.features.weighed_velocity import WeighedVelocity
from manip_learn.constraint.mechanism import CLEAR_SHARE, CURVE, Mechanism
from manip_learn.constraint.place import AXES, AXIS_UNITS
from manip_learn.robot.robot import Robot


@final
class CurveRows(WeighedVelocity):
    """Velocity of a frame across a curve, and along it: rows that follow the place of the hand.

    With p the origin of the frame, c(s) the place of the curve next to it, t the tangent there and n_1, n_2 two unit
    vectors across that do not turn about the curve:

    - `across-1`, `across-2`: n_i.v, the rate of n_i.(p - c) [m/s];
    - `along`: the rate of the length s, t.v / (1 - c''.(p - c)) [m/s];
    - `rx`, `ry`, `rz`: the angular velocity along the base's axes [rad/s].

    A rail of any shape makes the first two zero.

    Args:
        robot: The robot.
        frame: Name of the frame, e.g. the tool's tip.
        points: Of the curve, in order, in the base frame, shape (k, 3) [m].
        rows: Names of the rows, each at most once.
        relative_to: Frame from which the hand is seen, and in which the points are given; None for the base.

    Raises:
        UnknownNameError: No such frame; lists near matches.
        FeatureError: Unknown rows, or points that make no curve.
    """

    kind = "curve-rows"
    saved = {"frame": "frame.name", "rows": "row_names", "points": "curve.points", "relative_to": "_relative_to"}
    # of weights that are not affine in the place
    padded = FeatureMap.padded
    value_and_vjp = FeatureMap.value_and_vjp

    def __init__(
        self,
        robot: Robot,
        frame: str,
        points: ArrayLike | Curve,
        rows: str | Sequence[str] = CURVE_ROWS[:3],
        relative_to: str | None = None,
    ):
        super().__init__(robot, frame, relative_to)
        self.row_names = parsed_rows(rows, CURVE_ROWS, "row")
        self.row_units = tuple(AXIS_UNITS.get(name, "m/s") for name in self.row_names)
        self.curve = points if isinstance(points, Curve) else Curve(points)
        self._rows = [CURVE_ROWS.index(name) for name in self.row_names]

    def with_rows(self, rows: Sequence[str]) -> CurveRows:
        """Other rows of the same curve."""
        return self.changed(points=self.curve, rows=rows)

    def _with_turns(self) -> CurveRows:
        return self.with_rows((*(name for name in self.row_names if name not in AXES), *AXES[3:]))

    def mechanism(self, selection: Float[np.ndarray, "s p"], learnt: Mapping[str, Any]) -> Mechanism | None:
        """Return the curve, if all that holds the hand is across it (see `FeatureMap`)."""
        others = [not name.startswith("across") for name in self.row_names]
        if len(selection) != 2 or np.any(np.abs(selection[:, others]) > CLEAR_SHARE):
            return None
        return Mechanism("other", name=CURVE, curve=self.curve, relative_to=self._relative_to)

    def weights(self, p: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n r 6"], Float[np.ndarray, "n r 6 3"]]:
        """W(p) and dW/dp at n places [m]."""
        W, dW = self.curve.weights(p)
        return W[:, self._rows], dW[:, self._rows]

    def values(self, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n r 6"]:
        """W(p) at n places [m]."""
        return self.weights(p)[0]

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Distances from the curve along n_1 and n_2, and the length along it [m].

        Raises:
            FeatureError: Rows of the angular velocity, which is the rate of nothing.
        """
        if max(self._rows) >= len(AXES[:3]):
            return super().coordinates(q)
        place = self.twist.placement(q)[0]
        s = self.curve.nearest(place[None])
        across = self.curve.frame(s)[0] @ (place - self.curve.at(s)[0])
        return np.append(across, s)[self._rows]

    def moved(
        self, transform: Float[np.ndarray, "4 4"], selection: Float[np.ndarray, "s p"]
    ) -> tuple[CurveRows, Float[np.ndarray, "s p"]]:
        """Return the same rows of a curve that stands elsewhere, unless that is in another frame (see `FeatureMap`)."""
        is_fixed = self.relative_to is not None
        return self if is_fixed else self.changed(points=self.curve.moved(transform)), selection
