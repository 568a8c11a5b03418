"""What stands around an arm, and distances of links from it and from each other, against computations of their own."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from case import DATA, rows_in
from conftest import chain_with
from test_gradients import central_difference
from urdf_corpus import stl

import manip_learn as ml
from manip_learn import errors
from manip_learn.errors import RobotError, SceneError
from manip_learn.planning.clearance import Clearance, Surroundings
from manip_learn.playback.appearance import appearance
from manip_learn.robot.collision import SelfCollision, collision_shapes, describe_shapes
from manip_learn.robot.rotations import rotation_matrix
from manip_learn.robot.visuals.visual_shapes import Solid

RADIUS = 0.05  # [m] of the balls of the `balls` arm


def pose(place, turn=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(np.array(turn)), place
    return T


BEAMS = (((1.0, 0.4, 0.4), (0.0, 0.0, 0.0)), ((0.4, 0.4, 1.0), (0.3, 0.0, 0.5)))  # size and place


# a board and a leg that stand apart: two closed convex parts in one mesh
TABLE = (trimesh.creation.box((0.8, 0.6, 0.05)), trimesh.creation.cylinder(0.05, 0.5, transform=pose((0.2, 0.0, -0.3))))
SOURCES = {
    # an L of two beams, closed and not convex
    "ell": trimesh.boolean.union([trimesh.creation.box(size, pose(place)) for size, place in BEAMS], engine="manifold"),
    "lidless": trimesh.creation.box((0.6, 0.5, 0.4)),  # its lid is taken off below
    "table": trimesh.util.concatenate(TABLE),
}
SOURCES["lidless"].update_faces(SOURCES["lidless"].face_normals[:, 2] < 0.5)


def signed_distance(thing, points):
    """Of points outside; of those within a number that is not positive; from a surface that is open, the distance."""
    if thing.name == "ell":  # its two beams
        foot, beam = (ml.Box(size, thing.pose @ pose(place), "beam") for size, place in BEAMS)
        return np.minimum(signed_distance(foot, points), signed_distance(beam, points))
    inner = (points - thing.pose[:3, 3]) @ thing.pose[:3, :3]
    if isinstance(thing, ml.Mesh):
        mesh = SOURCES[thing.name]
        if not mesh.is_watertight:
            return trimesh.proximity.closest_point(mesh, inner)[1]
        parts = [trimesh.Trimesh(p.vertices, p.faces) for p in mesh.split()]
        return np.min([-trimesh.proximity.signed_distance(part, inner) for part in parts], axis=0)
    if isinstance(thing, ml.Sphere):
        return np.linalg.norm(inner, axis=1) - thing.radius
    if isinstance(thing, ml.Box):
        beyond = np.abs(inner) - 0.5 * np.asarray(thing.size)
    else:
        beyond = np.column_stack([np.hypot(*inner[:, :2].T) - thing.radius, np.abs(inner[:, 2]) - 0.5 * thing.length])
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


def mesh_of(name, place, turn=(0.0, 0.0, 0.0)):
    return ml.Mesh((SOURCES[name].vertices, SOURCES[name].faces), pose(place, turn), name)


THINGS = [
    ml.Box((0.5, 0.7, 0.3), pose((0.6, 0.2, 0.3), (0.1, 0.2, 0.7)), "box"),
    ml.Sphere(0.25, (0.6, 0.3, 0.3), "sphere"),
    ml.Cylinder(0.2, 0.6, pose((0.6, -0.3, 0.4), (0.6, 0.3, 0.0)), "cylinder"),
    mesh_of("table", (0.6, -0.3, 0.4), (0.0, 0.1, 0.5)),
    mesh_of("ell", (0.5, 0.4, 0.1), (0.2, 0.1, 0.4)),
    mesh_of("lidless", (0.5, 0.4, 0.2), (0.1, 0.3, 0.4)),
]
FIELDS = {ml.Box: "boxes", ml.Sphere: "spheres", ml.Cylinder: "cylinders", ml.Mesh: "meshes"}


def scene_of(*things, **others):
    lists = {field: [t for t in things if type(t) is kind] for kind, field in FIELDS.items()}
    return ml.Scene(**lists, **others)


def shape(kind: str, at: str = "0.1 0 0", tag: str = "collision") -> str:
    """An element of a link."""
    return f'<{tag}><origin xyz="{at}"/><geometry>{kind}</geometry></{tag}>'


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    """An arm of five joints with a ball at the end of each link but the base."""
    joints = [("revolute", axis, "0.3 0.05 0.1", "0 0 0") for axis in ("0 0 1", "0 1 0", "1 0 0", "0 1 0", "0 0 1")]
    ball = shape(f'<sphere radius="{RADIUS}"/>')
    return chain_with(tmp_path_factory.mktemp("balls"), joints, {f"link{i}": ball for i in range(5)})


def min_distances(pairs):
    """Return the smallest distance of each pair of links."""
    return {pair.links: pair.distance for pair in sorted(pairs, key=lambda pair: -pair.distance)}


@pytest.mark.parametrize("thing", THINGS, ids=lambda thing: thing.name)
def test_distances_of_balls_are_exact(balls, thing):
    """From each kind of thing, outside and within, with the gradient of what is outside."""
    collision, rng = SelfCollision(balls, obstacles=scene_of(thing).obstacles(balls)), np.random.default_rng(4)
    within = outside = 0
    for _ in range(30):
        q = balls.random_configuration(rng)
        links = [f"link{i}" for i in range(5)]
        centres = np.array([(balls.pose(q, link) @ [0.1, 0.0, 0.0, 1.0])[:3] for link in links])
        exact = dict(zip(links, signed_distance(thing, centres) - RADIUS, strict=True))
        seen = {on: x for (on, name), x in min_distances(collision.closer_than(q, 10.0)).items() if name == thing.name}
        assert seen.keys() == exact.keys()
        for link, distance in exact.items():
            if distance > 0.0:
                assert seen[link] == pytest.approx(distance, abs=1e-6)
                outside += 1
            else:  # overlaps of round shapes have an approximate depth
                assert seen[link] <= 0.0
                within += 1
        near, every = collision.nearest(q), sorted(p.distance for p in collision.closer_than(q, 10.0))
        assert near.distance == pytest.approx(every[0], abs=1e-12)
        in_range = [distance for distance in every if distance <= 0.1]
        assert sorted(p.distance for p in collision.closer_than(q, 0.1)) == pytest.approx(in_range, abs=1e-9)
        if near.links[1] == thing.name and near.distance > 1e-3:
            expected = central_difference(lambda x: collision.nearest(x).distance, balls, q)
            assert np.linalg.norm(near.gradient - expected) < 1e-5
    assert outside > 50 and within > 1


def test_which_links_meet_which_things(robot_of):
    """Every link that moves meets every thing, though it touches there; but for the base and what it stands on."""
    panda, ur5 = robot_of("panda"), robot_of("ur5")
    everywhere = ml.Scene(boxes=[ml.Box((3.0, 3.0, 3.0), (0.0, 0.0, 1.52), "everywhere")])
    collision = SelfCollision(panda, obstacles=everywhere.obstacles(panda))
    met = {p.links[0] for p in collision.closer_than(panda.neutral(), 0.0) if p.links[1] == "everywhere"}
    assert met == {s.link for s in collision_shapes(panda) if s.joint}
    assert collision.link_pairs == SelfCollision(panda).link_pairs
    # on a table, and on a floor: the link of the first joint may touch them, and the second may not
    low = [ml.Box((2.0, 2.0, 0.1), (0.0, 0.0, -0.05), "table"), ml.Box((2.0, 2.0, 0.1), (0.0, 0.0, -0.1), "shelf")]
    obstacles = {o.name: o.may_touch for o in ml.Scene(floor=0.0, boxes=low).obstacles(ur5)}
    assert {"shoulder_link", "base_link"} <= obstacles["floor"] == obstacles["table"]
    assert "upper_arm_link" not in obstacles["floor"] and not obstacles["shelf"]


SCENE = ml.Scene(
    floor=-0.02,
    boxes=[ml.Box((0.5, 0.4, 0.3), (0.6, 0.0, 0.3, 0.1, 0.2, 0.3), "table")],
    spheres=[ml.Sphere(0.1, (0.0, 0.5, 0.5), "ball")],
    cylinders=[ml.Cylinder(0.1, 0.5, pose((0.2, 0.1, 0.0)), "post"), ml.Cylinder(0.1, 0.5, (0.9, 0.1, 0.0), "can")],
    meshes=[mesh_of("lidless", (0.5, 0.5, 0.0))],
    handled="table",
)


def test_scenes_are_data(tmp_path):
    """Equal where all of it is, said in one line, saved and loaded; meshes in files beside a scene are found there."""
    said = "Scene: floor at -0.02 m, 1 box (table), 1 sphere (ball), 2 cylinders (post, can), 1 mesh (lidless)"
    assert repr(SCENE) == said
    assert ml.Scene.load(SCENE.save(tmp_path / "a" / "scene.json")) == SCENE
    assert hash(ml.Scene.load(tmp_path / "a" / "scene.json")) == hash(SCENE) and SCENE.handled == ("table",)
    said = "mesh 'lidless' has 4 open edges: it counts as a surface, and the space behind it as free"
    assert SCENE.notes == (said,)
    SOURCES["ell"].export(tmp_path / "ell.stl")
    mesh = {"name": "ell", "source": "ell.stl", "scale": [2.0, 1.0, -1.0], "pose": [0.0, 0.0, 1.0]}
    (tmp_path / "meshes.json").write_text(json.dumps({"meshes": [mesh]}), encoding="utf-8")
    found = ml.Scene.load(tmp_path / "meshes.json")
    assert ml.Scene.load(found.save(tmp_path / "a" / "again.json")) == found and found.notes == ()
    shape = trimesh.Trimesh(*found.meshes[0].shape[:2])
    assert shape.volume == pytest.approx(2.0 * SOURCES["ell"].volume, rel=1e-5)
    moved = ml.Scene(floor=-0.02, boxes=[ml.Box((0.5, 0.4, 0.3), (0.6, 0.0, 0.3), "table")])
    assert moved != ml.Scene(floor=-0.02, boxes=[ml.Box((0.5, 0.4, 0.3), (0.6, 0.0, 0.31), "table")])


def test_descriptions_as_scenes(tmp_path):
    """URDF and MJCF, of what can be touched and by its names; a joint that moves is named."""
    SOURCES["ell"].export(tmp_path / "ell.stl")

    def load(name, text):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return ml.Scene.load(tmp_path / name)

    cabinet, room = ((DATA / name).read_text(encoding="utf-8") for name in ("cabinet.urdf", "room.xml"))
    scene = load("room.urdf", cabinet)
    assert repr(scene) == "Scene: 1 box (cabinet), 1 sphere (cabinet 2), 1 cylinder (rod), 1 mesh (lamp)"
    np.testing.assert_allclose(scene.boxes[0].pose, pose((0.5, 0.0, 0.4), (0.0, 0.0, 1.0)), atol=1e-12)
    np.testing.assert_allclose(scene.spheres[0].pose[:3, 3], [0.5, 0.0, 0.3], atol=1e-12)
    assert np.ptp(scene.meshes[0].shape.vertices, axis=0) == pytest.approx([0.1, 0.04, 0.12], abs=1e-6)
    scene = load("room.xml", room)
    assert repr(scene) == "Scene: 2 boxes (ground, desk), 1 cylinder (rack)"
    ground, desk = scene.boxes
    assert ground.pose[2, 3] + 0.5 * ground.shape.size[2] == pytest.approx(-0.1) and desk.shape.size == (1.0, 0.8, 0.04)
    np.testing.assert_allclose(scene.cylinders[0].pose[:3, 3], [1.0, 0.1, 0.0], atol=1e-12)
    assert scene.cylinders[0].shape.size == pytest.approx((0.05, 0.3))
    for name, text, error, words in (
        (
            "room.urdf",
            cabinet.replace('lamp_joint" type="fixed', 'lamp_joint" type="floating'),
            SceneError,
            "lamp_joint.*fix",
        ),
        ("room.xml", room.replace("</body>", '<joint name="hinge"/></body>'), SceneError, "hinge.*fix"),
        (
            "hills.xml",
            room.replace("</body>", '<geom type="hfield" hfield="hills"/></body>'),
            RobotError,
            "'hfield' is not supported",
        ),
    ):
        with pytest.raises(error, match=f"{name}.*{words}"):
            load(name, text)


@pytest.mark.parametrize(("made", "error", "sentence", "content"), rows_in("bad_scenes.txt"))
def test_impossible_things_and_bad_files(made, error, sentence, content, tmp_path, robot_of):
    """One sentence says which thing, what was seen, and what is wanted; of a file its name, the entry and the nearest
    known key.
    """
    path, lists = tmp_path / "room.json", {kind.__name__: field for kind, field in FIELDS.items()}
    if made != path.name:
        with pytest.raises(getattr(errors, error), match=sentence):
            getattr(ml, made)(**json.loads(content))
        content = f'{{"{lists[made]}": [{content}]}}' if made in lists else content
    path.write_text(content, encoding="utf-8")
    with pytest.raises(getattr(errors, error), match=sentence) as seen:
        ml.Scene.load(path, robot_of("panda"))
    assert "room.json" in str(seen.value)


def test_names_and_files_that_are_not_there(tmp_path):
    """A ball among the boxes is named with its kind, a file by its name."""
    with pytest.raises(SceneError, match="boxes hold Sphere"):
        ml.Scene(boxes=[THINGS[1]])
    with pytest.raises(RobotError, match=r"none\.json.*no such file"):
        ml.Scene.load(tmp_path / "none.json")


# ---- of links from each other ----


def test_which_pairs_count(robot_of):
    """Neighbours are left out, and links that cannot touch; hand and base count. Neutral postures are free."""
    pairs = {frozenset(p) for p in SelfCollision(robot_of("panda")).link_pairs}
    assert frozenset(("panda_link1", "panda_hand")) in pairs and frozenset(("panda_link0", "panda_link6")) in pairs
    assert not pairs & {frozenset((f"panda_link{i}", f"panda_link{i + 1}")) for i in range(7)}
    assert frozenset(("panda_link2", "panda_link4")) not in pairs  # a knee that cannot close that far
    for name, shapes in (("panda", "collision"), ("sawyer", "visual"), ("planar3", "visual")):
        assert SelfCollision(robot_of(name), shapes=shapes).nearest(robot_of(name).neutral()).distance > 0.0


@pytest.mark.parametrize(("name", "hulls"), [("panda", True), ("panda", False), ("ur5", True)])
def test_clear_is_what_is_not_closer(robot_of, name, hulls):
    """`is_clear` and `closer_than` draw one line, to ten micrometres on both sides of every distance; among things of
    every kind, and with the last link in a body that is not convex, too.
    """
    robot, rng, seen, answers = robot_of(name), np.random.default_rng(11), 0, []
    things = scene_of(*THINGS, floor=-0.5).obstacles(robot) if name == "ur5" else ()
    collision, ell = SelfCollision(robot, hulls=hulls, obstacles=things), THINGS[4]
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
    ball = f'<sphere radius="{0.5 * (nearest + deep)}"/>'
    shapes = {"base": shape(ball, "0.4 0 0"), "link1": shape(ball), "link3": shape('<sphere radius="0.001"/>')}
    pairs = SelfCollision(chain_with(tmp_path, joints, shapes)).link_pairs
    assert (("base", "link1") in pairs) is counts and ("base", "link3") in pairs


FLAT = [("revolute", "0 0 1", "0.4 0 0", "0 0 0")] * 3


SHEET = trimesh.creation.box((0.2, 0.1, 0.0), trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))).export


@pytest.mark.parametrize("tag", ["collision", "visual"])
@pytest.mark.parametrize(("elements", "stands_there", "why"), [row[1:] for row in rows_in("bad_shapes.txt")])
def test_a_bad_shape_costs_its_own_link_only(tmp_path, tag, elements, stands_there, why):
    """A sheet is a thin body of its size; what cannot be used is replaced by a plain shape, and plans and replays say
    so in one sentence. The other links count as they are, and nobody claims that the robot has no shapes.
    """
    files = {"sheet": SHEET(file_type="stl"), "large": stl(value=300.0), "larger": stl(value=400.0)}
    for name, content in files.items():
        (tmp_path / f"{name}.stl").write_bytes(content)
    shapes = dict.fromkeys(("base", "link0", "link2"), shape('<box size="0.1 0.1 0.1"/>', tag=tag))
    shapes["link1"] = "".join(shape(element, tag=tag) for element in elements.split(", "))
    robot = chain_with(tmp_path, FLAT, shapes)
    shapes = collision_shapes(robot, tag)
    assert [type(s.geometry).__name__ for s in shapes if s.link == "link1"] == [stands_there]
    cubes = {s.link for s in shapes if isinstance(s.shape, Solid) and s.shape.size == (0.1, 0.1, 0.1)}
    assert cubes == {"base", "link0", "link2"}
    planned = Clearance(robot, True, Surroundings(), robot.positions(robot.neutral())).notes
    drawn = list(appearance(robot).notes)
    assert len(planned) == bool(why)
    assert all(note.startswith("Plain shapes stand in for link1: ") and why in note for note in planned)
    assert tag == "collision" or drawn == planned
    said = f"collision checks use {3 + (not why)} shapes of <{tag}> elements"
    assert describe_shapes(robot) == said + "; plain shapes stand in for link1" * bool(why)


def test_robots_without_shapes(robot_of, tmp_path):
    """One error says what is missing and what can take its place; broken shapes are named with their link."""
    with pytest.raises(RobotError, match="shapes='visual'") as seen:
        SelfCollision(robot_of("sawyer"))
    assert seen.value.code == "no-collision-shapes"
    with pytest.raises(RobotError, match="no <collision> elements"):
        SelfCollision(robot_of("gantry"))
    for kind, message in (('<sphere radius="-1"/>', "link2"), ('<mesh filename="nowhere.stl"/>', "nowhere.stl")):
        with pytest.raises(RobotError, match=message):
            SelfCollision(chain_with(tmp_path, FLAT, {"link2": shape(kind)}))
