"""The control law: equation (2) with damping near singularities, brought within bounds by one quadratic program."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, final

import daqp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dgeqrf, dposv, dtrtrs  # pyright: ignore[reportAttributeAccessIssue]

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability import LEAST_SINGULAR_RATIO, SINGULAR_RATIO, smallest_gradient, svd
from manip_learn.control.barriers import Barrier, approach_bound
from manip_learn.control.command import ACCELERATION, VELOCITY, Command, Posture, Status, Vector, slowed_by
from manip_learn.control.limits import FINE, Bounds, Limits
from manip_learn.control.policies import SEED_SPEED, Decomposition, ManipulabilityAscent, NullSpacePolicy
from manip_learn.control.tasks.point_attractor import Task, VelocityAndJacobian
from manip_learn.errors import ConfigurationError, TargetError, advice
from manip_learn.linalg import Inverse, inverse_singular_values, unit

# [m or 1] velocity of the policy [rad/s] that costs as much as a unit of velocity of the rows, in the program within
# bounds. At a singular value of 0.3 the held rows and the task's direction give way by 1e-7 of the policy's velocity,
# the speed along that direction by 1e-4; of the speed that bounds take from the task, 1e-3 goes off its direction
ACROSS, ALONG = 1e-4, 3e-3
# largest slope, times dt, of a velocity field that explicit steps of dt can follow: from 1 on a step overshoots, and
# the policy's own field adds to the task's
STABLE_SLOPE = 0.5
_ROUNDING = 1e-9  # [rad/s or m/s] rounding error; a joint that the task moves by less does not slow it down
AT_GOAL = 1e-6  # [m/s or rad/s] a task that requests less than this has reached its goal
# a task stalls where less than the first share of the requested velocity is left (a hand that is pressed against a wall
# keeps 1 to 2 % by creeping along it), and is slowed down where less than the second is (the program leaves 1e-4 of it)
STALLED_BELOW, SCALED_BELOW = 0.02, 0.999


@final
class Desired(NamedTuple):
    """Desired velocity of the law at one posture, before joint limits, and the quantities for the quadratic program.

    Attributes:
        A: Matrix (s, nv) of A u = b: the constraint's rows, or the Jacobian of the task's error (see
            `Task.error_jacobian`).
        b: Desired velocity of these rows (s,), in their units per second.
        task: Task part A^# b (nv,) [rad/s or m/s], with the (damped) pseudo-inverse A^# of A.
        null: Part of the policy's velocity in the null space of A (nv,) [rad/s or m/s].
        escape: Part of the policy's velocity along directions that A nearly loses (nv,) [rad/s or m/s]; None away from
            singularities.
        mu: Manipulability of the constraint.
        smallest: Smallest singular value of the constraint.
        basis: Orthonormal basis (k, nv) of the span of A's rows, without directions that A has lost.
        gain: Transposed pseudo-inverse Y (s, nv): A^# b = Y^T b.
        is_damped: True if the law is damped: the constraint's smallest singular value is below the threshold.
        damping: Damping factor lambda of the driven rows; 0 away from singularities.
        bend: Correction c (s,) for the change of A during the step: the rows' mean velocity is A u + c, so that u has
            to satisfy A u = b - c.
        rows: Constraint matrix A(q) (s, nv).
    """

    A: Float[np.ndarray, "s nv"]
    b: Float[np.ndarray, " s"]
    task: Vector
    null: Vector
    escape: Vector | None
    mu: float
    smallest: float
    basis: Float[np.ndarray, "k nv"]
    gain: Float[np.ndarray, "s nv"]
    is_damped: bool = False
    damping: float = 0.0
    bend: Float[np.ndarray, " s"] | float = 0.0
    rows: Any = None

    @property
    def is_lost(self) -> bool:
        """True if A has lost a direction: at a singularity, or, with more rows than joints, if b is not feasible."""
        if self.A.shape[0] > self.A.shape[1]:
            return self.escape is not None and self.progress(self.task) < SCALED_BELOW
        return self.escape is not None and self.smallest <= SINGULAR_RATIO * float(np.abs(self.A).max())

    @property
    def velocity(self) -> Vector:
        """Velocity u* before limits (nv,) [rad/s or m/s]: the sum of task, null-space and escape part."""
        return self.task + self.null + (0.0 if self.escape is None else self.escape)

    def progress(self, u: Vector) -> float:
        """Return the fraction of the requested velocity along b that is achieved, b^T (A u + c) / |b|^2.

        Args:
            u: Joint velocity (nv,) [rad/s or m/s].

        Returns:
            The fraction; 1 where nothing is requested.
        """
        square = float(self.b.dot(self.b))
        return float(self.b.dot(self.A.dot(u) + self.bend)) / square if square > AT_GOAL * AT_GOAL else 1.0

    def status(
        self, progress: float, outside: float, scale: float = 1.0, *, changed: bool, cause: int = -1, fits: bool = True
    ) -> Status:
        """Return the status of a command.

        Args:
            progress: Fraction of the requested velocity along b that is achieved.
            outside: Largest distance of a joint beyond its position limits [rad or m].
            scale: Factor on the task part.
            changed: True if the command differs from u* because of bounds.
            cause: The limit that restricts the command most, POSITION, VELOCITY or ACCELERATION; -1 for a singularity.
            fits: True if the task part alone is within the bounds.
        """
        if outside > 0.0:
            return Status.OUTSIDE_LIMITS
        if self.is_lost:
            return Status.SINGULAR
        if progress < STALLED_BELOW and (self.is_damped or changed) and cause not in (VELOCITY, ACCELERATION):
            return Status.STALLED
        if scale < SCALED_BELOW:
            return slowed_by(cause)
        unchanged = Status.DAMPED if self.is_damped else Status.OK
        return unchanged if self.is_damped or not changed else Status.NULL_SCALED if fits else Status.REROUTED

    def unconstrained_command(self, u: Vector, outside: float) -> Command:
        """Return the command if u* is within the bounds.

        Args:
            u: u* (nv,) [rad/s or m/s], clipped to the bounds to remove rounding errors.
            outside: Largest distance of a joint beyond its position limits [rad or m].
        """
        progress = 1.0 if self.escape is None else self.progress(u)
        parts, status = (self.task, self.null, 1.0, 1.0), self.status(progress, outside, changed=False)
        return Command(u, status, self.mu, self.b, *parts, self.smallest, self.escape, progress, outside)

    def limited_command(self, bounds: Bounds, wish: Vector, u: Vector, cause: int) -> Command:
        """Return the command if u* is not within the bounds.

        Args:
            bounds: The bounds.
            wish: u* (nv,) [rad/s or m/s].
            u: Velocity within the bounds (nv,) [rad/s or m/s].
            cause: Limit that is reported if no joint is at a bound: POSITION, VELOCITY or ACCELERATION; -1 for a
                singularity.
        """
        null_part, escape = u - self.basis.dot(u).dot(self.basis), self.escape
        task_part = u - null_part
        if escape is not None:
            escape = escape * _share(u, escape)
            task_part = task_part - escape
        # a policy at rest has no scale: its null part is rounding only
        null_scale = _share(null_part, self.null) if float(self.null.dot(self.null)) > AT_GOAL**2 else 1.0
        progress = self.progress(u)
        before = 1.0 if self.escape is None else self.progress(self.task)
        scale = min(1.0, max(0.0, progress / before)) if before > 0.0 else 1.0
        joint, limit = bounds.binding(u, wish)
        cause, fits = cause if joint < 0 else limit, bounds.excess(self.task) <= FINE
        status = self.status(progress, bounds.outside, scale, changed=True, cause=cause, fits=fits)
        parts = (task_part, null_part, scale, null_scale)
        return Command(u, status, self.mu, self.b, *parts, self.smallest, escape, progress, bounds.outside, joint)


def _share(part: Vector, whole: Vector) -> float:
    """Return the fraction of a velocity that another one contains, 0 to 1."""
    return min(1.0, max(0.0, float(part.dot(whole)) / max(float(whole.dot(whole)), 1e-300)))


@final
@dataclass(frozen=True, eq=False)
class Law:
    """Control law u = A^+ b + N w, equation (2) of Manavalan and Howard, in three priorities and within limits.

    The task divides the rows of A into held rows and driven rows. With P the projector on the driven ones, and w the
    velocity of the null-space policy, the velocity before bounds is

        u* = argmin |A u - b|^2_{1 / Gamma^2} + |u - w|^2 = w + A^T (A A^T + Gamma^2)^-1 (b - A w),
        Gamma^2 = share^2 lambda^2 (P + h^2 (1 - P)),    share = 1 - (sigma / threshold)^2, 0 above the threshold,
        h = 0.1.

    Above the threshold of the smallest singular value sigma of A, the damping matrix Gamma is 0 and u* is equation (2),
    exactly. Below it, a direction whose singular value is small compared with its damping hardly constrains the motion
    any more, and w moves the arm along it: this is both the damping and the escape from the singularity. (The policy's
    part along such directions is at most 0.2 rad/s; it fades and is 0 above 0.6 times the threshold, so that targets
    there are reached.)

    For an arm in motion, b is understood as the mean velocity of the rows during the step, so that an explicit step of
    dt stays on the path of the task. A u is therefore set to b - c instead of b, with the velocity v of the previous
    step and

        c = (A(q + dt/2 v) - A(q)) v,    |c| <= STABLE_SLOPE sigma |v| / 2.

    If u* is within the bounds it is the command. If not, the part of u* that drives the task is first slowed down for
    the velocity limits, for the allowed rate of approach to a singularity, and so that the joints can brake while the
    hand stays on its constraint (see `_braking_share`); null-space motion cannot replace this. The command is the point
    within the bounds that is nearest to the resulting u*:

        min  |(1 - d d^T) A (u - u*)|^2 / ACROSS^2 + |d^T A (u - u*)|^2 / ALONG^2 + |u - u*|^2
        low <= u <= high,    G u >= least

    where d is the unit vector of the driven part of b. The order of priority is: the hand stays on its constraint and
    keeps its direction, then it keeps its speed, then it follows the policy. Null-space motion makes room for the task
    before the task slows down (Flacco, De Luca and Khatib, "Control of redundant robots under hard joint constraints:
    saturation in the null space", 2015). The rows G bound the approach to a singularity and to walls. The program is
    strictly convex and u* is continuous, so that the command is continuous. It is solved by DAQP (Arnstrom, Bemporad
    and Axehill, "A dual active-set solver for embedded quadratic programming using recursive LDL^T updates", 2022).

    Args:
        constraint: Constraint A(q).
        task: Task b(q, t), and the driven rows.
        null_policy: Null-space policy w(q, t).
        inverse: `"damped"` as above; `"exact"` or `"truncated"`: u* has that inverse and the exact projector.
        threshold: Singular value of A below which damping sets in, in the constraint's units (m or 1).
        damping: Damping factor lambda of the driven rows at a singular value of 0.
    """

    constraint: Constraint
    task: Task
    null_policy: NullSpacePolicy
    inverse: Inverse
    threshold: float
    damping: float

    @property
    def ascends(self) -> bool:
        """True if the policy is a `ManipulabilityAscent` of the law's own constraint."""
        policy = self.null_policy
        return isinstance(policy, ManipulabilityAscent) and policy.constraint is self.constraint

    # ---- before bounds ----------------------------------------------------------------------------------------------

    def desired(self, q: np.ndarray, t: float, dt: float, limits: Limits | None) -> Desired:
        """Return the desired velocity at a posture, before bounds.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
            dt: Step [s].
            limits: Limits; at an exact singularity the arm moves away from the nearer position limits. None for none.

        Raises:
            ConfigurationError: The posture has the wrong size or is not finite, or an exact inverse overflows.
            TargetError: The task's target does not fit the constraint, or a velocity is not finite.
        """
        A = self.constraint(q)
        (b, E), w = self.task_velocity(q, t, dt), self.policy_velocity(q, t, dt)
        rows = A if E is None else E
        (s, nv), decomposition = rows.shape, svd(rows)
        U, sigma, Vt = decomposition
        own_sigma = sigma if E is None else svd(A)[1]
        mu = math.prod(own_sigma.tolist()) if s <= nv else 0.0
        smallest, least = (float(own_sigma[-1]), float(sigma[-1])) if s <= nv else (0.0, 0.0)
        is_damped = self.inverse == "damped"
        is_regular = s <= nv and all(x[-1] > LEAST_SINGULAR_RATIO * x[0] for x in (own_sigma, sigma))
        is_regular = is_regular and not (is_damped and min(smallest, least) < self.threshold)
        if is_regular or not is_damped:
            gains = inverse_singular_values(sigma, rows.shape, "exact" if is_damped else self.inverse)
            V = Vt[: len(sigma)]
            with np.errstate(over="ignore", invalid="ignore"):
                Y = (U[:, : len(sigma)] * gains).dot(V)
                task = b.dot(Y)
            if not math.isfinite(sum(task.tolist())):
                fix = advice("use {}", "inverse='damped'", "--inverse damped")
                words = f"the {self.inverse!r} inverse overflows (smallest singular value {smallest:.1e})"
                raise ConfigurationError(f"{words}: {fix}")
            V = V[gains > 0.0]
            escape = None if is_regular else np.zeros(nv)
            return Desired(rows, b, task, w - V.dot(w).dot(V), escape, mu, smallest, V, Y, rows=A)
        V = Vt[: len(sigma)][sigma > SINGULAR_RATIO * sigma[0]]  # rows that are not lost; the others are rounding only
        share = max(0.0, 1.0 - (least / self.threshold) ** 2)
        # w gets at least SEED_SPEED near a singularity (6e-4 of the threshold), where policies that climb out vanish
        speed, seed = math.sqrt(w.dot(w)), SEED_SPEED * (1.0 - smallest / (6e-4 * self.threshold))
        if 0.0 < speed < seed:
            w = w * (seed / speed)
        if self.ascends and limits is not None and smallest <= SINGULAR_RATIO:
            w = limits.freer_sense(q, w)  # mu rises in both senses there: choose the one that the limits leave free
        square = self._damping(q, decomposition, b, dt)
        D = self.task.driven_rows(self.constraint)
        # h of the class: lambda of held rows over lambda of driven rows, so that the held rows are lost last
        h = 0.1
        Lambda2 = share * share * square * (h * h * unit(s) + (1.0 - h * h) * D.T.dot(D))
        _, Y, failed = dposv(rows.dot(rows.T) + Lambda2, rows)
        if failed:  # A = 0
            Y = np.zeros((s, nv))
        task, free = b.dot(Y), w - rows.dot(w).dot(Y)
        escape = V.dot(free).dot(V)
        null, length = free - escape, math.sqrt(escape.dot(escape))
        fastest = 0.2 * max(0.0, 1.0 - (least / (0.6 * self.threshold)) ** 2) ** 2  # [rad/s]
        if length > fastest:
            escape = escape * (fastest / length)
        damping = share * math.sqrt(square)
        return Desired(rows, b, task, null, escape, mu, smallest, V, Y, smallest < self.threshold, damping, rows=A)

    def bend(self, q: np.ndarray, dt: float, A: np.ndarray, u: np.ndarray) -> Float[np.ndarray, " s"]:
        """Return c = (A(q + dt/2 u) - A(q)) u, the difference of the rows' mean velocity during a step and A(q) u.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            dt: Step [s].
            A: Constraint matrix A(q) (s, nv).
            u: Joint velocity (nv,) [rad/s or m/s].

        Returns:
            shape (s,), in the rows' units per second.
        """
        robot, step = self.constraint.robot, 0.5 * dt * u
        plain = robot is None or (robot.positions_add_up and len(q) == len(u))
        return (self.constraint(q + step if plain or robot is None else robot.integrate(q, step)) - A).dot(u)

    def _with_bend(self, law: Desired, q: np.ndarray, dt: float, u: np.ndarray) -> Desired:
        """Return the law with b as the mean velocity of the rows over the step, see the class.

        A change of the previous u changes the next u by at most 2 |c| / (sigma |u|) times as much: the bound on |c|
        keeps this factor at STABLE_SLOPE or less, so that u settles.
        """
        speed = math.sqrt(u.dot(u))
        if speed == 0.0:
            return law
        c = self.bend(q, dt, law.rows, u)
        size, most = math.sqrt(c.dot(c)), 0.5 * STABLE_SLOPE * law.smallest * speed
        c = c if size <= most else c * (most / size)
        return law._replace(task=law.task - c.dot(law.gain), bend=c)

    def task_velocity(self, q: np.ndarray, t: float, dt: float) -> VelocityAndJacobian:
        """Return the task's velocity b for a step, and the Jacobian E of its error (see `Task.error_jacobian`).

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time at which the step begins [s].
            dt: Step [s].

        Returns:
            b (s,), in the rows' units per second, and E (s, nv), or None if E is A(q).

        Raises:
            TargetError: The task's target does not fit the constraint, or b is not finite.
        """
        sampled = (dt,) if self.task.sampled else ()
        b, E = self.task.velocity_and_jacobian(self.constraint, q, t, *sampled)
        return _checked(b, self.constraint.n_constraints, "the task's velocity b"), E

    def policy_velocity(self, q: np.ndarray, t: float, dt: float) -> Vector:
        """Return the null-space policy's velocity w for a step.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time at which the step begins [s].
            dt: Step [s].

        Returns:
            shape (nv,) [rad/s or m/s].

        Raises:
            TargetError: The policy's velocity has the wrong size, or is not finite.
        """
        return _checked(self.null_policy.over_step(q, t, dt), self.constraint.nv, "the null-space policy's velocity")

    def _damping(self, q: np.ndarray, decomposition: Decomposition, b: np.ndarray, dt: float) -> float:
        """Return lambda^2, larger for a task that presses into a singularity, so that explicit steps of dt can follow.

        At the singularity A^T w / lambda^2, w the part of b along the nearly lost directions, has the slope |d(A^T w) /
        dq| / lambda^2 (in the Frobenius norm), STABLE_SLOPE / dt at most. The measure of pressing is the cosine between
        A^# b and the direction towards the singularity.
        """
        (U, sigma, Vt), square, nv = decomposition, self.damping**2, self.constraint.nv
        is_small = sigma < self.threshold
        if len(U) > nv:  # more rows than joints: the singular vectors of zero singular values are rounding only
            is_small &= sigma > SINGULAR_RATIO * sigma[0]
        lost = U[:, : len(sigma)][:, is_small]
        pressed = lost.dot(b.dot(lost))
        if not pressed.any():
            return square
        rates = self.constraint.value_and_vjp(q)[1]
        pressing = 1.0  # at the singularity itself, where the sense of the task relative to it is unknown
        if sigma[-1] > SINGULAR_RATIO * sigma[0]:
            slope = smallest_gradient(decomposition, rates)
            task = (b.dot(U)[: len(sigma)] * sigma / (sigma * sigma + square)).dot(Vt[: len(sigma)])
            size = math.sqrt(slope.dot(slope) * task.dot(task))
            pressing = -float(slope.dot(task)) / size if size > 0.0 else 0.0
        if pressing <= 0.0:
            return square
        flat = np.concatenate([rates(np.outer(pressed, e)) for e in unit(nv)])
        stable = dt / STABLE_SLOPE * math.sqrt(flat.dot(flat))
        return square + pressing * max(0.0, stable - square)

    # ---- within bounds ----------------------------------------------------------------------------------------------

    def command(
        self, q: np.ndarray, t: float, dt: float, limits: Limits | None, previous: Vector | None, slide: float
    ) -> Command:
        """Return the command at a posture; errors as for `ResolvedRateController`.

        Args:
            q: Configuration (nq,) or joint positions (nv,) as a float64 array [rad or m]; not checked.
            t: Time [s].
            dt: Step [s].
            limits: Limits; None for the command without any limits.
            previous: Velocity of the previous step (nv,) [rad/s or m/s]; None for no limit of the acceleration.
            slide: Share of the task's direction that is given up at limits, 0 to 1 (see `next_slide`).
        """
        law = self.desired(q, t, dt, limits)
        if limits is None:
            return law.unconstrained_command(law.velocity, 0.0)
        if previous is not None:
            law = self._with_bend(law, q, dt, previous)
        wish, bounds = law.velocity, limits.bounds(q, dt, previous)
        barriers, barrier = limits.barriers.at(q, dt, limits.acceleration, previous), self._approach(q, dt, law, limits)
        broken, D = barriers.broken(wish), self.task.driven_rows(self.constraint)
        fits, cause = broken is None and bounds.excess(wish) <= FINE, -1 if broken is None else broken[1]
        fits = fits and (barrier is None or float(barrier[0][0].dot(wish)) >= barrier[1][0])
        rest, drive = _limit_drive(law, D, limits, barrier)
        if previous is not None and 0 < len(D) < len(law.b):
            share = self._braking_share(law, q, D, rest + drive, previous, limits)
            if share < 1.0:
                fits, cause, drive = False, ACCELERATION if cause < 0 else cause, share * drive
        if fits:
            return law.unconstrained_command(bounds.nearest(wish), bounds.outside)
        slowed, W = rest + drive, self._metric(law, D, dt, slide)
        u = barriers.solution(slowed, barrier, lambda rows: nearest_within(slowed, W, bounds, rows))
        return law.limited_command(bounds, wish, u, cause)

    def _metric(self, law: Desired, D: np.ndarray, dt: float, slide: float) -> Float[np.ndarray, "s nv"]:
        """Return W of the program min |W (u - u*)|^2 + |u - u*|^2, see the class.

        With `slide` the task's direction gives way as its speed does, damped as u* is near a singularity, so that
        explicit steps of dt can follow.
        """
        A = law.A
        W = A * (1.0 / ACROSS)
        if len(D):
            along = D.dot(law.b)
            length = math.sqrt(along.dot(along))
            across, speed = ACROSS, math.hypot(ALONG, law.damping)
            if slide > 0.0:
                blur = max(self.damping, math.sqrt(dt / STABLE_SLOPE * math.sqrt(law.b.dot(law.b))))
                across, speed = (x + slide * (blur - x) for x in (across, speed))
                driven = D.dot(A)
                W = W + D.T.dot(driven) * (1.0 / across - 1.0 / ACROSS)
            if length > AT_GOAL:
                d = along.dot(D) * (1.0 / length)
                W = W + np.outer(d, d.dot(A)) * (1.0 / speed - 1.0 / across)
        return W

    def _braking_share(
        self, law: Desired, q: Posture, D: Float[np.ndarray, "d s"], wish: Vector, previous: Vector, limits: Limits
    ) -> float:
        """Return the share of its speed at which the task is driven, so that a braking hand stays on its constraint.

        If all joints brake together, in the time that the slowest needs with its full acceleration, they move straight
        on by T u / 2, T = max_j |u_j| / a_j, while the held rows turn away by

            e(u) = |(1 - P) dA[u] u| T^2 / 8,    P the projector on the driven rows.

        If the curve of the constraint turns faster than the joints can, as while a wrist flips, the hand would leave
        it. With the share, e(u*), which grows with the fourth power of the speed, is at most `most`; and where the
        present motion exceeds that, the task slows down in proportion. |dA[u] u| is at most about |A| |u| sum_j |u_j|.
        """
        # [m or rad] largest deviation from the constraint while the joints brake, half of the deviation that counts as
        # straying. With twice as much 3 of 90 near-singular firm grips stray, by up to 3.4 mm; with this 2, by 2.1 mm
        most = 1e-3
        square, size = max(float(u.dot(u)) for u in (law.velocity, previous)), float((law.A * law.A).sum())
        if math.sqrt(law.A.shape[1] * size) * square * square <= 8.0 * most * float(limits.acceleration.min()) ** 2:
            return 1.0
        (_, vjp), share = self.constraint.value_and_vjp(q), 1.0
        for u, power in ((wish, 0.25), (previous, 1.0)):
            bend = np.array([vjp(np.outer(e, u)) for e in unit(len(law.A))]).dot(u)
            bend = bend - D.T.dot(D.dot(bend))
            deviation = 0.125 * limits.stopping_time(u) ** 2 * math.sqrt(bend.dot(bend))
            if deviation > most:
                share = min(share, (most / deviation) ** power)
        return share

    def _approach(self, q: np.ndarray, dt: float, law: Desired, limits: Limits) -> Barrier | None:
        """Return the bound on the approach to a singularity, where u* could come near it too fast; None elsewhere."""
        if self.inverse != "damped" or law.A.shape[0] > law.A.shape[1] or law.smallest <= SINGULAR_RATIO:
            return None
        u, flat = law.velocity, law.A.reshape(-1)
        if not limits.may_approach(float(u.dot(u)), float(flat.dot(flat)), law.smallest, dt):
            return None
        A, vjp = self.constraint.value_and_vjp(q)  # the rows of the law may be rows of an error
        slope = smallest_gradient(svd(A), vjp)
        bound = approach_bound(law.smallest, slope, limits.acceleration, dt)
        return (slope[None], np.array([-bound])) if bound < math.inf else None


def _limit_drive(law: Desired, D: np.ndarray, limits: Limits, barrier: Barrier | None) -> tuple[Vector, Vector]:
    """Return the rest of u*, and its part that drives the task, scaled to the velocity limits and the singularity's
    barrier.

    Null-space motion makes no room for more. D are the driven rows.
    """
    wish = law.velocity
    drive = (law.b if len(D) == len(law.b) else D.T.dot(D.dot(law.b))).dot(law.gain)
    rest, fastest = wish - drive, float((np.abs(drive) / limits.velocity).max())
    if fastest > 1.0:  # a joint that the rest moves the other way has more room than its limit
        moved = np.abs(drive) > _ROUNDING
        factors = (limits.velocity - np.sign(drive) * rest)[moved] / np.abs(drive)[moved]
        drive = drive * min(1.0, max(1.0 / fastest, float(factors.min())))
    if barrier is not None:
        slope, least = barrier[0][0], float(barrier[1][0])
        toward = -float(slope.dot(drive))
        if toward > 0.0:
            drive = drive * min(1.0, max(0.0, (float(slope.dot(rest)) - least) / toward))
    return rest, drive


def nearest_within(wish: Vector, W: Float[np.ndarray, "s nv"], bounds: Bounds, barrier: Barrier | None) -> Vector:
    """Return the velocity u that minimises |W (u - wish)|^2 + |u - wish|^2 within bounds and, if possible, a barrier.

    The program is solved for z = R (u - wish) with R^T R = 1 + W^T W. Solving it for u would cost eight digits, because
    the condition number of R^T R is the square of R's. The bounds have precedence over the barrier.

    Args:
        wish: Desired velocity (nv,) [rad/s or m/s].
        W: Weights (s, nv) of the deviation u - wish; s may be 0.
        bounds: Bounds on u.
        barrier: Rows G u >= least; None for none.

    Returns:
        shape (nv,) [rad/s or m/s].
    """
    nv = len(wish)
    one, zeros, _ = _constants(nv, nv)
    lowest, highest = bounds.low, bounds.high
    inverse = dtrtrs(dgeqrf(np.concatenate((one, W)))[0][:nv], one)[0]  # R^-1
    for barred in (barrier, None) if barrier is not None else (None,):
        rows, least, most = inverse, lowest - wish, highest - wish
        if barred is not None:
            rows = np.concatenate((inverse, barred[0].dot(inverse)))
            least = np.concatenate((least, barred[1] - barred[0].dot(wish)))
            most = np.concatenate((most, np.full(len(barred[0]), np.inf)))
        sense = _constants(nv, len(most))[2]
        # independent rows differ by at least 1e-8 in this metric, and the tolerance is for a squared sine: with DAQP's
        # default it dropped walls that were feasible within the bounds
        z, _, flag, _ = daqp.solve(one, zeros, rows, most, least, sense, primal_tol=FINE, sing_tol=1e-14)
        if flag == 1:
            u = wish + inverse.dot(z)
            within = np.clip(u, lowest, highest)
            if float(np.abs(within - u).max()) <= _ROUNDING:
                return within
    return np.clip(wish, lowest, highest)


@cache
def _constants(nv: int, rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return identity, zeros and inequalities for DAQP, which takes no read-only array."""
    return np.eye(nv), np.zeros(nv), np.zeros(rows, dtype=np.int32)


def next_slide(slide: float, command: Command, dt: float) -> float:
    """Return the value of `slide` for the next step: the share of its direction that a task gives up at limits.

    The share grows while limits hold the task up. A task that is slowed down to less than half of its speed gives up a
    tenth of its direction in 0.1 s. A task that stalls gives up all of it in 0.25 s, because out of reach the joints
    would oscillate. When the task has more than 90 % of its speed again, the direction is restored within a second; so
    it is when the requested velocity is less than 2 mm/s, because the task has almost arrived and the policy must not
    move the hand away.

    Args:
        slide: Present value, 0 to 1.
        command: The newest command.
        dt: Time for which the command is applied [s].
    """
    requested, some = math.sqrt(command.task_velocity.dot(command.task_velocity)), 0.1
    if requested <= 2e-3 or command.progress > 0.9:
        return max(0.0, slide - max(some, slide) * dt)
    is_slowed = command.status in (Status.SINGULAR, Status.STALLED, Status.POSITION_LIMITED)
    if slide < some and command.progress < 0.5 and is_slowed:
        return min(some, slide + some * dt / 0.1)
    return min(1.0, slide + dt / 0.25) if command.status is Status.STALLED else slide


def _checked(vector: ArrayLike, size: int, what: str) -> Any:
    array = np.asarray(vector, np.float64)
    if array.shape != (size,) or not math.isfinite(sum(array.tolist())):
        raise TargetError(f"{what} must be {size} finite numbers, got {array.tolist()}")
    return array
