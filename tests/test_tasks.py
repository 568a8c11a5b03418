"""Tasks: what they ask of the constrained rows, in every form of a target; null-space policies: what they want, that
they want it everywhere, and what a controller makes of several.
"""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from itertools import product

import numpy as np
import pytest
from case import case
from numpy.testing import assert_allclose, assert_array_equal

import manip_learn as ml
from manip_learn.errors import ConfigurationError, FeatureError, TargetError


@pytest.fixture
def constraint(robot_of, rng) -> ml.Constraint:
    return ml.Constraint(rng.standard_normal((2, 3)), ml.FrameJacobian(robot_of("sawyer"), "right_hand"))


def test_three_forms_of_a_target(constraint, robot_of, rng):
    """All rows of the features, one number per constrained row, or a pose: the same displacement."""
    q, goal = rng.uniform(-1, 1, (2, 7))
    robot, features = robot_of("sawyer"), constraint.features
    point = features.coordinates(goal)
    expected = constraint.selection @ (point - features.coordinates(q))
    for target in (point, constraint.selection @ point, robot.pose(goal, features.frame)):
        task = ml.PointAttractor(target, gain=2.0)
        assert_allclose(task.velocity(constraint, q, 0.0), 2.0 * expected, rtol=0, atol=1e-12)
        assert task.error(constraint, q, 0.0) == pytest.approx(np.linalg.norm(expected))


def test_a_target_that_moves_counts_over_the_step(constraint, rng):
    """b for a time dt has the rate in its middle, or the way of the target in dt; without dt what was given alone."""
    q, Lambda = rng.uniform(-1, 1, 7), constraint.selection
    here = constraint.features.coordinates(q)

    def target(t: float) -> np.ndarray:
        return here + 0.01 + np.array([t * t, 0.0, t**3])

    for task, wanted in (
        (ml.Track(target, lambda t: np.array([2.0 * t, 0.0, 3.0 * t * t]), gain=3.0), [0.3, 0.0, 3.0 * 0.15**2]),
        (ml.Track(target, gain=3.0), [(0.04 - 0.01) / 0.1, 0.0, (0.008 - 0.001) / 0.1]),
    ):  # in the middle of 0.1 ... 0.2
        b, E = task.velocity_and_jacobian(constraint, q, 0.1, 0.1)
        assert_allclose(b, Lambda @ (3.0 * (target(0.1) - here) + wanted), rtol=0, atol=1e-12)
        assert E is None and repr(task) == "Track(gain=3)"
        assert_allclose(task.velocity(constraint, q, 0.0), 3.0 * Lambda @ (0.01 * np.ones(3)), atol=1e-12)


def test_all_rows_are_driven_on_demand(constraint, robot_of):
    """Every row of the features where the target has a number for each, or is a pose, the same object at each call; not
    for rows of a mechanism, nor for numbers along the rows of Lambda. A task does not change. Wrong sizes and
    features without coordinates are refused with what would fit.
    """
    for target in (np.zeros(3), np.eye(4)):
        task = ml.PointAttractor(target, driven="all")
        rows = task.rows(constraint)
        assert_array_equal(rows.selection, np.eye(3))
        assert rows.features is constraint.features and task.rows(constraint) is rows
        assert ml.PointAttractor(target).rows(constraint) is constraint
    with pytest.raises(FrozenInstanceError, match="gain"):  # a loop may be running it
        ml.PointAttractor(np.zeros(3)).gain = 2.0  # type: ignore[misc]
    door, q = ml.Constraint(np.eye(2), ml.MechanismRows(robot_of("sawyer"), "right_hand", "radial axial")), np.zeros(7)
    silent = ml.Constraint([[1.0]], ml.CustomFeatures(lambda q: np.ones((1, 2)), ("a",), 2))
    two, four = ml.PointAttractor(np.zeros(2), driven="all"), ml.PointAttractor(np.zeros(4))
    for call, error, words in (
        *((lambda of=of: two.rows(of), TargetError, "driven='held'") for of in (constraint, door)),
        (lambda: four.velocity(constraint, q, 0.0), TargetError, r"3 numbers \(x, y, z\), or 2"),
        (lambda: ml.PointAttractor([1.0]).velocity(silent, np.zeros(2), 0.0), FeatureError, "no task coordinates"),
    ):
        with case(words), pytest.raises(error, match=words):
            call()


# ---- policies -----------------------------------------------------------------------------------------------------


def test_joint_attractor_goes_the_short_way(robot_of):
    """gain (rest - q); with the robot a continuous joint goes the short way round; wrong sizes are refused."""
    assert_allclose(ml.JointAttractor([1.0, 2.0], gain=3.0)([0.5, 0.0]), [1.5, 6.0])
    robot = robot_of("wrist")
    policy = ml.JointAttractor([3.0, 0.0, 0.0, 0.0], robot=robot)
    assert policy([-3.0, 0.0, 0.0, 0.0])[0] == pytest.approx(6.0 - 2.0 * np.pi)
    for call, error, words in (
        (lambda: ml.JointAttractor([0.0, 0.0])([0.0, 0.0, 0.0]), TargetError, "2 numbers"),
        (lambda: ml.JointAttractor([0.0, 0.0], robot=robot), ConfigurationError, None),
    ):
        with pytest.raises(error, match=words):
            call()


def test_ascent_is_the_gradient(constraint, planar3, rng):
    """gain grad mu as the paper prints it, or along the gradient g of log mu: gain |g| at most, and
    max_speed / sqrt(1 + (dt max_speed |g| / 1.25)^2); 5e-4 rad/s at a singularity; the gain is 3 by default.
    """
    stretched = ml.ManipulabilityAscent(ml.Constraint(np.eye(2), ml.FrameJacobian(planar3, "tip", "x y")))
    assert np.linalg.norm(stretched(np.zeros(3))) == pytest.approx(5e-4, rel=1e-9)
    for q in 0.5 * rng.standard_normal((5, 7)):
        log, raw = (ml.ManipulabilityAscent(constraint, 0.7, logarithmic=x) for x in (True, False))
        slope = ml.log_manipulability_gradient(constraint, q)
        assert_allclose(log(q), 0.7 * slope, rtol=1e-9, atol=1e-12)
        assert_allclose(raw(q), 0.7 * ml.manipulability_gradient(constraint, q), rtol=1e-9, atol=1e-12)
        slope = ml.ManipulabilityAscent(constraint, 1.0, max_speed=None)(q)
        assert_allclose(ml.ManipulabilityAscent(constraint, max_speed=None)(q), 3.0 * slope, rtol=1e-12)
        size = float(np.linalg.norm(slope))
        for gain, speed, dt in product((0.5, 3.0), (0.1, 1.0, 10.0, None), (0.001, 0.05, 2.0)):
            longest = np.inf if speed is None else speed / np.sqrt(1.0 + (dt * speed * size / 1.25) ** 2)
            got = ml.ManipulabilityAscent(constraint, gain, max_speed=speed)(q, 0.0, dt)
            assert_allclose(got, slope / size * min(gain * size, longest), rtol=1e-12)
    with pytest.raises(ConfigurationError):
        log(np.full(7, np.nan))


@pytest.mark.parametrize("name", ["gantry", "wrist", "panda"])
def test_joint_limit_avoidance(robot_of, rng, name):
    """It descends the potential, at most at its speed, finite at the limits and outside; free joints are left alone."""
    robot = robot_of(name)
    policy, limited = ml.JointLimitAvoidance(robot, 0.2, max_speed=0.3), np.isfinite(robot.position_upper)
    lower, upper = robot.position_lower[limited], robot.position_upper[limited]
    width = upper - lower
    longest = np.minimum(0.3, 0.5 * width)
    for _ in range(20):
        q = robot.positions(robot.random_configuration(rng))
        pi, x = policy(q), (2.0 * q[limited] - upper - lower) / width
        p = 0.2 * width * x / (1.0 - x**2) ** 2  # of h: 4 x / (width (1 - x^2)^2)
        assert_allclose(pi[limited], -p / np.sqrt(1.0 + (p / longest) ** 2), rtol=1e-7, atol=1e-12)
        assert_array_equal(pi[~limited], 0.0)
    for beyond, (bound, sign) in product((0.0, 1e-12, 0.5), ((upper, 1.0), (lower, -1.0))):
        q = np.full(robot.nv, 0.1)
        q[limited] = bound + sign * beyond
        assert_allclose(policy(q)[limited], -sign * longest, rtol=1e-9)


def test_weighted_sum(constraint, robot_of, rng):
    """sum w_i pi_i, sums within sums too; wrong weights and sizes are refused; the weights can be read."""
    robot = robot_of("sawyer")
    q, a, b = robot.random_configuration(rng), ml.JointLimitAvoidance(robot), ml.ManipulabilityAscent(constraint)
    inner = ml.WeightedPolicies([a, b], [0.5, 2.0])
    assert_allclose(inner(q), 0.5 * a(q) + 2.0 * b(q))
    assert_allclose(inner(q, 0.0, 0.1), 0.5 * a(q) + 2.0 * b(q, 0.0, 0.1))
    assert_allclose(ml.WeightedPolicies([inner, a], [3.0, 1.0])(q), 3.0 * inner(q) + a(q))
    with pytest.raises(ConfigurationError):
        ml.WeightedPolicies([])
    with pytest.raises(TargetError, match="7, 3"):
        ml.WeightedPolicies([a, ml.ZeroPolicy(3)])(q)
