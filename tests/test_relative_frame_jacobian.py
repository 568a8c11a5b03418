"""Rows of one frame as seen from another that moves too; their derivatives are in test_gradients.py."""

from __future__ import annotations

import numpy as np
import pytest
from test_gradients import RobotOf, central_difference

import manip_learn as ml
from manip_learn.errors import FeatureError, TargetError, UnknownNameError


def test_a_constraint_is_saved_controlled_and_climbs(robot_of: RobotOf, rng: np.random.Generator, tmp_path):
    """A constraint on relative rows is saved and read back, has an exact gradient, and drives a controller."""
    robot = robot_of("tree")
    features = ml.RelativeFrameJacobian(robot, "tip", "arm_b", "x y z")
    constraint = ml.Constraint(np.array([[1.0, 0.2, 0.0], [0.0, 0.0, 1.0]]), features)
    again = ml.Constraint.load(constraint.save(tmp_path / "c.json"), robot)
    q = robot.random_configuration(rng)
    np.testing.assert_array_equal(again(q), constraint(q))
    expected = central_difference(lambda x: ml.manipulability(constraint, x), robot, q)
    np.testing.assert_allclose(ml.manipulability_gradient(constraint, q), expected, rtol=0, atol=1e-8)
    target = features.coordinates(q) + np.array([0.02, 0.0, 0.01])
    controller = ml.ResolvedRateController(constraint, ml.PointAttractor(target), ml.ManipulabilityAscent(constraint))
    rollout = ml.simulate(robot, controller, q, duration=6.0, dt=0.01)
    end = features.error_to(target, rollout.q[-1])
    assert np.linalg.norm(constraint.selection @ end) < 1e-3


def test_bad_arguments_are_refused(robot_of: RobotOf):
    """Unknown frames, the same frame twice, unknown axes and targets of another size are errors."""
    robot = robot_of("sawyer")
    with pytest.raises(UnknownNameError):
        ml.RelativeFrameJacobian(robot, "right_hand", "rihgt_l3")
    with pytest.raises(FeatureError, match="relative to itself"):
        ml.RelativeFrameJacobian(robot, "right_hand", "right_hand")
    with pytest.raises(FeatureError):
        ml.RelativeFrameJacobian(robot, "right_hand", "right_l3", "x w")
    with pytest.raises(TargetError):
        ml.RelativeFrameJacobian(robot, "right_hand", "right_l3", "x").error_to([1.0, 2.0], np.zeros(7))
