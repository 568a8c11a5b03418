"""Manipulability of many postures at once must be the manipulability of each."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from case import case
from conftest import TIPS, URDFS, tip_of
from test_gradients import RobotOf

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CentreOfMass, FeatureMap, FrameJacobian, Stacked
from manip_learn.constraint.manipulability import (
    log_manipulability_gradient,
    manipulability,
    manipulability_gradient,
)
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.errors import ConfigurationError
from manip_learn.linalg import EPS


def constraints_of(features: FeatureMap, rng: np.random.Generator) -> list[Constraint]:
    p = features.n_rows
    return [Constraint(np.linalg.qr(rng.normal(size=(p, s)))[0].T, features) for s in range(1, min(p, 4) + 1)]


def check(constraint: Constraint, q: np.ndarray) -> None:
    batch = manipulability_batch(constraint, q)
    assert np.all(np.isfinite(batch.gradient)) and np.all(np.isfinite(batch.log_gradient))
    for i, x in enumerate(q):
        mu, gradient = manipulability(constraint, x), manipulability_gradient(constraint, x)
        scale = max(float(np.max(np.abs(gradient))), 1e-12)
        assert abs(batch.mu[i] - mu) <= 1e-10 * max(mu, 1e-6)
        np.testing.assert_allclose(batch.gradient[i], gradient, rtol=0, atol=1e-10 * scale)
        log_gradient = log_manipulability_gradient(constraint, x)
        if mu > 1e-6:
            size = float(np.max(np.abs(log_gradient), initial=1.0))
            np.testing.assert_allclose(batch.log_gradient[i], log_gradient, rtol=0, atol=1e-9 * size)


@pytest.mark.parametrize("name", [*URDFS, *TIPS])
def test_batch_equals_one_by_one(name: str, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """mu and its gradient to 1e-10 relative, for one to four dense rows, at random postures of every robot."""
    robot = robot_of(name)
    q = np.stack([robot.positions(robot.random_configuration(rng)) for _ in range(4)])
    for reference in ("world", "local"):
        for constraint in constraints_of(FrameJacobian(robot, tip_of(name), "pose", reference), rng):
            with case(reference, constraint):
                check(constraint, q)


def test_other_features(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """The same for features without a fast way of their own."""
    robot = robot_of("tree")
    q = np.stack([robot.positions(robot.random_configuration(rng)) for _ in range(4)])
    for features in (CentreOfMass(robot), Stacked([FrameJacobian(robot, "tip"), FrameJacobian(robot, "arm_b", "x")])):
        for constraint in constraints_of(features, rng):
            check(constraint, q)


def test_near_singularities_nothing_is_lost(robot_of: RobotOf) -> None:
    """Stretched arms: the gradient of the batch is that of the single posture, ever closer to the singularity."""
    for (name, axes), distance in product(
        (("planar3", "x y"), ("sawyer", "x y"), ("sawyer", "xyz")), (1e-1, 1e-3, 1e-5, 1e-8, 1e-11)
    ):
        robot = robot_of(name)
        q = np.full((3, robot.nv), distance) * np.array([[1.0], [0.5], [-1.0]])
        q[:, 0] = [0.3, -0.4, 1.0]
        features = FrameJacobian(robot, tip_of(name), axes)
        constraint = Constraint(np.eye(features.n_rows), features)
        batch = manipulability_batch(constraint, q)
        for i, x in enumerate(q):
            expected = manipulability_gradient(constraint, x)
            scale = float(np.max(np.abs(expected)))
            with case(name, axes, distance):
                np.testing.assert_allclose(batch.gradient[i], expected, rtol=0, atol=1e-9 * scale)


def test_exact_singularities(robot_of: RobotOf) -> None:
    """On the cone's tip the steepest ascent comes back, in the middle of good postures too."""
    robot = robot_of("planar3")
    constraint = Constraint(np.eye(2), FrameJacobian(robot, "tip", "x y"))
    q = np.array([[0.3, 0.7, -0.4], [0.5, 0.0, 0.0], [1.0, -0.3, 0.9], [0.2, 0.0, np.pi]])
    batch = manipulability_batch(constraint, q)
    for i, x in enumerate(q):
        np.testing.assert_allclose(batch.gradient[i], manipulability_gradient(constraint, x), rtol=0, atol=1e-10)
        expected = log_manipulability_gradient(constraint, x)
        np.testing.assert_allclose(batch.log_gradient[i], expected, rtol=0, atol=1e-6 * np.max(np.abs(expected)))
    sigma = np.linalg.svd(constraint(q[1]), compute_uv=False)
    np.testing.assert_allclose(batch.floor, [0.0, 64.0 * EPS * sigma[0] ** 2, 0.0, batch.floor[3]], rtol=1e-9)
    assert batch.mu[1] < 1e-15 and np.linalg.norm(batch.gradient[1]) > 0.1
    assert np.all(np.isfinite(batch.log_gradient))


def test_more_rows_than_joints_have_no_manipulability(robot_of: RobotOf) -> None:
    """det(A A^T) = 0 always: mu and its gradient are zero."""
    robot = robot_of("planar3")
    batch = manipulability_batch(Constraint(np.eye(6), FrameJacobian(robot, "tip", "pose")), np.ones((4, 3)))
    assert not batch.mu.any() and not batch.gradient.any() and batch.gradient.shape == (4, 3)


def test_sizes_and_bad_numbers(robot_of: RobotOf) -> None:
    """No posture gives an empty table; NaN names its row and joint."""
    robot = robot_of("sawyer")
    constraint = Constraint(np.eye(3), FrameJacobian(robot, "right_hand"))
    assert manipulability_batch(constraint, np.zeros((0, 7))).gradient.shape == (0, 7)
    q = np.zeros((5, 7))
    q[3, 2] = np.nan
    with pytest.raises(ConfigurationError, match="row 3"):
        manipulability_batch(constraint, q)


def test_what_is_wrong_is_named(robot_of: RobotOf) -> None:
    """The row of a bad posture is its row in the table."""
    robot = robot_of("sawyer")
    constraint = Constraint(np.eye(3)[:2], FrameJacobian(robot, "right_hand"))
    q = np.zeros((9000, 7))
    q[7000, 3] = np.nan
    with pytest.raises(ConfigurationError, match="7000"):
        manipulability_batch(constraint, q)
    with pytest.raises(ConfigurationError, match="7000"):
        constraint.features.batch(q)
