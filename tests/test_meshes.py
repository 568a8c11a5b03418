"""Mesh files, found inside the robot's folders only and examined before they are parsed, and shapes to draw."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from case import case, rows_in
from peak_memory import peak_megabytes
from urdf_corpus import DAE, OBJ, edited, stl

from manip_learn.errors import RobotError
from manip_learn.robot.description.catalogue import example_package_dir, example_robots
from manip_learn.robot.loading import load_robot
from manip_learn.robot.visuals.meshes import GREY, Mesh, find_mesh, mesh_roots, read_meshes
from manip_learn.robot.visuals.visual_shapes import Solid, resolve_meshes, visual_shapes

# ---- Mesh files: found inside the robot's folders only, examined before they are parsed ----


@pytest.fixture(autouse=True)
def no_ros(monkeypatch):
    """A machine without ROS."""
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)


def write(path: Path, content: bytes = b"") -> Path:
    """A file and its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content or stl())
    return path


@pytest.fixture
def urdf(tmp_path):
    """A URDF in the usual place in a package."""
    return write(tmp_path / "ws" / "arm_description" / "urdf" / "arm.urdf", b"<robot/>")


@pytest.mark.parametrize("variable", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH", None])
def test_packages_are_found_where_ros_keeps_them(urdf, tmp_path, monkeypatch, variable):
    """ROS 1 and ROS 2 search paths, and folders that the caller gives, or the package itself; these come first."""
    share = tmp_path / "prefix" / ("share" if variable == "AMENT_PREFIX_PATH" else "")
    if variable is not None:
        monkeypatch.setenv(variable, os.pathsep.join([str(tmp_path / "empty"), str(tmp_path / "prefix")]))
    write(urdf.parents[1] / "meshes" / "a.stl")
    for name in ("hand_description", "arm_description"):
        found = write(share / name / "meshes" / "a.stl").resolve()
        for given in ([],) if variable else ([share], [share / name]):
            if variable is None or name == "hand_description":
                assert find_mesh(f"package://{name}/meshes/a.stl", mesh_roots(urdf, given)) == found


def test_meshes_are_found_in_the_folders_of_the_robot_only(urdf, tmp_path):
    """However an address is written and whatever links lead out of the folder, with the reason."""
    package = urdf.parents[1]
    write(urdf.parent / "b.stl")
    write(package / "meshes" / "a.stl")
    for folder in ("other", "tools/nested", "branch-main"):
        name = folder.split("/")[-1].split("-")[0]
        write(package.parent / folder / "meshes" / "a.stl")
        write(package.parent / folder / "package.xml", f"<package><name>{name}</name></package>".encode())
    write(package.with_name("secret") / "a.stl")
    write(package / "package.xml", b"<package format='2'><name>renamed</name></package>")
    for link, target in {
        "meshes/good.stl": "a.stl",
        "meshes/circle.stl": "circle.stl",
        "meshes/out.stl": "/etc/passwd",
        "meshes/device.stl": "/dev/zero",
        "linked": package.with_name("secret"),
    }.items():
        (package / link).symlink_to(target)
    for address, expected in [*rows_in("mesh_addresses.txt"), ("a" * 5000 + ".stl", "mesh-missing")]:
        with case(address):
            try:
                seen = str(find_mesh(address, mesh_roots(urdf, [])).relative_to(package.parent.resolve()))
            except RobotError as error:
                seen = error.code
                assert seen != "mesh-outside" or "package_dirs" in str(error)
            assert seen == expected
    given = mesh_roots(urdf, [package.with_name("secret")])
    assert find_mesh("../linked/a.stl", given) == (package.with_name("secret") / "a.stl").resolve()


def doubling_nodes() -> bytes:
    """A COLLADA scene in which a node is used 2^40 times."""
    nodes = '<node id="n0"><instance_geometry url="#g"/></node>'
    nodes += "".join(f'<node id="n{i}">{f"""<instance_node url="#n{i - 1}"/>""" * 2}</node>' for i in range(1, 41))
    text = DAE.decode().replace("<library_visual", f"<library_nodes>{nodes}</library_nodes><library_visual")
    return text.replace("<node><instance_geometry", '<node><instance_node url="#n40"/><instance_geometry').encode()


FACET = b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
IMAGE = b'<library_images><image id="i"><init_from>../../other/skin.png</init_from></image></library_images>'
CONTENTS = [  # file, content, number of triangles or the code of the refusal
    ("a.stl", stl(5), 5),
    ("a.stl", b"solid s\n" + FACET + b"endsolid s\n", 1),
    ("a.obj", b"mtllib /etc/passwd\n" + OBJ, 1),
    ("a.dae", DAE, 1),
    ("a.dae", DAE.replace(b"mesh>", b"convex_mesh>"), 1),
    ("a.dae", DAE.replace(b"<library_g", IMAGE + b"<library_g"), 1),
    ("a.stl", b"", "mesh-content"),
    ("a.stl", stl(1, 0xFFFFFFFF), "mesh-content"),
    ("a.stl", stl(0), "mesh-content"),
    ("a.obj", b"\x7fELF" + bytes(500), "mesh-content"),
    ("a.dae", DAE.replace(b"?>", b'?><!DOCTYPE x SYSTEM "file:///x">'), "mesh-content"),
    ("a.dae", DAE.replace(b'"9">0 0 0 1 0 0 0 1 0', b'"0">').replace(b'"3" stride', b'"0" stride'), "mesh-content"),
    ("a.dae", DAE + b"<instance_node " * 5000, "mesh-parser"),
    ("a.dae", doubling_nodes(), "mesh-parser"),
    ("a.glb", b"glTF" + bytes(16), "mesh-kind"),
    ("a", stl(), "mesh-kind"),
]


@pytest.mark.timeout(60)
def test_what_a_file_holds_is_checked_before_it_is_unpacked(tmp_path):
    """Every format gives the same triangle, and no file beside it is opened; what claims more than it has, says another
    thing than its name or is cut is refused, its neighbour is read.
    """
    os.mkfifo(tmp_path / "a.mtl")  # would hang
    good, before = write(tmp_path / "good.stl"), peak_megabytes()
    for name, content, expected in CONTENTS:
        with case(name, content[:80], expected):
            path = tmp_path / name
            path.write_bytes(content)
            answers = read_meshes([path, good])
            assert isinstance(answers[good], Mesh)
            mesh = answers[path]
            if not isinstance(mesh, Mesh):
                assert mesh.code == expected
                continue
            assert len(mesh.faces) == expected
            assert {tuple(v) for v in mesh.vertices[mesh.faces[0]]} == {(0, 0, 0), (1, 0, 0), (0, 1, 0)}
    assert peak_megabytes() - before < 200.0


def test_no_vertex_is_nan(tmp_path):
    """A file with such a vertex is refused, or read without it by older versions of the parser."""
    path = write(tmp_path / "a.stl", stl(value=float("nan")))
    mesh = read_meshes([path])[path]
    assert np.isfinite(mesh.vertices).all() if isinstance(mesh, Mesh) else mesh.code == "mesh-content"


PAINTED = """<library_effects><effect id="e{0}"><profile_COMMON><technique sid="t"><lambert>
<diffuse>{1}</diffuse></lambert></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m{0}">
<instance_effect url="#e{0}"/></material></library_materials>"""
BOUND = """<node><translate>{1} 0 0</translate><instance_geometry url="#g"><bind_material><technique_common>
<instance_material symbol="s" target="#m{0}"/></technique_common></bind_material></instance_geometry></node>"""


def painted(diffuse: str, *places: int) -> bytes:
    """A COLLADA triangle at places along x [m], all but the first of another colour."""
    text = DAE.decode().replace('<triangles count="1">', '<triangles count="1" material="s">')
    library = PAINTED.format(1, diffuse) + PAINTED.format(2, "<color>0 0 1 1</color>")
    library = library.replace("</library_effects><library_materials>", "</library_effects>\n<library_materials>")
    parts = "".join(BOUND.format(min(i, 1) + 1, x) for i, x in enumerate(places))
    text = text.replace("<library_geometries>", library + "<library_geometries>")
    return text.replace('<node><instance_geometry url="#g"/></node>', parts).encode()


def test_each_part_of_a_mesh_has_its_colour(tmp_path):
    """Every part is where its node places it, in its colour, and a part without one in grey; the fourth number is not
    believed, others end at 0 and 1. Where no part has a colour, the mesh has none.
    """
    red, blue = (1.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)
    for diffuse, places, colours in (
        ("<color>2 0.5 -0.2 0.1</color>", (0,), {0: (1.0, 0.5, 0.0, 1.0)}),
        ("<color>1 0 0</color>", (0, 5, 9), {0: red, 5: blue, 9: blue}),
        ("<color>nan 0 0 1</color>", (0,), None),
        ('<texture texture="gone" texcoord="t"/>', (0, 5), {0: GREY, 5: blue}),
    ):
        path = write(tmp_path / "a.dae", painted(diffuse, *places))
        mesh = read_meshes([path])[path]
        with case(diffuse, places):
            assert isinstance(mesh, Mesh), mesh
            assert sorted(set(mesh.vertices[:, 0])) == sorted({x + step for x in places for step in (0, 1)})
            if colours is None:
                assert mesh.colours is None
                continue
            seen = {int(mesh.vertices[f[0], 0]): tuple(c) for f, c in zip(mesh.faces, mesh.colours, strict=True)}
            assert seen == colours


def test_too_large_files_and_pipes_are_not_read(tmp_path):
    """The cap is on the size of the file, before reading; a pipe does not hang."""
    with (large := tmp_path / "a.stl").open("wb") as file:
        file.truncate(51_000_000)
    os.mkfifo(pipe := tmp_path / "b.stl")
    codes = {path: error.code for path, error in read_meshes([large, pipe]).items() if isinstance(error, RobotError)}
    assert codes == {large: "mesh-size", pipe: "mesh-kind"}


# ---- Shapes to draw: where the file puts them, or why there are none ----


def arm_with(tmp_path, visuals: str, head: str = ""):
    """The two-joint arm with something on its tip."""
    path = tmp_path / "urdf" / "arm.urdf"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(edited(('<link name="tip"/>', f'<link name="tip">{visuals}</link>'), ("<link", f"{head}<link")))
    return load_robot(path)


SHAPES = [  # element, what it says of its colour, what is drawn, in which colour
    ('<box size="1 2 3"/>', '<material name="red"/>', Solid("box", (1, 2, 3)), (1, 0, 0, 1)),
    ('<sphere radius="0.5"/>', '<color rgba="0 1 0 0.5"/>', Solid("sphere", (0.5,)), (0, 1, 0, 0.5)),
    ('<cylinder radius="0.1" length="2"/>', '<color rgba="9 -1 0 1"/>', Solid("cylinder", (0.1, 2)), (1, 0, 0, 1)),
    ('<capsule radius="0.1" length="2"/>', '<material name="unknown"/>', Solid("capsule", (0.1, 2)), None),
]


@pytest.mark.parametrize(("element", "paint", "shape", "colour"), SHAPES)
def test_shapes_sizes_and_colours(element, paint, shape, colour, tmp_path):
    """All primitives, colours given in place, by name, out of range, or not at all."""
    paint = paint if "material" in paint else f'<material name="x">{paint}</material>'
    red = '<material name="red"><color rgba="1 0 0 1"/></material>'
    (drawn,) = visual_shapes(arm_with(tmp_path, f"<visual><geometry>{element}</geometry>{paint}</visual>", red))
    assert (drawn.shape, drawn.link) == (shape, "tip") and drawn.colour == (colour or (*drawn.colour[:3], 1))


@pytest.mark.parametrize("name", ["panda", "xarm7", "talos_arm"])
def test_shapes_are_where_pinocchio_has_them(name):
    """Joint and placement agree with Pinocchio's own geometry reader."""
    robot = load_robot(name)
    model = robot.pinocchio_model
    path, folders = str(example_robots()[name]), [str(example_package_dir())]
    geometry = pin.buildGeomFromUrdf(model, path, pin.GeometryType.VISUAL, package_dirs=folders)
    theirs = sorted((g.parentJoint, *g.placement.homogeneous.round(6).ravel()) for g in geometry.geometryObjects)
    visuals = visual_shapes(robot)
    ours = sorted((v.joint, *v.placement.round(6).ravel()) for v in visuals)
    np.testing.assert_allclose(ours, theirs, atol=2e-6)
    assert not any(v.fault for v in visuals)


def test_scale_and_mirror(tmp_path):
    """Scale is applied to the vertices; a mirrored mesh keeps its outside outside."""
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "a.stl").write_bytes(stl())
    mesh = '<visual><geometry><mesh filename="../meshes/a.stl" scale="{}"/></geometry></visual>'
    robot = arm_with(tmp_path, mesh.format("2 3 4") + mesh.format("-2 3 4"))
    for shape, corner in zip(visual_shapes(robot), (2, -2), strict=True):
        a, b, c = shape.shape.vertices[shape.shape.faces[0]]
        assert np.cross(b - a, c - a)[2] > 0.0
        assert {tuple(vertex) for vertex in (a, b, c)} == {(0, 0, 0), (corner, 0, 0), (0, 3, 0)}


@pytest.mark.parametrize(
    ("geometry", "words"),
    [(None, "geometry"), ("<cone/>", "cone"), ('<box size="nan 1 1"/>', "finite"), ('<mesh filename=""/>', "file"),
     ('<mesh filename="."/>', "extension"), ('<mesh filename="package://gone/a.stl"/>', "package_dirs")],
)  # fmt: skip
def test_what_cannot_be_drawn_has_a_fault(geometry, words, tmp_path):
    """No geometry, an unknown shape, a size that is not finite, no address: the link is there, with the reason,
    which is told once.
    """
    visual = "<visual/>" if geometry is None else f"<visual><geometry>{geometry}</geometry></visual>"
    robot = arm_with(tmp_path, visual * (1 + ("gone" in visual)))
    (shape,) = visual_shapes(robot)
    assert shape.shape is None and shape.link == "tip" and words in shape.fault
    if "gone" in visual:
        found, missing = resolve_meshes(robot)
        assert list(missing) == ["package://gone/a.stl"] and not found
