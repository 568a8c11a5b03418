"""Phases and mechanisms on their way into the replay page: what is kept, what is refused, what the page reads."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from test_playback import EVIL, data_in, unpacked, waving

from manip_learn.control.rollout import Rollout
from manip_learn.errors import RecordingError
from manip_learn.playback import replay
from manip_learn.playback.phase_bands import PhaseBand, own_bands, own_kinds, phase_bands, phase_kinds, phases_from_json
from manip_learn.recordings.trajectory import Trajectory

FREE, FIRST, SECOND = ("a", 0.0, 1.0, None), ("a", 1.0, 2.0, 0), ("b", 0.5, 1.5, 1)


def recorded(robot, start=0.0, duration=2.0):
    """A recording whose clock does not begin at zero."""
    rollout = waving(robot, duration)
    return Trajectory(rollout.time + start, rollout.q, None, rollout.joint_names, "a")


def test_bands_belong_to_their_recording():
    """Each recording has its own phases in order of time; those of recordings that are not shown are left out."""
    bands = phase_bands([FIRST, SECOND, FREE], ["a", "c"])
    assert bands == {"a": (PhaseBand(0.0, 1.0, None), PhaseBand(1.0, 2.0, 0)), "c": ()}


def test_phases_of_other_recordings_are_refused():
    """Phases none of which is of a shown recording are a mistake in the names, and both sides are named."""
    with pytest.raises(RecordingError, match=r"'a', 'b'.*shown are 'demo_01'"):
        phase_bands([FIRST, SECOND], ["demo_01"])


@pytest.mark.parametrize(
    "phase",
    [
        ("a", 0.0, 1.0),
        ("a", 2.0, 1.0, 0),
        ("a", 0.0, float("nan"), 0),
        ("a", 0.0, "late", 0),
        ("a", 0.0, 1.0, -1),
        ("a", 0.0, 1.0, True),
        ("a", 0.0, 1.0, 10**9),
        ("a", 0.0, 1.0, 0.5),
        (3, 0.0, 1.0, 0),
        "text",
    ],
)
def test_bad_phases_are_refused(phase):
    """A phase that cannot be drawn is refused with its number, from Python and from a file alike."""
    with pytest.raises(RecordingError, match="phase 1"):
        phase_bands([FREE, phase], ["a"])
    with pytest.raises(RecordingError, match="phase 1"):
        phases_from_json([list(FREE), phase])


def test_phases_survive_json():
    """Phases come back from JSON as they were, written as lists or as objects."""
    phases = (FREE, FIRST, SECOND)
    assert phases_from_json(json.loads(json.dumps(phases))) == phases
    keys = ("trajectory", "start", "end", "constraint")
    assert phases_from_json([dict(zip(keys, phase, strict=True)) for phase in phases]) == phases
    with pytest.raises(RecordingError, match="list"):
        phases_from_json("phases")


def test_colours_tell_constraints_apart():
    """Seven constraints and free motion have different colours, and every number on a band is readable (4.5 to 1)."""
    kinds = phase_kinds([("a", 0.0, 1.0, 6)], ["hinge", "", "plane"])
    labels = [k.label for k in kinds[:3]]
    assert labels == ["constraint 1: hinge", "constraint 2", "constraint 3: plane"]
    assert kinds[-1].label == "free motion"
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
    assert shown["firstTime"] == 100.0
    np.testing.assert_allclose(shown["phases"], [[0.0, 0.5, -1], [0.5, 2.0, 0]])


def test_without_phases_nothing_changes(robot_of, tmp_path):
    """A page without phases has no bands, and its recordings keep their own colours."""
    robot = robot_of("planar3")
    data = data_in(replay(robot, {"a": recorded(robot), "b": recorded(robot)}, tmp_path / "a.html").html)
    assert data["phaseKinds"] == data["mechanisms"] == []
    assert len({r["colour"] for r in data["rollouts"]}) == 2


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


@pytest.mark.parametrize("ending", [".npz", ".csv"])
def test_a_rollout_of_a_file_draws_the_same(robot_of, tmp_path, ending):
    """Phases that were saved with a rollout are drawn as those of the rollout itself."""
    robot = robot_of("planar3")
    rollout = replace(waving(robot), phases=OWN)
    again, _ = Rollout.load_with_notes(rollout.save(tmp_path / f"a{ending}"), robot)
    pages = [data_in(replay(robot, {"plan": r}, tmp_path / "a.html").html)["rollouts"] for r in (rollout, again)]
    assert pages[0] == pages[1] and len(pages[0][0]["phases"]) == 3


def test_phases_that_are_given_replace_a_rollouts_own(robot_of, tmp_path):
    """Phases of constraints are drawn where they are given; other rollouts of the page keep their own."""
    robot = robot_of("planar3")
    rollouts = {name: replace(waving(robot), phases=OWN) for name in ("a", "b")}
    data = data_in(replay(robot, rollouts, tmp_path / "a.html", phases=[FREE, FIRST]).html)
    a, b = data["rollouts"]
    assert a["phases"] == [[0.0, 1.0, -1], [1.0, 2.0, 0]] and "phaseKinds" not in a
    assert len(b["phases"]) == len(b["phaseKinds"]) == 3 and len(data["phaseKinds"]) == 2


def test_own_phases_share_a_kind_by_their_name():
    """Names that come twice are one kind, in the order of time; long ones are cut; constraints are none of them."""
    bands = own_bands("a", [("way", 3.0, 4.0), ("approach", 0.0, 1.0), ("way", 1.0, 2.0), ("x" * 90, 2.0, 3.0)])
    assert [b.start for b in bands] == [0.0, 1.0, 2.0, 3.0]
    assert [k.label for k in own_kinds(bands, "#0072b2")] == ["approach", "way", "x" * 40]
    assert own_kinds([PhaseBand(0.0, 1.0, None), PhaseBand(1.0, 2.0, 0)], "#0072b2") == ()


@pytest.mark.parametrize("span", [(1.0, 0.0), (0.0, float("nan")), ("early", 1.0)])
def test_bad_phases_of_a_rollout_are_refused(robot_of, tmp_path, span):
    """Times that cannot be drawn are refused with the rollout's name or the phase's number."""
    robot = robot_of("planar3")
    rollout = replace(waving(robot), phases=(OWN[0], ("hold", *span)))
    with pytest.raises(RecordingError, match="phase 1"):
        replay(robot, {"plan": rollout}, tmp_path / "a.html")


class TestMechanism:
    """What is drawn of a mechanism is where the mechanism is."""

    AXIS, POINT = np.array([0.6, 0.0, 0.8]), np.array([0.4, -0.2, 0.3])

    def lines(self, robot, tmp_path, **mechanism):
        phases = [("a", 0.5, 1.5, 0)]
        described = {"axis": self.AXIS.tolist(), "point": self.POINT.tolist(), "sentence": "words", **mechanism}
        recording = {"a": recorded(robot)}
        data = data_in(replay(robot, recording, tmp_path / "a.html", phases=phases, mechanism=described).html)
        (drawn,) = data["mechanisms"]
        assert drawn["sentence"] == "words"
        shapes = (drawn["lines"], drawn["patches"])
        return [[unpacked(x, "<f4").reshape(-1, 3).astype(float) for x in shape] for shape in shapes]

    def distances(self, points):
        """From the axis [m]."""
        arm = points - self.POINT
        return np.linalg.norm(arm - np.outer(arm @ self.AXIS, self.AXIS), axis=1)

    def test_line(self, robot_of, tmp_path):
        """A line lies on the line, and reaches beyond the motion that it held."""
        (line,), patches = self.lines(robot_of("sawyer"), tmp_path, type="line")
        np.testing.assert_allclose(self.distances(line), 0.0, atol=1e-6)
        assert not patches

    def test_hinge(self, robot_of, tmp_path):
        """A hinge has its axis and a circle of its radius across it."""
        (axis, circle), _ = self.lines(robot_of("sawyer"), tmp_path, type="hinge", radius=0.3)
        np.testing.assert_allclose(self.distances(axis), 0.0, atol=1e-6)
        np.testing.assert_allclose(self.distances(circle), 0.3, atol=1e-6)
        np.testing.assert_allclose((circle - circle[0]) @ self.AXIS, 0.0, atol=1e-6)

    def test_plane(self, robot_of, tmp_path):
        """The patch of a plane lies in the plane."""
        _, (patch,) = self.lines(robot_of("sawyer"), tmp_path, type="plane")
        np.testing.assert_allclose((patch - self.POINT) @ self.AXIS, 0.0, atol=1e-6)

    @pytest.mark.parametrize("pitch", [0.02, -0.05])
    def test_screw(self, robot_of, tmp_path, pitch):
        """A screw's helix keeps its radius and rises by the pitch with each radian, right-handed if positive."""
        (_, helix), _ = self.lines(robot_of("sawyer"), tmp_path, type="screw", radius=0.1, pitch=pitch)
        np.testing.assert_allclose(self.distances(helix), 0.1, atol=1e-6)
        arm = helix - self.POINT
        flat = arm - np.outer(arm @ self.AXIS, self.AXIS)
        turn = np.arctan2(np.cross(flat[:-1], flat[1:]) @ self.AXIS, np.sum(flat[:-1] * flat[1:], axis=1))
        np.testing.assert_allclose(np.diff(arm @ self.AXIS), pitch * turn, rtol=1e-3, atol=1e-6)

    def test_ball(self, robot_of, tmp_path):
        """Every line of a ball is on its sphere."""
        circles, _ = self.lines(robot_of("sawyer"), tmp_path, type="ball", radius=0.25, axis=None)
        assert len(circles) == 3
        for circle in circles:
            np.testing.assert_allclose(np.linalg.norm(circle - self.POINT, axis=1), 0.25, atol=1e-6)

    def test_nothing_to_draw(self, robot_of, tmp_path):
        """A held orientation, or a mechanism whose place is not known, is told in words only."""
        for lack in ({"point": None}, {"axis": None}, {"axis": [0, 0, 0]}):
            assert self.lines(robot_of("sawyer"), tmp_path, type="held-orientation", **lack) == [[], []]

    @pytest.mark.parametrize("wrong", [{"axis": [0, 0]}, {"point": [0, 0, float("nan")]}, {"radius": "wide"}])
    def test_bad_numbers_are_refused(self, robot_of, tmp_path, wrong):
        """A number that cannot be drawn is refused by name."""
        with pytest.raises(RecordingError, match=next(iter(wrong))):
            self.lines(robot_of("sawyer"), tmp_path, **{"type": "hinge", "radius": 0.3, **wrong})


def test_hostile_names_stay_text(robot_of, tmp_path):
    """Markup in names and in the mechanism's words does not reach the page as markup."""
    robot = robot_of("planar3")
    phases = [(EVIL, 0.0, 1.0, 0)]
    page = replay(robot, {EVIL: recorded(robot)}, tmp_path / "a.html", phases=phases, mechanism={"type": EVIL})
    assert EVIL not in page.html.read_text(encoding="utf-8")
    assert data_in(page.html)["mechanisms"][0]["sentence"] == EVIL
