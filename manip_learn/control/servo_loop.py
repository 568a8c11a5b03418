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
from manip_learn.control.following import FollowingError
from manip_learn.control.moving_average import MovingAverage
from manip_learn.control.outcome import next_slide
from manip_learn.control.servo_settings import is_number, limits_of, robot_of, task_of, with_limits
from manip_learn.control.status import Status
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

# [s] time by which a measurement may lag behind the command that it is compared with
LATENCY = 0.01
LONGEST_TIME = 1e15  # [s] a larger number is no time: its steps are longer than a period
STANDING = (Status.INVALID_INPUT, Status.STALE, Status.FOLLOWING_ERROR, Status.STOPPED)


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
    `reset` is called (`Status.FOLLOWING_ERROR`), and brakes without regard to the jerk limits.

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
        compiled: None compiles the controller where numba is installed and it can be (see `CompiledController`), and
            for other controllers of the library what keeps the limits; later changes of it and of its task are then
            not seen. False takes it as it is; True compiles it.

    Attributes:
        acceleration_limit: shape (nv,) [rad/s2 or m/s2], in force.
        jerk_limit: shape (nv,) [rad/s3 or m/s3], in force, or None.
        dt: [s].

    Raises:
        ConfigurationError: A setting that is not positive, or a controller that has no robot where none is given.
        ConstraintError: `compiled=True` for a controller that cannot be compiled.
        MissingExtraError: `compiled=True` without numba.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
        >>> controller = ml.ResolvedRateController(constraint, ml.PointAttractor([1.0, 1.5]))
        >>> loop = ml.ServoLoop(controller, dt=0.001, compiled=False)  # leave `compiled` out on an arm
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
        following_error_limit: ArrayLike | None = None,
        latency: float = LATENCY,
        robot: Robot | None = None,
        compiled: bool | None = None,
    ):
        for name, value in (("dt", dt), ("stale_after", stale_after), ("latency", latency)):
            if not (is_number(value) and 0.0 <= value < math.inf and (value > 0.0 or name == "latency")):
                raise ConfigurationError(f"{name} must be a positive number of seconds, got {value!r}")
        self.robot, self.dt, self.stale_after = robot_of(controller, robot), float(dt), float(stale_after)
        self.limits = limits_of(controller, self.robot, acceleration_limit, jerk_limit)
        self.controller = with_limits(controller, self.limits, compiled)
        self.acceleration_limit, self.jerk_limit = self.limits.acceleration, self.limits.jerk
        self._keeps_limits = isinstance(self.controller, ResolvedRateController | CompiledController)
        self._following = FollowingError(self.robot, following_error_limit, float(latency))
        self._average = MovingAverage(self.limits, self.dt)
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
        # where the controller is, and where the arm is sent: the same but for the average
        self._reference = self._output = None if q is None else np.array(self.robot.checked_posture(q))
        self._velocity, self._sent = np.zeros(nv), np.zeros(nv)
        self._average.forget()
        self._following.forget()
        self._time, self._origin = -math.inf, math.nan  # of the newest state, and of the first
        self._earlier = math.nan  # of a state that was refused, being older than the newest
        self._advanced = 0.0  # time by which the commanded posture has moved on since `_origin`
        self._waited = 0.0  # periods since the newest state
        self._stopping = False
        self._slide = 0.0
        self._last: Command | None = None
        task = task_of(self.controller)
        if task is not None:
            task.reset()

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
        time = float(t) if is_number(t) and abs(t) < LONGEST_TIME else math.nan
        if measured is not None and time < self._time and self._earlier < time <= self._earlier + self.stale_after:
            self._time = -math.inf  # two states in order: the clock was set back, or one stamp was wrong
        if measured is None or not time >= self._time:
            self._earlier = time if measured is not None and time < self._time else math.nan
            self._waited += self.dt
            return self._braked(Status.INVALID_INPUT)
        held = self._accept_time(time)
        if self._reference is None or self._output is None:
            self._reference = self._output = measured
        if self._waited == 0.0:  # a state that is not new says nothing of the commands since
            self._following.compare(self._output, measured, self._sent, self.limits.acceleration)
        if self._following.tripped:
            # the average would go on pressing for its own length
            self._reference, self._velocity = self._output, self._sent
            return self._braked(Status.FOLLOWING_ERROR)
        if held is None or self._waited > self.stale_after:
            return self._braked(Status.STALE)
        if self._stopping:
            return self._braked(Status.STOPPED)
        if self._waited > 0.0 and self._last is not None:
            return self._held(self._last)
        return self._sent_on(self._command(self._reference, time, held))

    def _held(self, last: Command) -> Command:
        """Nothing new: the last command, as long as that stays within the limits."""
        if last.status in STANDING:
            return self._braked(last.status)
        if self._reference is not None:
            bounds = self.limits.bounds(self._reference, self.dt, self._velocity)
            if not bounds.admit(self._velocity):
                slower = np.clip(self._velocity, bounds.low, bounds.high)
                return self._sent_on(last._replace(velocity=slower, status=Status.POSITION_LIMITED))
        return self._sent_on(last._replace(velocity=self._velocity))

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
        if q.ndim != 1:
            return None
        try:
            q = self.robot.checked_posture(q)
            # (cos, sin) of any length but 0
            return np.array(q) if q.shape[0] == self.robot.nv else np.array(self.robot.configuration(q))
        except ConfigurationError:
            return None

    def _accept_time(self, time: float) -> float | None:
        """Take the time of a state; returns the time since the last command, None after a gap [s]."""
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
            self._advance(late, self._sent)
        # calls without a new state have moved on in steps of dt: the change of velocity that they left out is lost
        return dt * max(1, math.floor(late / dt + 1.25)) if late > -0.25 * dt else max(dt + late, 0.1 * dt)

    def _command(self, q: np.ndarray, time: float, held: float) -> Command:
        """The controller's command, within the limits."""
        if self._keeps_limits:
            command = self.controller(q, time, held, self._velocity, self._slide)  # type: ignore[call-arg]
            self._slide = next_slide(self._slide, command, held)
            return command
        # the user's own controller may write into what it is given, and give the same array every time
        command = self.controller(q.copy(), time, held)
        wish = np.array(command.velocity, dtype=np.float64)
        if wish.shape != self._velocity.shape or not np.all(np.isfinite(wish)):
            raise ConfigurationError(f"the controller's velocity is not {self.robot.nv} finite numbers: {wish}")
        bounds = self.limits.bounds(q, held, self._velocity)
        if bounds.admit(wish):
            return command._replace(velocity=wish)
        status = Status.OUTSIDE_LIMITS if bounds.outside > 0.0 else Status.ACCELERATION_LIMITED
        velocity = self.limits.towards(wish, self._velocity, bounds, held)
        return command._replace(velocity=velocity, status=status, outside=bounds.outside)

    def _braked(self, status: Status) -> Command:
        """The arm brakes along the motion it was in, as hard as the acceleration limits allow."""
        u, dt = self._velocity, self.dt
        hardest = float(np.max(np.abs(u) / (self.limits.acceleration * dt), initial=0.0))
        if np.all(np.isfinite(self.limits.acceleration)):
            u = u * max(0.0, 1.0 - 1.0 / hardest) if hardest > 0.0 else u
        else:  # a joint that stops at once waits for none that cannot
            u = np.sign(u) * np.maximum(np.abs(u) - self.limits.acceleration * dt, 0.0)
        if hardest > 0.0 and self._reference is not None:
            bounds = self.limits.bounds(self._reference, dt, self._velocity)
            # slower towards a limit, but at rest outside one
            u = np.clip(u, np.minimum(bounds.low, 0.0), np.maximum(bounds.high, 0.0))
        last, zero = self._last, np.zeros(self.robot.nv)
        mu, b, smallest = 0.0, zero[:0], 0.0
        if last is not None:
            mu, b, smallest = last.manipulability, last.task_velocity, last.smallest_singular_value
        return self._sent_on(Command(*(u, status, mu, b, u, zero, 0.0, 0.0, smallest), progress=0.0))

    def _sent_on(self, command: Command) -> Command:
        """Average the velocity, and move the commanded posture on by one period."""
        # arrays of the loop's own: what the caller does to those of the command is his
        self._last, self._velocity, error = command, command.velocity.copy(), self._following.largest
        self._sent = self._velocity.copy() if self._following.tripped else self._average.of(self._velocity)
        self._advance(self.dt, self._velocity)
        b, task, null = (np.array(part) for part in (command.task_velocity, command.task_part, command.null_part))
        return command._replace(
            velocity=self._sent.copy(), task_velocity=b, task_part=task, null_part=null, following_error=error
        )

    def _advance(self, time: float, velocity: np.ndarray) -> None:
        """Move the commanded posture on by a time [s]."""
        if self._reference is None or self._output is None:
            return
        self._advanced += time
        if velocity.any() or self._sent.any():
            together = self._output is self._reference and self._average.length == 1
            self._reference = self.robot.integrate(self._reference, time * velocity)
            self._output = self._reference if together else self.robot.integrate(self._output, time * self._sent)

    def task_error(self, q: ArrayLike, t: float = 0.0) -> float:
        """Distance to the task's goal along the constrained rows [m or rad]; NaN if the controller knows none."""
        error = getattr(self.controller, "task_error", None)
        return math.nan if error is None else float(error(q, t))

    def __repr__(self) -> str:
        return f"ServoLoop({self.controller!r}, dt={self.dt:g})"
