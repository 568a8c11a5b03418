"""Tasks: the velocity b(q) of the constrained rows; at rest, towards a target, or tracking a moving target."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.mechanism_rows import WeighedVelocity
from manip_learn.control.command import Vector
from manip_learn.errors import TargetError, advice
from manip_learn.linalg import unit

# b (s,), or a number for a single row, and E of `Task.error_jacobian`, None where it is A(q)
VelocityAndJacobian = tuple[Any, Float[np.ndarray, "s nv"] | None]


class Task(ABC):
    """Base class of tasks: the velocity b(q, t) of the constrained rows in equation (1), A(q) u = b."""

    # True if an arm that is stopped by limits may leave the task's direction, to come as near to the goal as it can
    slides: bool = True
    # True if the task's time stands still while a `ServoLoop` is at rest, and follows the commanded posture
    waits: bool = False
    # default damping at a singular value of 0 [m or 1]: with less an arm that presses into the end of its reach
    # oscillates before it comes to rest (tests/test_closed_loops.py)
    damping: float = 0.05
    # True if b is a mean over the step for which it is held: `velocity_and_jacobian` then gets dt [s], too
    sampled: bool = False
    start: Vector | None = None  # joint positions at which it begins; None if it begins anywhere
    is_approach: bool = False  # True if it only leads to the start of another task
    gripper: str | None = None  # word to the gripper during the task, `"close"` or `"open"`

    @abstractmethod
    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, " s"]:
        """Return b along the constraint's rows, shape (s,), in their units per second.

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """

    @abstractmethod
    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Return the distance to the goal along the constraint's rows (Euclidean norm), in their units.

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """

    def is_over(self, q: ArrayLike, t: float) -> bool:
        """Return True if the task is complete, so that another one may follow; by default always False.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """
        return False

    def reset(self) -> None:  # noqa: B027  most tasks remember nothing
        """Clear the memory of previous calls, before another motion."""

    def rows(self, constraint: Constraint) -> Constraint:
        """Return the constraint whose rows b refers to: by default the given one.

        A task that drives further rows returns a constraint with these rows added; the controller then uses that one.

        Args:
            constraint: The learnt constraint.
        """
        return constraint

    def driven_rows(self, constraint: Constraint) -> Float[np.ndarray, "d s"]:
        """Return orthonormal combinations of the rows that the task drives; by default all rows are driven.

        The combinations orthogonal to them are held: near singularities and at limits they are kept before the driven
        ones. The controller calls this after `velocity_and_jacobian`, for the same instant.

        Args:
            constraint: The constraint of the controller, see `rows`.

        Returns:
            Combinations (d, s) of the rows.
        """
        return unit(constraint.n_constraints)

    def error_jacobian(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, "s nv"] | None:
        """Return the Jacobian E of the task's error: for a goal at rest, the error's rate along the rows is -E u.

        It differs from A(q) for orientations, because the rate of a rotation vector is not the angular velocity; at the
        target both are equal (see `FeatureMap.error_jacobian`). With E instead of A in u = E^+ b + N pi the error
        decays at the rate of the task, and motion in the null space of E does not change the error.

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].

        Returns:
            shape (s, nv); None if E = A(q), as for positions.
        """
        return None

    def goal(self) -> Float[np.ndarray, "..."] | None:
        """Return the target of the task.

        Returns:
            One number per feature row (p,) or per constrained row (s,), or a pose (4, 4) of the frame. None if there is
            no target, or if it depends on a start that is not known yet.
        """
        return None

    def velocity_and_jacobian(self, constraint: Constraint, q: np.ndarray, t: float) -> VelocityAndJacobian:
        """Return `velocity` and `error_jacobian` together; a subclass may override this to compute them faster.

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """
        return self.velocity(constraint, q, t), self.error_jacobian(constraint, q, t)


class SinglePassTask(Task):
    """Base class of tasks that define `velocity_and_jacobian` alone; `velocity` and `error_jacobian` call it."""

    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, " s"]:
        """Return b along the rows, shape (s,), in their units per second.

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """
        return self.velocity_and_jacobian(constraint, q, t)[0]

    def error_jacobian(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, "s nv"] | None:
        """Return the Jacobian E of the task's error (s, nv); None if E = A(q) (see `Task.error_jacobian`).

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """
        return self.velocity_and_jacobian(constraint, q, t)[1]


@final
class Hold(Task):
    """Task b = 0: nothing moves along the constrained rows, all motion is in the null space."""

    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, " s"]:
        """Return zeros, shape (s,).

        Args:
            constraint: The constraint, for the number of its rows.
            q: Not used.
            t: Not used.
        """
        return np.zeros(constraint.n_constraints)

    def driven_rows(self, constraint: Constraint) -> Float[np.ndarray, "d s"]:
        """Return no rows, shape (0, s): all of them are held.

        Args:
            constraint: The constraint, for the number of its rows.
        """
        return unit(constraint.n_constraints)[:0]

    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Return 0: there is no goal to reach.

        Args:
            constraint: Not used.
            q: Not used.
            t: Not used.
        """
        return 0.0

    def __repr__(self) -> str:
        return "Hold()"


@final
@dataclass(frozen=True, eq=False, repr=False)
class PointAttractor(Task):
    r"""Task that moves the tip to a target point or pose, the reaching task of the paper's simulated experiments.

    .. math::

        b = \text{gain} \, \Lambda \, (r^* - r(q))

    with the target :math:`r^*`, and the features' coordinates :math:`r(q)` at the posture q.

    Args:
        target: Target :math:`r^*`, in one of three forms. One number per row of the features, e.g. x, y, z of the tip
            in the base frame [m], rotations as a rotation vector [rad]; the selection matrix Lambda picks the
            constrained part. Or a pose of the frame (4, 4). Or one number per row of Lambda, if the features have
            another number of rows.
        gain: Rate [1/s].
        max_speed: Largest norm of b [m/s or rad/s]; None for no bound.
        driven: `"held"` drives the rows of Lambda, as the paper does, and leaves the tip's position along the other
            rows to the null-space policy; `"all"` drives every row of the features, so that the tip reaches the point.

    Raises:
        TargetError: The target is not finite numbers, or `driven` is another word.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
        >>> task = ml.PointAttractor([1.0, 1.5])  # x, y [m]; the held row picks y
        >>> rollout = ml.simulate(robot, ml.ResolvedRateController(constraint, task), [0.3, 0.8, 0.4])
        >>> float(rollout.task_error[-1].round(3))  # left along y [m]
        0.005
    """

    target: Any
    gain: float = 1.0
    max_speed: float | None = None
    driven: Literal["held", "all"] = field(default="held", kw_only=True)
    _all: ClassVar[Constraint | None] = None  # constraint of all rows of the features, made at the first use

    def __post_init__(self) -> None:
        """Check the target, and store it as a read-only array: a loop may be running it."""
        if self.driven not in ("held", "all"):
            raise TargetError(f"driven must be 'held' or 'all', not {self.driven!r}")
        try:
            numbers = np.array(self.target, dtype=np.float64)
        except (TypeError, ValueError):
            numbers = np.array(np.nan)
        if numbers.ndim not in (1, 2) or not np.all(np.isfinite(numbers)):
            raise TargetError(f"the target must be finite numbers, got {self.target!r}")
        numbers.setflags(write=False)
        object.__setattr__(self, "target", numbers)

    def _fits(self, features: FeatureMap) -> bool:
        """Return True if the target is a pose, or has a number for each row of the features."""
        return self.target.shape in ((features.n_rows,), (4, 4))

    def rows(self, constraint: Constraint) -> Constraint:
        """Return the constraint's rows, or all rows of its features for `driven="all"`.

        Args:
            constraint: The learnt constraint.

        Raises:
            TargetError: `driven` is `"all"`, and the target does not have one number per feature row.
        """
        if self.driven == "held":
            return constraint
        features, names = constraint.features, constraint.features.row_names
        if not self._fits(features) or isinstance(features, WeighedVelocity):
            how_held = advice("a number per row of Lambda needs {}", "driven='held'", "--rows held")
            expected = f"{len(names)} numbers ({', '.join(names)})"
            raise TargetError(f"the target must have {expected}, got shape {self.target.shape}: {how_held}")
        if (every := self._all) is None or every.features is not features:
            every = Constraint(np.eye(len(names)), features, constraint.provenance)
            object.__setattr__(self, "_all", every)
        return every  # the same one at each call, so that a policy that climbs it shares the controller's work

    def displacement(self, constraint: Constraint, q: ArrayLike) -> Float[np.ndarray, " s"]:
        """Return the displacement to the target along the constrained rows, Lambda (r* - r(q)), in their units (s,).

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Raises:
            TargetError: The target has the wrong size.
        """
        return self._toward(constraint, q)[0]

    def _toward(self, constraint: Constraint, q: ArrayLike) -> VelocityAndJacobian:
        """Return the displacement, and E with d/dt displacement = -E u; None where E = A(q) (see `Task`)."""
        features, s, rows = constraint.features, constraint.n_constraints, constraint.selection
        if self._fits(features):
            error, E = features.error_and_jacobian(self.target, q)
            way = rows.dot(error)
        elif self.target.shape == (s,):
            way, E = self.target - rows @ features.coordinates(q), features.coordinates_jacobian(q)
        else:
            expected = f"{features.n_rows} numbers ({', '.join(features.row_names)})"
            expected += "" if s == features.n_rows else f", or {s}: one per row of the constraint"
            raise TargetError(f"the target must have {expected}; got shape {self.target.shape}")
        return way, None if E is None else rows.dot(E)

    def goal(self) -> Float[np.ndarray, "..."] | None:
        """Return the target as an array of the shape that was passed: (p,), (s,) or (4, 4)."""
        return self.target

    def error_jacobian(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, "s nv"] | None:
        """Return the Jacobian E of the displacement, whose rate is -E u; None if E = A(q) (see `Task.error_jacobian`).

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Not used.

        Raises:
            TargetError: The target has the wrong size.
        """
        return self._toward(constraint, q)[1]

    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, " s"]:
        """Return b = gain * `displacement`, scaled down to `max_speed`, shape (s,), in the rows' units per second.

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Not used.

        Raises:
            TargetError: The target has the wrong size.
        """
        return self._attraction(self.displacement(constraint, q))

    def velocity_and_jacobian(self, constraint: Constraint, q: np.ndarray, t: float) -> VelocityAndJacobian:
        """Return `velocity` and `error_jacobian` from a single evaluation of the pose.

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Not used.

        Raises:
            TargetError: The target has the wrong size.
        """
        if type(self) is not PointAttractor:  # a subclass may override velocity()
            return super().velocity_and_jacobian(constraint, q, t)
        displacement, E = self._toward(constraint, q)
        return self._attraction(displacement), E

    def _attraction(self, displacement: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
        b = self.gain * displacement
        if self.max_speed is not None and (speed := math.sqrt(b.dot(b))) > self.max_speed:
            b *= self.max_speed / speed
        return b

    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Return the distance to the target along the constrained rows [m or rad].

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Not used.

        Raises:
            TargetError: The target has the wrong size.
        """
        return float(np.linalg.norm(self.displacement(constraint, q)))

    def __repr__(self) -> str:
        return f"PointAttractor({np.array2string(self.target, precision=3)}, gain={self.gain:g})"


@final
class Track(SinglePassTask):
    r"""Task that follows a moving target without lag.

    .. math::

        b = \text{gain} \, \Lambda \, (r^*(t) - r(q)) + \Lambda \, \frac{dr^*}{dt}

    A controller applies b for its period dt. The velocity of the target is therefore its mean during that time: the
    rate at the middle of the step, or, if no rate is given, the displacement of the target divided by dt. `velocity`
    does not get dt: without a `rate` it leaves out the velocity of the target.

    Args:
        target: Function of the time [s] that returns :math:`r^*(t)`, in one of the forms of `PointAttractor.target`.
        rate: Function of the time [s] that returns :math:`dr^*/dt` along the rows of the features, shape (p,); None
            derives it from the target.
        gain: Rate [1/s].

    Example:
        >>> import numpy as np
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> constraint = ml.Constraint(np.eye(2), ml.FrameJacobian(robot, "tip", axes="x y"))
        >>> start = robot.position([0.3, 0.8, 0.4], "tip")[:2]
        >>> circle = ml.Track(lambda t: start + 0.1 * np.array([np.sin(t), np.cos(t) - 1.0]), gain=5.0)
        >>> controller = ml.ResolvedRateController(constraint, circle)
        >>> rollout = ml.simulate(robot, controller, [0.3, 0.8, 0.4], duration=6.0, dt=0.01)
        >>> bool(rollout.task_error[100:].max() < 1e-4)  # [m]
        True
    """

    sampled = True

    def __init__(
        self, target: Callable[[float], ArrayLike], rate: Callable[[float], ArrayLike] | None = None, gain: float = 1.0
    ):
        self._target, self._rate, self.gain = target, rate, float(gain)

    def velocity_and_jacobian(
        self, constraint: Constraint, q: np.ndarray, t: float, dt: float = 0.0
    ) -> VelocityAndJacobian:
        """Return the task's velocity b for a step (s,), and the Jacobian E of its error, or None if E = A(q).

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time at which the step begins [s].
            dt: Length of the step [s]; 0 leaves out the target's velocity unless `rate` is given.

        Raises:
            TargetError: The target has the wrong size.
        """
        ahead, E = PointAttractor(self._target(t))._toward(constraint, q)
        b = self.gain * ahead
        if self._rate is not None:
            b += constraint.selection @ np.asarray(self._rate(t + 0.5 * dt), dtype=np.float64)
        elif dt > 0.0:
            b += (PointAttractor(self._target(t + dt)).displacement(constraint, q) - ahead) / dt
        return b, E

    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Return the distance to the target's position at time t along the constrained rows [m or rad].

        Args:
            constraint: The constraint of the controller, see `rows`.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """
        return PointAttractor(self._target(t)).error(constraint, q, t)

    def __repr__(self) -> str:
        return f"Track(gain={self.gain:g})"
