"""An arm behind a driver: the period, joints by name, and how a run ends whatever the driver does."""

from __future__ import annotations

import gc
import os
import re
import signal
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from case import rows_in

import manip_learn as ml
from manip_learn.control import driver
from manip_learn.control.joint_motion import JointMotion, LawSequence, every_joint
from manip_learn.errors import ConfigurationError

DT, BEFORE = 0.005, 40  # [s], cycles before something goes wrong
START = np.array([0.3, 0.8, 0.4])


class Arm:
    """A perfect arm whose driver goes wrong after some cycles; its clock is the number of commands.

    Attributes:
        fault: What goes wrong.
        first: What is read before the first state.
        late: How often that is.
        hands: Those of a clock that moves on: a period of 20 ms is then held.
        slow: The reading that takes longer, and by how much [s].
    """

    def __init__(self, fault="", joint_names=None, first=None, late=0.0, hands=None, slow=(0, 0.0)):
        self.q, self.fault, self.reads, self.sent, self.farthest = START.copy(), fault, 0, [], 0.0
        self.frozen, self.held, self.first, self.late = START, 0, first, late
        self.hands, self.slow, self.simulated, self.period = hands, slow, hands is None, 0.02 if hands else DT
        if joint_names is not None:
            self.joint_names = joint_names

    def read(self):
        """What the fault makes of the posture."""
        if self.hands is not None:
            self.hands.time += self.slow[1] * (self.reads == self.slow[0])
        self.reads += 1
        if self.reads <= self.late:
            return self.first, None, None
        if self.reads <= BEFORE:
            self.frozen = self.q.copy()
            return self.q, None, None
        first = self.reads == BEFORE + 1
        match self.fault:
            case "nothing":
                return None
            case "raises":
                raise OSError("no cable")
            case "period":
                self.period = 0.7 * DT
            case "renamed" if first:
                self.joint_names = self.joint_names[::-1]
            case "Ctrl-C":
                raise KeyboardInterrupt
            case "signal" if first:
                os.kill(os.getpid(), signal.SIGINT)
        readings = {"nan": np.full(3, np.nan), "impossible": np.full(3, 1e200)}
        readings |= {"stale": self.frozen, "reordered": self.q[::-1].copy()}
        return (readings | {"shorter": self.q[:2]}).get(self.fault, self.q), None, None

    def command(self, q, u) -> None:
        """Go there at once."""
        self.sent.append(u.copy())
        if self.fault == "deaf" and self.reads > BEFORE:
            raise OSError("bus off")
        self.farthest = max(self.farthest, float(np.abs(q - self.q).max()))
        self.q = np.asarray(q)

    def hold(self) -> None:
        """How many commands had come."""
        self.held = len(self.sent)


def loop_of(robot: ml.Robot, dt: float = DT) -> ml.ServoLoop:
    """A motion of some seconds."""
    constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
    return ml.ServoLoop(ml.ResolvedRateController(constraint, ml.PointAttractor([1.0, 1.5])), dt)


def test_a_run_ends_braked_after_its_duration(planar3):
    """What is recorded is what was measured and commanded; the last velocity is zero."""
    arm = Arm()
    record = ml.run(loop_of(planar3), arm, 0.5)
    assert record.ordered and "0.5 s" in record.ended
    assert 100 <= record.cycles == len(record.rollout) <= 110 and record.overruns == 0
    np.testing.assert_array_equal(record.rollout.u, arm.sent)
    np.testing.assert_array_equal(record.rollout.q[0], START)
    np.testing.assert_allclose(record.rollout.q[1:], record.rollout.q[:-1] + DT * record.rollout.u[:-1], atol=1e-12)
    assert not record.rollout.u[-1].any() and np.abs(record.rollout.u[50]).max() > 0.1
    assert record.rollout.status[-1] == "stopped" and record.rollout.frame == "tip"
    assert np.isfinite(record.rollout.task_error).all()


def braked(arm: Arm, loop: ml.ServoLoop, dt: float = DT) -> bool:
    """Whether the arm was in motion and came to rest within its acceleration limits."""
    changes = np.abs(np.diff(arm.sent, axis=0, prepend=np.zeros((1, 3))))
    within = bool(np.all(changes <= loop.acceleration_limit * dt * (1.0 + 1e-9)))
    return within and bool(np.abs(arm.sent).max() > 0.1) and not arm.sent[-1].any()


@pytest.mark.parametrize(("fault", "words"), rows_in("driver_faults.txt"))
def test_whatever_the_driver_does_the_arm_brakes(fault, words, planar3):
    """A braked stop, one sentence, an arm that holds itself, and the collector and Ctrl-C as they were."""
    arm, loop = Arm(fault, planar3.joint_names if fault == "renamed" else None), loop_of(planar3)
    before = signal.getsignal(signal.SIGINT)
    record = ml.run(loop, arm, 2.0)
    assert re.search(words, record.ended), record.ended
    assert record.ordered == ("Ctrl-C" in words)
    assert braked(arm, loop) and record.cycles < 400
    assert arm.held == (0 if fault == "Ctrl-C" else len(arm.sent))  # which the driver itself has handled
    assert gc.isenabled() and gc.get_freeze_count() == 0
    assert signal.getsignal(signal.SIGINT) is before


def test_joints_are_mapped_by_name(planar3):
    """Another order and a gripper, or messages with names: the same motion, and the gripper is sent where it was."""
    names = planar3.joint_names[::-1]

    class Named(Arm):
        def read(self):
            return np.append(0.7, super().read()[0][::-1]), None, None

        def command(self, q, u):
            assert q[0] == 0.7 and u[0] == 0.0
            super().command(q[:0:-1], u[:0:-1])

    class Messages(Arm):
        def read(self):
            return dict(zip(names, super().read()[0][::-1], strict=True)), None, None

    arms = Arm(), Named(joint_names=("gripper", *names)), Messages()
    for arm in arms:
        ml.run(loop_of(planar3), arm, 0.3)
        np.testing.assert_array_equal(arm.sent, arms[0].sent)
    for given, said in ((names[:2], f"missing {names[2]}"), ((*names, "a", "a"), "one name occurs twice")):
        with pytest.raises(ConfigurationError, match=said):
            ml.run(loop_of(planar3), Arm(joint_names=given), 0.1)


def test_another_period_is_refused(planar3):
    """A loop made for another period says how to make the right one."""
    with pytest.raises(ConfigurationError, match=r"dt=0.005"):
        ml.run(loop_of(planar3, 0.001), Arm())
    with pytest.raises(ConfigurationError, match="duration"):
        ml.run(loop_of(planar3), Arm(), -1.0)


class Hands:
    """The hands of a clock, which move when somebody waits or moves them."""

    time = 1000.0

    def now(self) -> float:
        """The time [s]."""
        return self.time

    def wait_until(self, moment: float) -> None:
        """That much passes."""
        self.time = max(self.time, moment)


def test_the_period_is_held_and_late_cycles_are_counted(planar3):
    """0.5 s are 0.5 s of the clock; after a cycle of 3.5 periods, those that were missed are not made up for."""
    hands = Hands()
    record = ml.run(loop_of(planar3, 0.02), Arm(hands=hands, slow=(11, 0.07)), 0.5, clock=hands)
    assert record.ordered and record.overruns == 1 and record.longest_delay == pytest.approx(0.05)
    np.testing.assert_allclose(np.diff(record.rollout.time)[:14], [*[0.02] * 10, 0.07, 0.01, 0.02, 0.02])
    assert 0.49 < hands.time - 1000.0 < 0.9


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.06, "the 1 s were over"), (0.2, "no new state for more than 100 ms"), (0.5, "period of 20 ms cannot be held")],
)
def test_a_driver_that_blocks_once(seconds, words, planar3):
    """Longer than `stale_after` ends the run; no command jumps, and the last one is zero."""
    hands, loop = Hands(), loop_of(planar3, 0.02)
    arm = Arm(hands=hands, slow=(20, seconds))
    record = ml.run(loop, arm, 1.0, clock=hands)
    assert words in record.ended and record.overruns == 1
    assert braked(arm, loop, 0.02)


PROGRAM = """
import signal, sys, threading, time
import manip_learn as ml
from test_driver import Arm, Hands, loop_of

how, moving = sys.argv[1], threading.Event()

class Steady(Hands):  # time passes while the cycle waits, and only then: no load makes it late
    def wait_until(self, moment):
        time.sleep(max(0.0, moment - self.time))
        super().wait_until(moment)

class Telling(Arm):
    def command(self, q, u):
        super().command(q, u)
        print("sent", *u, flush=True)
        if len(self.sent) == 40:
            moving.set()
        if len(self.sent) == 40 and how == "blocks":
            clock.time += 1.0
            print("blocks", flush=True)
            time.sleep(60.0)
    def hold(self):
        print("held", flush=True)
        if how == "fails":
            raise OSError("no port")

if how == "own":
    for name in ("SIGTERM", "SIGHUP"):
        signal.signal(getattr(signal, name), lambda *_: print("own handler", flush=True))
loop, arm, clock = loop_of(ml.load_robot("planar3")), Telling(), Steady()
arm.simulated = False
if how == "thread":  # a daemon, which the end of the interpreter would kill in motion
    threading.Thread(target=lambda: ml.run(loop, arm, clock=clock), daemon=True).start()
    moving.wait(50.0)
    sys.exit()
done = ml.run(loop, arm, 0.5 if how == "ignored" else 300.0, clock=clock)
print("returned:", done.ended, flush=True)
"""


@pytest.mark.parametrize(("name", "how", "said", "code"), rows_in("ends_of_a_run.txt"))
def test_signals_end_a_run_with_a_braked_arm_that_holds_itself(name, how, said, code):
    """The last velocity sent is zero, `hold` comes after it, and the program ends as the signal has it end.

    The same where the interpreter ends while a thread runs the arm.

    Not where it was started with the signal ignored. A `command` that does not return is given up, and none is sent.
    """
    more: Any = {"preexec_fn": lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)} if how == "ignored" else {}
    more |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    more["env"] = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, "-c", PROGRAM, how], **more) as program:
        assert program.stdout is not None and program.stderr is not None
        lines = [program.stdout.readline() for _ in range(41)]
        if name:
            program.send_signal(signal.Signals[name])
        lines += program.stdout.readlines()
        error = program.stderr.read()
    assert (lines[-1].strip(), program.returncode) == (said, int(code)) and "Traceback" not in error
    sent = np.array([[float(x) for x in line.split()[1:]] for line in lines if line.startswith("sent")])
    assert np.max(np.abs(sent[38])) > 0.1 and np.max(np.abs(np.diff(sent, axis=0))) < 0.1  # braked, not stopped dead
    if how == "blocks":
        assert len(sent) == 40 and "command() had not returned for 1 s" in error
    else:
        assert not sent[-1].any() and ("held\n" in lines) == (how != "ignored")
    assert ("own handler\n" in lines) == (how == "own")


def test_a_loop_runs_again(planar3):
    """A second run goes on from where the first one left the arm; of an arm that was moved by hand, it is refused."""
    loop, arm = loop_of(planar3), Arm()
    ml.run(loop, arm, 0.3)
    at = arm.q.copy()
    record = ml.run(loop, arm, 0.3)
    assert record.ordered and np.abs(record.rollout.u).max() > 0.1
    np.testing.assert_allclose(record.rollout.q[0], at, atol=1e-12)
    sent, arm.q = len(arm.sent), arm.q + 0.3
    assert "nothing was sent" in ml.run(loop, arm, 0.1).ended and len(arm.sent) == sent


def test_long_runs_keep_every_second_cycle(planar3, monkeypatch):
    """Half of the samples go whenever there are too many: those left are evenly spaced, from the first one on."""
    monkeypatch.setattr(driver, "SAMPLES", 50)
    record = ml.run(loop_of(planar3), Arm(), 1.0)
    stride = np.diff(record.rollout.time)
    assert record.cycles > 200 and 25 <= len(record.rollout) <= 50
    np.testing.assert_allclose(stride, 8 * DT, rtol=1e-9)
    assert record.rollout.time[0] == 0.0


def test_a_stop_that_takes_too_long_ends_all_the_same(planar3, monkeypatch):
    """10 s after the reason to stop, a run ends with the arm still in motion; until then it brakes."""
    monkeypatch.setattr(driver, "LONGEST_STOP", 0.1)
    gentle = ml.ServoLoop(loop_of(planar3).controller, DT, acceleration_limit=0.01)
    record = ml.run(gentle, Arm("raises"), 2.0)
    assert "no cable" in record.ended and abs(record.cycles - BEFORE - 1 - round(0.1 / DT)) <= 1
    assert record.rollout.u[-1].any()


def test_a_driver_that_is_not_ready_yet_is_waited_for(planar3):
    """Nothing for less than `stale_after` at the start is no reason to end; for longer it is, with the loop's words."""
    assert ml.run(loop_of(planar3), Arm(late=15), 0.3).ordered
    record = ml.run(loop_of(planar3), Arm(late=np.inf), 2.0)
    assert not record.ordered and record.ended == "no posture: None" and record.cycles == round(0.1 / DT)
    assert len(record.rollout) == 0 and "late" in repr(record)


def at_once(robot: ml.Robot, start: np.ndarray = START) -> ml.ServoLoop:
    """A motion that starts where the arm is."""
    return loop_of(robot)


def played(robot: ml.Robot, start: np.ndarray = START) -> ml.ServoLoop:
    """A recorded motion, which starts at a posture."""
    return ml.ServoLoop(ml.FollowMotion(robot, ml.Trajectory([0.0, 2.0], [start, start + 0.3])), DT)


def planned(robot: ml.Robot, start: np.ndarray = START) -> ml.ServoLoop:
    """A motion of the joints and then one along the constraint, as of a plan."""
    there = ml.ResolvedRateController(every_joint(robot), JointMotion(ml.Limits(robot), [start, start + 0.1]))
    rows = loop_of(robot).controller.constraint
    return ml.ServoLoop(LawSequence(there, ml.ResolvedRateController(rows, ml.motion(rows, along=0.1))), DT)


ZERO, BY_START = np.zeros(3), (played, planned)
STARTS = [  # the motion, how far away it starts [rad], what is read first, and how often
    *[(make, 0.0, ZERO, n) for make in BY_START for n in (1, 100)],
    *[(make, 0.0, START + [0.0, 0.2, 0.0], 10) for make in BY_START],
    *[(make, 0.0, np.full(3, np.nan), 5) for make in (*BY_START, at_once)],
    *[(make, off, None, 0) for make in BY_START for off in (0.2, -1.0, 0.06, 0.04)],
]


@pytest.mark.parametrize(("make", "off", "first", "late"), STARTS)
def test_nothing_is_sent_to_where_the_arm_is_not(make, off, first, late, planar3):
    """Zeros, an old posture or no numbers come before the first state: it is waited for, and then the arm moves; two
    readings are enough. An arm that is not where its motion starts is sent nothing, and told joint and both figures.
    """
    arm, start, is_away = Arm(first=first, late=late), START + [0.0, off, 0.0], abs(off) > 0.05
    record = ml.run(make(planar3, start), arm, 5.0 if is_away else 0.5)
    assert record.ordered != is_away
    if is_away:
        assert not arm.sent and arm.held == 0 and arm.reads * DT < 1.5
        assert planar3.joint_names[1] in record.ended and "reads 0.8 rad" in record.ended
        assert f"{start[1]:.3g} rad where the motion starts" in record.ended
        return
    assert arm.farthest < 0.02 and np.abs(arm.sent).max() > 0.01 and (late or arm.reads - len(arm.sent) == 1)
    np.testing.assert_array_equal(record.rollout.q[0], START)


def test_a_driver_of_other_sizes(planar3):
    """A mapping without a joint, or one number too many, ends the run with a sentence."""
    partial = Arm(first={planar3.joint_names[0]: 0.1}, late=np.inf)
    assert f"no position of joint {planar3.joint_names[1]}" in ml.run(loop_of(planar3), partial, 1.0).ended
    more = Arm(joint_names=(*planar3.joint_names, "gripper"))
    assert "4 joints are named, positions have shape (3,)" in ml.run(loop_of(planar3), more, 1.0).ended


@pytest.mark.parametrize("error", [ValueError("of the caller"), SystemExit(3), KeyboardInterrupt()])
def test_what_a_callback_raises_is_raised_when_the_arm_stands(error, planar3):
    """The arm brakes within its limits, the last command is zero, it holds itself, and then the error goes on."""
    arm, loop = Arm(), loop_of(planar3)

    def until() -> str:
        if len(arm.sent) > 50:
            raise error
        return ""

    with pytest.raises(type(error)):
        ml.run(loop, arm, until=until)
    assert braked(arm, loop) and arm.held == len(arm.sent)
