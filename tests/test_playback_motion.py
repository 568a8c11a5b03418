"""Key frames, joint tracks, curves and phases of a replay."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from test_playback import data_in, unpacked, waving

import manip_learn as ml
from manip_learn.errors import RecordingError
from manip_learn.playback.appearance import Appearance, joint_tracks, kinematic_tree
from manip_learn.playback.palette import PhaseBand, phase_bands, phases_from_json
from manip_learn.playback.recorded_motion import (
    MAX_CURVE_POINTS,
    MAX_KEY_FRAMES,
    MAX_PATH_POINTS,
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
    assert curve.size <= MAX_CURVE_POINTS + 2 and path.size <= 3 * MAX_PATH_POINTS
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


# ---- phases ----------------------------------------------------------------------------------------------------------

FREE, FIRST, SECOND = ("a", 0.0, 1.0, None), ("a", 1.0, 2.0, 0), ("b", 0.5, 1.5, 1)


BAD_PHASES = [
    *(("a", 0.0, 1.0), ("a", 2.0, 1.0, 0), ("a", 0.0, float("nan"), 0), ("a", 0.0, "late", 0), ("a", 0.0, 1.0, -1)),
    *(("a", 0.0, 1.0, True), ("a", 0.0, 1.0, 1000), ("a", 0.0, 1.0, 0.5), (3, 0.0, 1.0, 0), "text"),
]


def test_bands_belong_to_their_recording():
    """In order of time; those of recordings that are not shown are left out; none at all is a mistake in the names."""
    bands = phase_bands([FIRST, SECOND, FREE, ("a", 2.0, 2.0, 999)], ["a", "c"])
    assert bands == {"a": (PhaseBand(0.0, 1.0, None), PhaseBand(1.0, 2.0, 0), PhaseBand(2.0, 2.0, 999)), "c": ()}
    with pytest.raises(RecordingError, match=r"'a', 'b'.*shown are 'demo_01'"):
        phase_bands([FIRST, SECOND], ["demo_01"])


def test_phases_survive_json_and_bad_ones_are_refused():
    """They come back as they were, from lists or objects; one that cannot be drawn is refused with its number."""
    phases = (FREE, FIRST, SECOND, (*FIRST, "too short"))
    assert phases_from_json(json.loads(json.dumps(phases))) == phases
    keys = ("trajectory", "start", "end", "constraint", "reason")
    assert phases_from_json([dict(zip(keys, phase, strict=False)) for phase in phases]) == phases
    with pytest.raises(RecordingError, match="list"):
        phases_from_json("phases")
    for phase in BAD_PHASES:
        for refused in (lambda p: phase_bands([FREE, p], ["a"]), lambda p: phases_from_json([list(FREE), p])):
            with pytest.raises(RecordingError, match="phase 1"):
                refused(phase)
                pytest.fail(f"{phase} was taken")


def test_times_are_moved_to_the_first_sample(robot_of, tmp_path):
    """Phases are given on the recording's own clock, drawn from its first sample on, and cut where it ends."""
    robot, rollout = robot_of("planar3"), waving(robot_of("planar3"))
    phases = [("a", 99.0, 100.5, None), ("a", 100.5, 107.0, 0), ("a", 110.0, 111.0, 1)]
    recorded = ml.Trajectory(rollout.time + 100.0, rollout.q, None, rollout.joint_names, "a")
    data = data_in(ml.replay(robot, {"a": recorded}, tmp_path / "a.html", phases=phases).html)
    np.testing.assert_allclose(data["rollouts"][0]["phases"], [[0.0, 0.5, -1], [0.5, 2.0, 0]])
    data = data_in(ml.replay(robot, {"a": recorded, "b": recorded}, tmp_path / "a.html").html)
    assert data["phaseKinds"] == data["mechanisms"] == [] and len({r["colour"] for r in data["rollouts"]}) == 2


OWN = (("approach", 0.0, 0.8), ("hold", 0.8, 1.0), ("way", 1.0, 2.0))


def test_a_rollouts_own_phases_are_bands_in_its_own_colour(robot_of, tmp_path):
    """They are in the page with their words, from its files too, and the page is not one of constraints: all keep their
    colours; those of constraints replace them where they are given.
    """
    robot = robot_of("planar3")
    rollout, page = replace(waving(robot), phases=OWN), tmp_path / "a.html"
    data = data_in(ml.replay(robot, {"plan": rollout, "zero": waving(robot, phase=1.0)}, page).html)
    plan, zero = data["rollouts"]
    assert plan["phases"] == [[0.0, 0.8, 0], [0.8, 1.0, 1], [1.0, 2.0, 2]]
    assert [k["label"] for k in plan["phaseKinds"]] == [k["mark"] for k in plan["phaseKinds"]] == [p[0] for p in OWN]
    assert {k["colour"] for k in plan["phaseKinds"]} == {plan["colour"]} != {zero["colour"]}
    approach, hold, way = (k["strength"] for k in plan["phaseKinds"])
    assert approach < hold < way == 1.0
    assert zero["phases"] == data["phaseKinds"] == [] and "phaseKinds" not in zero
    drawn = data_in(ml.replay(robot, {"plan": rollout}, page).html)["rollouts"]
    for ending in (".npz", ".csv"):
        again, _ = ml.Rollout.load_with_notes(rollout.save(tmp_path / f"a{ending}"), robot)
        assert data_in(ml.replay(robot, {"plan": again}, page).html)["rollouts"] == drawn, ending
    data = data_in(ml.replay(robot, {"a": rollout, "b": rollout}, page, phases=[FREE, FIRST]).html)
    a, b = data["rollouts"]
    assert a["phases"] == [[0.0, 1.0, -1], [1.0, 2.0, 0]] and "phaseKinds" not in a
    assert len(b["phases"]) == len(b["phaseKinds"]) == 3 and len(data["phaseKinds"]) == 2
