"""The loop that a real-time program calls: a controller, its state and its periods in time, and what stops it."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.command import Command, Controller, LimitedController, Status
from manip_learn.control.controller import BoundedController
from manip_learn.control.following import LEFT, Contact, FollowingError
from manip_learn.control.law import next_slide
from manip_learn.control.limits import Bounds, Limits, bound_changes, farthest_positions, stopping_speed
from manip_learn.control.reading import Readings
from manip_learn.control.tasks import PointAttractor, Task
from manip_learn.control.timing import Timing, VelocityAverage, in_milliseconds, time_of
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

_LOGGER = logging.getLogger("manip_learn")
UNLOADING_RATE = 25.0  # [1/s] rate at which an arm that was blocked lets go: from 60 N to 3 N in 0.12 s
RELOOK, _NEAR = 0.01, 5e-4  # [s] beside its delay after which an arm that lets go is looked at again, [rad or m]
_SETTLED = 0.05  # [s] after which an arm that was let go stands
RENEWALS = 10  # times that an arm goes on letting go where more is left
# [rad or m] of letting go after which it shows, and share of it by which an arm that carries a weight comes along
_SHOWS, _FOLLOWS = 2e-3, 0.9
# [rad/s or m/s] speed below which it does not fall on the way, and [rad or m] distance at which it has arrived
_SLOWEST, _ARRIVED = 1e-3, 1e-9
BEYOND_TAUGHT = 1.5  # times the force that a way took when it was taught: it may stick more another time
# arguments that are gone, and what to give instead
_REMOVED = {
    **dict.fromkeys(("latency", "stiffness"), ": give contact=Contact({}={!r})"),
    "following_error_limit": ": give contact=Contact(stiffness=...), forces on the hand stop the arm",
    "correction_time": ": load the robot with its payload, robot.with_payload(...)",
}
STANDING = (Status.INVALID_INPUT, Status.STALE, Status.FOLLOWING_ERROR, Status.STOPPED)


@final
class Return(NamedTuple):
    """The way of a commanded posture back to a measured one, within the velocity and acceleration limits.

    Attributes:
        limits: The limits.
        posture: Where a position servo is sent.
        load: Distance at which a weight keeps the arm from where it is sent [rad or m].
        goal: Where it goes: where the arm was first measured, less its load; a newer reading has other noise.
        speed: Share of the acceleration limits, times s, with which it moves [s].
    """

    limits: Limits
    posture: Float[np.ndarray, " n"]
    load: Float[np.ndarray, " nv"]
    goal: Float[np.ndarray, " n"] | None = None
    speed: float = 0.0

    def step(self, measured: Float[np.ndarray, " n"], dt: float) -> Return | None:
        """One period farther; None where the way ends.

        All joints move along the straight way, faster by at most an acceleration for dt, and as fast as lets them stop
        (`stopping_speed`).
        """
        limits = self.limits
        goal = limits.robot.integrate(measured, -self.load) if self.goal is None else self.goal
        away = limits.robot.difference(self.posture, goal)
        acceleration = np.minimum(limits.acceleration, 1e6)
        far = float(np.max(np.abs(away) / acceleration))  # [s^2] at unit acceleration
        if far <= 0.5 * dt * dt:
            return None
        direction = away / far
        fastest = float(np.min(limits.velocity / np.maximum(np.abs(direction), 1e-12)))
        stopping = float(stopping_speed(np.array([far]), np.ones(1), dt)[0])
        speed = min(self.speed + dt, stopping, fastest, far / dt)
        posture = limits.robot.integrate(self.posture, dt * speed * direction)
        return self._replace(posture=posture, goal=goal, speed=speed)


@final
class ServoLoop:
    """A controller as a real-time program calls it, once per period, e.g. at 1 kHz.

    In a program::

        loop = ServoLoop(controller, dt=0.001)
        while running:
            command = loop.update(measured_q, t)      # never raises
            robot.send(command.velocity)              # or loop.position, to a position servo

    The velocity starts from rest and changes within the acceleration limits, and within the jerk limits if there are
    any. The controller runs on the commanded posture, which is the integral of the commands; the measured one is
    compared with it. Encoder noise and latency are therefore not fed back, and a servo that follows late does not make
    the loop unstable.

    The arm brakes within the acceleration limits and stands while there is a reason to: input that is no posture or no
    time (`Status.INVALID_INPUT`), a state that has not been new for `stale_after` (`Status.STALE`), a call of `stop`
    (`Status.STOPPED`). It starts again by itself when the reason is gone. Where the measured posture says that the arm
    is blocked (a collision, a jammed drawer, a servo that is off), it brakes without regard to the jerk limits, lets
    go by going slowly to where it was measured when that was found, and stands until `reset` is called
    (`Status.FOLLOWING_ERROR`); `stopped_by` says which row of the constraint was blocked, and by how much.

    Args:
        controller: A `ResolvedRateController`, or any `(q, t, dt) -> Command`.
        dt: Period [s].
        acceleration_limit: shape (nv,) or a number [rad/s2 or m/s2]; by default those of the controller's `Limits`.
        jerk_limit: shape (nv,) or a number [rad/s3 or m/s3]; by default those of the controller's `Limits`, or none.
            The commands are averaged over 2 max_j(a_j / jerk_j), which delays them by half of that time.
        stale_after: Time without a new state after which the arm brakes [s].
        contact: Which forces on the hand stop the arm, and what is known of its servos (`Contact`).
        robot: Whose limits count; the controller's own by default.
        limits: Limits of a controller of your own; by default those of the controller, or of the robot.

    Attributes:
        limits: The limits in force.
        acceleration_limit: shape (nv,) [rad/s2 or m/s2], in force.
        jerk_limit: shape (nv,) [rad/s3 or m/s3], in force, or None.
        dt: [s].
        measured: shape (n,), the newest measured posture that was one; None before the first.
        lets_go: Whether the arm is letting go of what blocked it.
        stopped_by: What last stopped the arm, in words; None where nothing has.

    Raises:
        ConfigurationError: A setting that is not positive, or a controller that has no robot where none is given.
        TypeError: An argument that there is not; of one that is gone it says what to give instead.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
        >>> controller = ml.ResolvedRateController(constraint, ml.PointAttractor([1.0, 1.5]))
        >>> loop = ml.ServoLoop(controller, dt=0.001)
        >>> for k in range(1000):  # one second
        ...     measured = loop.position if k else [0.3, 0.8, 0.4]  # your arm's encoders
        ...     command = loop.update(measured, 0.001 * k)
        >>> command.status  # it never raises: a status says what is wrong
        <Status.OK: 'ok'>
    """

    def __init__(
        self,
        controller: Controller,
        dt: float = 0.001,
        acceleration_limit: ArrayLike | None = None,
        jerk_limit: ArrayLike | None = None,
        stale_after: float = 0.1,
        *,
        contact: Contact | None = None,
        robot: Robot | None = None,
        limits: Limits | None = None,
        **removed: Any,
    ):
        for name, value in removed.items():
            raise TypeError(f"ServoLoop has no argument {name!r}{_REMOVED.get(name, '').format(name, value)}")
        for name, value in (("dt", dt), ("stale_after", stale_after)):
            if not 0.0 < time_of(value) < math.inf:
                raise ConfigurationError(f"{name} must be a positive number of seconds, got {value!r}")
        if not dt < stale_after:
            raise ConfigurationError(
                f"a state is stale after {stale_after:g} s and the period is {dt:g} s: give stale_after={3.0 * dt:g}"
            )
        own = robot or getattr(controller, "robot", None)
        if not isinstance(own, Robot):
            raise ConfigurationError("the controller has no robot whose limits count: ServoLoop(..., robot=robot)")
        self.robot, self.dt, self.stale_after = own, float(dt), float(stale_after)
        within = controller if isinstance(controller, LimitedController) else BoundedController(controller, Limits(own))
        given: Limits = limits or within.limits or Limits(own)
        self.limits = limits = given.with_rates(acceleration_limit, jerk_limit)
        self.acceleration_limit, self.jerk_limit = limits.acceleration, limits.jerk
        average = VelocityAverage.at_rest(limits, self.dt)
        self._within = within.with_limits(limits, 0.0 if average is None else 0.5 * average.time)
        self.controller = self._within if within is controller else controller
        self.contact = contact = contact or Contact()
        if contact.max_axial_force == "auto" and (force := self._within.taught_force) is not None:
            self.contact = replace(contact, max_axial_force=max(contact.max_lateral_force, BEYOND_TAUGHT * force))
        # an arm that presses brakes and lets go as hard as it can, however gently it was to move
        self._hard = self.limits.with_rates(np.maximum(self.limits.acceleration, Limits(own).acceleration), None)
        self._following = FollowingError(own, self.contact, self.dt, self._hard.acceleration, self._within.frame)
        self._readings = Readings(own, farthest_positions(own))
        self._timing = Timing.begin(self.dt, self.stale_after)
        self._slowed = 1.0, self.limits  # a share of the acceleration, and the limits with it
        self._return: Return | None = None
        self.reset()

    def reset(self, q: ArrayLike | None = None) -> None:
        """Stand still and forget the past, after a following error or before another motion.

        After a following error `position` first goes back to the measured posture within the velocity and acceleration
        limits, while the commanded velocity is zero and the status stays `Status.FOLLOWING_ERROR`.

        Args:
            q: Posture to start from, that at which the servos hold the arm; None takes the next measured one, with
                the noise of its encoders.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        nv = self.robot.nv
        # a position servo holds the arm there still
        if q is not None or self._following.tripped:
            sent = None if q is not None else self.position
            self._return = None if sent is None else Return(self.limits, sent, self._following.load)
        # where the controller is, and where the arm is sent: the same but for the average
        self._reference = self._output = None if q is None else np.array(self.robot.checked_posture(q))
        self._velocity, self._sent = np.zeros(nv), np.zeros(nv)
        self._average = VelocityAverage.at_rest(self.limits, self.dt)
        self._following.forget()
        self._relief: np.ndarray | None = None  # posture to go to after a following error
        self.measured, self.stopped_by = None, None
        # for how long readings have come that no joint can have moved to, and what was said of the last one: from
        # `stale_after` on they are believed
        self._refused, self._jumped = 0.0, ("", -math.inf)
        self._timing = self._timing.again()
        self._runs_on = False  # whether the arm goes on between late calls, as a velocity servo does
        self._alone = self._output is None  # a posture starts from the first reading, and no other has been near it
        self._stopping = self.lets_go = self._hangs = False
        self._slide = 0.0
        self._last: Command | None = None
        self._within.reset()

    def stop(self) -> None:
        """Brake and stand until `start` is called."""
        self._stopping = True

    def start(self) -> None:
        """Move again after `stop`."""
        self._stopping = False

    def set_task(self, task: Task) -> None:
        """Another task, in motion: the velocity goes over into that of the new task within the acceleration limits.

        A `ManipulabilityAscent` of the rows driven so far climbs those driven from now on.

        Raises:
            ConfigurationError: The controller is no `ResolvedRateController`.
            ManipLearnError: The task does not fit the constraint.
        """
        self._exchange(task, None)

    def set_target(self, target: ArrayLike) -> None:
        """Another target of a `PointAttractor`, in motion, as for `set_task`.

        Raises:
            ConfigurationError: The task is another one.
            TargetError: The target does not fit the constraint.
        """
        task = None if self._within.law is None else self._within.law.task
        if type(task) is not PointAttractor:
            raise ConfigurationError(f"only a PointAttractor has a target that can be set, the task is {task!r}")
        self._exchange(PointAttractor(target, task.gain, task.max_speed, driven=task.driven), None)

    def set_constraint(self, constraint: Constraint) -> None:
        """Another constraint for the same task, in motion, as for `set_task`.

        Raises:
            ConfigurationError: The controller is no `ResolvedRateController`.
            ManipLearnError: The task does not fit the constraint, or it belongs to another robot.
        """
        self._exchange(None, constraint)

    def _exchange(self, task: Task | None, constraint: Constraint | None) -> None:
        """Go on with another task or another constraint from the posture and the velocity of now."""
        law = self._within.law
        if law is None:
            kind = type(self.controller).__name__
            raise ConfigurationError(f"only a ResolvedRateController takes another task, not {kind}")
        if constraint is not None and constraint.robot is not law.learnt.robot:
            raise ConfigurationError("the constraint belongs to another robot than that of the loop")
        law = law.with_task(law.task if task is None else task, law.learnt if constraint is None else constraint)
        if self._reference is not None:
            law(self._reference, 0.0, self.dt)  # what does not fit is refused while the old law is still there
            law.task.reset()
        self.controller = self._within = law.with_limits(self.limits)
        self._slide, self._timing = 0.0, self._timing._replace(waited=0.0)

    @property
    def silent(self) -> float:
        """Time in which no state has come that was one and new [s]."""
        return self._timing.silent

    @property
    def begins(self) -> Float[np.ndarray, " nv"] | None:
        """Joint positions at which the motion of the controller begins [rad or m]; None if it begins anywhere."""
        return self._within.start

    @property
    def yields(self) -> Float[np.ndarray, " nv"]:
        """By how much servos give way to the largest force that is allowed, shape (nv,) [rad or m]."""
        return self._following.farthest()

    @property
    def notes(self) -> tuple[str, ...]:
        """What is known of the arm and of the motion, in sentences: how late it follows, which forces are seen."""
        return (*self._following.notes, *self._within.notes)

    @property
    def position(self) -> Float[np.ndarray, " n"] | None:
        """The commanded posture at the end of the period, for a position servo; None before the first state.

        From one call to the next it moves by no more than the velocity limits allow in `dt`, or in the time between
        the calls where that is shorter: after a gap, a position servo goes on from where it stands.
        """
        sent = self._output if self._return is None else self._return.posture
        return None if sent is None else sent.copy()

    def update(self, q: Any, t: Any) -> Command:
        """The command of the next period. Never raises.

        Args:
            q: Measured posture: a configuration or joint positions.
            t: Time at which it was measured [s].

        Returns:
            A command whose velocity is finite and within the limits, and whose status names what stops the arm.
        """
        try:
            return self.step(q, t)
        except Exception:  # whatever goes wrong in a task or a policy of the user's own, an arm in motion must brake
            return self._braked(Status.INVALID_INPUT)

    def step(self, q: ArrayLike, t: float) -> Command:
        """The command of the next period, as `update` gives it; errors of controller, task and policy are raised.

        Raises:
            ManipLearnError: What the controller raises.
        """
        measured, time, timing = self._readings.posture(q), time_of(t), self._timing
        timing = timing if measured is None else timing.ordered(time)
        if measured is None or not time >= timing.time:
            self._timing = timing.without(math.nan if measured is None else time)
            self.stopped_by = self._readings.refusal(q) if measured is None else f"no time: {t!r:.40}"
            return self._braked(Status.INVALID_INPUT)
        jump = self._readings.jump(self.measured, measured, max(self.dt, time - timing.time))
        if jump and self._refused <= self.stale_after:
            if self._alone:  # a first reading that the second one is not near: nothing starts from it
                stopping = self._stopping
                self.reset()
                self._stopping, timing = stopping, self._timing._replace(time=time)
                self.measured = self._reference = self._output = measured
            self._timing = timing.without(timing.older)
            self._refused += self.dt
            self.stopped_by, self._jumped = jump, (jump, time)
            return self._braked(Status.INVALID_INPUT)
        self._refused, self._alone = 0.0, self._alone and self.measured is None
        self.measured = measured
        stood = self._last is None or self._last.status in STANDING
        self._timing, told = timing.accept(time, stood), timing.warning
        timing = self._timing
        if timing.warning != told:
            _LOGGER.warning(timing.warning)
        if timing.late and not timing.is_stale:
            self._catch_up(measured, stood)
        period = timing.held
        if self._reference is None or self._output is None:
            self._reference = self._output = measured
        if self._return is not None:
            sent, self._return = self._return.posture, self._return.step(measured, period)
            self._reference = self._output = sent
            return self._braked(Status.FOLLOWING_ERROR, period)
        if timing.silent == 0.0:  # a state that is not new says nothing of the commands since
            known = len(self._following.notes)
            self._following.compare(self._output, measured, self._within.driven_motions)
            for note in self._following.notes[known:]:
                _LOGGER.warning(note)
        if self._following.tripped:
            # the average would go on pressing for its own length
            self._reference, self._velocity = self._output, self._sent
            return self._unloading(self._output, measured, period)
        if timing.is_stale:
            self.stopped_by = f"no new state for more than {1e3 * self.stale_after:g} ms"
            if in_milliseconds(timing.since, self.dt):
                self.stopped_by += f"; the time went on by {timing.since:g}, in milliseconds? It is to be in seconds"
            return self._braked(Status.STALE, period)
        if self._stopping:
            return self._braked(Status.STOPPED, period)
        if timing.silent > 0.0 and self._last is not None:
            last = self._last  # goes on, as long as that stays within the limits
            if last.status in STANDING:
                return self._braked(last.status)
            bounds = self._bounds(self._reference, self.dt)
            if bounds.admit(self._velocity):
                return self._sent_on(last._replace(velocity=self._velocity))
            slower = np.clip(self._velocity, bounds.low, bounds.high)
            return self._sent_on(last._replace(velocity=slower, status=Status.POSITION_LIMITED))
        return self._sent_on(self._command(self._reference, self._clock(time), period), period)

    def _catch_up(self, measured: Float[np.ndarray, " n"], stood: bool) -> None:
        """Take the motion that the arm made because a call was late, or did not because it was early.

        A velocity servo goes on moving until the next command comes, a position servo stands where it was sent: the
        share of the motion that the last velocity makes in this time which the arm has made tells them apart.
        """
        timing, followed, square = self._timing, 0.0, float(self._sent.dot(self._sent))
        if self._output is not None and square > 0.0 and not self._following.tripped:
            away = self.robot.difference(self._output, measured)
            followed = min(1.0, max(0.0, float(away.dot(self._sent)) / (timing.late * square)))
        self._runs_on = self._runs_on or (timing.late > 0.0 and followed > 0.5)
        # an early call takes back no more than it goes on by: the posture never moves against the velocity
        moved = max(timing.late, -timing.since) * followed
        self._advance(moved, self._sent)
        waited = timing.waited - (0.0 if stood else moved)
        self._timing = self._timing._replace(commanded=0.0, waited=waited)

    def _clock(self, time: float) -> float:
        """Time for the controller: that of the state, less that for which a task that waits for the arm has waited."""
        return time - self._timing.waited if self._within.waits else time

    def _bounds(self, q: np.ndarray, held: float) -> Bounds:
        """Bounds on the velocity that follows; where periods vary, a joint can stop however late the calls are.

        In a call that is late by a time T, a velocity servo brakes by a dt only: the deceleration is a dt / T.
        """
        if self._timing.is_regular:
            return self.limits.bounds(q, held, self._velocity)
        return bound_changes(
            self._careful(q, self._timing.longest), self._velocity, self.limits.acceleration.tolist(), held
        )

    def _careful(self, q: np.ndarray, late: float) -> Bounds:
        """Bounds from which a joint stops however late the calls are, without those of its acceleration."""
        share = self._timing.usual / late
        if share != self._slowed[0]:
            self._slowed = share, self.limits.with_rates(share * self.limits.acceleration, None)
        return self._slowed[1].bounds(q, late, None)

    def _command(self, q: np.ndarray, time: float, held: float) -> Command:
        """The controller's command, within the limits and clear of what stands around; else the arm brakes.

        Where it would come to rest if it braked was clear one step before.
        """
        command, tip = self._within_limits(q, time, held), self.limits.tip
        if tip is None or tip.clear is None:
            return command
        clear = tip.clear_at(q, held, self.limits.acceleration, self._velocity)
        if clear is not None and not tip.clear.was_clear(q, command.velocity) and clear(command.velocity) is not None:
            command = _held_back(command, self._braking(held))._replace(limiting_joint=-1)
        if command.limiting_joint < 0 and command.status in (Status.POSITION_LIMITED, Status.STALLED):
            self.stopped_by = tip.clear.words() or self.stopped_by
        return command

    def _within_limits(self, q: np.ndarray, time: float, held: float) -> Command:
        """The controller's command, within the limits."""
        command = self._within(q, time, held, self._velocity, self._slide)
        self._slide = next_slide(self._slide, command, held)
        if self._timing.is_regular or (bounds := self._bounds(q, held)).admit(command.velocity):
            return command
        return _held_back(command, np.clip(command.velocity, bounds.low, bounds.high))

    def _braked(self, status: Status, held: float | None = None) -> Command:
        """The arm brakes along the motion it was in, as hard as the acceleration limits allow in a time [s]."""
        dt = self.dt if held is None else held
        return self._beside_the_law(self._braking(dt), status, dt)

    def _braking(self, dt: float) -> np.ndarray:
        """The velocity with which the arm brakes for a time [s]."""
        u = self._velocity
        hardest = float(np.max(np.abs(u) / (self.limits.acceleration * dt), initial=0.0))
        if np.all(np.isfinite(self.limits.acceleration)):
            u = u * max(0.0, 1.0 - 1.0 / hardest) if hardest > 0.0 else u
        else:  # a joint that stops at once waits for none that cannot
            u = np.sign(u) * np.maximum(np.abs(u) - self.limits.acceleration * dt, 0.0)
        if hardest > 0.0 and self._reference is not None:
            bounds = self._bounds(self._reference, dt)
            # slower towards a limit, but at rest outside one
            u = np.clip(u, np.minimum(bounds.low, 0.0), np.maximum(bounds.high, 0.0))
        return u

    def _unloading(self, commanded: np.ndarray, measured: np.ndarray, held: float) -> Command:
        """The arm lets go of what blocks it: it goes to where it was measured when that was found, and on until it has.

        What it was pressed by comes back with the arm, so that the first measurement does not say how far to go.
        """
        following = self._following
        if self._relief is None:
            self._pressed, self._renewed, self._rested = (commanded, measured, following.farthest()), 0, 0.0
            self._moved, self._payload = self._velocity, following.carry(following.servos.at_rest, measured)
            self._relief, self.lets_go = self._let_go(commanded), True
            self._name_cause(measured)
        elif float(self._velocity.dot(self._moved)) > 0.0:  # it brakes, and each reading tells more of the cause
            self._name_cause(measured)
        elif not self._renewed and self._comes_along(commanded, measured):
            self._relief, self._renewed, self._hangs = commanded, RENEWALS, True
        else:
            self._moved = np.zeros_like(self._moved)
        left = self.robot.difference(commanded, self._relief)
        farthest = float(np.abs(left).max(initial=0.0))
        self._rested += held
        since, arrived = self._rested - following.servos.delay, farthest < _ARRIVED and not self._velocity.any()
        if arrived and since > _SETTLED:
            self.lets_go = self._renewed < RENEWALS and following.left(measured) > LEFT
            if self._hangs:  # the weight has come to rest
                self.stopped_by = f"{self.stopped_by}{following.carry(following.distance, measured)}"
                self._hangs = False
        if arrived and not (self.lets_go and since > _SETTLED):
            return self._braked(Status.FOLLOWING_ERROR, held)
        self._renewed += arrived
        # the first measurements were those of an arm in motion; what is near is noise
        if arrived or (farthest > _NEAR and not self._renewed and since > RELOOK):
            self._relief, self._rested = self._let_go(commanded), 0.0
            left = self.robot.difference(commanded, self._relief)
            farthest = float(np.abs(left).max(initial=0.0))
        wish = left * min(1.0 / held, max(UNLOADING_RATE, _SLOWEST / max(farthest, _ARRIVED)))
        bounds = self._hard.bounds(commanded, held, self._velocity)
        velocity = self._hard.towards(wish, self._velocity, bounds, held)
        return self._beside_the_law(velocity, Status.FOLLOWING_ERROR, held)

    def _name_cause(self, measured: np.ndarray) -> None:
        """Say what stopped the arm."""
        words = self._following.sentence(self._within.constraint, measured) + self._payload
        self.stopped_by = (
            f"{self._jumped[0]}; {words}" if self._timing.time - self._jumped[1] <= self.stale_after else words
        )

    def _let_go(self, commanded: np.ndarray) -> np.ndarray:
        """A posture at which the arm presses less, not far from where it pressed."""
        place, _, most = self._pressed
        gone = self.robot.difference(place, commanded) + self._following.relief()
        way = np.clip(gone, -most, most)
        if np.any(way != gone):  # no force takes an arm so far: what is measured is wrong
            self._renewed = RENEWALS
        return np.array(self.robot.integrate(place, way))

    def _comes_along(self, commanded: np.ndarray, measured: np.ndarray) -> bool:
        """True if an arm that is pulled down sinks as far as it lets go: a weight pulls it, and nothing blocks it."""
        place, pressed, _ = self._pressed
        following, servos = self._following, self._following.servos
        gone = self.robot.difference(place, commanded) - servos.gone(round(servos.delay / self.dt))
        came, square = self.robot.difference(pressed, measured), float(gone.dot(gone))
        return following.sinks and square > _SHOWS * _SHOWS and float(came.dot(gone)) > _FOLLOWS * square

    def _beside_the_law(self, u: np.ndarray, status: Status, held: float) -> Command:
        last, zero = self._last, np.zeros(self.robot.nv)
        mu, b, smallest = 0.0, zero[:0], 0.0
        if last is not None:
            mu, b, smallest = last.manipulability, last.task_velocity, last.smallest_singular_value
        command = Command(
            velocity=u, status=status, manipulability=mu, task_velocity=b, task_part=u, null_part=zero,
            task_scale=0.0, null_scale=0.0, smallest_singular_value=smallest, progress=0.0,
        )  # fmt: skip
        return self._sent_on(command, held)

    def _sent_on(self, command: Command, held: float | None = None) -> Command:
        """Average the velocity, and move the commanded posture on by one period."""
        held = self.dt if held is None else held
        # arrays of the loop's own: what the caller does to those of the command is his
        before, sent = self._velocity, self._sent
        self._last, self._velocity, error = command, command.velocity.copy(), self._following.largest
        self._sent = moved = self._velocity
        if self._average is not None and not self._following.tripped:
            self._average = self._average.add(self._velocity, held)
            self._sent = self._average.mean
            # joined by straight lines, as in the average; what holding the mean adds to its own line is not lost
            moved = 0.5 * (before + moved + self._sent - sent)
            late = self._timing.longest
            if self._runs_on and late > self._timing.usual and self._output is not None:
                # the mean comes to rest in as many calls, however long these last: it gives way to position limits
                accelerations = self.limits.acceleration.tolist()
                bounds = bound_changes(self._careful(self._output, late), sent, accelerations, held)
                slower = np.clip(self._sent, bounds.low, bounds.high)
                moved, self._sent = moved - (self._sent - slower), slower
        self._advance(held, moved)
        b, task, null = (np.array(part) for part in (command.task_velocity, command.task_part, command.null_part))
        return command._replace(
            velocity=self._sent.copy(), task_velocity=b, task_part=task, null_part=null, following_error=error
        )

    def _advance(self, time: float, velocity: np.ndarray) -> None:
        """Move the commanded posture on by a time [s]."""
        if self._reference is None or self._output is None:
            return
        self._following.moved(self._output, time, self._sent)
        self._timing = self._timing._replace(commanded=self._timing.commanded + time)
        if velocity.any() or self._sent.any():
            together = self._output is self._reference and self._average is None
            self._reference = self.robot.integrate(self._reference, time * velocity)
            self._output = self._reference if together else self.robot.integrate(self._output, time * self._sent)

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Distance to the task's goal along the constrained rows [m or rad]; NaN if the controller knows none."""
        error = getattr(self.controller, "task_error", None)
        return math.nan if error is None else float(error(q, self._clock(t)))

    def __repr__(self) -> str:
        return f"ServoLoop({self.controller!r}, dt={self.dt:g})"


def _held_back(command: Command, velocity: np.ndarray) -> Command:
    """A command with another velocity, within a limit of positions; its status says so where it says nothing graver."""
    status = min(command.status, Status.POSITION_LIMITED, key=tuple(Status).index)
    return command._replace(velocity=velocity, status=status)
