"""Recordings that do not belong are named, those that do are not, and two tasks in equal parts are two constraints;
rows, mechanism and odd recordings of one answer say the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from task_sets import generated, learnt, moving

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError
from manip_learn.linalg import row_space_angle


def away_from_axis(report: ml.LearningReport, truth: dict[str, Any]) -> float:
    """Distance between learnt and true axis where the door is [m]."""
    hinge, true = report.mechanism, truth["mechanisms"][0]
    assert hinge is not None and hinge.type == "hinge"
    return float(np.linalg.norm(np.cross(hinge.point - np.array(true["point"]), true["axis"])))


@pytest.mark.parametrize(
    ("robot", "seed", "whole"),
    [
        pytest.param("ur5", 606, False, id="short arcs among long ones"),
        pytest.param("xarm7", 601, False, id="a slip that a wide hinge would fit", marks=pytest.mark.slow),
        pytest.param("ur5", 602, True, id="an approach along the door", marks=pytest.mark.slow),
        pytest.param("sawyer", 607, True, id="a chance stretch beside the contact", marks=pytest.mark.slow),
        pytest.param("xarm7", 605, True, id="a slip that makes the first fit soft", marks=pytest.mark.slow),
        pytest.param("panda", 600, True, id="a slip across the axis only", marks=pytest.mark.slow),
        pytest.param("xarm7", 601, True, id="a piece of the arc that is a line of its own"),
    ],
)
def test_a_slip_at_a_door_is_named_and_nothing_else(robot: str, seed: int, whole: bool):
    """The hand slips on a loosely held door in some of eight recordings: these are named, and the hinge is found to a
    millimetre from the others.
    """
    truth, demos = generated("door_slip", robot, seed, 8, whole)
    learner = learnt(robot, truth["tip"], demos)
    named = {odd.trajectory for odd in learner.report_.odd_trajectories}
    assert named == {f"demo_{i}" for i in truth["contaminated"]}
    assert len(learner.constraints_) == 1
    assert away_from_axis(learner.report_, truth) < 1e-3


@pytest.mark.parametrize(
    ("robot", "seed"),
    [
        pytest.param("ur5", 7002, id="slips so large that the evidence of all eight drowns in them"),
        pytest.param("sawyer", 7503, id="slips halfway", marks=pytest.mark.slow),
    ],
)
def test_a_slip_at_a_drawer_is_named_and_nothing_else(robot: str, seed: int):
    """The hand slips in two or three of eight whole recordings of a drawer: these are named, and the others show its
    line to 0.02 degrees.
    """
    truth, demos = generated("drawer_slip", robot, seed, 8, whole=True)
    learner = learnt(robot, truth["tip"], demos)
    named = {odd.trajectory for odd in learner.report_.odd_trajectories}
    assert named == {f"demo_{i}" for i in truth["contaminated"]}
    assert len(learner.constraints_) == 1
    rows = np.array(truth["mechanisms"][0]["rows"])[:, :3]
    assert np.degrees(row_space_angle(learner.constraint_.selection, rows)) < 0.02


def learnt_half_and_half(
    kind: str, robot: str, seed: int, whole: bool
) -> tuple[dict[str, Any], dict[str, Any], ml.ConstraintLearner]:
    """Truth of demo_0 to demo_3, truth of demo_4 to demo_7, and what is learnt from both together."""
    truth, demos = generated(kind, robot, seed, 4, whole)
    other, more = generated(kind, robot, seed + 5000, 4, whole)
    more = [ml.Trajectory(t.time, t.q, name=f"demo_{i + 4}") for i, t in enumerate(more)]
    return truth, other, learnt(robot, truth["tip"], [*demos, *more])


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_two_doors_in_equal_parts_are_two_hinges(whole: bool):
    """Four recordings of one door and four of another, which share a sphere: each has its own hinge."""
    truth, other, learner = learnt_half_and_half("door", "xarm7", 601, whole)
    members = [{p.trajectory for p in learner.report_.phases if p.constraint == k} for k in range(2)]
    halves = [{f"demo_{i}" for i in range(4)}, {f"demo_{i}" for i in range(4, 8)}]
    assert sorted(members, key=min) == halves
    for mine, report in zip(members, learner.reports_, strict=True):
        assert away_from_axis(report, truth if mine == halves[0] else other) < 1e-3


@pytest.mark.slow
def test_pairs_that_share_a_direction_are_no_answer():
    """Free motion in which one joint moves at a time: whatever two of six recordings share, nothing is held."""
    truth, demos = generated("free_one_joint", "xarm7", 7017, 6, True)
    cut = [t.part(slice(len(t) // 3, len(t) // 3 + 250)) for t in demos]
    with pytest.raises(NotIdentifiableError):
        learnt("xarm7", truth["tip"], cut)


def test_a_door_and_a_table_beside_a_drawer_are_not_pooled():
    """Three cut recordings each of a drawer, a door and a table whose normal is 11 degrees from the door's axis: three
    constraints, each from its own recordings.
    """
    demos, truths = [], []
    for kind, seed in (("drawer", 4004), ("door", 5004), ("table", 6004)):
        truth, made = generated(kind, "panda", seed, 3, whole=False)
        truths.append(truth["mechanisms"][0])
        demos += [ml.Trajectory(t.time, t.q, name=f"demo_{len(demos) + i}") for i, t in enumerate(made)]
    learner = learnt("panda", truth["tip"], demos)
    tasks = [{p.trajectory for p in learner.report_.phases if p.constraint == k} for k in range(3)]
    assert sorted(map(sorted, tasks)) == [[f"demo_{3 * k + i}" for i in range(3)] for k in range(3)]
    for task, report in zip(tasks, learner.reports_, strict=True):
        assert report.mechanism is not None and report.mechanism.axis is not None
        true = truths[int(min(task).removeprefix("demo_")) // 3]
        assert np.linalg.norm(np.cross(report.mechanism.axis, true["axis"])) < np.radians(0.1)


def test_a_door_elsewhere_is_left_out_of_the_rows_too():
    """Recordings in which the others' hinge does not hold are named, and both rows of the others are kept."""
    _, trajectories, truth = moving("door_other_place", "sawyer", 1003, 8)
    learner = learnt("sawyer", truth["tip"], trajectories)
    named = {odd.trajectory for odd in learner.report_.odd_trajectories}
    assert {trajectories[i].name for i in truth["contaminated"]} <= named
    assert learner.constraint_.n_constraints == 2


@pytest.mark.parametrize(
    ("kind", "robot", "seed", "whole", "axes", "mechanism", "rows"),
    [
        pytest.param("door", "panda", 2031, True, "xyz", "hinge", ("radial", "axial"),
                     id="the phases show one constant row of a door, along the axis"),
        pytest.param("hinge", "xarm7", 2001, False, "pose", "hinge", 5, id="a firm lever has no constant rows beside"),
        pytest.param("tether", "sawyer", 1007, False, "xyz", "ball", ("spherical",),
                     id="the gap shows two weak constant rows that nothing holds"),
    ],
)  # fmt: skip
def test_rows_and_mechanism_do_not_contradict_each_other(kind, robot, seed, whole, axes, mechanism, rows):
    """All rows of the mechanism are held, none of the world's axes beside them."""
    _, trajectories, truth = moving(kind, robot, seed, 6, whole)
    learner = learnt(robot, truth["tip"], trajectories, axes)
    report = learner.report_
    assert report.mechanism is not None and report.mechanism.type == mechanism
    if isinstance(rows, int):
        assert learner.constraint_.n_constraints == rows
        assert report.reference != "world" or not report.sentence.startswith("The tip can move along")
    else:
        assert learner.constraint_.features.row_names == rows
    assert not whole or not any("asked for" in warning for warning in report.warnings)


def test_one_free_motion_is_no_ball():
    """A single free motion stays near some sphere: that alone is no answer, and the reason is said."""
    _, trajectories, truth = moving("free", "panda", 1000, 1)
    with pytest.raises(NotIdentifiableError, match="^record at least 3, better 5, .* not 1 recording"):
        learnt("panda", truth["tip"], trajectories)
