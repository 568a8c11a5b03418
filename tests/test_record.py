"""Recording by hand: every sample is kept, whatever happens, and the arm is held in the end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from case import case

from manip_learn.cli import main
from manip_learn.drivers.record import RESTS, record
from manip_learn.errors import ConfigurationError, OutputError
from manip_learn.recordings import load_demonstrations
from manip_learn.robot import load_robot

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


def rows(file: Path) -> list[list[float]]:
    lines = file.read_text(encoding="utf-8").splitlines()[1:]
    return [[float(x) for x in line.split(",")] for line in lines]


def test_each_motion_is_a_file_of_its_own(tmp_path: Path):
    """A file begins half a second before the joints move and ends when they have rested; nothing in it is missing, the
    numbers come back bit for bit, and the arm is released before and held after.
    """
    arm = Arm([(2.0, 4.0), (8.0, 9.5)], efforts=True)
    done = record(arm, tmp_path / "demos", "drawer", duration=14.0)
    assert [file.name for file in done.files] == ["drawer_01.csv", "drawer_02.csv"]
    assert (done.lost, done.ordered, arm.calls) == (0, True, ["release", "hold"])
    for file, (begin, end) in zip(done.files, arm.moves, strict=True):
        table = np.array(rows(file))
        assert begin - 0.5 < table[0, 0] < begin - 0.3 and end + 1.0 < table[-1, 0] < end + RESTS + 0.2
        assert np.allclose(np.diff(table[:, 0]), 0.01)
        arm.k = round(table[50, 0] / 0.01)
        q, u, effort = arm.read()
        assert table[50].tolist() == [table[50, 0], *q, *u, *effort]
    demos = load_demonstrations([str(file) for file in done.files], load_robot("planar3"))
    assert demos[0].u is not None and demos[0].effort is not None and len(demos) == 2
    assert sum(map(len, demos)) == done.samples


def test_the_key_begins_and_ends(tmp_path: Path):
    """By key nothing begins by itself, a file is what lies between two presses and half a second before, and numbers of
    files go on where the folder has some.
    """
    presses = {150: "start or stop", 350: "start or stop", 500: "end"}
    for first in (1, 2):
        arm = Arm([(1.0, 6.0)])
        done = record(arm, tmp_path, "wipe", by="key", key=lambda arm=arm: presses.get(arm.k, ""))  # type: ignore[arg-type]
        assert [file.name for file in done.files] == [f"wipe_{first:02d}.csv"]
        table = np.array(rows(done.files[0]))
        assert table[0, 0] == pytest.approx(1.0) and table[-1, 0] == pytest.approx(3.5)
        assert done.ended == "ended by key"


def test_whatever_a_driver_does_the_files_are_kept(tmp_path: Path):
    """A driver that raises, gives no posture, or loses a joint ends the recording in one sentence; what came before is
    kept, complete, and the arm is held.
    """

    class Failing(Arm):
        fault: object = None

        def read(self):
            if self.t >= 2.5:
                if isinstance(self.fault, Exception):
                    raise self.fault
                return self.fault, None, None
            return super().read()

    faults = {
        "the driver's read() failed: OSError: port gone": OSError("port gone"),
        "the driver has given no posture for 1 s": None,
        "the driver has given no posture for 1  s": np.array([0.1, np.nan, 0.2]),
        "the driver has given no posture for 1   s": {"joint1": 0.3, "joint2": 0.1},
    }
    for sentence, fault in faults.items():
        with case(sentence) as folder:
            arm = Failing([(1.0, 8.0)])
            arm.fault = fault
            done = record(arm, folder, duration=20.0)
            assert done.ended == " ".join(sentence.split()) and not done.ordered and arm.calls[-1] == "hold"
            assert len(rows(done.files[0])) == done.samples and rows(done.files[0])[-1][0] > 2.4


def test_a_hand_guided_mode_that_is_not_there_is_said(tmp_path: Path):
    """Where release() refuses, its sentence is a note; a driver without it is recorded as it is; a simulated one that
    cannot wait, names that nobody gives and a folder that cannot be are refused before anything begins.
    """
    arm = Arm([(1.0, 2.0)])
    arm.release = lambda: (_ for _ in ()).throw(ConfigurationError("press the button on the wrist"))  # type: ignore
    assert record(arm, tmp_path, duration=5.0).notes == ("press the button on the wrist",)
    nameless = Arm([(1.0, 2.0)])
    nameless.joint_names = None  # type: ignore[assignment]
    with pytest.raises(ConfigurationError, match="names no joints"):
        record(nameless, tmp_path, duration=5.0)
    still = Arm([])
    still.wait = None  # type: ignore[assignment, method-assign]
    with pytest.raises(ConfigurationError, match="wait"):
        record(still, tmp_path, duration=5.0)
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(OutputError, match="cannot make the folder"):
        record(arm, tmp_path / "file" / "demos", duration=1.0)


PROGRAM = """
import resource, sys, time
import numpy as np
from manip_learn.drivers.record import record

class Arm:
    joint_names, period = ("joint1", "joint2", "joint3"), 0.005
    begun = time.perf_counter()
    def read(self):
        t = time.perf_counter() - self.begun
        return np.array([t, 0.1 * t, -t]), None, None
    def hold(self):
        print("held", flush=True)

limit, duration = int(sys.argv[2]), float(sys.argv[3])
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
def shown(q, recorded):
    if recorded:
        print(repr(q["joint1"]), flush=True)
done = record(Arm(), sys.argv[1], shown=shown, duration=duration)
print(done.ended, flush=True)
"""


def started(folder: Path, limit: int, duration: float) -> subprocess.Popen[str]:
    words = [sys.executable, "-c", textwrap.dedent(PROGRAM), str(folder), str(limit), str(duration)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_killed_program_loses_a_tenth_of_a_second(tmp_path: Path):
    """After kill -9 the file has whole lines only, and all but the last 0.1 s of what had been read."""
    with started(tmp_path, 0, 60.0) as program:
        assert program.stdout is not None and program.stderr is not None
        last = 0.0
        for line in program.stdout:
            last = float(line)
            if last > 1.5:
                break
        program.send_signal(signal.SIGKILL)
        for line in program.stdout.read().splitlines():
            last = float(line)
    (file,) = tmp_path.glob("*.csv")
    assert file.read_text(encoding="utf-8").endswith("\n")
    table = rows(file)
    assert last - table[-1][1] <= 0.1
    assert len(load_demonstrations([str(file)], load_robot("planar3"))[0]) == len(table)


def test_a_full_disk_keeps_what_it_has(tmp_path: Path):
    """Where there is no more room, recording ends with a sentence, the arm is held, and the file is whole lines."""
    program = started(tmp_path, 9000, 60.0)
    out, error = program.communicate(timeout=60.0)
    (file,) = tmp_path.glob("*.csv")
    assert not error and out.splitlines()[-2] == "held"
    assert out.splitlines()[-1].startswith("the disk is full, make room; the samples before are kept in")
    content = file.read_text(encoding="utf-8")
    assert 8800 < len(content) <= 9000 and content.endswith("\n")
    assert len(load_demonstrations([str(file)], load_robot("planar3"))[0]) == content.count("\n") - 1


def test_ctrl_c_ends_it(tmp_path: Path):
    """Ctrl-C completes the file and holds the arm, without a traceback."""
    program = started(tmp_path, 0, 60.0)
    assert program.stdout is not None
    for line in program.stdout:
        if float(line) > 0.5:
            break
    program.send_signal(signal.SIGINT)
    out, error = program.communicate(timeout=30.0)
    assert out.splitlines()[-2:] == ["held", "Ctrl-C"] and not error
    (file,) = tmp_path.glob("*.csv")
    assert rows(file)[-1][1] > 0.5


ARM = """
import numpy as np

class Arm:
    joint_names, period, simulated, k = ("joint1", "joint2", "joint3"), 0.01, True, 0
    def read(self):
        t = 0.01 * self.k
        n, s = divmod(t, 6.0)
        way = 0.5 - 0.5 * np.cos(np.pi * np.clip(s - 2.0, 0.0, 2.0))
        # the hand goes along x and back, each time with another elbow
        x, y = 1.6 + 0.5 * way, 0.8
        bend = 0.6 + 0.15 * n
        reach = np.hypot(x - np.cos(bend), y - np.sin(bend))
        b = np.arccos(np.clip(reach / 2.0, -1.0, 1.0))
        toward = np.arctan2(y - np.sin(bend), x - np.cos(bend))
        return np.array([bend, toward + b - bend, -2.0 * b]), None, None
    def wait(self):
        self.k += 1

arm, number = Arm(), 3

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
    for words, sentence in {
        f"{tmp_path / 'arm.py'}:none": "has no attribute 'none'",
        f"{tmp_path / 'arm.py'}:number": "'int' object is not callable",
        f"{tmp_path / 'arm.py'}:broken": "OSError: no port",
        f"{tmp_path / 'other.py'}:Arm": "does not exist",
        "arm": "FILE.py:NAME",
        "json:dumps": "no driver json:dumps",
    }.items():
        with case(words):
            assert main(["record", words, "--out", str(tmp_path / "x"), "--no-browser"]) == 2
            assert sentence in capsys.readouterr().err
    assert main([*here, "--by", "knob"]) == 2 and "motion or key" in capsys.readouterr().err


def test_a_late_driver_is_counted(tmp_path: Path):
    """Periods in which no sample came are counted as lost, and the longest gap is told."""

    class Slow:
        joint_names, period = NAMES, 0.01
        n, begun = 0, time.perf_counter()

        def read(self):
            self.n += 1
            if self.n == 60:
                time.sleep(0.105)
            t = time.perf_counter() - self.begun
            return np.array([t, t, t]), None, None

    done = record(Slow(), tmp_path, duration=1.5)  # type: ignore[arg-type]
    assert 9 <= done.lost <= 40 and 0.1 < done.longest_gap < 0.4
    assert f"{done.lost} samples lost" in done.sentence and os.path.getsize(done.files[0]) > 100
