"""Manipulability at singularities, at joint limits, and of many postures at once (gradients: test_gradients.py)."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from case import case
from conftest import tip_of
from rounding import rounding

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.constraint.manipulability import (
    log_manipulability_gradient,
    manipulability,
    manipulability_batch,
    manipulability_gradient,
)
from manip_learn.errors import ConfigurationError
from manip_learn.linalg import EPS, manipulability_of


def test_singular_is_zero_never_nan(robot_of):
    """Stretched arms, more rows than joints, and A = 0: mu is 0 to rounding, its gradients are finite."""
    robot = robot_of("planar3")
    stretched = Constraint(np.eye(2), FrameJacobian(robot, "tip", "x y"))
    crowded = Constraint(np.eye(4), CustomFeatures(lambda q: np.arange(8.0).reshape(4, 2) + q[0], "abcd", 2))
    nothing = Constraint([[1.0]], CustomFeatures(lambda q: np.zeros((1, 2)), "a", 2))
    for constraint, q in ((stretched, np.zeros(3)), (crowded, np.ones(2)), (nothing, np.ones(2))):
        A = constraint(q)
        assert 0.0 <= manipulability(constraint, q) <= rounding(4 * A.size, *[A] * len(A))
        assert manipulability(constraint, q) == constraint.manipulability(q) == manipulability_of(constraint(q))
        for gradient in (manipulability_gradient, log_manipulability_gradient):
            assert np.all(np.isfinite(gradient(constraint, q)))


def test_many_postures_at_and_near_singularities(robot_of):
    """The gradient in bulk is that of the single posture, ever closer to the singularity and on it, where it is the
    steepest ascent, in the middle of good postures too.
    """
    for (name, axes), distance in product((("planar3", "x y"), ("sawyer", "xyz")), (1e-1, 1e-3, 1e-5, 1e-8, 1e-11)):
        with case(name, axes, distance):
            robot = robot_of(name)
            q = np.full((3, robot.nv), distance) * np.array([[1.0], [0.5], [-1.0]])
            q[:, 0] = [0.3, -0.4, 1.0]
            features = FrameJacobian(robot, tip_of(name), axes)
            constraint = Constraint(np.eye(features.n_rows), features)
            expected = np.array([manipulability_gradient(constraint, x) for x in q])
            scale = np.max(np.abs(expected), axis=1, keepdims=True)
            np.testing.assert_allclose(
                manipulability_batch(constraint, q).gradient / scale, expected / scale, atol=1e-9
            )
    constraint = Constraint(np.eye(2), FrameJacobian(robot_of("planar3"), "tip", "x y"))
    q = np.array([[0.3, 0.7, -0.4], [0.5, 0.0, 0.0], [1.0, -0.3, 0.9], [0.2, 0.0, np.pi]])
    batch = manipulability_batch(constraint, q)
    for i, x in enumerate(q):
        np.testing.assert_allclose(batch.gradient[i], manipulability_gradient(constraint, x), rtol=0, atol=1e-10)
        expected = log_manipulability_gradient(constraint, x)
        np.testing.assert_allclose(batch.log_gradient[i], expected, rtol=0, atol=1e-6 * np.max(np.abs(expected)))
    sigma = np.linalg.svd(constraint(q[1]), compute_uv=False)
    np.testing.assert_allclose(batch.floor, [0.0, 64.0 * EPS * sigma[0] ** 2, 0.0, batch.floor[3]], rtol=1e-9)
    assert batch.mu[1] <= rounding(4 * 2 * 3, sigma, sigma) and np.linalg.norm(batch.gradient[1]) > 0.1


def test_sizes_and_bad_numbers(robot_of):
    """No posture gives an empty table; the row of a bad posture is its row in the table."""
    constraint = Constraint(np.eye(3), FrameJacobian(robot_of("sawyer"), "right_hand"))
    assert manipulability_batch(constraint, np.zeros((0, 7))).gradient.shape == (0, 7)
    q = np.zeros((9000, 7))
    q[7000, 3] = np.nan
    for evaluate in (lambda: manipulability_batch(constraint, q), lambda: constraint.features.batch(q)):
        with pytest.raises(ConfigurationError, match="row 7000"):
            evaluate()
