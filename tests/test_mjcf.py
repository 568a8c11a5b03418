"""MJCF files: the same robot as MuJoCo sees, or a refusal."""

from __future__ import annotations

import numpy as np
import pytest
from urdf_corpus import stl

from manip_learn.errors import RobotError
from manip_learn.robot.collision import known_shapes
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot_summary import cross_check
from manip_learn.robot.visuals.meshes import Mesh
from manip_learn.robot.visuals.visual_shapes import Solid, visual_shapes

GEOM = '<geom type="sphere" size="0.1"/>'
RADIAN = '<compiler angle="radian"/>'
DEFAULTS = """<compiler angle="radian"/>
<default><joint axis="1 0 0"/><default class="c"><joint axis="0 1 0" range="0 1"/>
<default class="d"><joint type="slide"/></default></default></default>"""


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


def one(attributes: str, inside: str = JOINT, head: str = RADIAN) -> str:
    """A file with one body in the world."""
    return mjcf(body("a", attributes, inside), head)


SLIDE, LAST = '<joint name="x" type="slide" axis="1 0 0"/>', '<joint name="z" pos="0 1 0"/>'
OF_CLASS = body("b", 'pos="1 0 0"', '<joint name="k" class="d"/>')
CASES = {
    "plain": one('pos="1 2 3"', JOINT + SECOND),
    "joint away from its body": one('euler="0.1 0.2 0.3"', f'<joint name="j" axis="0 0 1" pos="0.1 0.2 0.3"/>{SECOND}'),
    "reference angle": one('pos="0 0 1"', '<joint name="j" axis="0 0.6 0.8" ref="0.5"/>' + SECOND),
    "reference slide": one('euler="1 0 0"', '<joint name="j" type="slide" ref="0.5"/>' + SECOND),
    "axis and angle": one('axisangle="1 2 0 0.7"'),
    "two axes": one('xyaxes="1 1 0 -1 2 0.3"'),
    "z axis": one('zaxis="1 1 0.2"'),
    "quaternion not of length one": one('quat="0.5 0.1 0.2 0.9"'),
    "Euler mixed axes": one('euler="10 20 30"', head='<compiler eulerseq="xZy"/>'),
    "default classes": one('childclass="c"', '<joint name="j"/>' + OF_CLASS, DEFAULTS),
    "several joints in a body": one('pos="1 0 0"', SLIDE + JOINT + LAST),
    "body without joint": one('pos="1 0 0" quat="0 1 0 0"', body("b", 'pos="0 1 0"', JOINT)),
    "two bodies in the world": mjcf(body("a", 'pos="1 0 0"', JOINT) + body("b", 'pos="0 1 0"', '<joint name="k"/>')),
    "free body": one('pos="1 0 0"', '<freejoint name="f"/>' + SECOND),
}


@pytest.mark.parametrize("name", CASES)
def test_every_body_is_where_mujoco_puts_it(tmp_path, rng, name):
    """Positions and orientations of all bodies agree to 1e-12 at random joint values."""
    mujoco = pytest.importorskip("mujoco")
    robot, model = load(tmp_path, CASES[name]), mujoco.MjModel.from_xml_string(CASES[name])
    data = mujoco.MjData(model)
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
    robot = load(tmp_path, mjcf(body("a", "", inside), tail=COUPLED.format("0.3 -2")))
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


COUPLED = '<equality><joint joint1="k" joint2="j" polycoef="{}"/></equality>'
REFUSED = {
    "mjcf-element": mjcf('<include file="other.xml"/>'),
    "mjcf-class": one("", '<joint class="nowhere"/>'),
    "mjcf-compiler": mjcf("", head='<compiler angle="gon"/>'),
    "mjcf-orientation": one('quat="0 0 0 0"'),
    "mjcf-orientation twice": one('quat="1 0 0 0" euler="0 0 1"'),
    "mjcf-coupling": mjcf(body("a", "", JOINT + SECOND), tail=COUPLED.format("0 1 2")),
    "joint-type": one("", '<joint type="ball"/>'),
    "number": one('pos="x 0 0"'),
    "limit-order": one("", '<joint limited="true" range="1 -1"/>'),
}


@pytest.mark.parametrize("code", REFUSED)
def test_what_cannot_be_kept_is_refused(tmp_path, code):
    """Files that Pinocchio's own reader takes in silence or garbles are refused with a code and a line."""
    with pytest.raises(RobotError, match=str(tmp_path)) as caught:
        load(tmp_path, REFUSED[code])
    assert caught.value.code == code.partition(" ")[0] and caught.value.line is not None
