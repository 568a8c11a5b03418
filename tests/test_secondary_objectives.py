"""Secondary objectives in the null space: limits, weighted sums, and what the controller makes of them."""

from __future__ import annotations

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.control.policies import (
    JointAttractor,
    JointLimitAvoidance,
    ManipulabilityAscent,
    PenalisedManipulabilityAscent,
    WeightedPolicies,
    ZeroPolicy,
)
from manip_learn.errors import ConfigurationError, TargetError
from manip_learn.robot.limit_potential import limit_gradient

DT = 0.01


@pytest.mark.parametrize("name", ["one", "planar3", "gantry", "wrist", "panda", "ur5", "sawyer"])
def test_joint_limit_avoidance(robot_of, rng, name: str):
    """It descends the potential, at most at its speed, finite at the limits and outside; free joints are left alone."""
    robot = robot_of(name)
    policy = JointLimitAvoidance(robot, 0.2, max_speed=0.3)
    limited = np.isfinite(robot.position_upper)
    width = robot.position_upper[limited] - robot.position_lower[limited]
    longest = np.minimum(0.3, 0.5 * width)
    for _ in range(20):
        q = robot.positions(robot.random_configuration(rng))
        pi = policy(q)
        p = 0.2 * (0.5 * width) ** 2 * limit_gradient(robot, q)[limited]
        np.testing.assert_allclose(pi[limited], -p / np.sqrt(1.0 + (p / longest) ** 2), rtol=1e-7, atol=1e-12)
        np.testing.assert_array_equal(pi[~limited], 0.0)
    for beyond in (0.0, 1e-12, 0.5):
        for bound, sign in ((robot.position_upper, 1.0), (robot.position_lower, -1.0)):
            q = np.full(robot.nv, 0.1)
            q[limited] = bound[limited] + sign * beyond
            np.testing.assert_allclose(policy(q)[limited], -sign * longest, rtol=1e-9)


def test_joint_limit_avoidance_can_be_followed(robot_of):
    """Explicit steps come to rest in the middle of all ranges, from all limits and from outside, without overshoot."""
    for name in ("gantry", "panda", "sawyer"):
        robot = robot_of(name)
        policy, middle = JointLimitAvoidance(robot, 0.5), 0.5 * (robot.position_lower + robot.position_upper)
        q, before = robot.position_upper + 0.1, np.full(robot.nv, np.inf)
        for _ in range(3000):
            q = q + DT * policy(q)
            assert np.all(q - middle < before) and np.all(q - middle > -1e-12)
            before = q - middle + 1e-12
        np.testing.assert_allclose(q, middle, atol=1e-4)
    with pytest.raises(ConfigurationError, match="gain"):
        JointLimitAvoidance(robot, -1.0)
    with pytest.raises(ConfigurationError, match="max_speed"):
        JointLimitAvoidance(robot, max_speed=np.nan)


def reaching(robot_of, rng):
    """Sawyer, two oblique rows, a reachable target and a start."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint(rng.normal(size=(2, 3)), ml.FrameJacobian(robot, "right_hand", "xyz"))
    start, goal = robot.random_configuration(rng), robot.position(robot.random_configuration(rng), "right_hand")
    return robot, constraint, ml.PointAttractor(goal), start


def test_weighted_sum(robot_of, rng):
    """sum w_i pi_i, sums within sums too; wrong weights and sizes are refused; the weights can be read."""
    robot, constraint, _, q = reaching(robot_of, rng)
    a, b = JointLimitAvoidance(robot), ManipulabilityAscent(constraint)
    inner = WeightedPolicies([a, b], [0.5, 2.0])
    np.testing.assert_allclose(inner(q), 0.5 * a(q) + 2.0 * b(q))
    np.testing.assert_allclose(inner(q, 0.0, 0.1), 0.5 * a(q) + 2.0 * b(q, 0.0, 0.1))
    np.testing.assert_allclose(WeightedPolicies([inner, a], [3.0, 1.0])(q), 3.0 * inner(q) + a(q))
    np.testing.assert_array_equal(WeightedPolicies([a])(q), a(q))
    text = repr(inner)
    assert text.startswith("WeightedPolicies(0.5 JointLimitAvoidance(") and "+ 2 ManipulabilityAscent(" in text
    for policies, weights in (([], None), ([a], [1.0, 2.0]), ([a], [-1.0]), ([a], [np.nan])):
        with pytest.raises(ConfigurationError):
            WeightedPolicies(policies, weights)
    with pytest.raises(TargetError, match="7, 3"):
        WeightedPolicies([a, ZeroPolicy(3)])(q)


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.05])
def test_ascent_within_a_sum_is_the_ascent(robot_of, rng, dt: float):
    """A sum of the ascent alone commands what the ascent does, at singularities and beside them, at each dt."""
    for name, frame in (("sawyer", "right_hand"), ("planar3", "tip"), ("ur5", "tool0")):
        robot = robot_of(name)
        constraint = ml.Constraint(np.eye(2), ml.FrameJacobian(robot, frame, "x y" if name == "planar3" else "z rx"))
        alone, summed = (
            ml.ResolvedRateController(constraint, None, policy, dt=dt)
            for policy in (ManipulabilityAscent(constraint), WeightedPolicies([ManipulabilityAscent(constraint)]))
        )
        for distance in (0.0, 1e-9, 1e-3, 1e-2, 0.5):
            q = distance * rng.standard_normal(robot.nv)
            one, other = alone(q), summed(q)
            assert one.status == other.status
            np.testing.assert_allclose(other.velocity, one.velocity, rtol=1e-9, atol=1e-12)


def test_singularities_are_left_with_several_objectives(robot_of):
    """From exactly stretched postures, mu grows within a second although other objectives share the null space."""
    for name, frame in (("planar3", "tip"), ("ur5", "tool0")):
        robot = robot_of(name)
        constraint = ml.Constraint(np.eye(2), ml.FrameJacobian(robot, frame, "x y" if name == "planar3" else "z rx"))
        policy = WeightedPolicies([ManipulabilityAscent(constraint), JointLimitAvoidance(robot)], [1.0, 0.3])
        start = np.zeros(robot.nv)
        rollout = ml.simulate(robot, ml.ResolvedRateController(constraint, None, policy), start, 2.0, DT)
        assert ml.manipulability(constraint, start) < 1e-9 and rollout.manipulability[-1] > 0.01


def test_the_task_is_not_disturbed(robot_of, rng):
    """Whatever the weights, A u = b away from singularities, and limits are kept."""
    robot, constraint, task, start = reaching(robot_of, rng)
    policy = WeightedPolicies(
        [PenalisedManipulabilityAscent(constraint), JointLimitAvoidance(robot), JointAttractor(robot.neutral())],
        [1.0, 5.0, 0.5],
    )
    controller = ml.ResolvedRateController(constraint, task, policy, limits=False)
    for _ in range(20):
        q = robot.random_configuration(rng)
        command = controller(q)
        if command.smallest_singular_value > 0.05:
            b = task.velocity(constraint, q, 0.0)
            np.testing.assert_allclose(constraint(q) @ command.velocity, b, atol=1e-10)
    rollout = ml.simulate(robot, ml.ResolvedRateController(constraint, task, policy), start, 2.0, DT)
    assert np.all(rollout.q <= robot.position_upper + 1e-9) and np.all(rollout.q >= robot.position_lower - 1e-9)


def test_limits_are_kept_at_a_distance(robot_of):
    """From a posture near its limits, a held task ends further away from them with the avoidance than without."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint([[1.0, 0.0, 0.0]], ml.FrameJacobian(robot, "right_hand", "xyz"))
    middle, half = 0.5 * (robot.position_lower + robot.position_upper), 0.5 * robot.position_upper
    start = middle + 1.8 * (half - 0.5 * middle)
    rooms = []
    for policy in (None, JointLimitAvoidance(robot)):
        q = ml.simulate(robot, ml.ResolvedRateController(constraint, None, policy), start, 5.0, DT).q[-1]
        rooms.append(np.min(np.minimum(robot.position_upper - q, q - robot.position_lower)))
    assert rooms[1] > rooms[0] + 0.1
