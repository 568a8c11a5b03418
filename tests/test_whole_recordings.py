"""The learner on recordings as people make them: uncut, of two tasks, loosely held, mixed, or of nothing at all.

Recordings that do not belong are named, those that do are not; rows, mechanism and odd recordings say the same.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from task_sets import arm, generated, learnt, learnt_from, moving, shipped, true_rows

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError
from manip_learn.linalg import row_space_angle

MOVES = 0.01  # a tip slower than this is at rest [m/s]


def degrees(constraint: ml.Constraint, truth: dict[str, Any], mechanism: int = 0) -> float:
    """Angle between the rows that are learnt and the true ones."""
    return float(np.degrees(row_space_angle(constraint.selection, true_rows(truth, mechanism))))


def named(report: ml.LearningReport) -> set[str]:
    return {odd.trajectory for odd in report.odd_trajectories}


def away_from_axis(report: ml.LearningReport, true: dict[str, Any]) -> float:
    """Distance between learnt and true axis where the door is [m]."""
    hinge = report.mechanism
    assert hinge is not None and hinge.type == "hinge"
    return float(np.linalg.norm(np.cross(hinge.point - np.array(true["point"]), true["axis"])))


def check_windows(truth: dict[str, Any], demos: ml.Demonstrations, learner: ml.ConstraintLearner, order: list[int]):
    """Of the time in which the tip moves, 95 % of each contact is found and hardly anything outside it."""
    features = ml.FrameJacobian(learner.constraint_.robot, truth["tip"], "xyz")
    for k, number in enumerate(order):
        inside = outside = total = 0
        for t, windows in zip(demos, truth["windows"], strict=True):
            trajectory = ml.derive_velocities(t, features.robot)
            time, rates = trajectory.time, np.einsum("npv,nv->np", features.batch(trajectory.q), trajectory.u)
            moves = np.linalg.norm(rates, axis=1) > MOVES
            held = np.any([(time >= a) & (time <= b) for a, b, which in windows if which == number], axis=0)
            spans = [p for p in learner.report_.phases if p.trajectory == t.name and p.constraint == k]
            found = np.any([(time >= p.start) & (time <= p.end) for p in spans], axis=0)
            inside += np.count_nonzero(held & found & moves)
            outside += np.count_nonzero(~held & found & moves)
            total += np.count_nonzero(held & moves)
        assert inside >= 0.95 * total
        assert outside <= 0.03 * (inside + outside)


def test_whole_recordings_of_a_drawer():
    """Approach and retreat are told from the contact, and the drawer's direction is right to 0.1 degrees."""
    (truth, demos), learner = shipped("panda_drawer_whole"), learnt_from("panda_drawer_whole")
    report = learner.report_
    assert report.n_constraints == 2 and len(learner.constraints_) == 1
    assert degrees(learner.constraint_, truth) < 0.1
    # smoothed velocities share their noise between neighbours, which is no sign of more than was thought of the arm
    assert report.uncertainty_deg is not None and report.uncertainty_deg < 0.2
    assert report.mechanism is not None and report.mechanism.type == "line"
    assert [row.state for row in report.row_evidence] == ["held", "held", "free"]
    assert all(row.p_value <= 0.01 and row.strength > 5.0 for row in report.row_evidence[:2])
    assert not report.odd_trajectories
    check_windows(truth, demos, learner, [0])


def test_two_tasks_in_one_recording():
    """A drawer and then a table in the same files are two constraints, each right to 0.3 degrees."""
    (truth, demos), learner = shipped("xarm7_drawer_then_table"), learnt_from("xarm7_drawer_then_table")
    assert len(learner.constraints_) == 2
    order = sorted(range(2), key=lambda number: -len(true_rows(truth, number)))
    found = sorted(learner.constraints_, key=lambda c: -c.n_constraints)
    for constraint, number in zip(found, order, strict=True):
        assert degrees(constraint, truth, number) < 0.3
    check_windows(truth, demos, learner, [order[found.index(c)] for c in learner.constraints_])


def test_the_drawer_of_one_recording_is_named_beside_the_door_of_all():
    """Six recordings of a door, the last of which opens a drawer too: the hinge is learnt, no recording is odd, and the
    drawer is named where it is.
    """
    truth, made = generated("door_then_drawer", "panda", 4000, 6)
    ends = [0.5 * (first[1] + second[0]) for first, second in truth["windows"]]
    demos = [t.part(slice(int(np.searchsorted(t.time, end)))) for t, end in zip(made[:5], ends, strict=False)]
    report = learnt("panda", truth["tip"], [*demos, made[5]]).report_
    assert report.mechanism is not None and report.mechanism.type == "hinge"
    assert not report.odd_trajectories
    alone = [p for p in report.phases if p.reason == "appears in one recording only"]
    assert [p.trajectory for p in alone] == ["demo_5"]
    start, end, _ = truth["windows"][5][1]
    assert min(alone[0].end, end) - max(alone[0].start, start) > 0.8 * (end - start)


def test_a_loosely_held_door_is_a_hinge(tmp_path: Path):
    """The rows that turn with the door are found; the constraint is saved, read back and controlled."""
    (truth, demos), learner = shipped("ur5_loose_door"), learnt_from("ur5_loose_door")
    mechanism, constraint = learner.report_.mechanism, learner.constraint_
    (true,) = truth["mechanisms"]
    assert mechanism is not None and mechanism.type == "hinge" and constraint.n_constraints == 2
    assert np.degrees(np.arccos(min(1.0, abs(float(mechanism.axis @ true["axis"]))))) < 0.1
    assert away_from_axis(learner.report_, true) < 1e-3
    assert mechanism.radius == pytest.approx(true["radius"], abs=1e-3)
    again = ml.Constraint.load(constraint.save(tmp_path / "door.json"), constraint.robot)
    np.testing.assert_array_equal(again(demos[0].q[0]), constraint(demos[0].q[0]))
    controller = ml.ResolvedRateController(constraint, null_policy=ml.ManipulabilityAscent(constraint))
    rollout = ml.simulate(constraint.robot, controller, demos[0].q[0], duration=1.0, dt=0.01)
    places = np.array([constraint.robot.position(q, "tool0") for q in rollout.q]) - mechanism.point
    height = places @ mechanism.axis
    radius = np.linalg.norm(places - np.outer(height, mechanism.axis), axis=1)
    assert np.ptp(height) < 1e-4 and np.ptp(radius) < 1e-4  # [m], of 0.4 m; nothing pulls the hand back


def test_another_drawer_among_the_recordings_is_named():
    """The odd recordings are named with the reason, and the answer is that of the others: no row disappears. What only
    two of them show is learnt if it is wanted, and else named.
    """
    (truth, demos), learner = shipped("panda_drawer_mixed"), learnt_from("panda_drawer_mixed")
    assert learner.report_.warnings[0].startswith("2 rows in 2 stretches not learnt: they may only be habits")
    assert len(ml.ConstraintLearner(learner.features, keep_habits=True).fit(demos).constraints_) == 2
    assert learner.report_.n_constraints == 2 and degrees(learner.constraint_, truth) < 0.1
    assert named(learner.report_) == {demos[i].name for i in truth["contaminated"]}
    assert all("mm along a direction" in odd.reason for odd in learner.report_.odd_trajectories)


@pytest.mark.parametrize("kind", ["free_repeated", "free_slow"])
def test_free_motion_is_no_constraint(kind: str):
    """Reaches, a reach that is repeated, sticking joints and slow motion are refused, with what to do."""
    truth, demos = generated(kind, "xarm7", 1500, 6)
    with pytest.raises(NotIdentifiableError, match=r"^[a-z]([^.]|\.\d)*\. [A-Z]"):
        ml.ConstraintLearner(ml.FrameJacobian(arm("xarm7"), truth["tip"], "xyz")).fit(demos)


@pytest.mark.parametrize(
    ("thing", "robot", "seed", "whole"),
    [
        pytest.param("door", "ur5", 606, False, id="short arcs among long ones"),
        pytest.param("door", "xarm7", 601, True, id="a piece of the arc that is a line of its own"),
        pytest.param("drawer", "ur5", 7002, True, id="slips so large that the evidence of all eight drowns in them"),
        pytest.param("drawer", "xarm7", 1201, True, id="a slip that the phases cut out"),
    ],
)
def test_a_slip_is_named_and_nothing_else(thing: str, robot: str, seed: int, whole: bool):
    """The hand slips in some of eight recordings: these are named, some with the moment, and the others show the hinge
    of the door to a millimetre, the line of the drawer to 0.02 degrees.
    """
    truth, demos = generated(f"{thing}_slip", robot, seed, 8, whole)
    learner = learnt(robot, truth["tip"], demos)
    assert named(learner.report_) == {f"demo_{i}" for i in truth["contaminated"]} and len(learner.constraints_) == 1
    if thing == "door":
        assert away_from_axis(learner.report_, truth["mechanisms"][0]) < 1e-3
    else:
        assert degrees(learner.constraint_, truth) < 0.02
    for odd, number in zip(learner.report_.odd_trajectories, truth["contaminated"], strict=True):
        (_, before, _), (after, _, _) = truth["windows"][number]
        said = re.search(r"(?:at|interrupted from) (\d+\.\d+) s", odd.reason)
        assert seed != 1201 or (said is not None and before - 0.3 < float(said[1]) < after + 0.1)


def test_phases_can_be_turned_off():
    """With `phases="off"` whole recordings are refused, and the refusal says that they are not of one piece."""
    truth, demos = shipped("panda_drawer_whole")
    features = ml.FrameJacobian(arm("panda"), truth["tip"], "xyz")
    with pytest.raises(NotIdentifiableError, match="phases='auto'"):
        ml.ConstraintLearner(features, phases="off").fit(demos[:3])


@pytest.mark.parametrize(
    ("robot", "sets"),
    [
        pytest.param("xarm7", [("door", 601, 4, False), ("door", 5601, 4, False)], id="two doors that share a sphere"),
        pytest.param("panda", [("drawer", 4004, 3, False), ("door", 5004, 3, False), ("table", 6004, 3, False)],
                     id="a table whose normal is 11 degrees from the axis of a door, and a drawer"),
    ],
)  # fmt: skip
def test_tasks_in_equal_parts_are_not_pooled(robot: str, sets: list):
    """As many recordings of each: so many constraints, each from its own recordings, the axis of each to 0.1 degrees,
    that of a door to a millimetre.
    """
    demos, truths, halves = [], [], []
    for one in sets:
        truth, made = generated(one[0], robot, *one[1:])
        truths.append(truth["mechanisms"][0])
        halves.append([f"demo_{len(demos) + i}" for i in range(len(made))])
        demos += [ml.Trajectory(t.time, t.q, name=name) for t, name in zip(made, halves[-1], strict=True)]
    learner = learnt(robot, truth["tip"], demos)
    tasks = [sorted({p.trajectory for p in learner.report_.phases if p.constraint == k}) for k in range(len(sets))]
    assert sorted(tasks) == halves
    for task, report in zip(tasks, learner.reports_, strict=True):
        true, mechanism = truths[halves.index(task)], report.mechanism
        assert mechanism is not None and mechanism.axis is not None
        assert np.linalg.norm(np.cross(mechanism.axis, true["axis"])) < np.radians(0.1)
        if sets[halves.index(task)][0] == "door" and len(sets) == 2:
            assert away_from_axis(report, true) < 1e-3


@pytest.mark.parametrize(
    ("kind", "robot", "seed", "whole", "mechanism", "rows"),
    [
        pytest.param("door", "panda", 2031, True, "hinge", ("radial", "axial"),
             id="the phases show one constant row of a door, along the axis"),
        pytest.param("tether", "sawyer", 1007, False, "ball", ("spherical",),
             id="the gap shows two weak constant rows that nothing holds"),
    ],
)  # fmt: skip
def test_rows_and_mechanism_do_not_contradict_each_other(kind, robot, seed, whole, mechanism, rows):
    """All rows of the mechanism are held, none of the world's axes beside them."""
    _, trajectories, truth = moving(kind, robot, seed, 6, whole)
    learner = learnt(robot, truth["tip"], trajectories)
    report = learner.report_
    assert report.mechanism is not None and report.mechanism.type == mechanism
    assert learner.constraint_.features.row_names == rows
    assert not whole or not any("asked for" in warning for warning in report.warnings)
