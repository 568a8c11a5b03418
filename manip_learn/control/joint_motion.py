"""Motions of the joints in time, within the limits: recorded motions, approaches, and sequences of laws."""

from __future__ import annotations

import math
from functools import partial
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline, CubicSpline, PchipInterpolator

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.other_features import CustomFeatures
from manip_learn.constraint.manipulability import manipulability
from manip_learn.constraint.skill import Gripping
from manip_learn.control.command import Command, LimitedController, Posture, Status, Vector, slowed_by
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.law import nearest_within
from manip_learn.control.limits import RETURN_SPEED, Limits, stopping_speed
from manip_learn.control.rollout import Rollout
from manip_learn.control.tasks import Task
from manip_learn.control.tasks.motion_profile import MotionProfile
from manip_learn.errors import ConfigurationError, counted
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Robot

# [rad or m] norm over all joints at which a posture is reached: the hand is within a millimetre of its goal
ARRIVED = 1e-3


@final
class FollowMotion(LimitedController):
    """Controller for a `ServoLoop` that follows a recorded joint motion as closely as the limits allow.

    First the joints move to the first posture, at a quarter of their velocity limits, and the motion starts there
    (`run` requires an arm that is within 0.05 rad or m of it); at the end they stay at the last posture. Between
    samples the motion is a monotone cubic (F. N. Fritsch and R. E. Carlson, 1980), which adds no overshoot. If the
    motion is faster than the limits of the joints or of the tip's speed, its time runs slower, so that the path stays
    the same.

    A step between two samples that exceeds the velocity limit of its joint is a jump. The joint then keeps its velocity
    until the next sample, and returns to the motion in the shortest time; the other joints do not wait for it.

    Args:
        robot: The robot.
        motion: Recorded motion: a `Trajectory`, a `Rollout`, or an object with their `time`, `q` and `joint_names`.
            Joints are matched by name if it has names, otherwise by their order.
        limits: Limits; by default the robot's. A `ServoLoop` adds its own acceleration and jerk limits.
        ahead: Lag of the loop's output behind this controller, for which the motion compensates [s]. A `ServoLoop` with
            jerk limits sets it to half of its averaging time.

    Attributes:
        duration: Duration of the motion [s].
        jumps: The jumps of each joint, in sentences; also in `ServoLoop.notes`.
        delay: Time by which the motion is behind the recording so far, without the motion to the first posture [s]. A
            loop runs a copy of this controller: read `loop.controller.delay`.

    Raises:
        ConfigurationError: The motion has fewer than two samples, lacks a joint of the robot, has numbers that are not
            finite, or its time does not increase.

    Example:
        >>> import numpy as np
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> time = np.linspace(0.0, 2.0, 21)  # [s]
        >>> shown = ml.Trajectory(time, np.outer(np.sin(time), [0.3, 0.8, 0.4]))
        >>> loop = ml.ServoLoop(ml.FollowMotion(robot, shown), dt=0.01)
        >>> rollout = ml.simulate(robot, loop, shown.q[0], duration=2.5, dt=0.01)
        >>> bool(np.allclose(rollout.q[-1], shown.q[-1], atol=1e-6))
        True
    """

    waits: bool = True  # its clock stops while the arm is at rest

    def __init__(self, robot: Robot, motion: Trajectory | Rollout, limits: Limits | None = None, *, ahead: float = 0.0):
        self.robot, self.motion, self.limits, self.ahead = robot, motion, limits or Limits(robot), float(ahead)
        self._path = path = _Path(robot, motion, self.limits.velocity)
        self.duration, sentences = float(path.time[-1]), list[str]()
        for name, unit, steps in zip(robot.joint_names, robot.joint_units, path.jumps.T, strict=True):
            k, times = int(steps.argmax()), counted(np.count_nonzero(steps), "time")
            farthest = f"at most by {steps[k]:.3g} {unit} at {path.time[k]:.3g} s"
            words = f"joint {name} of the motion jumps {times}, {farthest}: it catches up as fast as its limits let it"
            sentences += [words] if steps[k] > 0.0 else []
        self.jumps = self.notes = tuple(sentences)
        self.reset()

    @property
    def start(self) -> Vector:
        """Joint positions (nv,) at which the motion begins [rad or m]."""
        return self.at(0.0)

    def driven_motions(self, q: Posture) -> Float[np.ndarray, "nv nv"]:
        """Return the motions of the joints that are driven: all.

        Args:
            q: Not used.

        Returns:
            The identity (nv, nv).
        """
        return np.eye(self.robot.nv)

    def with_limits(self, limits: Limits, lag: float = 0.0) -> FollowMotion:
        """Return a copy of this motion with other limits.

        Args:
            limits: `Limits` of the same robot.
            lag: Time by which the output of the loop lags behind this controller [s], for which the motion compensates.
        """
        return FollowMotion(self.robot, self.motion, limits, ahead=lag)

    def reset(self) -> None:
        """Forget previous calls: the next call starts again with the motion to the first posture."""
        self._clock, self._since, self._rate, self.delay = -math.inf, math.inf, 0.0, 0.0

    def at(self, s: float) -> Vector:
        """Return the joint positions of the motion at a time (nv,) [rad or m].

        Args:
            s: Time since the first sample [s].
        """
        return self._path.at(s, 0.0)[0]

    def __call__(
        self, q: Posture, t: float = 0.0, dt: float | None = None, previous: Vector | None = None, slide: float = 0.0
    ) -> Command:
        """Return the command for the next step.

        Args:
            q: Commanded configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
            dt: Length of the step [s]; required, None raises.
            previous: Velocity commanded in the previous step (nv,) [rad/s or m/s]; None for no acceleration limit.
            slide: Not used.

        Returns:
            The command, without a task: its `task_part` is the whole velocity.

        Raises:
            ConfigurationError: dt is missing.
        """
        if dt is None:
            raise ConfigurationError("FollowMotion needs the period: run it in ServoLoop(FollowMotion(...), dt)")
        step, self._since = max(0.0, t - self._since), t
        self._clock += step * self._rate
        if 0.0 <= self._clock < self.duration:
            self.delay += step * (1.0 - self._rate)
        if self._clock < 0.0 and float(np.linalg.norm(self.robot.difference(q, self.start))) < ARRIVED:
            self._clock = 0.0
        limits, self._rate = self.limits, float(self._clock >= 0.0)
        wish, rate = self._wish(q, dt)
        # the clock runs slower to keep the motion within the limits of the joints, and the whole wish within the tip's
        most, frames = float(np.max(np.abs(rate) / limits.velocity, initial=1.0)), limits.barriers
        if (times := max(most, frames.fastest(q, wish) / frames.speed)) > 1.0:
            self._rate /= times
            wish, _ = self._wish(q, dt)
        fastest = limits.velocity * (RETURN_SPEED if self._clock < 0.0 else 1.0)
        wish, bounds = np.clip(wish, -fastest, fastest), limits.bounds(q, dt, previous)
        u, barriers = bounds.nearest(wish), frames.at(q, dt, limits.acceleration, previous)
        if barriers.broken(u) is not None:
            W = np.zeros((0, len(wish)))
            u = barriers.solution(u, None, lambda rows: nearest_within(wish, W, bounds, rows))
        j, cause = bounds.binding(u, wish)
        status = Status.OUTSIDE_LIMITS if bounds.outside > 0.0 else Status.OK if j < 0 else slowed_by(cause)
        return Command.of_joints(u, status, outside=bounds.outside, limiting_joint=j)

    def _wish(self, q: np.ndarray, dt: float) -> tuple[Vector, Vector]:
        """Return the velocity of the motion, with the correction that closes the distance to it in the shortest time,
        and without.
        """
        goal, rate = self._path.at(max(self._clock, 0.0), (self.ahead + dt) * self._rate)
        rate = rate * self._rate
        away = self.robot.difference(q, goal) - dt * rate
        return rate + np.sign(away) * stopping_speed(np.abs(away), self.limits.acceleration, dt), rate

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Return the largest distance of a joint from its present position in the motion [rad or m].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Not used; the controller keeps the time of the motion itself.
        """
        return float(np.max(np.abs(self.robot.difference(q, self.at(max(self._clock, 0.0)))), initial=0.0))

    def __repr__(self) -> str:
        return f"FollowMotion({len(self._path.time)} samples, {self.duration:.4g} s, delayed by {self.delay:.3g} s)"


@final
class _Path:
    """A motion as cubics, each joint in pieces between its jumps.

    Attributes:
        time: shape (T,), of the samples, from 0 [s].
        pieces: shape (4, T, nv), coefficients of the positions after each sample, by powers of the time since then;
            positions of joints without limits continue over whole turns.
        last: shape (T, nv), number of the last sample before the next jump of the joint.
        jumps: shape (T - 1, nv), length of the jump after each sample [rad or m], 0 where there is none.
    """

    def __init__(self, robot: Robot, motion: Trajectory | Rollout, fastest: Vector):
        time, q = np.array(motion.time, dtype=np.float64), np.array(motion.q, dtype=np.float64)
        names = tuple(motion.joint_names)
        if names not in ((), robot.joint_names):
            missing = ", ".join(name for name in robot.joint_names if name not in names)
            if missing or q.shape[1:] != (len(names),):
                raise ConfigurationError(f"the motion has joints {', '.join(names)}: {robot.name!r} also has {missing}")
            q = q[:, [names.index(name) for name in robot.joint_names]]
        if not (len(q) == len(time) >= 2 and np.all(np.isfinite(time)) and np.all(np.diff(time) > 0.0)):
            requirement = f"a motion has two or more samples at increasing, finite times and {robot.nv} joints"
            raise ConfigurationError(f"{requirement}; got times of shape {time.shape} and positions of shape {q.shape}")
        # without whole turns between samples
        ways = map(robot.difference, q[:-1], q[1:])
        self.time, x = time - time[0], np.cumsum([robot.positions(q[0]), *ways], axis=0)
        steps = np.abs(np.diff(x, axis=0))
        self.jumps = np.where(steps > fastest * np.diff(time)[:, None], steps, 0.0)
        slope, self.last = np.zeros_like(x), np.empty(x.shape, dtype=np.int64)
        for j in range(robot.nv):
            for part in np.split(np.arange(len(time)), np.flatnonzero(self.jumps[:, j]) + 1):
                self.last[part, j] = part[-1]
                if len(part) > 1:
                    slope[part, j] = PchipInterpolator(time[part], x[part, j]).derivative()(time[part])
        slope[-1], self.pieces = 0.0, np.zeros((4, *x.shape))
        self.pieces[:2] = x, slope
        # without curvature a joint that jumps continues along the tangent, and stays at the end
        self.pieces[2:, :-1] = CubicHermiteSpline(time, x, slope).c[1::-1] * (self.jumps == 0.0)

    def at(self, s: float, ahead: float) -> tuple[Vector, Vector]:
        """Return the positions and the velocity of the motion a little later than a time.

        A jump in between is not anticipated: the joint continues along its tangent.

        Args:
            s: Time since the first sample, which selects the piece of each joint [s].
            ahead: Time after that [s].
        """
        now, then = np.maximum(np.searchsorted(self.time, (s, s + ahead), side="right") - 1, 0)
        piece = np.minimum(then, self.last[now])
        (x, v, c, d), since = self.pieces[:, piece, np.arange(len(piece))], s + ahead - self.time[piece]
        return x + since * (v + since * (c + since * d)), v + since * (2.0 * c + 3.0 * since * d)


def every_joint(robot: Robot) -> Constraint:
    """Return the constraint A(q) = I (nv, nv), with one row for the velocity of each joint.

    Args:
        robot: The robot.
    """
    one, rates = np.eye(robot.nv), partial(_constant, np.zeros((robot.nv,) * 3))
    return Constraint(one, CustomFeatures(partial(_constant, one), robot.joint_names, derivative=rates, robot=robot))


def _constant(value: np.ndarray, _q: np.ndarray) -> np.ndarray:
    return value  # a function at module level can be pickled


@final
class JointMotion(Task):
    """Task for a joint motion from posture to posture, at rest in each of them, or smooth through all of them.

    The task's velocity is b = dq*/dt + gain (q*(t) - q), with the planned positions q*(t) and the constraint
    `every_joint`. The motion begins at time 0; a `LawSequence` starts each of its laws at time 0. Each leg, the motion
    between two postures, takes the time that its slowest joint needs, or longer if the speed of the tip is limited.

    Args:
        limits: Limits of the robot's joints and tip.
        path: shape (k, nv), postures as joint positions [rad or m], the start first.
        share: Largest used share of the joints' velocity limits, 0 to 1.
        gripper: Gripper action during the motion, `"close"` or `"open"`: the motion then takes half a second or more.
            None for no action.
        through: True for a single leg, a spline through all postures; False for a straight leg between each two.

    Attributes:
        start: shape (nv,), the first posture [rad or m].
        duration: Planned duration within `limits` and `share` [s]; the arm arrives later if the controller slows it
            down further.
        gain: Rate at which deviations are corrected, 10/s.

    Raises:
        ConfigurationError: Postures that are not finite or have the wrong size.
    """

    is_approach, waits, slides = True, True, False
    gain = 10.0  # [1/s] rate at which deviations are corrected, as for a `FreeDirection`

    def __init__(
        self, limits: Limits, path: ArrayLike, share: float = 1, gripper: Gripping | None = None, through: bool = False
    ):
        self._robot, table = limits.robot, np.array(limits.robot.checked_postures(path))
        self.gripper: Gripping | None = gripper
        table = table[np.append(True, np.any(np.diff(table, axis=0) != 0.0, axis=1))]  # without repeated postures
        legs = [table][: len(table) - 1] if through else [table[i : i + 2] for i in range(len(table) - 1)]
        self._legs = [_leg(limits, leg, share) for leg in legs]
        self._ends = np.cumsum([profile.duration for _, profile in self._legs])
        # half a second for a gripper to close or to open
        self.duration = max([0.5 if gripper else 0.0, *self._ends.tolist()])
        self.start, self._last = table[0], table[-1]

    def at(self, t: float) -> tuple[Vector, Vector]:
        """Return the planned joint positions (nv,) [rad or m] and velocities (nv,) [rad/s or m/s] at a time.

        Args:
            t: Time since the start [s].
        """
        leg = int(np.searchsorted(self._ends, t))
        if leg == len(self._legs):
            return self._last, np.zeros_like(self._last)
        path, profile = self._legs[leg]
        share, rate = profile.at(t - float(self._ends[leg]) + profile.duration)
        return path(share), rate * path(share, 1)

    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Vector:
        """Return the task's velocity b, one entry per joint, shape (nv,) [rad/s or m/s].

        Args:
            constraint: Not used; `every_joint` is assumed.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time since the start [s].
        """
        goal, rate = self.at(t)
        return rate + self.gain * self._robot.difference(q, goal)

    def is_over(self, q: ArrayLike, t: float) -> bool:
        """Return True if `duration` has passed and the arm is at the last posture, or a second later in any case.

        Encoder noise may hide the arrival, therefore the second.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time since the start [s].
        """
        late, off = t - self.duration, self._robot.difference(np.asarray(q, dtype=np.float64), self._last)
        return late >= 0.0 and (late >= 1.0 or float(np.linalg.norm(off)) < ARRIVED)

    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Return the distance of the joints from the last posture [rad or m], the Euclidean norm over all joints.

        Args:
            constraint: Not used.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Not used.
        """
        return float(np.linalg.norm(self._robot.difference(q, self._last)))

    def goal(self) -> Vector:
        """Return the last posture as joint positions (nv,) [rad or m]."""
        return self._last.copy()

    def __repr__(self) -> str:
        return f"JointMotion({len(self._legs)} legs, {self.duration:.3g} s)"


def _leg(limits: Limits, knots: Float[np.ndarray, "k nv"], share: float) -> tuple[CubicSpline, MotionProfile]:
    """Return a path through postures, and the progress along it in time."""
    robot, tip = limits.robot, limits.barriers

    def time_at_full_speed(q: np.ndarray, rates: np.ndarray) -> Posture:
        """Return the time that each joint motion takes at a posture, at full speed [s].

        Args:
            q: Postures (k, nv) as joint positions [rad or m].
            rates: Joint motions (k, nv) there, per unit of the path [rad or m].
        """
        times = np.max(np.abs(rates) / (share * limits.velocity), axis=1)
        fastest = [tip.fastest(robot.configuration(x), d) for x, d in zip(q, rates, strict=True)]
        return np.maximum(times, np.array(fastest) / tip.pace)

    steps = np.diff(knots, axis=0)
    times = np.append(0.0, np.cumsum(time_at_full_speed(knots[:-1] + 0.5 * steps, steps)))
    path = CubicSpline(times / times[-1], knots, bc_type="natural")
    fine = np.linspace(0.0, 1.0, 8 * max(4, len(steps)) + 1)  # between these points the law keeps the limits
    # half a second from rest to the speed, as for a `FreeDirection`
    return path, MotionProfile(1.0, 1.0 / float(np.max(time_at_full_speed(path(fine), path(fine, 1)))), 0.5)


@final
class LawSequence(LimitedController):
    """Controller that runs several `ResolvedRateController`s (laws) one after another.

    The laws are joint motions to a posture (`JointMotion`), and motions along free directions of a constraint. The
    sequence starts with the first call. It starts again if a later call has a time at or before that of the first one.
    The next law follows when a joint motion has arrived, or when a motion along a free direction is complete; if that
    motion cannot be completed, its law stays active.

    Args:
        laws: The laws, in order; the last one stays active at its end.

    Attributes:
        laws: The laws.
        robot: The robot of all laws.
        limits: Limits of the first law; a `ServoLoop` sets its limits for all laws.
        number: Index of the active law, from 0.
        began: Time at which the active law started [s]; None before the first call.
    """

    def __init__(self, *laws: ResolvedRateController):
        self.laws, self.robot, self.limits = laws, laws[-1].robot, laws[0].limits
        self.reset()

    def reset(self) -> None:
        """Forget previous calls: the next call starts the first law again."""
        self.number, self.began = 0, None
        self._first, self._latest = math.inf, -math.inf  # times of calls [s]
        super().reset()

    @property
    def gripper(self) -> Gripping | None:
        """The latest gripper action up to now, `"close"` or `"open"`; None if there was none yet."""
        return next((law.task.gripper for law in reversed(self.laws[: self.number + 1]) if law.task.gripper), None)

    @property
    def law(self) -> ResolvedRateController:
        """The active law."""
        return self.laws[self.number]

    @property
    def constraint(self) -> Constraint:
        """Constraint of `way`."""
        return self.way.constraint

    @property
    def way(self) -> ResolvedRateController:
        """The active law; during a joint motion the next law that is not a joint motion, or the last one if none is."""
        ahead = self.laws[self.number :]
        return next((law for law in ahead if not law.task.is_approach), ahead[-1])

    def __call__(
        self, q: ArrayLike, t: float = 0.0, dt: float | None = None, previous: Vector | None = None, slide: float = 0.0
    ) -> Command:
        """Return the command of the active law; arguments and errors as for `ResolvedRateController`.

        The command's manipulability is always the one of `constraint`, also during joint motions.
        """
        if t <= self._first < self._latest:
            self.reset()
        self._first, self._latest = min(self._first, t), t
        self.began = t if self.began is None else self.began
        if self.number + 1 < len(self.laws) and self.law.task.is_over(q, t - self.began):
            self.number, self.began = self.number + 1, t
        law, way = self.law, self.way
        command = law(q, t - self.began, dt, previous, slide)
        return command if law is way else command._replace(manipulability=manipulability(way.constraint, q))

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Return the distance to the goal of the active law [m or rad].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time on the clock of the calls [s].
        """
        return self.law.task_error(q, t - (self.began or 0.0))

    def with_limits(self, limits: Limits, lag: float = 0.0) -> LawSequence:
        """Return a copy of this sequence with other limits.

        Args:
            limits: `Limits` of the same robot.
            lag: Ignored: this controller does not compensate for a lag.
        """
        return LawSequence(*(law.with_limits(limits) for law in self.laws))

    def __repr__(self) -> str:
        return f"LawSequence({', '.join(repr(law.task) for law in self.laws)})"
