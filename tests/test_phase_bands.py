"""Phases and mechanisms on their way into the replay page: what is kept, what is refused, what the page reads."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from test_playback import data_in, unpacked, waving

from manip_learn.control.rollout import Rollout
from manip_learn.errors import RecordingError
from manip_learn.playback import replay
from manip_learn.playback.phase_bands import PhaseBand, own_bands, own_kinds, phase_bands, phase_kinds, phases_from_json
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.tips import default_tip

FREE, FIRST, SECOND = ("a", 0.0, 1.0, None), ("a", 1.0, 2.0, 0), ("b", 0.5, 1.5, 1)


def recorded(robot, start=0.0, duration=2.0):
    """A recording whose clock does not begin at zero."""
    rollout = waving(robot, duration)
    return Trajectory(rollout.time + start, rollout.q, None, rollout.joint_names, "a")


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


def test_colours_tell_constraints_apart():
    """Seven constraints and free motion have different colours, and every number on a band is readable (4.5 to 1)."""
    kinds = phase_kinds([("a", 0.0, 1.0, 6)], ["hinge", "", "plane"])
    labels = [k.label for k in kinds[:3]]
    assert labels == ["constraint 1: hinge", "constraint 2", "constraint 3: plane"]
    assert kinds[-1].label == "free motion"
    assert phase_kinds([FREE, (*FIRST, "too short")])[-1].label == "free motion, or not learnt"
    assert all(a.colour != b.colour for a, b in combinations(kinds, 2))
    for kind in kinds:
        lighter, darker = sorted((luminance(kind.colour), luminance(kind.ink)), reverse=True)
        assert (lighter + 0.05) / (darker + 0.05) >= 4.5, kind


def luminance(colour):
    """Relative luminance, WCAG 2.2."""
    c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]


def test_times_are_moved_to_the_first_sample(robot_of, tmp_path):
    """Phases are given on the recording's own clock, drawn from its first sample on, and cut where it ends."""
    robot = robot_of("planar3")
    phases = [("a", 99.0, 100.5, None), ("a", 100.5, 107.0, 0), ("a", 110.0, 111.0, 1)]
    data = data_in(replay(robot, {"a": recorded(robot, start=100.0)}, tmp_path / "a.html", phases=phases).html)
    (shown,) = data["rollouts"]
    np.testing.assert_allclose(shown["phases"], [[0.0, 0.5, -1], [0.5, 2.0, 0]])
    data = data_in(replay(robot, {"a": recorded(robot), "b": recorded(robot)}, tmp_path / "a.html").html)
    assert data["phaseKinds"] == data["mechanisms"] == [] and len({r["colour"] for r in data["rollouts"]}) == 2


OWN = (("approach", 0.0, 0.8), ("hold", 0.8, 1.0), ("way", 1.0, 2.0))


def test_a_rollouts_own_phases_are_bands_in_its_own_colour(robot_of, tmp_path):
    """They are in the page with their words, and the page is not one of constraints: all keep their colours."""
    robot = robot_of("planar3")
    rollouts = {"plan": replace(waving(robot), phases=OWN), "zero": waving(robot, phase=1.0)}
    data = data_in(replay(robot, rollouts, tmp_path / "a.html").html)
    plan, zero = data["rollouts"]
    assert plan["phases"] == [[0.0, 0.8, 0], [0.8, 1.0, 1], [1.0, 2.0, 2]]
    assert [k["label"] for k in plan["phaseKinds"]] == [k["mark"] for k in plan["phaseKinds"]] == [p[0] for p in OWN]
    assert {k["colour"] for k in plan["phaseKinds"]} == {plan["colour"]} != {zero["colour"]}
    approach, hold, way = (k["strength"] for k in plan["phaseKinds"])
    assert approach < hold < way == 1.0
    assert zero["phases"] == data["phaseKinds"] == [] and "phaseKinds" not in zero


def test_phases_of_files_and_of_constraints(robot_of, tmp_path):
    """Phases saved with a rollout are drawn as its own; those of constraints replace them where they are given."""
    robot = robot_of("planar3")
    rollout = replace(waving(robot), phases=OWN)
    drawn = data_in(replay(robot, {"plan": rollout}, tmp_path / "a.html").html)["rollouts"]
    for ending in (".npz", ".csv"):
        again, _ = Rollout.load_with_notes(rollout.save(tmp_path / f"a{ending}"), robot)
        assert data_in(replay(robot, {"plan": again}, tmp_path / "a.html").html)["rollouts"] == drawn, ending
    data = data_in(replay(robot, {"a": rollout, "b": rollout}, tmp_path / "a.html", phases=[FREE, FIRST]).html)
    a, b = data["rollouts"]
    assert a["phases"] == [[0.0, 1.0, -1], [1.0, 2.0, 0]] and "phaseKinds" not in a
    assert len(b["phases"]) == len(b["phaseKinds"]) == 3 and len(data["phaseKinds"]) == 2


def test_own_phases_share_a_kind_by_their_name(robot_of, tmp_path):
    """Names that come twice are one kind, in order of time; long ones are cut; times that cannot be are refused."""
    bands = own_bands("a", [("way", 3.0, 4.0), ("approach", 0.0, 1.0), ("way", 1.0, 2.0), ("x" * 90, 2.0, 3.0)])
    assert [b.start for b in bands] == [0.0, 1.0, 2.0, 3.0]
    assert [k.label for k in own_kinds(bands, "#0072b2")] == ["approach", "way", "x" * 40]
    assert own_kinds([PhaseBand(0.0, 1.0, None), PhaseBand(1.0, 2.0, 0)], "#0072b2") == ()
    for span in ((1.0, 0.0), (0.0, float("nan")), ("early", 1.0)):
        rollout = replace(waving(robot_of("planar3")), phases=(OWN[0], ("hold", *span)))
        with pytest.raises(RecordingError, match="phase 1"):
            replay(robot_of("planar3"), {"plan": rollout}, tmp_path / "b.html")


AXIS, POINT = np.array([0.6, 0.0, 0.8]), np.array([0.4, -0.2, 0.3])


def test_mechanisms_are_drawn_where_they_are(robot_of, tmp_path):
    """Axis, circle, helix, sphere and patch of a mechanism, from the page; what has no place is told in words only."""
    robot = robot_of("sawyer")

    def drawn(**mechanism):
        described = {"axis": AXIS.tolist(), "point": POINT.tolist(), "sentence": "words", **mechanism}
        page = replay(
            robot, {"a": recorded(robot)}, tmp_path / "a.html", phases=[("a", 0.5, 1.5, 0)], mechanism=described
        )
        (one,) = data_in(page.html)["mechanisms"]
        assert one["sentence"] == "words"
        return [[unpacked(x, "<f4").reshape(-1, 3).astype(float) for x in one[kind]] for kind in ("lines", "patches")]

    def off_axis(points):
        return np.linalg.norm((points - POINT) - np.outer((points - POINT) @ AXIS, AXIS), axis=1)

    (line,), patches = drawn(type="line")
    np.testing.assert_allclose(off_axis(line), 0.0, atol=1e-6)
    assert not patches
    path = np.array([robot.position(q, robot.frame(default_tip(robot))) for q in recorded(robot).q[50:151]])
    reach = (line - POINT) @ AXIS, (path - POINT) @ AXIS
    margin = max(0.25 * np.ptp(reach[1]), 0.06)  # beyond the motion that it held
    np.testing.assert_allclose(sorted(reach[0]), [reach[1].min() - margin, reach[1].max() + margin], atol=5e-3)
    (axis, circle), _ = drawn(type="hinge", radius=0.3)
    np.testing.assert_allclose(off_axis(axis), 0.0, atol=1e-6)
    np.testing.assert_allclose(off_axis(circle), 0.3, atol=1e-6)
    np.testing.assert_allclose((circle - POINT) @ AXIS, 0.5 * (reach[1].min() + reach[1].max()), atol=5e-3)
    np.testing.assert_allclose((circle - circle[0]) @ AXIS, 0.0, atol=1e-6)
    assert len(drawn(type="other", radius=0.3)[0]) == 3  # both rims of a cylinder
    (patch,) = drawn(type="plane")[1]
    np.testing.assert_allclose((patch - POINT) @ AXIS, 0.0, atol=1e-6)
    for pitch in (0.02, -0.05):  # right-handed if positive
        (_, helix), _ = drawn(type="screw", radius=0.1, pitch=pitch)
        np.testing.assert_allclose(off_axis(helix), 0.1, atol=1e-6)
        arm = helix - POINT
        flat = arm - np.outer(arm @ AXIS, AXIS)
        turn = np.arctan2(np.cross(flat[:-1], flat[1:]) @ AXIS, np.sum(flat[:-1] * flat[1:], axis=1))
        np.testing.assert_allclose(np.diff(arm @ AXIS), pitch * turn, rtol=1e-3, atol=1e-6)
    circles, _ = drawn(type="ball", radius=0.25, axis=None)
    assert len(circles) == 3
    np.testing.assert_allclose(np.linalg.norm(np.concatenate(circles) - POINT, axis=1), 0.25, atol=1e-6)
    for lack in ({"point": None}, {"axis": None}, {"axis": [0, 0, 0]}):
        assert drawn(type="held-orientation", **lack) == [[], []]
    for wrong in ({"axis": [0, 0]}, {"point": [0, 0, float("nan")]}, {"radius": "wide"}, {"pitch": 1e9}):
        with pytest.raises(RecordingError, match=f"the mechanism's {next(iter(wrong))} must be"):
            drawn(**{"type": "hinge", "radius": 0.3, **wrong})
