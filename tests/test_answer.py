"""Rows, mechanism and odd recordings of one answer say the same."""

from __future__ import annotations

import pytest
from test_explanation import recordings

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError


def learnt(kind: str, robot: str, seed: int, n: int, *, whole: bool, axes: str = "xyz") -> ml.ConstraintLearner:
    """Fitted to generated recordings, in the world's and in the tool's axes."""
    features, trajectories, _ = recordings(kind, robot, seed, n, whole=whole)
    maps = [ml.FrameJacobian(features.robot, features.frame.name, axes, r) for r in ("world", "local")]
    return ml.ConstraintLearner(maps).fit(trajectories)


@pytest.mark.parametrize("robot", ["panda", "sawyer"])
def test_a_door_in_whole_recordings_keeps_both_rows(robot: str):
    """The phases show one constant row, along the axis; the radial row of the hinge is held as well."""
    learner = learnt("door", robot, 2031, 6, whole=True)
    assert learner.report_.mechanism is not None
    assert learner.report_.mechanism.type == "hinge"
    assert learner.constraint_.features.row_names == ("radial", "axial")
    assert not any("asked for" in warning for warning in learner.report_.warnings)


def test_rows_and_mechanism_do_not_contradict_each_other():
    """A firm lever about an axis: no constant rows of the world's axes beside a hinge that turns them."""
    learner = learnt("hinge", "xarm7", 2001, 6, whole=False, axes="pose")
    assert learner.report_.mechanism is not None
    assert learner.report_.mechanism.type == "hinge"
    if learner.report_.reference == "world":
        assert not learner.report_.sentence.startswith("The tip can move along")
    assert learner.constraint_.n_constraints == 5


def test_one_free_motion_is_no_ball():
    """A single free motion stays near some sphere: that alone is no answer, and the reason is said."""
    with pytest.raises(NotIdentifiableError, match="^record at least 3, better 5, .* not 1 recording"):
        learnt("free", "panda", 1000, 1, whole=True)


def test_a_door_elsewhere_is_left_out_of_the_rows_too():
    """Recordings in which the others' hinge does not hold are named, and both rows of the others are kept."""
    features, trajectories, truth = recordings("door_other_place", "sawyer", 1003, 8, whole=True)
    maps = [ml.FrameJacobian(features.robot, features.frame.name, "xyz", r) for r in ("world", "local")]
    learner = ml.ConstraintLearner(maps).fit(trajectories)
    named = {odd.trajectory for odd in learner.report_.odd_trajectories}
    assert {trajectories[i].name for i in truth["contaminated"]} <= named
    assert learner.constraint_.n_constraints == 2


def test_a_tether_is_found_where_constant_rows_are_none():
    """The gap shows two weak constant rows that nothing holds; the sphere is the answer all the same."""
    learner = learnt("tether", "sawyer", 1007, 6, whole=False)
    assert learner.report_.mechanism is not None
    assert learner.report_.mechanism.type == "ball"
    assert learner.constraint_.features.row_names == ("spherical",)
