"""Null-space policies: the desired motion of the redundant degrees of freedom."""

from __future__ import annotations

import copy
import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint, Vjp
from manip_learn.constraint.features.frame_jacobian import PoseRows
from manip_learn.constraint.manipulability import SINGULAR_RATIO, gradient_from, manipulability_gradient, svd
from manip_learn.control.command import Vector
from manip_learn.errors import ConfigurationError, ConstraintError, TargetError, an
from manip_learn.linalg import unit
from manip_learn.robot.limit_potential import has_range, joint_range_margin, ranges
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_vector

ASCENT_GAIN = 3.0  # [rad^2/s] default: the highest manipulability of the gains that were compared
SEED_SPEED = 5e-4  # [rad/s] speed at an exact singularity, which the policy may leave in either sense
# largest growth of the distance to the singularity in one step (ratio): a step away from it cannot overshoot anything.
# Of 61 exactly singular starts of five arms that hold still, 0.25 leaves 61, 56 and 42 within a second at 1, 10 and
# 20 ms, 1 leaves 61, 61 and 58, 1.25 and more leave all; from 1.5 on, arms that are pressed against a singularity
# oscillate now and then
GROWTH = 1.25
Decomposition = tuple[Float[np.ndarray, "s s"], Float[np.ndarray, " k"], Float[np.ndarray, "n n"]]


class NullSpacePolicy(ABC):
    r"""Base class of null-space policies: the velocity :math:`\pi(q, t)` of :math:`u = A^+ b + N \pi`, equation (2).

    A policy returns the joint velocity that it prefers. The controller projects it onto the null space of the task.
    """

    @abstractmethod
    def __call__(self, q: ArrayLike, t: float = 0.0) -> Vector:
        """Return the desired joint velocity (nv,) [rad/s or m/s].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """

    def over_step(self, q: ArrayLike, t: float, dt: float) -> Vector:
        """Return the velocity for a step; by default the velocity at its beginning.

        Args:
            q: Configuration (nq,) or joint positions (nv,) at the beginning of the step [rad or m].
            t: Time at which the step begins [s].
            dt: Length of the step, for which the velocity is applied [s].

        Returns:
            shape (nv,) [rad/s or m/s].
        """
        return self(q, t)


class SampledPolicy(NullSpacePolicy):
    """Base class of policies whose velocity depends on the length of the step, so that explicit steps stay stable."""

    @abstractmethod
    def __call__(self, q: ArrayLike, t: float = 0.0, dt: float = 0.01) -> Vector:
        """Return the desired joint velocity for a step, shape (nv,) [rad/s or m/s].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time at which the step begins [s].
            dt: Length of the step [s].
        """

    def over_step(self, q: ArrayLike, t: float, dt: float) -> Vector:
        """Return the velocity for a step.

        Args:
            q: Configuration (nq,) or joint positions (nv,) at the beginning of the step [rad or m].
            t: Time at which the step begins [s].
            dt: Length of the step, for which the velocity is applied [s].

        Returns:
            shape (nv,) [rad/s or m/s].
        """
        return self(q, t, dt)


@final
class ZeroPolicy(NullSpacePolicy):
    r"""Null-space policy :math:`\pi = 0`: the plain pseudo-inverse, equation (2) without its second term.

    Args:
        nv: Number of joint velocities of the robot.
    """

    def __init__(self, nv: int):
        self._zero = np.zeros(nv)
        self._zero.setflags(write=False)

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Vector:
        """Return zeros, shape (nv,) [rad/s or m/s], whatever the posture and the time."""
        return self._zero

    def __repr__(self) -> str:
        return "ZeroPolicy()"


def _positive(name: str, value: float) -> float:
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigurationError(f"{name} must be a positive number, got {value!r}")
    return float(value)


@final
class JointAttractor(NullSpacePolicy):
    r"""Null-space policy towards a rest posture, the point attractor of the paper's comparisons.

    .. math::

        \pi = \text{gain} \cdot (\psi^* - q)

    with the rest posture :math:`\psi^*`. If the robot is given, differences are taken on its configuration manifold, so
    that a continuous joint moves by the smaller angle; otherwise they are plain differences.

    Args:
        rest: Rest posture, joint positions (nv,) [rad or m] or a configuration (nq,), as q. A configuration with
            nq different from nv needs `robot`.
        gain: Rate [1/s].
        robot: The robot, for differences on its configuration manifold.

    Raises:
        TargetError: The rest posture is not a vector of finite numbers.
        ConfigurationError: The rest posture has the wrong size for the robot.
    """

    def __init__(self, rest: ArrayLike, gain: float = 1.0, robot: Robot | None = None):
        self.rest = np.array(rest, dtype=np.float64)
        if self.rest.ndim != 1 or not np.all(np.isfinite(self.rest)):
            raise TargetError(f"the rest posture must be finite numbers in one row, got {rest!r}")
        if robot is not None:
            robot.configuration(self.rest)
        self.rest.setflags(write=False)
        self.gain = float(gain)
        self.robot = robot

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Vector:
        """Return gain * (rest - q), shape (nv,) [rad/s or m/s].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Not used.

        Raises:
            TargetError: q and the rest posture have different sizes.
        """
        here = np.asarray(q, dtype=np.float64)
        if self.robot is None and here.shape != self.rest.shape:
            raise TargetError(f"the rest posture has {self.rest.size} numbers, the posture has shape {here.shape}")
        return self.gain * (self.rest - here if self.robot is None else self.robot.difference(here, self.rest))

    def __repr__(self) -> str:
        return f"JointAttractor({np.array2string(self.rest, precision=3)}, gain={self.gain:g})"


@final
class JointLimitAvoidance(NullSpacePolicy):
    r"""Null-space policy away from the joint limits: gradient descent of the potential h of `limit_potential`.

    Let :math:`x_j` be the position of joint j in its range from :math:`l_j` to :math:`u_j`, normalised to -1 ... 1, and
    :math:`v_j` its largest speed. Then

    .. math::

        h &= \sum_j \frac{1}{1 - x_j^2}, \qquad
        p_j = \text{gain} \left(\frac{u_j - l_j}{2}\right)^2 \frac{\partial h}{\partial q_j}
            = \text{gain} \, \frac{(u_j - l_j) \, x_j}{(1 - x_j^2)^2} \\
        \pi_j &= -\frac{p_j}{\sqrt{1 + (p_j / v_j)^2}}

    The gradient of h is taken in the coordinates x, so that joints of different ranges and units return to the middle
    at the same rate, 2 gain. The speed grows smoothly to :math:`v_j` at a limit, and stays there outside. Joints that
    are not limited on both sides do not move.

    Args:
        robot: Robot whose limits are avoided.
        gain: Rate [1/s].
        max_speed: Largest speed of a joint [rad/s or m/s]. No joint moves faster than half its range per second either.

    Raises:
        ConfigurationError: The gain or the speed is not positive.
    """

    def __init__(self, robot: Robot, gain: float = 0.1, *, max_speed: float = 0.5):
        self.robot = robot
        self.gain = _positive("gain", gain)
        self.max_speed = _positive("max_speed", max_speed)
        limited = has_range(robot)
        width = np.where(limited, ranges(robot), 0.0)
        self._strength = self.gain * width
        self._middle = np.zeros(robot.nv)
        self._middle[limited] = 0.5 * (robot.position_lower[limited] + robot.position_upper[limited])
        self._per_half = np.divide(2.0, width, out=np.zeros(robot.nv), where=limited)
        self._longest = np.where(limited, np.minimum(self.max_speed, 0.5 * width), 1.0)
        self.numbers = self._strength, self._middle, self._per_half, self._longest  # for the compiled law

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Vector:
        """Return the velocity towards the middle of the joint ranges (nv,) [rad/s or m/s].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Not used.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        x = (self.robot.positions(q) - self._middle) * self._per_half
        room, pull = joint_range_margin(x), self._strength * x
        # numerator and denominator are multiplied by room^2, which keeps them finite at the limits
        return -pull / np.hypot(room * room, pull / self._longest)

    def __repr__(self) -> str:
        return f"JointLimitAvoidance(gain={self.gain:g}, max_speed={self.max_speed:g})"


class _Ascent(SampledPolicy):
    """Bounded ascent of the logarithm of a measure that vanishes where rows of a constraint are lost.

    Args:
        constraint: Constraint with these rows.
        gain: Rate [rad^2/s].
        max_speed: Largest norm of pi [rad/s]; None for no bound.
    """

    def __init__(self, constraint: Constraint, gain: float, max_speed: float | None):
        if not isinstance(constraint, Constraint):
            raise ConstraintError(f"call {type(self).__name__}(constraint), got {an(constraint)}")
        if max_speed is not None and not max_speed > 0.0:
            raise ConstraintError(f"max_speed must be positive [rad/s], or None for no bound, got {max_speed!r}")
        self.constraint, self.gain = constraint, float(gain)
        self.max_speed = None if max_speed is None else float(max_speed)

    @abstractmethod
    def _slope(self, q: ArrayLike, decomposition: Decomposition, vjp: Vjp) -> Vector:
        """Return the gradient of the measure's logarithm at a posture, from the rows' decomposition and derivative."""

    def __call__(self, q: ArrayLike, t: float = 0.0, dt: float = 0.01) -> Vector:
        """Return the ascent velocity (nv,) [rad/s or m/s], finite everywhere.

        Args:
            q: Posture: a configuration or joint positions.
            t: Time [s]; not used.
            dt: Time for which the velocity is applied [s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        A, vjp = self.constraint.value_and_vjp(q)
        decomposition, (s, nv) = svd(A), A.shape
        if s > nv:
            return np.zeros(nv)
        lost = decomposition[1] <= SINGULAR_RATIO * decomposition[1][0]
        if lost[-1] and (self.max_speed is not None or lost[:-1].any()):
            speed = self.gain / SINGULAR_RATIO if self.max_speed is None else min(self.max_speed, SEED_SPEED)
            return speed * steepest_ascent(decomposition, vjp)
        slope = self._slope(q, decomposition, vjp)
        if self.max_speed is None:
            return slope * self.gain
        steepness = math.sqrt(slope.dot(slope))
        ramp = dt * self.max_speed * steepness / GROWTH  # r / sigma
        longest = self.max_speed / math.sqrt(1.0 + ramp * ramp)
        return slope * (self.gain if self.gain * steepness <= longest else longest / steepness)


@final
class ManipulabilityAscent(_Ascent):
    r"""Null-space policy that increases the manipulability mu of a constraint: gradient ascent of log mu.

    .. math::

        \pi = \text{gain} \, \nabla \log \mu = \text{gain} \, \frac{\nabla \mu}{\mu}, \qquad
        \frac{\partial \mu}{\partial q_k}
            = \mu \, \text{tr}\left((A A^T)^{-1} A \left(\frac{\partial A}{\partial q_k}\right)^T\right)

    With `logarithmic=False` it is :math:`\text{gain} \, \nabla \mu`, equation (13) of Manavalan and Howard. The
    gradient of log mu has the same direction, but does not depend on the units of the constraint. It also stays large
    where mu is small, near a singularity, where the gradient of mu almost vanishes.

    Towards a singularity the gradient of log mu grows as :math:`1 / \sigma`, with the smallest singular value
    :math:`\sigma` of A, so that an explicit step would jump from one side to the other. Its length is therefore at most

    .. math::

        v_\text{max} \, \frac{\sigma}{\sqrt{\sigma^2 + r^2}}, \qquad
        r = \frac{dt \, v_\text{max} \, |\nabla \log \mu| \, \sigma}{\gamma}

    with :math:`v_\text{max}` = `max_speed` and :math:`\gamma` = `GROWTH`. It is continuous, with a slope that a step of
    dt can follow. At the singularity itself the velocity is `SEED_SPEED` along the steepest ascent of mu, and the
    controller adds the motion that leaves it (see `Law`).

    If a task also drives rows, the manipulability of both the held and the driven rows matters: the manipulability of
    the held rows alone may rise while the driven direction is being lost. `FreeDirection.ascent` climbs a measure of
    both.

    Args:
        constraint: Constraint whose manipulability is climbed.
        gain: Factor on the gradient; [rad^2/s] for the gradient of log mu.
        logarithmic: True for the gradient of log mu, with bounded length; False for the gradient of mu as in the paper,
            without a bound.
        max_speed: Largest norm of the velocity [rad/s]; None for no bound. At a singularity the unbounded gradient has
            the direction of steepest ascent, also if several directions are lost at once. With 1 rad/s the arm leaves
            singularities more slowly, and the hand is pulled less far off its constraint when a redundant joint meets
            its limit.

    Raises:
        ConstraintError: `max_speed` is not positive, or no constraint was given.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
        >>> climb = ml.ResolvedRateController(constraint, null_policy=ml.ManipulabilityAscent(constraint))
        >>> rollout = ml.simulate(robot, climb, [0.3, 0.8, 0.4], duration=3.0)  # the tip keeps its y
        >>> rollout.manipulability[[0, -1]].round(1)
        array([1.6, 2.6])
    """

    def __init__(
        self,
        constraint: Constraint,
        gain: float = ASCENT_GAIN,
        *,
        logarithmic: bool = True,
        max_speed: float | None = 10.0,
    ):
        super().__init__(constraint, gain, max_speed if logarithmic else None)
        self.logarithmic = bool(logarithmic)

    def __call__(self, q: ArrayLike, t: float = 0.0, dt: float = 0.01) -> Vector:
        """Return the ascent velocity (nv,) [rad/s or m/s], finite everywhere.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s]; not used.
            dt: Time for which the velocity is applied [s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return (
            super().__call__(q, t, dt) if self.logarithmic else self.gain * manipulability_gradient(self.constraint, q)
        )

    def _slope(self, q: ArrayLike, decomposition: Decomposition, vjp: Vjp) -> Vector:
        mu, gradient, floor = gradient_from((len(decomposition[0]), len(decomposition[2])), decomposition, vjp)
        return gradient / max(mu, floor, 1e-300)

    def __repr__(self) -> str:
        return f"ManipulabilityAscent(gain={self.gain:g}, logarithmic={self.logarithmic})"


@final
class RoomAscent(_Ascent):
    """Null-space policy that keeps the arm away from singularities and from joint limits at the same time.

        m_i = sigma_i / (sigma_i + sigma_0),    m_j = 1 - x_j^2,    M = (sum_i m_i^-2 + sum_j m_j^-2)^(-1/2)
        pi = gain grad log M, at most max_speed as for `ManipulabilityAscent`

    There is one m_i per singular value sigma_i of the constraint, and one m_j per joint. sigma_0 is the singular value
    at which the requested speed needs the slowest joint's full speed; x_j is the position of joint j in its range,
    normalised to -1 ... 1. M is a smooth minimum, in which the smallest m counts most. Ascent of the manipulability
    alone would lead joints to their limits.

    Args:
        constraint: Constraint with the held and the driven rows.
        speed: Requested speed along the rows [m/s or rad/s].
        gain: Rate [rad^2/s].
        max_speed: Largest norm of pi [rad/s].

    Raises:
        ConstraintError: The constraint's features have no robot, or `max_speed` is not positive.
    """

    def __init__(self, constraint: Constraint, speed: float, gain: float = ASCENT_GAIN, *, max_speed: float = 10.0):
        super().__init__(constraint, gain, _positive("max_speed", max_speed))
        robot = constraint.robot
        if robot is None:
            raise ConstraintError(f"{constraint.features!r} belongs to no robot, whose joint limits count")
        self.speed = _positive("speed", speed)
        slowest = float(np.min(robot.velocity_limit))
        self._enough = self.speed / (slowest if math.isfinite(slowest) else 1.0)
        self._robot, self._limited = robot, has_range(robot)
        self._width = ranges(robot)[self._limited]
        self._middle = 0.5 * (robot.position_lower[self._limited] + robot.position_upper[self._limited])
        self.numbers = self._enough, np.flatnonzero(self._limited), self._middle, self._width  # for the compiled law

    def _slope(self, q: ArrayLike, decomposition: Decomposition, vjp: Vjp) -> Vector:
        U, sigma, Vt = decomposition
        x = 2.0 * (self._robot.positions(q)[self._limited] - self._middle) / self._width
        room = np.maximum(joint_range_margin(x), 1e-4)  # of a range: the slope of a joint at its limit stays finite
        shares = np.concatenate([(1.0 + self._enough / sigma) ** 2, 1.0 / room**2])
        shares /= shares.sum()
        rates = shares[: len(sigma)] * self._enough / ((sigma + self._enough) * sigma)
        slope = vjp((U * rates).dot(Vt[: len(sigma)]))
        slope[self._limited] -= shares[len(sigma) :] * 4.0 * x / (room * self._width)
        return slope

    def __repr__(self) -> str:
        return f"RoomAscent(speed={self.speed:g}, gain={self.gain:g})"


@final
class KeptOrientation(SampledPolicy):
    """Null-space policy: another policy plus a pull towards the demonstrated orientation of the hand.

    It is for orientations that demonstrators kept by habit, so that the task does not constrain them. The pull is
    gradient descent of theta^2 / (2 rms^2), where theta is the angle between the orientation of the hand and the
    demonstrated one, and rms the RMS value of that angle in the demonstrations. Its weight is 1 / rms^2 relative to
    grad log M of `RoomAscent`, with the same gain. The step is implicit and therefore stable at any weight: with the
    rotation rows J of the hand, theta as the rotation vector from the hand's orientation to the demonstrated one in
    the base frame, and h = max(3 dt, 0.1 s) gain,

        pi = (I + h J^T J / rms^2)^-1 (pi_0 + gain J^T theta / rms^2)

    As every null-space motion it is reduced first when joints meet their limits.

    Args:
        policy: The other policy, pi_0.
        features: Rows of the hand frame's twist (`PoseRows`).
        wanted: Function without arguments that returns the demonstrated orientation of the frame in the base frame
            (3, 3) for the current position on the path.
        rms: RMS deviation of the demonstrations [rad], positive.
        gain: Rate [rad^2/s].

    Raises:
        ConfigurationError: rms or the gain is not a positive number.
    """

    def __init__(
        self,
        policy: NullSpacePolicy,
        features: PoseRows,
        wanted: Callable[[], Float[np.ndarray, "3 3"]],
        rms: float,
        gain: float = ASCENT_GAIN,
    ):
        self.policy, self._features, self._orientation = policy, features, wanted
        self.rms, self.gain = _positive("rms", rms), _positive("gain", gain)

    def __call__(self, q: ArrayLike, t: float = 0.0, dt: float = 0.01) -> Vector:
        """Return the velocity of the policy plus the pull towards the demonstrated orientation (nv,) [rad/s or m/s].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
            dt: Time for which the velocity is applied [s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        u = self.policy.over_step(q, t, dt)
        J, pose = self._features.twist_rows(q, False)[3:], self._features.pose(q)
        turn = rotation_vector(self._orientation() @ pose[:3, :3].T)
        u = u + (self.gain / self.rms**2) * J.T.dot(turn)
        # the deviation is corrected in at least three cycles, because readings may be two cycles late, and in at least
        # 0.1 s, because faster changes are encoder noise
        stiff = self.rms**2 / (max(3.0 * dt, 0.1) * self.gain) * np.eye(3) + J @ J.T
        return u - J.T.dot(np.linalg.solve(stiff, J.dot(u)))

    def __repr__(self) -> str:
        return f"KeptOrientation({self.policy!r}, rms={self.rms:.3g} rad, gain={self.gain:g})"


@final
class WeightedPolicies(SampledPolicy):
    r"""Weighted sum of null-space policies, a compromise between several objectives in one null space.

    .. math::

        \pi = \sum_i w_i \pi_i

    Args:
        policies: The policies :math:`\pi_i`.
        weights: The weights :math:`w_i \ge 0`, one per policy; by default all are 1.

    Raises:
        ConfigurationError: No policies, a wrong number of weights, or a weight that is negative or not finite.
    """

    def __init__(self, policies: Sequence[NullSpacePolicy], weights: Sequence[float] | None = None):
        self.policies = tuple(policies)
        self.weights = (1.0,) * len(self.policies) if weights is None else tuple(float(w) for w in weights)
        if not self.policies or len(self.weights) != len(self.policies):
            raise ConfigurationError(f"{len(self.policies)} policies need as many weights, got {len(self.weights)}")
        if not all(math.isfinite(w) and w >= 0.0 for w in self.weights):
            raise ConfigurationError(f"weights must be numbers of at least 0, got {list(self.weights)}")

    def __call__(self, q: ArrayLike, t: float = 0.0, dt: float = 0.01) -> Vector:
        """Return the weighted sum of the policies' velocities (nv,) [rad/s or m/s].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
            dt: Time for which the velocity is applied [s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
            TargetError: The policies belong to different numbers of joints.
        """
        parts = [w * policy.over_step(q, t, dt) for w, policy in zip(self.weights, self.policies, strict=True)]
        if len({part.shape for part in parts}) > 1:
            sizes = ", ".join(str(part.size) for part in parts)
            raise TargetError(f"the policies of a weighted sum return {sizes} velocities: they belong to one robot")
        return np.sum(parts, axis=0)

    def __repr__(self) -> str:
        terms = " + ".join(f"{w:g} {policy!r}" for w, policy in zip(self.weights, self.policies, strict=True))
        return f"WeightedPolicies({terms})"


def steepest_ascent(decomposition: Decomposition, vjp: Vjp) -> Vector:
    """Return the joint direction in which the lost singular values grow fastest, in the null space if they grow there.

    Let U_0 and V_0 span the directions that A has lost. To first order, U_0^T A(q + step) V_0 is linear in the step;
    the leading right singular vector of the matrix M of this linear map is the direction of steepest ascent.

    Args:
        decomposition: Singular value decomposition of A(q): U (s, s), singular values, V^T (nv, nv).
        vjp: Derivative of A: function of weights (s, nv) that returns the gradient (nv,) of the weighted sum of A's
            entries.

    Returns:
        Unit vector, shape (nv,); zeros if the rows depend on each other at all postures.
    """
    U, sigma, Vt = decomposition
    rank = int(np.count_nonzero(sigma > SINGULAR_RATIO * sigma[0]))
    Z = Vt[rank:]
    M = np.array([vjp(np.outer(u, z)) for u in U[:, rank:].T for z in Z])
    size = float(np.linalg.norm(M))
    if size <= SINGULAR_RATIO * float(sigma[0]):  # rounding: the rows depend on each other everywhere
        return np.zeros(M.shape[1])
    _, rates, directions = np.linalg.svd(M.dot(Z.T))
    if not rates[0] > 1e-6 * size:
        Z, (_, rates, directions) = unit(M.shape[1]), np.linalg.svd(M)
    # several directions may be equally fast, as at the saddle of a planar arm: take the projection of the first joint
    # with the largest share
    fastest = directions[: np.count_nonzero(rates >= rates[0] * (1.0 - 1e-9))].dot(Z)
    shares = (fastest * fastest).sum(axis=0)
    joint = int(np.argmax(shares >= shares.max() - 1e-9))
    return fastest[:, joint].dot(fastest) / math.sqrt(shares[joint])


@final
class PolicyFunction(NullSpacePolicy):
    """Null-space policy that calls a function of yours.

    Args:
        function: Function of a posture q as the caller passes it, (nq,) or (nv,) [rad or m], or of q and a time [s],
            that returns a joint velocity (nv,) [rad/s or m/s].

    Raises:
        ConfigurationError: The function takes other arguments.
    """

    def __init__(self, function: Callable[..., ArrayLike]):
        self.function = function
        takes, fits = inspect.signature(function), set[int]()
        for number in (1, 2):
            with suppress(TypeError):
                takes.bind(*range(number))
                fits.add(number)
        if not fits:
            usage = "write lambda q: ... or lambda q, t: ..."
            raise ConfigurationError(f"a null-space policy takes q, or q and t; this one takes {takes}: {usage}")
        self._timed = 2 in fits and (1 not in fits or "t" in takes.parameters)

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Vector:
        """Return the velocity that the function returns, as an array (nv,) [rad/s or m/s].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s]; not passed to a function of q alone.

        Raises:
            TargetError: The function does not return numbers.
        """
        answer = self.function(q, t) if self._timed else self.function(q)
        try:
            return np.asarray(answer, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise TargetError(f"the null-space policy must return joint velocities, got {answer!r}") from error

    def __repr__(self) -> str:
        return f"PolicyFunction({getattr(self.function, '__name__', self.function)!s})"


def as_policy(policy: NullSpacePolicy | Callable[..., ArrayLike]) -> NullSpacePolicy:
    """Return a policy unchanged, or a function wrapped as a `PolicyFunction`.

    Args:
        policy: A policy; or a function f(q) or f(q, t) of the posture q and the time t [s] that returns a joint
            velocity (nv,) [rad/s or m/s].

    Raises:
        ConfigurationError: The function takes other arguments.
    """
    return policy if isinstance(policy, NullSpacePolicy) else PolicyFunction(policy)


def replace_constraint(policy: NullSpacePolicy, before: Constraint, after: Constraint) -> NullSpacePolicy:
    """Return a copy of a policy that climbs the manipulability of another constraint.

    Args:
        policy: The policy. In a `WeightedPolicies` or a `KeptOrientation`, the policies inside are changed. A policy
            that does not depend on `before` is returned unchanged.
        before: Constraint that the policy climbs now.
        after: Constraint that the copy climbs.
    """
    if isinstance(policy, _Ascent) and policy.constraint is before:
        changed: dict[str, Any] = {"constraint": after}
    elif isinstance(policy, KeptOrientation):
        changed = {"policy": replace_constraint(policy.policy, before, after)}
    elif isinstance(policy, WeightedPolicies):
        changed = {"policies": tuple(replace_constraint(part, before, after) for part in policy.policies)}
    else:
        return policy
    other = copy.copy(policy)
    vars(other).update(changed)
    return other
