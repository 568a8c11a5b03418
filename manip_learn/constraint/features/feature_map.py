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
    """Phi(q), shape (p, nv), and its exact derivative; A(q) = Lambda Phi(q) combines its rows.

    A child defines `derivative`, or `value_and_derivative` if the two share work.

    Attributes of every child:
        nv: Number of velocities that the rows act on.
        row_names: One name per row, e.g. `("x", "y", "rz")`.
        row_units: Unit of each row times a velocity, e.g. `("m/s", "m/s", "rad/s")`.
        twist: All six rows of the frame, along axes fixed in the base or in `relative_to` (`PoseRows`); None without a
        frame.
        own_axes: For velocities along and about x y z, True if these are the frame's own axes; None for other rows.
        relative_to: The reference frame of the rows; None for the robot's base.
        geometry: Place of the mechanism whose rows these are; None for other rows.
        curve: Curve across and along which the rows are; None for other rows.
        robot: The robot; None for a system without one.
        kind: Name of the class in a constraint file; empty if the features cannot be saved.
        saved: Constructor arguments in a file, except the robot -> names of their attributes.
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
        """Return Phi(q).

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv), in the units of `row_units` per unit of joint velocity.
        """

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """Return dPhi/dq, exact.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv, nv): entry [i, j, k] = d Phi_ij / d q_k along tangent coordinate k.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.value_and_derivative(q)[1]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Return Phi(q) and dPhi/dq together; cheaper than two calls if a child shares work.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            Phi (p, nv), and dPhi/dq (p, nv, nv) as from `derivative`.
        """
        return self(q), self.derivative(q)

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Return Phi at n configurations.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            shape (n, p, nv).
        """
        return np.reshape([self(row) for row in np.asarray(q, dtype=np.float64)], (-1, self.n_rows, self.nv))

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Return Phi and dPhi/dq at n configurations.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            Phi (n, p, nv) and dPhi/dq (n, p, nv, nv).
        """
        values = [self.value_and_derivative(row) for row in np.asarray(q, dtype=np.float64)]
        Phi = np.reshape([one for one, _ in values], (-1, self.n_rows, self.nv))
        return Phi, np.reshape([one for _, one in values], (*Phi.shape, self.nv))

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return task coordinates r(q); their rate is Phi(q) u, or `coordinates_jacobian(q)` u if that is not None.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p,), one coordinate per row.

        Raises:
            FeatureError: The rows are not the rates of known coordinates.
        """
        raise FeatureError(f"{self!r} has no task coordinates: use a task that returns b itself")

    def error_and_jacobian(self, target: ArrayLike, q: ArrayLike) -> ErrorAndRate:
        """Return the displacement e from r(q) to the target along the rows' axes, and E: de/dt = -E u for a fixed
        target.

        Args:
            target: p coordinates in the order of the rows.
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            e (p,), and E (p, nv) or None if it is Phi(q) itself.

        Raises:
            TargetError: Wrong size or not finite.
            FeatureError: The rows have no coordinates.
        """
        return self._goal(target) - self.coordinates(q), self.coordinates_jacobian(q)

    def error_to(self, target: ArrayLike, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return the displacement of `error_and_jacobian`.

        Args:
            target: p coordinates in the order of the rows.
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            e (p,).

        Raises:
            TargetError: Wrong size or not finite.
            FeatureError: The rows have no coordinates.
        """
        return self.error_and_jacobian(target, q)[0]

    def error_jacobian(self, target: ArrayLike, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Return E of `error_and_jacobian`.

        Args:
            target: p coordinates in the order of the rows.
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            E (p, nv), or None if it is Phi(q) itself.

        Raises:
            TargetError: Wrong size or not finite.
            FeatureError: The rows have no coordinates.
        """
        return self.error_and_jacobian(target, q)[1]

    def _goal(self, target: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return a target as numbers in the order of the rows.

        Raises:
            TargetError: Wrong size or not finite.
        """
        goal = np.asarray(target, dtype=np.float64)
        if goal.shape != (self.n_rows,) or not np.all(np.isfinite(goal)):
            expected = f"{self.n_rows} finite numbers ({', '.join(self.row_names)})"
            raise TargetError(f"the target must be {expected}, got {goal.tolist()}")
        return goal

    def coordinates_jacobian(self, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Return C(q) = dr/dq, with dr/dt = C u.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv), or None if it is Phi(q) itself, e.g. for positions.
        """
        return None

    # ---- mechanisms, for rows of one frame

    def mechanism(self, selection: Selection, learnt: Mapping[str, Any]) -> Mechanism | None:
        """Return the mechanism that leaves the same motions free as Lambda, read from these rows.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            learnt: Provenance of Lambda, with its error and the recorded postures; empty if it was not learnt.

        Returns:
            The mechanism; None if the rows are no known mechanism.
        """
        return None

    def kind_of(self, selection: Selection, immovable: Selection, places: Float[np.ndarray, "n 3"]) -> Match | None:
        """Return kind and place of the mechanism that makes these rows zero.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            immovable: Orthonormal rows (m, p) that this arm cannot move.
            places: Positions of the hand (n, 3) [m].

        Returns:
            Kind and place; None if the rows are no known mechanism.
        """
        return None

    def named(self, selection: Selection, mechanism: Mechanism | None) -> Selected:
        """Return Phi and Lambda with rows named after the mechanism, for features without such names (`PlaceRows`).

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            mechanism: The mechanism of these rows; None if there is none.

        Returns:
            Phi and Lambda; unchanged for other features.
        """
        return self, selection

    def moved(self, transform: Float[np.ndarray, "4 4"], selection: Selection) -> Selected:
        """Return Phi and Lambda after a rigid motion of the mechanism, p' = R p + t in the base frame.

        Args:
            transform: Rigid motion (4, 4) in the base frame [m].
            selection: Lambda (s, p).

        Returns:
            Phi and Lambda; unchanged if the rows do not depend on the place.
        """
        return self, selection

    def with_rotation(self, selection: Selection) -> Selected:
        """Return Phi and Lambda of these rows, followed by rows that also constrain the orientation of the frame.

        Args:
            selection: Lambda (s, p) with orthonormal rows.

        Returns:
            Phi with all angular rows, and Lambda with the rotations that these rows do not constrain yet.

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
            arguments: Arguments to replace, named as in the constructor.

        Returns:
            A new feature map of the same robot.
        """
        make, described = type(self), self.describe() | arguments
        return make(self.robot, **{name: described[name] for name in self.saved if name in described})  # type: ignore[call-arg]

    def describe(self) -> dict[str, Any]:
        """Return the entries of a constraint file that rebuild this feature map: kind, arguments and units.

        Returns:
            Values for JSON.

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
        what: Noun for one name in error messages.

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
        least: Coefficients of this size or smaller are left out.

    Returns:
        The text; empty if all coefficients are left out.
    """
    return " ".join(f"{c:{form}} {name}" for c, name in zip(row, names, strict=True) if abs(c) > least)
