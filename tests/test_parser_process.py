"""Parsers of foreign formats that hang, crash or eat memory end in one sentence, and the next file is read."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from case import case

from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.readers import parser_process
from manip_learn.recordings.readers.parser_process import parsed_recordings
from manip_learn.recordings.readers.read_request import Block, ReadRequest, RobotOutline
from manip_learn.robot import Robot

ROBOT = RobotOutline(("a", "b"), (Block("b", "continuous"),), (-1.0, -np.inf), (1.0, np.inf))
REQUEST = ReadRequest(cast(Robot, ROBOT), chosen=frozenset({3, 1}))
PARSER = """
import os, time
import numpy as np
from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.readers.recording import Recording

def read(path, request):
    what = path.read_text()
    print("a library that talks")
    if what == "hang":
        while True:
            pass
    if what == "sleep":
        time.sleep(3600)
    if what == "abort":
        os.abort()
    if what == "memory":
        np.ones(2**40)
    if what == "bug":
        raise ZeroDivisionError("in the parser")
    if what == "refuse":
        raise RecordingError(f"{path.name}: no", code="no", path=path, line=7, column="a")
    if what == "missing":
        raise MissingExtraError("reading this", "ros")
    n = int(what)
    q = np.arange(2.0 * n).reshape(n, 2)
    for i in range(3):
        yield Recording(path, f"part {i}", np.arange(n) * 0.1, request.robot.joint_names, q + i, notes=("noted",))
"""


@pytest.fixture
def parser(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Name of a module that does what a file says; children that do not know it are not used."""
    (tmp_path / "odd_parser.py").write_text(PARSER)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(parser_process, "_IDLE", [])
    yield "odd_parser"
    for child in parser_process._IDLE:
        child.close()


def file(folder: Path, content: str) -> Path:
    path = folder / "demo.odd"
    path.write_text(content)
    return path


def refusal(parser: str, folder: Path, content: str) -> RecordingError:
    with pytest.raises(RecordingError) as caught:
        list(parsed_recordings(parser, file(folder, content), REQUEST))
    assert "\n" not in str(caught.value) and "demo.odd" in str(caught.value)
    return caught.value


def test_recordings_come_through_bit_for_bit(parser: str) -> None:
    """Names, notes and numbers, of nothing and of much."""
    for n in [0, 1, 50_000]:
        with case(n) as tmp_path:
            path = file(tmp_path, str(n))
            recordings = list(parsed_recordings(parser, path, REQUEST))
            assert [r.name for r in recordings] == ["part 0", "part 1", "part 2"]
            for i, recording in enumerate(recordings):
                assert recording.path == path and recording.notes == ("noted",) and recording.velocities is None
                assert recording.position_names == ("a", "b")
                np.testing.assert_array_equal(recording.positions, np.arange(2.0 * n).reshape(n, 2) + i)
                np.testing.assert_array_equal(recording.time, np.arange(n) * 0.1)


def test_a_request_comes_through_as_it_was() -> None:
    """Also infinite limits and sets."""
    assert pickle.loads(pickle.dumps(REQUEST.for_parser())) == REQUEST


def test_one_process_serves_many_files(parser: str, tmp_path: Path) -> None:
    """The process that read a file, or refused one, reads the next; so does one whose answers were not all wanted."""
    list(parsed_recordings(parser, file(tmp_path, "3"), REQUEST))
    (first,) = parser_process._IDLE
    assert refusal(parser, tmp_path, "refuse").code == "no"
    list(parsed_recordings(parser, file(tmp_path, "3"), REQUEST))
    assert parser_process._IDLE == [first]
    half = parsed_recordings(parser, file(tmp_path, "3"), REQUEST)
    next(half)
    half.close()
    after = list(parsed_recordings(parser, file(tmp_path, "4"), REQUEST))
    assert [len(r.time) for r in after] == [4, 4, 4] and [r.name for r in after] == ["part 0", "part 1", "part 2"]


def test_refusals_keep_their_place(parser: str, tmp_path: Path) -> None:
    """Code, path, line and column; and a missing extra names itself."""
    error = refusal(parser, tmp_path, "refuse")
    assert (error.code, error.path, error.line, error.column) == ("no", tmp_path / "demo.odd", 7, "a")
    with pytest.raises(MissingExtraError, match="reading this needs the optional extra 'ros'") as caught:
        list(parsed_recordings(parser, file(tmp_path, "missing"), REQUEST))
    assert caught.value.extra == "ros"


def test_a_crash_is_one_sentence(parser: str) -> None:
    """And the next file is read by another process."""
    for content, code in [("abort", "parser-crashed"), ("bug", "parser-crashed")]:
        with case(content, code) as tmp_path:
            assert refusal(parser, tmp_path, content).code == code
            assert len(list(parsed_recordings(parser, file(tmp_path, "2"), REQUEST))) == 3


@pytest.mark.skipif(sys.platform != "linux", reason="limits of memory and processor time")
def test_a_parser_that_hangs_or_eats_memory_is_ended(
    parser: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Processor time and memory are limited by the size of the file; so is silence without any processor time."""
    assert "Unable to allocate" in str(refusal(parser, tmp_path, "memory"))
    monkeypatch.setattr(parser_process, "SECONDS", 0.5)
    assert refusal(parser, tmp_path, "hang").code == "parser-time"
    list(parsed_recordings(parser, file(tmp_path, "2"), REQUEST))
    monkeypatch.setattr(parser_process, "SLACK", 0.5)
    assert refusal(parser, tmp_path, "sleep").code == "parser-time"


INTERRUPTED = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell has background jobs ignore it
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from manip_learn.recordings.readers import parser_process
from manip_learn.recordings.readers.parser_process import parsed_recordings
from manip_learn.recordings.readers.read_request import ReadRequest, RobotOutline
request = ReadRequest(RobotOutline((), (), (), ()))
list(parsed_recordings("odd_parser", Path(sys.argv[2]), request))
print("reading", flush=True)
try:
    list(parsed_recordings("odd_parser", Path(sys.argv[3]), request))
except KeyboardInterrupt:
    print("interrupted", parser_process._IDLE)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_ctrl_c_ends_a_parser_that_is_deaf(parser: str, tmp_path: Path) -> None:
    """An interrupt while the parser hangs is answered by the caller, which ends the parser."""
    (tmp_path / "two.odd").write_text("2")
    script = [sys.executable, "-c", INTERRUPTED, str(tmp_path), str(tmp_path / "two.odd"), str(file(tmp_path, "hang"))]
    process = subprocess.Popen(script, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "reading\n"
    time.sleep(1.0)  # until it has handed the file over
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=60)
    assert said == "interrupted []\n" and process.returncode == 0
