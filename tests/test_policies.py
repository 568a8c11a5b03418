"""Null-space policies: what they want, and that they want it everywhere."""

from __future__ import annotations

import numpy as np
import pytest

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.constraint.manipulability import log_manipulability_gradient, manipulability, manipulability_gradient
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, ZeroPolicy
from manip_learn.errors import ConfigurationError, TargetError


def test_zero_policy():
    """It is zero at every posture and time, and its array cannot be modified."""
    policy = ZeroPolicy(4)
    np.testing.assert_array_equal(policy(np.ones(4)), np.zeros(4))
    with pytest.raises(ValueError, match="read-only"):
        policy(np.ones(4))[0] = 1.0


def test_joint_attractor_goes_the_short_way(robot_of):
    """gain (rest - q); with the robot a continuous joint goes the short way round; wrong sizes are refused."""
    np.testing.assert_allclose(JointAttractor([1.0, 2.0], gain=3.0)([0.5, 0.0]), [1.5, 6.0])
    robot = robot_of("wrist")
    policy = JointAttractor([3.0, 0.0, 0.0, 0.0], robot=robot)
    assert policy([-3.0, 0.0, 0.0, 0.0])[0] == pytest.approx(6.0 - 2.0 * np.pi)
    with pytest.raises(TargetError, match="finite"):
        JointAttractor([np.nan, 0.0])
    with pytest.raises(TargetError, match="2 numbers"):
        JointAttractor([0.0, 0.0])([0.0, 0.0, 0.0])
    with pytest.raises(ConfigurationError):
        JointAttractor([0.0, 0.0], robot=robot)


def test_ascent_is_the_gradient(robot_of, rng):
    """gain grad log mu, or gain grad mu as the paper prints it."""
    robot = robot_of("sawyer")
    constraint = Constraint(rng.standard_normal((2, 3)), FrameJacobian(robot, "right_hand"))
    for _ in range(10):
        q = robot.random_configuration(rng)
        log, raw = ManipulabilityAscent(constraint, 0.7), ManipulabilityAscent(constraint, 0.7, logarithmic=False)
        np.testing.assert_allclose(log(q), 0.7 * log_manipulability_gradient(constraint, q), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(raw(q), 0.7 * manipulability_gradient(constraint, q), rtol=1e-9, atol=1e-12)
        with pytest.raises(ConfigurationError):
            log(np.full(7, np.nan))


@pytest.mark.parametrize("name", ["planar3", "sawyer", "panda", "ur5"])
def test_ascent_climbs_out_of_singularities(robot_of, name: str):
    """At stretched postures, and 1e-15 ... 1e-6 beside them, a small step along the policy raises mu."""
    robot, rng = robot_of(name), np.random.default_rng(3)
    frame = {"planar3": "tip", "sawyer": "right_hand", "panda": "panda_hand_tcp", "ur5": "tool0"}[name]
    constraint = Constraint(np.eye(2), FrameJacobian(robot, frame, "x y" if name == "planar3" else "z rx"))
    for distance in (0.0, 1e-15, 1e-12, 1e-9, 1e-6):
        q = distance * rng.standard_normal(robot.nv)
        direction = ManipulabilityAscent(constraint)(q)
        assert np.all(np.isfinite(direction)) and np.linalg.norm(direction) > 0.0
        step = 1e-3 * direction / np.linalg.norm(direction)
        assert manipulability(constraint, robot.integrate(q, step)) > manipulability(constraint, q)


def test_ascent_where_several_directions_are_lost():
    """Where A = 0, grad mu is zero; the policy leads out all the same, first to rank one and then to full rank."""
    features = CustomFeatures(lambda q: np.array([[q[0], 0, 0, q[1]], [0, 2 * q[1], 0, q[2]]]), ("a", "b"), 4)
    constraint = Constraint(np.eye(2), features)
    q = np.zeros(4)
    policy = ManipulabilityAscent(constraint)
    np.testing.assert_array_equal(manipulability_gradient(constraint, q), np.zeros(4))
    np.testing.assert_array_equal(ManipulabilityAscent(constraint, logarithmic=False)(q), np.zeros(4))
    for _ in range(3):
        direction = policy(q)
        assert np.all(np.isfinite(direction)) and np.linalg.norm(direction) > 0.0
        q = q + 0.1 * direction / np.linalg.norm(direction)
    assert manipulability(constraint, q) > 1e-3


def test_policies_print_themselves(robot_of):
    """Gains and rest postures can be read."""
    constraint = Constraint(np.eye(2), FrameJacobian(robot_of("planar3"), "tip", "x y"))
    assert repr(ManipulabilityAscent(constraint, 2.0)) == "ManipulabilityAscent(gain=2, logarithmic=True)"
    assert "gain=3" in repr(JointAttractor([0.0], 3.0)) and repr(ZeroPolicy(2)) == "ZeroPolicy()"
