"""What recordings show along what is free, and that the arm does it again."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
import pytest
from case import case
from numpy.testing import assert_allclose
from task_sets import arm, out_and_back

import manip_learn as ml
from manip_learn.constraint.shown import Intention, demonstrated_motion
from manip_learn.control.simulation import simulate_way
from manip_learn.errors import ConstraintError, TargetError

HOME = {
    "panda": np.array([0.2, -0.4, 0.1, -2.1, 0.1, 1.8, 0.6]),
    "sawyer": np.array([0.1, -0.8, 0.1, 1.6, 0.1, 0.9, 3.2]),
}
SETS = (("door", "sawyer"), ("table", "panda"))


@cache
def shown_set(kind: str, name: str) -> tuple[ml.Robot, str, ml.ConstraintLearner, Any, list[float]]:
    """Robot, tip, what was learnt, the thing and how far each recording went."""
    robot, tip, demos, (thing,), (ways,) = out_and_back((kind,), name, 4100)
    maps = [ml.FrameJacobian(robot, tip, "xyz", reference) for reference in ("world", "local")]
    return robot, tip, ml.ConstraintLearner(maps).fit(demos), thing, ways


def done(constraint: ml.Constraint, task: ml.Task, start: np.ndarray, tip: str) -> tuple[np.ndarray, object]:
    """Where the hand is from the begin of the way to its end, and what became of the way."""
    law = ml.ResolvedRateController(constraint, task, task.ascent())  # type: ignore[attr-defined]
    rollout, way = simulate_way(constraint.robot, law, np.array(start))
    begin = int(np.searchsorted(rollout.time, way.begins or 0.0))
    return np.array([constraint.robot.position(q, tip) for q in rollout.q[begin:]]), way


@pytest.mark.parametrize(("kind", "name"), SETS)
def test_what_was_shown_is_what_people_did_and_is_done_again(kind, name):
    """Where contacts began, how far they went, how many and whether back; the same after saving and loading. From home
    the arm takes hold where contacts began, goes their way, and leaves neither rail nor path.
    """
    _, tip, learner, thing, ways = shown_set(kind, name)
    constraint, far = learner.constraint_, np.median(ways)
    shown = constraint.shown
    assert shown is not None and shown.unit == ("rad" if kind == "door" else "m")
    assert shown.hold is not None and np.linalg.norm(shown.hold - thing.handle) < 2e-3
    assert shown.extent == pytest.approx(far, rel=0.03)
    assert shown.least <= shown.extent <= shown.most and shown.spread == pytest.approx(np.std(ways), rel=0.3)
    assert shown.n == len(ways) and shown.back == (kind != "table")
    again = ml.Shown.from_dict(json.loads(json.dumps(shown.to_dict())))
    assert again is not None and again.sentence == shown.sentence and not np.any(shown.path[0])
    went = "and went up to 0.13 m (" if kind == "table" else "moved 48 degrees (42 to 50) at about 34 degrees/s"
    assert went in shown.sentence
    assert_allclose(again.points, shown.points, atol=1e-5)
    places, way = done(constraint, ml.motion(constraint), HOME[name], tip)
    assert np.linalg.norm(places[0] - shown.hold) < 2e-3 and way.is_done and way.deviation < 1e-3
    if kind == "table":
        for one, other in ((places, shown.points), (shown.points, places)):
            assert max(np.min(np.linalg.norm(other - p, axis=1)) for p in one) < 5e-3
    else:
        assert abs(way.done) == pytest.approx(far, rel=0.03)
        pose = np.eye(4)
        pose[:3, 3] = thing.handle
        end = thing.carry(pose, np.array([[far]])).position[0]
        assert np.linalg.norm(places[-1] - end) < 0.03 * far * 0.5 + 3e-3


def test_numbers_of_what_was_shown(robot_of):
    """Median, spread and pace without the rest before; one place to 3 mm, back to a tenth, one way if most went it."""
    features = ml.FrameJacobian(robot_of("gantry"), "tip")

    def shown(*strokes: tuple[float, float, float]) -> ml.Shown:
        """Of strokes that begin beside, go so far in a second after a rest, and so near again [m]."""
        contacts = []
        for beside, far, end in strokes:
            way = np.concatenate([np.zeros(50), np.linspace(0.0, far, 101), np.linspace(far, end, 51)[1:]])
            q = np.outer(beside + way, np.eye(5)[0])
            contacts.append(ml.Trajectory(0.01 * np.arange(len(q)), q))
        made = demonstrated_motion(features, np.eye(3)[1:], None, contacts)
        assert made is not None
        return made

    one = shown((0.0, 0.2, 0.0), (0.0, 0.2, 0.0), (0.0029, 0.3, 0.0))
    assert_allclose([one.extent, one.least, one.most, one.spread, one.span], [0.2, 0.2, 0.3, np.sqrt(0.02) / 3, 0.3029])
    assert_allclose([one.speed, one.seconds, one.scatter], [0.2, 1.0, 0.0029], rtol=1e-6)
    assert one.hold is not None and one.unit == "m" and one.n == 3
    assert shown((0.0, 0.2, 0.0), (0.0, 0.2, 0.0), (0.0031, 0.2, 0.0)).hold is None
    assert [shown((0.0, 0.2, end)).back for end in (0.019, 0.021)] == [True, False]
    assert [shown(*3 * [(0.0, 0.1, 0.0)], (0.0, far, 0.0)).one_way for far in (-0.0999, -0.1001)] == [True, False]


def test_positive_is_the_way_shown():
    """A drawer opens by a positive way and is shut by a negative one, which ends where contacts began. More than was
    shown is refused, of a drawer and a lid, unless it is asked for.
    """
    _, tip, learner, thing, _ = shown_set("drawer", "panda")
    constraint = learner.constraint_
    for along in (0.1, -0.1):
        places, _ = done(constraint, ml.motion(constraint, along=along), HOME["panda"], tip)
        assert (places[-1] - places[0]) @ thing.axis == pytest.approx(along, abs=2e-3)
    assert np.linalg.norm(places[-1] - thing.handle) < 3e-3
    back = ml.motion(constraint, direction="back")
    assert np.sign(back.wanted) == -np.sign(ml.motion(constraint).wanted)
    for held, far in ((constraint, {"along": 0.5}), (shown_set("door", "sawyer")[2].constraint_, {"turn": 150.0})):
        with pytest.raises(TargetError, match="longer than the demonstrations"):
            ml.motion(held, **far)
        assert ml.motion(held, **far, beyond_shown=True).wanted != 0.0


def test_a_constraint_that_was_not_learnt_is_told_how_far():
    """By hand, or from a file of an earlier version: a sentence, and a way that is named works."""
    line = ml.Constraint([[0, 1]], ml.FrameJacobian(arm("planar3"), "tip", axes="x y"))
    assert line.shown is None and ml.motion(line, along=0.1).wanted == 0.1
    for asked, error, words in (
        ({}, TargetError, "has no demonstrated motion"),
        ({"along": 150.0}, TargetError, "distances are in metres"),
        ({"along": 0.1, "direction": "shown"}, ConstraintError, "do not define a positive sense"),
    ):
        with case(asked), pytest.raises(error, match=words):
            ml.motion(line, **asked)
    assert ml.Constraint(line.selection, line.features, {"shown": {"unit": "m"}}).shown is None  # damaged


@pytest.mark.parametrize("common", [True, False])
def test_rows_moved_on_purpose_have_a_target(common):
    """A reach in which the tip is drawn to a point: that point and its gain are found, or that the points differ."""
    robot, rng = arm("planar3"), np.random.default_rng(7)
    features = ml.FrameJacobian(robot, "tip", "x y")
    both, demos, targets = ml.Constraint(np.eye(2), features), [], []
    for _ in range(8):
        targets.append(np.array([0.6, 1.4]) if common or not targets else rng.uniform(0.3, 1.5, 2))
        reach, rest = ml.PointAttractor(targets[-1], gain=1.2), ml.JointAttractor(np.zeros(3))
        law = ml.ResolvedRateController(both, reach, rest, limits=False)
        demos.append(ml.simulate(robot, law, rng.uniform(0.3, 1.2, 3), 2.0, 0.02).trajectory())
    constraint = ml.ConstraintLearner(features, n_constraints=2, estimator="joint").fit(demos).constraint_
    meant = constraint.intention
    assert isinstance(meant, Intention) and meant.common is common and meant.gain == pytest.approx(1.2, rel=0.05)
    if common:
        task = ml.motion(constraint)
        assert isinstance(task, ml.PointAttractor)
        assert_allclose(constraint.selection.T @ task.target, targets[0], atol=0.01)
    else:
        with pytest.raises(TargetError, match="different targets"):
            ml.motion(constraint)


def test_the_force_that_a_way_took_limits_the_next():
    """From efforts that carry the arm's weight as well; a way that a hand guided, or other units, say no force.

    `Contact` allows one and a half times that force along the way, `held` at the least, and 60 N where it is not known.
    """
    robot, tip, demos, (thing,), _ = out_and_back(("drawer",), "panda", 4100)
    features = ml.FrameJacobian(robot, tip, "xyz")

    def forces(push: float, friction: float = 0.0, weight: float = 1.0) -> ml.Constraint:
        taught = []
        for t in demos[:5]:
            slope = np.sign(np.gradient(t.q, t.time, axis=0))
            effort = [
                weight * robot.weight_effort(q) + robot.jacobian(q, tip)[:3].T @ (push * thing.axis) + friction * s
                for q, s in zip(t.q, slope, strict=True)
            ]
            taught.append(ml.Trajectory(t.time, t.q, None, t.joint_names, t.name, effort=effort))
        return ml.ConstraintLearner(features).fit(taught).constraint_

    def allowed(constraint: ml.Constraint, contact: ml.Contact | None = None) -> object:
        law = ml.ResolvedRateController(constraint, ml.motion(constraint))
        return ml.ServoLoop(law, contact=contact).contact.max_axial_force

    constraint = forces(40.0)
    shown = constraint.shown
    assert shown is not None and shown.force == pytest.approx(40.0, rel=0.02)
    assert "It took up to 40 N" in shown.sentence
    again = ml.Shown.from_dict(json.loads(json.dumps(shown.to_dict())))
    assert again is not None and again.force == shown.force
    assert allowed(constraint) == pytest.approx(60.0, rel=0.02)
    former = ml.Contact(held=15.0, driven=20.0)  # the names until 0.4
    assert former == ml.Contact(15.0, 20.0) and (former.held, former.driven) == (15.0, 20.0)
    assert allowed(constraint, ml.Contact(80.0)) == 80.0 and allowed(constraint, ml.Contact(15.0, 20.0)) == 20.0
    for unknown in (forces(0.0, friction=0.5), forces(40.0, weight=0.1)):
        assert unknown.shown is not None and unknown.shown.force is None and allowed(unknown) == "auto"
