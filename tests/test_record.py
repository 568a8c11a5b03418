"""Recording by hand: every sample is kept, whatever happens, and the arm is held in the end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from case import case

from manip_learn.cli import main
from manip_learn.drivers.record import RESTS, record
from manip_learn.errors import ConfigurationError, OutputError
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.trajectory import EFFORT_SUFFIX, VELOCITY_SUFFIX
from manip_learn.robot import Robot

NAMES = ("joint1", "joint2", "joint3")


class Arm:
    """A simulated arm of three joints: at rest, and moved between times that are given."""

    joint_names, period, simulated = NAMES, 0.01, True

    def __init__(self, moves: list[tuple[float, float]], efforts: bool = False):
        self.moves, self.efforts, self.k = moves, efforts, 0
        self.calls: list[str] = []

    @property
    def t(self) -> float:
        return self.k * self.period

    def read(self):
        way = sum(np.clip(self.t, a, b) - a for a, b in self.moves)
        q = np.array([0.3, -0.2, 0.5]) + 0.4 * way * np.array([1.0, -0.5, 0.2])
        moving = any(a <= self.t < b for a, b in self.moves)
        return q, 0.4 * moving * np.array([1.0, -0.5, 0.2]), np.ones(3) * self.t if self.efforts else None

    def wait(self):
        self.k += 1

    def command(self, q, u):
        raise AssertionError("a recorded arm is not commanded")

    def release(self):
        self.calls.append("release")

    def hold(self):
        self.calls.append("hold")


def rows(file: Path) -> np.ndarray:
    lines = file.read_text(encoding="utf-8").splitlines()[1:]
    return np.array([[float(x) for x in line.split(",")] for line in lines])


def test_each_motion_is_a_file_of_its_own(tmp_path: Path, planar3: Robot):
    """A file begins half a second before the joints move and ends when they have rested; nothing in it is missing, the
    numbers come back bit for bit, and the arm is released before and held after.
    """
    arm = Arm([(2.0, 4.0), (8.0, 9.5)], efforts=True)
    done = record(arm, tmp_path / "demos", "drawer", duration=14.0)
    assert [file.name for file in done.files] == ["drawer_01.csv", "drawer_02.csv"]
    assert (done.lost, done.ordered, arm.calls) == (0, True, ["release", "hold"])
    for file, (begin, end) in zip(done.files, arm.moves, strict=True):
        table = rows(file)
        assert table[0, 0] == pytest.approx(begin + 0.05 - 0.5, abs=0.021)  # it has moved by 0.02 rad after 0.05 s
        assert end + 1.0 < table[-1, 0] < end + RESTS + 0.2
        assert np.allclose(np.diff(table[:, 0]), 0.01)
        arm.k = round(table[50, 0] / 0.01)
        q, u, effort = arm.read()
        assert table[50].tolist() == [table[50, 0], *q, *u, *effort]
    demos = load_demonstrations(list(done.files), planar3, velocities="recorded")
    assert demos[0].u is not None and demos[0].effort is not None and len(demos) == 2
    assert sum(map(len, demos)) == done.samples


def test_the_key_begins_and_ends(tmp_path: Path):
    """By key nothing begins by itself, a file is what lies between two presses and half a second before, and numbers of
    files go on where the folder has some.
    """
    presses = {150: "start or stop", 350: "start or stop", 500: "end"}
    for name in ("wipe_01.csv", "wipe_02.csv"):
        arm = Arm([(1.0, 6.0)])
        done = record(arm, tmp_path, "wipe", by="key", key=lambda arm=arm: presses.get(arm.k, ""))  # type: ignore[arg-type]
        assert [file.name for file in done.files] == [name]
        table = rows(done.files[0])
        assert table[0, 0] == pytest.approx(1.0) and table[-1, 0] == pytest.approx(3.5)
        assert done.ended == "ended by key"


NO_POSTURE = "the driver has returned no posture for 1 s"
FAULTS = [(OSError("port gone"), "the driver's read() failed: OSError: port gone")]
FAULTS += [(np.array([0.1, np.nan, 0.2]), NO_POSTURE), ({"joint1": 0.3, "joint2": 0.1}, NO_POSTURE)]


@pytest.mark.parametrize(("fault", "sentence"), FAULTS)
def test_whatever_a_driver_does_the_files_are_kept(fault: object, sentence: str, tmp_path: Path):
    """If a driver raises, gives no posture or loses a joint, the recording ends with one sentence; all samples before
    are kept, and the arm is held.
    """

    class Failing(Arm):
        def read(self):
            if self.t < 2.5:
                return super().read()
            if isinstance(fault, Exception):
                raise fault
            return fault, None, None

    arm = Failing([(1.0, 8.0)])
    done = record(arm, tmp_path, duration=20.0)
    assert done.ended == sentence and not done.ordered and arm.calls[-1] == "hold"
    assert len(rows(done.files[0])) == done.samples and rows(done.files[0])[-1, 0] > 2.4


def test_a_hand_guided_mode_that_is_not_there_is_said(tmp_path: Path):
    """Where release() refuses, its sentence is a note; a driver without it is recorded as it is; a simulated one that
    cannot wait, names that nobody gives, a folder that cannot be and a name that leads elsewhere are refused before
    anything begins.
    """
    arm = Arm([(1.0, 2.0)])
    arm.release = lambda: (_ for _ in ()).throw(ConfigurationError("press the button on the wrist"))  # type: ignore
    assert record(arm, tmp_path / "ok", duration=5.0).notes == ("press the button on the wrist",)
    for attribute, words in (("joint_names", "names no joints"), ("wait", "wait")):
        lacking = Arm([(1.0, 2.0)])
        setattr(lacking, attribute, None)
        with pytest.raises(ConfigurationError, match=words):
            record(lacking, tmp_path, duration=5.0)
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(OutputError, match="cannot create the folder"):
        record(arm, tmp_path / "file" / "demos", duration=1.0)
    for name in ("../drawer", "a/b", "", ".."):
        with pytest.raises(OutputError, match="without a folder"):
            record(arm, tmp_path / "demos", name, duration=1.0)
    assert not (tmp_path / "demos").exists()


PROGRAM = """
import resource, signal, sys, time
import numpy as np
from manip_learn.drivers.record import record

limit, last = int(sys.argv[2]), int(sys.argv[3])

class Steady:  # time passes while the cycle waits, and only then: no load makes it late
    t = 0.0
    def now(self):
        return self.t
    def wait_until(self, moment):
        time.sleep(max(0.0, moment - self.t))
        self.t = max(self.t, moment)

class Arm:
    joint_names, period, n = ("joint1", "joint2", "joint3"), 0.005, 0
    def read(self):
        self.n += 1
        if self.n > last:
            clock.t += 1.0
            print("blocks", flush=True)
            time.sleep(60.0)
        print(self.n, flush=True)
        return np.array([0.005, 0.0005, -0.005]) * self.n, None, None
    def hold(self):
        print("held", flush=True)

if limit:
    sys.dont_write_bytecode = True  # before 3.12.8 a .pyc that found no room stays, and breaks every import
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
clock = Steady()
done = record(Arm(), sys.argv[1], clock=clock)
print(done.ended, flush=True)
"""


FULL = "the disk is full, make room; the samples before are kept in"


@pytest.mark.parametrize(
    ("name", "last", "said", "code"),
    [
        ("SIGINT", 10**9, ["held", "Ctrl-C"], 0),
        ("SIGTERM", 200, ["blocks", "held"], 143),
        ("SIGHUP", 200, ["blocks", "held"], 129),
        ("SIGKILL", 200, ["blocks"], -signal.SIGKILL),
        ("a full disk", 10**9, ["held", FULL], 0),
    ],
)
def test_whatever_ends_it_the_file_is_complete_and_the_arm_held(
    name: str, last: int, said: list[str], code: int, tmp_path: Path, planar3: Robot
):
    """Without a traceback; a driver that does not return is given up; the exit code is the signal's. The file is
    written while it grows: after kill -9, too, it has every sample read before, in whole lines. Where there is no more
    room, recording ends with a sentence.
    """
    full = name == "a full disk"
    words = [sys.executable, "-c", PROGRAM, str(tmp_path), "9000" if full else "0", str(last)]
    own = {k: x for k, x in os.environ.items() if not (full and k.startswith("COVERAGE"))}  # writes too
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=own) as program:
        assert program.stdout is not None and program.stderr is not None
        heard = [program.stdout.readline() for _ in range(0 if full else 201)]
        while name == "SIGKILL" and rows(next(tmp_path.glob("*.csv")))[-1:, 1].tolist() != [0.005 * last]:
            time.sleep(0.05)
        if not full:
            program.send_signal(signal.Signals[name])
        heard += program.stdout.readlines()
        error = program.stderr.read()
    lines, (file,) = [line.strip() for line in heard], tmp_path.glob("*.csv")
    assert program.returncode == code and not error
    assert all(line.startswith(words) for line, words in zip(lines[-len(said) :], said, strict=True))
    table, count, content = rows(file), max(int(x) for x in lines if x.isdecimal()), file.read_text(encoding="utf-8")
    assert np.allclose(np.diff(table, axis=0)[:, 1], 0.005) and content.endswith("\n")
    assert len(load_demonstrations(file, planar3)[0]) == len(table)
    assert 8800 < len(content) <= 9000 if full else table[-1][1] >= 0.005 * (count - (name != "SIGKILL"))


ARM = """
import numpy as np

class Arm:
    joint_names, period, simulated, k = ("joint1", "joint2", "joint3"), 0.01, True, 0
    def read(self):  # the hand goes along x and back, each time with another elbow
        n, s = divmod(0.01 * self.k, 6.0)
        x, bend = 1.85 - 0.25 * np.cos(np.pi * np.clip(s - 2.0, 0.0, 2.0)), 0.6 + 0.15 * n
        along = x + 0.8j - np.exp(1j * bend)
        b = np.arccos(np.clip(np.abs(along) / 2.0, -1.0, 1.0))
        return np.array([bend, np.angle(along) + b - bend, -2.0 * b]), None, None
    def wait(self):
        self.k += 1

def broken():
    raise OSError("no port")
"""


def test_command_records_and_says_what_was_shown(tmp_path: Path, capsys):
    """`record` learns from all files of the name and ends with the sentence and what to do next; without a robot it
    says how; what is no driver is one sentence.
    """
    (tmp_path / "arm.py").write_text(ARM, encoding="utf-8")
    here = ["record", f"{tmp_path / 'arm.py'}:Arm", "--out", str(tmp_path / "demos"), "--motions", "3", "--no-browser"]
    assert main([*here, "--robot", "planar3", "--frame", "tip", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert len(answer["files"]) == 3 and answer["lost"] == 0
    assert "can move along" in answer["sentence"] and answer["advice"]
    assert main(here) == 0
    said = capsys.readouterr().out
    assert "demo_06.csv" in said and "say --robot ROBOT" in said
    for driver, sentence in {
        "arm.py:none": "has no attribute 'none'",
        "arm.py:broken": "OSError: no port",
        "other.py:Arm": "does not exist",
        "arm.py": "FILE.py:NAME",
        "arm.py:np": "no driver",
    }.items():
        with case(driver):
            assert main(["record", f"{tmp_path}/{driver}", "--out", str(tmp_path / "x"), "--no-browser"]) == 2
            assert sentence in capsys.readouterr().err
    assert main([*here, "--by", "knob"]) == 2 and "motion or key" in capsys.readouterr().err


@pytest.mark.parametrize(("stall", "wrong", "lost"), [(1.6, 0.0, 159), (0.0, 1.0, 2)])
def test_a_stall_is_said_as_long_as_it_was(stall: float, wrong: float, lost: int, tmp_path: Path):
    """A slow reading leaves a gap of its length, its samples are counted as lost, and recording continues. A posture
    that no slow motion can have reached is not written and counts as lost.
    """

    class Stalling:
        joint_names, period, n, time = NAMES, 0.01, 0, 50.0

        def now(self):
            return self.time

        def wait_until(self, moment):
            self.time = max(self.time, moment)

        def read(self):
            self.n += 1
            q = 0.5 * np.ones(3) * (self.time - 50.0) + wrong * (self.n in (80, 120))
            self.time += stall * (self.n == 60)
            return q, None, None

    arm = Stalling()
    done = record(arm, tmp_path, duration=2.0 + stall, clock=arm)  # type: ignore[arg-type]
    assert done.ordered and done.lost == lost and f"{lost} samples lost" in done.sentence
    steps = np.diff(rows(done.files[0]), axis=0)
    assert done.longest_gap == pytest.approx(stall or 0.02) and np.max(steps[:, 0]) == pytest.approx(stall or 0.02)
    assert np.allclose(steps[:, 1] / steps[:, 0], 0.5)


def test_columns_are_the_joints_of_their_names(tmp_path: Path):
    """Readings by name may come in any order, and in another one each time: each column is its joint's."""

    class Shuffled(Arm):
        joint_names = None  # type: ignore[assignment]

        def read(self):
            order = [NAMES[(j + self.k) % 3] for j in range(3)]
            return tuple({name: part[NAMES.index(name)] for name in order} for part in super().read())

    arm = Shuffled([(1.0, 2.0)], efforts=True)
    (file,) = record(arm, tmp_path, duration=6.0).files
    header, table = file.read_text(encoding="utf-8").splitlines()[0].split(","), rows(file)
    for row in table[::10]:
        arm.k = round(row[0] / arm.period)
        for part, ending in zip(Arm.read(arm), ("", VELOCITY_SUFFIX, EFFORT_SUFFIX), strict=True):
            assert [row[header.index(name + ending)] for name in NAMES] == [*part]
