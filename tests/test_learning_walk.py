"""The way of demonstrations in memory through the learner stays short."""

from __future__ import annotations

import sys
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import manip_learn as ml
from manip_learn import learning

DATA = Path(__file__).resolve().parents[1] / "examples" / "data"
LIBRARY, ROOM = ml.__path__[0], learning.__path__[0]
# functions and files that a fit passes through at most, in learning/ and in all rooms
IN_LEARNING, IN_ALL = (249, 18), (425, 46)


def walk(learner: ml.ConstraintLearner, demos: ml.Demonstrations) -> set[CodeType]:
    """Every function of the library that a fit calls, generators and lambdas left out."""
    seen: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(LIBRARY) and frame.f_code.co_name[0] != "<":
            seen.add(frame.f_code)

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        learner.fit(demos)
    finally:
        sys.setprofile(before)
    return seen


def test_a_fit_in_memory_walks_few_functions():
    """A fit of the default learner to a cut drawer calls at most 249 functions in 18 files of learning/, none of
    streaming/, and 425 in 46 of all rooms.
    """
    robot = ml.load_robot("sawyer")
    demos = ml.load_demonstrations([DATA / "sawyer_drawer"], robot)[:6]
    maps = [ml.FrameJacobian(robot, "right_gripper_tip", "xyz", reference) for reference in ("world", "local")]
    seen = walk(ml.ConstraintLearner(maps), demos)
    for most, rooms in ((IN_LEARNING, ROOM), (IN_ALL, LIBRARY)):
        functions = {f"{c.co_filename}:{c.co_qualname}" for c in seen if c.co_filename.startswith(rooms)}
        files = {name.rpartition(":")[0] for name in functions}
        assert 5 < len(functions) <= most[0], sorted(functions)
        assert len(files) <= most[1], sorted(files)
    assert not [c.co_filename for c in seen if "streaming" in c.co_filename]
