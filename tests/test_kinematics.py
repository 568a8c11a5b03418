"""Kinematics of one posture and of many at once are those of Pinocchio's model of the whole robot, asked in any order.

Derivatives are compared with central differences in test_gradients.py.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from conftest import TIPS, URDFS, chain_urdf, tip_of
from rounding import rounding

from manip_learn.constraint.features import FrameJacobian
from manip_learn.errors import ConfigurationError
from manip_learn.robot.frame_kinematics import DERIVATIVE_CHUNK, PINOCCHIO_REFERENCES, FrameKinematics
from manip_learn.robot.loading import robot_from_text
from manip_learn.robot.robot import Robot

ROBOTS = [*URDFS, *TIPS]
TOLERANCE = 1e-12


@pytest.mark.parametrize("name", ROBOTS)
def test_the_joints_that_carry_a_frame_are_enough(name, robot_of, rng):
    """Poses and Jacobians, alone and in a table, at configurations and joint positions, of frames all along the arm."""
    robot = robot_of(name)
    model, data = robot.pinocchio_model, robot.pinocchio_model.createData()
    for frame in (tip_of(name), robot.frame_names[0], robot.frame_names[len(robot.frame_names) // 2]):
        index, table, poses = robot.frame(frame).index, [], []
        for _ in range(5):
            q = robot.random_configuration(rng)
            for posture in (q, robot.positions(q)):
                full = robot.pinocchio_configuration(posture)
                for reference, theirs in PINOCCHIO_REFERENCES.items():
                    J = pin.computeFrameJacobian(model, data, full, index, theirs).reshape(6, model.nv)
                    J = J if robot.coupling is None else J @ robot.coupling.lift
                    np.testing.assert_allclose(robot.jacobian(posture, frame, reference), J, rtol=0, atol=1e-13)
                pin.forwardKinematics(model, data, full)
                pose = pin.updateFramePlacement(model, data, index).homogeneous
                np.testing.assert_allclose(robot.pose(posture, frame), pose, rtol=0, atol=1e-13)
                np.testing.assert_array_equal(robot.position(posture, frame), robot.pose(posture, frame)[:3, 3])
            table.append(robot.positions(q))
            poses.append(pose)
        np.testing.assert_allclose(robot.frame_kinematics(frame).poses(np.array(table)), poses, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("name", ROBOTS)
def test_no_number_depends_on_what_was_asked_before(name, robot_of, rng):
    """In any order of calls, at any postures in between, every answer is the same to the last bit."""
    robot = robot_of(name)
    frame = robot.frame(tip_of(name))
    asked = [
        lambda kinematics, q: (kinematics.pose(q),),
        lambda kinematics, q: (kinematics.position(q),),
        lambda kinematics, q: (kinematics.jacobian(q, "world"),),
        lambda kinematics, q: (kinematics.jacobian(q, "local"),),
        lambda kinematics, q: kinematics.jacobian_and_derivative(q, "local"),
        lambda kinematics, q: kinematics.jacobian_and_derivative(q, "world"),
    ]
    postures, used = [robot.random_configuration(rng) for _ in range(3)], FrameKinematics(robot, frame)
    expected = [[ask(FrameKinematics(robot, frame), q) for q in postures] for ask in asked]
    for k, i in rng.integers((len(asked), len(postures)), size=(300, 2)):
        for a, b in zip(asked[k](used, postures[i]), expected[k][i], strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("n", [0, 1, *(DERIVATIVE_CHUNK + k for k in (-1, 0, 1)), 2 * DERIVATIVE_CHUNK + 3])
def test_chunks_leave_no_seam(n, robot_of, rng):
    """Any number of postures, including zero: each row is the result of its own posture."""
    robot = robot_of("sawyer")
    q, features = rng.uniform(-2.0, 2.0, (n, robot.nv)), FrameJacobian(robot, "right_hand", "x rz")
    Phi, dPhi = features.batch_with_derivative(q)
    assert features.batch(q).shape == (n, 2, 7) and Phi.shape == (n, 2, 7) and dPhi.shape == (n, 2, 7, 7)
    assert robot.frame_kinematics(features.frame).poses(q).shape == (n, 4, 4)
    for i in {0, n // 2, n - 1} if n else ():
        np.testing.assert_allclose(features.batch(q)[i], features(q[i]), rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(dPhi[i], features.derivative(q[i]), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("tilt", ["0", "1e-9", "3.67e-6", "1e-3", "1.5708", "3.14159"])
def test_nearly_parallel_axes_lose_nothing(tilt):
    """Axes tilted by 1e-9 .. 1e-3 rad against each other stay accurate (Denavit and Hartenberg's form would not)."""
    joints = [("revolute", "0 0 1", "0.3 0.1 0.2", f"{tilt} 0 0.4")] * 4
    features = FrameJacobian(Robot(pin.buildModelFromXML(chain_urdf("nearly", joints))), "tip", "pose")
    q = np.array([[0.3, -1.0, 2.0, 0.7]])
    np.testing.assert_allclose(features.batch(q)[0], features(q[0]), rtol=0, atol=rounding(8 * 4, q, 2.0))  # [m] long


def test_a_table_that_changes_is_seen(robot_of):
    """Numbers of the last table are kept, for this table only; a caller that changes its arrays spoils nothing."""
    robot = robot_of("sawyer")
    kinematics, q = robot.frame_kinematics("right_hand"), np.linspace(-1.0, 1.0, 21).reshape(3, 7)

    def answers():
        return kinematics.poses(q), kinematics.jacobians(q), kinematics.jacobians(q, "local")

    first = answers()
    for array in (kinematics.poses(q), kinematics.jacobians(q), kinematics.jacobians_and_derivatives(q)[0]):
        array[:] = 7.0
    for a, b in zip(first, answers(), strict=True):
        np.testing.assert_array_equal(a, b)
    q[1, 2] += 0.1
    assert not np.allclose(kinematics.poses(q)[1], first[0][1]) and np.array_equal(kinematics.poses(q)[2], first[0][2])
    np.testing.assert_allclose(kinematics.jacobians(q)[1], robot.jacobian(q[1], "right_hand"), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_not_finite_names_row_and_joint(value, robot_of):
    """NaN or infinity is refused with the first bad row and the joint's name, before any work."""
    robot, q = robot_of("sawyer"), np.zeros((2000, 7))
    q[1234, 5], q[1500, 0] = value, np.nan
    features = FrameJacobian(robot, "right_hand")
    for call in (features.batch, features.batch_with_derivative, robot.frame_kinematics("right_hand").poses):
        with pytest.raises(ConfigurationError, match=rf"row 1234, joint '{robot.joint_names[5]}'"):
            call(q)


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


def test_a_robot_without_joints_has_its_frames(tmp_path):
    """Its only posture has no numbers, and is a posture all the same."""
    fixed = '<joint name="up" type="fixed"><parent link="base"/><child link="top"/><origin xyz="0.1 0.2 0.3"/></joint>'
    text = f'<robot name="post"><link name="base"/><link name="top"/>{fixed}</robot>'
    robot, q = robot_from_text(text.encode(), tmp_path / "post.urdf"), np.zeros(0)
    np.testing.assert_array_equal(robot.position(q, "top"), [0.1, 0.2, 0.3])
    assert robot.jacobian(q, "top").shape == (6, 0)
    assert [x.shape for x in robot.jacobian_and_derivative(q, "top", "local")] == [(6, 0), (6, 0, 0)]
