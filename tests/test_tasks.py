"""Tasks: what they ask of the constrained rows, in every form of a target."""

from __future__ import annotations

import numpy as np
import pytest

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.control.tasks import Hold, PointAttractor, Track
from manip_learn.errors import FeatureError, TargetError


@pytest.fixture
def constraint(robot_of, rng) -> Constraint:
    return Constraint(rng.standard_normal((2, 3)), FrameJacobian(robot_of("sawyer"), "right_hand"))


def test_hold(constraint, rng):
    """b = 0, and nothing left to go."""
    q = rng.standard_normal(7)
    np.testing.assert_array_equal(Hold().velocity(constraint, q, 1.0), np.zeros(2))
    assert Hold().error(constraint, q, 1.0) == 0.0
    assert repr(Hold()) == "Hold()"


def test_three_forms_of_a_target(constraint, robot_of, rng):
    """All rows of the features, one number per constrained row, or a pose: the same displacement."""
    q, goal = rng.uniform(-1, 1, 7), rng.uniform(-1, 1, 7)
    robot, features = robot_of("sawyer"), constraint.features
    point = features.coordinates(goal)
    expected = constraint.selection @ (point - features.coordinates(q))
    for target in (point, constraint.selection @ point, robot.pose(goal, features.frame)):
        task = PointAttractor(target, gain=2.0)
        np.testing.assert_allclose(task.velocity(constraint, q, 0.0), 2.0 * expected, rtol=0, atol=1e-12)
        assert task.error(constraint, q, 0.0) == pytest.approx(np.linalg.norm(expected))


def test_rotation_targets(robot_of, rng):
    """Following b of a full pose turns the tool to the target, in both references."""
    robot = robot_of("sawyer")
    q, goal = rng.uniform(-0.5, 0.5, 7) + 0.3, rng.uniform(-0.5, 0.5, 7)
    for reference in ("world", "local"):
        features = FrameJacobian(robot, "right_hand", "pose", reference)
        full = Constraint(np.eye(6), features)
        task, x = PointAttractor(robot.pose(goal, features.frame)), q.copy()
        before = task.error(full, x, 0.0)
        for _ in range(300):
            x = x + 0.03 * np.linalg.pinv(full(x), rcond=0.02) @ task.velocity(full, x, 0.0)
        assert task.error(full, x, 0.0) < 0.02 * before


def test_max_speed(constraint, rng):
    """Far away the speed is the largest allowed, and the direction stays."""
    q = rng.uniform(-1, 1, 7)
    free, bounded = PointAttractor([5.0, 5.0, 5.0]), PointAttractor([5.0, 5.0, 5.0], max_speed=0.1)
    b, slow = free.velocity(constraint, q, 0.0), bounded.velocity(constraint, q, 0.0)
    assert np.linalg.norm(slow) == pytest.approx(0.1)
    np.testing.assert_allclose(slow / 0.1, b / np.linalg.norm(b))


def test_track_with_feed_forward_does_not_lag(constraint, rng):
    """On the target its own velocity is all that is asked for; beside it the pull is added."""
    q = rng.uniform(-1, 1, 7)
    here, rate = constraint.features.coordinates(q), np.array([0.1, -0.2, 0.3])
    task = Track(lambda t: here + rate * (t - 1.0), lambda t: rate, gain=4.0)
    np.testing.assert_allclose(task.velocity(constraint, q, 1.0), constraint.selection @ rate, rtol=0, atol=1e-12)
    lagging = task.velocity(constraint, q, 1.5) - constraint.selection @ rate
    np.testing.assert_allclose(lagging, 4.0 * constraint.selection @ rate * 0.5, rtol=0, atol=1e-12)
    assert task.error(constraint, q, 1.5) == pytest.approx(0.5 * np.linalg.norm(constraint.selection @ rate))
    assert repr(task) == "Track(gain=4)"


def test_bad_targets(constraint, rng):
    """Wrong sizes, NaN, text and features without coordinates are refused with what would fit."""
    q = rng.uniform(-1, 1, 7)
    for target in ([np.nan, 0.0, 0.0], "there", [[1.0, 2.0], [3.0]], 5.0):
        with pytest.raises(TargetError):
            PointAttractor(target)
    with pytest.raises(TargetError, match=r"3 numbers \(x, y, z\), or 2"):
        PointAttractor(np.zeros(4)).velocity(constraint, q, 0.0)
    features = CustomFeatures(lambda q: np.ones((1, 2)), ("a",), 2)
    with pytest.raises(FeatureError, match="no task coordinates"):
        PointAttractor([1.0]).velocity(Constraint([[1.0]], features), np.zeros(2), 0.0)
