"""Kinematics of many postures at once must be the kinematics of each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest
from case import case
from conftest import TIPS, URDFS, tip_of
from rounding import rounding

from manip_learn.constraint.features import FrameJacobian
from manip_learn.errors import ConfigurationError
from manip_learn.robot.frame_kinematics import DERIVATIVE_CHUNK
from manip_learn.robot.robot import Robot

RobotOf = Callable[[str], Robot]
ROBOTS = [*URDFS, *TIPS]
AXES = ["xyz", "pose", "planar", "ry z", "rotation"]
REFERENCES = ["world", "local"]
TOLERANCE = 1e-12


def positions(robot: Robot, rng: np.random.Generator, n: int) -> np.ndarray:
    return np.stack([robot.positions(robot.random_configuration(rng)) for _ in range(n)])


@pytest.mark.parametrize("name", ROBOTS)
def test_poses_are_those_of_each(name, robot_of, rng):
    """Poses of a batch are Pinocchio's to 1e-12; its Jacobians and derivatives are compared in test_gradients.py."""
    robot = robot_of(name)
    q, frame = positions(robot, rng, 5), robot.frame(tip_of(name))
    got = robot.frame_kinematics(frame).poses(q)
    np.testing.assert_allclose(got, [robot.pose(x, frame) for x in q], rtol=0, atol=TOLERANCE)


def test_chunks_leave_no_seam(robot_of, rng):
    """Any number of postures, including zero: each row is the result of its own posture."""
    for n in [0, 1, DERIVATIVE_CHUNK - 1, DERIVATIVE_CHUNK, DERIVATIVE_CHUNK + 1, 2 * DERIVATIVE_CHUNK + 3]:
        with case(n):
            robot = robot_of("sawyer")
            q = rng.uniform(-2.0, 2.0, (n, robot.nv))
            features = FrameJacobian(robot, "right_hand", "x rz")
            Phi, dPhi = features.batch_with_derivative(q)
            assert features.batch(q).shape == (n, 2, 7) and Phi.shape == (n, 2, 7) and dPhi.shape == (n, 2, 7, 7)
            assert robot.frame_kinematics(features.frame).poses(q).shape == (n, 4, 4)
            for i in {0, n // 2, n - 1} if n else ():
                np.testing.assert_allclose(features.batch(q)[i], features(q[i]), rtol=0, atol=TOLERANCE)
                np.testing.assert_allclose(dPhi[i], features.derivative(q[i]), rtol=0, atol=TOLERANCE)


def test_nearly_parallel_axes_lose_nothing():
    """Axes tilted by 1e-9 .. 1e-3 rad against each other stay accurate (Denavit and Hartenberg's form would not)."""
    from conftest import chain_urdf

    for tilt in ("0", "1e-9", "3.67e-6", "1e-3", "1.5708", "3.14159"):
        joints = [("revolute", "0 0 1", "0.3 0.1 0.2", f"{tilt} 0 0.4")] * 4
        robot = Robot(pin.buildModelFromXML(chain_urdf("nearly", joints)))
        features = FrameJacobian(robot, "tip", "pose")
        q = np.array([[0.3, -1.0, 2.0, 0.7]])
        known = rounding(8 * 4, q, 2.0)  # [m] long
        np.testing.assert_allclose(features.batch(q)[0], features(q[0]), rtol=0, atol=known)


def test_a_table_that_changes_is_seen(robot_of):
    """Numbers of the last table are kept, for this table only; a caller that changes its arrays spoils nothing."""
    robot = robot_of("sawyer")
    kinematics, q = robot.frame_kinematics("right_hand"), np.linspace(-1.0, 1.0, 21).reshape(3, 7)
    first = kinematics.poses(q), kinematics.jacobians(q), kinematics.jacobians(q, "local")
    for array in (kinematics.poses(q), kinematics.jacobians(q), kinematics.jacobians_and_derivatives(q)[0]):
        array[:] = 7.0
    for a, b in zip(
        first, (kinematics.poses(q), kinematics.jacobians(q), kinematics.jacobians(q, "local")), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    q[1, 2] += 0.1
    assert not np.allclose(kinematics.poses(q)[1], first[0][1]) and np.array_equal(kinematics.poses(q)[2], first[0][2])
    np.testing.assert_allclose(kinematics.jacobians(q)[1], robot.jacobian(q[1], "right_hand"), rtol=0, atol=TOLERANCE)


def test_not_finite_names_row_and_joint(robot_of):
    """NaN or infinity is refused with the first bad row and the joint's name, before any work."""
    for value in [np.nan, np.inf, -np.inf]:
        with case(value):
            robot = robot_of("sawyer")
            q = np.zeros((2000, 7))
            q[1234, 5] = value
            q[1500, 0] = np.nan
            for call in (
                FrameJacobian(robot, "right_hand").batch,
                FrameJacobian(robot, "right_hand").batch_with_derivative,
            ):
                with pytest.raises(ConfigurationError, match=rf"row 1234, joint '{robot.joint_names[5]}'"):
                    call(q)
            with pytest.raises(ConfigurationError, match="row 1234"):
                robot.frame_kinematics("right_hand").poses(q)


def test_wrong_tables_are_refused(robot_of):
    """One posture, a wrong number of columns, text, a (cos, sin) of length zero: each error says what is expected."""
    robot = robot_of("wrist")
    features = FrameJacobian(robot, "tip")
    for wrong in (np.zeros(4), np.zeros((3, 5)), np.zeros((2, 2, 4)), [["a"] * 4], [[1.0], [1.0, 2.0]]):
        with pytest.raises(ConfigurationError, match="table"):
            features.batch(wrong)
    q = np.stack([robot.configuration(np.zeros(4))] * 3)
    q[2, robot.blocks[2].q] = 0.0
    with pytest.raises(ConfigurationError, match="row 2, joint 'joint2'"):
        features.batch(q)
