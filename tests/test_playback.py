"""The replay page: what goes in, what is refused, what the file holds; key frames, curves, phases and shapes."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import subprocess
import sys
import webbrowser
from dataclasses import replace
from html import unescape
from xml.sax.saxutils import escape

import numpy as np
import pytest
import trimesh
from case import case
from conftest import URDFS

import manip_learn as ml
from manip_learn.errors import ConfigurationError, OutputError, RecordingError, UnknownNameError
from manip_learn.playback.appearance import appearance, decimate, kinematic_tree
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
from manip_learn.robot.description.catalogue import find_robot
from manip_learn.robot.visuals.meshes import Mesh
from manip_learn.robot.visuals.visual_shapes import visual_shapes

PLANAR3 = find_robot("planar3")
EVIL = '</script><script>window.hacked=1</script><img src=x onerror="window.hacked=2">'


def waving(robot, duration=2.0, dt=0.01, phase=0.0):
    """A rollout that waves around the robot's rest posture."""
    time = np.arange(round(duration / dt) + 1) * dt
    middle = robot.positions(robot.neutral())
    swing = np.sin(np.outer(time, 1.0 + 0.3 * np.arange(robot.nv)) + phase)
    mu = np.abs(np.cos(time + phase))
    status = tuple("damped" if m < 0.3 else "ok" for m in mu)
    q = middle + 0.4 * swing
    return ml.Rollout(time, q, 0.0 * q, mu, status, robot.joint_names, 0.0 * time)


def evil_robot(folder):
    """A planar arm whose own name and those of a link and a joint are markup."""
    quoted = escape(EVIL, {'"': "&quot;"})
    urdf = PLANAR3.read_text().replace("planar3", quoted).replace("link2", quoted)
    (folder / "evil.urdf").write_text(urdf.replace("joint2", escape("<b>joint</b>")), encoding="utf-8")
    return ml.load_robot(folder / "evil.urdf")


def data_in(path):
    """What the page's program reads."""
    text = path.read_text(encoding="utf-8")
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])


def unpacked(text, dtype="<f8"):
    """An array as the page's program decodes it."""
    return np.frombuffer(base64.b64decode(text), dtype)


def test_pages_are_small_and_accurate(robot_of, tmp_path):
    """Ten minutes of a Panda at 100 Hz, meshes included, make one file below 5 MB, in a folder that did not exist. It
    is within 2 mrad of each sample between key frames.
    """
    rollout, path = waving(robot_of("panda"), 600.0), tmp_path / "new" / "a.html"
    result = ml.replay(robot_of("panda"), {"a": rollout}, path)
    assert result.html == path.resolve() and result.bytes == path.stat().st_size < 5_000_000
    assert [p.name for p in path.parent.iterdir()] == ["a.html"]
    drawn = data_in(path)["rollouts"][0]
    times, tracks = unpacked(drawn["keyTimes"]), unpacked(drawn["tracks"])
    for j, column in enumerate(tracks.reshape(len(times), -1)[:, :7].T):
        assert np.abs(np.interp(rollout.time, times, column) - rollout.q[:, j]).max() < 2e-3


def test_page_loads_nothing_and_contains_the_licences(robot_of, tmp_path):
    """The policy allows the page's two scripts by their hashes and no connection; nothing is loaded from outside. The
    licences of the viewer, three.js and their dependencies are in the page word for word.
    """
    text = ml.replay(robot_of("planar3"), waving(robot_of("planar3"), 0.1), tmp_path / "a.html").html.read_text("utf-8")
    policy = re.search(r'http-equiv="Content-Security-Policy" content="(.*?)"', text)[1]
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    assert len(scripts) == 2 and all(f"'sha256-{digest}'" in policy for digest in hashes)
    assert "default-src 'none'" in policy and "connect-src 'none'" in policy
    assert "unsafe-eval" not in policy and "script-src 'unsafe-inline'" not in policy
    assert not re.search(r"(src|href)\s*=", re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL))
    licences = unescape(re.search(r'<script type="text/plain" id="licences">(.*?)</script>', text, re.DOTALL)[1])
    assert licences == (PLANAR3.parents[1] / "LICENSES" / "third-party-pages.txt").read_text(encoding="utf-8")
    for name in ("meshcat", "three 0.132.2", "dat.gui", "msgpack-lite", "Copyright © 2010-2021 three.js authors"):
        assert name in licences


def broken(rollout, **changes):
    """A rollout with some fields changed, past all checks."""
    copy = replace(rollout)
    for name, value in changes.items():
        object.__setattr__(copy, name, value)
    return copy


def test_bad_rollouts_and_choices_are_refused(robot_of, tmp_path):
    """NaN anywhere, bad times, missing rows, other robots and nothing at all are errors, and no file is written; an
    unknown tip, colour or rollout names what there is; an unwritable place is one sentence.
    """
    robot = robot_of("planar3")
    good, path = waving(robot), tmp_path / "a.html"
    nan = np.where(np.arange(good.q.size).reshape(good.q.shape) == 7, np.nan, good.q)
    mu = "manipulability of its 201 times must be as many finite"
    bad = [
        (broken(good, q=nan), "q of sample 2, joint 'joint2' is nan"),
        (broken(good, manipulability=good.manipulability * np.inf), mu),
        (broken(good, manipulability=good.manipulability[:-1]), mu),
        (broken(good, time=good.time * 0.0), "time must increase"),
        (broken(good, time=np.where(good.time == 0.5, np.nan, good.time)), "time of sample 50 is nan"),
        (broken(good, q=good.q[:-1]), r"q must have shape \(201, 3\)"),
        (broken(good, status=good.status[:-1]), "200 status words"),
        (broken(good, time=good.time[:0], q=good.q[:0]), "there are no samples"),
        (broken(good, joint_names=("joint1", "joint2", "elbow")), "missing joint3; not its own elbow"),
        (waving(robot_of("sawyer")), "not made with robot 'planar3'"),
        ("rollout.npz", "must be a Rollout or a Trajectory"),
    ]
    wide = broken(good, q=np.hstack([good.q, good.q]))
    for shown, more, error, words in (
        *(({"one": good, "bad": rollout}, {}, RecordingError, words) for rollout, words in bad),
        *((nothing, {}, RecordingError, None) for nothing in ({}, [good], None)),
        (wide, {}, ConfigurationError, "has 3 numbers"),
        (good, {"tip": "tipp"}, UnknownNameError, "unknown frame 'tipp'.*'tip'"),
        ({"a": good}, {"colours": {"a": "gren"}}, UnknownNameError, "unknown colour 'gren'.*'green'"),
        ({"a": good}, {"colours": {"b": "green"}}, UnknownNameError, "unknown rollout 'b'"),
        (good, {"html": tmp_path}, OutputError, "is a folder"),
        *(
            (good, wrong, RecordingError, "align|side_by_side")
            for wrong in ({"align": "contact"}, {"side_by_side": True})
        ),
    ):
        with pytest.raises(error, match=words):
            ml.replay(robot, shown, **{"html": path} | more)
    assert not path.exists()


def test_demonstrations_have_no_curve(robot_of, tmp_path):
    """A trajectory plays without a manipulability curve, under its own name, columns matched by joint name."""
    robot, rollout = robot_of("planar3"), waving(robot_of("planar3"))
    shuffled = ml.Trajectory(rollout.time + 5.0, rollout.q[:, ::-1], None, robot.joint_names[::-1], "demo_01")
    page, other = (
        data_in(ml.replay(robot, shown, tmp_path / "a.html").html)["rollouts"][0] for shown in (shuffled, rollout)
    )
    assert (page["name"], page["curve"], page["status"]) == ("demo_01", "", [])
    assert page["tracks"] == other["tracks"] and unpacked(page["keyTimes"])[0] == 0.0


def test_browser_opens_without_a_file_name(robot_of, tmp_path, monkeypatch):
    """Without a file name a temporary page is written and shown, unless `open_browser` is False; with one, only if it
    is True.
    """
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    robot, motion = robot_of("planar3"), waving(robot_of("planar3"))
    page = ml.replay(robot, motion).html
    assert page.is_file() and tmp_path in page.parents
    ml.replay(robot, motion, tmp_path / "a.html")
    ml.replay(robot, motion, open_browser=False)
    assert opened == [page.as_uri()]
    ml.replay(robot, motion, tmp_path / "a.html", open_browser=True)
    assert opened[1:] == [(tmp_path / "a.html").as_uri()]


def test_meshcat_is_never_imported(tmp_path):
    """Writing a replay takes meshcat's script from its folder; importing meshcat would bring IPython."""
    code = (
        "import sys, numpy as np, manip_learn as ml\n"
        "robot = ml.load_robot('planar3')\n"
        "demo = ml.Trajectory(np.arange(3.0), np.zeros((3, 3)), None, robot.joint_names)\n"
        f"ml.replay(robot, demo, {str(tmp_path / 'a.html')!r})\n"
        "assert not {'meshcat', 'IPython', 'tornado', 'zmq', 'trimesh'} & {*sys.modules}\n"
    )
    subprocess.run([sys.executable, "-c", code], timeout=60, check=True)


# ---- key frames and curves -------------------------------------------------------------------------------------------


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
    assert curve.size <= MAX_CURVE_POINTS + 2 and path.size <= 3 * MAX_PATH_POINTS
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


# ---- shapes ----------------------------------------------------------------------------------------------------------


def soup(mesh):
    """Every corner of a triangle is a vertex of its own, as in an STL file."""
    return Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))


def volume(mesh):
    """Enclosed volume [m^3]; positive if triangles are counter-clockwise from outside."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume


BALL, CUBE = soup(trimesh.creation.icosphere(5, 0.1)), soup(trimesh.creation.box((1.0, 1.0, 1.0)))


def test_simplified_meshes_keep_budget_and_shape():
    """Large meshes are simplified until all fit the budget, small ones stay; size, volume and orientation hardly
    change. A mesh within the budget keeps its triangles.
    """
    (ball, cube), before, after = decimate([BALL, CUBE], 3000)
    assert before > 10_000 and 1500 < after <= 3000 and len(cube.faces) == 12
    assert volume(ball) == pytest.approx(volume(BALL), rel=0.05)
    np.testing.assert_allclose(np.ptp(ball.vertices, axis=0), 0.2, rtol=0.06)
    (cube, ball), before, after = decimate([CUBE, BALL], 10**6)
    assert before == after and volume(cube) == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["gantry", "tree", "rover", "ur5e"])
def test_robots_without_meshes_get_shells(robot_of, name):
    """A robot without meshes is drawn with closed shells, and something is drawn at every joint."""
    robot = robot_of(name)
    looks = appearance(robot)
    assert {s.joint for s in looks.shapes} == set(range(len(kinematic_tree(robot))))
    assert all(np.isfinite(s.pose).all() for s in looks.shapes) and len(looks.meshes) > 0
    for mesh in looks.meshes:
        sides = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
        assert sorted(map(tuple, sides)) == sorted(map(tuple, sides[:, ::-1])) and volume(mesh) > 0.0


def looks_with(folder, geometry):
    """Looks of a gantry whose second link has a shape of its own."""
    path = folder / "arm.urdf"
    visual = f'<link name="link2"><visual><geometry>{geometry}</geometry></visual>'
    path.write_text(URDFS["gantry"].replace('<link name="link2">', visual), encoding="utf-8")
    return appearance(ml.load_robot(path))


def test_own_shapes(tmp_path):
    """A box of the description is drawn with its size. A link whose mesh is missing gets plain shapes and a note that
    names both.
    """
    assert (0.6, 0.4, 0.3) in [s.size for s in looks_with(tmp_path, '<box size="0.6 0.4 0.3"/>').shapes]
    looks = looks_with(tmp_path, '<mesh filename="package://nowhere/arm.stl"/>')
    assert "link2" in looks.notes[0] and "arm.stl" in looks.notes[0] and looks.shapes


def test_meshes_are_packed(robot_of):
    """The Panda's meshes stay within the budget, a note says so, and the page's 16-bit vertices are within 10
    micrometres. Its hand keeps its white, black and grey.
    """
    robot = robot_of("panda")
    looks = appearance(robot, max_triangles=5000)
    assert sum(len(m.faces) for m in looks.meshes) <= 5000
    assert any("simplified from" in note for note in looks.notes)
    motion = recorded_motion(robot, robot.frame("panda_hand"), guided_motion(robot, "a", waving(robot)))
    data = scene_data(robot, looks, "panda_hand", [motion], looks.notes)
    for packed, mesh in zip(data["robot"]["meshes"], looks.meshes, strict=True):
        steps = unpacked(packed["positions"], "<u2").reshape(-1, 3)
        np.testing.assert_allclose(packed["origin"] + steps * packed["step"], mesh.vertices, atol=1e-5)
        triangles = unpacked(packed["triangles"], "<u4" if packed["wide"] else "<u2").reshape(-1, 3)
        np.testing.assert_array_equal(triangles, mesh.faces)
    hand = next(v for v in visual_shapes(robot) if v.link == "panda_hand")
    colours = {s.colour for s in looks.shapes if np.array_equal(s.pose, hand.placement) and s.joint == hand.joint}
    assert colours == {tuple(c) for c in hand.shape.colours} and len(colours) > 2
