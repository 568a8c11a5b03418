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
from manip_learn.robot.visuals.meshes import find_mesh, mesh_roots, read_meshes


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
def urdf(tmp_path) -> Path:
    """A URDF in the usual place in a package."""
    return write(tmp_path / "ws" / "arm_description" / "urdf" / "arm.urdf", b"<robot/>")


@pytest.mark.parametrize("variable", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH", None])
def test_packages_are_found_where_ros_keeps_them(urdf, tmp_path, monkeypatch, variable):
    """ROS 1 and ROS 2 search paths, and folders that the caller gives."""
    share = tmp_path / "prefix" / ("share" if variable == "AMENT_PREFIX_PATH" else "")
    mesh = write(share / "hand_description" / "meshes" / "a.stl")
    given = []
    if variable is None:
        given = [share]
    else:
        monkeypatch.setenv(variable, os.pathsep.join([str(tmp_path / "empty"), str(tmp_path / "prefix")]))
    assert find_mesh("package://hand_description/meshes/a.stl", mesh_roots(urdf, given)) == mesh.resolve()


def test_a_given_folder_may_be_the_package_itself(urdf, tmp_path):
    """People pass the package as often as the folder above it."""
    mesh = write(tmp_path / "elsewhere" / "hand_description" / "meshes" / "a.stl")
    roots = mesh_roots(urdf, [tmp_path / "elsewhere" / "hand_description"])
    assert find_mesh("package://hand_description/meshes/a.stl", roots) == mesh.resolve()


def test_own_package_needs_no_search_path(urdf):
    """The folder above the URDF is the package, under its name or that of its package.xml."""
    mesh = write(urdf.parents[1] / "meshes" / "a.stl")
    assert find_mesh("package://arm_description/meshes/a.stl", mesh_roots(urdf, [])) == mesh.resolve()
    write(urdf.parents[1] / "package.xml", b"<package format='2'><name>other_name</name></package>")
    assert find_mesh("package://other_name/meshes/a.stl", mesh_roots(urdf, [])) == mesh.resolve()


def test_given_folders_come_first(urdf, tmp_path):
    """An explicit folder beats what lies around."""
    write(urdf.parents[1] / "meshes" / "a.stl")
    mine = write(tmp_path / "mine" / "arm_description" / "meshes" / "a.stl")
    roots = mesh_roots(urdf, [tmp_path / "mine"])
    assert find_mesh("package://arm_description/meshes/a.stl", roots) == mine.resolve()


def test_nothing_outside_is_found(urdf, tmp_path):
    """However the path is written, a file outside the robot's folders is not used, and the reason is given."""
    for uri in [
        "../../../secret.stl",
        "package://arm_description/../../secret.stl",
        "package://arm_description/meshes/../../../secret.stl",
        "{tmp}/secret.stl",
        "file://{tmp}/secret.stl",
        "package://arm_description/%2E%2E/%2E%2E/secret.stl",
        "..\\..\\..\\secret.stl",
    ]:
        with case(uri):
            write(urdf.parents[1] / "meshes" / "a.stl")
            write(tmp_path / "secret.stl")
            with pytest.raises(RobotError, match="package_dirs") as caught:
                find_mesh(uri.format(tmp=tmp_path), mesh_roots(urdf, []))
            assert caught.value.code == "mesh-outside"


def test_links_are_followed_before_judging(urdf, tmp_path):
    """A symbolic link out is refused; a link inside, and a link into a given folder, are fine."""
    write(tmp_path / "outside" / "a.stl")
    inside = write(urdf.parents[1] / "meshes" / "real.stl")
    (urdf.parents[1] / "meshes" / "good.stl").symlink_to("real.stl")
    (urdf.parents[1] / "meshes" / "out.stl").symlink_to(tmp_path / "outside" / "a.stl")
    (urdf.parents[1] / "linked").symlink_to(tmp_path / "outside")
    roots = mesh_roots(urdf, [])
    assert find_mesh("../meshes/good.stl", roots) == inside.resolve()
    for uri in ("../meshes/out.stl", "../linked/a.stl", "package://arm_description/linked/a.stl"):
        with pytest.raises(RobotError) as caught:
            find_mesh(uri, roots)
        assert caught.value.code == "mesh-outside"
    assert find_mesh("../linked/a.stl", mesh_roots(urdf, [tmp_path / "outside"])).name == "a.stl"


def test_folders_above_are_no_packages_by_themselves(urdf, tmp_path):
    """`package://etc/...` does not lead to /etc, nor to any neighbour that is no package."""
    write(tmp_path / "ws" / "private" / "a.stl")
    with pytest.raises(RobotError) as caught:
        find_mesh("package://private/a.stl", mesh_roots(urdf, []))
    assert caught.value.code == "mesh-missing"
    write(tmp_path / "ws" / "private" / "package.xml", b"<package><name>private</name></package>")
    assert find_mesh("package://private/a.stl", mesh_roots(urdf, [])).name == "a.stl"


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.stl", stl(5)), ("a.obj", OBJ), ("a.dae", dae())],
)
def test_formats_become_triangles(tmp_path, name, content):
    """Every format gives the same triangle."""
    path = write(tmp_path / name, content)
    mesh = read_meshes([path])[path]
    assert not isinstance(mesh, RobotError)
    vertices, faces = mesh.vertices, mesh.faces
    corners = {tuple(v) for v in vertices[faces[0]]}
    assert corners == {(0, 0, 0), (1, 0, 0), (0, 1, 0)}
    assert len(faces) == (5 if name == "a.stl" else 1)


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


def test_the_colour_of_a_mesh_is_that_of_most_triangles(tmp_path):
    """Every part is where its node places it; the fourth number is not believed, others end at 0 and 1."""
    for diffuse, places, colour in (
        ("<color>2 0.5 -0.2 0.1</color>", (0,), (1.0, 0.5, 0.0, 1.0)),
        ("<color>1 0 0</color>", (0, 5, 9), (0.0, 0.0, 1.0, 1.0)),
        ("<color>1 red 0</color>", (0,), None),
        ("<color>nan 0 0 1</color>", (0,), None),
        ('<texture texture="gone" texcoord="t"/>', (0,), None),
    ):
        path = write(tmp_path / "a.dae", painted(diffuse, *places))
        mesh = read_meshes([path])[path]
        with case(diffuse):
            assert not isinstance(mesh, RobotError), mesh
            assert mesh.colour == colour
            assert sorted(set(mesh.vertices[:, 0])) == sorted({x + step for x in places for step in (0, 1)})


def doubling_nodes() -> bytes:
    """A COLLADA scene in which a node is used 2^40 times."""
    nodes = '<node id="n0"><instance_geometry url="#g"/></node>'
    nodes += "".join(f'<node id="n{i}">{f"""<instance_node url="#n{i - 1}"/>""" * 2}</node>' for i in range(1, 41))
    text = dae().decode().replace("<library_visual", f"<library_nodes>{nodes}</library_nodes><library_visual")
    return text.replace("<node><instance_geometry", '<node><instance_node url="#n40"/><instance_geometry').encode()


BOMBS = {
    "nodes.dae": doubling_nodes(),
    "few.stl": bytes(80) + (10**9).to_bytes(4, "little") + bytes(50),
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_that_claims_much_is_refused(tmp_path, name):
    """What a file says it unpacks to is checked before it is unpacked; its neighbours are read."""
    bomb, good = write(tmp_path / name, BOMBS[name]), write(tmp_path / "good.stl")
    before = peak_megabytes()
    answers = read_meshes([bomb, good])
    assert isinstance(answers[bomb], RobotError) and answers[bomb].code in ("mesh-content", "mesh-parser")
    assert not isinstance(answers[good], RobotError)
    assert peak_megabytes() - before < 200.0


def test_too_large_files_and_pipes_are_not_read(tmp_path):
    """The cap is on the size of the file, before reading; a pipe does not hang."""
    with (large := tmp_path / "a.stl").open("wb") as file:
        file.truncate(51_000_000)
    os.mkfifo(pipe := tmp_path / "b.stl")
    codes = {path: error.code for path, error in read_meshes([large, pipe]).items() if isinstance(error, RobotError)}
    assert codes == {large: "mesh-size", pipe: "mesh-kind"}


def test_materials_beside_a_mesh_are_not_opened(tmp_path):
    """A file that names materials is read, and nothing but that file."""
    os.mkfifo(tmp_path / "a.mtl")  # would hang
    path = write(tmp_path / "a.obj", b"mtllib a.mtl\nusemtl x\n" + OBJ)
    mesh = read_meshes([path])[path]
    assert not isinstance(mesh, RobotError)
    np.testing.assert_array_equal(np.sort(mesh.vertices.ravel()), [0] * 7 + [1, 1])
