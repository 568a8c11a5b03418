"""Mesh files: found inside the robot's folders only, parsed in a process of limited resources."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from case import case
from urdf_corpus_meshes import OBJ, dae, glb, gltf, stl

from manip_learn.errors import RobotError
from manip_learn.robot.limited_child import START_SECONDS, LimitedChild
from manip_learn.robot.visuals import meshes
from manip_learn.robot.visuals.meshes import checked_mesh, find_mesh, mesh_roots, read_meshes


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
    [("a.stl", stl(5)), ("a.obj", OBJ), ("a.dae", dae()), ("a.glb", glb(gltf()))],
)
def test_formats_become_triangles(tmp_path, name, content):
    """Every format gives the same triangle."""
    path = write(tmp_path / name, content)
    vertices, faces = read_meshes([path])[path]
    corners = {tuple(v) for v in vertices[faces[0]]}
    assert corners == {(0, 0, 0), (1, 0, 0), (0, 1, 0)}
    assert len(faces) == (5 if name == "a.stl" else 1)


def test_too_large_files_are_not_read(tmp_path):
    """The cap is on the size of the file, before reading."""
    path = tmp_path / "a.stl"
    with path.open("wb") as file:
        file.truncate(51_000_000)
    with pytest.raises(RobotError) as caught:
        checked_mesh(path)
    assert caught.value.code == "mesh-size"


def test_a_pipe_does_not_hang(tmp_path):
    """A mesh that is a pipe is refused at once."""
    path = tmp_path / "a.stl"
    os.mkfifo(path)
    with pytest.raises(RobotError) as caught:
        checked_mesh(path)
    assert caught.value.code == "mesh-kind"


CHILD = """
import os, time
def prepared():
    def answer(job):
        content = open(job["input"], "rb").read()
        if b"hang" in content: time.sleep(60)
        while b"busy" in content: pass
        if b"crash" in content: os.abort()
        return {"fault": f"parsed {sorted(os.listdir(os.path.dirname(job['input'])))}"}
    return answer
"""


@pytest.mark.timeout(50)  # the hanging parser sleeps for 60 s
@pytest.mark.parametrize(("word", "code"), [("hang", "mesh-time"), ("busy", "mesh-time"), ("crash", "mesh-parser")])
def test_a_mesh_that_kills_its_parser_harms_no_other(tmp_path, monkeypatch, word, code):
    """A hang or a crash is that mesh's fault only: the next one gets a new parser."""
    script = tmp_path / "child.py"
    script.write_text(CHILD, encoding="utf-8")
    monkeypatch.setattr(meshes, "CHILD", script)
    bad = write(tmp_path / "bad.obj", f"# {word}\nv 0 0 0\n".encode())
    good = write(tmp_path / "good.obj", OBJ)
    answers = read_meshes([bad, good], seconds=1.0)
    assert isinstance(answers[bad], RobotError) and answers[bad].code == code
    assert "parsed" in str(answers[good])


def test_the_real_child_limits_its_memory(tmp_path):
    """A mesh that wants more memory than allowed fails alone; this one has a node graph that doubles 40 times."""
    nodes = "".join(f'<node id="n{i}">{f"<instance_node url=&quot;#n{i - 1}&quot;/>" * 2}</node>' for i in range(1, 41))
    content = dae().replace(
        b"<library_visual_scenes>", f"<library_nodes>{nodes}</library_nodes>".encode() + b"<library_visual_scenes>"
    )
    content = content.replace(b"<node><instance_geometry", b'<node><instance_node url="#n40"/><instance_geometry')
    content = content.replace(b"&quot;", b'"').replace(
        b'<node id="n1">', b'<node id="n0"><instance_geometry url="#g"/></node><node id="n1">'
    )
    path, good = write(tmp_path / "bomb.dae", content), write(tmp_path / "good.stl")
    answers = read_meshes([path, good], seconds=4.0)
    assert isinstance(answers[path], RobotError) and answers[path].code in ("mesh-parser", "mesh-time")
    assert not isinstance(answers[good], RobotError)


def test_the_limits_are_real():
    """After limiting itself, the child cannot have a gigabyte, and its processor time ends."""
    script = (
        "import resource, sys; from manip_learn.robot.limited_child import limit_self; limit_self(512_000_000, 60)\n"
        "assert resource.getrlimit(resource.RLIMIT_CPU)[0] <= 60\n"
        "try: bytearray(1_000_000_000)\n"
        "except MemoryError: sys.exit(7)\n"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 7


def test_a_child_has_the_time_and_the_memory_that_it_was_given(tmp_path):
    """Its processor time is that of its jobs and its start together; a job that takes longer than asked ends it."""
    task = write(
        tmp_path / "task.py",
        b"import resource, time\n"
        b"def prepared():\n"
        b"    def answer(job):\n"
        b"        time.sleep(job['sleep'])\n"
        b"        while time.process_time() < job.get('busy', 0.0): pass\n"
        b"        limits = {'cpu': resource.RLIMIT_CPU, 'as': resource.RLIMIT_AS}\n"
        b"        return {name: resource.getrlimit(kind)[0] for name, kind in limits.items()}\n"
        b"    return answer\n",
    )
    child = LimitedChild(task, memory=700_000_000, seconds=11, folder=tmp_path)
    try:
        assert child.ask({"sleep": 0.0}, 99.0) == {"cpu": 11 + START_SECONDS, "as": 700_000_000} and not child.is_lost
        assert child.ask({"sleep": 0.5}, 0.1)["cpu"] <= 2  # a job that waits is not one that computes
        with pytest.raises(TimeoutError, match="more than 0.2 s"):
            child.ask({"sleep": 30.0}, 0.2)
        assert child.is_lost
    finally:
        child.close()
    busy = LimitedChild(task, memory=700_000_000, seconds=11, folder=tmp_path)
    with pytest.raises(TimeoutError, match="more than 1 s"):
        busy.ask({"sleep": 0.0, "busy": 60.0}, 1.0)
    busy.close()


def test_side_files_cannot_be_reached(tmp_path, monkeypatch):
    """The parser sees a copy that is alone in its folder; a file that names materials is still read."""
    write(tmp_path / "a.mtl", b"newmtl x\n")
    path = write(tmp_path / "a.obj", b"mtllib a.mtl\n" + OBJ)
    vertices, _ = read_meshes([path])[path]
    np.testing.assert_array_equal(np.sort(vertices.ravel()), [0] * 7 + [1, 1])
    script = tmp_path / "child.py"
    script.write_text(CHILD, encoding="utf-8")
    monkeypatch.setattr(meshes, "CHILD", script)
    assert "parsed ['mesh.obj']" in str(read_meshes([path])[path])


def test_no_meshes_no_process(monkeypatch):
    """Nothing is started for nothing."""
    monkeypatch.setattr(meshes, "LimitedChild", None)
    assert read_meshes([]) == {}


def test_colours_of_meshes_have_three_or_four_numbers():
    """Each from 0 to 1; the fourth is not believed; other counts and what is no number are no colour."""
    assert meshes._rgba(b"1 0.5 -0.2") == meshes._rgba(b"2 0.5 0 0.1") == (1.0, 0.5, 0.0, 1.0)
    for other in (b"", b"1", b"1 0", b"1 0 0 1 1", b"1 0 0 1 1 1", b"1 red 0", b"nan 0 0"):
        assert meshes._rgba(other) is None
