"""Servo loop for a real-time program: rules for each step, and a state with all of the loop's memory.

::

    runs --- invalid posture or time, stale reading, `stop` --> brakes, then is at rest
       ^ <---------------- the reason is gone ----------------------+
       |
       +--- blocked (also while it brakes) --> relaxes --- no force left --> at rest, blocked
       |                                                                        |
       +--- arrived --- commanded posture returns to the measured one <-- `reset`
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.command import Command, Controller, LimitedController, Posture, Status, Vector
from manip_learn.control.contact import LEFT, Contact, FollowingError
from manip_learn.control.controller import BoundedController
from manip_learn.control.law import next_slide
from manip_learn.control.limits import Bounds, Limits, farthest_positions, stopping_speed
from manip_learn.control.reading import Readings
from manip_learn.control.servos import shallow_copy
from manip_learn.control.tasks import PointAttractor, Task
from manip_learn.control.timing import Timing, VelocityAverage, in_milliseconds, time_of
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

_LOGGER = logging.getLogger("manip_learn")
RENEWALS = 10  # largest number of continued relaxations while a force remains
# removed arguments, and their replacements
_REMOVED = {
    **dict.fromkeys(("latency", "stiffness"), ": give contact=Contact({}={!r})"),
    "following_error_limit": ": give contact=Contact(stiffness=...), forces on the hand stop the arm",
    "correction_time": ": load the robot with its payload, robot.with_payload(...)",
}
WayBack = tuple[Vector, Posture | None, float]  # return motion of the posture that is sent, see `State`
STANDING = (Status.INVALID_INPUT, Status.STALE, Status.FOLLOWING_ERROR, Status.STOPPED)


@final
@dataclass(eq=False)
class State:
    """Memory of a loop from one period to the next. Each step returns a new state; returned states do not change.

    Attributes:
        following: Following error: model of the servos, and the force on the hand.
        timing: Timing of the readings.
        commanded: Time for which commands have moved the commanded posture since the newest reading [s].
        average: Average of the velocities that keeps the jerk limits; None without jerk limits.
        velocity: shape (nv,), velocity of `reference` [rad/s or m/s].
        sent: shape (nv,), velocity of `position` [rad/s or m/s].
        reference: Commanded posture on which the controller runs; None before the first reading.
        position: Commanded posture that is sent to the arm: `reference`, after averaging if there are jerk limits.
        measured: Newest measured posture; None before the first.
        last: Newest command; None before the first.
        stopped_by: Reason of the last stop, in words; None if there was none.
        is_stopped: True after `ServoLoop.stop`, until `start`.
        lets_go: True while the arm relaxes after it was blocked.
        slide: Share of the task's direction that the law gives up at limits, 0 to 1.
        alone: True if the motion began at a measured posture that no second reading has confirmed yet.
        refused: Time for which readings were refused because no joint can have moved so fast [s]; after `stale_after`
            they are accepted.
        jumped: Text on the newest refused reading, and its time [s].
        runs_on: True if the arm continues to move between late calls, as a velocity servo does.
        way_back: State of the return of `position` to the arm's position after a following error: deflection by a
            weight (nv,) [rad or m]; goal, a posture; and speed of the return in units of the acceleration limits [s].
            None if there is no return.
        relief: Posture to which a relaxing arm moves; None before it is blocked.
        pressed: Commanded posture, measured posture, and largest relaxation (nv,) [rad or m] at the time when the arm
            was blocked.
        renewed: Number of times that the relaxation was continued.
        rested: Time since the relaxation was last evaluated [s].
        moved: shape (nv,), velocity at the time of the stop [rad/s or m/s]; zeros once the arm has turned back.
        payload: Text on a weight that the arm seems to carry; empty if there is none.
        hangs: True if a weight pulls the arm, and nothing blocks it.
    """

    following: FollowingError
    timing: Timing
    average: VelocityAverage | None
    velocity: Vector
    sent: Vector
    reference: Posture | None = None
    position: Posture | None = None
    measured: Posture | None = None
    last: Command | None = None
    stopped_by: str | None = None
    commanded: float = 0.0
    is_stopped: bool = False
    lets_go: bool = False
    slide: float = 0.0
    alone: bool = False
    refused: float = 0.0
    jumped: tuple[str, float] = ("", -math.inf)
    runs_on: bool = False
    way_back: WayBack | None = None
    relief: Posture | None = None
    pressed: tuple[Any, Any, Any] = (None, None, None)
    renewed: int = 0
    rested: float = 0.0
    moved: Any = None
    payload: str = ""
    hangs: bool = False

    def copy(self) -> State:
        """Return a copy for the next period; changes of the copy do not affect the original."""
        other = shallow_copy(self)
        other.following = self.following.copy()
        return other


@final
class LoopRules:
    """Rules that compute the next state of a loop from its present state and a reading.

    Args:
        controller: The controller; its commands are within `limits`.
        limits: Limits of velocity, acceleration, jerk and position.
        contact: Limits of the forces on the hand.
        dt: Period [s].
        stale_after: Time without a new reading after which the arm brakes [s].
    """

    def __init__(self, controller: LimitedController, limits: Limits, contact: Contact, dt: float, stale_after: float):
        self.controller, self.limits, self.contact = controller, limits, contact
        self.dt, self.stale_after = dt, stale_after
        self.robot: Robot = limits.robot
        # an arm that presses brakes and relaxes as hard as it can, even if its motion has lower limits
        hardest = np.maximum(limits.acceleration, Limits(self.robot).acceleration)
        self.hardest = limits.with_rates(hardest, None)
        self.readings = Readings(self.robot, farthest_positions(self.robot))
        self._unknown = FollowingError(self.robot, contact, dt, self.hardest.acceleration, controller.frame)

    def begin(self, before: State | None = None, posture: Posture | None = None) -> State:
        """Return the state of an arm at rest, before its first reading.

        Args:
            before: State of the previous motion, whose measured period of the calls is kept; None for none.
            posture: Commanded posture; None takes the first measured one.
        """
        rest, average = np.zeros(self.robot.nv), VelocityAverage.at_rest(self.limits, self.dt)
        timing = Timing.begin(self.dt, self.stale_after) if before is None else before.timing.restart()
        return State(self._unknown.copy(), timing, average, rest, rest, posture, posture, alone=posture is None)

    def step(self, state: State, q: Any, t: Any) -> tuple[State, Command]:
        """Return the state and the command of the next period; the given state is not changed.

        Args:
            state: The present state.
            q: Measured posture.
            t: Time at which it was measured [s].

        Raises:
            ManipLearnError: The controller raised it.
        """
        after = state.copy()
        return after, self.advance(after, q, t)

    def advance(self, s: State, q: Any, t: Any) -> Command:
        """Return the command of the next period, and change a state in place.

        Args:
            s: Copy of the present state; it becomes the next state.
            q: Measured posture.
            t: Time at which it was measured [s].
        """
        measured, time, timing = self.readings.posture(q), time_of(t), s.timing
        timing = timing if measured is None else timing.detect_reset(time)
        if measured is None or not time >= timing.time:
            s.timing = timing.skip_reading(math.nan if measured is None else time)
            s.stopped_by = self.readings.refusal(q) if measured is None else f"no time: {t!r:.40}"
            return self.brake(s, Status.INVALID_INPUT)
        jump = self.readings.jump(s.measured, measured, max(self.dt, time - timing.time))
        if jump and s.refused <= self.stale_after:
            if s.alone:  # the second reading is far from the first one: do not start from the first
                self.controller.reset()
                back = None if s.way_back is None else (s.way_back[0], None, 0.0)
                new = self.begin(s, measured if back is None else s.position)
                replaced = {"is_stopped": s.is_stopped, "way_back": back, "measured": measured, "alone": True}
                vars(s).update(vars(new) | replaced)
                timing = s.timing._replace(time=time)
            s.timing = timing.skip_reading(timing.older)
            s.refused += self.dt
            s.stopped_by, s.jumped = jump, (jump, time)
            return self.brake(s, Status.INVALID_INPUT)
        s.refused, s.alone = 0.0, s.alone and s.measured is None
        s.measured = measured
        stood = s.last is None or s.last.status in STANDING
        s.timing = timing = timing.accept(time, stood, s.commanded)
        s.commanded *= timing.silent > 0.0
        if timing.late and not timing.is_stale:
            self._catch_up(s, measured, stood)
        period = timing.held
        if s.reference is None or s.position is None:
            s.reference = s.position = measured
        if s.way_back is not None:
            self._return_to_arm(s, s.position, s.way_back, measured, period)
            return self.brake(s, Status.FOLLOWING_ERROR, period)
        if timing.silent == 0.0:  # an old state has no information on the commands since
            s.following.compare(s.position, measured, self.controller.driven_motions)
        if s.following.tripped:
            # the average would continue to press for its own length
            s.reference, s.velocity = s.position, s.sent
            return self._relax(s, s.position, measured, period)
        if timing.is_stale:
            s.stopped_by = f"no new state for more than {1e3 * self.stale_after:g} ms"
            if in_milliseconds(timing.since, self.dt):
                s.stopped_by += f"; the time advanced by {timing.since:g}, in milliseconds? It must be in seconds"
            return self.brake(s, Status.STALE, period)
        if s.is_stopped:
            return self.brake(s, Status.STOPPED, period)
        if timing.silent > 0.0 and s.last is not None:
            if s.last.status in STANDING:
                return self.brake(s, s.last.status)
            same = s.last._replace(velocity=s.velocity)  # goes on, as long as that stays within the limits
            return self._send_command(s, _clip_command(same, self._bounds(s, s.reference, self.dt)), self.dt)
        return self._send_command(s, self._command(s, s.reference, self.clock(s, time), period), period)

    def _return_to_arm(self, s: State, sent: Posture, way: WayBack, measured: Posture, dt: float) -> None:
        """Move the posture that is sent to the first measured position of the arm, less its load: newer readings add
        noise.

        All joints move on a straight line. Their speed rises with at most the acceleration limits, and lets them stop
        (`stopping_speed`).
        """
        (load, goal, speed), robot, limits, s.way_back = way, self.robot, self.limits, None
        goal = robot.integrate(measured, -load) if goal is None else goal
        away, acceleration = robot.difference(sent, goal), np.minimum(limits.acceleration, 1e6)
        far = float(np.max(np.abs(away) / acceleration))  # [s^2] at unit acceleration
        if far > 0.5 * dt * dt or far > 0.0 and speed > dt:  # the last step brakes no harder than the limits either
            direction = away / far
            fastest = float(np.min(limits.velocity / np.maximum(np.abs(direction), 1e-12)))
            stopping = float(stopping_speed(np.array([far]), np.ones(1), dt)[0])
            speed = min(speed + dt, stopping, fastest, far / dt)
            s.reference = s.position = robot.integrate(sent, dt * speed * direction)
            s.way_back = load, goal, speed

    def _catch_up(self, s: State, measured: Posture, stood: bool) -> None:
        """Apply the motion that the arm made because a call was late, or did not make because it was early.

        A velocity servo keeps moving until the next command comes, a position servo stops at its command: the share of
        the motion at the last velocity that the arm has made in this time distinguishes them.
        """
        timing, followed, square = s.timing, 0.0, float(s.sent.dot(s.sent))
        if s.position is not None and square > 0.0 and not s.following.tripped:
            away = self.robot.difference(s.position, measured)
            followed = min(1.0, max(0.0, float(away.dot(s.sent)) / (timing.late * square)))
        s.runs_on = s.runs_on or (timing.late > 0.0 and followed > 0.5)
        # an early call takes back no more than its own step: the posture never moves against the velocity
        moved = max(timing.late, -timing.since) * followed
        self._advance(s, moved, s.sent)
        s.commanded = 0.0
        s.timing = timing._replace(waited=timing.waited - (0.0 if stood else moved))

    def clock(self, s: State, time: float) -> float:
        """Return the time to pass to the controller [s]: without the pauses of a task that waits for the arm.

        Args:
            s: State.
            time: Time of the caller [s].
        """
        return time - s.timing.waited if self.controller.waits else time

    def _bounds(self, s: State, q: np.ndarray, held: float) -> Bounds:
        """Return bounds on the next velocity; if periods vary, a joint can stop however late the calls are.

        In a call that is late by a time T, a velocity servo brakes by a dt only: the deceleration is a dt / T.
        """
        if s.timing.is_regular:
            return self.limits.bounds(q, held, s.velocity)
        return self._safe_bounds(s, q, s.timing.longest).after(s.velocity, self.limits.acceleration * held)

    def _safe_bounds(self, s: State, q: np.ndarray, late: float) -> Bounds:
        """Return bounds from which a joint stops however late the calls are, without acceleration limits."""
        return self.limits.bounds(q, late, None, s.timing.usual / late)

    def _command(self, s: State, q: np.ndarray, time: float, held: float) -> Command:
        """Return the controller's command, within the limits and clear of obstacles; else brake.

        The position at rest after braking was clear one step before.
        """
        command, clear = self.controller(q, time, held, s.velocity, s.slide), self.limits.barriers.clear
        s.slide = next_slide(s.slide, command, held)
        if not s.timing.is_regular:
            command = _clip_command(command, self._bounds(s, q, held))
        if clear is None:
            return command
        at = q, held, self.limits.acceleration, s.velocity
        if not clear.is_latest_clear(q, command.velocity) and clear.rows(*at, command.velocity) is not None:
            command = _replace_velocity(command, self._braking(s, held))._replace(limiting_joint=-1)
        if command.limiting_joint < 0 and command.status in (Status.POSITION_LIMITED, Status.STALLED):
            s.stopped_by = clear.describe_nearest() or s.stopped_by
        return command

    def brake(self, s: State, status: Status, held: float | None = None) -> Command:
        """Return a command that brakes along the present motion, as hard as the acceleration limits allow.

        Args:
            s: State; it is changed in place.
            status: Status of the command.
            held: Time for which the command is applied [s]; None for the period.
        """
        dt = self.dt if held is None else held
        return self._command_without_law(s, self._braking(s, dt), status, dt)

    def _braking(self, s: State, dt: float) -> np.ndarray:
        """Return the velocity with which the arm brakes for a time [s]: slower towards a limit, but at rest outside
        one.
        """
        u = s.velocity
        if s.reference is None or not u.any():
            return u
        bounds = self._bounds(s, s.reference, dt)
        bounds = bounds._replace(low=np.minimum(bounds.low, 0.0), high=np.maximum(bounds.high, 0.0))
        return self.limits.towards(np.zeros_like(u), u, bounds, dt)

    def _relax(self, s: State, commanded: np.ndarray, measured: np.ndarray, held: float) -> Command:
        """Relax a blocked arm: move to its measured position at the time of the contact, and on until no force is left.

        The obstacle springs back with the arm, so that the first measurement does not give the whole distance.
        """
        following, at_rest_after, reached = s.following, 0.05, 1e-9  # [s]; [rad or m] largest distance to a goal
        if s.relief is None:
            s.pressed, s.renewed, s.rested = (commanded, measured, following.largest_relaxation()), 0, 0.0
            s.moved, s.payload = s.velocity, following.accept_weight(following.servos.at_rest, measured)
            s.relief, s.lets_go = self._relaxed_posture(s, commanded), True
            self._set_cause(s, measured)
        elif float(s.velocity.dot(s.moved)) > 0.0:  # it brakes, and each reading makes the cause clearer
            self._set_cause(s, measured)
        elif not s.renewed and self._follows_relaxation(s, commanded, measured):
            s.relief, s.renewed, s.hangs = commanded, RENEWALS, True
        else:
            s.moved = np.zeros_like(s.moved)
        remaining = self.robot.difference(commanded, s.relief)
        farthest = float(np.abs(remaining).max(initial=0.0))
        s.rested += held
        since, arrived = s.rested - following.servos.delay, farthest < reached and not s.velocity.any()
        if arrived and since > at_rest_after:
            s.lets_go = s.renewed < RENEWALS and following.remaining_force(measured) > LEFT
            if s.hangs:  # the weight has come to rest
                s.stopped_by = f"{s.stopped_by}{following.accept_weight(following.distance, measured)}"
                s.hangs = False
        if arrived and not (s.lets_go and since > at_rest_after):
            return self.brake(s, Status.FOLLOWING_ERROR, held)
        s.renewed += arrived
        # the first measurements were of an arm in motion, so the goal is updated; small distances are noise
        if arrived or (farthest > 5e-4 and not s.renewed and since > 0.01):
            s.relief, s.rested = self._relaxed_posture(s, commanded), 0.0
            remaining = self.robot.difference(commanded, s.relief)
            farthest = float(np.abs(remaining).max(initial=0.0))
        # from 60 N to 3 N in 0.12 s, and no slower than 1 mrad/s meanwhile
        wish = remaining * min(1.0 / held, max(25.0, 1e-3 / max(farthest, reached)))
        bounds = self.hardest.bounds(commanded, held, s.velocity)
        velocity = self.hardest.towards(wish, s.velocity, bounds, held)
        return self._command_without_law(s, velocity, Status.FOLLOWING_ERROR, held)

    def _set_cause(self, s: State, measured: np.ndarray) -> None:
        """Set the reason of the stop."""
        words = s.following.describe_cause(self.controller.constraint, measured) + s.payload
        s.stopped_by = f"{s.jumped[0]}; {words}" if s.timing.time - s.jumped[1] <= self.stale_after else words

    def _relaxed_posture(self, s: State, commanded: np.ndarray) -> np.ndarray:
        """Return a posture at which the arm presses less, within the largest relaxation."""
        place, _, most = s.pressed
        relaxation = self.robot.difference(place, commanded) + s.following.relief()
        way = np.clip(relaxation, -most, most)
        if np.any(way != relaxation):  # no force deflects an arm so far: the measurement is wrong
            s.renewed = RENEWALS
        return np.array(self.robot.integrate(place, way))

    def _follows_relaxation(self, s: State, commanded: np.ndarray, measured: np.ndarray) -> bool:
        """Return True if an arm that is pulled down sinks as far as it relaxes: a weight pulls it, and nothing blocks
        it.
        """
        place, pressed, _ = s.pressed
        following, servos = s.following, s.following.servos
        relaxation = self.robot.difference(place, commanded) - servos.travel(round(servos.delay / self.dt))
        response, square = self.robot.difference(pressed, measured), float(relaxation.dot(relaxation))
        # a relaxation of less than 2 mrad or mm is not conclusive
        return following.sinks and square > 2e-3 * 2e-3 and float(response.dot(relaxation)) > 0.9 * square

    def _command_without_law(self, s: State, u: np.ndarray, status: Status, held: float) -> Command:
        names = ("manipulability", "task_velocity", "smallest_singular_value")
        values = {} if s.last is None else {name: getattr(s.last, name) for name in names}
        return self._send_command(s, Command.of_joints(u, status, task_scale=0.0, progress=0.0, **values), held)

    def _send_command(self, s: State, command: Command, held: float) -> Command:
        """Average the velocity, and move the commanded posture on by one period."""
        # copies: the caller may write into the arrays of the command
        before, sent = s.velocity, s.sent
        s.last, s.velocity, error = command, command.velocity.copy(), s.following.largest
        s.sent = moved = s.velocity
        if s.average is not None and not s.following.tripped:
            s.average = s.average.add(s.velocity, held)
            s.sent = s.average.mean
            # joined by straight lines, as in the average; the difference between the held mean and its line is kept
            moved = 0.5 * (before + moved + s.sent - sent)
            late = s.timing.longest
            if s.runs_on and late > s.timing.usual and s.position is not None:
                # the mean needs a fixed number of calls to come to rest: position limits have precedence over it
                bounds = self._safe_bounds(s, s.position, late)
                slower = bounds.after(sent, self.limits.acceleration * held).nearest(s.sent)
                moved, s.sent = moved - (s.sent - slower), slower
        self._advance(s, held, moved)
        own = {name: np.array(getattr(command, name)) for name in ("task_velocity", "task_part", "null_part")}
        return command._replace(velocity=s.sent.copy(), following_error=error, **own)

    def _advance(self, s: State, time: float, velocity: np.ndarray) -> None:
        """Move the commanded posture on by a time [s]."""
        if s.reference is None or s.position is None:
            return
        s.following.record_step(s.position, time, s.sent)
        s.commanded += time
        if velocity.any() or s.sent.any():
            together = s.position is s.reference and s.average is None
            s.reference = self.robot.integrate(s.reference, time * velocity)
            s.position = s.reference if together else self.robot.integrate(s.position, time * s.sent)


def _clip_command(command: Command, bounds: Bounds) -> Command:
    """Return a command clipped to bounds."""
    admitted = bounds.admit(command.velocity)
    return command if admitted else _replace_velocity(command, bounds.nearest(command.velocity))


def _replace_velocity(command: Command, velocity: np.ndarray) -> Command:
    """Return a command with another velocity, for a position limit; its status changes if it was less serious."""
    status = min(command.status, Status.POSITION_LIMITED, key=tuple(Status).index)
    return command._replace(velocity=velocity, status=status)


@final
class ServoLoop:
    """Servo loop: runs a controller inside a real-time program, which calls `update` once per period, e.g. at 1 kHz.

    In a program::

        loop = ServoLoop(controller, dt=0.001)
        while running:
            command = loop.update(measured_q, t)      # never raises
            robot.send(command.velocity)              # or loop.position, to a position servo

    The velocity starts from rest and changes within the acceleration limits, and within the jerk limits if there are
    any. The controller runs on the commanded posture, which is the integral of the commands; the measured posture is
    only compared with it. Encoder noise and latency are therefore not fed back, and a servo that follows late does not
    make the loop unstable.

    The arm brakes within the acceleration limits and stays at rest as long as an input is not a valid posture or time
    (`Status.INVALID_INPUT`), no new reading has come for `stale_after` (`Status.STALE`), or after a call of `stop`
    (`Status.STOPPED`). When the reason is gone, it starts again by itself. If the measured posture shows that the arm
    is blocked (a collision, a jammed drawer, a servo that is off), the arm brakes without regard to the jerk limits,
    relaxes by moving slowly to its measured position at the time of the contact, and stays at rest until `reset` is
    called (`Status.FOLLOWING_ERROR`); `stopped_by` names the row of the constraint that was blocked, and its deviation.

    Args:
        controller: A `ResolvedRateController`, or any callable `(q, t, dt) -> Command`.
        dt: Period [s].
        acceleration_limit: shape (nv,) or a number [rad/s2 or m/s2]; by default the controller's `Limits` apply.
        jerk_limit: shape (nv,) or a number [rad/s3 or m/s3]; by default the jerk limits of the controller's `Limits`
            apply, if any. The commands are averaged over a time of 2 max_j(a_j / jerk_j), with the acceleration limits
            a_j, and thereby delayed by half of it.
        stale_after: Time without a new reading after which the arm brakes [s].
        contact: Limits of the forces on the hand, and properties of the servos (`Contact`).
        robot: Robot whose limits count; the controller's own by default.
        limits: Limits of a controller of your own; by default the controller's, or the robot's.

    Attributes:
        limits: The limits in force.
        rules: Rules that compute the next state from the present one and a reading.
        acceleration_limit: Acceleration limits in force, shape (nv,) [rad/s2 or m/s2].
        jerk_limit: Jerk limits in force, shape (nv,) [rad/s3 or m/s3], or None.
        dt: Period [s].

    Raises:
        ConfigurationError: A setting is not positive, the period is not shorter than `stale_after`, the stiffness of
            `contact` is not positive or has the wrong size, or the controller has no robot and no `robot` is passed.
        ConstraintError: `limits` belong to another robot than the controller.
        TypeError: An unknown argument; for a removed one the message names the replacement.

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
            words = f"a state is stale after {stale_after:g} s and the period is {dt:g} s"
            raise ConfigurationError(f"{words}: set stale_after={3.0 * dt:g}")
        arm = robot or getattr(controller, "robot", None)
        if not isinstance(arm, Robot):
            raise ConfigurationError("the controller has no robot whose limits count: ServoLoop(..., robot=robot)")
        self.robot, self.dt, self.stale_after = arm, float(dt), float(stale_after)
        within = controller if isinstance(controller, LimitedController) else BoundedController(controller, Limits(arm))
        base: Limits = limits or within.limits or Limits(arm)
        self.limits = limits = base.with_rates(acceleration_limit, jerk_limit)
        self.acceleration_limit, self.jerk_limit = limits.acceleration, limits.jerk
        average = VelocityAverage.at_rest(limits, self.dt)
        bounded = within.with_limits(limits, 0.0 if average is None else 0.5 * average.time)
        self.controller = bounded if within is controller else controller
        self.contact = contact = contact or Contact()
        if contact.max_axial_force == "auto" and (force := bounded.taught_force) is not None:
            # the friction of the mechanism may be higher by half another time
            self.contact = replace(contact, max_axial_force=max(contact.max_lateral_force, 1.5 * force))
        self.rules = LoopRules(bounded, limits, self.contact, self.dt, self.stale_after)
        self._state = self.rules.begin()
        self.reset()

    def reset(self, q: ArrayLike | None = None) -> None:
        """Prepare another motion: set the commanded velocity to zero and clear the memory, also of a following error.

        After a following error `position` first returns to the measured posture within the velocity and acceleration
        limits, while the commanded velocity is zero and the status stays `Status.FOLLOWING_ERROR`.

        Args:
            q: Commanded configuration (nq,) or joint positions (nv,) to start from, at which the servos hold the arm
                [rad or m]; None takes the next measured posture, which contains encoder noise.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        before, back = self._state, None
        if q is None and before.position is not None:  # a position servo holds it there
            back = (before.following.load, None, 0.0) if before.following.tripped else before.way_back
        place = before.position if back else None if q is None else np.array(self.robot.checked_posture(q))
        state = self.rules.begin(before, place)
        state.alone, state.way_back = q is None, back
        self._state, self._is_stopped = state, False
        self.rules.controller.reset()

    def stop(self) -> None:
        """Brake, and stay at rest until `start` is called."""
        self._is_stopped = True

    def start(self) -> None:
        """Move again after `stop`."""
        self._is_stopped = False

    def set_task(self, task: Task) -> None:
        """Set another task, also in motion: the velocity changes to the new task's within the acceleration limits.

        A `ManipulabilityAscent` of the rows that the present task drives climbs the new task's rows from now on.

        Args:
            task: The new task.

        Raises:
            ConfigurationError: The controller is not a `ResolvedRateController`.
            ManipLearnError: The task does not fit the constraint. Before the first reading, not everything can be
                checked: the next `update` then returns `Status.INVALID_INPUT`.
        """
        self._exchange(task, None)

    def set_target(self, target: ArrayLike) -> None:
        """Set another target of a `PointAttractor`, also in motion (see `set_task`).

        Args:
            target: The new target, in one of the forms of `PointAttractor.target`.

        Raises:
            ConfigurationError: The task is not a `PointAttractor`.
            TargetError: The target is not finite numbers or does not fit the constraint; its size is not checked before
                the first reading (see `set_task`).
        """
        task = None if self.rules.controller.law is None else self.rules.controller.law.task
        if type(task) is not PointAttractor:
            raise ConfigurationError(f"only a PointAttractor has a target that can be set, the task is {task!r}")
        self._exchange(PointAttractor(target, task.gain, task.max_speed, driven=task.driven), None)

    def set_constraint(self, constraint: Constraint) -> None:
        """Set another constraint for the same task, also in motion (see `set_task`).

        Args:
            constraint: The new constraint, of the same robot.

        Raises:
            ConfigurationError: The controller is not a `ResolvedRateController`, or the constraint belongs to another
                robot.
            ManipLearnError: The task does not fit the constraint.
        """
        self._exchange(None, constraint)

    def _exchange(self, task: Task | None, constraint: Constraint | None) -> None:
        """Continue with another task or another constraint from the present posture and velocity."""
        law, state = self.rules.controller.law, self._state.copy()
        if law is None:
            kind = type(self.controller).__name__
            raise ConfigurationError(f"only a ResolvedRateController takes another task, not {kind}")
        if constraint is not None and constraint.robot is not law.learnt.robot:
            raise ConfigurationError("the constraint belongs to another robot than the loop")
        law = law.with_task(law.task if task is None else task, law.learnt if constraint is None else constraint)
        if state.reference is not None:
            law(state.reference, 0.0, self.dt)  # a misfit is refused while the old law is still in force
            law.task.reset()
        self.controller = self.rules.controller = law.with_limits(self.limits)
        state.slide, state.timing, self._state = 0.0, state.timing._replace(waited=0.0), state

    @property
    def state(self) -> State:
        """Memory of the loop (see `State`)."""
        return self._state

    @property
    def measured(self) -> Posture | None:
        """Newest valid measured posture; None before the first."""
        return self._state.measured

    @property
    def stopped_by(self) -> str | None:
        """Reason of the last stop, in words; None if there was none."""
        return self._state.stopped_by

    @property
    def notes(self) -> tuple[str, ...]:
        """Measured properties of the arm, such as latency and detectable forces, and of the motion, in sentences."""
        return (*self._state.following.notes, *self.rules.controller.notes)

    @property
    def position(self) -> Posture | None:
        """Commanded posture at the end of the period, for a position servo; None before the first reading.

        From one call to the next it moves by no more than the velocity limits allow in `dt`, or in the time between
        the calls if that is shorter, so that it does not jump after a gap in the calls.
        """
        sent = self._state.position
        return None if sent is None else sent.copy()

    def update(self, q: Any, t: Any) -> Command:
        """Return the command of the next period. Never raises.

        Args:
            q: Measured configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time at which it was measured [s].

        Returns:
            A command whose velocity is finite and within the limits; its status names the reason if the arm stops.
        """
        try:
            return self.step(q, t)
        except Exception:  # whatever goes wrong in a task or a policy of the user's own, an arm in motion must brake
            return self.rules.brake(self._state, Status.INVALID_INPUT)

    def step(self, q: ArrayLike, t: float) -> Command:
        """Return the command of the next period as `update` does, but raise errors of controller, task and policy.

        Args:
            q: Measured configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time at which it was measured [s].

        Returns:
            The command, as from `update`.

        Raises:
            ManipLearnError: An error of the controller.
        """
        before, self._state = self._state, self._state.copy()
        self._state.is_stopped = self._is_stopped  # which a signal may change at any time
        command = self.rules.advance(self._state, q, t)
        for note in self._state.following.notes[len(before.following.notes) :]:
            _LOGGER.warning(note)
        if (warning := self._state.timing.warning) != before.timing.warning:
            _LOGGER.warning(warning)
        return command

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Return the distance to the task's goal along the constrained rows [m or rad].

        It is NaN if the controller has no `task_error`.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """
        error = getattr(self.controller, "task_error", None)
        return math.nan if error is None else float(error(q, self.rules.clock(self._state, t)))

    def __repr__(self) -> str:
        return f"ServoLoop({self.controller!r}, dt={self.dt:g})"
