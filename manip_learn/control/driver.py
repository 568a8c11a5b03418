"""An arm behind a small protocol, and the cycle that runs a servo loop on it."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, final

import numpy as np
from scipy.optimize import linear_sum_assignment

from manip_learn.control.command import Command, Posture, Status, Vector
from manip_learn.control.cycle import Clock, ComputerClock, OrderlyEnd, Pace
from manip_learn.control.rollout import Rollout
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.simulation import rollout_of
from manip_learn.errors import ConfigurationError
from manip_learn.linalg import finite
from manip_learn.recordings.checks import far_outside
from manip_learn.robot.robot import Robot

SAMPLES = 100_000  # of a record at most: a longer run keeps every second, fourth, ... cycle
LONGEST_STOP = 10.0  # [s] for braking and letting go, after which a run ends in any case
# [rad or m] by which no arm goes off that is sent to where it is: brakes that open, a payload and a push of 20 N give a
# few hundredths at most; and by which first readings may differ, from each other and from where a motion starts
_AWAY = 0.05
_SCALES = {1.0: "", math.degrees(1.0): "degrees", math.radians(1.0): "degrees", 1e3: "mm", 1e-3: "mm"}
# a cycle: its time [s], what was measured, the command, and the joint positions that were sent before
_Sample = tuple[float, Posture, Command, Vector]
_LOGGER = logging.getLogger("manip_learn")


class Driver(Protocol):
    """An arm as `run` sees it.

    It may also have `joint_names`, its own order of joints, from which and to which `run` maps (further joints, as of a
    gripper, are sent where they were first measured); and `simulated`, True for an arm whose clock is the number of
    commands, which is then not waited for, with `wait()`, in which a period passes without one.

    A driver of an arm with a gripper may have `gripper(word)`, which is called with `"close"` or `"open"`, once, where
    the controller's motion says so (see `repeat`), and returns without waiting for it.

    A driver that can let a person guide the arm also has `release()`, after which the joints turn freely, and `hold()`,
    after which the arm stays where it is. Where an arm cannot do that, `release()` raises a `ConfigurationError` that
    says how else to guide it.

    Attributes:
        period: Between two commands [s].
    """

    period: float

    def read(self) -> tuple[Posture, Posture | None, Posture | None]:
        """The newest measured joint positions [rad or m], velocities and efforts, or None where there are none.

        Each is an array in the order of the joints, or a mapping from joint names.
        """
        ...

    def command(self, q: Posture, u: Posture) -> object:
        """Go to joint positions at the end of the period [rad or m], or at these velocities [rad/s or m/s]."""
        ...


@final
@dataclass(frozen=True)
class RunRecord:
    """What `run` did.

    Attributes:
        rollout: Measured postures, commanded velocities, statuses; of a long run every second, fourth, ... cycle.
        cycles: Number of cycles.
        overruns: Number of cycles that began late by more than half a period.
        longest_delay: Of the beginning of a cycle [s].
        ended: Why it ended, a sentence.
        ordered: Whether it ended as it was meant to: after its duration, for the caller's reason, or by a signal.
    """

    rollout: Rollout
    cycles: int
    overruns: int
    longest_delay: float
    ended: str
    ordered: bool

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

    However it ends, the arm first brakes within its limits and then stands: after the duration, by a signal, where the
    driver or `until` raises or the driver returns what is no posture, where the arm is blocked and has let go, where
    the period changes or cannot be held, and when the interpreter ends while it runs in a thread. Unless that was the
    duration or the caller's reason, the driver's `hold()` is then called, if it has one. A reading that is wrong once
    brakes the arm and does not end the run. Python's garbage collector rests meanwhile.

    Nothing is sent before two readings in turn agree to 0.05 rad or m and lie as near to the start of a plan, of a
    repetition or of a `FollowMotion` (else to where the loop was reset to, or farther off by what its servos give way):
    a driver may read zeros, or an old posture, until its first state has come. A second is given for that; then the run
    ends with the joint and both figures. Without a start of its own, a driver that goes on reading
    zeros cannot be told from an arm that is there: read None until there is a state.

    A driver that reads other joints, units or senses than it commands is told by its arm: a first reading outside the
    limits, or an arm that goes off while it is sent to where it is, ends the run at once, and nothing more is sent.

    The signals are Ctrl-C, SIGTERM and SIGHUP (a stopped container, a closed terminal). After Ctrl-C the run returns.
    After the other two the program ends, by `SystemExit` with 128 and the number of the signal; where it has a handler
    of its own for the signal, that is called and the run returns. A call of the driver that blocks is waited for. A
    signal gives it up where it has taken longer than the loop's `stale_after`, and Ctrl-C also when pressed again:
    after `read()` the arm brakes without being read, after `command()` nothing more is sent.

    Nothing catches kill -9, a crash of the interpreter or a loss of power: a driver should have a watchdog of its own,
    which brakes the arm where no command has come for some periods, as those of UR, Franka and xArm have.

    The loop begins anew, from the commanded posture where `loop.reset(q)` has given one, otherwise from the first
    measured one.

    Args:
        loop: The loop; its `dt` is the driver's period.
        driver: The arm, see `Driver`.
        duration: Time after which the arm brakes [s]; None goes on until Ctrl-C.
        until: Asked in each cycle: a reason in words, once there is one, after which the arm brakes. What it raises is
            raised when the arm stands.
        clock: Where the time comes from, for an arm whose time is not the computer's. That of a driver which is
            `simulated` is the number of commands.

    Returns:
        What was done and why it ended.

    Raises:
        ConfigurationError: The driver's period is not the loop's, its joints are not the robot's, or the duration is
            no time.
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


@final
class _Cycle:
    """The state of a run."""

    def __init__(self, loop: ServoLoop, arm: _Arm, clock: Clock):
        self._loop, self._robot, self._arm, self._pace = loop, loop.robot, arm, Pace(arm, clock)
        self.ending = OrderlyEnd(arm, loop.stop, loop.stale_after, clock)
        own = loop.begins
        self._start, self._within = (loop.position, np.maximum(_AWAY, loop.yields)) if own is None else (own, _AWAY)
        self._samples: list[_Sample] = []
        self._stride = 1  # cycles from one sample to the next
        self._place = np.zeros(loop.robot.nv)  # first positions that were read, and later those that were sent last
        self._doubted = self._astray = 0  # first readings; readings in turn that say that the arm goes off
        self._words = ""  # of the loop, on what stopped the arm
        self._told: str | None = None  # to the gripper
        self._continuous = np.array([b.kind == "continuous" for b in loop.robot.blocks for _ in b.coordinate_names])

    def run(self, duration: float, until: Callable[[], str]) -> None:
        """Until the arm stands after a reason to stop."""
        loop, pace, ending, last = self._loop, self._pace, self.ending, math.inf
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
            if self._doubt(q):  # nothing is sent before a reading is believed
                if ending.reason:
                    break
                if pace.simulated:
                    ending.ask("wait")
                self._arm.rest = {}
                pace.begin()
                continue
            command = loop.update(q, t)
            if not ending.reason and (astray := self._goes_astray(q, command.status is Status.FOLLOWING_ERROR)):
                ending.stop(astray)
                break  # whatever is sent to such a driver, the arm goes elsewhere: it is only held
            self._send(t, command)
            pace.cycles += 1
            stands = self._stands(command)
            last = min(last, t + LONGEST_STOP) if ending.reason else math.inf
            if stands or t >= last or "command" in ending.failed:
                break
        ending.holds = (bool(ending.signals) or not ending.ordered) and not ending.failed
        loop.start()
        if ending.raised is not None:
            raise ending.raised

    def _doubt(self, q: Any) -> str:
        """Return why a first reading is not believed, in words; empty if it is, or if it is not a posture.

        A driver that has no state yet may give zeros, or its last posture: two readings in turn must agree, with each
        other and with where the motion starts, or where the loop was reset to. A reading that is none of this arm ends
        the run.
        """
        loop, robot, before = self._loop, self._robot, self._place if self._doubted else None
        if loop.measured is not None or (q := _numbers(robot, q)) is None:
            return ""
        self._place, words = robot.positions(q), ""
        where = "where the motion starts: bring the arm there, or start from where it stands"
        away = _apart(robot, self._start, q, self._within, where)
        if away := away or _apart(robot, before, q, _AWAY, "a period before: the arm moves"):
            words = f"nothing was sent: {away}; or the driver has no state yet, and is to read None"
        elif before is None:
            words = "one reading alone"
        self._doubted += 1
        outside, is_late = far_outside(robot, self._place), self._doubted * self._pace.period > 1.0  # [s]
        self.ending.stop(outside or (words if is_late else ""))
        return outside or words

    def _goes_astray(self, q: Any, tripped: bool) -> str:
        """Return how the arm goes off while it is sent to where it is, in words; empty if it does not.

        The arm of a driver that reads joints in another order than it commands them, or in another unit or sense, does
        so. One reading may be wrong, unless the arm is too far from where it was sent: `tripped`.
        """
        q = _numbers(self._robot, q)
        if q is None or not self._samples:
            return ""
        _, first, _, start = self._samples[0]
        went = float(np.abs(self._robot.difference(start, self._place)).max())
        causes = "it was in motion or is pushed, or the driver reads other joints, units or senses than it commands"
        words = f"at first, and was sent by {went:.1g} rad or m at most: {causes}"
        # an arm that was sent by less than 0.02 rad or m, and is four times as far away, has gone by itself
        most = max(0.0 if tripped else _AWAY, 4.0 * went)
        away = _apart(self._robot, first, q, most, words) if went < 0.02 else ""
        self._astray = self._astray + 1 if away else 0
        return away if self._astray > (not tripped) else ""

    def _send(self, t: float, command: Command) -> None:
        """Send the commanded posture and velocity to the driver, and a new word to its gripper, once; note a sample."""
        loop, before = self._loop, self._place
        if loop.position is None or loop.measured is None:
            return
        x = self._robot.positions(loop.position)
        turns = np.round((before - x) / (2.0 * math.pi)) * self._continuous
        self._place = x + 2.0 * math.pi * turns  # in the turns that the driver counts
        self.ending.ask("command", self._place, command.velocity)
        word = getattr(loop.controller, "gripper", None)
        if word not in (None, self._told) and not self.ending.reason:
            self._told = word
            self.ending.ask("gripper", word)
        if self._pace.cycles % self._stride == 0:
            self._samples.append((t, loop.measured, command, before if self._samples else self._place))
        if len(self._samples) > SAMPLES:  # of a long run every second, fourth, ...
            self._samples, self._stride = self._samples[::2], 2 * self._stride

    def _stands(self, command: Command) -> bool:
        """Whether the arm stands for a reason to end; gives the reason where it is the loop's."""
        loop, ending, patience, period = self._loop, self.ending, self._loop.stale_after, self._pace.period
        stands, is_blocked = not (command.velocity.any() or loop.lets_go), command.status is Status.FOLLOWING_ERROR
        is_silent = stands and command.status in (Status.INVALID_INPUT, Status.STALE)
        # a driver that is not ready yet, or one wrong reading, is waited for
        is_silent &= self._pace.cycles * period >= patience and not 0.0 < loop.silent < patience
        if is_blocked or is_silent:
            words, causes = loop.stopped_by or f"the loop stands: {command.status}", ""
            past = [q for _, q, _, _ in self._samples[-int(max(3, 0.02 / (self._stride * period))) :]]
            if is_blocked and len(past) > 2 and all(np.array_equal(q, past[-1]) for q in past):
                causes = "the driver has gone on returning the same posture, or the arm is off: "
            if not ending.reason:
                ending.stop(_mixed_up(self._robot, self._samples) + causes + words)
            ending.reason = ending.reason.replace(self._words or words, words)  # more readings tell more of it
            self._words = words
        return stands and bool(ending.reason)

    def record(self) -> RunRecord:
        """What was done."""
        loop, pace = self._loop, self._pace
        rollout = rollout_of(loop.robot, loop, [(t, q, c, loop.task_error(q, t)) for t, q, c, _ in self._samples])
        return RunRecord(rollout, pace.cycles, pace.overruns, pace.longest_delay, *self.ending.outcome)


def _numbers(robot: Robot, q: Any) -> Posture | None:
    """Return a reading if it is as many finite numbers as a posture has, else None."""
    positions = finite(q, robot.nv)
    return finite(q, robot.nq) if positions is None else positions


def _apart(robot: Robot, place: Posture | None, q: Posture, most: Vector | float, words: str) -> str:
    """Return which joint is farther from a place than it may be [rad or m], in words; empty if none is."""
    most = np.maximum(most, np.finfo(float).eps)
    away = np.zeros(1) if place is None else np.abs(robot.difference(place, q)) / most
    if place is None or away[j := int(away.argmax())] <= 1.0:
        return ""
    now, was, unit = robot.positions(q)[j], robot.positions(place)[j], robot.joint_units[j]
    return f"joint {robot.joint_names[j]} reads {now:.3g} {unit}, and {was:.3g} {unit} {words}"


def _mixed_up(robot: Robot, samples: Sequence[_Sample]) -> str:
    """Return which other order, unit or sense of the joints explains the motion that was read, in words; or nothing."""
    if len(samples) < 3:
        return ""
    some = samples[:: len(samples) // 512 + 1]  # more change nothing
    read, sent = np.array([robot.positions(q) for _, q, _, _ in some]), np.array([sent for *_, sent in some])
    read, sent = read - read.mean(axis=0), sent - sent.mean(axis=0)
    own, theirs, products = np.sum(read**2, axis=0), np.sum(sent**2, axis=0), read.T @ sent
    # an explanation leaves a tenth of what is left as it stands; one that exchanges joints is better by a thousandth
    names, explanation, best = robot.joint_names, "", 0.1**2 * float(np.sum((read - sent) ** 2))
    own_order = 1e-3 * best * (1.0 - np.eye(robot.nv))
    for scale, unit in _SCALES.items():
        # what each joint leaves of each path that was sent, in either sense
        left = np.maximum(own[:, None] + scale**2 * theirs - 2.0 * scale * np.abs(products), 0.0)
        pairs = linear_sum_assignment(left + own_order)
        if (rest := float(left[pairs].sum())) >= best:
            continue
        best, moved = rest, [(i, j) for i, j in zip(*pairs, strict=True) if own[i] > rest]
        messages = [f"{names[i]} moves as {names[j]} is sent" for i, j in moved if i != j]
        messages += [f"{names[i]} moves the other way round" for i, j in moved if products[i, j] < 0.0]
        messages += [f"{scale:.3g} times as far as it is sent, as if in {unit} on one way"] if unit else []
        explanation = "; ".join(messages)
    look = "look how the driver orders its joints, and in which units and senses"
    return f"the arm moves otherwise than it is sent ({explanation}): {look}; " if explanation else ""


@final
class _Arm:
    """A driver in the order of the robot's joints; its further joints are sent where they were first measured.

    Attributes:
        rest: Joint -> where it was first measured; empty before.
    """

    def __init__(self, robot: Robot, driver: Any):
        self._own, self._driver, self.rest = robot.joint_names, driver, dict[str, float]()
        self._names: tuple[str, ...] = tuple(getattr(driver, "joint_names", None) or ())
        missing = ", ".join(name for name in self._own if name not in self._names)
        if self._names and (missing or len(set(self._names)) < len(self._names)):
            wrong = f"missing {missing}" if missing else "one name occurs twice"
            raise ConfigurationError(f"the driver's joints are {', '.join(self._names)}: {wrong}")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def read(self) -> Any:
        """Return joint positions in the robot's order, from the driver's or from a mapping.

        Raises:
            ConfigurationError: A name is missing, their number is another, or the driver's order has changed.
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
        if missing := [name for name in self._own if name not in q]:
            raise ConfigurationError(f"no position of joint {', '.join(missing)}")
        if not self.rest and finite(list(q.values()), len(q)) is not None:
            self.rest = dict(q)
        return np.array([q[name] for name in self._own], dtype=np.float64)

    def command(self, q: Vector, u: Vector) -> None:
        """Send positions and velocities of the robot's joints."""
        self._driver.command(self._sent(q, self.rest), self._sent(u, {}))

    def _sent(self, values: Vector, others: Mapping[str, float]) -> Posture:
        numbers = {**others, **dict(zip(self._own, values, strict=True))}
        return np.array([numbers.get(name, 0.0) for name in self._names or self._own], dtype=np.float64)
