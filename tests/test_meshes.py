"""Mesh files: found inside the robot's folders only, examined before they are parsed."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from case import case
from peak_memory import peak_megabytes
from urdf_corpus import OBJ, dae, stl

from manip_learn.errors import RobotError
from manip_learn.robot.visuals.meshes import GREY, Mesh, by_colour, find_mesh, mesh_roots, read_meshes


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


# address -> what is found, below the workspace, or the code of the refusal
PATHS = {
    "b.stl": "arm_description/urdf/b.stl",
    "../meshes/a.stl": "arm_description/meshes/a.stl",
    "..\\meshes\\a.stl": "arm_description/meshes/a.stl",
    "package://arm_description/meshes/a.stl": "arm_description/meshes/a.stl",
    "package://renamed/meshes/a.stl": "arm_description/meshes/a.stl",
    "package://arm_description/meshes/a%2Estl": "arm_description/meshes/a.stl",
    "package://other/meshes/a.stl": "other/meshes/a.stl",
    "package://nested/meshes/a.stl": "tools/nested/meshes/a.stl",
    "package://branch/meshes/a.stl": "branch-main/meshes/a.stl",
    "../meshes/good.stl": "arm_description/meshes/a.stl",
    "package://secret/a.stl": "mesh-missing",
    "package://etc/passwd": "mesh-missing",
    "package:///a.stl": "mesh-missing",
    "../meshes/b.stl": "mesh-missing",
    "../meshes/circle.stl": "mesh-missing",
    "a" * 5000 + ".stl": "mesh-missing",
    "../../secret/a.stl": "mesh-outside",
    "package://arm_description/../secret/a.stl": "mesh-outside",
    "package://arm_description/meshes/../../secret/a.stl": "mesh-outside",
    "package://arm_description/%2E%2E/secret/a.stl": "mesh-outside",
    "..\\..\\secret\\a.stl": "mesh-outside",
    "/etc/passwd": "mesh-outside",
    "file:///etc/passwd": "mesh-outside",
    "../meshes/out.stl": "mesh-outside",
    "../meshes/device.stl": "mesh-outside",
    "../linked/a.stl": "mesh-outside",
    "package://arm_description/linked/a.stl": "mesh-outside",
    "http://localhost/a.stl": "mesh-scheme",
}


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
    for address, expected in PATHS.items():
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
    text = dae().decode().replace("<library_visual", f"<library_nodes>{nodes}</library_nodes><library_visual")
    return text.replace("<node><instance_geometry", '<node><instance_node url="#n40"/><instance_geometry').encode()


FACET = b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
CONTENTS = [  # file, content, number of triangles or the code of the refusal
    ("a.stl", stl(5), 5),
    ("a.stl", b"solid s\n" + FACET + b"endsolid s\n", 1),
    ("a.obj", b"mtllib a.mtl\nusemtl x\n" + OBJ, 1),
    ("a.obj", b"mtllib /etc/passwd\n" + OBJ, 1),
    ("a.dae", dae(), 1),
    ("a.dae", dae().replace(b"mesh>", b"convex_mesh>"), 1),
    ("a.dae", dae("skin.png"), 1),
    ("a.dae", dae("../../other/skin.png"), 1),
    ("a.dae", dae("file:///C:/Users/me/skin.png"), 1),
    ("a.stl", b"", "mesh-content"),
    ("a.stl", stl()[:-3], "mesh-content"),
    ("a.stl", stl(1, 0xFFFFFFFF), "mesh-content"),
    ("a.stl", stl(0), "mesh-content"),
    ("a.obj", b"\x7fELF" + bytes(500), "mesh-content"),
    ("a.dae", dae(head='<!DOCTYPE x SYSTEM "file:///x">'), "mesh-content"),
    ("a.dae", dae(positions=""), "mesh-content"),
    ("a.dae", dae()[:700], "mesh-parser"),
    ("a.dae", dae() + b"<instance_node " * 5000, "mesh-parser"),
    ("a.dae", doubling_nodes(), "mesh-parser"),
    ("a.glb", b"glTF" + bytes(16), "mesh-kind"),
    ("a.exe", b"MZ", "mesh-kind"),
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
    text = dae().decode().replace('<triangles count="1">', '<triangles count="1" material="s">')
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
        ("<color>1 red 0</color>", (0,), None),
        ("<color>nan 0 0 1</color>", (0,), None),
        ('<texture texture="gone" texcoord="t"/>', (0,), None),
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
            parts = {tuple(colour): sorted(part.vertices[part.faces[:, 0], 0]) for colour, part in by_colour(mesh)}
            assert parts == {c: [x for x in places if colours[x] == c] for c in set(colours.values())}


def test_colours_in_an_obj_file_and_too_many(tmp_path):
    """Colours of vertices are in the file itself; a material of another file is not opened. Of more colours than can be
    drawn one by one a mesh has none.
    """
    path = write(tmp_path / "a.obj", b"mtllib b.mtl\nusemtl m\nv 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n")
    os.mkfifo(tmp_path / "b.mtl")  # would hang
    np.testing.assert_array_equal(read_meshes([path])[path].colours, [(1.0, 0.0, 0.0, 1.0)])
    path.write_bytes(b"mtllib b.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    assert read_meshes([path])[path].colours is None
    text = painted("<color>1 0 0</color>", 0).decode()
    library = "".join(PAINTED.format(n, f"<color>0 {n / 99} 0</color>") for n in range(3, 99))
    nodes = "".join(BOUND.format(n, n) for n in range(3, 99))
    path = write(tmp_path / "a.dae", text.replace("<library_geometries>", library + "<library_geometries>").encode())
    path.write_text(path.read_text().replace("</visual_scene>", f"{nodes}</visual_scene>"), encoding="utf-8")
    mesh = read_meshes([path])[path]
    assert len(mesh.faces) == 97 and mesh.colours is None


def test_too_large_files_and_pipes_are_not_read(tmp_path):
    """The cap is on the size of the file, before reading; a pipe does not hang."""
    with (large := tmp_path / "a.stl").open("wb") as file:
        file.truncate(51_000_000)
    os.mkfifo(pipe := tmp_path / "b.stl")
    codes = {path: error.code for path, error in read_meshes([large, pipe]).items() if isinstance(error, RobotError)}
    assert codes == {large: "mesh-size", pipe: "mesh-kind"}
