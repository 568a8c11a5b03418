"""What is drawn: own shapes, simplified meshes, and plain figures where there is nothing better."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from conftest import URDFS
from test_playback import unpacked, waving

from manip_learn.playback.appearance import appearance, decimated, kinematic_tree
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


def test_simplified_meshes_keep_budget_and_shape():
    """Large meshes are simplified until all fit the budget, small ones stay; size, volume and orientation hardly
    change. A mesh within the budget keeps its triangles.
    """
    (ball, cube), before, after = decimated([BALL, CUBE], 3000)
    assert before > 10_000 and 1500 < after <= 3000 and len(cube.faces) == 12
    assert volume(ball) == pytest.approx(volume(BALL), rel=0.05)
    np.testing.assert_allclose(np.ptp(ball.vertices, axis=0), 0.2, rtol=0.06)
    (cube, ball), before, after = decimated([CUBE, BALL], 10**6)
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
