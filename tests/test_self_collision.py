"""Distances between links: exact gradients, which pairs count, and a clear error where there is nothing to measure."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import chain_urdf
from test_gradients import central_difference
from test_scene import THINGS, pose, scene_of
from urdf_corpus import edited, stl

import manip_learn as ml
from manip_learn.errors import RobotError
from manip_learn.planning.clearance import Clearance, Surroundings
from manip_learn.playback.appearance import appearance
from manip_learn.robot.collision import SelfCollision, collision_shapes, describe_shapes, known_shapes
from manip_learn.robot.loading import load_robot, robot_from_text
from manip_learn.robot.robot_summary import inspect_robot
from manip_learn.robot.visuals.visual_shapes import Solid, losses, visual_shapes

SHAPES = {"panda": "collision", "sawyer": "visual", "planar3": "visual"}


@pytest.fixture(scope="module")
def collision_of(robot_of):
    """Name -> distances of a robot, each built once."""
    built = {name: SelfCollision(robot_of(name), shapes=tag) for name, tag in SHAPES.items()}
    return built.__getitem__


def shape(kind: str) -> str:
    return f'<collision><origin xyz="0.1 0 0"/><geometry>{kind}</geometry></collision>'


@pytest.mark.parametrize("name", list(SHAPES))
def test_gradient(robot_of, collision_of, name):
    """Of pairs that do not overlap the gradient is right to 1e-5, but for where the nearest points jump.

    `nearest` is the least of `closer_than`, which finds all pairs in range and no others.
    """
    robot, collision, rng = robot_of(name), collision_of(name), np.random.default_rng(5)
    checked = jumps = 0
    for _ in range(40):
        q = robot.random_configuration(rng)
        near = collision.nearest(q)
        if near.distance <= 1e-3:
            continue
        every = sorted(p.distance for p in collision.closer_than(q, 10.0))
        assert near.distance == pytest.approx(every[0], abs=1e-9)
        in_range = [distance for distance in every if distance <= 0.1]
        assert sorted(p.distance for p in collision.closer_than(q, 0.1)) == pytest.approx(in_range, abs=1e-9)
        expected = central_difference(lambda x: collision.nearest(x).distance, robot, q)
        wrong = float(np.linalg.norm(near.gradient - expected))
        checked, jumps = checked + 1, jumps + (wrong > 1e-5)
    assert checked > 20 and jumps <= 0.1 * checked


def test_which_pairs_count(robot_of, collision_of):
    """Neighbours are left out, and links that cannot touch; hand and base count. Neutral postures are free."""
    pairs = {frozenset(p) for p in collision_of("panda").link_pairs}
    assert frozenset(("panda_link1", "panda_hand")) in pairs and frozenset(("panda_link0", "panda_link6")) in pairs
    assert not pairs & {frozenset((f"panda_link{i}", f"panda_link{i + 1}")) for i in range(7)}
    assert frozenset(("panda_link2", "panda_link4")) not in pairs  # a knee that cannot close that far
    for name in SHAPES:
        assert collision_of(name).nearest(robot_of(name).neutral()).distance > 0.0


def test_a_mesh_that_is_not_convex(tmp_path):
    """A ball between the legs of a U is within its hull; by its triangles it is as far away as from the nearest leg."""
    legs = [
        ((0.1, 0.8, 0.2), (0.75, 0.0, 0.0)),
        ((0.5, 0.1, 0.2), (0.45, 0.45, 0.0)),
        ((0.5, 0.1, 0.2), (0.45, -0.45, 0.0)),
    ]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in legs]
    trimesh.util.concatenate(boxes).export(tmp_path / "u.stl")
    text = chain_urdf(
        "hook", [("revolute", "0 0 1", "0 0 0", "0 0 0")] + [("revolute", "0 0 1", "0.3 0 0", "0 0 0")] * 2
    )
    mesh, ball = '<mesh filename="u.stl"/>', '<sphere radius="0.05"/>'
    for link, kind in (("base", mesh), ("link2", ball)):
        text = text.replace(f'<link name="{link}">', f'<link name="{link}">{shape(kind).replace("0.1 0 0", "0 0 0")}')
    (tmp_path / "hook.urdf").write_text(text, encoding="utf-8")
    robot, rng = load_robot(tmp_path / "hook.urdf"), np.random.default_rng(8)
    hulls, meshes = SelfCollision(robot, free=[2.0, 0.5, 0.5]), SelfCollision(robot, free=[2.0, 0.5, 0.5], hulls=False)
    between = 0
    for _ in range(200):
        q = robot.random_configuration(rng)
        place = robot.position(q, "link2")
        away = (np.abs(place - np.array(at)) - 0.5 * np.array(size) for size, at in legs)
        expected = min(np.linalg.norm(np.maximum(d, 0.0)) + min(d.max(), 0.0) for d in away) - 0.05
        if expected > 1e-4:
            assert meshes.nearest(q).distance == pytest.approx(expected, abs=1e-6)
            between += bool(hulls.nearest(q).distance < 0.0)
        assert meshes.is_clear(q, 0.02) is bool(expected > 0.02) or abs(expected - 0.02) < 1e-6
    assert between > 20


@pytest.mark.parametrize(("name", "hulls"), [("panda", True), ("panda", False), ("ur5", True)])
def test_clear_is_what_is_not_closer(robot_of, name, hulls):
    """`is_clear` and `closer_than` draw one line, to ten micrometres on both sides of every distance; among things of
    every kind, and with the last link in a body that is not convex, too.
    """
    robot, rng, seen, answers = robot_of(name), np.random.default_rng(11), 0, []
    things = scene_of(*THINGS, floor=-0.5).obstacles(robot) if name == "ur5" else ()
    collision, ell = SelfCollision(robot, hulls=hulls, obstacles=things), THINGS[5]
    for _ in range(120):
        q = robot.random_configuration(rng)
        about = ml.Mesh(ell.source, pose(robot.pose(q, robot.frame_names[-1])[:3, 3]), "ell")
        for pairs in (collision, collision.with_obstacles(scene_of(about).obstacles(robot)))[: 1 + bool(things)]:
            near = pairs.nearest(q).distance
            answers.append(pairs.is_clear(q, 0.0))
            assert abs(near) < 1e-6 or answers[-1] == (not pairs.closer_than(q, 0.0))
            if 2e-5 < near < 0.2:
                seen += 1
                for distance, is_clear in ((near - 1e-5, True), (near + 1e-5, False), (near + 0.05, False)):
                    assert pairs.is_clear(q, distance) is is_clear is (not pairs.closer_than(q, distance))
    assert seen > 40 or (things and 0.05 < np.mean(answers) < 0.95)


@pytest.mark.parametrize(("deep", "counts"), [(0.009, False), (0.011, True)])
def test_links_two_joints_apart_count_where_they_touch(tmp_path, deep, counts):
    """A pair is left out unless its hulls overlap by a centimetre somewhere; with more joints between it counts."""
    joints = [("revolute", "0 0 1", "0.4 0 0", "0 0 0")] + [("revolute", "0 0 1", "0.3 0 0", "0 0 0")] * 3
    nearest = abs(0.3 + 0.1 * np.exp(2.0j))  # of a place on link1 and the first joint, at the limit of the second
    ball, text = shape(f'<sphere radius="{0.5 * (nearest + deep)}"/>'), chain_urdf("bent", joints)
    shapes = {"base": ball.replace("0.1 0 0", "0.4 0 0"), "link1": ball, "link3": shape('<sphere radius="0.001"/>')}
    for link, element in shapes.items():
        text = text.replace(f'<link name="{link}">', f'<link name="{link}">{element}')
    (tmp_path / "bent.urdf").write_text(text, encoding="utf-8")
    pairs = SelfCollision(load_robot(tmp_path / "bent.urdf")).link_pairs
    assert (("base", "link1") in pairs) is counts and ("base", "link3") in pairs


def lost(robot, folder, *changes: tuple[bytes, bytes]):
    """A copy of a robot in which meshes have other names."""
    content = robot.description
    for old, new in changes:
        assert content.count(old) == 1
        content = content.replace(old, new)
    (folder / "lost.urdf").write_bytes(content)
    return load_robot(folder / "lost.urdf", package_dirs=list(robot.source.parents)[:5])


@pytest.mark.parametrize("tag", ["collision", "visual"])
def test_a_lost_mesh_costs_its_own_link_only(tmp_path, tag):
    """Meshes of two links are missing: the others count as before, plain shapes stand in for these, and a plan,
    a replay and `inspect` say their names in the same words.
    """
    file = {"collision": "collision/{}.stl", "visual": "visual/{}.dae"}[tag]
    changes = [(file.format(f"link{n}").encode(), file.format(f"gone{n}").encode()) for n in (3, 5)]
    robot = lost(load_robot("panda"), tmp_path, *changes)
    other = SelfCollision(robot, shapes=tag)
    kinds = {s.link: type(s.geometry).__name__ for s in collision_shapes(robot, tag)}
    assert kinds["panda_link3"] == "Capsule" and kinds["panda_link5"] == "Sphere" and kinds["panda_link4"] == "Convex"
    q = robot.positions(robot.neutral())
    full, some = (
        {p.links: p.distance for p in c.closer_than(x, 10.0) if not {"panda_link3", "panda_link5"} & {*p.links}}
        for c, x in ((SelfCollision(load_robot("panda"), shapes=tag), q), (other, q))
    )
    shared = full.keys() & some.keys()
    assert len(shared) > 0.8 * len(full) and all(some[k] == full[k] for k in shared)
    why = losses(visual_shapes(robot, tag))
    assert len(why) == 1 and why[0].startswith("Plain shapes stand in for panda_link3, panda_link5: mesh '")
    assert known_shapes(robot) == "collision"
    planned = Clearance(robot, True, Surroundings(), q).notes
    drawn = appearance(robot).notes
    assert (why[0] in planned, why[0] in drawn) == (tag == "collision", tag == "visual")
    assert why[0] in inspect_robot(robot).warnings


SHEET = trimesh.creation.box((0.2, 0.1, 0.0), trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))).export
DOTS = trimesh.Trimesh([[0, 0, 0], [1e-3, 0, 0], [2e-3, 0, 0]], [[0, 1, 2]]).export
ONE_LINK = {  # what is wrong with the shapes of a link -> these, what stands there, and why
    "a flat sticker": ('<mesh filename="sheet.stl"/>', ["Convex"], ""),
    "one triangle": ('<mesh filename="triangle.stl"/>', ["Convex"], ""),
    "points on a line": ('<mesh filename="dots.stl"/>', ["Convex"], ""),
    "a box without thickness": ('<box size="0.2 0 0.1"/>', ["Box"], ""),
    "a cylinder without length": ('<cylinder radius="0.1" length="0"/>', ["Cylinder"], ""),
    "a box of size 0": ('<box size="0 0 0"/>', ["Capsule"], "a size of its box is 0.0"),
    "a negative size": ('<cylinder radius="0.1" length="-1"/>', ["Capsule"], "a size of its cylinder is -1.0"),
    "a mesh that is missing": ('<mesh filename="gone.stl"/>', ["Capsule"], "'gone.stl' was not found"),
    "millimetres": ('<mesh filename="large.stl"/>', ["Capsule"], 'scale="0.001 0.001 0.001" in its <mesh> says so'),
    "millimetres twice": (
        '<mesh filename="large.stl"/>|<mesh filename="larger.stl"/>',
        ["Capsule"],
        "mesh 'large.stl' (and 1 more) is 300 m long",
    ),
}


@pytest.mark.parametrize("tag", ["collision", "visual"])
@pytest.mark.parametrize("kind", ONE_LINK)
def test_a_bad_shape_costs_its_own_link_only(tmp_path, tag, kind):
    """A sheet is a thin body of its size; what cannot be used is replaced by a plain shape, and plans and replays say
    so in one sentence. The other links count as they are, and nobody claims that the robot has no shapes.
    """
    elements, stands_there, why = ONE_LINK[kind]
    sheet = SHEET(file_type="stl")
    files = {"sheet": sheet, "triangle": stl(value=0.1), "dots": DOTS(file_type="stl")}
    files |= {"large": stl(value=300.0), "larger": stl(value=400.0)}
    for name, content in files.items():
        (tmp_path / f"{name}.stl").write_bytes(content)
    text = chain_urdf("arm", [("revolute", "0 0 1", "0.4 0 0", "0 0 0")] * 3)
    box, bad = shape('<box size="0.1 0.1 0.1"/>'), "".join(map(shape, elements.split("|")))
    for link, element in (("base", box), ("link0", box), ("link1", bad), ("link2", box)):
        text = text.replace(f'<link name="{link}">', f'<link name="{link}">{element.replace("collision", tag)}')
    (tmp_path / "arm.urdf").write_text(text, encoding="utf-8")
    robot = load_robot(tmp_path / "arm.urdf")
    shapes = collision_shapes(robot, tag)
    assert [type(s.geometry).__name__ for s in shapes if s.link == "link1"] == stands_there
    cubes = {s.link for s in shapes if isinstance(s.shape, Solid) and s.shape.size == (0.1, 0.1, 0.1)}
    assert cubes == {"base", "link0", "link2"}
    planned = Clearance(robot, True, Surroundings(), robot.positions(robot.neutral())).notes
    drawn = list(appearance(robot).notes)
    assert len(planned) == bool(why)
    assert all(note.startswith("Plain shapes stand in for link1: ") and why in note for note in planned)
    assert tag == "collision" or drawn == planned
    said = f"collision checks use {3 + (not why)} shapes of <{tag}> elements"
    assert describe_shapes(robot) == said + "; plain shapes stand in for link1" * bool(why)


@pytest.mark.parametrize("joint", ["revolute", "fixed"])
def test_a_robot_without_shapes_and_without_length(joint):
    """There is nothing that could touch: no pair, every posture is clear, and a sentence says why."""
    content = edited(("0 0 0.3", "0 0 0"), ("0.4 0 0", "0 0 0"), *[('"revolute"', f'"{joint}"')] * 2)
    robot = robot_from_text(content, Path("arm.urdf"))
    q, collision = robot.neutral(), SelfCollision(robot, shapes="links")
    assert collision.nearest(q) is None and not collision.closer_than(q, 1.0) and collision.is_clear(q, 1.0)
    clearance = Clearance(robot, True, Surroundings(), robot.positions(q))
    assert clearance(robot.positions(q)) and clearance.notes == [describe_shapes(robot)]
    assert "no shapes that can be used" in describe_shapes(robot)


def test_threads_and_copies(robot_of, collision_of):
    """Give the same numbers; with a mimic joint the gradient is along the independent joints."""
    panda = load_robot("panda")  # the second finger mimics the first
    collision, rng = SelfCollision(panda), np.random.default_rng(7)
    starts = [panda.random_configuration(rng) for _ in range(16)]
    alone = [collision.nearest(q) for q in starts]
    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(collision.nearest, starts))
    for a, b in zip(alone, together, strict=True):
        assert a.links == b.links and a.distance == pytest.approx(b.distance, abs=1e-12)
        np.testing.assert_allclose(a.gradient, b.gradient, rtol=0, atol=1e-9)
        assert a.gradient.shape == (8,)
    copy = pickle.loads(pickle.dumps(collision_of("planar3")))
    assert copy.link_pairs == collision_of("planar3").link_pairs


def test_robots_without_shapes(robot_of, tmp_path):
    """One error says what is missing and what can take its place; broken shapes are named with their link."""
    with pytest.raises(RobotError, match="shapes='visual'") as seen:
        SelfCollision(robot_of("sawyer"))
    assert seen.value.code == "no-collision-shapes"
    with pytest.raises(RobotError, match="no <collision> elements"):
        SelfCollision(robot_of("gantry"))
    for kind, message in (('<sphere radius="-1"/>', "link2"), ('<mesh filename="nowhere.stl"/>', "nowhere.stl")):
        text = chain_urdf("broken", [("revolute", "0 0 1", "0.4 0 0", "0 0 0")] * 3)
        path = tmp_path / "broken.urdf"
        path.write_text(text.replace('<link name="link2">', f'<link name="link2">{shape(kind)}'), encoding="utf-8")
        with pytest.raises(RobotError, match=message):
            SelfCollision(load_robot(path))
