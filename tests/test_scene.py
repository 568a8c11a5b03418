"""What stands around an arm: its data and files, and distances of links from it against computations of their own."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
import trimesh
from case import case
from conftest import chain_urdf
from test_gradients import central_difference

import manip_learn as ml
from manip_learn.errors import RobotError, SceneError, UnknownNameError
from manip_learn.robot.collision import SelfCollision, collision_shapes
from manip_learn.robot.loading import load_robot
from manip_learn.robot.rotations import rotation_matrix

ARMS = {"ur5": "collision", "panda": "collision", "sawyer": "visual"}
RADIUS = 0.05  # [m] of the balls of the `balls` arm
POINTS = 2000  # on each link


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


def surface(shape):
    """Points on a link's shape, in its own frame, all its corners among them."""
    g = shape.geometry
    kind = type(g).__name__
    if kind == "Box":
        body = trimesh.creation.box(2.0 * g.halfSide)
    elif kind == "Sphere":
        body = trimesh.creation.icosphere(4, g.radius)
    elif kind == "Cylinder":
        body = trimesh.creation.cylinder(g.radius, 2.0 * g.halfLength, sections=64)
    elif kind == "Capsule":
        body = trimesh.creation.capsule(2.0 * g.halfLength, g.radius)
    else:
        body = trimesh.convex.convex_hull(np.array([g.point(i) for i in range(g.num_points)]))
    return np.concatenate([body.vertices, body.sample(POINTS, seed=0)]), float(np.sqrt(body.area / POINTS))


@pytest.mark.parametrize("name", ["panda", "sawyer", "gantry"])
def test_arms_among_things(robot_of, name):
    """Links of real arms, by points on their surfaces: never nearer than computed, and seldom much farther."""
    robot, tag = robot_of(name), ARMS.get(name, "links")
    things = [thing for thing in THINGS if thing.name in ("box", "sphere", "cylinder", "ell")]
    scene, rng = scene_of(*things, floor=-0.05), np.random.default_rng(6)
    collision = SelfCollision(robot, shapes=tag, obstacles=scene.obstacles(robot))
    shapes = [(shape, *surface(shape)) for shape in collision_shapes(robot, tag) if shape.joint]
    parents, compared, touching = robot.pinocchio_model.parents, 0, 0
    solids = {thing.name: lambda x, t=thing: signed_distance(t, x) for thing in things}
    solids["floor"] = lambda x: x[:, 2] + 0.05
    for _ in range(6):
        q = robot.random_configuration(rng)
        seen, exact = min_distances(collision.closer_than(q, 10.0)), {}
        for shape, on, gap in shapes:
            placed = placed_points(robot, q, shape, on)
            for thing, distance in solids.items():
                if thing != "floor" or parents[shape.joint] != 0:
                    before = exact.get((shape.link, thing), (np.inf, 0.0))
                    exact[shape.link, thing] = min(before, (float(distance(placed).min()), gap))
        for pair, (sampled, gap) in exact.items():
            with case(name, pair, sampled):
                if sampled > 0.0 and seen[pair] > 0.0:
                    assert sampled - 2.0 * gap < seen[pair] < sampled + 1e-3  # circles of 64 corners
                else:
                    assert seen[pair] < 2e-3 and sampled < 2.0 * gap
                compared, touching = compared + 1, touching + (seen[pair] <= 0.0)
    assert compared > 100 and 0 < touching < compared


def placed_points(robot, q, shape, points):
    """Return points on a link's shape, in the world frame."""
    of_link = robot.pinocchio_model.frames[robot.frame(shape.link).index].placement.homogeneous
    carrier = robot.pose(q, shape.link) @ np.linalg.inv(of_link) @ shape.placement
    return points @ carrier[:3, :3].T + carrier[:3, 3]


@pytest.mark.parametrize("name", ["balls", "panda", "sawyer"])
def test_clear_is_what_is_not_close(robot_of, balls, name):
    """`is_clear` answers as `closer_than` does, among things of every kind, also with the last link in a beam."""
    robot = balls if name == "balls" else robot_of(name)
    scene, rng, answers = scene_of(*THINGS, floor=-0.5), np.random.default_rng(12), []
    collision = SelfCollision(robot, shapes=ARMS.get(name, "collision"), obstacles=scene.obstacles(robot))
    ell = next(thing for thing in THINGS if thing.name == "ell")
    for _ in range(30):
        q = robot.random_configuration(rng)
        about = ml.Mesh(ell.source, pose(robot.pose(q, robot.frame_names[-1])[:3, 3]), "ell")
        inside = collision.with_obstacles(scene_of(about).obstacles(robot))
        for pairs, distance in ((collision, 0.0), (collision, 0.005), (collision, 0.03), (inside, 0.0)):
            close = pairs.closer_than(q, distance)
            at_limit = any(abs(pair.distance - distance) < 1e-6 for pair in pairs.closer_than(q, 0.04))
            assert at_limit or pairs.is_clear(q, distance) == (not close)
            answers.append(not close)
    assert 0.05 < np.mean(answers) < 0.95


@pytest.mark.parametrize("name", ["ur5", "sawyer"])
def test_floor_under_arms(robot_of, name):
    """The lowest corner of each link decides, to a nanometre; what the first joint carries may touch the floor."""
    robot, tag, rng = robot_of(name), ARMS[name], np.random.default_rng(8)
    moving = [s for s in collision_shapes(robot, tag) if s.joint and robot.pinocchio_model.parents[s.joint] != 0]
    hulls = [s for s in moving if type(s.geometry).__name__ in ("Convex", "Box")]
    collision = SelfCollision(robot, shapes=tag, obstacles=ml.Scene(floor=-5.0).obstacles(robot))
    for _ in range(5):
        q = robot.random_configuration(rng)
        near = collision.closer_than(q, 20.0)
        touched = {p.links[0] for p in near if p.links[1] == "floor"}
        assert touched == {s.link for s in moving}
        for shape in hulls:
            lowest = float(placed_points(robot, q, shape, surface(shape)[0])[:, 2].min()) + 5.0
            found = [p.distance for p in near if p.links == (shape.link, "floor")]
            assert min(found) <= lowest + 1e-9 and np.min(np.abs(np.array(found) - lowest)) < 1e-9


def test_which_links_meet_which_things(robot_of):
    """Every link that moves meets every thing, though it touches there; but for the base and what it stands on."""
    panda, ur5 = robot_of("panda"), robot_of("ur5")
    q = panda.neutral()
    everywhere = ml.Box((3.0, 3.0, 3.0), (0.0, 0.0, 1.52), "everywhere")
    collision = SelfCollision(panda, obstacles=ml.Scene(boxes=[everywhere]).obstacles(panda))
    met = {p.links[0] for p in collision.closer_than(q, 0.0) if p.links[1] == "everywhere"}
    assert (
        met == {s.link for s in collision_shapes(panda) if s.joint}
        and collision.link_pairs == SelfCollision(panda).link_pairs
    )
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
    with pytest.raises(RobotError, match="no <collision> elements"):
        SelfCollision(robot)
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
    urdf, mjcf = tmp_path / "room.urdf", tmp_path / "room.xml"
    urdf.write_text(CABINET.replace("TYPE", "fixed"), encoding="utf-8")
    scene = ml.Scene.load(urdf)
    assert repr(scene) == "Scene: 1 box (cabinet), 1 sphere (cabinet 2), 1 cylinder (rod), 1 mesh (lamp)"
    np.testing.assert_allclose(scene.boxes[0].pose, pose((0.5, 0.0, 0.4), (0.0, 0.0, 1.0)), atol=1e-12)
    np.testing.assert_allclose(scene.spheres[0].pose[:3, 3], [0.5, 0.0, 0.3], atol=1e-12)
    assert np.ptp(scene.meshes[0].shape.vertices, axis=0) == pytest.approx([0.1, 0.04, 0.12], abs=1e-6)
    mjcf.write_text(ROOM.replace("JOINT", ""), encoding="utf-8")
    scene = ml.Scene.load(mjcf)
    assert repr(scene) == "Scene: 2 boxes (ground, desk), 1 cylinder (rack)"
    ground, desk = scene.boxes
    assert ground.pose[2, 3] + 0.5 * ground.shape.size[2] == pytest.approx(-0.1) and desk.shape.size == (1.0, 0.8, 0.04)
    np.testing.assert_allclose(scene.cylinders[0].pose[:3, 3], [1.0, 0.1, 0.0], atol=1e-12)
    assert scene.cylinders[0].shape.size == pytest.approx((0.05, 0.3))
    urdf.write_text(CABINET.replace("TYPE", "floating"), encoding="utf-8")
    mjcf.write_text(ROOM.replace("JOINT", '<joint name="hinge"/>'), encoding="utf-8")
    hilly = tmp_path / "hills.xml"
    hilly.write_text(ROOM.replace("JOINT", '<geom type="hfield" hfield="hills"/>'), encoding="utf-8")
    for path, words in ((urdf, "lamp_joint.*fix"), (mjcf, "hinge.*fix"), (hilly, "'hfield' is not read")):
        with pytest.raises(RobotError if path == hilly else SceneError, match=f"{path.name}.*{words}"):
            ml.Scene.load(path)


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
    (lambda: ml.Scene(-700), "floor is -700; a height of at most 10 m"),
]


def test_impossible_things():
    """One sentence says which thing, what was seen, and what is wanted."""
    for number, (make, sentence) in enumerate(BAD_THINGS):
        with case(number, sentence), pytest.raises(SceneError, match=sentence):
            make()
    with pytest.raises(UnknownNameError, match="'boks'.*did you mean 'box'"):
        ml.Scene(boxes=[THINGS[0]], handled="boks")


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


def test_bad_files(tmp_path, robot_of):
    """The sentence names the file, the entry and the nearest known key."""
    path = tmp_path / "room.json"
    for text, error, sentence in BAD_FILES:
        path.write_text(text, encoding="utf-8")
        with case(text), pytest.raises(error, match=sentence) as seen:
            ml.Scene.load(path, robot_of("panda"))
        assert "room.json" in str(seen.value)
    with pytest.raises(RobotError, match="no such file"):
        ml.Scene.load(tmp_path / "none.json")
