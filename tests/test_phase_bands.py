"""Phases and mechanisms on their way into the replay page: what is kept, what is refused, what the page reads."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from test_playback import data_in, waving

import manip_learn as ml
from manip_learn.errors import RecordingError
from manip_learn.playback.palette import PhaseBand, phase_bands, phases_from_json

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
