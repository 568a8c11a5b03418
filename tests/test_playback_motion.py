"""Key frames, joint tracks and curves of a replay."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from test_playback import data_in, unpacked, waving

import manip_learn as ml
from manip_learn.playback.appearance import Appearance, joint_tracks, kinematic_tree
from manip_learn.playback.recorded_motion import (
    MAX_KEY_FRAMES,
    MAX_PATH_POINTS,
    MOST_OF_A_CURVE,
    guided_motion,
    key_frames,
    recorded_motion,
)
from manip_learn.playback.scene_data import scene_data

ROBOTS = ("planar3", "sawyer", "panda", "kinova", "gantry", "wrist", "humanoid", "rover", "tree", "mimic")


def posed(tree, values):
    """Poses of all joints from the numbers of one key frame, as the page's program computes them."""
    poses, k = [np.eye(4)], 0
    for joint in tree[1:]:
        motion, x = np.eye(4), values[k : k + (7 if joint.motion == "free" else 1)]
        if joint.motion == "revolute":
            motion[:3, :3] = pin.AngleAxis(x[0], joint.axis).matrix()
        elif joint.motion == "prismatic":
            motion[:3, 3] = x[0] * joint.axis
        else:
            motion = pin.XYZQUATToSE3(x).homogeneous
        poses.append(poses[joint.parent] @ joint.placement @ motion)
        k += len(x)
    assert k == len(values)
    return poses


def test_tracks_are_forward_kinematics(robot_of, rng):
    """The numbers of a key frame give every joint's pose back, whatever kinds of joints and mimics there are."""
    for name in ROBOTS:
        robot = robot_of(name)
        tree, model = kinematic_tree(robot), robot.pinocchio_model
        data = model.createData()
        postures = np.array([robot.random_configuration(rng) for _ in range(20)])
        for q, values in zip(postures, joint_tracks(robot, postures), strict=True):
            pin.forwardKinematics(model, data, robot.pinocchio_configuration(q))
            for pose, placed in zip(posed(tree, values), data.oMi, strict=True):
                np.testing.assert_allclose(pose, placed.homogeneous, atol=1e-12, err_msg=name)


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


def test_thinned_curves_keep_every_dip(robot_of, tmp_path):
    """A dip of one sample among 50,000 is in the curve, and the page's path and curve stay short; the path goes through
    the tip at its times; the strip says when each status begins.
    """
    robot, rollout = robot_of("planar3"), waving(robot_of("planar3"), 500.0)
    mu = np.ones(len(rollout))
    mu[33_333] = 1e-4
    words = np.where(rollout.time < 2.0, "ok", np.where(rollout.time < 3.0, "damped", "singular"))
    long = ml.Rollout(rollout.time, rollout.q, rollout.u, mu, tuple(words), robot.joint_names, mu)
    (drawn,) = data_in(ml.replay(robot, {"a": long}, tmp_path / "a.html").html)["rollouts"]
    curve, path = unpacked(drawn["curve"]), unpacked(drawn["path"], "<f4")
    assert curve.size <= MOST_OF_A_CURVE + 2 and path.size <= 3 * MAX_PATH_POINTS
    assert curve.min() == 1e-4 and unpacked(drawn["curveTimes"])[np.argmin(curve)] == rollout.time[33_333]
    assert [(t, word) for t, word, _ in drawn["status"]] == [(0.0, "ok"), (2.0, "damped"), (3.0, "singular")]
    assert drawn["duration"] == pytest.approx(500.0)
    robot = robot_of("sawyer")
    tip, rollout = robot.frame("right_hand"), waving(robot)
    motion = recorded_motion(robot, tip, guided_motion(robot, "a", rollout))
    at = np.searchsorted(rollout.time, motion.path_times - 1e-9)
    np.testing.assert_allclose(motion.path, [robot.position(rollout.q[i], tip) for i in at], atol=1e-12)


def test_planar_arms_are_seen_from_above(robot_of):
    """A robot that moves in the plane of the floor is looked at from above; all that is drawn is in the picture."""
    for name, view in (("planar3", "top"), ("sawyer", "iso"), ("gantry", "iso")):
        robot = robot_of(name)
        tip = robot.frame("right_hand" if name == "sawyer" else "tip")
        motion = recorded_motion(robot, tip, guided_motion(robot, "a", waving(robot)))
        data = scene_data(robot, Appearance(()), "", [motion], [])
        low, high = np.array(data["bounds"])
        assert data["view"] == view and data["floor"] == min(low[2], 0.0)
        assert np.all(motion.path >= low - 1e-9) and np.all(motion.path <= high + 1e-9)
        # the camera is beside the middle of the path, 62 degrees on
        x, y, _ = motion.path.mean(axis=0)
        assert data["azimuth"] == pytest.approx(np.arctan2(y, x) - np.radians(62.0))
        outline = np.array(data["outline"])
        np.testing.assert_allclose(
            [outline.min(axis=0), outline.max(axis=0)], [low, high], atol=0.02 * np.ptp([low, high])
        )
