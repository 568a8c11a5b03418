"""A contact that one recording alone shows is named beside the one that all show, a door included."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

import manip_learn as ml

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
LOCKED = {"panda": ("panda_finger_joint1", "panda_finger_joint2")}


@pytest.mark.parametrize(
    ("robot", "seed"),
    [
        pytest.param("panda", 4000, id="recombined recordings must not keep the door of one of them"),
        pytest.param("xarm7", 4001, id="a door that is found as a tether"),
    ],
)
def test_the_drawer_of_one_recording_is_named_beside_the_door_of_all(robot: str, seed: int):
    """Six recordings of a door, the last of which opens a drawer too: the hinge is learnt, no recording is odd, and the
    drawer is named where it is.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        make_set = importlib.import_module("make_recordings.kinematic_sets").make_set
        motions, truth = make_set("door_then_drawer", robot, seed, 6)
    demos = []
    for i, (t, q) in enumerate(motions):
        first, second = truth["windows"][i]
        kept = t < (np.inf if i == 5 else 0.5 * (first[1] + second[0]))
        demos.append(ml.Trajectory(t[kept], q[kept], name=f"demo_{i}"))
    arm = ml.load_robot(robot, locked=LOCKED.get(robot, ()))
    maps = [ml.FrameJacobian(arm, truth["tip"], "xyz", reference) for reference in ("world", "local")]
    report = ml.ConstraintLearner(maps).fit(demos).report_
    assert report.mechanism is not None and report.mechanism.type == "hinge"
    assert not report.odd_trajectories
    alone = [p for p in report.phases if p.reason == "appears in one recording only"]
    assert [p.trajectory for p in alone] == ["demo_5"]
    start, end, _ = truth["windows"][5][1]
    assert min(alone[0].end, end) - max(alone[0].start, start) > 0.8 * (end - start)
