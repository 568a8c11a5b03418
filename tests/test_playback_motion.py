"""Key frames, joint tracks and curves of a replay."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from test_playback import waving

from manip_learn.control.rollout import Rollout
from manip_learn.playback.appearance import Appearance
from manip_learn.playback.kinematic_tree import joint_tracks, kinematic_tree
from manip_learn.playback.recorded_motion import (
    MAX_CURVE_POINTS,
    MAX_KEY_FRAMES,
    MAX_PATH_POINTS,
    key_frames,
    recorded_motion,
)
from manip_learn.playback.scene_data import scene_data

ROBOTS = ("planar3", "sawyer", "panda", "kinova", "gantry", "wrist", "humanoid", "rover", "tree", "mimic")


def posed(tree, values):
    """Poses of all joints from the numbers of one key frame, as the page's program computes them."""
    poses, k = [np.eye(4)], 0
    for joint in tree[1:]:
        motion, x = np.eye(4), values[k : k + joint.width]
        if joint.motion == "revolute":
            motion[:3, :3] = pin.AngleAxis(x[0], joint.axis).matrix()
        elif joint.motion == "prismatic":
            motion[:3, 3] = x[0] * joint.axis
        else:
            motion = pin.XYZQUATToSE3(x).homogeneous
        poses.append(poses[joint.parent] @ joint.placement @ motion)
        k += joint.width
    assert k == len(values)
    return poses


@pytest.mark.parametrize("robot_name", ROBOTS)
def test_tracks_are_forward_kinematics(robot_of, rng, robot_name):
    """The numbers of a key frame give every joint's pose back, whatever kinds of joints and mimics there are."""
    robot = robot_of(robot_name)
    tree = kinematic_tree(robot)
    model = robot.pinocchio_model
    data = model.createData()
    postures = np.array([robot.random_configuration(rng) for _ in range(20)])
    tracks = joint_tracks(robot, tree, postures)
    for q, values in zip(postures, tracks, strict=True):
        pin.forwardKinematics(model, data, robot.pinocchio_configuration(q))
        for i, pose in enumerate(posed(tree, values)):
            np.testing.assert_allclose(pose, data.oMi[i].homogeneous, atol=1e-12)


def test_most_joints_move_by_one_number(robot_of):
    """Turning and sliding joints are stored as one number, so that links stay attached between key frames."""
    assert [j.motion for j in kinematic_tree(robot_of("gantry"))[1:]] == ["prismatic"] * 2 + ["revolute"] * 2 + [
        "prismatic"
    ]
    assert [j.motion for j in kinematic_tree(robot_of("wrist"))[1:]] == ["revolute"] * 4
    assert kinematic_tree(robot_of("humanoid"))[1].motion == "free"


def test_continuous_joints_take_the_short_way(robot_of):
    """A continuous joint that passes half a turn goes on, it does not spin back."""
    robot = robot_of("wrist")
    angles = np.linspace(2.0, 5.0, 31)
    positions = np.zeros((31, robot.nv))
    positions[:, 0] = angles
    tracks = joint_tracks(robot, kinematic_tree(robot), np.array([robot.configuration(p) for p in positions]))
    np.testing.assert_allclose(np.diff(tracks[:, 0]), 0.1, atol=1e-12)


def test_key_frames_are_few_and_keep_the_ends():
    """At most 60 key frames a second and 18,000 in all; slow recordings keep every sample; first and last stay."""
    for rate, seconds, most in ((1000.0, 10.0, 602), (100.0, 10.0, 602), (30.0, 10.0, 301), (100.0, 900.0, 18_001)):
        time = np.arange(int(rate * seconds) + 1) / rate
        keys = key_frames(time)
        assert keys[0] == 0 and keys[-1] == time.size - 1
        assert np.all(np.diff(keys) > 0)
        assert keys.size <= min(most, MAX_KEY_FRAMES + 1)
    assert key_frames(np.arange(301) / 30.0).size == 301
    assert key_frames(np.arange(601) / 60.0).size == 601
    assert key_frames(np.zeros(1)).tolist() == [0]
    assert key_frames(np.array([0.0, 1e9])).tolist() == [0, 1]


def test_thinned_curves_keep_every_dip(robot_of):
    """A dip of one sample among 50,000 is in the curve, and the page's path and curve stay short."""
    robot = robot_of("planar3")
    rollout = waving(robot, 500.0)
    mu = np.ones(len(rollout))
    mu[33_333] = 1e-4
    long = Rollout(rollout.time, rollout.q, rollout.u, mu, ("ok",) * mu.size, robot.joint_names, mu)
    tree = kinematic_tree(robot)
    motion = recorded_motion(robot, tree, robot.frame("tip"), "long", long)
    assert motion.curve.size <= MAX_CURVE_POINTS + 2
    assert motion.curve.min() == 1e-4
    assert motion.curve_times[np.argmin(motion.curve)] == rollout.time[33_333]
    assert motion.path.shape[0] <= MAX_PATH_POINTS
    assert motion.status == ((0.0, "ok"),)
    assert motion.duration == pytest.approx(500.0)


def test_path_is_the_tips(robot_of):
    """The path goes through the tip at its times."""
    robot = robot_of("sawyer")
    tip = robot.frame("right_hand")
    rollout = waving(robot)
    motion = recorded_motion(robot, kinematic_tree(robot), tip, "a", rollout)
    for t, point in list(zip(motion.path_times, motion.path, strict=True))[::20]:
        q = rollout.q[np.argmin(np.abs(rollout.time - t))]
        np.testing.assert_allclose(point, robot.pose(q, tip)[:3, 3], atol=1e-12)


def test_status_changes_are_kept(robot_of):
    """The strip says when each status begins."""
    robot = robot_of("one")
    time = np.arange(6.0)
    words = ("ok", "ok", "damped", "ok", "ok", "singular")
    rollout = Rollout(time, np.zeros((6, 1)), np.zeros((6, 1)), time, words, robot.joint_names, time)
    motion = recorded_motion(robot, kinematic_tree(robot), robot.frame("tip"), "a", rollout)
    assert motion.status == ((0.0, "ok"), (2.0, "damped"), (3.0, "ok"), (5.0, "singular"))


@pytest.mark.parametrize(("robot_name", "view"), [("planar3", "top"), ("sawyer", "iso"), ("gantry", "iso")])
def test_planar_arms_are_seen_from_above(robot_of, robot_name, view):
    """A robot that moves in the plane of the floor is looked at from above."""
    robot = robot_of(robot_name)
    tree = kinematic_tree(robot)
    motion = recorded_motion(
        robot, tree, robot.frame("tip" if robot_name != "sawyer" else "right_hand"), "a", waving(robot)
    )
    data = scene_data(robot, tree, Appearance(()), "", [motion], [("blue", "#000000")], [])
    assert data["view"] == view
    low, high = np.array(data["bounds"])
    assert np.all(motion.path >= low - 1e-9) and np.all(motion.path <= high + 1e-9)
