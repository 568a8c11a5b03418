"""What is drawn: own shapes, simplified meshes, and plain figures where there is nothing better."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from conftest import URDFS
from test_meshes import BOUND, painted
from test_playback import unpacked, waving

from manip_learn.playback.appearance import appearance, decimated, kinematic_tree
from manip_learn.playback.recorded_motion import guided_motion, recorded_motion
from manip_learn.playback.scene_data import scene_data
from manip_learn.robot.loading import load_robot
from manip_learn.robot.visuals.meshes import Mesh
from manip_learn.robot.visuals.visual_shapes import visual_shapes


def ball(steps=60, radius=0.1):
    """A sphere as a triangle soup: every corner a vertex of its own, as in an STL file."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * steps + 1), np.linspace(0, np.pi, steps + 1))
    grid = radius * np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    soup = np.concatenate([np.stack([a, b, c], axis=2).reshape(-1, 3), np.stack([a, c, d], axis=2).reshape(-1, 3)])
    return Mesh(soup, np.arange(len(soup)).reshape(-1, 3))


def cube():
    """A cube of 12 triangles on 8 vertices, counter-clockwise from outside."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Mesh(corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]))


def volume(mesh):
    """Enclosed volume [m^3]; positive if triangles are counter-clockwise from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def test_budget_is_kept_and_shape_too():
    """Large meshes are simplified until all fit, small ones stay; size, volume and orientation hardly change."""
    large, small = ball(), cube()
    (ball_out, cube_out), before, after = decimated([large, small], 3000)
    assert before > 10_000
    assert 1500 < after <= 3000
    assert len(cube_out.faces) == 12
    assert volume(ball_out) == pytest.approx(volume(large), rel=0.05)
    np.testing.assert_allclose(np.ptp(ball_out.vertices, axis=0), 0.2, rtol=0.06)
    assert decimated([large], 10**6)[1:] == (before - 12, before - 12)


def test_edges_stay_sharp_and_round_things_smooth():
    """A cube's corners are split into three vertices, a smooth sphere's vertices are shared."""
    (cube_out, ball_out), _, _ = decimated([cube(), ball()], 10**6)
    assert len(cube_out.vertices) == 24
    assert len(ball_out.vertices) < 0.51 * len(ball_out.faces) + 10
    assert volume(cube_out) == pytest.approx(1.0)


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
    for child in tree[1:]:
        at = child.placement[:3, 3]
        if np.linalg.norm(at) > 0.05:
            assert trimesh.Trimesh(*solid_of(looks, child.parent)).contains([at])[0], child.name


def solid_of(looks, joint):
    """Vertices and faces of a joint's shell."""
    mesh = next(looks.meshes[s.mesh] for s in looks.shapes if s.joint == joint and s.mesh is not None)
    return mesh.vertices, mesh.faces


def test_few_triangles_look_round(robot_of):
    """A link has under a thousand triangles on average; its normals are those of the round itself, also in the page."""
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
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", forearm.normals[middle], radial).min() > np.cos(np.deg2rad(3.0))


def test_shells_take_the_thickness_of_what_they_stand_for(robot_of):
    """A link of the shipped Sawyer is as thick as its cylinder; head and jaws, which no bone goes through, stay."""
    looks = appearance(robot_of("sawyer"))
    forearm = solid_of(looks, 3)[0]
    middle = forearm[np.abs(forearm[:, 2] - 0.13) < 0.03]
    np.testing.assert_allclose(np.hypot(middle[:, 0], middle[:, 1]), 0.06, atol=0.004)
    assert [s.size for s in looks.shapes if s.kind == "box"].count((0.02, 0.26, 0.16)) == 1
    assert len([s for s in looks.shapes if s.kind == "box" and s.joint == 7]) == 2


def test_chassis_and_wheels_are_drawn_as_they_are(tmp_path):
    """Own shapes that are no slender links keep their form, wherever the bones of joints run."""
    chassis = '<visual><geometry><box size="0.6 0.4 0.3"/></geometry></visual>'
    path = tmp_path / "cart.urdf"
    path.write_text(URDFS["gantry"].replace('<link name="link2">', f'<link name="link2">{chassis}'), encoding="utf-8")
    robot = load_robot(path)
    assert (0.6, 0.4, 0.3) in [s.size for s in appearance(robot).shapes]


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


def test_parts_that_have_no_area_are_left_out(tmp_path):
    """A part whose triangles are lines is not drawn; its neighbour is."""
    text = painted("<color>1 0 0</color>", 0, 5).decode()
    flat = BOUND.format(1, 0).replace("</translate>", "</translate><scale>1 0 1</scale>")
    assert BOUND.format(1, 0) in text
    (tmp_path / "a.dae").write_text(text.replace(BOUND.format(1, 0), flat), encoding="utf-8")
    visual = '<visual><geometry><mesh filename="a.dae"/></geometry></visual>'
    path = tmp_path / "arm.urdf"
    path.write_text(URDFS["gantry"].replace('<link name="link2">', f'<link name="link2">{visual}'), encoding="utf-8")
    robot = load_robot(path)
    looks = appearance(robot)
    assert [(s.kind, s.colour) for s in looks.shapes] == [("mesh", (0.0, 0.0, 1.0, 1.0))]


def test_missing_meshes_are_told(tmp_path, robot_of):
    """A link whose mesh is missing gets plain shapes, and a note that names the link and the file."""
    visual = '<visual><geometry><mesh filename="package://nowhere/arm.stl"/></geometry></visual>'
    path = tmp_path / "bare.urdf"
    path.write_text(URDFS["gantry"].replace('<link name="link2">', f'<link name="link2">{visual}'), encoding="utf-8")
    robot = load_robot(path)
    looks = appearance(robot)
    assert len(looks.notes) == 1
    assert "link2" in looks.notes[0] and "arm.stl" in looks.notes[0]
    assert looks.shapes
