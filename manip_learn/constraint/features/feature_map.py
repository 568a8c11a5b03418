"""Feature maps Phi(q): the candidate rows out of which Lambda selects."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from operator import attrgetter
from reprlib import Repr
from typing import Any, Self

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.mechanism import Mechanism, Read
from manip_learn.constraint.place import AXES
from manip_learn.errors import ConstraintError, FeatureError, TargetError

NAMED_AXES = {"xyz": AXES[:3], "pose": AXES, "planar": ("x", "y", "rz"), "rotation": AXES[3:]}
Selection = Float[np.ndarray, "_ p"]  # Lambda, or other combinations of the rows
ErrorAndRate = tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p nv"] | None]


class FeatureMap(ABC):
    """Phi(q), shape (p, nv), and its exact derivative; A(q) = Lambda Phi(q) selects from its rows.

    A child defines `derivative`, or `value_and_derivative` where both share work.

    Attributes of every child:
        nv: Number of velocities that the rows act on.
        row_names: One name a row, e.g. `("x", "y", "rz")`.
        row_units: Unit of each row times a velocity, e.g. `("m/s", "m/s", "rad/s")`.
        twist: All six rows of the frame, in axes that rest with what holds it (`PoseRows`); None without a frame.
        own_axes: Of velocities along x y z and about them, whether these axes are the frame's own; None of others.
        relative_to: The frame from which they are seen; None for the robot's base.
        geometry: Where a mechanism is whose rows they are; None of others.
        curve: Across and along which they are; None of others.
        robot: The robot; None for a system without one.
        kind: Name of the class in a constraint file; empty for what cannot be saved.
        saved: Arguments of the constructor that a file keeps, beside the robot -> the attributes that they are.
    """

    twist: Any = None
    own_axes: bool | None = None
    relative_to: Any = None
    geometry: Any = None
    curve: Any = None
    robot: Any = None
    kind: str = ""
    saved: Mapping[str, str] = {}
    nv: int
    row_names: tuple[str, ...]
    row_units: tuple[str, ...]

    @cached_property  # read at every control step
    def n_rows(self) -> int:
        """Number of rows p."""
        return len(self.row_names)

    @abstractmethod
    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Phi(q)."""

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """Return dPhi/dq, exact; entry [i, j, k] = d Phi_ij / d q_k along tangent coordinate k.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.value_and_derivative(q)[1]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Phi(q) and dPhi/dq together, cheaper than one by one where a child shares work."""
        return self(q), self.derivative(q)

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Phi at n configurations, the rows of q."""
        return np.reshape([self(row) for row in np.asarray(q, dtype=np.float64)], (-1, self.n_rows, self.nv))

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Phi and dPhi/dq at n configurations, the rows of q."""
        values = [self.value_and_derivative(row) for row in np.asarray(q, dtype=np.float64)]
        Phi = np.reshape([one for one, _ in values], (-1, self.n_rows, self.nv))
        return Phi, np.reshape([one for _, one in values], (*Phi.shape, self.nv))

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Task coordinates r(q) whose rate is Phi(q) u, or `coordinates_jacobian(q)` u where that is given.

        Raises:
            FeatureError: The rows are not the rate of anything that this feature map knows.
        """
        raise FeatureError(f"{self!r} has no task coordinates: give the controller a task that returns b itself")

    def error_and_jacobian(self, target: ArrayLike, q: ArrayLike) -> ErrorAndRate:
        """Return the displacement e from r(q) to the target in the rows' axes, and E: de/dt = -E u for a fixed target.

        E is None where that is Phi(q) itself.

        Raises:
            TargetError: Wrong size or not finite.
            FeatureError: The rows have no coordinates.
        """
        return self._goal(target) - self.coordinates(q), self.coordinates_jacobian(q)

    def error_to(self, target: ArrayLike, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return the displacement of `error_and_jacobian`; errors as there."""
        return self.error_and_jacobian(target, q)[0]

    def error_jacobian(self, target: ArrayLike, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Return E of `error_and_jacobian`; errors as there."""
        return self.error_and_jacobian(target, q)[1]

    def _goal(self, target: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return a target as numbers in the order of the rows.

        Raises:
            TargetError: Wrong size or not finite.
        """
        goal = np.asarray(target, dtype=np.float64)
        if goal.shape != (self.n_rows,) or not np.all(np.isfinite(goal)):
            wanted = f"{self.n_rows} finite numbers ({', '.join(self.row_names)})"
            raise TargetError(f"the target must be {wanted}, got {goal.tolist()}")
        return goal

    def coordinates_jacobian(self, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """dr/dq, so that dr/dt = dr/dq u; None where that is Phi(q) itself, as for all rows but rotations."""
        return None

    # ---- what holds the hand: of rows of one frame

    def mechanism(self, selection: Selection, learnt: Mapping[str, Any]) -> Mechanism | None:
        """Return the mechanism whose motions Lambda leaves free, read from these rows; None if it is none of a machine.

        Args:
            selection: Lambda, with orthonormal rows.
            learnt: What is known of how Lambda was learnt, empty if it was not: its error and the postures.
        """
        return None

    def kind_of(self, selection: Selection, immovable: Selection, places: Float[np.ndarray, "n 3"]) -> Read | None:
        """Return the kind of the mechanism that leaves these rows zero, and where it is; None if it is none.

        Args:
            selection: Lambda, with orthonormal rows.
            immovable: Rows that this arm cannot move, orthonormal.
            places: Places of the hand [m].
        """
        return None

    def named(self, selection: Selection, mechanism: Mechanism | None) -> Selected:
        """Return Phi and Lambda of rows with the names of the mechanism's, where these have none (`PlaceRows`)."""
        return self, selection

    def moved(self, transform: Float[np.ndarray, "4 4"], selection: Selection) -> Selected:
        """Return Phi and Lambda where what holds the hand stands elsewhere, p' = R p + t in the base's frame."""
        return self, selection

    def with_rotation(self, selection: Selection) -> Selected:
        """Return Phi and Lambda of these rows, and below them of those that hold the orientation of the frame too.

        Raises:
            ConstraintError: Features without a frame that could turn.
        """
        if (wide := self._with_turns()) is None:
            raise ConstraintError(f"{self!r} belong to no frame whose orientation could be held")
        held = selection @ [[name == row for row in wide.row_names] for name in self.row_names]
        turns = np.eye(wide.n_rows)[[unit == "rad/s" for unit in wide.row_units]]
        _, sigma, Vt = np.linalg.svd(turns - turns @ held.T @ held)
        return wide, np.vstack([held, Vt[: int(np.count_nonzero(sigma > 0.5))]])

    def _with_turns(self) -> FeatureMap | None:
        """Return these rows and all of the angular velocity; None without a frame."""
        return None

    # ---- files

    def changed(self, **arguments: Any) -> Self:
        """Return this feature map with other arguments, named as in its constructor."""
        make, given = type(self), self.describe() | arguments
        return make(self.robot, **{name: given[name] for name in self.saved if name in given})  # type: ignore[call-arg]

    def describe(self) -> dict[str, Any]:
        """Return what a saved constraint needs to build this feature map again: kind, arguments and units.

        Raises:
            FeatureError: It cannot be written down (functions in Python).
        """
        if not self.kind:
            raise FeatureError(f"{self!r} is made of Python functions and cannot be saved")
        given = {name: x for name, path in self.saved.items() if (x := attrgetter(path)(self)) is not None}
        plain = {name: np.asarray(x).tolist() if isinstance(x, tuple | np.ndarray) else x for name, x in given.items()}
        return {"kind": self.kind, **plain, "units": list(self.row_units)}

    def __repr__(self) -> str:
        if not self.saved:
            return super().__repr__()
        words = [f"{name}={_SHORT.repr(x)}" for name, x in self.describe().items() if name in self.saved and x]
        return f"{type(self).__name__}({', '.join([repr(self.robot.name), *words])})"


Selected = tuple[FeatureMap, Float[np.ndarray, "_ _"]]  # Phi and Lambda


class _Short(Repr):
    def repr_list(self, x: list[Any], level: int) -> str:
        """Return names in one string, and the first few of many places."""
        return repr(" ".join(x)) if isinstance(x[0], str) else super().repr_list(x, level)

    def repr_float(self, x: float, level: int) -> str:
        """Return a number of four digits."""
        return f"{x:.4g}"


_SHORT = _Short()
_SHORT.maxstring, _SHORT.maxlist = 200, 3


def parse_axes(axes: str | Sequence[str], known: Collection[str] = AXES, what: str = "axis") -> tuple[str, ...]:
    """Return names of rows from a string with spaces or commas, from a sequence, or of a set of axes, in that order.

    Args:
        axes: For example `"x y rz"`; `"xyz"`, `"pose"`, `"planar"` or `"rotation"` for a set of axes.
        known: The names that there are.
        what: What errors call one.

    Raises:
        FeatureError: An unknown or repeated name, or none.
    """
    sets = NAMED_AXES if known is AXES else {}
    words = tuple(axes.replace(",", " ").split() if isinstance(axes, str) else axes)
    names = sets.get(axes.strip(), words) if isinstance(axes, str) else words
    unknown = [f"unknown {what} {name!r}" for name in names if name not in known]
    if unknown or not names or len(set(names)) != len(names):
        reason = unknown[0] if unknown else f"one {what} is named twice" if names else f"no {what}"
        either = "".join(f"{name!r}, " for name in sets) + "or " * bool(sets)
        raise FeatureError(f"{axes!r}: {reason}; use {either}any of {' '.join(known)}, each at most once")
    return names


def sum_in_words(row: Float[np.ndarray, " p"], names: Sequence[str], form: str, least: float) -> str:
    """Return a combination of rows as a sum, e.g. `+0.6 x +0.8 y`: coefficients in a format, larger than the least."""
    return " ".join(f"{c:{form}} {name}" for c, name in zip(row, names, strict=True) if abs(c) > least)
