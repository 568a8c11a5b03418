"""What `inspect` tells about a robot, its likely tips among it."""

from __future__ import annotations

import pytest
from case import case
from urdf_corpus import ARM

from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot_summary import inspect_robot
from manip_learn.robot.tips import likely_tips


def test_likely_tips():
    """One tip is an answer, two are a question; a robot that does not move has none."""
    for name, tips in [
        ("planar3", ("tip",)),
        ("panda", ("panda_hand_tcp",)),
        ("xarm7", ("link_eef",)),
        ("kinova", ("j2s6s200_end_effector",)),
        ("so101", ("gripper_frame_link",)),
        ("ur5", ("ee_link", "tool0")),
        ("tiago_dual", ("hand_left_grasping_frame", "hand_right_grasping_frame")),
        ("solo12", ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")),
        ("hector", ()),
    ]:
        with case(name, tips):
            assert likely_tips(load_robot(name)) == tips
    left = [n for n in load_robot("tiago_dual").joint_names if "left" in n and "wheel" not in n]
    assert likely_tips(load_robot("tiago_dual", locked=left)) == ("hand_right_grasping_frame",)


def test_summary_of_a_real_robot():
    """Names, kinds, units, limits, mimics, meshes and the comparison with yourdfpy are all there."""
    summary = inspect_robot(load_robot("panda"))
    assert (summary.name, summary.nq, summary.nv) == ("panda", 8, 8)
    assert [j.unit for j in summary.joints] == ["rad"] * 7 + ["m"]
    assert summary.joints[0].kind == "revolute" and summary.joints[0].upper == pytest.approx(2.8973)
    assert summary.mimics[0].joint == "panda_finger_joint2"
    assert summary.cross_check is not None and summary.cross_check.agrees
    assert len(summary.meshes_found) == 10 and not summary.meshes_missing
    assert summary.tips == ("panda_hand_tcp",) and "panda_hand" in summary.frames
    assert summary.warnings == ()


def test_summary_says_what_is_wrong(tmp_path):
    """Warnings of validation, missing meshes, and the kind of each coordinate of a moving base."""
    path = tmp_path / "arm.urdf"
    mesh = "".join(f'<visual><geometry><mesh filename="gone{i}.stl"/></geometry></visual>' for i in range(3))
    path.write_text(
        ARM.replace('<link name="tip"/>', f'<link name="tip">{mesh}</link>').replace('velocity="1" ', ""),
        encoding="utf-8",
    )
    summary = inspect_robot(load_robot(path, base="planar"))
    assert [j.unit for j in summary.joints] == ["m", "m", "rad", "rad", "rad"]
    assert [j.name for j in summary.joints][:3] == ["root_joint.x", "root_joint.y", "root_joint.rz"]
    assert any("no velocity limit" in w for w in summary.warnings)
    assert list(summary.meshes_missing) == ["gone0.stl", "gone1.stl", "gone2.stl"]  # one line with their number
    path.write_text(path.read_text().replace("visual>", "collision>"), encoding="utf-8")  # shapes for collisions, too
    assert list(inspect_robot(load_robot(path)).meshes_missing) == ["gone0.stl", "gone1.stl", "gone2.stl"]
    known = [w.partition(";")[0] for w in summary.warnings]
    assert "Plain shapes stand in for tip: mesh 'gone0.stl' (and 2 more) was not found" in known
