"""The driver protocol of an arm, and the cycle that runs a servo loop on it: its clock, and its shutdown."""

from __future__ import annotations

import atexit
import gc
import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, final

import numpy as np
from scipy.optimize import linear_sum_assignment

from manip_learn.control.command import Command, Posture, Status, Vector
from manip_learn.control.rollout import Rollout
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.simulation import rollout_of
from manip_learn.control.timing import in_milliseconds
from manip_learn.errors import ConfigurationError
from manip_learn.linalg import finite
from manip_learn.recordings.checks import far_outside
from manip_learn.robot.robot import Robot

SAMPLES = 100_000  # largest number of samples of a record: a longer run keeps every second, fourth, ... cycle
LONGEST_STOP = 10.0  # [s] for braking and relaxing, after which a run ends in any case
# [rad or m] largest drift of an arm commanded to its own position: opening brakes, a payload and a push of 20 N give a
# few hundredths at most. Also the largest distance between the first readings, and from them to the start of a motion
_DRIFT = 0.05
_SCALES = {1.0: "", math.degrees(1.0): "degrees", math.radians(1.0): "degrees", 1e3: "mm", 1e-3: "mm"}
# a cycle: its time [s], the measured posture, the command, and the joint positions that were sent before
_Sample = tuple[float, Posture, Command, Vector]
_LOGGER = logging.getLogger("manip_learn")


class Driver(Protocol):
    """Interface of an arm for `run`.

    Only `period`, `read` and `command` are required. A driver may also have:

    - `joint_names`: names of its joints in its own order; `run` reorders readings and commands accordingly. Further
      joints, e.g. of a gripper, are commanded to their first measured positions.
    - `simulated`: True for a simulated arm, whose time is the number of commands times the period, so that `run` does
      not wait between cycles. It then also has `wait()`, which lets a period pass without a command.
    - `gripper(word)`: closes or opens a gripper. It is called once with `"close"` or `"open"` at each gripper action of
      the controller's motion (see `repeat`), and returns without waiting for the gripper.
    - `release()`, after which a person can guide the arm by hand, and `hold()`, after which the arm keeps its position.
      If an arm cannot be released, `release()` raises a `ConfigurationError` that explains how else to guide it.

    Attributes:
        period: Time between two commands [s].
    """

    period: float

    def read(self) -> tuple[Posture, Posture | None, Posture | None]:
        """Return the newest measured joint positions [rad or m], velocities and efforts.

        Returns:
            Three arrays in the order of the joints, or mappings from joint names to numbers. None for velocities or
            efforts that are not measured, and for positions that have not come yet.
        """
        ...

    def command(self, q: Posture, u: Posture) -> object:
        """Send a command to the arm: either the joint positions or the joint velocities.

        Args:
            q: Joint positions (nv,) to reach at the end of the period [rad or m].
            u: Joint velocities (nv,) during the period [rad/s or m/s].

        Returns:
            Value that is ignored.
        """
        ...


@final
@dataclass(frozen=True)
class RunRecord:
    """Record of a `run`.

    Attributes:
        rollout: Measured postures, commanded velocities and statuses. In a long run only every second, fourth, ...
            cycle is kept.
        cycles: Number of cycles.
        overruns: Number of cycles that began late by more than half a period.
        longest_delay: Largest delay of the beginning of a cycle [s].
        ended: Reason why the run ended, a sentence.
        ordered: True if it ended as intended: after its duration, by `until`, or by a signal.
        notes: Limitations of the record, in sentences.
    """

    rollout: Rollout
    cycles: int
    overruns: int
    longest_delay: float
    ended: str
    ordered: bool
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        late = f"{self.overruns:,} late, at most {1e3 * self.longest_delay:.2g} ms"
        return f"RunRecord({self.cycles:,} cycles, {late}; {self.ended})"


def run(
    loop: ServoLoop,
    driver: Driver,
    duration: float | None = None,
    *,
    until: Callable[[], str] | None = None,
    clock: Clock | None = None,
) -> RunRecord:
    """Run a servo loop on an arm: read, update, command, once per period.

    End of the run: the arm first brakes within its limits and then stays at rest. A run ends after the duration, by a
    signal, if the driver or `until` raises, if the driver returns no valid posture, if the arm is blocked and has
    relaxed, if the period changes or cannot be kept, and when the interpreter ends while `run` is in a thread. Then the
    driver's `hold()` is called, if it has one, unless the reason was the duration or `until`. A single wrong reading
    brakes the arm but does not end the run. Python's garbage collector is off during the run.

    Start: no command is sent until two successive readings agree to 0.05 rad or m, because a driver may read zeros, or
    an old posture, until its first state has come. Both must also be as near to the start of a plan, of a repetition or
    of a `FollowMotion`. A motion without a start of its own compares them with the posture of the last `loop.reset`
    instead, with more tolerance if the servos may deflect by more. After a second without such readings, the run ends
    and reports the joint and both figures. If there is no start to compare with, a driver that keeps reading zeros
    cannot be distinguished from an arm at zero: return None from `read()` until there is a state.

    Wrong drivers: if `read` and `command` differ in the joints' order, units or signs, the arm's motion shows it. A
    first reading outside the limits, or an arm that drifts while it is commanded to its own position, ends the run at
    once, and nothing more is sent.

    Signals: Ctrl-C, SIGTERM and SIGHUP (a stopped container, a closed terminal). After Ctrl-C the run returns. After
    SIGTERM or SIGHUP the program's own handler is called and the run returns; if there is no handler, the program ends
    by `SystemExit` with 128 plus the number of the signal. `run` waits for a call of the driver that blocks. A signal
    aborts the call if it has taken longer than the loop's `stale_after`; a second Ctrl-C aborts it at once. If `read()`
    was aborted, the arm brakes without further readings; if `command()` was, nothing more is sent.

    No program can catch kill -9, a crash of the interpreter or a loss of power: a driver should have a watchdog of its
    own, which brakes the arm if no command has come for some periods, as UR, Franka and xArm have.

    The loop is reset at the beginning: it starts from the commanded posture if `loop.reset(q)` has set one, otherwise
    from the first measured posture.

    Args:
        loop: The loop; its `dt` is the driver's period.
        driver: The arm, see `Driver`.
        duration: Time after which the arm brakes [s]; None continues until Ctrl-C.
        until: Function that is called in each cycle: it returns an empty text to continue, or a reason in words, after
            which the arm brakes and the run ends. An exception from it is raised once the arm is at rest. None for no
            such function.
        clock: Source of the time; by default the computer's clock. The time of a `simulated` driver is the number of
            commands times the period, whatever the clock.

    Returns:
        The record, with the reason why the run ended.

    Raises:
        ConfigurationError: The driver's period is not the loop's, its joints are not the robot's, or the duration is
            not a number of seconds.
    """
    if duration is not None and not 0.0 <= duration < math.inf:
        raise ConfigurationError(f"duration must be a number of seconds, got {duration!r}")
    if not math.isclose(driver.period, loop.dt, rel_tol=0.01):
        periods = f"the driver's period is {1e3 * driver.period:g} ms and the loop's {1e3 * loop.dt:g} ms"
        raise ConfigurationError(f"{periods}: make the loop with ServoLoop(controller, dt={driver.period:g})")
    cycle = _Cycle(loop, _Arm(loop.robot, driver), clock or ComputerClock())
    loop.reset(loop.position)
    for note in loop.notes:
        _LOGGER.warning(note)
    with cycle.ending:
        cycle.run(math.inf if duration is None else duration, until or (lambda: ""))
        ended, is_ordered = cycle.ending.outcome
        if not is_ordered:
            _LOGGER.warning("the arm was stopped: %s", ended)
    return cycle.record()


class Clock(Protocol):
    """Interface of a clock for `run` and `record`."""

    def now(self) -> float:
        """Return the time [s]; it never decreases."""
        ...

    def wait_until(self, moment: float) -> object:
        """Wait until a time, or return at once if it has passed.

        Args:
            moment: Time of this clock [s].

        Returns:
            Value that is ignored.
        """
        ...


@final
class ComputerClock:
    """Clock of the computer, the default of `run` and `record`."""

    def now(self) -> float:
        """Return the time [s], counted from an arbitrary moment."""
        return time.perf_counter()

    def wait_until(self, moment: float) -> None:
        """Wait until a time: sleep, then spin, because sleeping may end 0.2 ms late.

        Args:
            moment: Time of this clock [s].
        """
        time.sleep(max(0.0, moment - time.perf_counter() - 2e-4))
        while time.perf_counter() < moment:
            pass


@final
class Pace:
    """Timing of a driver's cycles, one per period. The time of a simulated driver is the number of cycles times the
    period.

    Args:
        driver: Driver whose `period` and `simulated` are used.
        clock: Source of the time of drivers that are not simulated.

    Attributes:
        period: Time between two cycles [s].
        simulated: True if `wait` returns at once, as for a simulated driver.
        cycles: Number of cycles, counted by the caller.
        overruns: Number of cycles that began late by more than half a period.
        longest_delay: Largest delay of the beginning of a cycle [s].
        fault: Reason why the period is not kept, in words; empty if it is kept.
    """

    def __init__(self, driver: Any, clock: Clock):
        self._driver, self._clock, self.period = driver, clock, float(driver.period)
        self.simulated = bool(getattr(driver, "simulated", False))
        self.cycles, self.overruns, self.longest_delay, self.fault = 0, 0, 0.0, ""
        self._missed, self._due = 0.0, clock.now()  # share of the recent periods that were missed, next cycle [s]
        self.begin()

    def begin(self) -> None:
        """Set `time` to 0 at the next cycle; a simulated driver keeps its time."""
        self._start, self._began = self._due, ComputerClock().now()

    @property
    def time(self) -> float:
        """Time since `begin` [s]; for a simulated driver since its first cycle."""
        return self.cycles * self.period if self.simulated else self._clock.now() - self._start

    def wait(self) -> float:
        """Wait for the next cycle; if a period was missed, the next cycle is not brought forward.

        Returns:
            Time at which the cycle begins [s], see `time`.
        """
        period, time, late = self.period, self.time, 0.0
        if not self.simulated:
            self._clock.wait_until(self._due)
            time = self.time
            late = time + self._start - self._due
        self.longest_delay = max(self.longest_delay, late)
        self.overruns += late > 0.5 * period
        missed = int(max(0.0, late) / period)
        # if half of the periods of a second were missed, the period cannot be kept
        self._missed += (missed / (missed + 1.0) - self._missed) * min(1.0, (missed + 1.0) * period)
        if self._missed > 0.5 * (1.0 - math.exp(-1.0)):
            seconds = ComputerClock().now() - self._began
            self.fault = f"the period of {1e3 * period:g} ms cannot be held: cycles begin {1e3 * late:.2g} ms late"
            if in_milliseconds(time, seconds):
                self.fault += f"; the clock advanced by {time:.3g} in {seconds:.1g} s: it must count seconds"
        if self._driver.period != period:
            self.fault = f"the driver's period changed from {1e3 * period:g} to {1e3 * self._driver.period:g} ms"
        self._due += period * (missed + 1)
        return time


@final
class CallAborted(KeyboardInterrupt):
    """Signal that aborts a call of the driver which does not return; the argument is the duration of the call [s]."""


@final
class Shutdown:
    """Graceful shutdown, a context manager around the cycles of a driver: the arm brakes, and `hold()` is called,
    whether they end by a signal, an exception, or with the interpreter.

    Ctrl-C, SIGTERM and SIGHUP (a stopped container, a closed terminal) end the cycles at any point. Python delivers
    signals to the main thread only; cycles in another thread end when the interpreter ends, which waits for them, even
    for a daemon thread. A program that was started to ignore SIGTERM or SIGHUP, as by nohup, continues to ignore it.
    After SIGTERM or SIGHUP, once the cycles have ended, the program's own handler is called; if there is none, the
    program ends by `SystemExit` with 128 plus the number of the signal. Ends that no program can catch (kill -9, a loss
    of power) need a watchdog in the driver or in the arm. The garbage collector is off in the context, because a
    collection of 260 ms was measured.

    Args:
        driver: Driver whose `hold()`, if it has one, is called at the end.
        brake: Function without arguments, called once, when there is a reason to end.
        patience: Time that a call of the driver may take [s]; a signal after that aborts the call.
        clock: Clock that measures the duration of the driver's calls.

    Attributes:
        reason: Reason for which the cycles end, in words; empty until there is one.
        ordered: True if they end as intended.
        signals: Numbers of the received signals; the end of the interpreter counts as Ctrl-C.
        holds: True if `hold()` will be called at the end even without an exception.
        failed: Names of the driver's methods that were aborted (or `hold` if it raised), and the faults in words.
        raised: Exception that will be raised when the arm is at rest.
    """

    def __init__(self, driver: object, brake: Callable[[], object], patience: float, clock: Clock):
        self._driver, self._brake, self._patience, self._clock = driver, brake, patience, clock
        self.reason, self.ordered, self.holds, self._gc_was_on = "", False, True, gc.isenabled()
        self.failed, self.signals, self._handlers = dict[str, str](), list[int](), dict[int, Any]()  # handlers before
        self.raised: BaseException | None = None
        # time of the driver's call that has not returned yet [s]; event that the cycle is over
        self._call_time, self._is_over = math.inf, threading.Event()

    def stop(self, reason: str, ordered: bool = False) -> None:
        """Brake, and end the cycles when the arm is at rest. After the first reason further ones are ignored.

        Args:
            reason: Reason, in words; an empty text does nothing.
            ordered: True if the cycles end as intended.
        """
        if reason and not self.reason:
            self.reason, self.ordered = reason, ordered
            self._brake()

    @property
    def outcome(self) -> tuple[str, bool]:
        """Reason of the end and faults of the shutdown, in words; and True if it was intended and without fault."""
        return "; ".join((self.reason, *self.failed.values())), self.ordered and not self.failed

    @contextmanager
    def waiting(self, call: str) -> Iterator[None]:
        """Open a context for a call of the driver: a signal after `patience`, or a second Ctrl-C, aborts the call.

        Args:
            call: Name of the driver's method, for `failed`.

        Yields:
            Nothing.
        """
        self._call_time = self._clock.now()
        try:
            yield
        except CallAborted as error:
            self.failed[call] = f"the driver's {call}() had not returned for {error.args[0]:.2g} s"
        finally:
            self._call_time = math.inf

    def ask(self, call: str, *arguments: Any) -> Any:
        """Call a method of the driver. If the call raises, the arm is braked and the cycles end.

        Args:
            call: Name of the driver's method.
            *arguments: Arguments of the call.

        Returns:
            Value of the call; None if the driver has no such method, or if the call was aborted or raised.
        """
        try:
            if call not in self.failed and (function := getattr(self._driver, call, None)) is not None:
                with self.waiting(call):
                    return function(*arguments)
        except KeyboardInterrupt:
            self.stop("Ctrl-C", True)
        except BaseException as error:  # whatever it is, an arm in motion must brake: it is raised at rest
            self.stop(f"the driver's {call}() failed: {type(error).__name__}: {error}")
            self.raised = self.raised if isinstance(error, Exception) else error
        return None

    def __enter__(self) -> None:
        atexit.register(self._stop_at_exit)
        names = ("SIGINT", "SIGTERM", "SIGHUP") if threading.current_thread() is threading.main_thread() else ()
        for number in [number for number in signal.Signals if number.name in names]:  # Windows has no SIGHUP
            before = signal.getsignal(number)  # None for a handler that Python did not install and cannot restore
            if before is not None and (before != signal.SIG_IGN or number == signal.SIGINT):
                self._handlers[number] = signal.signal(number, self._receive)
        gc.collect()
        gc.disable()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._gc_was_on:
            gc.enable()
        try:
            if self.holds or kind is not None:
                with self.waiting("hold"):
                    getattr(self._driver, "hold", lambda: None)()
        except Exception as error:  # whatever a driver raises, the record is kept
            self.failed["hold"] = f"the driver's hold() failed: {type(error).__name__}: {error}"
        finally:
            self._is_over.set()
            atexit.unregister(self._stop_at_exit)
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
        for number in [number for number in self.signals if number != signal.SIGINT][-1:]:
            if not callable(handler := self._handlers[number]):
                raise SystemExit(128 + number)  # the exit code that a shell reports
            handler(number, None)

    def _stop_at_exit(self) -> None:
        """Brake: the main thread has ended, and this thread will be killed."""
        self.signals.append(signal.SIGINT)
        self.stop("the interpreter ended", True)
        self._is_over.wait(12.0)  # [s] for the arm to brake and to hold itself

    def _receive(self, number: int, frame: object) -> None:
        """Stop, and abort a call of the driver that does not return.

        Raises:
            CallAborted: In the call of the driver.
        """
        by_hand = number == signal.SIGINT
        again = by_hand and number in self.signals  # a second SIGHUP does not count: kernel and shell may both send one
        self.signals.append(number)
        self.stop("Ctrl-C" if by_hand else signal.Signals(number).name, True)
        elapsed = self._clock.now() - self._call_time  # negative if no call is under way
        if elapsed > self._patience or (again and elapsed >= 0.0):
            raise CallAborted(elapsed)


@final
class _Cycle:
    """The state of a run."""

    def __init__(self, loop: ServoLoop, arm: _Arm, clock: Clock):
        self._loop, self._robot, self._arm, self._clock = loop, loop.robot, arm, clock
        self.ending = Shutdown(arm, loop.stop, loop.stale_after, clock)
        start = loop.rules.controller.start
        # deflections under the largest allowed force
        yields = np.maximum(_DRIFT, loop.state.following.largest_relaxation())
        self._start, self._start_tolerance = (loop.position, yields) if start is None else (start, _DRIFT)
        self._samples, self._stride = list[_Sample](), 1  # stride: cycles from one sample to the next
        self._place = np.zeros(loop.robot.nv)  # positions of the first readings, later of the newest command
        # number of first readings, and of successive readings that show a drift of the arm
        self._doubt_count = self._drift_count = 0
        self._words = self._gripper_word = ""  # the loop's words on the reason of the stop; newest word to the gripper
        self._continuous = np.array([b.kind == "continuous" for b in loop.robot.blocks for _ in b.coordinate_names])

    def run(self, duration: float, until: Callable[[], str]) -> None:
        """Run until the arm is at rest after a reason to stop.

        Args:
            duration: Time after which the arm brakes [s]; inf for none.
            until: Returns a reason to stop in words, or an empty text.
        """
        loop, ending, last = self._loop, self.ending, math.inf
        self._pace = pace = Pace(self._arm, self._clock)  # its time starts here, after the garbage collection
        while True:
            t = pace.wait()
            ending.stop(pace.fault)
            ending.stop(f"the {duration:g} s were over" if t >= duration - 0.5 * pace.period else "", True)
            try:
                ending.stop(until() if ending.raised is None else "", True)
            except BaseException as error:  # whatever it is, SystemExit too: an arm in motion must brake
                ending.raised = error
                ending.stop(f"{type(error).__name__}: {error}")
            q = ending.ask("read")
            if self._describe_doubt(q):  # nothing is sent before a reading is believed
                if ending.reason:
                    break
                if pace.simulated:
                    ending.ask("wait")
                self._arm.rest = {}
                pace.begin()
                continue
            command = loop.update(q, t)
            if not ending.reason and (astray := self._describe_drift(q, command.status is Status.FOLLOWING_ERROR)):
                ending.stop(astray)
                break  # no command moves such an arm as intended: only hold() is called
            self._send(t, command)
            pace.cycles += 1
            stands = self._is_at_rest(command)
            last = min(last, t + LONGEST_STOP) if ending.reason else math.inf
            if stands or t >= last or "command" in ending.failed:
                break
        ending.holds = (bool(ending.signals) or not ending.ordered) and not ending.failed
        loop.start()
        if ending.raised is not None:
            raise ending.raised

    def _describe_doubt(self, q: Any) -> str:
        """Return why a first reading is not trusted, in words; empty if it is, or if it is not a posture.

        A driver that has no state yet may return zeros, or its last posture: two successive readings must agree, with
        each other and with the start of the motion, or the posture of the last reset. A reading that cannot be of this
        arm ends the run.
        """
        loop, robot, before = self._loop, self._robot, self._place if self._doubt_count else None
        if loop.measured is not None or (q := _as_posture(robot, q)) is None:
            return ""
        self._place, words = robot.positions(q), ""
        where = "where the motion starts: bring the arm there, or start from where it stands"
        away = _describe_distance(robot, self._start, q, self._start_tolerance, where)
        if away := away or _describe_distance(robot, before, q, _DRIFT, "a period before: the arm moves"):
            words = f"nothing was sent: {away}; or the driver has no state yet and should return None"
        elif before is None:
            words = "one reading alone"
        self._doubt_count += 1
        outside, is_late = far_outside(robot, self._place), self._doubt_count * self._pace.period > 1.0  # [s]
        self.ending.stop(outside or (words if is_late else ""))
        return outside or words

    def _describe_drift(self, q: Any, tripped: bool) -> str:
        """Return in words that the arm drifts while it is commanded to its own position; empty if it does not.

        This happens if a driver reads joints in another order than it commands them, or in another unit or sign. A
        single reading may be wrong, unless the arm is too far from its commanded position: `tripped`.
        """
        q = _as_posture(self._robot, q)
        if q is None or not self._samples:
            return ""
        _, first, _, start = self._samples[0]
        travel = float(np.abs(self._robot.difference(start, self._place)).max())
        causes = "it was in motion or is pushed, or the driver reads other joints, units or signs than it commands"
        words = f"at first, with commands of {travel:.1g} rad or m at most: {causes}"
        # an arm that was commanded by less than 0.02 rad or m, and has moved four times as far, has moved by itself
        most = max(0.0 if tripped else _DRIFT, 4.0 * travel)
        away = _describe_distance(self._robot, first, q, most, words) if travel < 0.02 else ""
        self._drift_count = self._drift_count + 1 if away else 0
        return away if self._drift_count > (not tripped) else ""

    def _send(self, t: float, command: Command) -> None:
        """Send the commanded posture and velocity to the driver, and a new word to its gripper, once; note a sample."""
        loop, before = self._loop, self._place
        if loop.position is None or loop.measured is None:
            return
        x = self._robot.positions(loop.position)
        turns = np.round((before - x) / (2.0 * math.pi)) * self._continuous
        self._place = x + 2.0 * math.pi * turns  # in the driver's count of turns
        self.ending.ask("command", self._place, command.velocity)
        word = getattr(loop.controller, "gripper", None)
        if word not in (None, self._gripper_word) and not self.ending.reason:
            self._gripper_word = word
            self.ending.ask("gripper", word)
        if self._pace.cycles % self._stride == 0:
            self._samples.append((t, loop.measured, command, before if self._samples else self._place))
        if len(self._samples) > SAMPLES:  # of a long run every second, fourth, ...
            self._samples, self._stride = self._samples[::2], 2 * self._stride

    def _is_at_rest(self, command: Command) -> bool:
        """Return True if the arm is at rest for a reason to end; set the reason if it is the loop's."""
        loop, ending, patience, period = self._loop, self.ending, self._loop.stale_after, self._pace.period
        stands = not (command.velocity.any() or loop.state.lets_go)
        is_blocked = command.status is Status.FOLLOWING_ERROR
        is_silent = stands and command.status in (Status.INVALID_INPUT, Status.STALE)
        # wait for a driver that is not ready yet, and after a single wrong reading
        is_silent &= self._pace.cycles * period >= patience and not 0.0 < loop.state.timing.silent < patience
        if is_blocked or is_silent:
            words, causes = loop.stopped_by or f"the loop has stopped: {command.status}", ""
            past = [q for _, q, _, _ in self._samples[-int(max(3, 0.02 / (self._stride * period))) :]]
            if is_blocked and len(past) > 2 and all(np.array_equal(q, past[-1]) for q in past):
                causes = "the driver keeps returning the same posture, or the arm is off: "
            if not ending.reason:
                ending.stop(_describe_mismatch(self._robot, self._samples) + causes + words)
            ending.reason = ending.reason.replace(self._words or words, words)  # more readings make it more precise
            self._words = words
        return stands and bool(ending.reason)

    def record(self) -> RunRecord:
        """Return the record of the run."""
        loop, pace = self._loop, self._pace
        rollout = rollout_of(loop.robot, loop, [(t, q, c, loop.task_error(q, t)) for t, q, c, _ in self._samples])
        note = "positions do not show whether the handle stayed in the fingers: look at the fixture"
        numbers = pace.cycles, pace.overruns, pace.longest_delay
        return RunRecord(rollout, *numbers, *self.ending.outcome, () if self._gripper_word is None else (note,))


def _as_posture(robot: Robot, q: Any) -> Posture | None:
    """Return a reading if it is as many finite numbers as a posture has, else None."""
    positions = finite(q, robot.nv)
    return finite(q, robot.nq) if positions is None else positions


def _describe_distance(robot: Robot, place: Posture | None, q: Posture, most: Vector | float, words: str) -> str:
    """Return a joint that is farther from a posture than allowed [rad or m], in words; empty if none is."""
    most = np.maximum(most, np.finfo(float).eps)
    away = np.zeros(1) if place is None else np.abs(robot.difference(place, q)) / most
    if place is None or away[j := int(away.argmax())] <= 1.0:
        return ""
    now, was, unit = robot.positions(q)[j], robot.positions(place)[j], robot.joint_units[j]
    return f"joint {robot.joint_names[j]} reads {now:.3g} {unit}, and {was:.3g} {unit} {words}"


def _describe_mismatch(robot: Robot, samples: Sequence[_Sample]) -> str:
    """Return the order, unit or sign of the joints that explains the measured motion, in words; empty if none does."""
    if len(samples) < 3:
        return ""
    subset = samples[:: len(samples) // 512 + 1]  # more samples change nothing
    measured, sent = np.array([robot.positions(q) for _, q, _, _ in subset]), np.array([sent for *_, sent in subset])
    measured, sent = measured - measured.mean(axis=0), sent - sent.mean(axis=0)
    measured_squares, sent_squares, products = np.sum(measured**2, axis=0), np.sum(sent**2, axis=0), measured.T @ sent
    # an explanation reduces the deviation to a tenth; one that exchanges joints must be better by a thousandth more
    names, explanation, best = robot.joint_names, "", 0.1**2 * float(np.sum((measured - sent) ** 2))
    own_order = 1e-3 * best * (1.0 - np.eye(robot.nv))
    for scale, unit in _SCALES.items():
        # squared residual of each joint for each commanded path, in either sense
        residual = np.maximum(measured_squares[:, None] + scale**2 * sent_squares - 2.0 * scale * np.abs(products), 0.0)
        pairs = linear_sum_assignment(residual + own_order)
        if (rest := float(residual[pairs].sum())) >= best:
            continue
        best, moved = rest, [(i, j) for i, j in zip(*pairs, strict=True) if measured_squares[i] > rest]
        messages = [f"{names[i]} moves as {names[j]} is commanded" for i, j in moved if i != j]
        messages += [f"{names[i]} moves in the opposite sense" for i, j in moved if products[i, j] < 0.0]
        messages += [f"{scale:.3g} times as far as commanded, as if in {unit} in one direction"] if unit else []
        explanation = "; ".join(messages)
    remedy = "check the joint order, units and signs of the driver"
    return f"the arm does not move as commanded ({explanation}): {remedy}; " if explanation else ""


@final
class _Arm:
    """A driver in the order of the robot's joints; its further joints are sent to their first measured positions.

    Attributes:
        rest: Joint -> first measured position; empty before.
    """

    def __init__(self, robot: Robot, driver: Any):
        self._joints, self._driver, self.rest = robot.joint_names, driver, dict[str, float]()
        self._names: tuple[str, ...] = tuple(getattr(driver, "joint_names", None) or ())
        missing = ", ".join(name for name in self._joints if name not in self._names)
        if self._names and (missing or len(set(self._names)) < len(self._names)):
            wrong = f"missing {missing}" if missing else "one name occurs twice"
            raise ConfigurationError(f"the driver's joints are {', '.join(self._names)}: {wrong}")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def read(self) -> Any:
        """Return joint positions in the robot's order, from the driver's or from a mapping.

        Raises:
            ConfigurationError: The position of a joint is missing, the number of positions is wrong, or the driver's
                order of the joints has changed.
        """
        q, _, _ = self._driver.read()
        if q is not None and self._names and not isinstance(q, Mapping):
            if tuple(self._driver.joint_names) != self._names:
                raise ConfigurationError("the order of its joints has changed")
            if np.shape(q) != (len(self._names),):
                raise ConfigurationError(f"{len(self._names)} joints are named, positions have shape {np.shape(q)}")
            q = dict(zip(self._names, q, strict=True))
        if not isinstance(q, Mapping):
            return None if q is None else np.array(q)  # the driver may go on writing into it
        if missing := [name for name in self._joints if name not in q]:
            raise ConfigurationError(f"no position of joint {', '.join(missing)}")
        if not self.rest and finite(list(q.values()), len(q)) is not None:
            self.rest = dict(q)
        return np.array([q[name] for name in self._joints], dtype=np.float64)

    def command(self, q: Vector, u: Vector) -> None:
        """Send positions and velocities of the robot's joints.

        Args:
            q: Joint positions (nv,) [rad or m].
            u: Joint velocities (nv,) [rad/s or m/s].
        """
        self._driver.command(self._sent(q, self.rest), self._sent(u, {}))

    def _sent(self, values: Vector, others: Mapping[str, float]) -> Posture:
        numbers = {**others, **dict(zip(self._joints, values, strict=True))}
        return np.array([numbers.get(name, 0.0) for name in self._names or self._joints], dtype=np.float64)
