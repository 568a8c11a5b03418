"""Manipulability: definition, units, and what it is at singularities (its gradient: test_gradients.py).

And the one that falls towards the joint limits: definition, exact gradient, finite everywhere.
"""

from __future__ import annotations

import numpy as np
import pytest
from conftest import tip_of
from test_gradients import central_difference, other_frame, relative_error
from test_limit_potential import near_limits

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CentreOfMass, CustomFeatures, FrameJacobian, RelativeFrameJacobian, Stacked
from manip_learn.constraint.manipulability import (
    log_manipulability_gradient,
    log_penalised_manipulability_gradient,
    manipulability,
    manipulability_gradient,
    penalised_manipulability,
    penalised_manipulability_gradient,
)
from manip_learn.control.policies import PenalisedManipulabilityAscent
from manip_learn.errors import ConstraintError
from manip_learn.linalg import manipulability_of
from manip_learn.robot.limit_potential import limit_weights


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
        gradient = manipulability_gradient(constraint, q)
        np.testing.assert_allclose(manipulability_gradient(turned, q), gradient, rtol=0, atol=1e-9)
        assert manipulability_of(A) == manipulability(constraint, q) == constraint.manipulability(q)


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


# nv = 1, 3, 5, 6, 7, joints without limits, and a mimic joint
LIMITED = ["one", "planar3", "gantry", "wrist", "mimic", "ur5", "sawyer"]


def feature_maps(robot, name: str) -> list:
    """Frame rows in both references, the centre of mass, a relative frame, a stack, and a map in Python."""
    frame, halfway = tip_of(name), other_frame(robot)
    return [
        FrameJacobian(robot, frame, "xyz"),
        FrameJacobian(robot, frame, "pose", "local"),
        CentreOfMass(robot),
        RelativeFrameJacobian(robot, frame, halfway, "xyz"),
        Stacked([FrameJacobian(robot, frame, "xyz"), FrameJacobian(robot, halfway, "rx rz")]),
        CustomFeatures(lambda q: robot.jacobian(q, frame)[:2], ("x", "y"), robot=robot),
    ]


@pytest.mark.parametrize("name", LIMITED)
def test_penalised_gradient(robot_of, rng, name: str):
    """grad mu_w and grad log mu_w are right to 1e-5 for random rows of each feature map, near limits too, and finite
    at limits, outside them and stretched out.
    """
    robot, checked = robot_of(name), 0
    for features in feature_maps(robot, name):
        for s in range(1, min(3, features.n_rows, robot.nv) + 1):
            constraint = Constraint(rng.normal(size=(s, features.n_rows)), features)
            for share in (0.0, 0.6, 0.95):
                q = near_limits(robot, rng, share)
                A = constraint(q) * limit_weights(robot, q)[0]
                sigma = np.linalg.svd(A, compute_uv=False)
                if sigma[-1] <= 1e-2 * sigma[0]:
                    continue
                mu = penalised_manipulability(constraint, q)
                assert mu == pytest.approx(np.sqrt(np.linalg.det(A @ A.T)), rel=1e-9)
                assert mu <= manipulability(constraint, q) * (1.0 + 1e-12)
                expected = central_difference(lambda x, c=constraint: penalised_manipulability(c, x), robot, q)
                assert relative_error(penalised_manipulability_gradient(constraint, q), expected) <= 1e-5
                log = log_penalised_manipulability_gradient(constraint, q)
                assert relative_error(log, expected / mu) <= 1e-5
                checked += 1
    assert checked > 8
    # at all limits, outside them, stretched out, and with one joint at its limit: no NaN, no infinity
    upper = np.where(np.isfinite(robot.position_upper), robot.position_upper, 0.3)
    one_at_limit = 0.5 * near_limits(robot, rng, 0.5)
    one_at_limit[0] = upper[0]
    for features in feature_maps(robot, name):
        for s in range(1, features.n_rows + 1):
            constraint = Constraint(np.eye(features.n_rows)[:s], features)
            policy = PenalisedManipulabilityAscent(constraint)
            for q in (upper, upper + 0.5, np.zeros(robot.nv), one_at_limit):
                # a volume of entries of size 1 is known to their rounding, where it should be zero
                most = manipulability(constraint, q) * (1.0 + 1e-9) + 1e-15
                assert 0.0 <= penalised_manipulability(constraint, q) <= most
                assert np.all(np.isfinite(penalised_manipulability_gradient(constraint, q)))
                assert np.all(np.isfinite(log_penalised_manipulability_gradient(constraint, q)))
                assert np.all(np.isfinite(policy(q))) and np.linalg.norm(policy(q)) <= 4.0 * (1.0 + 1e-9)


def test_a_joint_at_its_limit_does_not_count(robot_of):
    """With one joint at its limit mu_w is that of the arm without it, each other joint weighted."""
    robot = robot_of("planar3")
    constraint = Constraint(np.eye(2), FrameJacobian(robot, "tip", "x y"))
    q = np.array([0.4, robot.position_upper[1], -0.8])
    w = limit_weights(robot, q)[0]
    rest = (constraint(q) * w)[:, [0, 2]]
    assert penalised_manipulability(constraint, q) == pytest.approx(abs(np.linalg.det(rest)))


def test_without_limits_it_is_mu(robot_of, rng):
    """A row that joints without limits move has mu_w = mu and its gradient; features without a robot are refused."""
    robot = robot_of("wrist")
    constraint = Constraint([[1.0]], FrameJacobian(robot, "link0", "rz"))
    q = robot.random_configuration(rng)
    assert penalised_manipulability(constraint, q) == manipulability(constraint, q) == pytest.approx(1.0)
    np.testing.assert_allclose(penalised_manipulability_gradient(constraint, q), 0.0, atol=1e-15)
    flat = CustomFeatures(lambda q: np.array([[np.cos(q[0]), q[1]]]), "a", 2)
    with pytest.raises(ConstraintError, match="no robot"):
        penalised_manipulability(Constraint([[1.0]], flat), [0.1, 0.2])
    with pytest.raises(ConstraintError, match="no robot"):
        PenalisedManipulabilityAscent(Constraint([[1.0]], flat))


def test_ascent_climbs_it_and_leaves_a_limit(robot_of, rng):
    """Small steps along the policy raise mu_w; a joint whose motion leaves mu alone is led away from its limit."""
    robot = robot_of("sawyer")
    for _ in range(10):
        constraint = Constraint(rng.normal(size=(2, 3)), FrameJacobian(robot, "right_hand"))
        q = near_limits(robot, rng, 0.9)
        direction = PenalisedManipulabilityAscent(constraint)(q)
        step = 1e-5 * direction / np.linalg.norm(direction)
        assert penalised_manipulability(constraint, q + step) > penalised_manipulability(constraint, q)
    slides = Constraint([[1.0, 0.0]], FrameJacobian(robot_of("gantry"), "link1", "x y"))
    q = np.array([1.8, -1.0, 0.2, 0.0, 0.0])
    np.testing.assert_allclose(manipulability_gradient(slides, q), 0.0, atol=1e-15)
    policy = PenalisedManipulabilityAscent(slides, 2.0)
    assert policy(q)[0] < 0.0 and policy(-q)[0] > 0.0
    assert "gain=2" in repr(policy)
