"""The derivative of pose errors: against differences, and what it gives a controller that reaches for poses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from case import case
from rounding import rounding

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CentreOfMass, FeatureMap, FrameJacobian, RelativeFrameJacobian
from manip_learn.control.tasks import PointAttractor
from manip_learn.errors import TargetError
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix

RobotOf = Callable[[str], Robot]
ANGLES = [0.0, 1e-9, 1e-4, 0.5, 2.6, 3.1]
AXES = ["pose", "xyz", "rotation", "x y rz", "rx ry", "rz", "z rx"]
VIEWS = ["world", "local", "relative"]


def features_of(robot: Robot, axes: str, view: str) -> FeatureMap:
    if view == "relative":
        return RelativeFrameJacobian(robot, "panda_hand_tcp", "panda_link3", axes)
    return FrameJacobian(robot, "panda_hand_tcp", axes, view)


def pose_of(features: FeatureMap, q: np.ndarray) -> np.ndarray:
    pose = features.robot.pose(q, features.frame)
    if isinstance(features, RelativeFrameJacobian):
        return np.linalg.inv(features.robot.pose(q, features.relative_to)) @ pose
    return pose


def turned(features: FeatureMap, q: np.ndarray, angle: float, rng: np.random.Generator) -> np.ndarray:
    """A pose that is turned from the present one by that angle about a random axis, and 0.2 m away."""
    axis, away = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    target = pose_of(features, q)
    target[:3, :3] = rotation_matrix(angle * axis) @ target[:3, :3]
    target[:3, 3] += 0.2 * away
    return target


def rate(function: Callable[[np.ndarray], np.ndarray], q: np.ndarray, u: np.ndarray, h: float = 1e-5) -> np.ndarray:
    """Central difference of order four along u."""
    f = [function(q + k * h * u) for k in (-2, -1, 1, 2)]
    return (f[0] - 8.0 * f[1] + 8.0 * f[2] - f[3]) / (12.0 * h)


@pytest.mark.parametrize("view", VIEWS)
def test_error_jacobian(robot_of: RobotOf, rng: np.random.Generator, view: str) -> None:
    """d/dt error = -E u to 1e-6 for every mix of axes, at every angle between frame and target that is a pose; and for
    targets that are numbers, where coordinates that are not among the rows go with the frame.
    """
    for axes in AXES:
        features, compared = features_of(robot_of("panda"), axes, view), 0
        for angle in ANGLES:
            with case(axes, angle):
                q, u = rng.uniform(-1.0, 1.0, (2, 7))
                check_rate(features, turned(features, q, angle, rng), q, u)
        if view == "local" and axes not in ("pose", "xyz", "rotation"):
            continue  # numbers do not determine such a target
        for _ in range(6):
            q, goal, u = rng.uniform(-1.0, 1.0, (3, 7))
            target = features.coordinates(goal)
            if any(np.linalg.norm(features.error_to(target, q + k * 1e-4 * u)[-3:]) > 3.0 for k in (-1, 0, 1)):
                continue  # next to half a turn the error changes its sign
            with case(axes, target):
                check_rate(features, target, q, u)
                C = features.coordinates_jacobian(q)
                C = features(q) if C is None else C
                if view != "local":
                    np.testing.assert_allclose(C @ u, rate(features.coordinates, q, u), rtol=0, atol=1e-6)
            compared += 1
        assert compared > 2, axes


def check_rate(features: FeatureMap, target: np.ndarray, q: np.ndarray, u: np.ndarray) -> None:
    E = features.error_jacobian(target, q)
    E = features(q) if E is None else E
    np.testing.assert_allclose(-E @ u, rate(lambda x: features.error_to(target, x), q, u), rtol=0, atol=1e-6)
    error, together = features.error_and_jacobian(target, q)
    np.testing.assert_array_equal(error, features.error_to(target, q))
    np.testing.assert_array_equal(features(q) if together is None else together, E)


def test_rows_are_those_of_the_constraint_on_the_target(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """On a target that is a pose, E is A(q); for positions along the base it is so everywhere (None)."""
    robot, q = robot_of("panda"), rng.uniform(-1.0, 1.0, 7)
    for view in VIEWS:
        for axes in AXES[:1] + AXES[2:]:
            features = features_of(robot, axes, view)
            E = features.error_jacobian(pose_of(features, q), q)
            np.testing.assert_allclose(E, features(q), rtol=0, atol=rounding(8 * robot.nv, E))
    for features in (features_of(robot, "x z", "world"), CentreOfMass(robot)):
        target = np.zeros(features.n_rows)
        assert features.error_jacobian(target, q) is None
        assert features.coordinates_jacobian(q) is None
        assert PointAttractor(target).error_jacobian(Constraint(np.eye(len(target)), features), q, 0.0) is None


def test_poses_that_are_none(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """A matrix that is no rotation is refused with a sentence; one written with few digits is taken."""
    features = features_of(robot_of("panda"), "pose", "world")
    q = rng.uniform(-1.0, 1.0, 7)
    pose = pose_of(features, q)
    assert np.linalg.norm(features.error_to(np.round(pose, 5), q)) < 1e-4
    for fault in (np.diag([1.0, 1.0, -1.0, 1.0]), np.zeros((4, 4)), np.diag([2.0, 2.0, 2.0, 1.0])):
        with pytest.raises(TargetError, match="not a rotation matrix"):
            features.error_to(pose @ fault, q)
    with pytest.raises(TargetError):
        features.error_jacobian(np.full((4, 4), np.nan), q)
