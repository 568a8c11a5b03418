"""From a name or a file to a robot."""

from __future__ import annotations

import importlib.metadata
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from case import case, rows_in
from rounding import rounding
from urdf_corpus import ARM, edited

from manip_learn.errors import MissingExtraError, RobotError, UnknownNameError
from manip_learn.robot.description import catalogue, xacro_expansion
from manip_learn.robot.description.catalogue import example_robots, find_robot, robot_names
from manip_learn.robot.loading import load_robot

PANDA_FINGERS = ("panda_finger_joint1", "panda_finger_joint2")


@pytest.fixture
def arm(tmp_path) -> Path:
    """A two-joint arm in a file."""
    path = tmp_path / "arm.urdf"
    path.write_text(ARM, encoding="utf-8")
    return path


def test_a_path_is_a_path(arm, tmp_path, monkeypatch):
    """Path objects, relative names with a suffix, and existing files without one; a folder does not hide a name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robotfile").write_text(ARM, encoding="utf-8")
    assert load_robot("arm.urdf").joint_names == load_robot("robotfile").joint_names == ("shoulder", "elbow")
    (tmp_path / "planar3").mkdir()
    assert load_robot("planar3").nv == 3


# what lies there -> code and words of the refusal
REFUSED = [
    ("gone.urdf", lambda path: None, "missing", "no such file"),
    ("folder/", lambda path: path.mkdir() or (path / "arm.urdf").write_text(ARM), "not-a-file", r"arm\.urdf"),
    ("pipe.urdf", os.mkfifo, "not-a-file", ""),
    ("circle.urdf", lambda path: path.symlink_to("circle.urdf"), "unreadable", ""),
    ("large.urdf", lambda path: path.write_bytes(bytes(10_000_001)), "file-too-large", ""),
    ("arm.xacro", lambda path: path.write_text(ARM), "xacro", "xacro=True"),
    ("  ", None, None, "no robot is named"),
    ("~nobody-of-this-name/arm.urdf", None, None, "write the path out"),
    ("a\0b.urdf", None, None, "not a usable path"),
]


@pytest.mark.parametrize(("name", "make", "code", "words"), REFUSED)
def test_what_is_no_description_is_refused(name, make, code, words, tmp_path, arm):
    """Missing files, folders (the error lists what is in them), pipes, devices, circles and huge files are not read."""
    if make is not None:
        make(tmp_path / name)
        name = f"{tmp_path}/{name}"
    with pytest.raises(RobotError, match=words or None) as caught:
        load_robot(name)
    assert code in (None, caught.value.code)


def test_without_the_data_package(monkeypatch):
    """Without example-robot-data its robots name the extra, and the shipped ones still load."""

    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    with monkeypatch.context() as patch:
        patch.setattr(catalogue.importlib.metadata, "distribution", missing)
        example_robots.cache_clear()
        with pytest.raises(MissingExtraError, match=r"manip_learn\[robots\]"):
            find_robot("panda")
        assert load_robot("planar3").nv == 3
        assert robot_names() == ("fr3", "planar3", "sawyer", "ur10e", "ur5e")
    example_robots.cache_clear()


XMLNS = 'xmlns:xacro="http://www.ros.org/wiki/xacro" '
XACRO_ARM = ARM.replace("<robot ", f"<robot {XMLNS}")
PART = f'<robot {XMLNS} name="part">'
XACRO = f'<robot {XMLNS} name="r"><xacro:arg name="kind" default="six"/>' + (
    '<link name="a"/><link name="$(arg kind)"/><joint name="j" type="revolute"><parent link="a"/>'
    '<child link="$(arg kind)"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
)


@pytest.fixture
def fetching(tmp_path, monkeypatch) -> Path:
    """A stand-in for robot_descriptions, whose modules fetch a robot when they are imported."""
    package = tmp_path / "robot_descriptions"
    package.mkdir()
    (tmp_path / "git").mkdir()
    (tmp_path / "git" / "exc.py").write_text("class GitError(Exception): pass\n")
    (package / "arm.urdf").write_text(ARM)
    (package / "six.urdf.xacro").write_text(XACRO)
    paths = f"print('Cloning')\nREPOSITORY_PATH = {str(package)!r}\n"
    six = f"XACRO_PATH = {str(package / 'six.urdf.xacro')!r}\nXACRO_ARGS = {{'kind': 'tip'}}\n"
    for name, text in {
        "__init__": "",
        "_cache": "raise RuntimeError",
        "own_description": f"{paths}URDF_PATH = {str(package / 'arm.urdf')!r}\n",
        "own_mj_description": "raise RuntimeError",
        "xarm6_description": paths + six,
        "offline_description": "from git.exc import GitError\nraise GitError('could not resolve host')\n",
    }.items():
        (package / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(catalogue.VARIANTS, "lite6", ("xarm6", {"kind": "lite"}))
    catalogue.fetched_names.cache_clear()
    yield package
    monkeypatch.undo()
    catalogue.fetched_names.cache_clear()
    for name in [n for n in sys.modules if n.partition(".")[0] in ("robot_descriptions", "git")]:
        del sys.modules[name]


def test_robots_are_fetched_by_name(fetching, capsys):
    """A URDF as it is, a xacro file expanded once with its arguments; each is known by its name again; nothing but
    what was asked for is fetched, and standard output stays clean.
    """
    assert catalogue.fetched_names() == {"own", "xarm6", "lite6", "offline"} <= set(robot_names())
    assert load_robot("own").joint_names == ("shoulder", "elbow")
    for name, tip in (("xarm6", "tip"), ("lite6", "lite"), ("xArm-6", "tip")):
        robot = load_robot(name)
        assert tip in robot.frame_names and catalogue.known_as(robot.source) == name.lower().replace("-", "")
    (fetching / "six.urdf.xacro").unlink()  # not expanded again
    assert "lite" in load_robot("lite6").frame_names and capsys.readouterr().out == ""


def test_a_robot_that_cannot_be_fetched(fetching, monkeypatch):
    """One sentence says that the net is needed once; without the package, which extra brings the arm."""
    with pytest.raises(RobotError, match="offline is downloaded at its first use, and the download failed"):
        load_robot("offline")
    monkeypatch.setattr(catalogue, "fetched_names", frozenset)
    for name in ("xarm6", "Lite 6"):
        with pytest.raises(MissingExtraError, match=r"manip_learn\[descriptions\]"):
            load_robot(name)


def test_shipped_robots_are_found_in_a_wheel(tmp_path, monkeypatch):
    """Capitals, hyphens and spaces do not count. An installed package has the robots inside."""
    assert set(catalogue.SHORT_NAMES) <= set(example_robots())
    for written, name in {"UR5e": "ur5e", "SO-101": "so101", "xarm 7": "xarm7"}.items():
        assert find_robot(written) == find_robot(name)
    (tmp_path / "_robots").mkdir()
    (tmp_path / "_robots" / "planar3.urdf").write_text(ARM, encoding="utf-8")
    monkeypatch.setattr(catalogue.importlib.resources, "files", lambda package: tmp_path)
    assert load_robot("planar3").name == "arm"


def test_locked_joints_stand_where_they_are_locked(rng):
    """Fingers locked: seven degrees of freedom, whichever of the coupled two are named. A joint locked at a position
    stands where the free robot stands with that position; without one at zero, or at the limit nearest to it: Panda's
    elbow cannot be straight.
    """
    both = load_robot("panda", locked=PANDA_FINGERS)
    for fingers in (PANDA_FINGERS[:1], PANDA_FINGERS[0]):
        one = load_robot("panda", locked=fingers)
        assert one.nv == both.nv == 7 and not one.mimics and one.fingerprint == both.fingerprint
        assert set(PANDA_FINGERS) == set(one.locked)
    free, held = load_robot("panda"), load_robot("panda", locked={"panda_joint2": 0.3, "panda_finger_joint1": 0.02})
    q = free.random_configuration(rng)
    q[1], q[7] = 0.3, 0.02
    pose = held.pose(np.delete(q, [1, 7]), "panda_rightfinger")
    np.testing.assert_allclose(pose, free.pose(q, "panda_rightfinger"), atol=rounding(8 * 9, q))
    assert load_robot("panda", locked=("panda_joint4",)).locked["panda_joint4"] == free.position_upper[3] < 0


def test_what_cannot_be_locked():
    """A follower alone, a position outside the limits, or a joint that does not exist: a near name is offered."""
    for locked, code in (
        (PANDA_FINGERS[1:], "locked-follower"),
        ({"panda_joint1": 9.0}, "locked-position"),
        ({"panda_joint1": "left"}, "locked-position"),
    ):
        with case(locked), pytest.raises(RobotError) as caught:
            load_robot("panda", locked=locked)
        assert caught.value.code == code
    with pytest.raises(UnknownNameError, match="panda_finger_joint1"):
        load_robot("panda", locked=("finger_joint1",))


def test_fingerprint_is_of_the_kinematics(tmp_path, arm):
    """Line ends, comments, visuals and last digits do not matter; geometry, locking and the base do."""
    ball = '<link name="tip"><visual><geometry><sphere radius="1"/></geometry></visual></link>'
    same = [("\n", "\r\n"), ("<link", "<!-- c --><link"), ('<link name="tip"/>', ball)]
    same += [("0 0 0.3", "0 0 0.30000000000000004")]
    other = [("0 0 0.3", "0 0 0.31"), ("0 0 0.3", "0 0 0.300001"), ('"2"/>', '"2.1"/>')]

    def fingerprint_with(change):
        (tmp_path / "other.urdf").write_text(ARM.replace(*change), encoding="utf-8", newline="")
        return load_robot(tmp_path / "other.urdf").fingerprint

    fingerprint = load_robot(arm).fingerprint
    assert {*map(fingerprint_with, same)} == {fingerprint}
    options = [{"locked": ("elbow",)}, {"locked": {"elbow": 0.1}}, {"base": "floating"}, {"base": "planar"}]
    different = {*map(fingerprint_with, other), *(load_robot(arm, **o).fingerprint for o in options)}
    assert len(different | {fingerprint}) == 1 + len(other) + len(options)


def test_bases(arm):
    """The root link can be fixed, free in the plane or free in space; any other base is refused."""
    assert [(r.nq, r.nv) for r in (load_robot(arm, base=base) for base in ("planar", "floating"))] == [(6, 5), (9, 8)]
    with pytest.raises(RobotError, match="floating"):
        load_robot(arm, base="flying")  # type: ignore[arg-type]
    arm.write_bytes(edited(("elbow", "root_joint")))
    with pytest.raises(RobotError, match="root_joint") as caught:
        load_robot(arm, base="floating")
    assert caught.value.code == "name-reserved"


def test_package_dirs_must_exist(arm, tmp_path):
    """A mistyped package folder is found at once, not when meshes are missing."""
    with pytest.raises(RobotError, match="no such folder"):
        load_robot(arm, package_dirs=[tmp_path / "nowhere"])
    for given in (str(tmp_path), tmp_path):
        assert load_robot(arm, package_dirs=given).package_dirs == (tmp_path,)


@pytest.mark.parametrize(("expression", "words"), rows_in("wrong_xacro.txt"))
def test_xacro_only_when_asked(expression, words, tmp_path, monkeypatch):
    """A xacro file is expanded; what it does wrong is a sentence, also an expression that never ends, or wants
    gigabytes, in the time and memory of its process.
    """
    pytest.importorskip("xacrodoc")
    path, found = tmp_path / "arm.xacro", '<xacro:property name="h" value="0.25"/><link name="base"/>'
    text = XACRO_ARM.replace('<link name="base"/>', found)
    path.write_text(text.replace("0 0 0.3", "0 0 ${2*h}"), encoding="utf-8")
    assert load_robot(path, xacro=True).pose([0, 0], "upper")[2, 3] == pytest.approx(0.5)
    monkeypatch.setattr(xacro_expansion, "EXPANSION_SECONDS", 1 if "**9" in expression[:14] else 60)
    path.write_text(text.replace("0 0 0.3", expression), encoding="utf-8")
    with pytest.raises(RobotError, match=words) as caught:
        load_robot(path, xacro=True)
    assert (caught.value.code, caught.value.path) == ("xacro-failed", path)


def test_arguments_and_packages_of_xacro_files(tmp_path):
    """Values are given to `<xacro:arg>`, a misspelt name is refused, and `$(find ...)` looks in package_dirs."""
    pytest.importorskip("xacrodoc")
    (part := tmp_path / "packages" / "heights" / "h.xacro").parent.mkdir(parents=True)
    part.write_text(f'{PART}<xacro:arg name="extra" default="0"/></robot>', encoding="utf-8")
    include = '<xacro:arg name="height" default="0.5"/><xacro:include filename="$(find heights)/h.xacro"/>'
    path = tmp_path / "arm.xacro"
    arm = XACRO_ARM.replace('<link name="base"/>', include + '<link name="base"/>')
    path.write_text(arm.replace("0 0 0.3", "0 0 ${$(arg height)+$(arg extra)}"), encoding="utf-8")
    for xacro, height in ((True, 0.5), ({"height": 0.25, "extra": "1"}, 1.25)):
        robot = load_robot(path, package_dirs=[tmp_path / "packages"], xacro=xacro)
        assert robot.pose([0, 0], "upper")[2, 3] == pytest.approx(height)
    for name, xacro, words in (
        (path, {"hieght": "0.25"}, "no argument 'hieght'; it has 'height'"),
        (path, "ur5", "a mapping"),
        ("planar3", {"height": "1"}, "not a .xacro file"),
    ):
        with case(words), pytest.raises(RobotError, match=words):
            load_robot(name, package_dirs=[tmp_path / "packages"], xacro=xacro)


def test_a_file_that_only_defines_a_macro_says_so(tmp_path):
    """The macros are named, and what to load or write; expanded from xacro, or called a URDF."""
    pytest.importorskip("xacrodoc")
    macros = "".join(f'<xacro:macro name="{name}"><link name="{name}"/></xacro:macro>' for name in ("arm", "hand"))
    words = "only defines the macros 'arm', 'hand'.*load the file that calls them, usually robot.urdf.xacro, or w"
    for name in ("arm.urdf", "arm.xacro"):
        (tmp_path / name).write_text(f"{PART}{macros}</robot>")
        with case(name), pytest.raises(RobotError, match=words) as caught:
            load_robot(tmp_path / name, xacro=name.endswith(".xacro"))
        assert caught.value.code == "no-links"
