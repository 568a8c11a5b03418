"""What stands around an arm: its data and files, and distances of links from it against computations of their own."""

from __future__ import annotations

import json
import pickle
from itertools import product

import numpy as np
import pytest
import trimesh
from conftest import chain_urdf
from test_gradients import central_difference

import manip_learn as ml
from manip_learn.errors import RobotError, SceneError, UnknownNameError
from manip_learn.robot.collision import SelfCollision, collision_shapes
from manip_learn.robot.loading import load_robot
from manip_learn.robot.rotations import rotation_matrix

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
    "ico": trimesh.creation.icosphere(2, 0.25),
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
    mesh_of("ico", (0.5, 0.4, 0.3), (0.3, 0.1, 0.2)),
    mesh_of("table", (0.6, -0.3, 0.4), (0.0, 0.1, 0.5)),
    mesh_of("ell", (0.5, 0.4, 0.1), (0.2, 0.1, 0.4)),
    mesh_of("lidless", (0.5, 0.4, 0.2), (0.1, 0.3, 0.4)),
]
FIELDS = {ml.Box: "boxes", ml.Sphere: "spheres", ml.Cylinder: "cylinders", ml.Mesh: "meshes"}


def scene_of(*things, **others):
    lists = {field: [t for t in things if type(t) is kind] for kind, field in FIELDS.items()}
    return ml.Scene(**lists, **others)


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    """An arm of five joints with a ball at the end of each link but the base."""
    joints = [("revolute", axis, "0.3 0.05 0.1", "0 0 0") for axis in ("0 0 1", "0 1 0", "1 0 0", "0 1 0", "0 0 1")]
    text = chain_urdf("balls", joints)
    for i in range(5):
        ball = f'<collision><origin xyz="0.1 0 0"/><geometry><sphere radius="{RADIUS}"/></geometry></collision>'
        text = text.replace(f'<link name="link{i}">', f'<link name="link{i}">{ball}')
    path = tmp_path_factory.mktemp("balls") / "balls.urdf"
    path.write_text(text, encoding="utf-8")
    return load_robot(path)


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
        near = collision.nearest(q)
        assert near.distance == pytest.approx(min(p.distance for p in collision.closer_than(q, 10.0)), abs=1e-12)
        if near.links[1] == thing.name and near.distance > 1e-3:
            expected = central_difference(lambda x: collision.nearest(x).distance, balls, q)
            assert np.linalg.norm(near.gradient - expected) < 1e-5
    assert outside > 50 and within > 1


@pytest.mark.parametrize(("name", "tag"), [("ur5", "collision"), ("sawyer", "visual")])
def test_floor_under_arms(robot_of, name, tag):
    """The lowest corner of each link decides, to a nanometre; what the first joint carries may touch the floor."""
    robot, rng = robot_of(name), np.random.default_rng(8)
    moving = [s for s in collision_shapes(robot, tag) if s.joint and robot.pinocchio_model.parents[s.joint] != 0]
    hulls = [s for s in moving if type(s.geometry).__name__ in ("Convex", "Box")]
    collision = SelfCollision(robot, shapes=tag, obstacles=ml.Scene(floor=-5.0).obstacles(robot))
    assert len(hulls) > 1
    for _ in range(5):
        q = robot.random_configuration(rng)
        near = collision.closer_than(q, 20.0)
        assert {p.links[0] for p in near if p.links[1] == "floor"} == {s.link for s in moving}
        for shape in hulls:
            g, signs = shape.geometry, np.array(list(product((-1.0, 1.0), repeat=3)))
            is_box = type(g).__name__ == "Box"
            corners = signs * g.halfSide if is_box else np.array([g.point(i) for i in range(g.num_points)])
            of_link = robot.pinocchio_model.frames[robot.frame(shape.link).index].placement.homogeneous
            carrier = robot.pose(q, shape.link) @ np.linalg.inv(of_link) @ shape.placement
            lowest = float((corners @ carrier[2, :3] + carrier[2, 3]).min()) + 5.0
            found = [p.distance for p in near if p.links == (shape.link, "floor")]
            assert min(found) <= lowest + 1e-9 and np.min(np.abs(np.array(found) - lowest)) < 1e-9


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


def test_other_obstacles(balls):
    """The same links among other things give what a new computation gives; copies too."""
    box, sphere, cylinder, *_ = THINGS
    first, among = SelfCollision(balls, obstacles=scene_of(sphere).obstacles(balls)), scene_of(box, cylinder)
    new, others = SelfCollision(balls, obstacles=among.obstacles(balls)), first.with_obstacles(among.obstacles(balls))
    computed = (new, others, pickle.loads(pickle.dumps(others)))
    wanted, *got = ([(p.links, p.distance) for p in x.closer_than(balls.neutral(), 1.0)] for x in computed)
    assert wanted and got == [wanted, wanted]


@pytest.mark.parametrize("name", ["gantry", "wrist", "tree"])
def test_capsules_of_robots_without_shapes(robot_of, name):
    """The axis of a capsule leads to each joint that its link carries; at rest no link touches another."""
    robot = robot_of(name)
    model, capsules = robot.pinocchio_model, collision_shapes(robot, "links")
    for joint in range(2, model.njoints):
        gaps = []
        for capsule in (c for c in capsules if c.joint == model.parents[joint]):
            at = model.jointPlacements[joint].translation - capsule.placement[:3, 3]
            x, y, z = at @ capsule.placement[:3, :3]
            gaps.append(np.hypot(np.hypot(x, y), max(abs(z) - capsule.geometry.halfLength, 0.0)))
        assert min(gaps) < 1e-9, model.names[joint]
    assert SelfCollision(robot, shapes="links").closer_than(robot.neutral(), 0.0) == []


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
    assert repr(ml.Scene()) == "Scene: nothing" and ml.Scene() == ml.Scene() != SCENE and SCENE != 3
    assert ml.Scene.load(SCENE.save(tmp_path / "a" / "scene.json")) == SCENE
    assert hash(ml.Scene.load(tmp_path / "a" / "scene.json")) == hash(SCENE) and SCENE.handled == ("table",)
    assert [thing.name for thing in SCENE.solids] == ["table", "ball", "post", "can", "lidless"]
    assert [np.shape(thing.pose) for thing in SCENE.solids] == [(4, 4)] * 5
    said = "mesh 'lidless' has 4 open edges: where it is open it counts as a surface, and what is behind it as free"
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


FIXED = (
    '<joint name="{0}_joint" type="{1}"><parent link="world"/><child link="{0}"/><origin xyz="0.5 0 0.3" rpy="0 0 1"/>'
)
CABINET = (
    '<robot name="room"><link name="world"/><link name="cabinet"><collision><origin xyz="0 0 0.1"/><geometry>'
    '<box size="1 0.5 0.2"/></geometry></collision><collision name="rod"><geometry><cylinder radius="0.1" '
    'length="0.5"/></geometry></collision><collision><geometry><sphere radius="0.1"/></geometry></collision>'
    '<visual><geometry><box size="9 9 9"/></geometry></visual></link><link name="lamp"><visual><geometry>'
    '<mesh filename="ell.stl" scale="0.1 0.1 0.1"/></geometry></visual></link>'
    f"{FIXED.format('cabinet', 'fixed')}</joint>{FIXED.format('lamp', 'TYPE')}</joint></robot>"
)
ROOM = (
    '<mujoco><default><geom rgba="1 0 0 1"/></default><worldbody><light pos="0 0 3"/><geom name="ground" type="plane" '
    'pos="0 0 -0.1" size="0 0 1"/><geom name="desk" type="box" size="0.5 0.4 0.02" pos="0.6 0 0.3" group="3"/>'
    '<body name="rack" pos="1 0 0" euler="0 0 90"><geom type="capsule" size="0.05" fromto="0 0 0 0.2 0 0"/>'
    '<geom type="sphere" size="0.1" contype="0" conaffinity="0"/>JOINT</body></worldbody></mujoco>'
)


def test_descriptions_as_scenes(tmp_path):
    """URDF and MJCF, of what can be touched and by its names; a joint that moves is named."""
    SOURCES["ell"].export(tmp_path / "ell.stl")

    def load(name, text):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return ml.Scene.load(tmp_path / name)

    scene = load("room.urdf", CABINET.replace("TYPE", "fixed"))
    assert repr(scene) == "Scene: 1 box (cabinet), 1 sphere (cabinet 2), 1 cylinder (rod), 1 mesh (lamp)"
    np.testing.assert_allclose(scene.boxes[0].pose, pose((0.5, 0.0, 0.4), (0.0, 0.0, 1.0)), atol=1e-12)
    np.testing.assert_allclose(scene.spheres[0].pose[:3, 3], [0.5, 0.0, 0.3], atol=1e-12)
    assert np.ptp(scene.meshes[0].shape.vertices, axis=0) == pytest.approx([0.1, 0.04, 0.12], abs=1e-6)
    scene = load("room.xml", ROOM.replace("JOINT", ""))
    assert repr(scene) == "Scene: 2 boxes (ground, desk), 1 cylinder (rack)"
    ground, desk = scene.boxes
    assert ground.pose[2, 3] + 0.5 * ground.shape.size[2] == pytest.approx(-0.1) and desk.shape.size == (1.0, 0.8, 0.04)
    np.testing.assert_allclose(scene.cylinders[0].pose[:3, 3], [1.0, 0.1, 0.0], atol=1e-12)
    assert scene.cylinders[0].shape.size == pytest.approx((0.05, 0.3))
    hills = ROOM.replace("JOINT", '<geom type="hfield" hfield="hills"/>')
    for name, text, error, words in (
        ("room.urdf", CABINET.replace("TYPE", "floating"), SceneError, "lamp_joint.*fix"),
        ("room.xml", ROOM.replace("JOINT", '<joint name="hinge"/>'), SceneError, "hinge.*fix"),
        ("hills.xml", hills, RobotError, "'hfield' is not read"),
    ):
        with pytest.raises(error, match=f"{name}.*{words}"):
            load(name, text)


ONE = ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
BAD_THINGS = [
    (lambda: ml.Box((1, -0.6, 1), (0, 0, 0), "a"), r"box 'a'.*size is \(1, -0.6, 1\).*three positive numbers"),
    (lambda: ml.Box((1, 1), (0, 0, 0), "a"), "three positive numbers"),
    (lambda: ml.Box("big", (0, 0, 0), "a"), "size is 'big'"),
    (lambda: ml.Box((800, 600, 40), (0, 0, 0), "a"), "size is 800 m.*millimetres"),
    (lambda: ml.Box((1, 1, 1), (600, 0, 0), "a"), "place is 600 m.*millimetres"),
    (lambda: ml.Box((1, 1, 1), (0, 0), "a"), r"place is \(0, 0\).*4 x 4"),
    (lambda: ml.Box((1, 1, 1), 2.0 * np.eye(4), "a"), "not rigid, by 3"),
    (lambda: ml.Box((1, 1, 1), np.diag([1.0, 1.0, -1.0, 1.0]), "a"), "pose mirrors"),
    (lambda: ml.Box((1, 1, 1), (0, 0, np.nan), "a"), "place is"),
    (lambda: ml.Box((1, 1, 1), (0, 0, 0), " "), "a name is expected"),
    (lambda: ml.Sphere(0, (0, 0, 0), "a"), "sphere 'a': its radius is 0; a positive number"),
    (lambda: ml.Sphere(1, (0, 0), "a"), "sphere 'a': its place"),
    (lambda: ml.Cylinder(0.1, np.inf, (0, 0, 0), "a"), "cylinder 'a': its length is inf"),
    (lambda: ml.Mesh("nowhere.stl", (0, 0, 0), "a"), "mesh 'a'.*nowhere.stl.*check the path"),
    (lambda: ml.Mesh((ONE[0], [[0, 1, 3]]), (0, 0, 0), "a"), "make no mesh"),
    (lambda: ml.Mesh((ONE[0], []), (0, 0, 0), "a"), "make no mesh"),
    (lambda: ml.Mesh(([[0, 0, np.inf], *ONE[0]], ONE[1]), (0, 0, 0), "a"), "make no mesh"),
    (lambda: ml.Mesh(ONE, (0, 0, 0), "a", 0.0), "scale is 0.0"),
    (lambda: ml.Mesh(ONE, (0, 0, 0), "a", 1000.0), "size is 1000 m.*millimetres.*scale=0.001"),
    (lambda: ml.Scene(boxes=[THINGS[0], THINGS[0]]), "2 things are called 'box'.*rename"),
    (lambda: ml.Scene(0.0, boxes=[ml.Box((1, 1, 1), (0, 0, 0), "floor")]), "2 things are called 'floor'"),
    (lambda: ml.Scene(boxes=[THINGS[1]]), "boxes hold Sphere"),
    (lambda: ml.Scene(np.nan), "floor is nan"),
    (lambda: ml.Scene(boxes=[THINGS[0]], handled="boks"), "'boks'.*did you mean 'box'"),
    (lambda: ml.Scene(-700), "floor is -700; a height of at most 10 m"),
]


@pytest.mark.parametrize(("make", "sentence"), BAD_THINGS)
def test_impossible_things(make, sentence):
    """One sentence says which thing, what was seen, and what is wanted."""
    with pytest.raises(SceneError if "mean" not in sentence else UnknownNameError, match=sentence):
        make()


BAD_FILES = [
    ("", SceneError, "empty"),
    ("{", SceneError, "no scene"),
    ("[]", SceneError, "in braces"),
    ('{"flor": 0}', UnknownNameError, "'flor'.*did you mean 'floor'"),
    ('{"boxes": 3}', SceneError, "no scene"),
    ('{"boxes": [3]}', SceneError, r"boxes\[0\] is 3"),
    ('{"boxes": [{"name": "a", "size": [1, 1, 1]}]}', SceneError, r"boxes\[0\] lacks key 'pose'"),
    ('{"boxes": [{"name": "a", "size": [1, 1, 1], "poes": [0, 0, 0]}]}', UnknownNameError, "'poes'.*'pose'"),
    ('{"boxes": [{"name": "a", "size": [1, 1, -1], "pose": [0, 0, 0]}]}', SceneError, "room.json: box 'a'"),
    ('{"boxes": [{"name": "a", "size": [19, 1, 1], "pose": [0, 0, 0]}]}', SceneError, "19 m large.*reaches.*milli"),
    ('{"meshes": [{"name": "a", "source": "a.stl", "pose": [0, 0, 0]}]}', SceneError, "room.json: mesh 'a'.*a.stl"),
    ("<robot", RobotError, "XML"),
]


@pytest.mark.parametrize(("text", "error", "sentence"), BAD_FILES)
def test_bad_files(text, error, sentence, tmp_path, robot_of):
    """The sentence names the file, the entry and the nearest known key."""
    (tmp_path / "room.json").write_text(text, encoding="utf-8")
    with pytest.raises(error, match=sentence) as seen:
        ml.Scene.load(tmp_path / "room.json", robot_of("panda"))
    assert "room.json" in str(seen.value)
    with pytest.raises(RobotError, match="no such file"):
        ml.Scene.load(tmp_path / "none.json")
