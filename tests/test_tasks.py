"""Tasks: what they ask of the constrained rows, in every form of a target."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import manip_learn as ml
from manip_learn.errors import FeatureError, TargetError
from manip_learn.robot.rotations import rotation_matrix


@pytest.fixture
def constraint(robot_of, rng) -> ml.Constraint:
    return ml.Constraint(rng.standard_normal((2, 3)), ml.FrameJacobian(robot_of("sawyer"), "right_hand"))


def test_three_forms_of_a_target(constraint, robot_of, rng):
    """All rows of the features, one number per constrained row, or a pose: the same displacement."""
    q, goal = rng.uniform(-1, 1, 7), rng.uniform(-1, 1, 7)
    robot, features = robot_of("sawyer"), constraint.features
    point = features.coordinates(goal)
    expected = constraint.selection @ (point - features.coordinates(q))
    for target in (point, constraint.selection @ point, robot.pose(goal, features.frame)):
        task = ml.PointAttractor(target, gain=2.0)
        assert_allclose(task.velocity(constraint, q, 0.0), 2.0 * expected, rtol=0, atol=1e-12)
        assert task.error(constraint, q, 0.0) == pytest.approx(np.linalg.norm(expected))


def test_track_with_feed_forward_does_not_lag(constraint, rng):
    """On the target its own velocity is all that is asked for; beside it the pull is added."""
    q = rng.uniform(-1, 1, 7)
    here, rate = constraint.features.coordinates(q), np.array([0.1, -0.2, 0.3])
    task = ml.Track(lambda t: here + rate * (t - 1.0), lambda t: rate, gain=4.0)
    assert_allclose(task.velocity(constraint, q, 1.0), constraint.selection @ rate, rtol=0, atol=1e-12)
    lagging = task.velocity(constraint, q, 1.5) - constraint.selection @ rate
    assert_allclose(lagging, 4.0 * constraint.selection @ rate * 0.5, rtol=0, atol=1e-12)
    assert task.error(constraint, q, 1.5) == pytest.approx(0.5 * np.linalg.norm(constraint.selection @ rate))
    assert repr(task) == "Track(gain=4)"


def test_a_target_that_moves_counts_over_the_step(constraint, rng):
    """b for a time dt has the rate in its middle, or the way of the target in dt; without dt what was given alone."""
    q = rng.uniform(-1, 1, 7)
    here, Lambda = constraint.features.coordinates(q), constraint.selection
    pull = Lambda @ (0.01 * np.ones(3))

    def target(t: float) -> np.ndarray:
        return here + 0.01 + np.array([t * t, 0.0, t**3])

    known = ml.Track(target, lambda t: np.array([2.0 * t, 0.0, 3.0 * t * t]), gain=3.0)
    for task, wanted in (
        (known, [0.3, 0.0, 3.0 * 0.15**2]),  # in the middle of 0.1 ... 0.2
        (ml.Track(target, gain=3.0), [(0.04 - 0.01) / 0.1, 0.0, (0.008 - 0.001) / 0.1]),
    ):
        b, E = task.velocity_and_jacobian(constraint, q, 0.1, 0.1)
        ahead = pull + Lambda @ [0.01, 0.0, 0.001]
        assert_allclose(b, 3.0 * ahead + Lambda @ wanted, rtol=0, atol=1e-12)
        assert E is None
    assert_allclose(ml.Track(target, gain=3.0).velocity(constraint, q, 0.0), 3.0 * pull, atol=1e-12)
    assert_allclose(known.velocity(constraint, q, 0.0), 3.0 * pull, atol=1e-12)


def line(t: float) -> np.ndarray:
    """There and back, 0.2 m, up to 0.5 m/s."""
    return 0.1 * np.array([0.0, 1.0 - np.cos(5.0 * t), 0.0])


def test_a_moving_target_is_followed(robot_of):
    """At 1 kHz the tip is within 0.2 mm of a target that moves at 0.5 m/s, with its orientation turning."""
    robot, frame, q = robot_of("panda"), "panda_hand_tcp", np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8])
    q = robot.checked_posture(np.concatenate((q, robot.positions(robot.neutral())[7:])))
    start = robot.pose(q, frame)

    def goal(t: float) -> np.ndarray:
        late = t - 0.3 if t > 0.6 else t * t / 1.2  # speeds up for 0.6 s
        turn = rotation_matrix(np.array([0.0, 0.0, 0.4 * np.sin(2.0 * late)]))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn @ start[:3, :3], start[:3, 3] + line(late)
        return pose

    features = ml.FrameJacobian(robot, frame, "pose")
    rows = ml.Constraint(np.eye(features.n_rows), features)
    loop = ml.ServoLoop(ml.ResolvedRateController(rows, ml.Track(goal, gain=5.0), ml.ManipulabilityAscent(rows)), 0.001)
    for k in range(1500):
        loop.update(q, 0.001 * k)
        q = loop.position
        assert np.linalg.norm(robot.position(q, frame) - goal(0.001 * (k + 1))[:3, 3]) < 2e-4


def test_bad_targets(constraint, rng):
    """Wrong sizes, NaN, text and features without coordinates are refused with what would fit."""
    q = rng.uniform(-1, 1, 7)
    for target in ([np.nan, 0.0, 0.0], "there", [[1.0, 2.0], [3.0]], 5.0):
        with pytest.raises(TargetError):
            ml.PointAttractor(target)
    with pytest.raises(TargetError, match=r"3 numbers \(x, y, z\), or 2"):
        ml.PointAttractor(np.zeros(4)).velocity(constraint, q, 0.0)
    features = ml.CustomFeatures(lambda q: np.ones((1, 2)), ("a",), 2)
    with pytest.raises(FeatureError, match="no task coordinates"):
        ml.PointAttractor([1.0]).velocity(ml.Constraint([[1.0]], features), np.zeros(2), 0.0)


def test_all_rows_are_driven_on_demand(constraint, robot_of):
    """Every row of the features where the target has a number for each, or is a pose, the same object at each call; not
    for rows of a mechanism, nor for numbers along the rows of Lambda. A task does not change.
    """
    for target in (np.zeros(3), np.eye(4)):
        task = ml.PointAttractor(target, driven="all")
        rows = task.rows(constraint)
        assert_array_equal(rows.selection, np.eye(3))
        assert rows.features is constraint.features and task.rows(constraint) is rows
        assert ml.PointAttractor(target).rows(constraint) is constraint
    door = ml.Constraint(np.eye(2), ml.MechanismRows(robot_of("sawyer"), "right_hand", "radial axial"))
    for target, of in ((np.zeros(2), constraint), (np.zeros(2), door)):
        with pytest.raises(TargetError, match="driven='held'"):
            ml.PointAttractor(target, driven="all").rows(of)
    with pytest.raises(TargetError, match="'held' or 'all'"):
        ml.PointAttractor(np.zeros(3), driven="free")  # type: ignore[arg-type]
    with pytest.raises(FrozenInstanceError, match="gain"):  # a loop may be running it
        ml.PointAttractor(np.zeros(3)).gain = 2.0  # type: ignore[misc]
