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
from manip_learn.control.cycle import Clock, ComputerClock, GivenUp, OrderlyEnd, quiet_collector
from manip_learn.control.rollout import Rollout
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.simulation import rollout_of
from manip_learn.control.timing import in_milliseconds
from manip_learn.errors import ConfigurationError
from manip_learn.linalg import finite
from manip_learn.recordings.checks import far_outside
from manip_learn.robot.robot import Robot

_LATE = 0.5  # share of a period by which a cycle begins late to be counted
SAMPLES = 100_000  # of a record at most: a longer run keeps every second, fourth, ... cycle
LONGEST_STOP = 10.0  # [s] for braking and letting go, after which a run ends in any case
SLOW_AFTER = 1.0  # [s] in which more than half of the periods were missed: the period cannot be held
# [rad or m] by which no arm goes off that is sent to where it is: brakes that open, a payload and a push of 20 N give a
# few hundredths at most; and by which first readings may differ, from each other and from where a motion starts
_AWAY = 0.05
PATIENCE = 1.0  # [s] for which it is waited for first readings that agree
# [rad or m] by which it is sent then, and times as far as that for it to have gone by itself
_STILL, _AHEAD = 0.02, 4.0
_KEPT = 512  # readings of a run: of a longer one every second, fourth, ...
_EXPLAINED = 0.1  # share of what is left of a motion as it stands that is left of it where it is explained
_TIE = 1e-3  # share of that by which an explanation that exchanges joints must be better than one that does not
_SCALES = {1.0: "", math.degrees(1.0): "degrees", math.radians(1.0): "degrees", 1e3: "mm", 1e-3: "mm"}
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
        raise ConfigurationError(
            f"the driver's period is {1e3 * driver.period:g} ms and the loop's {1e3 * loop.dt:g} ms: "
            f"make the loop with ServoLoop(controller, dt={driver.period:g})"
        )
    clock = clock or ComputerClock()
    cycle = _Cycle(loop, driver, clock)
    loop.reset(loop.position)
    for note in loop.notes:
        _LOGGER.warning(note)
    ending = OrderlyEnd(driver, lambda reason: cycle.stop(reason, True), loop.stale_after, clock)
    with ending, quiet_collector():
        cycle.run(math.inf if duration is None else duration, until or (lambda: ""), ending)
        if not cycle.ordered:
            _LOGGER.warning("the arm was stopped: %s", cycle.reason)
    if ending.failed:
        cycle.reason, cycle.ordered = f"{cycle.reason}; {ending.failed}", False
    return cycle.record()


@final
class _Cycle:
    """The state of a run."""

    def __init__(self, loop: ServoLoop, driver: Driver, clock: Clock):
        self._loop, self._driver, self._clock = loop, driver, clock
        self._joints, self._witness = _Joints(loop.robot, driver), _Witness(loop.robot)
        self._first = _FirstReadings(loop)
        self._simulated = bool(getattr(driver, "simulated", False))
        self._samples: list[tuple[float, np.ndarray, Command]] = []
        self._stride = 1
        self.cycles = self.overruns = 0
        self.longest_delay = 0.0
        self.reason, self.ordered = "", False
        self._words = ""  # of an arm that is blocked
        self._told: str | None = None  # of the gripper
        blocks = loop.robot.blocks
        self._continuous = np.concatenate([np.full(b.v.stop - b.v.start, b.kind == "continuous") for b in blocks])
        self._blocked: set[str] = set()  # what did not return and is called no more
        self._raised: BaseException | None = None  # by the caller's own code

    def stop(self, reason: str, ordered: bool = False) -> None:
        """Brake, and end when the arm stands; the first reason counts."""
        if not self.reason:
            self.reason, self.ordered = reason, ordered
            self._loop.stop()

    def run(self, duration: float, until: Callable[[], str], ending: OrderlyEnd) -> None:
        """Until the arm stands after a reason to stop."""
        period, loop, clock = self._driver.period, self._loop, self._clock
        start = due = clock.now()
        began = ComputerClock.now()
        lately, last = 0.0, math.inf
        while True:
            if self._simulated:
                t, late = self.cycles * period, 0.0
            else:
                clock.wait_until(due)
                t = clock.now() - start
                late = t + start - due
            self.longest_delay = max(self.longest_delay, late)
            self.overruns += late > _LATE * period
            missed = int(max(0.0, late) / period)
            lately += (missed / (missed + 1.0) - lately) * min(1.0, (missed + 1.0) * period / SLOW_AFTER)
            due += period * (missed + 1)  # a period that was missed is not made up for
            if lately > 0.5 * (1.0 - math.exp(-1.0)):
                passed = clock.now() - start, ComputerClock.now() - began
                wrong = f"the period of {1e3 * period:g} ms cannot be held: cycles begin {1e3 * late:.2g} ms late"
                if in_milliseconds(*passed):
                    wrong += f"; the clock went on by {passed[0]:.3g} in {passed[1]:.1g} s: it is to count seconds"
                self.stop(wrong)
            if self._driver.period != period:
                self.stop(f"the driver's period changed from {1e3 * period:g} to {1e3 * self._driver.period:g} ms")
            if t >= duration - 0.5 * period:
                self.stop(f"the {duration:g} s were over", True)
            if self._raised is None:
                try:
                    if reason := until():
                        self.stop(reason, True)
                except BaseException as error:  # whatever it is, SystemExit too: an arm in motion must brake
                    self._raised = error
                    self.stop(f"{type(error).__name__}: {error}")
            q = self._asked("read()", ending, self._read)
            if self._doubts(q, ending):  # nothing is sent before a reading is believed
                if self.reason:
                    break
                start, began = due, ComputerClock.now()
                continue
            command = loop.update(q, t)
            if not self.reason and (wrong := self._witness.refuses(q, command.status is Status.FOLLOWING_ERROR)):
                self.stop(wrong)
                break  # whatever is sent to such a driver, the arm goes elsewhere: it is only held
            if (sent := loop.position) is not None and self._first.agree:
                self._send(sent, command, ending)
            self._witness.note(loop.measured, sent)
            self._note(t, command)
            if command.status is Status.FOLLOWING_ERROR:
                past = [q for _, q, _ in self._samples[-int(max(3, 0.02 / (self._stride * period))) :]]
                frozen = len(past) > 2 and all(np.array_equal(q, past[-1]) for q in past)
                why = "the driver has gone on returning the same posture, or the arm is off: " if frozen else ""
                words = loop.stopped_by or "the arm is blocked"
                self._stopped(why + words)
                self.reason = self.reason.replace(self._words or words, words)  # more readings tell more of it
                self._words = words
            self.cycles += 1
            last = min(last, t + LONGEST_STOP) if self.reason else math.inf
            if t >= last or "command()" in self._blocked or self._stands(command):
                break
        ending.holds = (ending.asked or not self.ordered) and not self._blocked
        loop.start()
        if self._raised is not None:
            raise self._raised

    def _doubts(self, q: Any, ending: OrderlyEnd) -> bool:
        """Return True if a first reading is not believed yet; that may take a second."""
        if not (doubt := self._first.doubt(q)):
            return False
        wrong = self._witness.refuses(q, False)
        if wrong or self._first.number * self._driver.period > PATIENCE:
            self.stop(wrong or doubt)
        elif self._simulated:
            self._asked("wait()", ending, getattr(self._driver, "wait", lambda: None))
        self._joints.rest = 0.0
        return True

    def _asked(self, call: str, ending: OrderlyEnd, function: Callable[[], Any]) -> Any:
        """What the driver answers; None where a call does not return or raises, for an arm in motion must brake."""
        if call in self._blocked:
            return None
        try:
            with ending.waiting():
                return function()
        except KeyboardInterrupt as error:
            self.stop("Ctrl-C", True)
            if isinstance(error, GivenUp):
                self._blocked.add(call)
                taken = f"{error.args[0]:.2g} s"
                self.reason, self.ordered = f"{self.reason}; the driver's {call} had not returned for {taken}", False
        except BaseException as error:  # whatever it is; what ends the program does so when the arm stands
            self.stop(f"the driver's {call} failed: {type(error).__name__}: {error}")
            if not isinstance(error, Exception):
                self._raised = error
        return None

    def _send(self, q: np.ndarray, command: Command, ending: OrderlyEnd) -> None:
        """The commanded posture and velocity to the driver, and a new word to its gripper, once."""
        robot, driver, joints = self._loop.robot, self._driver, self._joints
        x = robot.positions(q)
        turns = np.round((self._first.place - x) / (2.0 * math.pi)) * self._continuous
        x = self._first.place = x + 2.0 * math.pi * turns  # in the turns that the driver counts
        x, u = joints.sent(x, joints.rest), joints.sent(command.velocity, 0.0)
        self._asked("command()", ending, lambda: driver.command(x, u))
        word, gripper = getattr(self._loop.controller, "gripper", None), getattr(driver, "gripper", None)
        if word != self._told and not self.reason:
            self._told = word
            if word is not None and gripper is not None:
                self._asked("gripper()", ending, lambda: gripper(word))

    def _read(self) -> Any:
        q, _, _ = self._driver.read()
        return self._joints.measured(q)

    def _stands(self, command: Command) -> bool:
        """Whether the arm stands for a reason to end; gives the reason where it is the loop's."""
        if command.velocity.any() or self._loop.lets_go:
            return False
        if not self.reason and command.status in (Status.INVALID_INPUT, Status.STALE):
            ran, patience = self.cycles * self._driver.period, self._loop.stale_after
            if ran < patience or 0.0 < self._loop.silent < patience:
                return False  # a driver that is not ready yet, or one wrong reading
            self._stopped(self._loop.stopped_by or f"the loop stands: {command.status}")
        return bool(self.reason)

    def _stopped(self, why: str) -> None:
        """The loop has stopped the arm, which may be the driver's fault."""
        mixed_up = "" if self.reason else self._witness.words()
        self.stop(f"{mixed_up}; {why}" if mixed_up else why)

    def _note(self, t: float, command: Command) -> None:
        if self.cycles % self._stride == 0 and (q := self._loop.measured) is not None:
            self._samples.append((t, q, command))
        if len(self._samples) > SAMPLES:
            self._samples, self._stride = self._samples[::2], 2 * self._stride

    def record(self) -> RunRecord:
        """What was done."""
        loop, rows = self._loop, self._samples
        q = np.array([q for _, q, _ in rows]).reshape(len(rows), -1 if rows else loop.robot.nv)
        time, commands = np.array([t for t, _, _ in rows]), [command for _, _, command in rows]
        errors = np.array([loop.task_error(q, t) for t, q, _ in rows])
        rollout = rollout_of(loop.robot, loop, time, q, commands, errors)
        return RunRecord(rollout, self.cycles, self.overruns, self.longest_delay, self.reason, self.ordered)


@final
class _FirstReadings:
    """Readings before anything is sent: a driver that has no state yet may give zeros, or its last posture.

    Args:
        loop: The arm must be where its motion starts, or where it was reset to.

    Attributes:
        agree: True once two readings in turn agree, with each other and with that.
        number: Number of readings until then.
        place: shape (nv,), joint positions of the newest, and later those that were sent last.
    """

    def __init__(self, loop: ServoLoop):
        own, self._robot = loop.begins, loop.robot
        self._start, self._within = (loop.position, np.maximum(_AWAY, loop.yields)) if own is None else (own, _AWAY)
        self.agree, self.number, self.place = False, 0, np.zeros(0)

    def doubt(self, q: Any) -> str:
        """Return why a reading is not believed yet, in words; empty if it is, or if it is not a posture."""
        robot, before = self._robot, self.place if self.number else None
        x = finite(q, robot.nv) if (full := finite(q, robot.nq)) is None else full
        if self.agree or x is None:
            return ""
        self.place, self.number = robot.positions(x), self.number + 1
        for place, within, words in (
            (self._start, self._within, "where the motion starts: bring the arm there, or start from where it stands"),
            (before, _AWAY, "a period before: the arm moves"),
        ):
            away = np.zeros(1) if place is None else np.abs(robot.difference(place, x)) / within
            if place is not None and away[j := int(away.argmax())] > 1.0:
                was, now, unit = robot.positions(place)[j], self.place[j], robot.joint_units[j]
                return (
                    f"nothing was sent: joint {robot.joint_names[j]} reads {now:.3g} {unit}, and {was:.3g} {unit} "
                    f"{words}; or the driver has no state yet, and is to read None"
                )
        self.agree = before is not None
        return "" if self.agree else "one reading alone"


@final
class _Witness:
    """The path that was read beside the path that was sent.

    The arm of a driver that reads joints in another order than it commands them, or in another unit or sense, goes off
    as soon as it is sent to where it was read, or a joint moves as another one is sent.
    """

    def __init__(self, robot: Robot):
        self._robot, self._every, self._cycles = robot, 1, 0
        self._rows: list[tuple[np.ndarray, np.ndarray]] = []  # readings, and the postures that were sent before them
        self._sent: np.ndarray | None = None
        self._off = 0  # readings in turn that have gone away

    def refuses(self, q: Any, tripped: bool) -> str:
        """Why the first reading is none of this arm, or why a later one says that the driver is wrong; or nothing.

        `tripped` says whether the arm is too far from where it was sent.
        """
        x = finite(q, self._robot.nv)
        if x is None:
            return ""
        if not self._rows or self._sent is None:
            return far_outside(self._robot, x)
        first, start = self._rows[0]
        away, went = np.abs(x - first), float(np.abs(self._sent - start).max())
        j = int(away.argmax())
        goes = went < _STILL and away[j] > max(0.0 if tripped else _AWAY, _AHEAD * went)
        self._off = self._off + 1 if goes else 0
        if not goes or (self._off < 2 and not tripped):  # one reading may be wrong
            return ""
        name, unit = self._robot.joint_names[j], self._robot.joint_units[j]
        return (
            f"joint {name} has gone from {first[j]:.3g} to {x[j]:.3g} {unit} while it was sent by {went:.1g} {unit} at "
            "most: it was in motion or is pushed, or the driver reads other joints, units or senses than it commands"
        )

    def note(self, q: Any, sent: Posture | None) -> None:
        """Take note of a reading and of the posture that was sent after it [rad or m]."""
        n = self._robot.nv
        x = finite(q, n) if self._cycles % self._every == 0 else None
        self._cycles += 1
        before, self._sent = sent if self._sent is None else self._sent, sent
        if x is None or before is None or len(before) != n:
            return
        self._rows.append((x, before))
        if len(self._rows) > _KEPT:
            self._rows, self._every = self._rows[::2], 2 * self._every

    def words(self) -> str:
        """Which other order, unit or sense of the joints explains the motion that was read; or nothing."""
        if len(self._rows) < 3:
            return ""
        read, sent = (np.array(part) - np.mean(part, axis=0) for part in zip(*self._rows, strict=True))
        own, found = np.sum(read**2, axis=0), ""
        best = _EXPLAINED**2 * float(np.sum((read - sent) ** 2))
        names, apart = self._robot.joint_names, _TIE * best * (1.0 - np.eye(len(own)))
        for scale, unit in _SCALES.items():
            # what each joint leaves of each path that was sent, in either sense
            both, theirs = scale * read.T @ sent, np.sum((scale * sent) ** 2, axis=0)
            left = np.maximum(own[:, None] + theirs - 2.0 * np.abs(both), 0.0)
            rows, columns = linear_sum_assignment(left + apart)
            if float(left[rows, columns].sum()) >= best:
                continue
            best = float(left[rows, columns].sum())
            pairs = [(i, j) for i, j in zip(rows, columns, strict=True) if own[i] > best]  # the joints that moved
            said = [f"{names[i]} moves as {names[j]} is sent" for i, j in pairs if i != j]
            said += [f"{names[i]} moves the other way round" for i, j in pairs if both[i, j] < 0.0]
            said += [f"{scale:.3g} times as far as it is sent, as if in {unit} on one way"] if unit else []
            found = "; ".join(said)
        look = "look how the driver orders its joints, and in which units and senses"
        return f"the arm moves otherwise than it is sent ({found}): {look}" if found else ""


@final
class _Joints:
    """The order of a driver's joints, and that of the robot's."""

    def __init__(self, robot: Robot, driver: Driver):
        self._names, self._driver = robot.joint_names, driver
        self._theirs = self._given()
        self._places: list[int] | None = None
        self.rest: np.ndarray | float = 0.0  # where joints stay that are none of the robot's
        if self._theirs is not None:
            missing = [name for name in self._names if name not in self._theirs]
            if missing or len(set(self._theirs)) < len(self._theirs):
                raise ConfigurationError(
                    f"the driver's joints are {', '.join(self._theirs)}: "
                    + (f"missing {', '.join(missing)}" if missing else "one name occurs twice")
                )
            self._places = [self._theirs.index(name) for name in self._names]

    def _given(self) -> tuple[str, ...] | None:
        names: Sequence[str] | None = getattr(self._driver, "joint_names", None)
        return None if names is None else tuple(names)

    def measured(self, q: Any) -> Any:
        """Joint positions in the robot's order, from the driver's or from a mapping.

        Raises:
            ConfigurationError: A name is missing, their number is another, or the driver's order has changed.
        """
        if isinstance(q, Mapping):
            missing = [name for name in self._names if name not in q]
            if missing:
                raise ConfigurationError(f"no position of joint {', '.join(missing)}")
            return np.array([q[name] for name in self._names], dtype=np.float64)
        if self._places is None or self._theirs is None:
            return None if q is None else np.array(q)  # the driver may go on writing into it
        if self._given() != self._theirs:
            raise ConfigurationError("the order of its joints has changed")
        x = np.array(q, dtype=np.float64)
        if x.shape != (len(self._theirs),):
            raise ConfigurationError(f"{len(self._theirs)} joints are named, positions have shape {x.shape}")
        if isinstance(self.rest, float) and np.all(np.isfinite(x)):
            self.rest = x
        return x[self._places]

    def sent(self, values: Vector, others: np.ndarray | float) -> Posture:
        """Numbers of the robot's joints in the driver's order, and those of its other joints."""
        if self._places is None or self._theirs is None:
            return values.copy()
        out = np.array(np.broadcast_to(others, (len(self._theirs),)), dtype=np.float64)
        out[self._places] = values
        return out
