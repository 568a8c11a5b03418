"""Key frames, curves, phases and shapes of a replay."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from case import case
from conftest import URDFS
from test_playback import data_in, unpacked, waving

import manip_learn as ml
from manip_learn.errors import RecordingError
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
from manip_learn.robot.loading import load_robot
from manip_learn.robot.visuals.meshes import Mesh
from manip_learn.robot.visuals.visual_shapes import visual_shapes


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
    return appearance(load_robot(path))


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
