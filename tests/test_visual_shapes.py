"""Shapes to draw: where the file puts them, or why there are none."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from test_meshes import painted
from urdf_corpus import ARM, stl

from manip_learn.robot.description.catalogue import example_package_dir, example_robots
from manip_learn.robot.loading import load_robot
from manip_learn.robot.visuals.meshes import Mesh
from manip_learn.robot.visuals.visual_shapes import Solid, resolve_meshes, visual_shapes

TIP = '<link name="tip"/>'


def arm_with(tmp_path, visuals: str, head: str = ""):
    """The two-joint arm with something on its tip."""
    path = tmp_path / "urdf" / "arm.urdf"
    path.parent.mkdir(exist_ok=True)
    text = ARM.replace(TIP, f'<link name="tip">{visuals}</link>').replace(
        '<link name="base"/>', f'{head}<link name="base"/>'
    )
    path.write_text(text, encoding="utf-8")
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
    """Joint, placement and scaled mesh size agree with Pinocchio's own geometry reader."""
    robot = load_robot(name)
    model = robot.pinocchio_model
    geometry = pin.buildGeomFromUrdf(
        model, str(example_robots()[name]), pin.GeometryType.VISUAL, package_dirs=[str(example_package_dir())]
    )
    theirs = sorted((g.parentJoint, *g.placement.homogeneous.round(6).ravel()) for g in geometry.geometryObjects)
    visuals = visual_shapes(robot)
    ours = sorted((v.joint, *v.placement.round(6).ravel()) for v in visuals)
    np.testing.assert_allclose(ours, theirs, atol=2e-6)
    assert not any(v.fault for v in visuals)
    sizes = sorted(float(np.ptp(v.shape.vertices, axis=0).max()) for v in visuals if isinstance(v.shape, Mesh))
    reference = sorted(
        float(np.ptp(np.asarray(g.geometry.vertices()) * g.meshScale, axis=0).max())
        for g in geometry.geometryObjects
        if g.meshPath and g.meshPath not in ("BOX", "CYLINDER", "SPHERE", "CAPSULE")
    )
    np.testing.assert_allclose(sizes, reference, rtol=1e-5)


def test_locked_joints_carry_their_shapes_along():
    """The fingers' shapes stay at the hand, at the position of the lock."""
    free, held = load_robot("panda"), load_robot("panda", locked={"panda_finger_joint1": 0.03})
    q = held.neutral()
    full = np.append(q, 0.03)

    def world(robot, posture):
        data = robot.pinocchio_model.createData()
        pin.forwardKinematics(robot.pinocchio_model, data, robot.pinocchio_configuration(posture))
        shapes = visual_shapes(robot)
        return [data.oMi[v.joint].homogeneous @ v.placement for v in shapes if "finger" in v.link]

    for a, b in zip(world(free, full), world(held, q), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_scale_and_mirror(tmp_path):
    """Scale is applied to the vertices; a mirrored mesh keeps its outside outside."""
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "a.stl").write_bytes(stl())
    mesh = '<visual><geometry><mesh filename="../meshes/a.stl" scale="{}"/></geometry></visual>'
    plain, mirrored = visual_shapes(arm_with(tmp_path, mesh.format("2 3 4") + mesh.format("-2 3 4")))
    assert isinstance(plain.shape, Mesh) and isinstance(mirrored.shape, Mesh)
    np.testing.assert_array_equal(plain.shape.vertices.max(axis=0), [2, 3, 0])
    np.testing.assert_array_equal(mirrored.shape.vertices.min(axis=0), [-2, 0, 0])
    normals = [
        np.cross(t[1] - t[0], t[2] - t[0])[2] for t in (s.shape.vertices[s.shape.faces[0]] for s in (plain, mirrored))
    ]
    assert min(normals) > 0


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


def test_a_robot_without_visuals_has_its_links(tmp_path):
    """Each with the joint that carries it, and the reason why nothing is drawn."""
    visuals = visual_shapes(arm_with(tmp_path, ""))
    assert {v.link: v.joint for v in visuals} == {"base": 0, "upper": 1, "tip": 2}
    assert all(v.shape is None and v.fault == "the robot has no visuals" for v in visuals)


def test_meshes_are_found_from_another_folder(tmp_path, monkeypatch):
    """A robot loaded by a relative path keeps its meshes when the program changes its folder."""
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "a.stl").write_bytes(stl())
    arm_with(tmp_path, '<visual><geometry><mesh filename="../meshes/a.stl"/></geometry></visual>')
    monkeypatch.chdir(tmp_path)
    robot = load_robot("urdf/arm.urdf", package_dirs=["meshes"])
    monkeypatch.chdir("/")
    assert isinstance(visual_shapes(robot)[0].shape, Mesh)
    assert robot.package_dirs == (tmp_path / "meshes",)


def test_a_mesh_without_a_material_has_the_colours_of_its_file(tmp_path):
    """Panda's hand is white, black and grey as in its COLLADA file; an STL has no colour and is grey; what the URDF
    says of a shape wins.
    """
    hand = next(v.shape for v in visual_shapes(load_robot("panda")) if v.link == "panda_hand")
    assert isinstance(hand, Mesh) and hand.colours is not None
    brightness = np.unique(hand.colours[:, :3].max(axis=1))
    assert brightness[0] < 0.3 and brightness[-1] > 0.8 and (hand.colours[:, 3] == 1).all()
    assert all(v.colour[3] == 1 and v.shape.colours is None for v in visual_shapes(load_robot("z1")))
    (tmp_path / "a.dae").write_bytes(painted("<color>1 0 0</color>", 0, 5))
    mesh = '<visual><geometry><mesh filename="../a.dae"/></geometry>{}</visual>'
    green = '<material name="x"><color rgba="0 1 0 1"/></material>'
    own, said = visual_shapes(arm_with(tmp_path, mesh.format("") + mesh.format(green)))
    assert len(np.unique(own.shape.colours, axis=0)) == 2
    assert said.shape.colours is None and said.colour == (0, 1, 0, 1)
