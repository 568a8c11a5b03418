"""What is compiled ahead of time is what the first loop needs."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

import manip_learn as ml
from manip_learn.control.driver import controllers_to_warm_up

LATER = """
import manip_learn as ml
from manip_learn.control.driver import controllers_to_warm_up
from numba.core.event import install_recorder
first, second = controllers_to_warm_up(ml.load_robot("sawyer"))
with install_recorder("numba:compile") as compiled:
    loops = [ml.ServoLoop(controller) for controller in (first, second)]
    loops[0].update([0.0] * 7, 0.0)
print(len(compiled.buffer), type(loops[0].controller).__name__, loops[1].controller.solver)
"""


@pytest.mark.timeout(600)
def test_a_later_process_starts_at_once(caplog: pytest.LogCaptureFixture) -> None:
    """Another process, with another robot, has its loops, compiles nothing, and announces nothing."""
    pytest.importorskip("numba")
    whole, limits = (ml.warm_up(controller) for controller in controllers_to_warm_up(ml.load_robot("planar3")))
    assert whole.step and not whole.limits and limits.limits and not limits.step
    later = subprocess.run([sys.executable, "-c", LATER], capture_output=True, text=True, check=True)
    compilations, kind, solver = later.stdout.split()
    assert (kind, solver) == ("CompiledController", "compiled")
    assert int(compilations) == 0
    assert "compiling" not in later.stderr


def test_what_cannot_be_compiled_takes_no_time() -> None:
    """A controller of the user's own, and a loop that has been made."""
    done = ml.warm_up(lambda q, t, dt: None)  # type: ignore[arg-type, return-value]
    assert not done.step and not done.limits and done.seconds < 1.0


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
