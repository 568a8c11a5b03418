"""Manipulability: definition, units, and what it is at singularities (its gradient: test_gradients.py)."""

from __future__ import annotations

import numpy as np
import pytest

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.constraint.manipulability import (
    log_manipulability_gradient,
    manipulability,
    manipulability_gradient,
    manipulability_of,
    products_of_others,
)
from manip_learn.errors import ConfigurationError


def test_definition(robot_of, rng):
    """mu = sqrt(det(A A^T)), the same in every orthonormal basis of the rows."""
    robot = robot_of("sawyer")
    features = FrameJacobian(robot, "right_hand", "pose")
    for s in range(1, 7):
        constraint = Constraint(rng.standard_normal((s, 6)), features)
        turned = Constraint(np.linalg.qr(rng.standard_normal((s, s)))[0] @ constraint.selection, features)
        q = robot.random_configuration(rng)
        A = constraint(q)
        assert manipulability(constraint, q) == pytest.approx(np.sqrt(np.linalg.det(A @ A.T)), rel=1e-9)
        assert manipulability(turned, q) == pytest.approx(manipulability(constraint, q), rel=1e-11)
        assert manipulability_of(A) == manipulability(constraint, q)


def test_singular_is_zero_never_nan(robot_of):
    """Stretched arms, more rows than joints, and A = 0: mu is 0 to rounding, its gradients are finite."""
    robot = robot_of("planar3")
    stretched = Constraint(np.eye(2), FrameJacobian(robot, "tip", "x y"))
    crowded = Constraint(np.eye(4), CustomFeatures(lambda q: np.arange(8.0).reshape(4, 2) + q[0], "abcd", 2))
    nothing = Constraint([[1.0]], CustomFeatures(lambda q: np.zeros((1, 2)), "a", 2))
    for constraint, q in ((stretched, np.zeros(3)), (crowded, np.ones(2)), (nothing, np.ones(2))):
        assert 0.0 <= manipulability(constraint, q) < 1e-14
        for gradient in (manipulability_gradient, log_manipulability_gradient):
            assert np.all(np.isfinite(gradient(constraint, q)))


def test_log_gradient_is_free_of_units(rng):
    """Rows in other units multiply mu and leave grad log mu alone."""
    metres = CustomFeatures(lambda q: np.array([[np.cos(q[0]), q[1], 1.0], [q[2], np.sin(q[1]), q[0]]]), "ab", 3)
    millimetres = CustomFeatures(lambda q: 1000.0 * metres(q), "ab", 3)
    q = rng.standard_normal(3)
    one, other = Constraint(np.eye(2), metres), Constraint(np.eye(2), millimetres)
    assert manipulability(other, q) == pytest.approx(1e6 * manipulability(one, q))
    np.testing.assert_allclose(
        log_manipulability_gradient(other, q), log_manipulability_gradient(one, q), rtol=0, atol=1e-6
    )


def test_products_of_others():
    """prod_{j != i} sigma_j, with zeros among them."""
    assert products_of_others(np.array([2.0, 3.0, 5.0])).tolist() == [15.0, 10.0, 6.0]
    assert products_of_others(np.array([2.0, 0.0, 5.0])).tolist() == [0.0, 10.0, 0.0]
    assert products_of_others(np.array([2.0, 0.0, 0.0])).tolist() == [0.0, 0.0, 0.0]
    assert products_of_others(np.array([7.0])).tolist() == [1.0]


def test_bad_postures(robot_of):
    """NaN and wrong sizes are refused."""
    constraint = Constraint(np.eye(2), FrameJacobian(robot_of("planar3"), "tip", "x y"))
    for q in ([np.nan, 0, 0], [0.0, 0.0]):
        for function in (manipulability, manipulability_gradient, log_manipulability_gradient):
            with pytest.raises(ConfigurationError):
                function(constraint, q)
