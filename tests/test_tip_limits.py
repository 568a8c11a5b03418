"""A limit on the speed of frames: it holds for positions and poses, and costs no more of the motion than it must."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from servo_cases import Constantly

import manip_learn as ml
from manip_learn.control.joint_motion import JointMotion, every_joint
from manip_learn.errors import ConfigurationError, UnknownNameError

TIP, SPEED, DT = "right_gripper_tip", 0.25, 0.002
RobotOf = Callable[[str], ml.Robot]


def speeds(robot: ml.Robot, controller: ml.Controller, q: np.ndarray, frames: tuple[str, ...]) -> np.ndarray:
    """Speeds of the frames over 1.2 s of a loop, shape (T, frames) [m/s]."""
    loop, rows = ml.ServoLoop(controller, DT, robot=robot), []
    for k in range(600):
        command = loop.update(q, k * DT)
        rows.append([np.linalg.norm(robot.jacobian(q, frame)[:3] @ command.velocity) for frame in frames])
        q = robot.integrate(q, DT * command.velocity)
    return np.array(rows)


@pytest.mark.parametrize(("axes", "frames"), [("xyz", (TIP,)), ("pose", (TIP, "right_l4"))])
def test_no_frame_is_faster(axes, frames, robot_of, rng):
    """Far targets with a large gain: the tip moves at its limit and never beyond it; without a limit far beyond it."""
    robot = robot_of("sawyer")
    features = ml.FrameJacobian(robot, TIP, axes)
    constraint = ml.Constraint(np.eye(features.n_rows)[: 2 if axes == "xyz" else 6], features)
    for _ in range(2):
        q = rng.uniform(-0.8, 0.8, 7)
        aim = q + rng.uniform(-0.6, 0.6, 7)
        goal = robot.position(aim, TIP) if axes == "xyz" else robot.pose(aim, TIP)
        task, climb = ml.PointAttractor(goal, gain=5.0), ml.ManipulabilityAscent(constraint)
        limits = ml.Limits(robot, tip_speed=SPEED, frames=frames)
        held = speeds(robot, ml.ResolvedRateController(constraint, task, climb, limits=limits), q, frames)
        assert held.max() <= SPEED + 1e-9
        assert held.max() >= 0.99 * SPEED
        assert speeds(robot, ml.ResolvedRateController(constraint, task, climb), q, frames).max() > 1.5 * SPEED


def test_the_direction_of_the_task_is_kept(robot_of):
    """Slowed down, the hand goes the same way, and the status says why."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint(np.eye(3), ml.FrameJacobian(robot, TIP, "xyz"))
    q, way = np.array([0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0]), np.array([0.3, -0.4, 0.1])
    task = ml.PointAttractor(robot.position(q, TIP) + way, gain=5.0)
    command = ml.ResolvedRateController(constraint, task, limits=ml.Limits(robot, tip_speed=SPEED))(q)
    v = constraint(q) @ command.velocity
    np.testing.assert_allclose(v / np.linalg.norm(v), way / np.linalg.norm(way), atol=1e-9)
    assert 0.998 * SPEED <= np.linalg.norm(v) <= SPEED
    assert command.status is ml.Status.VELOCITY_LIMITED and command.task_scale < 0.2


def test_a_controller_of_the_users_own_is_slowed_down(robot_of):
    """Its velocity is scaled as a whole."""
    robot = robot_of("sawyer")
    own = Constantly(robot, np.full(7, 0.5))
    loop = ml.ServoLoop(own, DT, limits=ml.Limits(robot, tip_speed=0.1))
    q = np.array([0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0])
    for k in range(300):
        u = loop.update(q, k * DT).velocity
        assert np.linalg.norm(robot.jacobian(q, TIP)[:3] @ u) <= 0.101
        q = robot.integrate(q, DT * u)
    assert np.linalg.norm(u) > 0.05


@pytest.mark.parametrize(("gain", "ways"), [(1.0, np.diag([1.0, -1.0, 1.0])), (10.0, np.diag([-1.0, 1.0, -1.0]))])
def test_the_tip_stays_in_its_box(gain, ways, robot_of, rng):
    """Targets beyond each face, and beyond two: the tip comes to rest at the nearest point of the box, at most 0.1 mm
    beyond a face, within all other limits.
    """
    robot = robot_of("sawyer")
    constraint = ml.Constraint(np.eye(3), ml.FrameJacobian(robot, TIP, "xyz"))
    q0 = np.array([0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0])
    start = robot.position(q0, TIP)
    box = np.array([start - 0.06, start + 0.08])
    limits = ml.Limits(robot, tip_box=box)
    for way in (*ways, rng.uniform(-1.0, 1.0, 3)):
        task, climb = ml.PointAttractor(start + 0.2 * way, gain=gain), ml.ManipulabilityAscent(constraint)
        loop = ml.ServoLoop(ml.ResolvedRateController(constraint, task, climb, limits=limits), 0.001)
        q, beyond, before, words = q0, -np.inf, np.zeros(7), []
        for k in range(4000):
            command = loop.update(q, 0.001 * k)
            assert np.all(np.abs(command.velocity - before) <= 0.001 * limits.acceleration * (1.0 + 1e-9))
            before, q = command.velocity, q + 0.001 * command.velocity
            place = robot.position(q, TIP)
            beyond = max(beyond, float(np.max(np.maximum(place - box[1], box[0] - place))))
            words.append(command.status)
        assert -2e-3 < beyond < 1e-4
        assert np.linalg.norm(place - np.clip(task.target, *box)) < 5e-3
        assert np.linalg.norm(robot.jacobian(q, TIP)[:3] @ command.velocity) < 5e-3
        assert ml.Status.POSITION_LIMITED in words


def test_an_oblique_wall_and_a_start_beyond_it(robot_of):
    """Half-spaces are boxes' faces in any direction; a tip that starts behind one comes back."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint(np.eye(3)[:2], ml.FrameJacobian(robot, TIP, "xyz"))
    q = np.array([0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0])
    n = np.array([1.0, 2.0, -1.0])
    wall = [*n, n @ robot.position(q, TIP) - 0.02 * np.linalg.norm(n)]  # 20 mm behind it
    limits = ml.Limits(robot, tip_walls=[wall], tip_speed=1.0)
    controller = ml.ResolvedRateController(constraint, null_policy=ml.ManipulabilityAscent(constraint), limits=limits)
    rollout = ml.simulate(robot, controller, q, 1.5, 0.002)
    behind = [(n @ robot.position(x, TIP) - wall[3]) / np.linalg.norm(n) for x in rollout.q]
    assert behind[0] == pytest.approx(0.02) and abs(behind[-1]) < 1e-3


def test_a_motion_of_the_joints_takes_the_time_that_the_tip_needs(robot_of, rng):
    """From posture to posture the tip keeps its speed and the joints their straight lines, which are clear."""
    robot = robot_of("sawyer")
    knots = np.cumsum([[0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0], *rng.uniform(-0.3, 0.3, (2, 7))], axis=0)
    limits = ml.Limits(robot).with_tip_speed(0.1, [TIP])
    task = JointMotion(limits, knots)
    law = ml.ResolvedRateController(every_joint(robot), task, limits=limits)
    rollout = ml.simulate(robot, law, knots[0], task.duration + 0.1, 0.01)
    places = np.array([robot.position(q, TIP) for q in rollout.q])
    assert 0.09 < np.linalg.norm(np.diff(places, axis=0), axis=1).max() / 0.01 <= 0.1
    away = np.full(len(rollout), np.inf)  # from the straight lines
    for a, d in zip(knots[:-1], np.diff(knots, axis=0), strict=True):
        share = np.clip((rollout.q - a) @ d / (d @ d), 0.0, 1.0)
        away = np.minimum(away, np.linalg.norm(rollout.q - a - share[:, None] * d, axis=1))
    assert away.max() < 1e-3 and np.linalg.norm(rollout.q[-1] - knots[-1]) < 1e-3
    assert JointMotion(ml.Limits(robot), knots).duration < 0.5 * task.duration


def test_a_speed_for_frames_beside_the_limits_that_there_are(robot_of):
    """The lower speed counts, for the frames of both; walls, rates and what is kept clear of stay."""
    robot = robot_of("sawyer")
    own = ml.Limits(robot, tip_speed=0.2, tip_walls=[[0.0, 0.0, 2.0, 1.0]], jerk=50.0, frames="right_l4")
    for speed, least in ((0.1, 0.1), (0.4, 0.2)):
        both = own.with_tip_speed(speed, [TIP])
        assert own.barriers.speed == 0.2 and both.barriers.speed == least
        assert [frame.name for frame in both.barriers.frames] == ["right_l4", TIP]
        np.testing.assert_array_equal(both.barriers.walls, own.barriers.walls)
        np.testing.assert_array_equal(both.jerk, own.jerk)
    with pytest.raises(ConfigurationError, match="tip_speed"):
        own.with_tip_speed(0.0, [TIP])
    with pytest.raises(UnknownNameError):
        own.with_tip_speed(0.1, ["nowhere"])


def test_bad_arguments(robot_of):
    """Speeds that are none, unknown frames, boxes without room and walls without a side."""
    robot = robot_of("sawyer")
    for speed in (0.0, -1.0, np.nan, np.inf, "fast"):
        with pytest.raises(ConfigurationError, match="tip_speed"):
            ml.Limits(robot, tip_speed=speed)  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError):
        ml.Limits(robot, tip_speed=1.0, frames="nowhere")
    for box in ([0.0, 1.0], [[0.0] * 3, [1.0, 0.0, 1.0]], [[0.0] * 3, [np.nan] * 3]):
        with pytest.raises(ConfigurationError, match="a box is two rows"):
            ml.Limits(robot, tip_box=box)
    for walls in ([1.0, 0.0, 0.0, 1.0], [[0.0, 0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0, np.inf]]):
        with pytest.raises(ConfigurationError, match="walls must be rows"):
            ml.Limits(robot, tip_walls=walls)
