"""The loop that a real-time program calls: a controller, its state in time, and what stops it."""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.control.command import Command, Controller
from manip_learn.control.compiled_controller import CompiledController
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.outcome import next_slide
from manip_learn.control.servo_settings import filter_length, following_errors, limits_of, robot_of, with_limits
from manip_learn.control.status import Status
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

# [s] time by which a measurement may lag behind the command that it is compared with
LATENCY = 0.01


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
    (`Status.STOPPED`). It starts again by itself when the reason is gone. Where the measured posture is farther from
    the commanded one than `following_error_limit` (a collision, a jammed drawer, a servo that is off), it stands until
    `reset` is called (`Status.FOLLOWING_ERROR`).

    Args:
        controller: A `ResolvedRateController`, a `CompiledController`, or any `(q, t, dt) -> Command`.
        dt: Period [s].
        acceleration_limit: shape (nv,) or a number [rad/s2 or m/s2]; by default those of the controller's `Limits`.
        jerk_limit: shape (nv,) or a number [rad/s3 or m/s3]; by default those of the controller's `Limits`, or none.
            The commands are averaged over 2 max_j(a_j / jerk_j), which delays them by half of that time.
        stale_after: Time without a new state after which the arm brakes [s].
        following_error_limit: shape (nv,) or a number [rad or m]; by default 0.1 rad, and 0.02 m for a prismatic joint.
            A servo of stiffness k gives way by F r / k to a force F at a lever r, and by torque / k to friction: choose
            it above the latter. The force goes on rising while the arm brakes.
        latency: Time by which a measurement may lag behind the command that it is compared with [s].
        robot: Whose limits count; the controller's own by default.

    Attributes:
        acceleration_limit: shape (nv,) [rad/s2 or m/s2], in force.
        jerk_limit: shape (nv,) [rad/s3 or m/s3], in force, or None.
        dt: [s].

    Raises:
        ConfigurationError: A setting that is not positive, or a controller that has no robot where none is given.
    """

    def __init__(
        self,
        controller: Controller,
        dt: float = 0.001,
        acceleration_limit: ArrayLike | None = None,
        jerk_limit: ArrayLike | None = None,
        stale_after: float = 0.1,
        *,
        following_error_limit: ArrayLike | None = None,
        latency: float = LATENCY,
        robot: Robot | None = None,
    ):
        for name, value in (("dt", dt), ("stale_after", stale_after)):
            if not 0.0 < value < math.inf:
                raise ConfigurationError(f"{name} must be a positive number of seconds, got {value!r}")
        if not 0.0 <= latency < math.inf:
            raise ConfigurationError(f"latency must be a number of seconds, got {latency!r}")
        self.robot = robot_of(controller, robot)
        self.dt, self.stale_after = float(dt), float(stale_after)
        self.limits = limits_of(controller, self.robot, acceleration_limit, jerk_limit)
        self.controller = with_limits(controller, self.limits)
        self.acceleration_limit, self.jerk_limit = self.limits.acceleration, self.limits.jerk
        self._keeps_limits = isinstance(self.controller, ResolvedRateController | CompiledController)
        self._largest_error = following_errors(self.robot, following_error_limit)
        self._latency = float(latency)
        self._filter = np.zeros((filter_length(self.limits, dt), self.robot.nv))
        self.reset()

    def reset(self, q: ArrayLike | None = None) -> None:
        """Stand still and forget the past, after a following error or before another motion.

        Args:
            q: Posture to start from, that at which the servos hold the arm; None takes the next measured one, with
                the noise of its encoders.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        nv = self.robot.nv
        # where the controller is, and where the arm is sent: the same but for the filter
        self._reference = self._output = None if q is None else np.array(self.robot.checked_posture(q))
        self._velocity, self._sent = np.zeros(nv), np.zeros(nv)
        self._filter[:] = 0.0
        self._row = 0
        self._time, self._origin = -math.inf, math.nan  # of the newest state, and of the first
        self._advanced = 0.0  # time by which the commanded posture has moved on since `_origin`
        self._waited = 0.0  # periods since the newest state
        self._tripped = self._stopping = False
        self._error, self._slide = 0.0, 0.0
        self._last: Command | None = None

    def stop(self) -> None:
        """Brake and stand until `start` is called."""
        self._stopping = True

    def start(self) -> None:
        """Move again after `stop`."""
        self._stopping = False

    @property
    def position(self) -> Float[np.ndarray, " n"] | None:
        """The commanded posture at the end of the period, for a position servo; None before the first state."""
        return None if self._output is None else self._output.copy()

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
        """The same as `update`, but errors of the controller, its task and its policy are raised.

        Raises:
            ManipLearnError: What the controller raises.
        """
        measured = self._posture(q)
        time = float(t) if isinstance(t, int | float | np.number) and not isinstance(t, bool) else math.nan
        if measured is None or not math.isfinite(time) or time < self._time:
            self._waited += self.dt
            return self._braked(Status.INVALID_INPUT)
        held = self._accept_time(time)
        if self._reference is None:
            self._reference = self._output = measured
        self._measure(measured)
        q = self._reference
        if self._tripped:
            return self._braked(Status.FOLLOWING_ERROR)
        if held is None or self._waited > self.stale_after:
            return self._braked(Status.STALE)
        if self._stopping:
            return self._braked(Status.STOPPED)
        if self._waited > 0.0 and self._last is not None:  # nothing new: hold the last command
            return self._sent_on(self._last._replace(velocity=self._velocity, following_error=self._error))
        return self._sent_on(self._command(q, time, held)._replace(following_error=self._error))

    def _posture(self, q: Any) -> Float[np.ndarray, " n"] | None:
        """The posture as an array of its own; None if it is none."""
        if type(q) is not np.ndarray or q.dtype.char != "d":
            try:
                q = np.asarray(q)
            except (TypeError, ValueError, OverflowError):
                return None
            if q.dtype.kind not in "fiu":
                return None
            q = q.astype(np.float64)
        if q.ndim != 1 or not math.isfinite(math.fsum(map(abs, q.tolist()))):
            return None
        try:
            return np.array(self.robot.checked_posture(q))
        except ConfigurationError:
            return None

    def _accept_time(self, time: float) -> float | None:
        """Take the time of a state; returns how long its command will be held, None after a gap [s]."""
        dt, since = self.dt, time - self._time
        if since <= 0.0:
            self._waited += dt
            return dt
        self._time, self._waited = time, 0.0
        if math.isinf(since) or since > self.stale_after:  # the first state, or the first after a gap
            self._origin, self._advanced = time, 0.0
            return dt if math.isinf(since) else None
        late = (time - self._origin) - self._advanced
        if abs(late) > 0.01 * dt and self._reference is not None:  # periods of another length than dt
            self._advance(late)
        return dt * max(1, round(since / dt))

    def _measure(self, measured: np.ndarray) -> None:
        """Compare the measured posture with the commanded one."""
        if self._output is None:
            return
        away = np.abs(self.robot.difference(self._output, measured))
        lag = self._latency * (np.abs(self._sent) + self._latency * self.limits.acceleration)
        excess = np.maximum(away - lag, 0.0)
        self._error = float(excess.max(initial=0.0))
        if self._error > 0.0 and np.any(excess > self._largest_error):
            self._tripped = True

    def _command(self, q: np.ndarray, time: float, held: float) -> Command:
        """The controller's command, within the limits."""
        if self._keeps_limits:
            command = self.controller(q, time, held, self._velocity, self._slide)  # type: ignore[call-arg]
            self._slide = next_slide(self._slide, command, held)
            return command
        command = self.controller(q, time, held)
        wish = np.asarray(command.velocity, dtype=np.float64)
        if wish.shape != self._velocity.shape or not np.all(np.isfinite(wish)):
            raise ConfigurationError(f"the controller's velocity is not {self.robot.nv} finite numbers: {wish}")
        bounds = self.limits.bounds(q, held, self._velocity)
        if bounds.admit(wish):
            return command
        # as far as possible on the straight way from the velocity commanded last
        low, high = np.array(bounds.low), np.array(bounds.high)
        start = np.clip(self._velocity, low, high)
        change = wish - start
        room = np.where(change > 0.0, high - start, start - low)
        share = float(np.min(room[change != 0.0] / np.abs(change[change != 0.0]), initial=1.0))
        status = Status.OUTSIDE_LIMITS if bounds.outside > 0.0 else Status.ACCELERATION_LIMITED
        return command._replace(velocity=start + share * change, status=status, outside=bounds.outside)

    def _braked(self, status: Status) -> Command:
        """The arm brakes along the motion it was in, as hard as the acceleration limits allow."""
        u, dt = self._velocity, self.dt
        hardest = float(np.max(np.abs(u) / (self.limits.acceleration * dt), initial=0.0))
        if hardest > 0.0:
            u = u * max(0.0, 1.0 - 1.0 / hardest)
            if self._reference is not None:
                bounds = self.limits.bounds(self._reference, dt, self._velocity)
                u = np.clip(u, bounds.low, bounds.high)
        last, zero = self._last, np.zeros(self.robot.nv)
        facts = (
            (0.0, zero[:0], 0.0)
            if last is None
            else (last.manipulability, last.task_velocity, last.smallest_singular_value)
        )
        command = Command(
            *(u, status, facts[0], facts[1], u, zero, 0.0, 0.0, facts[2]), progress=0.0, following_error=self._error
        )
        return self._sent_on(command)

    def _sent_on(self, command: Command) -> Command:
        """Filter the velocity, and move the commanded posture on by one period."""
        self._last, u = command, command.velocity
        self._velocity = u
        if len(self._filter) > 1:
            self._filter[self._row] = u
            self._row = (self._row + 1) % len(self._filter)
            u = self._filter.mean(axis=0)
        self._sent = u
        self._advance(self.dt)
        return command if u is command.velocity else command._replace(velocity=u.copy())

    def _advance(self, time: float) -> None:
        """Move the commanded posture on by a time [s]."""
        if self._reference is None or self._output is None:
            return
        self._advanced += time
        together = self._output is self._reference and self._sent is self._velocity
        self._reference = self.robot.integrate(self._reference, time * self._velocity)
        self._output = self._reference if together else self.robot.integrate(self._output, time * self._sent)

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Distance to the task's goal along the constrained rows [m or rad]; NaN if the controller knows none."""
        error = getattr(self.controller, "task_error", None)
        return math.nan if error is None else float(error(q, t))

    def __repr__(self) -> str:
        return f"ServoLoop({self.controller!r}, dt={self.dt:g})"
