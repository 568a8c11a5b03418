"""Resolved-rate control: u = A^+ b + N pi, within the limits of a real arm."""

from __future__ import annotations

import copy
import logging
import math
import os
from collections.abc import Callable
from functools import cache, cached_property
from importlib import import_module
from typing import Any, Literal, final

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.command import Command, Controller, LimitedController, Status, Vector
from manip_learn.control.law import Law
from manip_learn.control.limits import Limits
from manip_learn.control.policies import NullSpacePolicy, ZeroPolicy, as_policy, replace_constraint
from manip_learn.control.tasks import Hold, Task
from manip_learn.errors import ConfigurationError, ConstraintError, an
from manip_learn.linalg import Inverse, finite
from manip_learn.robot.robot import Robot

_LOGGER = logging.getLogger("manip_learn")
LAW_VERSION = 3  # version of the law's results: fast/src/law.hpp has the same


@final
class ResolvedRateController(LimitedController):
    r"""Resolved-rate controller: the joint velocity of a task and a null-space policy, within the limits of an arm.

    It computes equation (2) of Manavalan and Howard, "Learning Singularity Avoidance",

    .. math::

        u = A^+ b + N \pi

    with the constraint A(q), the task's velocity b(q, t), the projector N onto the null space of A, and the null-space
    policy pi(q, t). Away from singularities and limits the command is exactly that. Near them one quadratic program
    finds the velocity within the limits that keeps, in this order: the constraint of the hand, the direction of the
    task, its speed, and the policy (`law.Law` has the mathematics). The task distinguishes held and driven rows
    (`Task.driven_rows`).

    Args:
        constraint: The constraint A(q).
        task: The task b(q, t); None for b = 0: nothing moves along the constrained rows.
        null_policy: The null-space policy pi(q, t): a `NullSpacePolicy`, or a function of q, or of q and t [s], that
            returns a joint velocity (nv,). None for no null-space motion.
        inverse: Pseudo-inverse of A: `"damped"` for a real arm; as in the paper `"exact"`, which divides by each
            singular value, or `"truncated"`, which leaves out singular values below Matlab's tolerance.
        threshold: Singular value of A below which damping sets in, in the constraint's units (m or 1).
        damping: Damping factor lambda of driven rows where a singular value is 0. Held rows have a tenth of it; a task
            that presses into the singularity has more. None for the task's own: 0.05, and 0.01 for a `FreeDirection`.
        limits: `True` for the robot's own limits (`Limits` has the default accelerations); a `Limits`; `False` ignores
            all limits (the paper's law as printed).
        dt: Time for which a command is applied [s], unless the call passes another one.
        robot: Robot whose limits count; by default the robot of `limits`, or else of the constraint's features.

    Raises:
        ConstraintError: Arguments in the wrong order, an unknown `inverse`, settings that are not positive, more held
            rows than joints, or `limits` of another robot than `robot`.
        ConfigurationError: A function as null-space policy takes other arguments than q, or q and t.

    Example:
        >>> import manip_learn as ml
        >>> constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(ml.load_robot("planar3"), "tip", axes="x y"))
        >>> climb = ml.ManipulabilityAscent(constraint)
        >>> controller = ml.ResolvedRateController(constraint, ml.PointAttractor([1.0, 1.5]), climb)
        >>> command = controller([0.3, 0.8, 0.4], 0.0)
        >>> command.velocity.shape, command.status  # [rad/s]
        ((3,), <Status.OK: 'ok'>)
    """

    def __init__(
        self,
        constraint: Constraint,
        task: Task | None = None,
        null_policy: NullSpacePolicy | Callable[..., ArrayLike] | None = None,
        inverse: Inverse = "damped",
        *,
        threshold: float = 0.05,
        damping: float | None = None,
        limits: bool | Limits = True,
        dt: float = 0.01,
        robot: Robot | None = None,
    ):
        fits = null_policy is None or (callable(null_policy) and not isinstance(null_policy, Task | Constraint))
        if not (isinstance(constraint, Constraint) and (task is None or isinstance(task, Task)) and fits):
            got = f"got {an(constraint)}, {an(task)} and {an(null_policy)}, in this order"
            raise ConstraintError(f"call ResolvedRateController(constraint, task, null_policy): {got}")
        if inverse not in ("exact", "truncated", "damped"):
            raise ConstraintError(f"inverse must be 'exact', 'truncated' or 'damped', not {inverse!r}")
        self.task: Task = task or Hold()
        self._damping_given, damping = damping, self.task.damping if damping is None else damping
        for name, value in (("threshold", threshold), ("damping", damping), ("dt", dt)):
            if not (np.isfinite(value) and value > 0.0):
                raise ConstraintError(f"{name} must be a positive number, got {value!r}")
        self.learnt = constraint
        self.constraint = constraint = self.task.rows(constraint)
        n_held = constraint.n_constraints - len(self.task.driven_rows(constraint))
        if n_held > constraint.nv:
            raise ConstraintError(f"{n_held} rows are held by {constraint.nv} joints: they contradict each other")
        self.null_policy: NullSpacePolicy = ZeroPolicy(constraint.nv) if null_policy is None else as_policy(null_policy)  # type: ignore[arg-type]
        self.inverse: Inverse = inverse
        self.threshold, self.damping, self.dt = float(threshold), float(damping), float(dt)
        limits_robot = limits.robot if isinstance(limits, Limits) else None
        self.robot: Robot | None = robot or limits_robot or constraint.robot
        self.limits = self._limits_of(limits)
        self._law = Law(constraint, self.task, self.null_policy, inverse, self.threshold, self.damping)

    def __call__(
        self, q: ArrayLike, t: float = 0.0, dt: float | None = None, previous: Vector | None = None, slide: float = 0.0
    ) -> Command:
        """Return the command at a posture and a time.

        Args:
            q: Posture: a configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
            dt: Time for which the command is applied [s]; None for the controller's own.
            previous: Velocity commanded in the previous step (nv,) [rad/s or m/s], from which the acceleration limits
                count; None for no limit of the acceleration.
            slide: Share of the task's direction that may be given up at limits, 0 to 1. 0 keeps the direction if the
                limits allow any motion along it; 1 comes as near to the task's velocity as the limits allow, in
                another direction if necessary. It has no effect on a task whose `slides` is False.

        Raises:
            ConfigurationError: q has the wrong size or is not finite, or dt is not positive.
            TargetError: The task's target does not fit the constraint, or the null-space policy does not return one
                number per joint.
        """
        dt = self.dt if dt is None else dt
        if not 0.0 < dt < math.inf:
            raise ConfigurationError(f"dt must be a positive number of seconds, got {dt!r}")
        native = self.native
        if native is not None and (command := native.step(q, dt, previous, slide)) is not None:
            return command
        if self.robot is not None:
            q = self.robot.checked_posture(q)
        elif not np.all(np.isfinite(q := np.asarray(q, dtype=np.float64))):
            raise ConfigurationError(f"the posture is not finite: {q.tolist()}")
        slide = slide if self.task.slides else 0.0
        if native is None or (command := native.command(q, t, dt, previous, slide)) is None:
            return self._law.command(q, t, dt, self.limits, previous, slide)
        return command

    @property
    def engine(self) -> Literal["native", "python"]:
        """Engine that computes the commands: `"native"` (compiled, `pip install ./fast`) or `"python"`."""
        return "python" if self.native is None else "native"

    @cached_property
    def native(self) -> Any:
        """The compiled law (see `native_law`); None if the commands are computed in Python."""
        return native_law(self._law, self.limits)

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Return the distance to the task's goal along the constrained rows [m or rad].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
            TargetError: The task's target does not fit the constraint.
        """
        return self.task.error(self.constraint, np.asarray(q, dtype=np.float64), t)

    def with_task(self, task: Task, constraint: Constraint) -> ResolvedRateController:
        """Return a copy of this controller with another task and another constraint.

        A `ManipulabilityAscent` (or similar policy) of the present constraint then climbs the new one.

        Args:
            task: The new task.
            constraint: The new constraint.

        Raises:
            ConstraintError: The task moves along another constraint.
        """
        rows, policy = task.rows(constraint), self.null_policy
        for before, after in ((self.constraint, rows), (self.learnt, constraint)):
            if before is not after:
                policy = replace_constraint(policy, before, after)
        settings = {"threshold": self.threshold, "damping": self._damping_given, "dt": self.dt, "robot": self.robot}
        return ResolvedRateController(constraint, task, policy, self.inverse, limits=self.limits or False, **settings)

    @property
    def law(self) -> ResolvedRateController:
        """This controller, as the law that computes the present command (see `LimitedController`)."""
        return self

    @property
    def laws(self) -> tuple[ResolvedRateController, ...]:
        """This controller alone, as a tuple."""
        return (self,)

    def with_limits(self, limits: Limits, lag: float = 0.0) -> ResolvedRateController:
        """Return a copy of this controller with other limits.

        Args:
            limits: `Limits` of the same robot.
            lag: Ignored: this controller does not compensate for a lag.

        Raises:
            ConstraintError: The limits belong to another robot.
        """
        other = copy.copy(self)
        other.limits = other._limits_of(limits)
        vars(other).pop("native", None)
        return other

    def _limits_of(self, limits: bool | Limits) -> Limits | None:
        if isinstance(limits, Limits):
            if self.robot is not limits.robot:
                raise ConstraintError("the limits belong to another robot than the constraint's")
            return limits
        return Limits(self.robot) if limits and self.robot is not None else None

    def __repr__(self) -> str:
        arguments = f"task={self.task!r}, null_policy={self.null_policy!r}, inverse={self.inverse!r}"
        return f"ResolvedRateController({self.constraint!r}, {arguments})"


@final
class BoundedController(LimitedController):
    """Wrapper that keeps a controller of your own within limits.

    Args:
        controller: Callable `(q, t, dt) -> Command`, of which only the velocity is used. It may write into its
            arguments, and return the same array every time.
        limits: The limits.
    """

    def __init__(self, controller: Controller, limits: Limits):
        self.controller, self.limits, self.robot = controller, limits, limits.robot

    def __call__(
        self, q: ArrayLike, t: float = 0.0, dt: float | None = None, previous: Any = None, slide: float = 0.0
    ) -> Command:
        """Return the controller's command, slowed down to the limits.

        Raises:
            ConfigurationError: dt is missing, or the velocity is not one finite number per joint.
        """
        if dt is None:
            raise ConfigurationError("a controller within limits needs the period: run it in ServoLoop(..., dt)")
        limits, q = self.limits, np.array(q, dtype=np.float64)
        command = self.controller(q.copy(), t, dt)
        if (wish := finite(command.velocity, *limits.velocity.shape)) is None:
            text = f"{command.velocity!r:.80}"
            raise ConfigurationError(f"the controller's velocity is not {self.robot.nv} finite numbers: {text}")
        wish = limits.barriers.at(q, dt, limits.acceleration, None).slowed(wish)
        bounds = limits.bounds(q, dt, previous)
        if bounds.admit(wish):
            return command._replace(velocity=wish)
        status = Status.OUTSIDE_LIMITS if bounds.outside > 0.0 else Status.ACCELERATION_LIMITED
        velocity = wish if previous is None else limits.towards(wish, previous, bounds, dt)
        return command._replace(velocity=velocity, status=status, outside=bounds.outside)

    def with_limits(self, limits: Limits, lag: float = 0.0) -> BoundedController:
        """Return this controller with other limits.

        Args:
            limits: `Limits` of the same robot.
            lag: Ignored: this controller does not compensate for a lag.
        """
        return BoundedController(self.controller, limits)


@cache
def _compiled() -> Any:
    """Return the compiled module, or None; log once why an installed one cannot be used."""
    try:
        module = import_module("manip_learn_fast")
        version = module.LAW_VERSION
    except (ImportError, AttributeError, OSError) as error:  # the law in Python does the work
        if isinstance(error, ModuleNotFoundError) and error.name == "manip_learn_fast":
            return None
        fault = f"manip_learn_fast cannot be loaded ({error!r})"
    else:
        fault = f"manip_learn_fast has version {version!r} of the law, this library needs {LAW_VERSION}"
        if version == LAW_VERSION:
            return module
    _LOGGER.warning("%s: build it again with pip install ./fast; until then the law runs in Python", fault)
    return None


def native_law(law: Law, limits: Limits | None) -> Any:
    """Return the compiled law, `manip_learn_fast.NativeLaw`, or None if the law in Python has to be used.

    `manip_learn_fast`, built from `fast/`, is optional. It returns the same numbers as the law in Python, which is the
    reference. Rows, tasks and policies that it does not implement (your own, `FreeDirection`) are computed in Python
    and passed to it.

    Args:
        law: The law in Python.
        limits: Limits of the controller; None for none.
    """
    module = None if os.environ.get("MANIP_LEARN_ENGINE") == "python" else _compiled()
    try:
        return None if module is None else module.NativeLaw(law, limits)
    except LookupError as reason:
        _LOGGER.debug("the law runs in Python: %s", reason)
        return None
