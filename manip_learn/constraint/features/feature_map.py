"""Feature maps Phi(q): the candidate rows from which Lambda selects."""

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

from manip_learn.constraint.mechanism import Match, Mechanism
from manip_learn.constraint.place import AXES
from manip_learn.errors import ConstraintError, FeatureError, TargetError

NAMED_AXES = {"xyz": AXES[:3], "pose": AXES, "planar": ("x", "y", "rz"), "rotation": AXES[3:]}
Selection = Float[np.ndarray, "_ p"]  # Lambda, or other combinations of the rows
ErrorAndRate = tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p nv"] | None]


class FeatureMap(ABC):
    r"""Base class of features Phi(q), a matrix (p, nv) whose rows a constraint combines.

    .. math::

        A(q) = \Lambda \, \Phi(q)

    To add features, derive a class that defines `__call__` (which returns Phi(q)) and the exact `derivative`, or
    `value_and_derivative` if the two share work.

    Every child class has these attributes:

    Attributes:
        nv: Number of velocities that the rows act on.
        row_names: One name per row, e.g. `("x", "y", "rz")`.
        row_units: Unit of the velocity of each row, i.e. of Phi(q) u, e.g. `("m/s", "m/s", "rad/s")`.
        twist: Features of all six components of the frame's twist, along axes fixed in the base or in `relative_to`
            (`PoseRows`); None for features without a frame.
        own_axes: For velocities along and about x y z: True if these axes turn with the frame. None for other rows.
        relative_to: The reference frame of the rows; None for the robot's base.
        geometry: Axis and point of the mechanism to which the rows refer; None for other rows.
        curve: Curve to which the rows refer; None for other rows.
        robot: The robot; None for a system without one.
        kind: Name of the class in a constraint file; empty if the features cannot be saved.
        saved: Each constructor argument that is saved in a file -> name of the attribute with its value.
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
        """Evaluate the feature matrix Phi(q).

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv), in the units of `row_units` per unit of joint velocity.

        Raises:
            ConfigurationError: q has the wrong size for the robot or is not finite.
        """

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """Return the exact derivative dPhi/dq.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv, nv): entry [i, j, k] = d Phi_ij / d q_k along tangent coordinate k.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.value_and_derivative(q)[1]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Return Phi(q) and dPhi/dq; for some features this is faster than two calls.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            Phi (p, nv), and dPhi/dq (p, nv, nv) as from `derivative`.

        Raises:
            ConfigurationError: q has the wrong size for the robot or is not finite.
        """
        return self(q), self.derivative(q)

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Return Phi at n configurations.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            shape (n, p, nv).

        Raises:
            ConfigurationError: q has the wrong size for the robot or is not finite.
        """
        return np.reshape([self(row) for row in np.asarray(q, dtype=np.float64)], (-1, self.n_rows, self.nv))

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Return Phi and dPhi/dq at n configurations.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            Phi (n, p, nv) and dPhi/dq (n, p, nv, nv).

        Raises:
            ConfigurationError: q has the wrong size for the robot or is not finite.
        """
        values = [self.value_and_derivative(row) for row in np.asarray(q, dtype=np.float64)]
        Phi = np.reshape([one for one, _ in values], (-1, self.n_rows, self.nv))
        return Phi, np.reshape([one for _, one in values], (*Phi.shape, self.nv))

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return the task coordinates r(q), e.g. the position of a frame.

        Their rate is Phi(q) u, or `coordinates_jacobian(q)` times u if that is not None.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p,), one coordinate per row; its rate is in the unit of the row (`row_units`).

        Raises:
            FeatureError: The rows are not the rates of known coordinates.
            ConfigurationError: q has the wrong size for the robot or is not finite.
        """
        raise FeatureError(f"{self!r} has no task coordinates: use a task that returns b itself")

    def error_and_jacobian(self, target: ArrayLike, q: ArrayLike) -> ErrorAndRate:
        """Return the displacement e from r(q) to a target, along the axes of the rows, and the matrix E of its rate.

        For a fixed target and the joint velocity u, the rate of e is -E u.

        Args:
            target: Task coordinates (p,) in the order of the rows.
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            e (p,) and E (p, nv); None instead of E if it is Phi(q) itself.

        Raises:
            TargetError: The target has the wrong size or is not finite.
            FeatureError: The rows have no coordinates.
        """
        return self._goal(target) - self.coordinates(q), self.coordinates_jacobian(q)

    def error_to(self, target: ArrayLike, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return the displacement from the task coordinates at q to a target, along the axes of the rows.

        Args:
            target: Task coordinates (p,) in the order of the rows.
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            Displacement (p,), in the units of the coordinates.

        Raises:
            TargetError: The target has the wrong size or is not finite.
            FeatureError: The rows have no coordinates.
        """
        return self.error_and_jacobian(target, q)[0]

    def error_jacobian(self, target: ArrayLike, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Return the matrix E with which the displacement to a fixed target changes at the rate -E u.

        Args:
            target: Task coordinates (p,) in the order of the rows.
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            E (p, nv), or None if it is Phi(q) itself.

        Raises:
            TargetError: The target has the wrong size or is not finite.
            FeatureError: The rows have no coordinates.
        """
        return self.error_and_jacobian(target, q)[1]

    def _goal(self, target: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return a target as numbers in the order of the rows.

        Raises:
            TargetError: The target has the wrong size or is not finite.
        """
        goal = np.asarray(target, dtype=np.float64)
        if goal.shape != (self.n_rows,) or not np.all(np.isfinite(goal)):
            expected = f"{self.n_rows} finite numbers ({', '.join(self.row_names)})"
            raise TargetError(f"the target must be {expected}, got {goal.tolist()}")
        return goal

    def coordinates_jacobian(self, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Return the derivative dr/dq of the task coordinates; their rate is this matrix times u.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv), or None if the derivative is Phi(q) itself, e.g. for positions.
        """
        return None

    # ---- mechanisms, for rows of one frame

    def mechanism(self, selection: Selection, learnt: Mapping[str, Any]) -> Mechanism | None:
        """Return the mechanism that constrains the rows selected by Lambda.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            learnt: Provenance of the constraint, with the uncertainty of Lambda and the recorded configurations; empty
                if it was not learnt.

        Returns:
            The mechanism; None if no known mechanism has these rows.
        """
        return None

    def kind_of(self, selection: Selection, immovable: Selection, places: Float[np.ndarray, "n 3"]) -> Match | None:
        """Identify the mechanism that holds Lambda Phi(q) u at zero.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            immovable: Orthonormal combinations (m, p) of the rows along which this arm cannot move at all.
            places: Positions (n, 3) of the hand [m].

        Returns:
            Kind of mechanism, and its axis and point; None if no known mechanism has these rows.
        """
        return None

    def named(self, selection: Selection, mechanism: Mechanism | None) -> Selected:
        """Return the same constraint in rows that are named after its mechanism; only `PlaceRows` change.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            mechanism: The mechanism that these rows describe; None if it is not known.

        Returns:
            Phi and Lambda; these features and `selection` if the features are no `PlaceRows`.
        """
        return self, selection

    def moved(self, transform: Float[np.ndarray, "4 4"], selection: Selection) -> Selected:
        """Return Phi and Lambda after a rigid motion of the mechanism, p' = R p + t in the base frame.

        Args:
            transform: Homogeneous matrix (4, 4) of R and t, in the base frame [m].
            selection: Lambda (s, p).

        Returns:
            Phi and Lambda; these features and `selection` if the motion does not change them.
        """
        return self, selection

    def with_rotation(self, selection: Selection) -> Selected:
        """Return Phi and Lambda of these rows, followed by rows that also constrain the orientation of the frame.

        Args:
            selection: Lambda (s, p) with orthonormal rows.

        Returns:
            Phi with all angular rows, and Lambda with additional rows for the rotations that `selection` leaves free.

        Raises:
            ConstraintError: The features have no frame with an orientation.
        """
        if (wide := self._with_turns()) is None:
            raise ConstraintError(f"{self!r} belong to no frame whose orientation could be constrained")
        embedded = selection @ [[name == row for row in wide.row_names] for name in self.row_names]
        turns = np.eye(wide.n_rows)[[unit == "rad/s" for unit in wide.row_units]]
        _, sigma, Vt = np.linalg.svd(turns - turns @ embedded.T @ embedded)
        return wide, np.vstack([embedded, Vt[: int(np.count_nonzero(sigma > 0.5))]])

    def _with_turns(self) -> FeatureMap | None:
        """Return these rows and all angular velocities; None without a frame."""
        return None

    # ---- files

    def changed(self, **arguments: Any) -> Self:
        """Return this feature map with other constructor arguments.

        Args:
            arguments: Arguments to replace, named as in the constructor; names that are not in `saved` are ignored.

        Returns:
            A new feature map of the same robot.

        Raises:
            FeatureError: An argument is invalid, or the features are Python functions, which cannot be built again.
        """
        make, described = type(self), self.describe() | arguments
        return make(self.robot, **{name: described[name] for name in self.saved if name in described})  # type: ignore[call-arg]

    def describe(self) -> dict[str, Any]:
        """Return a description from which the feature map can be built again, as in a constraint file.

        Returns:
            Dictionary of JSON values: kind, constructor arguments and units of the rows.

        Raises:
            FeatureError: The features are Python functions, which cannot be saved.
        """
        if not self.kind:
            raise FeatureError(f"{self!r} is made of Python functions and cannot be saved")
        values = {name: x for name, path in self.saved.items() if (x := attrgetter(path)(self)) is not None}
        plain = {name: np.asarray(x).tolist() if isinstance(x, tuple | np.ndarray) else x for name, x in values.items()}
        return {"kind": self.kind, **plain, "units": list(self.row_units)}

    def __repr__(self) -> str:
        if not self.saved:
            return super().__repr__()
        words = [f"{name}={_SHORT.repr(x)}" for name, x in self.describe().items() if name in self.saved and x]
        return f"{type(self).__name__}({', '.join([repr(self.robot.name), *words])})"


Selected = tuple[FeatureMap, Float[np.ndarray, "_ _"]]  # Phi and Lambda


class _Short(Repr):
    """Short text of constructor arguments, for `repr`."""

    def repr_list(self, x: list[Any], level: int) -> str:
        """Return a list as text: names in one string, or the first few numbers.

        Args:
            x: Names or numbers.
            level: Nesting depth of `reprlib`.
        """
        return repr(" ".join(x)) if isinstance(x[0], str) else super().repr_list(x, level)

    def repr_float(self, x: float, level: int) -> str:
        """Return a number as text with four digits.

        Args:
            x: The number.
            level: Nesting depth of `reprlib`.
        """
        return f"{x:.4g}"


_SHORT = _Short()
_SHORT.maxstring, _SHORT.maxlist = 200, 3


def parse_axes(axes: str | Sequence[str], known: Collection[str] = AXES, what: str = "axis") -> tuple[str, ...]:
    """Return row names from a string with spaces or commas, from a sequence, or from the name of a set of axes.

    Args:
        axes: For example `"x y rz"`; `"xyz"`, `"pose"`, `"planar"` or `"rotation"` for a set of axes.
        known: Valid names.
        what: Noun for such a name in error messages, e.g. `"axis"`.

    Returns:
        The names in the given order.

    Raises:
        FeatureError: An unknown or repeated name, or no name.
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
    """Return a linear combination of rows as text, e.g. `+0.6 x +0.8 y`.

    Args:
        row: Coefficients (p,).
        names: Names of the p rows.
        form: Format of a coefficient, e.g. `"+.1f"`.
        least: Terms whose coefficient has at most this absolute value are left out.

    Returns:
        The text; empty if all coefficients are left out.
    """
    return " ".join(f"{c:{form}} {name}" for c, name in zip(row, names, strict=True) if abs(c) > least)
