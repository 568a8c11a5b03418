"""Kinematics of one frame: the joints that carry it give the numbers of the whole robot, whatever was asked before."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest
from case import case
from conftest import tip_of

from manip_learn.robot import load_robot
from manip_learn.robot.frame_kinematics import PINOCCHIO_REFERENCES, FrameKinematics
from manip_learn.robot.robot import Robot

RobotOf = Callable[[str], Robot]
ROBOTS = ["planar3", "sawyer", "panda", "kinova", "gantry", "wrist", "tree", "mimic", "one"]


def frames_of(robot: Robot, name: str) -> list[str]:
    return [tip_of(name), robot.frame_names[0], robot.frame_names[len(robot.frame_names) // 2]]


@pytest.mark.parametrize("name", ROBOTS)
def test_the_joints_that_carry_a_frame_are_enough(name, robot_of, rng):
    """Pose and Jacobian are those of Pinocchio's model of the whole robot, at configurations and joint positions."""
    for reference in ["world", "local"]:
        with case(reference):
            robot = robot_of(name)
            model = robot.pinocchio_model
            data = model.createData()
            for frame in frames_of(robot, name):
                index = robot.frame(frame).index
                for _ in range(5):
                    q = robot.random_configuration(rng)
                    for posture in (q, robot.positions(q)):
                        full = robot.pinocchio_configuration(posture)
                        J = pin.computeFrameJacobian(model, data, full, index, PINOCCHIO_REFERENCES[reference]).reshape(
                            6, model.nv
                        )
                        if robot.coupling is not None:
                            J = J @ robot.coupling.lift
                        pin.forwardKinematics(model, data, full)
                        pose = pin.updateFramePlacement(model, data, index).homogeneous
                        np.testing.assert_allclose(robot.jacobian(posture, frame, reference), J, rtol=0, atol=1e-13)
                        np.testing.assert_allclose(robot.pose(posture, frame), pose, rtol=0, atol=1e-13)
                        np.testing.assert_array_equal(robot.position(posture, frame), robot.pose(posture, frame)[:3, 3])


@pytest.mark.parametrize("name", ROBOTS)
def test_no_number_depends_on_what_was_asked_before(name, robot_of, rng):
    """In any order of calls, at any postures in between, every answer is the same to the last bit."""
    robot = robot_of(name)
    frame = robot.frame(tip_of(name))
    kinematics = FrameKinematics(robot, frame)
    asked: list[Callable[[np.ndarray], tuple[np.ndarray, ...]]] = [
        lambda q: (kinematics.pose(q),),
        lambda q: (kinematics.position(q),),
        lambda q: (kinematics.jacobian(q, "world"),),
        lambda q: (kinematics.jacobian(q, "local"),),
        lambda q: kinematics.jacobian_and_derivative(q, "local"),
        lambda q: kinematics.jacobian_and_derivative(q, "world"),
    ]
    postures = [robot.random_configuration(rng) for _ in range(3)]
    expected = {}
    for k, ask in enumerate(asked):
        for i, q in enumerate(postures):
            fresh, kinematics = kinematics, FrameKinematics(robot, frame)
            expected[k, i] = ask(q)
            kinematics = fresh
    for k, i in rng.integers((len(asked), len(postures)), size=(300, 2)):
        for a, b in zip(asked[k](postures[i]), expected[k, i], strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_robot_without_joints_has_its_frames(tmp_path):
    """Its only posture has no numbers, and is a posture all the same."""
    path = tmp_path / "post.urdf"
    path.write_text(
        "<robot name='post'><link name='base'/><link name='top'/><joint name='up' type='fixed'><parent link='base'/>"
        "<child link='top'/><origin xyz='0.1 0.2 0.3'/></joint></robot>"
    )
    robot, q = load_robot(path), np.zeros(0)
    np.testing.assert_array_equal(robot.position(q, "top"), [0.1, 0.2, 0.3])
    assert robot.jacobian(q, "top").shape == (6, 0)
    assert [x.shape for x in robot.jacobian_and_derivative(q, "top", "local")] == [(6, 0), (6, 0, 0)]
