"""What is compiled ahead of time is what the first loop needs."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

import manip_learn as ml

LATER = """
import manip_learn as ml
from numba.core.event import install_recorder
robot = ml.load_robot("sawyer")
rows = ml.Constraint([[0, 1, 0]], ml.FrameJacobian(robot, "right_hand"))
with install_recorder("numba:compile") as compiled:
    loop = ml.ServoLoop(ml.ResolvedRateController(rows, ml.PointAttractor([0.1]), ml.ManipulabilityAscent(rows)))
    loop.update([0.0] * 7, 0.0)
print(len(compiled.buffer), type(loop.controller).__name__)
"""


@pytest.mark.timeout(600)
def test_a_later_process_starts_at_once() -> None:
    """Another process, with another robot and other parts of the law, compiles nothing, and announces nothing."""
    pytest.importorskip("numba")
    rows = ml.Constraint([[1, 0]], ml.FrameJacobian(ml.load_robot("planar3"), "tip", "x y"))
    assert ml.warm_up(ml.ResolvedRateController(rows)).step
    later = subprocess.run([sys.executable, "-c", LATER], capture_output=True, text=True, check=True)
    assert later.stdout.split() == ["0", "CompiledController"]
    assert "compiling" not in later.stderr


def test_what_cannot_be_compiled_is_left_as_it_is() -> None:
    """A controller of the user's own, and a loop that has been made."""
    done = ml.warm_up(lambda q, t, dt: None)  # type: ignore[arg-type, return-value]
    assert not done.step


@pytest.mark.timeout(600)
def test_the_command_says_what_it_did(capsys: pytest.CaptureFixture[str]) -> None:
    """One JSON document with --json, and a sentence without."""
    pytest.importorskip("numba")
    from manip_learn.cli import main

    assert main(["warm-up", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["compiled"] is True and answer["seconds"] >= 0.0
    assert main(["warm-up"]) == 0
    assert "control steps are compiled" in capsys.readouterr().out
