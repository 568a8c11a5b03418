"""What is drawn: own shapes, simplified meshes, and plain figures where there is nothing better."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from conftest import URDFS
from test_meshes import BOUND, painted
from test_playback import unpacked, waving

from manip_learn.playback.appearance import appearance, decimate, kinematic_tree
from manip_learn.playback.recorded_motion import guided_motion, recorded_motion
from manip_learn.playback.scene_data import scene_data
from manip_learn.robot.loading import load_robot
from manip_learn.robot.visuals.meshes import Mesh
from manip_learn.robot.visuals.visual_shapes import visual_shapes


def soup(mesh):
    """Every corner of a triangle is a vertex of its own, as in an STL file."""
    return Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))


def volume(mesh):
    """Enclosed volume [m^3]; positive if triangles are counter-clockwise from outside."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume


BALL, CUBE = soup(trimesh.creation.icosphere(5, 0.1)), soup(trimesh.creation.box((1.0, 1.0, 1.0)))


def test_budget_is_kept_and_shape_too():
    """Large meshes are simplified until all fit, small ones stay; size, volume and orientation hardly change. A cube's
    corners are split into three vertices, a smooth sphere's vertices are shared.
    """
    (ball, cube), before, after = decimate([BALL, CUBE], 3000)
    assert before > 10_000 and 1500 < after <= 3000 and len(cube.faces) == 12
    assert volume(ball) == pytest.approx(volume(BALL), rel=0.05)
    np.testing.assert_allclose(np.ptp(ball.vertices, axis=0), 0.2, rtol=0.06)
    (cube, ball), before, after = decimate([CUBE, BALL], 10**6)
    assert before == after and volume(cube) == pytest.approx(1.0)
    assert len(cube.vertices) == 24 and len(ball.vertices) < 0.51 * len(ball.faces) + 10


@pytest.mark.parametrize("name", ["one", "gantry", "wrist", "tree", "humanoid", "rover", "sawyer", "ur5e", "fr3"])
def test_robots_without_meshes_get_shells(robot_of, name):
    """Closed shells lead from each joint to those that it carries, and something is drawn at every joint."""
    robot = robot_of(name)
    tree = kinematic_tree(robot)
    looks = appearance(robot)
    assert {s.joint for s in looks.shapes} == set(range(len(tree)))
    assert all(np.isfinite(s.pose).all() for s in looks.shapes) and len(looks.meshes) > 0
    for mesh in looks.meshes:
        sides = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
        assert sorted(map(tuple, sides)) == sorted(map(tuple, sides[:, ::-1])) and volume(mesh) > 0.0
    shells = {s.joint: looks.meshes[s.mesh] for s in reversed(looks.shapes) if s.mesh is not None}
    for child in tree[1:]:
        at = child.placement[:3, 3]
        if np.linalg.norm(at) > 0.05:
            shell = shells[child.parent]
            assert trimesh.Trimesh(shell.vertices, shell.faces).contains([at])[0], child.name


def test_few_triangles_look_round(robot_of):
    """A link has under a thousand triangles on average; its normals are those of the round itself, also in the page. It
    is as thick as its cylinder; head and jaws, which no bone goes through, stay.
    """
    robot = robot_of("sawyer")
    looks = appearance(robot)
    assert sum(len(m.faces) for m in looks.meshes) < 1000 * len(looks.meshes)
    motion = recorded_motion(robot, robot.frame("right_hand"), guided_motion(robot, "a", waving(robot)))
    data = scene_data(robot, looks, "right_hand", [motion], ())
    number = next(s.mesh for s in looks.shapes if s.joint == 3 and s.mesh is not None)
    forearm = looks.meshes[number]
    sent = unpacked(data["robot"]["meshes"][number]["normals"], "i1").reshape(-1, 3) / 127.0
    np.testing.assert_allclose(sent, forearm.normals, atol=0.005)
    middle = np.abs(forearm.vertices[:, 2] - 0.13) < 0.03
    radial = forearm.vertices[middle] * [1.0, 1.0, 0.0]
    thickness = np.linalg.norm(radial, axis=1, keepdims=True)
    np.testing.assert_allclose(thickness, 0.06, atol=0.004)
    assert np.einsum("ij,ij->i", forearm.normals[middle], radial / thickness).min() > np.cos(np.deg2rad(3.0))
    boxes = [s for s in looks.shapes if s.kind == "box"]
    assert [s.size for s in boxes].count((0.02, 0.26, 0.16)) == 1 and [s.joint for s in boxes].count(7) == 2


def with_visual(folder, geometry):
    """A gantry whose second link has an own shape."""
    path = folder / "arm.urdf"
    visual = f'<link name="link2"><visual><geometry>{geometry}</geometry></visual>'
    path.write_text(URDFS["gantry"].replace('<link name="link2">', visual), encoding="utf-8")
    return load_robot(path)


def test_own_shapes(tmp_path):
    """Those that are no slender links keep their form, wherever the bones of joints run; a part whose triangles are
    lines is not drawn, its neighbour is; a link whose mesh is missing gets plain shapes, and a note that names both.
    """
    robot = with_visual(tmp_path, '<box size="0.6 0.4 0.3"/>')
    assert (0.6, 0.4, 0.3) in [s.size for s in appearance(robot).shapes]
    text = painted("<color>1 0 0</color>", 0, 5).decode()
    flat = BOUND.format(1, 0).replace("</translate>", "</translate><scale>1 0 1</scale>")
    assert BOUND.format(1, 0) in text
    (tmp_path / "a.dae").write_text(text.replace(BOUND.format(1, 0), flat), encoding="utf-8")
    looks = appearance(with_visual(tmp_path, '<mesh filename="a.dae"/>'))
    assert [(s.kind, s.colour) for s in looks.shapes] == [("mesh", (0.0, 0.0, 1.0, 1.0))]
    looks = appearance(with_visual(tmp_path, '<mesh filename="package://nowhere/arm.stl"/>'))
    (note,) = looks.notes
    assert "link2" in note and "arm.stl" in note and looks.shapes


def test_meshes_are_packed(robot_of):
    """Panda's meshes stay within the budget, say so, and come back from 16 bits to within 10 micrometres."""
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


def test_each_part_is_drawn_in_its_colour(robot_of):
    """Panda's hand is drawn in its white, black and grey, also where it is simplified; all parts are where it is."""
    robot = load_robot("panda")
    for most in (10**6, 3000):
        looks = appearance(robot, max_triangles=most)
        hand = next(v for v in visual_shapes(robot) if v.link == "panda_hand")
        drawn = [s for s in looks.shapes if np.array_equal(s.pose, hand.placement) and s.joint == hand.joint]
        known = {tuple(c) for c in hand.shape.colours}
        assert len(known) > 2 and {s.colour for s in drawn} == known and len(drawn) == len(known)
        parts = [looks.meshes[s.mesh] for s in drawn]
        assert sum(len(p.faces) for p in parts) <= len(hand.shape.faces)
        low, high = (f([f(p.vertices, axis=0) for p in parts], axis=0) for f in (np.min, np.max))
        np.testing.assert_allclose([low, high], [f(hand.shape.vertices, axis=0) for f in (np.min, np.max)], atol=0.01)
