"""MJCF files: the same robot as MuJoCo sees, or a refusal."""

from __future__ import annotations

import numpy as np
import pytest
from case import DATA
from urdf_corpus import stl

from manip_learn.errors import RobotError
from manip_learn.robot.collision import known_shapes
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot_summary import cross_check
from manip_learn.robot.visuals.meshes import Mesh
from manip_learn.robot.visuals.visual_shapes import Solid, visual_shapes

GEOM = '<geom type="sphere" size="0.1"/>'
RADIAN = '<compiler angle="radian"/>'


def body(name: str, attributes: str = "", inside: str = "") -> str:
    """One body with a ball for a mass."""
    return f'<body name="{name}" {attributes}>{inside}{GEOM}</body>'


def mjcf(bodies: str, head: str = RADIAN, tail: str = "") -> str:
    """A file."""
    return f'<mujoco model="m">{head}<worldbody>{bodies}</worldbody>{tail}</mujoco>'


def load(tmp_path, text: str, **options):
    """Load a text."""
    (tmp_path / "robot.xml").write_text(text, encoding="utf-8")
    return load_robot(tmp_path / "robot.xml", **options)


JOINT = '<joint name="j" axis="0 1 1"/>'
SECOND = body("b", 'pos="0.3 0.1 0" euler="0.3 0 0.2"', '<joint name="k" axis="1 0 0.5"/>')


def files(folder: str) -> pytest.MarkDecorator:
    """The files of a folder of tests/data."""
    return pytest.mark.parametrize("path", [pytest.param(p, id=p.stem) for p in sorted((DATA / folder).glob("*.xml"))])


@files("mjcf")
def test_every_body_is_where_mujoco_puts_it(path, rng):
    """Positions and orientations of all bodies agree to 1e-12 at random joint values."""
    mujoco = pytest.importorskip("mujoco")
    robot, model = load_robot(path), mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    assert any("no velocity limits" in w for w in robot.warnings)  # of the hinges and slides that each has
    for _ in range(5):
        q = robot.random_configuration(rng)
        for block in robot.blocks:
            values = q[block.q]
            # a quaternion is x y z w here and w x y z there
            data.joint(block.name).qpos = values[[0, 1, 2, 6, 3, 4, 5]] if block.kind == "floating" else values
        mujoco.mj_kinematics(model, data)
        for link in (n for n in ("a", "b") if n in robot.frame_names):
            pose = robot.pose(q, robot.frame(link))
            np.testing.assert_allclose(pose[:3, 3], data.body(link).xpos, atol=1e-12)
            np.testing.assert_allclose(pose[:3, :3].ravel(), data.body(link).xmat, atol=1e-12)


def test_linear_couplings_become_mimic_joints(tmp_path, rng):
    """A coupled joint follows, counted from both reference values, as in MuJoCo's equation."""
    inside = '<joint name="j" ref="0.2"/>' + body("b", "", '<joint name="k" ref="0.1"/>')
    follows = '<equality><joint joint1="k" joint2="j" polycoef="0.3 -2"/></equality>'
    robot = load(tmp_path, mjcf(body("a", "", inside), tail=follows))
    (mimic,) = robot.mimics
    assert (mimic.joint, mimic.leader, mimic.multiplier) == ("k", "j", -2.0)
    assert mimic.offset == pytest.approx(0.1 + 0.3 + 2 * 0.2)
    assert robot.nv == 1
    held = load(tmp_path, mjcf(body("a", "", JOINT + SECOND)), locked={"k": 0.4})
    assert (held.nv, held.locked) == (1, {"k": 0.4}) and held.fingerprint != robot.fingerprint
    assert cross_check(robot, rng).agrees


@pytest.mark.parametrize("range_", ["0 0", "1 0", "1 1", "0 1", "-2 2"])
@pytest.mark.parametrize("limited", ["", 'limited="auto"', 'limited="false"'])
def test_limits_are_those_of_mujoco(tmp_path, range_, limited):
    """A range is a limit where MuJoCo's compiler makes one of it; that of a hinge may be in degrees, a slide's not."""
    mujoco = pytest.importorskip("mujoco")
    for head, kind in ((RADIAN, "hinge"), ("", "hinge"), ("", "slide")):
        default = '<default><joint range="-1 1"/></default>'
        text = mjcf(body("a", "", f'<joint name="j" type="{kind}" {limited} range="{range_}"/>'), head + default)
        model, robot = mujoco.MjModel.from_xml_string(text), load(tmp_path, text)
        expected = model.jnt_range[0] if model.jnt_limited[0] else (-np.inf, np.inf)
        np.testing.assert_allclose((robot.position_lower[0], robot.position_upper[0]), expected, rtol=1e-15)
        assert np.isinf(robot.velocity_limit[0])
    is_odd = range_ in ("1 0", "1 1") and limited != 'limited="false"'
    assert any("is ignored, as in MuJoCo" in w for w in robot.warnings) == is_odd


def test_a_mesh_has_the_scale_of_its_class(tmp_path):
    """A file in millimetres whose scale stands in a default class is as large as one that says it itself."""
    (tmp_path / "a.stl").write_bytes(stl(value=900.0))
    scale, sizes = 'scale="0.001 0.001 0.001"', []
    for default, own in ((scale, 'class="c"'), ('scale="9 9 9"', f'class="c" {scale}')):
        head = f'<default><default class="c"><mesh {default}/></default></default>'
        text = mjcf(body("a", "", JOINT + '<geom type="mesh" mesh="a"/>'), head)
        robot = load(tmp_path, text.replace("<worldbody>", f'<asset><mesh {own} file="a.stl"/></asset><worldbody>'))
        sizes.append(max(np.ptp(v.shape.vertices) for v in visual_shapes(robot) if isinstance(v.shape, Mesh)))
    assert sizes == [pytest.approx(0.9, rel=1e-3)] * 2


def test_sites_are_frames_and_shapes_are_drawn(tmp_path):
    """Sites can be named as tips; primitive shapes keep size and colour; half lengths become lengths."""
    shapes = (
        '<geom type="box" size="0.1 0.2 0.3" rgba="1 0 0 1"/><geom type="capsule" size="0.1 0.2"/>'
        '<geom type="cylinder" size="0.05" fromto="0 0 0 0 0 0.6"/><geom type="plane" size="1 1 1"/>'
    )
    robot = load(tmp_path, mjcf(body("a", "", JOINT + shapes + '<site name="tcp" pos="0 0 0.5"/>')))
    assert "tcp" in robot.frame_names
    drawn = {v.shape.kind: v for v in visual_shapes(robot)}
    sizes = {"box": (0.2, 0.4, 0.6), "capsule": (0.1, 0.4), "cylinder": (0.05, 0.6), "sphere": (0.1,)}
    assert {kind: v.shape.size for kind, v in drawn.items()} == {k: pytest.approx(x) for k, x in sizes.items()}
    assert drawn["box"].colour == (1.0, 0.0, 0.0, 1.0) and drawn["cylinder"].placement[2, 3] == pytest.approx(0.3)


def test_what_touches_in_mjcf_counts_for_collisions(tmp_path):
    """Geoms that touch something count, whether they are drawn or not; in a body without any, what is drawn. Where
    MuJoCo fits a body to a mesh, the mesh counts.
    """
    unseen, seen = 'group="3"', 'contype="0" conaffinity="0"'
    both = f'<geom type="box" size="0.1 0.1 0.1" {unseen}/><geom type="capsule" size="0.1 0.2" {seen}/>'
    fitted = f'<joint name="k"/><geom type="capsule" mesh="m" {unseen}/><geom size="0.2" {seen}/>'
    drawn = f'<geom type="cylinder" size="0.1 0.2" {seen}/>'
    bodies = f'<body name="a">{JOINT}{both}<body name="b">{fitted}<body name="c">{drawn}</body></body></body>'
    (tmp_path / "m.stl").write_bytes(stl())
    robot = load(tmp_path, mjcf(bodies, RADIAN + '<asset><mesh name="m" file="m.stl"/></asset>'))
    kinds = {
        tag: {v.link: v.shape.kind if isinstance(v.shape, Solid) else "mesh" for v in visual_shapes(robot, tag)}
        for tag in ("collision", "visual")
    }
    assert kinds["collision"] == {"a": "box", "b": "mesh", "c": "cylinder"}
    assert kinds["visual"] == {"a": "capsule", "b": "sphere", "c": "cylinder"}
    assert known_shapes(robot) == "collision"


@files("mjcf_refused")
def test_what_cannot_be_kept_is_refused(path):
    """Files that Pinocchio's own reader takes in silence or garbles are refused with a code, that of the file's name,
    and a line.
    """
    with pytest.raises(RobotError, match=path.name) as caught:
        load_robot(path)
    assert caught.value.code == path.stem.partition("_")[0] and caught.value.line is not None
