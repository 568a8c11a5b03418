"""Null-space policies: what they want, that they want it everywhere, and what a controller makes of several."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from case import case
from numpy.testing import assert_allclose, assert_array_equal

import manip_learn as ml
from manip_learn.constraint.manipulability import svd
from manip_learn.control.policies import GROWTH, steepest_ascent
from manip_learn.errors import ConfigurationError, ConstraintError, TargetError


def test_joint_attractor_goes_the_short_way(robot_of):
    """gain (rest - q); with the robot a continuous joint goes the short way round; wrong sizes are refused."""
    assert_allclose(ml.JointAttractor([1.0, 2.0], gain=3.0)([0.5, 0.0]), [1.5, 6.0])
    robot = robot_of("wrist")
    policy = ml.JointAttractor([3.0, 0.0, 0.0, 0.0], robot=robot)
    assert policy([-3.0, 0.0, 0.0, 0.0])[0] == pytest.approx(6.0 - 2.0 * np.pi)
    with pytest.raises(TargetError, match="finite"):
        ml.JointAttractor([np.nan, 0.0])
    with pytest.raises(TargetError, match="2 numbers"):
        ml.JointAttractor([0.0, 0.0])([0.0, 0.0, 0.0])
    with pytest.raises(ConfigurationError):
        ml.JointAttractor([0.0, 0.0], robot=robot)


def test_ascent_is_the_gradient(robot_of, rng):
    """gain grad log mu, or gain grad mu as the paper prints it."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint(rng.standard_normal((2, 3)), ml.FrameJacobian(robot, "right_hand"))
    for _ in range(10):
        q = robot.random_configuration(rng)
        log, raw = ml.ManipulabilityAscent(constraint, 0.7), ml.ManipulabilityAscent(constraint, 0.7, logarithmic=False)
        assert_allclose(log(q), 0.7 * ml.log_manipulability_gradient(constraint, q), rtol=1e-9, atol=1e-12)
        assert_allclose(raw(q), 0.7 * ml.manipulability_gradient(constraint, q), rtol=1e-9, atol=1e-12)
        with pytest.raises(ConfigurationError):
            log(np.full(7, np.nan))


def test_ascent_climbs_out_of_singularities(robot_of):
    """At stretched postures, and 1e-15 ... 1e-6 beside them, a small step along the policy raises mu."""
    frames = {"planar3": "tip", "sawyer": "right_hand", "panda": "panda_hand_tcp", "ur5": "tool0"}
    for name, distance in product(frames, (0.0, 1e-15, 1e-12, 1e-9, 1e-6)):
        robot, rng = robot_of(name), np.random.default_rng(3)
        axes = "x y" if name == "planar3" else "z rx"
        constraint = ml.Constraint(np.eye(2), ml.FrameJacobian(robot, frames[name], axes))
        q = distance * rng.standard_normal(robot.nv)
        direction = ml.ManipulabilityAscent(constraint)(q)
        with case(name, distance):
            assert np.all(np.isfinite(direction)) and np.linalg.norm(direction) > 0.0
            step = 1e-3 * direction / np.linalg.norm(direction)
            assert ml.manipulability(constraint, robot.integrate(q, step)) > ml.manipulability(constraint, q)


def test_an_exact_singularity_is_left_along_the_steepest_ascent(robot_of):
    """In the null space, at the small speed of the seed; no other direction of the null space raises mu more."""
    constraint = ml.Constraint(np.eye(2), ml.FrameJacobian(robot_of("planar3"), "tip", "x y"))
    q = np.array([0.4, 0.0, 0.0])
    A, vjp = constraint.value_and_vjp(q)
    decomposition = svd(A)
    ascent = steepest_ascent(decomposition, vjp)
    assert ascent[np.argmax(np.abs(ascent))] > 0.0 and np.linalg.norm(ascent) == pytest.approx(1.0)
    assert_allclose(A @ ascent, 0.0, rtol=0, atol=1e-12)
    assert_allclose(ml.ManipulabilityAscent(constraint)(q), 5e-4 * ascent, rtol=0, atol=1e-12)
    Z = decomposition[2][1:]
    for other in np.random.default_rng(5).standard_normal((200, 3)):
        z = Z.T @ (Z @ other)
        z *= 1e-4 / np.linalg.norm(z)
        assert ml.manipulability(constraint, q + z) <= ml.manipulability(constraint, q + 1e-4 * ascent) * (1.0 + 1e-3)


def test_the_bound_of_the_ascent(robot_of, rng):
    """Along the gradient g of log mu: gain |g| at most, and max_speed / sqrt(1 + (dt max_speed |g| / GROWTH)^2)."""
    rows = ml.Constraint(rng.standard_normal((2, 3)), ml.FrameJacobian(robot_of("sawyer"), "right_hand"))
    postures = 0.5 * rng.standard_normal((5, 7))
    for q, gain, speed, dt in product(postures, (0.5, 3.0), (0.1, 1.0, 10.0, None), (0.001, 0.05, 2.0)):
        slope = ml.ManipulabilityAscent(rows, 1.0, max_speed=None)(q)
        size = float(np.linalg.norm(slope))
        longest = np.inf if speed is None else speed / np.sqrt(1.0 + (dt * speed * size / GROWTH) ** 2)
        got = ml.ManipulabilityAscent(rows, gain, max_speed=speed)(q, 0.0, dt)
        assert_allclose(got, slope / size * min(gain * size, longest), rtol=1e-12)
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(ConstraintError, match="max_speed"):
            ml.ManipulabilityAscent(rows, max_speed=wrong)


def test_ascent_where_several_directions_are_lost():
    """Where A = 0, grad mu is zero; the policy leads out all the same, first to rank one and then to full rank."""
    features = ml.CustomFeatures(lambda q: np.array([[q[0], 0, 0, q[1]], [0, 2 * q[1], 0, q[2]]]), ("a", "b"), 4)
    constraint = ml.Constraint(np.eye(2), features)
    q = np.zeros(4)
    policy = ml.ManipulabilityAscent(constraint)
    assert_array_equal(ml.manipulability_gradient(constraint, q), np.zeros(4))
    assert_array_equal(ml.ManipulabilityAscent(constraint, logarithmic=False)(q), np.zeros(4))
    for _ in range(3):
        direction = policy(q)
        assert np.all(np.isfinite(direction)) and np.linalg.norm(direction) > 0.0
        assert np.max(direction) == np.max(np.abs(direction))  # of two senses the one whose largest entry is positive
        q = q + 0.1 * direction / np.linalg.norm(direction)
    assert ml.manipulability(constraint, q) > 1e-3


DT = 0.01


def test_joint_limit_avoidance(robot_of, rng):
    """It descends the potential, at most at its speed, finite at the limits and outside; free joints are left alone."""
    for name in ("one", "planar3", "gantry", "wrist", "panda", "ur5", "sawyer"):
        with case(name):
            robot = robot_of(name)
            policy = ml.JointLimitAvoidance(robot, 0.2, max_speed=0.3)
            limited = np.isfinite(robot.position_upper)
            width = robot.position_upper[limited] - robot.position_lower[limited]
            longest = np.minimum(0.3, 0.5 * width)
            for _ in range(20):
                q = robot.positions(robot.random_configuration(rng))
                pi = policy(q)
                x = (2.0 * q[limited] - robot.position_upper[limited] - robot.position_lower[limited]) / width
                p = 0.2 * width * x / (1.0 - x**2) ** 2  # of h: 4 x / (width (1 - x^2)^2)
                assert_allclose(pi[limited], -p / np.sqrt(1.0 + (p / longest) ** 2), rtol=1e-7, atol=1e-12)
                assert_array_equal(pi[~limited], 0.0)
            for beyond in (0.0, 1e-12, 0.5):
                for bound, sign in ((robot.position_upper, 1.0), (robot.position_lower, -1.0)):
                    q = np.full(robot.nv, 0.1)
                    q[limited] = bound[limited] + sign * beyond
                    assert_allclose(policy(q)[limited], -sign * longest, rtol=1e-9)


def reaching(robot_of, rng):
    """Sawyer, two oblique rows, a reachable target and a start."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint(rng.normal(size=(2, 3)), ml.FrameJacobian(robot, "right_hand", "xyz"))
    start, goal = robot.random_configuration(rng), robot.position(robot.random_configuration(rng), "right_hand")
    return robot, constraint, ml.PointAttractor(goal), start


def test_weighted_sum(robot_of, rng):
    """sum w_i pi_i, sums within sums too; wrong weights and sizes are refused; the weights can be read."""
    robot, constraint, _, q = reaching(robot_of, rng)
    a, b = ml.JointLimitAvoidance(robot), ml.ManipulabilityAscent(constraint)
    inner = ml.WeightedPolicies([a, b], [0.5, 2.0])
    assert_allclose(inner(q), 0.5 * a(q) + 2.0 * b(q))
    assert_allclose(inner(q, 0.0, 0.1), 0.5 * a(q) + 2.0 * b(q, 0.0, 0.1))
    assert_allclose(ml.WeightedPolicies([inner, a], [3.0, 1.0])(q), 3.0 * inner(q) + a(q))
    assert_array_equal(ml.WeightedPolicies([a])(q), a(q))
    text = repr(inner)
    assert text.startswith("WeightedPolicies(0.5 JointLimitAvoidance(") and "+ 2 ManipulabilityAscent(" in text
    for policies, weights in (([], None), ([a], [1.0, 2.0]), ([a], [-1.0]), ([a], [np.nan])):
        with pytest.raises(ConfigurationError):
            ml.WeightedPolicies(policies, weights)
    with pytest.raises(TargetError, match="7, 3"):
        ml.WeightedPolicies([a, ml.ZeroPolicy(3)])(q)
