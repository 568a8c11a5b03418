"""The way of demonstrations in memory through the learner stays short."""

from __future__ import annotations

import sys
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import manip_learn as ml
from manip_learn import learning

RECORDINGS = Path(__file__).resolve().parents[1] / "examples" / "data"
ROOM = learning.__path__[0]
FUNCTIONS, FILES = 249, 25


def test_a_fit_in_memory_walks_few_functions():
    """A fit to a cut drawer calls at most 249 functions in 25 files of learning/, none in streaming/."""
    robot = ml.load_robot("sawyer")
    demos = ml.load_demonstrations([RECORDINGS / "sawyer_drawer"], robot)[:6]
    maps = [ml.FrameJacobian(robot, "right_gripper_tip", "xyz", reference) for reference in ("world", "local")]
    seen: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        path = frame.f_code.co_filename
        if event == "call" and path.startswith(ROOM):
            seen.add(frame.f_code)

    learner = ml.ConstraintLearner(maps)
    before = sys.getprofile()
    sys.setprofile(note)
    try:
        learner.fit(demos)
    finally:
        sys.setprofile(before)
    functions = {f"{code.co_filename}:{code.co_qualname}" for code in seen if not code.co_name.startswith("<")}
    files = {code.co_filename for code in seen}
    assert 5 < len(functions) <= FUNCTIONS, sorted(functions)
    assert len(files) <= FILES, sorted(files)
    assert not [file for file in files if "streaming" in file]
