"""Key frames, joint tracks, curves and phases of a replay."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from case import case
from test_playback import data_in, unpacked, waving

import manip_learn as ml
from manip_learn.errors import RecordingError
from manip_learn.playback.palette import PhaseBand, phase_bands, phases_from_json
from manip_learn.playback.recorded_motion import (
    MAX_KEY_FRAMES,
    MAX_PATH_POINTS,
    MOST_OF_A_CURVE,
    guided_motion,
    key_frames,
    recorded_motion,
)


def test_key_frames_are_few_and_keep_the_ends():
    """At most 60 key frames a second and 18,000 in all; slow recordings keep every sample; first and last stay."""
    for rate, seconds, least, most in (
        *((1000.0, 10.0, 2, 602), (30.0, 10.0, 301, 301), (60.0, 10.0, 601, 601)),
        *((100.0, 900.0, 2, MAX_KEY_FRAMES + 1), (1.0, 0.0, 1, 1)),
    ):
        time = np.arange(int(rate * seconds) + 1) / rate
        keys = key_frames(time)
        assert keys[0] == 0 and keys[-1] == time.size - 1
        assert np.all(np.diff(keys) > 0) and least <= keys.size <= most
    assert key_frames(np.array([0.0, 1e9])).tolist() == [0, 1]


def test_thinned_curves_keep_every_dip(robot_of, tmp_path):
    """A dip of one sample among 50,000 is in the curve, and the page's path and curve stay short; the path goes through
    the tip at its times; each status has its start.
    """
    robot, rollout = robot_of("planar3"), waving(robot_of("planar3"), 500.0)
    mu = np.ones(len(rollout))
    mu[33_333] = 1e-4
    words = np.where(rollout.time < 2.0, "ok", np.where(rollout.time < 3.0, "damped", "singular"))
    long = replace(rollout, manipulability=mu, status=tuple(words))
    (drawn,) = data_in(ml.replay(robot, {"a": long}, tmp_path / "a.html").html)["rollouts"]
    curve, path = unpacked(drawn["curve"]), unpacked(drawn["path"], "<f4")
    assert curve.size <= MOST_OF_A_CURVE + 2 and path.size <= 3 * MAX_PATH_POINTS
    assert curve.min() == 1e-4 and unpacked(drawn["curveTimes"])[np.argmin(curve)] == rollout.time[33_333]
    assert [(t, word) for t, word, _ in drawn["status"]] == [(0.0, "ok"), (2.0, "damped"), (3.0, "singular")]
    tip = robot.frame("tip")
    motion = recorded_motion(robot, tip, guided_motion(robot, "a", rollout))
    at = np.searchsorted(rollout.time, motion.path_times - 1e-9)
    np.testing.assert_allclose(motion.path, [robot.position(rollout.q[i], tip) for i in at], atol=1e-12)


# ---- phases ----------------------------------------------------------------------------------------------------------

FREE, FIRST, SECOND = ("a", 0.0, 1.0, None), ("a", 1.0, 2.0, 0), ("b", 0.5, 1.5, 1)


BAD_PHASES = [
    *(("a", 0.0, 1.0), ("a", 2.0, 1.0, 0), ("a", 0.0, float("nan"), 0), ("a", 0.0, "late", 0), ("a", 0.0, 1.0, -1)),
    *(("a", 0.0, 1.0, True), ("a", 0.0, 1.0, 1000), ("a", 0.0, 1.0, 0.5), (3, 0.0, 1.0, 0), "text"),
]


def test_phases_survive_json_and_bad_ones_are_refused():
    """Phases are read from lists or objects and sorted by recording and time. One that cannot be drawn is refused with
    its number, and so are names that match no recording.
    """
    phases = (FIRST, SECOND, FREE, ("a", 2.0, 2.0, 999, "too short"))
    keys = ("trajectory", "start", "end", "constraint", "reason")
    assert phases_from_json(json.loads(json.dumps(phases))) == phases
    assert phases_from_json([dict(zip(keys, phase, strict=False)) for phase in phases]) == phases
    bands = phase_bands(phases, ["a", "c"])
    assert bands == {"a": (PhaseBand(0.0, 1.0, None), PhaseBand(1.0, 2.0, 0), PhaseBand(2.0, 2.0, 999)), "c": ()}
    with pytest.raises(RecordingError, match=r"'a', 'b'.*shown are 'demo_01'"):
        phase_bands([FIRST, SECOND], ["demo_01"])
    with pytest.raises(RecordingError, match="list"):
        phases_from_json("phases")
    for phase in BAD_PHASES:
        with case(phase), pytest.raises(RecordingError, match="phase 1"):
            phase_bands([FREE, phase], ["a"])
        with case(phase), pytest.raises(RecordingError, match="phase 1"):
            phases_from_json([list(FREE), phase])


def test_a_rollouts_own_phases_are_bands_in_its_own_colour(robot_of, tmp_path):
    """The phases of a rollout are in the page with their words, also when it is loaded from a file. Phases of
    constraints replace them.
    """
    robot, page = robot_of("planar3"), tmp_path / "a.html"
    rollout = replace(waving(robot), phases=(("approach", 0.0, 0.8), ("hold", 0.8, 1.0), ("way", 1.0, 2.0)))
    data = data_in(ml.replay(robot, {"plan": rollout, "zero": waving(robot, phase=1.0)}, page).html)
    plan, zero = data["rollouts"]
    assert plan["phases"] == [[0.0, 0.8, 0], [0.8, 1.0, 1], [1.0, 2.0, 2]]
    assert [kind["label"] for kind in plan["phaseKinds"]] == ["approach", "hold", "way"]
    assert {kind["colour"] for kind in plan["phaseKinds"]} == {plan["colour"]} != {zero["colour"]}
    assert zero["phases"] == data["phaseKinds"] == [] and "phaseKinds" not in zero
    for ending in (".npz", ".csv"):
        again, _ = ml.Rollout.load_with_notes(rollout.save(tmp_path / f"a{ending}"), robot)
        assert data_in(ml.replay(robot, {"plan": again, "zero": again}, page).html)["rollouts"][0] == plan, ending
    a, b = data_in(ml.replay(robot, {"a": rollout, "b": rollout}, page, phases=[FREE, FIRST]).html)["rollouts"]
    assert a["phases"] == [[0.0, 1.0, -1], [1.0, 2.0, 0]] and "phaseKinds" not in a and len(b["phases"]) == 3
